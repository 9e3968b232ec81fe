"""Cost terms on batches of trajectories (4.5.2), and the plain problem of VP-STO for any number of joints.

A term is ranked by its cost; a constraint also says which candidates are valid. Rows of a batch whose
duration is infinite (a boundary velocity beyond its limit) have an infinite cost and are invalid.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from numba import njit

from vpsto_ros.configuration import option, validate
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.optimization.vpsto import Evaluation
from vpsto_ros.priors.smoothness import GaussianPrior, smoothness_prior
from vpsto_ros.trajectory import (
    Limits,
    OptimalBasis,
    Trajectory,
    TrajectoryBatch,
    minimal_duration,
    synthesize,
    synthesize_batch,
)

CollisionCheck = Callable[[np.ndarray], np.ndarray]
Term = Callable[[TrajectoryBatch], tuple[np.ndarray, np.ndarray]]


def duration_cost(batch: TrajectoryBatch) -> np.ndarray:
    """Movement durations [s], shape (B,)."""
    return batch.duration


def smoothness_cost(
    basis: OptimalBasis,
    batch: TrajectoryBatch,
    start_velocity: np.ndarray,
    end_velocity: np.ndarray,
    weights: np.ndarray | None = None,
) -> np.ndarray:
    """J_s of eq. (4.7), 1/2 int q''(s)^T R q''(s) ds over phase, exact; shape (B,).

    Args:
        basis: the basis the batch was made with.
        batch: trajectories.
        start_velocity: shape (n,), per second.
        end_velocity: shape (n,), per second.
        weights: diagonal of R, shape (n,); ones by default.
    """
    keys = batch.key_positions
    slopes = np.stack([start_velocity, end_velocity]) * _finite_duration(batch)[:, None, None]
    # The effort does not depend on where the origin is; relative to the start it is free of cancellation.
    w = np.concatenate([keys - keys[:, :1], slopes], axis=1)
    per_dof = (w * (basis.gramian() @ w)).sum(axis=1)
    return 0.5 * (per_dof.sum(axis=1) if weights is None else per_dof @ weights)


def joint_limit_cost(
    basis: OptimalBasis,
    batch: TrajectoryBatch,
    start_velocity: np.ndarray,
    end_velocity: np.ndarray,
    limits: Limits,
) -> tuple[np.ndarray, np.ndarray]:
    """Eq. (4.16) at the exact extrema of every joint: 1 + excess for every limit that is exceeded, summed.

    Deviations: the thesis accumulates over evaluation points; and a joint exactly on its limit counts as
    valid, as it does for :meth:`vpsto_ros.trajectory.Trajectory.violations`.

    Returns:
        Cost (B,) and validity (B,).
    """
    cost = np.zeros(len(batch.duration))
    if limits.lower is None and limits.upper is None:
        return cost, np.ones(len(cost), dtype=bool)
    lowest, highest = position_extrema(basis, batch, start_velocity, end_velocity)
    if limits.lower is not None:
        cost += np.where(lowest < limits.lower, 1.0 + limits.lower - lowest, 0.0).sum(axis=1)
    if limits.upper is not None:
        cost += np.where(highest > limits.upper, 1.0 + highest - limits.upper, 0.0).sum(axis=1)
    return cost, cost == 0.0


def collision_cost(batch: TrajectoryBatch, in_collision: CollisionCheck) -> tuple[np.ndarray, np.ndarray]:
    """Number of evaluation points in collision.

    Args:
        batch: trajectories.
        in_collision: maps positions (B, K, n) to collisions (B, K) of bool.

    Returns:
        Cost (B,) and validity (B,).

    Raises:
        InvalidInputError: the check returned another shape.
    """
    hit = np.asarray(in_collision(batch.position))
    if hit.shape != batch.position.shape[:2] or hit.dtype != bool:
        raise InvalidInputError(
            f"the collision check must return bool of shape {batch.position.shape[:2]}, "
            f"got {hit.dtype} of shape {hit.shape}"
        )
    count = hit.sum(axis=1)
    return count.astype(float), count == 0


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


def position_extrema(
    basis: OptimalBasis, batch: TrajectoryBatch, start_velocity: np.ndarray, end_velocity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Exact lowest and highest position of every degree of freedom over the whole motion, shapes (B, n)."""
    keys = batch.key_positions
    slopes = np.stack([start_velocity, end_velocity]) * _finite_duration(batch)[:, None, None]
    knot_slopes = basis.knot_slopes @ np.concatenate([keys - keys[:, :1], slopes], axis=1)
    return _extrema_kernel(basis.knots, keys, knot_slopes)


