"""Compiled kernels of the minimal duration and of the batch synthesis; see :mod:`vpsto_ros.trajectory.timing`.

Notation on one segment of phase length h, with local coordinate u in [0, 1]: a velocity profile that runs from slope
a0 to slope a1 with mean (chord) c is the quadratic a0 + (6c - 4a0 - 2a1) u + (3a0 + 3a1 - 6c) u^2.
"""

import math

import numpy as np
from numba import njit

MINIMUM_DURATION = 1e-3
"""Duration [s] of a trajectory that does not move."""

BOUNDARY_TOLERANCE = 1e-9
"""Relative excess of a boundary velocity over its limit that still counts as being on the limit."""


@njit(cache=True, nogil=True, error_model="numpy")
def _slopes(knot_slopes, keys, start, end, alpha, beta):
    """Slopes at the knots: alpha from the key positions, beta from the boundary velocities per unit duration."""
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
    """Largest root of limit T^2 - b T - a, if above the duration: beyond it a / T^2 + b / T <= limit for good."""
    if limit * duration * duration - b * duration - a >= 0.0 and 2.0 * limit * duration >= b:
        return duration
    discriminant = b * b + 4.0 * limit * a
    if discriminant < 0.0:
        return duration
    root = math.sqrt(discriminant)
    largest = 0.5 * (b + root) / limit if b >= 0.0 else 2.0 * a / (root - b)
    return max(duration, largest)


@njit(cache=True, nogil=True, error_model="numpy")
def _ratio_bound(duration, a0, a1, chord, b0, b1, limit, reach):
    """Raise the duration to the interior maximum of alpha(u) / (limit - beta(u)) on 0 < u <= reach, if it is larger.

    Both ends of the segment must already be feasible at this duration.
    """
    p1, p2 = 6.0 * chord - 4.0 * a0 - 2.0 * a1, 3.0 * (a0 + a1) - 6.0 * chord
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
def _end_bound(duration, a0, a1, chord, b0, b1, limit):
    """Feasibility at u = 0, where a0 = 0 at the very start and end: 0/0 there when the velocity is on the limit."""
    gap = limit - b0
    if gap > 0.0:
        return max(duration, a0 / gap)
    rise, fall = 6.0 * chord - 4.0 * a0 - 2.0 * a1, 4.0 * b0 + 2.0 * b1
    return max(duration, rise / fall)


@njit(cache=True, nogil=True, error_model="numpy")
def _minimal_duration(knots, keys, start, end, alpha, beta, velocity, acceleration):
    last, dof = keys.shape[0] - 1, keys.shape[1]
    for j in range(dof):
        if max(abs(start[j]), abs(end[j])) > velocity[j] * (1.0 + BOUNDARY_TOLERANCE):
            return np.inf
    duration = MINIMUM_DURATION
    for i in range(last):
        h = knots[i + 1] - knots[i]
        for j in range(dof):
            a0, a1, b0, b1 = alpha[i, j], alpha[i + 1, j], beta[i, j], beta[i + 1, j]
            c, v, limit = (keys[i + 1, j] - keys[i, j]) / h, velocity[j], acceleration[j]
            a, b = (6.0 * c - 4.0 * a0 - 2.0 * a1) / h, (-4.0 * b0 - 2.0 * b1) / h
            duration = _acceleration_bound(duration, a, b, limit)
            duration = _acceleration_bound(duration, -a, -b, limit)
            duration = _end_bound(duration, a0, a1, c, b0, b1, v)
            duration = _end_bound(duration, -a0, -a1, -c, -b0, -b1, v)
            if i == last - 1:
                a, b = (2.0 * a0 + 4.0 * a1 - 6.0 * c) / h, (2.0 * b0 + 4.0 * b1) / h
                duration = _acceleration_bound(duration, a, b, limit)
                duration = _acceleration_bound(duration, -a, -b, limit)
                duration = _end_bound(duration, a1, a0, c, b1, b0, v)
                duration = _end_bound(duration, -a1, -a0, -c, -b1, -b0, v)
    # Only now, with all ends feasible, the cheap test inside is valid.
    for i in range(last):
        h = knots[i + 1] - knots[i]
        for j in range(dof):
            a0, a1, b0, b1 = alpha[i, j], alpha[i + 1, j], beta[i, j], beta[i + 1, j]
            c, v = (keys[i + 1, j] - keys[i, j]) / h, velocity[j]
            # Near an end on the limit numerator and denominator both vanish: count u from that end.
            if i < last - 1 or last == 1:
                reach = 0.5 if last == 1 else 1.0
                duration = _ratio_bound(duration, a0, a1, c, b0, b1, v, reach)
                duration = _ratio_bound(duration, -a0, -a1, -c, -b0, -b1, v, reach)
            if i == last - 1:
                reach = 0.5 if last == 1 else 1.0
                duration = _ratio_bound(duration, a1, a0, c, b1, b0, v, reach)
                duration = _ratio_bound(duration, -a1, -a0, -c, -b1, -b0, v, reach)
    return duration


