"""Compiled modes of the puck model: floating, bouncing off a wall and being hit, for means and covariances.

A model is an array of rows, each of two numbers: (period, opening), reach, (delay of hits, share of lively
bounces), (contact distance, radius of the posts with the puck's), and for floating, wall, lively wall and
mallet seven rows: matrix (2 rows; for the mallet that of the puck's velocity), offset, covariance (2 rows),
growth (2 rows); at last the matrix of the mallet's velocity; see
:attr:`vpsto_ros.contact.puck.PuckModel.kernel_rows`.

Nothing is allocated here: planners look at thousands of shots at once. A work array has shape (8, 4).
"""

import math

import numpy as np
from numba import njit

FLOATING, WALL, LIVELY, MALLET, STRIKER, ROWS = 4, 11, 18, 25, 32, 34
"""First row of each mode, of the matrix of the mallet's velocity, and how many rows there are."""
MERGED = 0
"""Both kinds of bounces as one Gaussian; else WALL or LIVELY."""
LEAST_CLOSING = 5e-3
"""Slower, puck and mallet do not hit each other but move together [m/s]."""
GRAZING = 0.1
"""Cosine of the angle between normal and approach below which a hit grazes."""


@njit(cache=True, nogil=True)
def next_wall(model, x, y, vx, vy, longest):
    """The wall that a puck meets first within a time: (time, axis, side), axis -1 for none.

    A puck that is beyond a wall and still on its way out meets it now. Openings of goals are no wall.
    """
    best, axis, side = longest, -1, 0.0
    for a in range(2):
        position, velocity = (x, vx) if a == 0 else (y, vy)
        if velocity == 0.0:
            continue
        sign = 1.0 if velocity > 0.0 else -1.0
        time = max(0.0, (sign * model[1, a] - position) / velocity)
        if time < best or (time <= best and axis < 0):
            if a == 0 and abs(y + time * vy) <= model[0, 1]:
                continue
            best, axis, side = time, a, sign
    return best, axis, side


@njit(cache=True, nogil=True)
def transform(a, covariance, work):
    """Covariance (4, 4) in place: a covariance a', with a and the result kept symmetric."""
    for i in range(4):
        for j in range(4):
            total = 0.0
            for k in range(4):
                total += a[i, k] * covariance[k, j]
            work[i, j] = total
    for i in range(4):
        for j in range(i, 4):
            total = 0.0
            for k in range(4):
                total += work[i, k] * a[j, k]
            covariance[i, j] = covariance[j, i] = total


@njit(cache=True, nogil=True)
def _identity(a):
    for i in range(4):
        for j in range(4):
            a[i, j] = 1.0 if i == j else 0.0


@njit(cache=True, nogil=True)
def scales(model, mode, normal, tangential):
    """By what standard deviations of a mode are multiplied along normal and tangent.

    Args:
        model: rows.
        mode: first row of it.
        normal: mean square of the speed with which the bodies close in.
        tangential: and with which they slip.
    """
    a, b = model[mode + 5, 0], model[mode + 5, 1]
    c, d = model[mode + 6, 0], model[mode + 6, 1]
    return (
        math.sqrt(1.0 - a - b + a * normal + b * tangential),
        math.sqrt(1.0 - c - d + c * normal + d * tangential),
    )


@njit(cache=True, nogil=True)
def float_on(model, part, mean, covariance, work):
    """Float for a part of a step, to first order in what a step changes, in place."""
    f, half = FLOATING, 0.5 * part * model[0, 0]
    a, vx, vy = work[4:], mean[2], mean[3]
    _identity(a)
    for i in range(2):
        for j in range(2):
            kept = (1.0 if i == j else 0.0) * (1.0 - part) + part * model[f + i, j]
            a[2 + i, 2 + j] = kept
            a[i, 2 + j] = half * (kept + (1.0 if i == j else 0.0))
    after_x = a[2, 2] * vx + a[2, 3] * vy + part * model[f + 2, 0]
    after_y = a[3, 2] * vx + a[3, 3] * vy + part * model[f + 2, 1]
    mean[0] += half * (vx + after_x)
    mean[1] += half * (vy + after_y)
    mean[2], mean[3] = after_x, after_y
    transform(a, covariance, work)
    for i in range(2):
        for j in range(2):
            covariance[2 + i, 2 + j] += part * model[f + 3 + i, j]


