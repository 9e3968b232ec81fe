"""Cost terms on batches of trajectories (4.5.2).

A term is ranked by its cost; a constraint also says which candidates are valid.
"""

from collections.abc import Callable

import numpy as np
from numba import njit

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory import Limits, TrajectoryBatch

CollisionCheck = Callable[[np.ndarray], np.ndarray]
Term = Callable[[TrajectoryBatch], tuple[np.ndarray, np.ndarray]]


def duration_cost(batch: TrajectoryBatch) -> np.ndarray:
    """Movement durations [s], shape (B,)."""
    return batch.duration


def smoothness_cost(batch: TrajectoryBatch, weights: np.ndarray | None = None) -> np.ndarray:
    """J_s of eq. (4.7), 1/2 int q''(s)^T R q''(s) ds over phase, exact; shape (B,).

    Args:
        batch: trajectories.
        weights: diagonal of R, shape (n,); ones by default.
    """
    dof = batch.key_positions.shape[2]
    diagonal = np.ones(dof) if weights is None else np.asarray(weights, dtype=float)
    if diagonal.shape != (dof,):
        raise InvalidInputError(f"weights must have shape ({dof},), got {diagonal.shape}")
    return smoothness_kernel(batch.knots, batch.key_positions, batch.knot_slopes, diagonal)


def joint_limit_cost(batch: TrajectoryBatch, limits: Limits) -> tuple[np.ndarray, np.ndarray]:
    """Eq. (4.16) at the exact extrema of every joint: 1 + excess for every limit that is exceeded, summed.

    Deviations: the thesis accumulates over evaluation points; and a joint exactly on its limit counts as
    valid, as it does for :meth:`vpsto_ros.trajectory.Trajectory.violations`.

    Returns:
        Cost (B,) and validity (B,).
    """
    cost = np.zeros(len(batch.duration))
    if limits.lower is not None or limits.upper is not None:
        joint_limit_kernel(batch.knots, batch.key_positions, batch.knot_slopes, *limits.position_range, cost)
    return cost, cost == 0.0


MOST_POINTS = 5000
"""Points of a motion that are looked at; one that is too long for them counts as in collision at a point."""


