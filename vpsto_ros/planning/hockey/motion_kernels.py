"""Compiled costs of motions at the air-hockey table; see :mod:`vpsto_ros.planning.hockey.motions`."""

import numpy as np
from numba import njit

from vpsto_ros.robot.iiwa_kinematics import chain, move_to_height
from vpsto_ros.trajectory.kernels import slopes_at_knots

HEIGHT, TOLERANCE, LEAST_X, MOST_Y, CLEARANCE, ROD_TILT = range(6)  # of PlayRules.kernel_row
_ROUNDING = 1e-6  # share by which limits may be exceeded


@njit(cache=True, nogil=True)
def to_height(points, height, found):
    """Joint positions (B, P, 7) moved by the least to where the universal joint is in the plane of play."""
    arm, axes, jac = np.empty((4, 3)), np.empty((7, 3)), np.empty((3, 6))
    for b in range(points.shape[0]):
        for i in range(points.shape[1]):
            found[b, i] = points[b, i]
            move_to_height(found[b, i], height, arm, axes, jac)


@njit(cache=True, nogil=True)
def _limits_excess(h, q0, q1, v0, v1, velocity, acceleration):
    """By which share a cubic segment of duration h exceeds its limits at worst, and its effort.

    The acceleration is linear, so its ends count; the velocity is a parabola whose vertex may count too. The
    effort is the integral of the squared acceleration as a share of its limit.
    """
    mean = (q1 - q0) / h
    a0 = (6.0 * mean - 4.0 * v0 - 2.0 * v1) / h
    a1 = (2.0 * v0 + 4.0 * v1 - 6.0 * mean) / h
    fastest = max(abs(v0), abs(v1))
    if a0 * a1 < 0.0:
        part = a0 / (a0 - a1)
        fastest = max(fastest, abs(v0 + 0.5 * h * part * a0))
    share = max(fastest / velocity, max(abs(a0), abs(a1)) / acceleration)
    effort = h * (a0 * a0 + a0 * a1 + a1 * a1) / (3.0 * acceleration * acceleration)
    return max(0.0, share - 1.0), effort


@njit(cache=True, nogil=True)
def place_excess(q, rules, arm, axes):
    """How far a posture is from the places that are allowed, in metres and, for the rod, as a cosine."""
    chain(q, arm, axes)
    excess = max(0.0, abs(arm[3, 2] - rules[HEIGHT]) - rules[TOLERANCE])
    excess += max(0.0, rules[LEAST_X] - arm[3, 0]) + max(0.0, abs(arm[3, 1]) - rules[MOST_Y])
    excess += max(0.0, rules[CLEARANCE] - min(arm[1, 2], arm[2, 2]))
    return excess + max(0.0, axes[6, 2] + rules[ROD_TILT])


@njit(cache=True, nogil=True)
def assess(
    knots, knot_slopes, keys, start, end, durations, velocity, acceleration, lower, upper, rules, spacing,
    weights, cost, valid,
):  # fmt: skip
    """Costs and validity of motions through key positions; durations that are infinite make them invalid.

    Args:
        knots: phases (N + 2,).
        knot_slopes: of the basis.
        keys: (B, N + 2, 7) [rad].
        start: velocities (7,) [rad/s].
        end: likewise.
        durations: (B,) [s].
        velocity: limits (7,).
        acceleration: limits (7,).
        lower: positions (7,).
        upper: likewise.
        rules: row, see above.
        spacing: time between the instants at which places are looked at, at most [s].
        weights: of duration, effort and excess (3,).
        cost: output (B,).
        valid: output (B,).
    """
    batch, size, dof = keys.shape
    alpha, beta, slopes = np.empty((size, dof)), np.empty((size, dof)), np.empty((size, dof))
    q, arm, axes = np.empty(dof), np.empty((4, 3)), np.empty((7, 3))
    for b in range(batch):
        duration = durations[b]
        if not np.isfinite(duration):
            cost[b], valid[b] = np.inf, False
            continue
        slopes_at_knots(knot_slopes, keys[b], start, end, alpha, beta)
        effort, beyond, away = 0.0, 0.0, 0.0
        for i in range(size):
            for j in range(dof):
                slopes[i, j] = alpha[i, j] / duration + beta[i, j]
        for i in range(size - 1):
            h = duration * (knots[i + 1] - knots[i])
            for j in range(dof):
                over, spent = _limits_excess(
                    h, keys[b, i, j], keys[b, i + 1, j], slopes[i, j], slopes[i + 1, j], velocity[j],
                    acceleration[j],
                )  # fmt: skip
                beyond, effort = max(beyond, over), effort + spent
            count = max(2, int(np.ceil(h / spacing)))
            for k in range(1, count + (i == size - 2)):
                u = k / count
                w1, w2 = u * u * (3.0 - 2.0 * u), u * (1.0 - u)
                for j in range(dof):
                    q[j] = (1.0 - w1) * keys[b, i, j] + w1 * keys[b, i + 1, j]
                    q[j] += h * w2 * ((1.0 - u) * slopes[i, j] - u * slopes[i + 1, j])
                    beyond = max(beyond, lower[j] - q[j], q[j] - upper[j])
                away = max(away, place_excess(q, rules, arm, axes))
        cost[b] = weights[0] * duration + weights[1] * effort + weights[2] * (beyond + 10.0 * away)
        valid[b] = beyond <= _ROUNDING and away <= 0.0