@njit(cache=True, nogil=True)
def _expected(model, row, normal, tangential):
    """Velocity after a mode, in the frame of contact, of the one before it."""
    after = model[row, 0] * normal + model[row, 1] * tangential + model[row + 2, 0]
    return after, model[row + 1, 0] * normal + model[row + 1, 1] * tangential + model[row + 2, 1]


@njit(cache=True, nogil=True)
def bounce_law(model, kind, normal, tangential, normal_variance, tangential_variance):
    """What a bounce does to a velocity in the frame of contact, (5.2).

    Args:
        model: rows.
        kind: WALL, LIVELY, or MERGED: their mixture as one Gaussian.
        normal: velocity before it along the normal.
        tangential: and along the tangent.
        normal_variance: of the first.
        tangential_variance: of the second.

    Returns:
        Matrix by rows (4 numbers), velocity afterwards (2), covariance (nn, nt, tt).
    """
    row = LIVELY if kind == LIVELY else WALL
    squares = normal * normal + normal_variance, tangential * tangential + tangential_variance
    sn, st = scales(model, row, squares[0], squares[1])
    m00, m01, m10, m11 = model[row, 0], model[row, 1], model[row + 1, 0], model[row + 1, 1]
    n, t = _expected(model, row, normal, tangential)
    nn, nt, tt = sn * sn * model[row + 3, 0], sn * st * model[row + 3, 1], st * st * model[row + 4, 1]
    share = model[2, 1]
    if kind == MERGED and share > 0.0:
        b, rest = LIVELY, 1.0 - share
        sn, st = scales(model, b, squares[0], squares[1])
        n2, t2 = _expected(model, b, normal, tangential)
        dn, dt, both = n2 - n, t2 - t, share * rest
        nn = rest * nn + share * sn * sn * model[b + 3, 0] + both * dn * dn
        nt = rest * nt + share * sn * st * model[b + 3, 1] + both * dn * dt
        tt = rest * tt + share * st * st * model[b + 4, 1] + both * dt * dt
        m00, m01 = rest * m00 + share * model[b, 0], rest * m01 + share * model[b, 1]
        m10, m11 = rest * m10 + share * model[b + 1, 0], rest * m11 + share * model[b + 1, 1]
        n, t = n + share * dn, t + share * dt
    return m00, m01, m10, m11, n, t, nn, nt, tt


@njit(cache=True, nogil=True)
def bounce(model, kind, time, rest, axis, side, mean, covariance, work):
    """Move evenly for a time, bounce off a wall, and move on for the rest, in place.

    Where the state is off, the wall is met at another time.
    """
    other, a = 1 - axis, work[4:]
    # The tangent is a quarter turn counter-clockwise from the normal, which points into the table.
    into, along = -side, (-side if axis == 0 else side)
    vn, vt = mean[2 + axis], mean[2 + other]
    m00, m01, m10, m11, n, t, nn, nt, tt = bounce_law(
        model, kind, into * vn, along * vt, covariance[2 + axis, 2 + axis],
        covariance[2 + other, 2 + other],
    )
    n, t = into * n, along * t
    m01, m10, nt = into * along * m01, into * along * m10, into * along * nt
    _identity(a)
    a[2 + axis, 2 + axis], a[2 + axis, 2 + other] = m00, m01
    a[2 + other, 2 + axis], a[2 + other, 2 + other] = m10, m11
    a[axis, 2 + axis], a[axis, 2 + other] = time + rest * m00, rest * m01
    a[other, 2 + axis], a[other, 2 + other] = rest * m10, time + rest * m11
    if time > 0.0:
        jump_n, jump_t = vn - n, vt - t
        a[axis, axis] -= jump_n / vn
        a[other, axis] -= jump_t / vn
        a[axis, 2 + axis] -= time * jump_n / vn
        a[other, 2 + axis] -= time * jump_t / vn
    mean[axis] += time * vn + rest * n
    mean[other] += time * vt + rest * t
    mean[2 + axis], mean[2 + other] = n, t
    transform(a, covariance, work)
    for p, q, value in ((axis, axis, nn), (axis, other, nt), (other, axis, nt), (other, other, tt)):
        covariance[2 + p, 2 + q] += value
        covariance[p, 2 + q] += rest * value
        covariance[2 + p, q] += rest * value
        covariance[p, q] += rest * rest * value


