"""Compiled quasi-static projection, eq. (6.5b)–(6.5c), with Coulomb friction: how an object gives way.

All quantities are in the object frame, where the centre of friction is constant. The object's displacement is
a twist ``(vx, vy, w)`` about the centre of friction with metric ``M = diag(1, 1, c^2)``; a contact impulse
``-n ln + t lt`` at a point with arm ``r`` moves it by ``M^-1 J^T l``.
"""

import math

from numba import njit

from vpsto_ros.contact.narrow_phase import COMPILED, GAP, NX, NY, PX, PY

SLIP, ARM_N, ARM_T, LAMBDA_N, LAMBDA_T = 5, 6, 7, 8, 9
CONTACT_COLUMNS = 10
SWEEPS = 60


@njit(**COMPILED, inline="always")
def _impulse(depth, slip, a11, a12, a21, a22, friction):
    """Impulse (ln, lt) that removes `depth` and drags the contact along by `slip` as far as friction allows.

    The displacement is ``(a11 ln + a12 lt, a21 ln + a22 lt)``. Eliminating the normal impulse makes the
    tangential displacement grow monotonically with the tangential impulse, so either the sticking solution
    lies in the friction cone or exactly one point of the cone's edge on the way to it is the answer.
    """
    if depth <= 0.0:
        return 0.0, 0.0
    if friction <= 0.0:
        return depth / a11, 0.0
    lt = (a11 * slip - a21 * depth) / (a11 * a22 - a12 * a21)
    ln = (depth - a12 * lt) / a11
    if abs(lt) > friction * ln:
        edge = math.copysign(friction, lt)
        ln = depth / (a11 + edge * a12)
        lt = edge * ln
    return ln, lt


@njit(**COMPILED, inline="always")
def solve_contact(gap, nx, ny, px, py, slip, k, friction, fx, fy):
    """Twist about the centre of friction (fx, fy) that opens one contact, in closed form."""
    rx, ry = px - fx, py - fy
    an = rx * ny - ry * nx
    at = rx * nx + ry * ny
    a12 = -k * an * at
    ln, lt = _impulse(-gap, slip, 1.0 + k * an * an, a12, a12, 1.0 + k * at * at, friction)
    return -nx * ln - ny * lt, -ny * ln + nx * lt, k * (at * lt - an * ln)


@njit(**COMPILED, inline="always")
def refine_contact(vx, vy, w, gap, nx, ny, px, py, x0, y0, px0, py0, slip, k, friction, fx, fy):
    """Second-order twist of a step: forces act where the contact is half-way, the gap closes where it ends.

    Args:
        vx: first-order twist of this step, which led to the contact (gap, nx, ny, px, py).
        vy: see vx.
        w: see vx.
        gap: of the contact at the end, like its normal and point.
        nx: see gap.
        ny: see gap.
        px: see gap.
        py: see gap.
        x0: normal and point of the contact at the start of the step (x0, y0, px0, py0).
        y0: see x0.
        px0: see x0.
        py0: see x0.
        slip: tangential displacement of the tool over the step.
        k: 1 / c^2 [1/m^2].
        friction: coefficient of friction.
        fx: centre of friction, object frame [m].
        fy: centre of friction, object frame [m].
    """
    # The normal half-way is not normalised: direction and friction cone do not depend on its length.
    mx, my = 0.5 * (nx + x0), 0.5 * (ny + y0)
    rx, ry = 0.5 * (px + px0) - fx, 0.5 * (py + py0) - fy
    bn = rx * my - ry * mx
    bt = rx * mx + ry * my
    an = (px - fx) * ny - (py - fy) * nx
    dot, cross = nx * mx + ny * my, ny * mx - nx * my
    depth = -nx * vx - ny * vy - an * w - gap
    ln, lt = _impulse(
        depth,
        slip,
        dot + k * an * bn,
        -cross - k * an * bt,
        -k * bt * bn,
        mx * mx + my * my + k * bt * bt,
        friction,
    )
    return -mx * ln - my * lt, -my * ln + mx * lt, k * (bt * lt - bn * ln)


@njit(**COMPILED)
def solve_contacts(contacts, count, k, friction, fx, fy):
    """Twist about the centre of friction that opens all contacts, by block Gauss-Seidel on their impulses.

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
        contacts[i, LAMBDA_N] = 0.0
        contacts[i, LAMBDA_T] = 0.0
    vx = vy = w = 0.0
    for _ in range(SWEEPS):
        change = 0.0
        for i in range(count):
            nx, ny = contacts[i, NX], contacts[i, NY]
            an, at = contacts[i, ARM_N], contacts[i, ARM_T]
            ln, lt = contacts[i, LAMBDA_N], contacts[i, LAMBDA_T]
            # What is left for this contact when its own impulse is taken back.
            moved_n = -nx * vx - ny * vy - an * w - (1.0 + k * an * an) * ln + k * an * at * lt
            moved_t = -ny * vx + nx * vy + at * w - (1.0 + k * at * at) * lt + k * an * at * ln
            a12 = -k * an * at
            ln_new, lt_new = _impulse(
                -contacts[i, GAP] - moved_n, contacts[i, SLIP] - moved_t,
                1.0 + k * an * an, a12, a12, 1.0 + k * at * at, friction,
            )  # fmt: skip
            dn, dt = ln_new - ln, lt_new - lt
            contacts[i, LAMBDA_N], contacts[i, LAMBDA_T] = ln_new, lt_new
            vx += -nx * dn - ny * dt
            vy += -ny * dn + nx * dt
            w += k * (at * dt - an * dn)
            change = max(change, abs(dn) + abs(dt))
        if change < 1e-8:
            break
    return vx, vy, w
