"""The plain problem of VP-STO for any number of joints, and the cost terms it is made of (4.3).

Rows of a batch whose duration is infinite (a boundary velocity beyond its limit) have an infinite cost and
are invalid.
"""

import dataclasses
import math

import numpy as np

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import InfeasibleError, InvalidInputError
from vpsto_ros.optimization.progress import Evaluation
from vpsto_ros.optimization.terms import (
    MOST_POINTS,
    CollisionCheck,
    Term,
    collision_cost,
    duration_cost,
    in_collision,
    joint_limit_cost,
    smoothness_cost,
)
from vpsto_ros.priors.gaussian import GaussianPrior
from vpsto_ros.priors.smoothness import smoothness_prior
from vpsto_ros.trajectory import (
    MINIMUM_DURATION,
    Limits,
    OptimalBasis,
    Trajectory,
    TrajectoryBatch,
    minimal_duration,
    synthesize,
    synthesize_batch,
)

__all__ = ["CostWeights", "JointSpaceProblem"]


@documented
@dataclasses.dataclass(frozen=True)
class CostWeights:
    """Weights of the terms of :class:`JointSpaceProblem`. A violated constraint must outweigh any duration.

    Raises:
        ConfigurationError: a value is out of range.
    """

    duration: float = option(1.0, "weight of the movement duration", unit="1/s", minimum=0.0)
    smoothness: float = option(0.001, "weight of the smoothness term", minimum=0.0)
    joint_limits: float = option(100.0, "weight of a joint limit exceeded", minimum=0.0)
    collision: float = option(100.0, "weight of the time in collision", unit="1/s", minimum=0.0)

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
            points at most ``collision_step`` apart: give obstacles a margin of half of that. Terms from
            :mod:`vpsto_ros.collision` need none, they are exact at every instant.
        collision_step: largest distance between two of these points in any joint; by default as far apart as
            ``samples`` points can be on the straight motion to the goal, or, where there is none, in the
            range of the position limits.
        terms: further costs, each mapping a batch to cost (B,) and validity (B,); their weights are 1. A term
            may have a method ``explain(trajectory) -> list[str]`` that says in words what a trajectory
            collides with, and, if its obstacles move, ``static = False``.
        weights: of the other terms.
        samples: evaluation points K >= 2.
        check_ends: whether to refuse a start or goal from which, or to which, no valid motion exists: beyond
            a position limit, or in collision. A controller that has to cope with such states switches it off;
            then every candidate is invalid.

    Start and goal may be the same: standing still, for ``MINIMUM_DURATION``, is then the optimum from rest.

    Raises:
        InvalidInputError: a shape or type does not fit, a number is not finite, or ``check_ends`` found
            something: the message says which end, where, and what is wrong with it.
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
    check_ends: bool = True
    collision_step: float | None = None

    def __post_init__(self) -> None:
        _check_kind("basis", self.basis, OptimalBasis, "an OptimalBasis, such as OptimalBasis.uniform(3)")
        _check_kind("limits", self.limits, Limits, "Limits")
        if isinstance(self.samples, bool) or not isinstance(self.samples, int) or self.samples < 2:
            raise InvalidInputError(f"samples must be an integer from 2 on, got {self.samples!r}")
        object.__setattr__(self, "terms", tuple(self.terms))
        for check in (*self.terms, self.collision):
            if check is not None and not callable(check):
                raise InvalidInputError(f"collision and terms must be functions of a batch, got {check!r}")
        n = self.limits.dof
        for name in ("start", "goal", "start_velocity", "end_velocity"):
            value = getattr(self, name)
            if value is None and name == "goal":
                continue
            array = np.zeros(n) if value is None else np.array(value, dtype=float)
            if array.shape != (n,) or not np.isfinite(array).all():
                raise InvalidInputError(f"{name} must be finite with shape ({n},), got {value!r}")
            object.__setattr__(self, name, array)
        if self.collision is not None and self.collision_step is None:
            object.__setattr__(self, "collision_step", self._default_step())
        for name in ("start", "goal") if self.check_ends else ():
            wrong = [] if getattr(self, name) is None else self._end_conflicts(name)
            if wrong:
                raise InvalidInputError(f"{name} {_coordinates(getattr(self, name))}: {'; '.join(wrong)}")

    def _default_step(self) -> float:
        """See ``collision_step``; the slope of the straight motion is at most three times its chord."""
        way = 0.0 if self.goal is None else 3.0 * float(np.abs(self.goal - self.start).max())
        lower, upper = self.limits.position_range
        way = way or float(np.min(upper - lower))
        if not np.isfinite(way):
            raise InvalidInputError(
                "collision_step is needed: without a goal away from the start and without position limits "
                "nothing tells how far apart evaluation points may be"
            )
        return way / (self.samples - 1)

    def _end_conflicts(self, name: str) -> list[str]:
        """Why no valid motion can start or end where this one does."""
        position = getattr(self, name)
        standing = Trajectory.from_points(
            np.array([0.0, MINIMUM_DURATION]), np.stack([position] * 2), np.zeros((2, self.limits.dof))
        )
        wrong = standing.violations(self.limits)
        if self.collision is not None and in_collision(position[None, None], self.collision).any():
            wrong.append("in collision")
        for term in self.terms:
            # An obstacle that moves can be gone by the time the goal is reached.
            if name == "start" or getattr(_owner(term), "static", True):
                wrong += _explained(term, standing) or []
        return wrong

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
        # Without a feasible duration nothing will be valid, but the prior exists.
        duration = float(guess) if np.isfinite(guess) else 1.0
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
        return self.assess(self._synthesize(self.key_positions(points)))

    def _synthesize(self, keys: np.ndarray) -> TrajectoryBatch:
        return synthesize_batch(
            self.basis, keys, self.start_velocity, self.end_velocity, self.limits, self.samples,
            derivatives=bool(self.terms),
        )  # fmt: skip

    def assess(self, batch: TrajectoryBatch) -> Evaluation:
        """Costs of trajectories that are there already, also of ones that no candidate stands for."""
        weights = self.weights
        valid = np.isfinite(batch.duration)
        cost = weights.duration * duration_cost(batch)
        if weights.smoothness:
            cost = cost + weights.smoothness * smoothness_cost(batch)
        constraints = [(weights.joint_limits, joint_limit_cost(batch, self.limits))]
        if self.collision is not None:
            assert self.collision_step is not None
            constraints.append(
                (weights.collision, collision_cost(batch, self.collision, self.collision_step))
            )
        constraints += [(1.0, term(batch)) for term in self.terms]
        for weight, (extra, holds) in constraints:
            cost = cost + weight * extra
            valid = valid & holds
        return Evaluation(cost, valid)

    def trajectory(self, points: np.ndarray, *, start_time: float = 0.0) -> Trajectory:
        """The timed trajectory of one candidate (P, n).

        Raises:
            InvalidInputError: there are no points, as in the result of a search that found nothing valid.
            InfeasibleError: a boundary velocity is beyond its limit.
        """
        if points is None:
            raise InvalidInputError(
                "no points: the search found nothing valid; explain(result.best_any_points) says why"
            )
        keys = self.key_positions(points[None])[0]
        return synthesize(
            self.basis, keys, self.start_velocity, self.end_velocity, self.limits, start_time=start_time
        )

    def explain(self, points: np.ndarray) -> list[str]:
        """What keeps one candidate from being valid, in words; empty if it is valid.

        For the ``best_any_points`` of a search that found nothing valid, for instance.

        Args:
            points: shape (P, n).
        """
        keys = self.key_positions(points[None])
        batch = self._synthesize(keys)
        try:
            trajectory = self.trajectory(points)
        except InfeasibleError as error:
            return [str(error)]
        wrong = trajectory.violations(self.limits)
        if self.collision is not None:
            wrong += self._explain_collision(batch, trajectory)
        for term in self.terms:
            cost, valid = term(batch)
            if not valid[0]:
                name = getattr(term, "__name__", type(term).__name__)
                wrong += _explained(term, trajectory) or [f"{name} is not satisfied (cost {cost[0]:.6g})"]
        return wrong

    def _explain_collision(self, batch: TrajectoryBatch, trajectory: Trajectory) -> list[str]:
        """How long the only candidate of a batch is in collision, and where first; empty if it is not."""
        assert self.collision is not None and self.collision_step is not None
        spent, free = collision_cost(batch, self.collision, self.collision_step)
        if free[0]:
            return []
        count = max(self.samples, math.ceil(float(batch.largest_slope()[0]) / self.collision_step) + 1)
        times = np.linspace(0.0, trajectory.duration, min(count, MOST_POINTS))
        positions = trajectory(times)
        hits = np.flatnonzero(in_collision(positions[None], self.collision)[0])
        if not hits.size:
            return [f"too long to be checked for collision every {self.collision_step:.3g}"]
        where = _coordinates(positions[hits[0]])
        return [f"in collision for {spent[0]:.3g} s, first at {times[hits[0]]:.3f} s in {where}"]


def _check_kind(name: str, value: object, kind: type, expected: str) -> None:
    if not isinstance(value, kind):
        raise InvalidInputError(f"{name} must be {expected}; got {value!r}")


def _coordinates(position: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in position) + ")"


def _owner(term: Term) -> object:
    """The object whose method a term is, or the term itself."""
    return getattr(term, "__self__", term)


def _explained(term: Term, trajectory: Trajectory) -> list[str] | None:
    """What a term says of a trajectory, None if it cannot."""
    explain = getattr(_owner(term), "explain", None)
    return None if explain is None else list(explain(trajectory))