@njit(cache=True, nogil=True)
def advance(model, part, mean, covariance, work, kind=MERGED):
    """Advance mean (4,) and covariance (4, 4) in place by a part of a step; whether a wall was met.

    Args:
        model: rows.
        part: of a step.
        mean: state.
        covariance: of it.
        work: space.
        kind: of the bounce if there is one: MERGED, WALL or LIVELY.
    """
    duration = part * model[0, 0]
    time, axis, side = next_wall(model, mean[0], mean[1], mean[2], mean[3], duration)
    if axis < 0:
        float_on(model, part, mean, covariance, work)
    else:
        bounce(model, kind, time, duration - time, axis, side, mean, covariance, work)
    return axis >= 0


@njit(cache=True, nogil=True)
def step(model, part, mean, covariance, kind=MERGED):
    """:func:`advance` for callers without a work array."""
    return advance(model, part, mean, covariance, np.empty((8, 4)), kind)


@njit(cache=True, nogil=True)
def hit(model, delay, striker, mean, covariance, work):
    """Be hit by the mallet now, (5.3), in place.

    Other states of the puck meet the mallet at another time and another angle: the Jacobian says where they
    come out, seen as of this touch.

    Args:
        model: rows.
        delay: by how much later the velocity seems to have changed [s].
        striker: state of the mallet (4,).
        mean: state of the puck (4,).
        covariance: of it (4, 4).
        work: space.
    """
    a, f = work[4:], MALLET
    dx, dy = mean[0] - striker[0], mean[1] - striker[1]
    distance = max(math.sqrt(dx * dx + dy * dy), 1e-9)
    nx, ny = dx / distance, dy / distance  # the tangent is (-ny, nx)
    vx, vy, ux, uy = mean[2], mean[3], striker[2], striker[3]
    vn, vt = nx * vx + ny * vy, nx * vy - ny * vx
    un, ut = nx * ux + ny * uy, nx * uy - ny * ux
    wn, wt = _expected(model, f, vn, vt)
    wn += model[STRIKER, 0] * un + model[STRIKER, 1] * ut
    wt += model[STRIKER + 1, 0] * un + model[STRIKER + 1, 1] * ut
    wx, wy = nx * wn - ny * wt, ny * wn + nx * wt
    xx, both, yy = covariance[2, 2], 2.0 * nx * ny * covariance[2, 3], covariance[3, 3]
    sn, st = scales(
        model, f, (un - vn) ** 2 + nx * nx * xx + both + ny * ny * yy,
        (ut - vt) ** 2 + ny * ny * xx - both + nx * nx * yy,
    )  # fmt: skip
    # What turning the normal by an angle does to the velocity afterwards, J w + F Theta (J F)' (v, u):
    gn = -wt + model[f, 0] * vt - model[f, 1] * vn + model[STRIKER, 0] * ut - model[STRIKER, 1] * un
    gt = wn + model[f + 1, 0] * vt - model[f + 1, 1] * vn
    gt += model[STRIKER + 1, 0] * ut - model[STRIKER + 1, 1] * un
    gx, gy = nx * gn - ny * gt, ny * gn + nx * gt
    # Where they graze, the time of the hit is no linear function of the state any more.
    relative = math.sqrt((vx - ux) ** 2 + (vy - uy) ** 2)
    closing = max(un - vn, LEAST_CLOSING, GRAZING * relative)
    slip = (vt - ut) / closing
    turn_x, turn_y = (-ny + slip * nx) / distance, (nx + slip * ny) / distance
    later_x, later_y = nx / closing, ny / closing
    _identity(a)
    a[2, 0], a[2, 1], a[3, 0], a[3, 1] = gx * turn_x, gx * turn_y, gy * turn_x, gy * turn_y
    # F Theta F'
    k0, k1, k2, k3 = model[f, 0], model[f, 1], model[f + 1, 0], model[f + 1, 1]
    b0, b1 = nx * k0 - ny * k2, nx * k1 - ny * k3
    b2, b3 = ny * k0 + nx * k2, ny * k1 + nx * k3
    a[2, 2], a[2, 3] = b0 * nx - b1 * ny, b0 * ny + b1 * nx
    a[3, 2], a[3, 3] = b2 * nx - b3 * ny, b2 * ny + b3 * nx
    a[0, 0] += (vx - wx) * later_x - delay * a[2, 0]
    a[0, 1] += (vx - wx) * later_y - delay * a[2, 1]
    a[1, 0] += (vy - wy) * later_x - delay * a[3, 0]
    a[1, 1] += (vy - wy) * later_y - delay * a[3, 1]
    a[0, 2], a[0, 3] = -delay * (a[2, 2] - 1.0), -delay * a[2, 3]
    a[1, 2], a[1, 3] = -delay * a[3, 2], -delay * (a[3, 3] - 1.0)
    transform(a, covariance, work)
    mean[0] -= delay * (wx - vx)
    mean[1] -= delay * (wy - vy)
    mean[2], mean[3] = wx, wy
    nn, nt, tt = sn * sn * model[f + 3, 0], sn * st * model[f + 3, 1], st * st * model[f + 4, 1]
    xx = nx * nx * nn - 2.0 * nx * ny * nt + ny * ny * tt
    xy = nx * ny * (nn - tt) + (nx * nx - ny * ny) * nt
    yy = ny * ny * nn + 2.0 * nx * ny * nt + nx * nx * tt
    for p, q, value in ((0, 0, xx), (0, 1, xy), (1, 0, xy), (1, 1, yy)):
        covariance[2 + p, 2 + q] += value
        covariance[p, 2 + q] -= delay * value
        covariance[2 + p, q] -= delay * value
        covariance[p, q] += delay * delay * value


