"""One planning step of online VP-STO in joint space: what is searched, and its options (4.4)."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.optimization.costs import CostWeights, JointSpaceProblem
from vpsto_ros.optimization.progress import Evaluation
from vpsto_ros.optimization.terms import Term
from vpsto_ros.optimization.vpsto import VpstoConfig
from vpsto_ros.planning.mpc import OnlineConfig
from vpsto_ros.planning.stitching import as_batch
from vpsto_ros.priors.gaussian import GaussianPrior
from vpsto_ros.trajectory import Limits, OptimalBasis, Trajectory


@documented
@dataclasses.dataclass(frozen=True)
class JointSpaceMpcConfig:
    """Options of :class:`JointSpaceMpc`.

    Raises:
        ConfigurationError: a value is out of range.
    """

    online: OnlineConfig = dataclasses.field(
        default_factory=lambda: OnlineConfig(
            n_via=5, via_rate=1.0, stop_duration=0.5, search=VpstoConfig(population=25, iterations=10)
        )
    )
    weights: CostWeights = dataclasses.field(default_factory=CostWeights)
    samples: int = option(50, "evaluation points per candidate", minimum=2, maximum=10_000)
    spread: float = option(
        0.15, "standard deviation of via-points when exploring, in the unit of the joints", minimum=1e-9
    )
    lookahead: float = option(
        1.5, "how long a motion must be clear to be followed while no valid plan is known", unit="s",
        minimum=0.1, maximum=60.0,
    )  # fmt: skip
    escapes: int = option(
        32, "random short motions tried when going on and braking would both collide", minimum=1, maximum=1000
    )

    def __post_init__(self) -> None:
        validate(self)


class OnlineJointSpaceProblem:
    """From a state in motion to rest at a goal: an ``OnlineProblem`` for n joints.

    Search points are the via-points; a :class:`JointSpaceProblem` per number of via-points does the rest.
    """

    def __init__(
        self,
        limits: Limits,
        *,
        position: NDArray,
        velocity: NDArray,
        start_time: float,
        goal: NDArray,
        terms: tuple[Term, ...] = (),
        config: JointSpaceMpcConfig,
    ) -> None:
        """Pose the problem.

        Args:
            limits: velocity, acceleration and position limits of n joints.
            position: position when the plan takes over, shape (n,) [rad or m].
            velocity: velocity at that time, shape (n,) [1/s].
            start_time: that time [s].
            goal: where to come to rest, shape (n,).
            terms: obstacles and further costs. Moving obstacles count time from ``start_time``, as the
                trajectories of a batch do.
            config: weights, evaluation points and the width of the prior.
        """
        self.limits, self.position, self.velocity = limits, position, velocity
        self.start_time, self.goal, self.terms, self.config = start_time, goal, terms, config
        self._plain: dict[int, JointSpaceProblem] = {}

    def plain(self, n_via: int) -> JointSpaceProblem:
        """The problem of 4.3 with a given number of via-points."""
        if n_via not in self._plain:
            self._plain[n_via] = JointSpaceProblem(
                OptimalBasis.uniform(n_via), self.limits, self.position, self.goal,
                start_velocity=self.velocity, terms=self.terms,
                weights=self.config.weights, samples=self.config.samples, check_ends=False,
            )  # fmt: skip
        return self._plain[n_via]

    def evaluate(self, points: NDArray) -> Evaluation:
        """Cost and validity of candidates (B, P, n), for any P."""
        return self.plain(points.shape[1]).evaluate(points)

    def assess(self, trajectory: Trajectory) -> tuple[float, bool]:
        """Cost and validity, measured as those of the candidates, of a motion that is no candidate.

        Velocity and acceleration limits are not looked at: the motion was made to keep them.
        """
        evaluation = self.plain(0).assess(as_batch(trajectory, self.config.samples))
        return float(evaluation.cost[0]), bool(evaluation.valid[0])

    def trajectory(self, points: NDArray) -> Trajectory:
        """The timed trajectory through points (P, n), from ``start_time`` on."""
        return self.plain(len(points)).trajectory(points, start_time=self.start_time)

    def direct(self, previous: Trajectory | None) -> NDArray | None:
        """No via-points: the goal is known whatever the previous solution was (4.4.1)."""
        return np.zeros((0, self.limits.dof))

    def shifted(self, previous: Trajectory, n_via: int) -> NDArray:
        """What is left of the previous solution, resampled at even times (4.4.2)."""
        begin = min(self.start_time, previous.end_time)
        steps = np.arange(1, n_via + 1) / (n_via + 1)
        return previous(begin + (previous.end_time - begin) * steps)

    def prior(self, n_via: int) -> GaussianPrior:
        """Smoothness prior (4.3.1)."""
        return self.plain(n_via).prior(spread=self.config.spread)

    def guesses(self, n_via: int) -> NDArray:
        """The straight line (4.4.2), shape (1, N, n)."""
        steps = np.arange(1, n_via + 1)[:, None] / (n_via + 1)
        return (self.position + steps * (self.goal - self.position))[None]
