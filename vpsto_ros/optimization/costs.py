"""The plain problem of VP-STO for any number of joints, and the cost terms it is made of (4.3).

Rows of a batch whose
duration is infinite (a boundary velocity beyond its limit) have an infinite cost and are invalid.
"""

import dataclasses

import numpy as np

from vpsto_ros.configuration import option, validate
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.optimization.terms import (
    CollisionCheck,
    Term,
    collision_cost,
    duration_cost,
    joint_limit_cost,
    position_extrema,
    pushing_progress_cost,
    smoothness_cost,
)
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

__all__ = [
    "CollisionCheck",
    "CostWeights",
    "JointSpaceProblem",
    "Term",
    "collision_cost",
    "duration_cost",
    "joint_limit_cost",
    "position_extrema",
    "pushing_progress_cost",
    "smoothness_cost",
]


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
        batch = synthesize_batch(
            self.basis,
            self.key_positions(points),
            self.start_velocity,
            self.end_velocity,
            self.limits,
            self.samples,
            derivatives=bool(self.terms),
        )
        return self.assess(batch)

    def assess(self, batch: TrajectoryBatch) -> Evaluation:
        """Costs of trajectories that are there already, also of ones that no candidate stands for."""
        weights = self.weights
        valid = np.isfinite(batch.duration)
        cost = weights.duration * duration_cost(batch)
        if weights.smoothness:
            cost = cost + weights.smoothness * smoothness_cost(batch)
        constraints = [(weights.joint_limits, joint_limit_cost(batch, self.limits))]
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