@dataclasses.dataclass(frozen=True)
class CostWeights:
    """Weights of the terms of :class:`JointSpaceProblem`. A violated constraint must outweigh any duration.

    Raises:
        ConfigurationError: a value is out of range.
    """

    duration: float = option(1.0, "weight of the movement duration", unit="1/s", minimum=0.0)
    smoothness: float = option(0.001, "weight of the smoothness term", minimum=0.0)
    joint_limits: float = option(100.0, "weight of a joint limit exceeded", minimum=0.0)
    collision: float = option(100.0, "weight of every evaluation point in collision", minimum=0.0)

    def __post_init__(self) -> None:
        validate(self)


@dataclasses.dataclass(frozen=True, eq=False)
class JointSpaceProblem:
    """Move from a state to a goal fast, smoothly, within joint limits and without collision (4.3).

    Two degrees of freedom around a disc of radius 0.3:

    >>> import numpy as np
    >>> from vpsto_ros.optimization.costs import JointSpaceProblem
    >>> from vpsto_ros.optimization.vpsto import VpstoConfig, search
    >>> from vpsto_ros.trajectory import Limits, OptimalBasis
    >>> limits = Limits(velocity=np.full(2, 1.0), acceleration=np.full(2, 2.0))
    >>> problem = JointSpaceProblem(
    ...     OptimalBasis.uniform(3),
    ...     limits,
    ...     start=np.zeros(2),
    ...     goal=np.array([1.0, 0.0]),
    ...     collision=lambda q: np.hypot(q[..., 0] - 0.5, q[..., 1]) < 0.32,
    ... )
    >>> prior, rng = problem.prior(spread=0.3), np.random.default_rng(0)
    >>> result = search(prior, problem.evaluate, VpstoConfig(iterations=15), rng)
    >>> result.valid
    True
    >>> trajectory = problem.trajectory(result.points)
    >>> trajectory.violations(limits)
    []
    >>> path = trajectory(np.linspace(0.0, trajectory.duration, 500))
    >>> bool(np.hypot(path[:, 0] - 0.5, path[:, 1]).min() > 0.3)
    True

    Attributes:
        basis: optimal basis with N via-points.
        limits: velocity and acceleration limits, and position limits if there are any, of n joints.
        start: start position, shape (n,).
        goal: final position, shape (n,), or None if it is part of the search.
        start_velocity: shape (n,), zero by default.
        end_velocity: shape (n,), zero by default.
        collision: maps positions (B, K, n) to collisions (B, K) of bool; None for free space. It sees only
            the evaluation points, so obstacles need a margin of half the distance between two of them.
        terms: further costs, each mapping a batch to cost (B,) and validity (B,); their weights are 1.
        weights: of the other terms.
        samples: evaluation points K.

    Raises:
        InvalidInputError: a shape does not fit.
    """

    basis: OptimalBasis
    limits: Limits
    start: np.ndarray
    goal: np.ndarray | None
    start_velocity: np.ndarray = None  # type: ignore[assignment]
    end_velocity: np.ndarray = None  # type: ignore[assignment]
    collision: CollisionCheck | None = None
    terms: tuple[Term, ...] = ()
    weights: CostWeights = dataclasses.field(default_factory=CostWeights)
    samples: int = 50

    def __post_init__(self) -> None:
        n = self.limits.dof
        for name in ("start", "goal", "start_velocity", "end_velocity"):
            value = getattr(self, name)
            if value is None and name == "goal":
                continue
            array = np.zeros(n) if value is None else np.array(value, dtype=float)
            if array.shape != (n,) or not np.isfinite(array).all():
                raise InvalidInputError(f"{name} must be finite with shape ({n},), got {value!r}")
            object.__setattr__(self, name, array)

    @property
    def n_points(self) -> int:
        """Number P of points that are searched: the via-points, and the final position if it is free."""
        return self.basis.n_via + (self.goal is None)

    def prior(self, *, spread: float | None = None, weights: np.ndarray | None = None) -> GaussianPrior:
        """Smoothness prior, with the duration of the direct motion as the guess it needs.

        Args:
            spread: mean standard deviation of the points' coordinates; see :func:`smoothness_prior`.
            weights: diagonal of R, shape (n,).
        """
        end = self.start if self.goal is None else self.goal
        ends = np.stack([self.start, end])
        guess = minimal_duration(
            OptimalBasis.uniform(0), ends, self.start_velocity, self.end_velocity, self.limits
        )
        duration = (
            float(guess) if np.isfinite(guess) else 1.0
        )  # nothing will be valid then, but the prior exists
        return smoothness_prior(
            self.basis,
            self.start,
            self.start_velocity,
            self.goal,
            self.end_velocity,
            duration,
            weights=weights,
            spread=spread,
        )

    def key_positions(self, points: np.ndarray) -> np.ndarray:
        """Points (B, P, n) between start and goal, shape (B, N + 2, n)."""
        expected = (self.n_points, self.limits.dof)
        if points.ndim != 3 or points.shape[1:] != expected:
            raise InvalidInputError(
                f"expected points of shape (B, {expected[0]}, {expected[1]}), got {points.shape}"
            )
        keys = np.empty((len(points), self.basis.n_via + 2, self.limits.dof))
        keys[:, 0] = self.start
        keys[:, 1 : 1 + self.n_points] = points
        if self.goal is not None:
            keys[:, -1] = self.goal
        return keys

    def evaluate(self, points: np.ndarray) -> Evaluation:
        """Costs of candidates (B, P, n), for :func:`vpsto_ros.optimization.vpsto.search`."""
        weights, bounds = self.weights, (self.start_velocity, self.end_velocity)
        batch = synthesize_batch(
            self.basis,
            self.key_positions(points),
            *bounds,
            self.limits,
            self.samples,
            derivatives=bool(self.terms),
        )
        valid = np.isfinite(batch.duration)
        cost = weights.duration * duration_cost(batch)
        if weights.smoothness:
            cost = cost + weights.smoothness * smoothness_cost(self.basis, batch, *bounds)
        constraints = [(weights.joint_limits, joint_limit_cost(self.basis, batch, *bounds, self.limits))]
        if self.collision is not None:
            constraints.append((weights.collision, collision_cost(batch, self.collision)))
        constraints += [(1.0, term(batch)) for term in self.terms]
        for weight, (extra, holds) in constraints:
            cost = cost + weight * extra
            valid = valid & holds
        return Evaluation(cost, valid)

    def trajectory(self, points: np.ndarray, *, start_time: float = 0.0) -> Trajectory:
        """The timed trajectory of one candidate (P, n).

        Raises:
            InfeasibleError: a boundary velocity is beyond its limit.
        """
        keys = self.key_positions(points[None])[0]
        return synthesize(
            self.basis, keys, self.start_velocity, self.end_velocity, self.limits, start_time=start_time
        )


