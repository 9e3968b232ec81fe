"""Compiled kernels of the minimal duration and of the batch synthesis (section 3.2.1).

The derivation is in :func:`vpsto_ros.trajectory.minimal_duration`. Notation on one segment of phase length h,
with local coordinate u in [0, 1]: a velocity profile that runs from slope a0 to slope a1 with the mean c (its
chord) is the quadratic a0 + (6c - 4a0 - 2a1) u + (3a0 + 3a1 - 6c) u^2. For alpha the mean is that of the key
positions, for beta it is zero. Swapping the two ends of a segment gives the same profile backwards.
"""

import math

import numpy as np
from numba import njit

MINIMUM_DURATION = 1e-3
"""Duration [s] of a trajectory that does not move."""

BOUNDARY_TOLERANCE = 1e-9
"""Relative excess of a boundary velocity over its limit that still counts as being on the limit."""


@njit(cache=True, nogil=True, error_model="numpy")
def slopes_at_knots(knot_slopes, keys, start, end, alpha, beta):
    """Slopes at the knots: alpha from the key positions, beta from the boundary velocities over duration."""
    size, dof = keys.shape
    for i in range(size):
        for j in range(dof):
            alpha[i, j] = 0.0
            beta[i, j] = knot_slopes[i, size] * start[j] + knot_slopes[i, size + 1] * end[j]
        # Differences to q_0 keep tiny motions far from the origin exact; the weights of the keys sum to zero.
        for k in range(1, size):
            weight = knot_slopes[i, k]
            for j in range(dof):
                alpha[i, j] += weight * (keys[k, j] - keys[0, j])


@njit(cache=True, nogil=True, error_model="numpy")
def _acceleration_bound(duration, a, b, limit):
    """The duration, or the largest root of limit T^2 - b T - a if longer: the limit holds from there on."""
    if limit * duration * duration - b * duration - a >= 0.0 and 2.0 * limit * duration >= b:
        return duration
    discriminant = b * b + 4.0 * limit * a
    if discriminant < 0.0:
        return duration
    root = math.sqrt(discriminant)
    largest = 0.5 * (b + root) / limit if b >= 0.0 else 2.0 * a / (root - b)
    return max(duration, largest)


@njit(cache=True, nogil=True, error_model="numpy")
def _end_velocity_bound(duration, a0, a1, c, b0, b1, limit):
    """The duration, or alpha / (limit - beta) at u = 0 if longer."""
    gap = limit - b0
    if gap > 0.0:
        return max(duration, a0 / gap)
    # A boundary velocity on its limit (alpha is zero there): 0/0, and the ratio of the slopes is its value.
    rise, fall = 6.0 * c - 4.0 * a0 - 2.0 * a1, 4.0 * b0 + 2.0 * b1
    return max(duration, rise / fall)


@njit(cache=True, nogil=True, error_model="numpy")
def _inner_velocity_bound(duration, a0, a1, c, b0, b1, limit, reach):
    """The duration, or the maximum of alpha(u) / (limit - beta(u)) on 0 < u <= reach if longer.

    Both ends of the segment must already be feasible at this duration.
    """
    p1, p2 = 6.0 * c - 4.0 * a0 - 2.0 * a1, 3.0 * (a0 + a1) - 6.0 * c
    g0, g1, g2 = max(limit - b0, 0.0), 4.0 * b0 + 2.0 * b1, -3.0 * (b0 + b1)
    # Cheap test: with feasible ends, alpha - T (limit - beta) is positive somewhere only at an inner vertex.
    r0, r1, r2 = a0 - duration * g0, p1 - duration * g1, p2 - duration * g2
    if r2 >= 0.0 or r1 <= 0.0 or r1 >= -2.0 * r2 or r1 * r1 <= 4.0 * r0 * r2:
        return duration
    # Stationary points of the ratio: qa u^2 + 2 qb u + qc = 0.
    qa, qb, qc = p2 * g1 - p1 * g2, p2 * g0 - a0 * g2, p1 * g0 - a0 * g1
    discriminant = qb * qb - qa * qc
    if discriminant < 0.0:
        return duration
    q = -(qb + math.copysign(math.sqrt(discriminant), qb))
    for u in (q / qa, qc / q):
        if 0.0 < u <= reach:
            denominator = g0 + u * (g1 + u * g2)
            if denominator > 0.0:
                duration = max(duration, (a0 + u * (p1 + u * p2)) / denominator)
    return duration


@njit(cache=True, nogil=True, error_model="numpy")
def _end_bound(duration, h, a0, a1, c, b0, b1, velocity, acceleration):
    """The shortest duration, not below the given one, that keeps both limits at u = 0 from there on."""
    a, b = (6.0 * c - 4.0 * a0 - 2.0 * a1) / h, (-4.0 * b0 - 2.0 * b1) / h
    spare = velocity - abs(b0)
    slow = spare > 0.0 and abs(a0) <= duration * spare
    if (
        slow
        and abs(a + duration * b) <= acceleration * duration**2
        and abs(b) <= 2.0 * acceleration * duration
    ):
        return duration
    for sign in (1.0, -1.0):
        duration = _acceleration_bound(duration, sign * a, sign * b, acceleration)
        duration = _end_velocity_bound(
            duration, sign * a0, sign * a1, sign * c, sign * b0, sign * b1, velocity
        )
    return duration


