"""Compiled quasi-static projection: how an object gives way to a tool, eq. (6.5b)–(6.5c), with Coulomb friction.

All quantities are in the object frame, where the centre of friction is constant. The object's displacement is a twist
``(vx, vy, w)`` about the centre of friction with metric ``M = diag(1, 1, c^2)``; a contact impulse ``-n ln + t lt`` at a point with
arm ``r`` moves it by ``M^-1 J^T l``.
"""

import math

from numba import njit

from vpsto_ros.contact.narrow_phase import GAP, NX, NY, PX, PY

SLIP, ARM_N, ARM_T, LAMBDA_N, LAMBDA_T = 5, 6, 7, 8, 9
CONTACT_COLUMNS = 10
SWEEPS = 60


@njit(cache=True, nogil=True, inline="always")
def _impulse(depth, slip, an, at, k, friction):
    """Impulse that removes `depth` at one contact and drags it along by `slip` as far as friction allows.

    Eliminating the normal impulse makes the tangential displacement grow monotonically with the tangential impulse, so either
    the sticking solution lies in the friction cone or exactly one point of the cone's edge on the way to it is the answer.
    """
    if depth <= 0.0:
        return 0.0, 0.0
    a11 = 1.0 + k * an * an
    if friction <= 0.0:
        return depth / a11, 0.0
    a12 = -k * an * at
    a22 = 1.0 + k * at * at
    lt = (a11 * slip - a12 * depth) / (a11 * a22 - a12 * a12)
    ln = (depth - a12 * lt) / a11
    if abs(lt) > friction * ln:
        edge = math.copysign(friction, lt)
        ln = depth / (a11 + edge * a12)
        lt = edge * ln
    return ln, lt


@njit(cache=True, nogil=True)
def solve_contacts(contacts, count, k, friction, fx, fy):
    """Twist about the centre of friction (fx, fy) that opens all contacts; see :func:`_impulse`.

    One contact is solved in closed form, several by block Gauss-Seidel on the impulses.

    Args:
        contacts: rows with gap, normal, point and the tangential target `SLIP` along ``t = (-ny, nx)``.
        count: number of rows used.
        k: 1 / c^2 [1/m^2].
        friction: coefficient of friction, 0 ignores `SLIP`.
        fx: centre of friction, object frame [m].
        fy: centre of friction, object frame [m].
    """
    for i in range(count):
        rx, ry = contacts[i, PX] - fx, contacts[i, PY] - fy
        nx, ny = contacts[i, NX], contacts[i, NY]
        contacts[i, ARM_N] = rx * ny - ry * nx
        contacts[i, ARM_T] = rx * nx + ry * ny
    if count == 1:
        an, at = contacts[0, ARM_N], contacts[0, ARM_T]
        ln, lt = _impulse(-contacts[0, GAP], contacts[0, SLIP], an, at, k, friction)
        nx, ny = contacts[0, NX], contacts[0, NY]
        return -nx * ln - ny * lt, -ny * ln + nx * lt, k * (at * lt - an * ln)
    return _gauss_seidel(contacts, count, k, friction)


@njit(cache=True, nogil=True)
def _gauss_seidel(contacts, count, k, friction):
    vx = vy = w = 0.0
    for i in range(count):
        contacts[i, LAMBDA_N] = 0.0
        contacts[i, LAMBDA_T] = 0.0
    for _ in range(SWEEPS):
        change = 0.0
        for i in range(count):
            nx, ny = contacts[i, NX], contacts[i, NY]
            an, at = contacts[i, ARM_N], contacts[i, ARM_T]
            ln, lt = contacts[i, LAMBDA_N], contacts[i, LAMBDA_T]
            # What is left for this contact when its own impulse is taken back.
            moved_n = -nx * vx - ny * vy - an * w - (1.0 + k * an * an) * ln + k * an * at * lt
            moved_t = -ny * vx + nx * vy + at * w - (1.0 + k * at * at) * lt + k * an * at * ln
            ln_new, lt_new = _impulse(-contacts[i, GAP] - moved_n, contacts[i, SLIP] - moved_t, an, at, k, friction)
            dn, dt = ln_new - ln, lt_new - lt
            contacts[i, LAMBDA_N], contacts[i, LAMBDA_T] = ln_new, lt_new
            vx += -nx * dn - ny * dt
            vy += -ny * dn + nx * dt
            w += k * (at * dt - an * dn)
            change = max(change, abs(dn) + abs(dt))
        if change < 1e-8:
            break
    return vx, vy, w