def collision_cost(
    batch: TrajectoryBatch, check: CollisionCheck, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Time in collision [s], judged at points at most `step` apart in every degree of freedom.

    Deviation: the thesis counts a fixed number of evaluation points. Then a search finds motions that take a
    detour elsewhere, which leaves few points for the obstacle, and jump through it between two of them.
    Here a longer motion has more points, so that an obstacle with a margin of half a step is never missed.

    Args:
        batch: trajectories.
        check: maps positions (B, K, n) to collisions (B, K) of bool.
        step: largest distance between two points, in the unit of the joints, positive.

    Returns:
        Cost (B,) and validity (B,).

    Raises:
        InvalidInputError: the check returned another shape, or the step is not positive.
    """
    if not (np.isfinite(step) and step > 0.0):
        raise InvalidInputError(f"the step between evaluation points must be positive, got {step!r}")
    share = in_collision(batch.position, check).mean(axis=1)
    needed = np.ceil(batch.largest_slope() / step) + 1.0
    longer = np.flatnonzero((needed > batch.position.shape[1]) & np.isfinite(batch.duration))
    for rows in np.array_split(longer[np.argsort(needed[longer])], 1 + longer.size // 8):
        if rows.size:
            count = int(min(needed[rows].max(), MOST_POINTS))
            positions = batch.positions_at(np.linspace(0.0, 1.0, count), rows)
            share[rows] = in_collision(positions, check).mean(axis=1)
    share[needed > MOST_POINTS] = np.maximum(share[needed > MOST_POINTS], 1.0 / MOST_POINTS)
    finite = np.where(np.isfinite(batch.duration), batch.duration, 0.0)
    return share * finite, share == 0.0


def in_collision(positions: np.ndarray, check: CollisionCheck) -> np.ndarray:
    """What the check says of positions (B, K, n): collisions (B, K) of bool.

    Raises:
        InvalidInputError: the check returned something else.
    """
    hit = np.asarray(check(positions))
    if hit.shape != positions.shape[:2] or hit.dtype != bool:
        raise InvalidInputError(
            f"the collision check must return bool of shape {positions.shape[:2]}, "
            f"got {hit.dtype} of shape {hit.shape}"
        )
    return hit


def pushing_progress_cost(
    start: np.ndarray, end: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """exp(e_T - e_0) with e the squared distance of the object to its target; valid where e_T < e_0 (4.5.2).

    Args:
        start: object position before the motion, shape (2,) or (B, 2) [m].
        end: predicted position after it, shape (B, 2) [m].
        target: desired position, shape (2,) [m].

    Returns:
        Cost (B,) and validity (B,).
    """
    before = np.square(start - target).sum(axis=-1)
    after = np.square(end - target).sum(axis=-1)
    return np.exp(after - before), after < before


def position_extrema(batch: TrajectoryBatch) -> tuple[np.ndarray, np.ndarray]:
    """Exact lowest and highest position of every degree of freedom over the whole motion, shapes (B, n)."""
    return extrema_kernel(batch.knots, batch.key_positions, batch.knot_slopes)


@njit(cache=True, nogil=True, error_model="numpy")
def _segment_extrema(q, step, left, right):
    """Lowest and highest value after the start of a cubic from q to q + step with slopes left, right in u."""
    c2, c3 = 3.0 * step - 2.0 * left - right, left + right - 2.0 * step
    lowest = highest = q + step
    # Roots of the slope left + 2 c2 u + 3 c3 u^2; division by zero fails the test below.
    discriminant = c2 * c2 - 3.0 * left * c3
    if discriminant >= 0.0:
        half = -(c2 + np.copysign(np.sqrt(discriminant), c2))
        for u in (half / (3.0 * c3), left / half):
            if 0.0 < u < 1.0:
                value = q + u * (left + u * (c2 + u * c3))
                lowest, highest = min(lowest, value), max(highest, value)
    return lowest, highest


@njit(cache=True, nogil=True, error_model="numpy")
def extrema_kernel(knots, keys, slopes):
    """Lowest and highest value (B, n) of cubic Hermite segments through keys with slopes (B, N + 2, n)."""
    batch, size, dof = keys.shape
    lowest, highest = keys[:, 0].copy(), keys[:, 0].copy()
    for b in range(batch):
        for i in range(size - 1):
            h = knots[i + 1] - knots[i]
            for j in range(dof):
                q, step = keys[b, i, j], keys[b, i + 1, j] - keys[b, i, j]
                low, high = _segment_extrema(q, step, h * slopes[b, i, j], h * slopes[b, i + 1, j])
                lowest[b, j], highest[b, j] = min(lowest[b, j], low), max(highest[b, j], high)
    return lowest, highest


@njit(cache=True, nogil=True, error_model="numpy")
def joint_limit_kernel(knots, keys, slopes, lower, upper, cost):
    """Add 1 + excess for every limit (n,) that a candidate exceeds to its cost (B,)."""
    lowest, highest = extrema_kernel(knots, keys, slopes)
    for b in range(cost.size):
        for j in range(lower.size):
            if lowest[b, j] < lower[j]:
                cost[b] += 1.0 + lower[j] - lowest[b, j]
            if highest[b, j] > upper[j]:
                cost[b] += 1.0 + highest[b, j] - upper[j]


@njit(cache=True, nogil=True, error_model="numpy")
def smoothness_kernel(knots, keys, slopes, weights):
    """Half the weighted effort (B,) of cubic Hermite segments through keys with slopes (B, N + 2, n)."""
    batch, size, dof = keys.shape
    effort = np.zeros(batch)
    for b in range(batch):
        for i in range(size - 1):
            h = knots[i + 1] - knots[i]
            for j in range(dof):
                step = keys[b, i + 1, j] - keys[b, i, j]
                left, right = h * slopes[b, i, j], h * slopes[b, i + 1, j]
                c2, c3 = 3.0 * step - 2.0 * left - right, left + right - 2.0 * step
                # 1/2 int (2 c2 + 6 c3 u)^2 du / h^3
                effort[b] += weights[j] * (2.0 * c2 * c2 + 6.0 * c3 * (c2 + c3)) / h**3
    return effort