@njit(cache=True, nogil=True, error_model="numpy")
def _inner_bound(duration, a0, a1, c, b0, b1, velocity, reach):
    """The shortest duration, not below the given one, that keeps the velocity limit inside a segment."""
    # The middle control point of the Bernstein form and the two feasible ends together bound the velocity.
    if abs(3.0 * c - a0 - a1 - duration * (b0 + b1)) <= duration * velocity:
        return duration
    for sign in (1.0, -1.0):
        duration = _inner_velocity_bound(
            duration, sign * a0, sign * a1, sign * c, sign * b0, sign * b1, velocity, reach
        )
    return duration


@njit(cache=True, nogil=True, error_model="numpy")
def _minimal_duration(knots, keys, start, end, alpha, beta, velocity, acceleration):
    last, dof = keys.shape[0] - 2, keys.shape[1]
    for j in range(dof):
        if max(abs(start[j]), abs(end[j])) > velocity[j] * (1.0 + BOUNDARY_TOLERANCE):
            return np.inf
    duration = MINIMUM_DURATION
    for i in range(last + 1):
        h = knots[i + 1] - knots[i]
        for j in range(dof):
            a0, a1, b0, b1 = alpha[i, j], alpha[i + 1, j], beta[i, j], beta[i + 1, j]
            c = (keys[i + 1, j] - keys[i, j]) / h
            duration = _end_bound(duration, h, a0, a1, c, b0, b1, velocity[j], acceleration[j])
            if i == last:
                duration = _end_bound(duration, h, a1, a0, c, b1, b0, velocity[j], acceleration[j])
    # A second pass: the tests for the inside of a segment need its two ends to be feasible. Near an end on
    # the limit alpha and limit - beta both vanish, so u counts from that end. A lone segment is searched from
    # both, overlapping, lest round-off drops a maximum in the middle.
    reach = 0.75 if last == 0 else 1.0
    for i in range(last + 1):
        h = knots[i + 1] - knots[i]
        for j in range(dof):
            a0, a1, b0, b1 = alpha[i, j], alpha[i + 1, j], beta[i, j], beta[i + 1, j]
            c = (keys[i + 1, j] - keys[i, j]) / h
            if i < last or last == 0:
                duration = _inner_bound(duration, a0, a1, c, b0, b1, velocity[j], reach)
            if i == last:
                duration = _inner_bound(duration, a1, a0, c, b1, b0, velocity[j], reach)
    return duration


@njit(cache=True, nogil=True, error_model="numpy")
def durations_kernel(knots, knot_slopes, keys, start, end, velocity, acceleration):
    """Minimal durations (B,) of key positions (B, N + 2, n)."""
    batch, size, dof = keys.shape
    duration = np.empty(batch)
    alpha, beta = np.empty((size, dof)), np.empty((size, dof))
    for b in range(batch):
        slopes_at_knots(knot_slopes, keys[b], start[b], end[b], alpha, beta)
        duration[b] = _minimal_duration(knots, keys[b], start[b], end[b], alpha, beta, velocity, acceleration)
    return duration


@njit(cache=True, nogil=True, error_model="numpy")
def _cubic_segments(knots, keys, slopes, cubic):
    """Coefficients (N + 1, 4, n) in u of every segment."""
    for i in range(cubic.shape[0]):
        h = knots[i + 1] - knots[i]
        for j in range(cubic.shape[2]):
            step = keys[i + 1, j] - keys[i, j]
            left, right = h * slopes[i, j], h * slopes[i + 1, j]
            cubic[i, 0, j] = keys[i, j]
            cubic[i, 1, j] = left
            cubic[i, 2, j] = 3.0 * step - 2.0 * left - right
            cubic[i, 3, j] = left + right - 2.0 * step


@njit(cache=True, nogil=True, error_model="numpy")
def synthesis_kernel(knots, knot_slopes, keys, start, end, velocity, acceleration, segment, u, derivatives):
    """Minimal durations (B,), slopes q'(s_i) (B, N + 2, n) and samples (3, B, K, n) of q, q̇ and q̈.

    Without derivatives the samples are (1, B, K, n) of q alone.
    """
    batch, size, dof = keys.shape
    duration, slopes = np.empty(batch), np.empty((batch, size, dof))
    # One block: the allocator hands separate large ones back to the system, and the page faults then cost
    # more than all the arithmetic.
    out = np.empty((3 if derivatives else 1, batch, u.size, dof))
    alpha, beta, cubic = np.empty((size, dof)), np.empty((size, dof)), np.empty((size - 1, 4, dof))
    for b in range(batch):
        slopes_at_knots(knot_slopes, keys[b], start[b], end[b], alpha, beta)
        duration[b] = _minimal_duration(knots, keys[b], start[b], end[b], alpha, beta, velocity, acceleration)
        if duration[b] == np.inf:
            out[:, b] = 0.0
            out[0, b] = keys[b, 0]
            slopes[b] = 0.0
            continue
        for i in range(size):
            for j in range(dof):
                slopes[b, i, j] = alpha[i, j] + duration[b] * beta[i, j]
        _cubic_segments(knots, keys[b], slopes[b], cubic)
        for k in range(u.size):
            i, x = segment[k], u[k]
            rate = 1.0 / ((knots[i + 1] - knots[i]) * duration[b])
            for j in range(dof):
                c1, c2, c3 = cubic[i, 1, j], cubic[i, 2, j], cubic[i, 3, j]
                out[0, b, k, j] = cubic[i, 0, j] + x * (c1 + x * (c2 + x * c3))
                if derivatives:
                    out[1, b, k, j] = rate * (c1 + x * (2.0 * c2 + x * 3.0 * c3))
                    out[2, b, k, j] = rate * rate * (2.0 * c2 + x * 6.0 * c3)
    return duration, slopes, out
