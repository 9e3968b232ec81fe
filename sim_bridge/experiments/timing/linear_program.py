"""The true optimum of a time-optimal move between two states of rest, as an oracle for the search.

With given phases and both ends at rest the velocity is alpha / T and the acceleration A / T^2, with alpha and
A linear in the via-points. For a given T all limits are therefore linear, and a longer T only widens
them: the feasible durations are an interval, whose lower end a bisection over linear programs finds. (With
boundary velocities this would not hold. Nor does the optimum fall with every further via-point: uniform
phases of N + 1 via-points do not contain those of N.) The degrees of freedom share nothing but T, so the
slowest one alone decides.
"""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory import MINIMUM_DURATION, Limits, OptimalBasis

_CUT_TOLERANCE = 1e-10
_GRID_PER_SEGMENT = 4
_MOST_ROUNDS = 50


@dataclasses.dataclass(frozen=True, eq=False)
class LinearProgramOptimum:
    """Shortest duration over all via-points.

    Attributes:
        duration: of the slowest degree of freedom [s].
        durations: (n,) of every one alone [s].
        via_points: (N, n) with which each is that fast.
    """

    duration: float
    durations: NDArray[np.float64]
    via_points: NDArray[np.float64]


def optimal_duration(
    basis: OptimalBasis, start: ArrayLike, goal: ArrayLike, limits: Limits, *, tolerance: float = 1e-7
) -> LinearProgramOptimum:
    """The optimum from rest to rest with the phases of a basis.

    Args:
        basis: N via-points, at least one.
        start: (n,) position [rad or m].
        goal: (n,) position.
        limits: finite velocity and acceleration limits; position limits play no part.
        tolerance: relative error of the duration.

    Raises:
        InvalidInputError: if shapes do not fit, a limit is infinite or there is no via-point.
    """
    first, last = np.asarray(start, dtype=np.float64), np.asarray(goal, dtype=np.float64)
    for name, end in (("start", first), ("goal", last)):
        if end.shape != (limits.dof,) or not np.isfinite(end).all():
            raise InvalidInputError(f"{name} must be finite with shape ({limits.dof},), got {end}")
    if not (np.isfinite(limits.velocity).all() and np.isfinite(limits.acceleration).all()):
        raise InvalidInputError("the linear program needs finite limits")
    if basis.n_via < 1:
        raise InvalidInputError("without via-points there is nothing to optimise")
    if not 1e-9 <= tolerance < 1.0:
        raise InvalidInputError(f"tolerance must be from 1e-9 to below 1, got {tolerance}")
    durations, columns = np.full(limits.dof, MINIMUM_DURATION), np.tile(first, (basis.n_via, 1))
    for j, step in enumerate(last - first):
        if step != 0.0:
            program = _Program(basis, abs(step), limits.velocity[j], limits.acceleration[j])
            durations[j], points = program.shortest(tolerance)
            columns[:, j] += np.sign(step) * points
    return LinearProgramOptimum(float(durations.max()), durations, columns)


class _Program:
    """One degree of freedom that moves from 0 to a positive distance."""

    def __init__(self, basis: OptimalBasis, distance: float, velocity: float, acceleration: float) -> None:
        self._basis, self._distance = basis, distance
        self._velocity, self._acceleration = velocity, acceleration
        self._curvatures = basis.knot_curvatures[:, 1:-2]
        spacing = np.linspace(0.0, 1.0, _GRID_PER_SEGMENT, endpoint=False)
        self._phases = np.ravel(basis.knots[:-1, None] + np.diff(basis.knots)[:, None] * spacing)
        self._slopes = basis(self._phases, 1)[:, 1:-2]

    def shortest(self, tolerance: float) -> tuple[float, NDArray]:
        """Duration [s], feasible and at most `tolerance` too long, and via-points (N,)."""
        low, high, best = 0.0, np.inf, np.empty(0)
        duration = self._distance / self._velocity + self._distance**0.5 / self._acceleration**0.5
        while not best.size or high - low > tolerance * high:
            ratio, points = self.least_ratio(duration)
            # Limits exceeded by this ratio hold at one of the two durations and fail at the other.
            low = max(low, duration * min(ratio, ratio**0.5))
            reached = duration * max(ratio, ratio**0.5)
            if reached < high:
                high, best = reached, points
            duration = 0.5 * (low + high)
        return high, best

    def least_ratio(self, duration: float) -> tuple[float, NDArray]:
        """The least factor on the limits with which this duration is feasible, and its via-points (N,).

        Velocity rows stand for phases; wherever the solution exceeds the limit between them, its vertex
        becomes a row, until nothing is exceeded.
        """
        scales = self._velocity * duration, self._acceleration * duration**2
        for _ in range(_MOST_ROUNDS):
            rows = np.vstack([self._slopes / scales[0], self._curvatures / scales[1]])
            free, goal = rows[:, :-1], self._distance * rows[:, -1]
            points, ratio = _least_bound(np.vstack([free, -free]), np.concatenate([goal, -goal]))
            phases, slopes = self._vertices(points)
            beyond = np.abs(slopes) > ratio * scales[0] * (1.0 + _CUT_TOLERANCE)
            if not beyond.any():
                break
            self._slopes = np.vstack([self._slopes, self._basis(phases[beyond], 1)[:, 1:-2]])
        return ratio, points

    def _vertices(self, points: NDArray) -> tuple[NDArray, NDArray]:
        """Phases where the slope is extreme inside the segments, and the slopes there."""
        keys = np.concatenate([[0.0], points, [self._distance]])
        bends = self._basis.knot_curvatures[:, :-2] @ keys
        left, right = bends[:-1], bends[1:]
        inside = left * right < 0.0
        u = left[inside] / (left[inside] - right[inside])
        phases = self._basis.knots[:-1][inside] + u * np.diff(self._basis.knots)[inside]
        return phases, self._basis(phases, 1)[:, :-2] @ keys


def _least_bound(rows: NDArray, offsets: NDArray) -> tuple[NDArray, float]:
    """Points x and the least r with rows @ x + offsets <= r."""
    from scipy.optimize import linprog

    size = rows.shape[1]
    for tolerance in (1e-10, 1e-9, 1e-7):  # HiGHS gives up on some programs when asked for the utmost
        solution = linprog(
            np.append(np.zeros(size), 1.0),
            A_ub=np.hstack([rows, -np.ones((len(rows), 1))]),
            b_ub=-offsets,
            bounds=[(None, None)] * size + [(0.0, None)],
            options={"primal_feasibility_tolerance": tolerance, "dual_feasibility_tolerance": tolerance},
        )
        if solution.success:
            return solution.x[:-1], float(solution.x[-1])
    raise RuntimeError(f"the linear program failed: {solution.message}")