def _finite_duration(batch: TrajectoryBatch) -> np.ndarray:
    return np.where(np.isfinite(batch.duration), batch.duration, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _extrema_kernel(knots, keys, slopes):
    """Lowest and highest value (B, n) of cubic Hermite segments through keys with slopes (B, N + 2, n)."""
    batch, size, dof = keys.shape
    lowest, highest = keys[:, 0].copy(), keys[:, 0].copy()
    for b in range(batch):
        for i in range(size - 1):
            h = knots[i + 1] - knots[i]
            for j in range(dof):
                q, step = keys[b, i, j], keys[b, i + 1, j] - keys[b, i, j]
                c1, right = h * slopes[b, i, j], h * slopes[b, i + 1, j]
                c2, c3 = 3.0 * step - 2.0 * c1 - right, c1 + right - 2.0 * step
                lowest[b, j] = min(lowest[b, j], q + step)
                highest[b, j] = max(highest[b, j], q + step)
                # Roots of the slope c1 + 2 c2 u + 3 c3 u^2; division by zero fails the test below.
                discriminant = c2 * c2 - 3.0 * c1 * c3
                if discriminant < 0.0:
                    continue
                half = -(c2 + np.copysign(np.sqrt(discriminant), c2))
                for u in (half / (3.0 * c3), c1 / half):
                    if 0.0 < u < 1.0:
                        value = q + u * (c1 + u * (c2 + u * c3))
                        lowest[b, j] = min(lowest[b, j], value)
                        highest[b, j] = max(highest[b, j], value)
    return lowest, highest