@njit(cache=True, nogil=True)
def hits(model, delay, strikers, means, covariances):
    """:func:`hit` for many, in place: strikers and means (B, 4), covariances (B, 4, 4)."""
    work = np.empty((8, 4))
    for b in range(len(means)):
        hit(model, delay, strikers[b], means[b], covariances[b], work)


@njit(cache=True, nogil=True)
def goal_window(model, slope):
    """Lowest and highest y on the goal line from which a puck comes in between the rounded posts.

    A puck that touches a post still goes in when the bounce off it does not turn it back. With the angle phi
    of the place of touch on the post from the face of the rim, and the slope m of the path, it is turned back
    up to tan(phi - atan m) tan(phi) = e / k, where walls keep e of the speed across and k along them.

    Args:
        model: rows.
        slope: vy / vx there.
    """
    ratio = max(-model[WALL, 0], 0.0) / max(model[WALL + 1, 1], 1e-6)
    radius, high = model[3, 1], 0.0
    low = 0.0
    for side in (-1.0, 1.0):
        m = side * slope
        b = m * (1.0 + ratio)
        tangent = 0.5 * (b + math.sqrt(b * b + 4.0 * ratio))
        cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
        edge = model[0, 1] + radius * (1.0 - tangent * cosine) - m * radius * (1.0 - cosine)
        if side > 0.0:
            high = edge
        else:
            low = -edge
    return low, high
