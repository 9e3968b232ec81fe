"""Compiled checks of whole motions: a proof that no instant collides, and a cost for the search.

While the joints move by at most delta_j from a posture, no point of a capsule's segment moves by more than
sum_j delta_j r_j, with r_j its largest distance from the axis of joint j. So a posture that is free with
radii grown by that much proves the whole interval free. What is not is halved, until the motion that is left
is within a tolerance.
"""

import numpy as np
from numba import njit

from vpsto_ros.collision.arm_distance_kernels import overlap, pair_count
from vpsto_ros.collision.arm_kernels import all_finite, place, sines, touches, workspace

_DEPTH = 40  # halvings; the tolerance ends them long before


@njit(cache=True, nogil=True, error_model="numpy")
def _expand(c, tau, half, q, delta):
    """Position at tau on a polynomial piece (6, n), and a bound (n,) of the deviation from it within half.

    The Taylor coefficients at tau, by repeated synthetic division, bound the deviation term by term.
    """
    for j in range(q.shape[0]):
        t0, t1, t2, t3, t4, t5 = c[0, j], c[1, j], c[2, j], c[3, j], c[4, j], c[5, j]
        if t4 != 0.0 or t5 != 0.0:
            t4 += tau * t5
            t3 += tau * t4
            t2 += tau * t3
            t1 += tau * t2
            t0 += tau * t1
            t4 += tau * t5
            t3 += tau * t4
            t2 += tau * t3
            t1 += tau * t2
            t4 += tau * t5
            t3 += tau * t4
            t2 += tau * t3
            t4 += tau * t5
            t3 += tau * t4
            t4 += tau * t5
        else:
            t2 += tau * t3
            t1 += tau * t2
            t0 += tau * t1
            t2 += tau * t3
            t1 += tau * t2
            t2 += tau * t3
        q[j] = t0
        rest = abs(t3) + half * (abs(t4) + half * abs(t5))
        delta[j] = half * (abs(t1) + half * (abs(t2) + half * rest))


@njit(cache=True, nogil=True, error_model="numpy")
def _grow(arm, delta, margin, reach, pair_reach):
    """Radii that cover all postures within delta (7,); returns the largest motion of a capsule [m]."""
    largest = 0.0
    for k in range(reach.shape[0]):
        motion = 0.0
        for j in range(arm.link[k]):
            motion += delta[j] * arm.swing[k, j]
        reach[k] = arm.radius[k] + margin + motion
        largest = max(largest, motion)
    for n in range(arm.pairs.shape[0]):
        k, i = arm.pairs[n, 0], arm.pairs[n, 1]
        motion = 0.0  # relative to the first capsule: joints before its link move both alike
        for j in range(arm.link[k], arm.link[i]):
            motion += delta[j] * arm.swing[i, j]
        pair_reach[n] = arm.radius[k] + arm.radius[i] + margin + motion
    return largest


@njit(cache=True, nogil=True, error_model="numpy")
def first_contact(arm, cell, coefficients, spans, margin, tolerance):
    """Where a motion may be closer than the margin: (piece, start, end of the interval); piece -1 if nowhere.

    Args:
        arm: the arm.
        cell: its surroundings; pairs that it leaves out must never be closer than the margin.
        coefficients: powers of the time since the start of each piece, shape (S, 6, 7).
        spans: lengths of the pieces, shape (S,).
        margin: distance to keep [m].
        tolerance: motion of the links below which an interval is not halved again [m].
    """
    sine, cosine, world = workspace(arm)
    q, delta = np.empty(7), np.empty(7)
    reach, pair_reach = np.empty(arm.radius.shape[0]), np.empty(arm.pairs.shape[0])
    starts, ends = np.empty(_DEPTH + 4), np.empty(_DEPTH + 4)
    for piece in range(spans.shape[0]):
        starts[0], ends[0], size = 0.0, spans[piece], 1
        while size > 0:
            size -= 1
            begin, end = starts[size], ends[size]
            middle = 0.5 * (begin + end)
            _expand(coefficients[piece], middle, 0.5 * (end - begin), q, delta)
            largest = _grow(arm, delta, margin, reach, pair_reach)
            if largest < 0.3:  # a larger motion hardly ever passes
                sines(q, sine[0], cosine[0])
                place(arm, sine[0], cosine[0], world)
                if not touches(arm, cell, world, reach, pair_reach):
                    continue
                if largest <= tolerance or size >= _DEPTH:
                    return piece, begin, end
            # The earlier half is looked at first, so that the contact found is the first one.
            starts[size], ends[size] = middle, end
            starts[size + 1], ends[size + 1] = begin, middle
            size += 2
    return -1, 0.0, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _hermite(knots, keys, slopes, coefficients, spans):
    """Cubic pieces between knots, as powers of the phase since the start of each piece."""
    for i in range(knots.shape[0] - 1):
        h = knots[i + 1] - knots[i]
        spans[i] = h
        for j in range(keys.shape[1]):
            step, left, right = (keys[i + 1, j] - keys[i, j]) / h, slopes[i, j], slopes[i + 1, j]
            coefficients[i, 0, j], coefficients[i, 1, j] = keys[i, j], left
            coefficients[i, 2, j] = (3.0 * step - 2.0 * left - right) / h
            coefficients[i, 3, j] = (left + right - 2.0 * step) / (h * h)
            coefficients[i, 4, j], coefficients[i, 5, j] = 0.0, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def batch_cost(
    arm, cell, samples, duration, knots, keys, slopes, margin, proof_margin, tolerance, depth_scale, cost
):
    """Fill the collision cost (B,) [s] of a batch; zero exactly where a motion is proven free.

    Args:
        arm: the arm.
        cell: its surroundings; pairs that it leaves out must never be closer than the margins.
        samples: positions (B, K, 7) at even phases.
        duration: shape (B,) [s].
        knots: phases between the cubics, shape (N + 2,).
        keys: positions there, shape (B, N + 2, 7).
        slopes: derivatives there with respect to phase, shape (B, N + 2, 7).
        margin: a sample that comes closer counts [m].
        proof_margin: what is proven of the motions without such a sample [m].
        tolerance: of the proof [m].
        depth_scale: overlap that counts as much as the sample itself [m].
        cost: filled with the time in collision, weighted by 1 + overlap / depth_scale; every sample stands
            for the K-th part of the duration. Infinite where the duration or a position is not finite.
    """
    count = samples.shape[1]
    pieces = knots.shape[0] - 1
    sine, cosine, world = workspace(arm)
    coefficients, spans = np.empty((pieces, 6, 7)), np.empty(pieces)
    reach, pair_reach = np.empty(arm.radius.shape[0]), np.empty(arm.pairs.shape[0])
    room = np.empty(pair_count(arm, cell))
    _grow(arm, np.zeros(7), margin, reach, pair_reach)
    for b in range(samples.shape[0]):
        cost[b] = 0.0
        if not (np.isfinite(duration[b]) and all_finite(samples[b])):
            cost[b] = np.inf
            continue
        for m in range(count):
            sines(samples[b, m], sine[0], cosine[0])
            place(arm, sine[0], cosine[0], world)
            if touches(arm, cell, world, reach, pair_reach):
                cost[b] += 1.0 + overlap(arm, cell, world, margin, room) / depth_scale
        if cost[b] == 0.0:
            _hermite(knots, keys[b], slopes[b], coefficients, spans)
            if first_contact(arm, cell, coefficients, spans, proof_margin, tolerance)[0] >= 0:
                cost[b] = 0.5
        cost[b] *= duration[b] / count