@njit(cache=True, nogil=True, error_model="numpy")
def durations_kernel(knots, knot_slopes, keys, start, end, velocity, acceleration):
    """Minimal durations (B,) of key positions (B, N + 2, n)."""
    batch, size, dof = keys.shape
    duration = np.empty(batch)
    alpha, beta = np.empty((size, dof)), np.empty((size, dof))
    for b in range(batch):
        _slopes(knot_slopes, keys[b], start[b], end[b], alpha, beta)
        duration[b] = _minimal_duration(knots, keys[b], start[b], end[b], alpha, beta, velocity, acceleration)
    return duration


@njit(cache=True, nogil=True, error_model="numpy")
def _cubic_segments(knots, keys, alpha, beta, duration, cubic):
    """Coefficients (N + 1, 4, n) in u of every segment; a row of infinite duration stands still."""
    for i in range(cubic.shape[0]):
        h = knots[i + 1] - knots[i]
        for j in range(cubic.shape[2]):
            step = keys[i + 1, j] - keys[i, j]
            left = h * (alpha[i, j] + duration * beta[i, j])
            right = h * (alpha[i + 1, j] + duration * beta[i + 1, j])
            cubic[i, 0, j] = keys[i, j]
            cubic[i, 1, j] = left
            cubic[i, 2, j] = 3.0 * step - 2.0 * left - right
            cubic[i, 3, j] = left + right - 2.0 * step


@njit(cache=True, nogil=True, error_model="numpy")
def synthesis_kernel(knots, knot_slopes, keys, start, end, velocity, acceleration, segment, u, derivatives):
    """Minimal durations (B,) and samples (B, K, n) of position, velocity and acceleration."""
    batch, size, dof = keys.shape
    samples = u.size
    rows = batch if derivatives else 0
    duration = np.empty(batch)
    q, qd, qdd = np.empty((batch, samples, dof)), np.empty((rows, samples, dof)), np.empty((rows, samples, dof))
    alpha, beta, cubic = np.empty((size, dof)), np.empty((size, dof)), np.empty((size - 1, 4, dof))
    for b in range(batch):
        _slopes(knot_slopes, keys[b], start[b], end[b], alpha, beta)
        duration[b] = _minimal_duration(knots, keys[b], start[b], end[b], alpha, beta, velocity, acceleration)
        if duration[b] == np.inf:
            q[b] = keys[b, 0]
            if derivatives:
                qd[b] = 0.0
                qdd[b] = 0.0
            continue
        _cubic_segments(knots, keys[b], alpha, beta, duration[b], cubic)
        for k in range(samples):
            i, x = segment[k], u[k]
            for j in range(dof):
                q[b, k, j] = cubic[i, 0, j] + x * (cubic[i, 1, j] + x * (cubic[i, 2, j] + x * cubic[i, 3, j]))
            if derivatives:
                rate = 1.0 / ((knots[i + 1] - knots[i]) * duration[b])
                for j in range(dof):
                    c1, c2, c3 = cubic[i, 1, j], cubic[i, 2, j], cubic[i, 3, j]
                    qd[b, k, j] = rate * (c1 + x * (2.0 * c2 + x * 3.0 * c3))
                    qdd[b, k, j] = rate * rate * (2.0 * c2 + x * 6.0 * c3)
    return duration, q, qd, qdd
