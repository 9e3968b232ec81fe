"""Online VP-STO: one step of model-predictive control (4.4, Algorithm 1), for any problem.

The thesis prints Algorithm 1 without its body; the steps follow the text of section 4.4. A problem says what
a candidate costs, where to look first and how via-points become a trajectory; :class:`OnlineVpsto` decides
between stopping, warm-starting and exploring.
"""

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.optimization.progress import Evaluation, SearchResult
from vpsto_ros.optimization.vpsto import VpstoConfig, search
from vpsto_ros.priors.gaussian import GaussianPrior
from vpsto_ros.trajectory import Trajectory


class OnlineProblem(Protocol):
    """What a planning step has to solve; P search points of n dimensions follow the start."""

    start_time: float

    def evaluate(self, points: NDArray) -> Evaluation:
        """Cost and validity of candidates (B, P, n), for any P."""

    def trajectory(self, points: NDArray) -> Trajectory:
        """The timed trajectory through points (P, n), from ``start_time`` on."""

    def direct(self, previous: Trajectory | None) -> NDArray | None:
        """Search points (P, n) of the trajectory without via-points, None if it has no end to go to."""

    def shifted(self, previous: Trajectory, n_via: int) -> NDArray:
        """Search points (P, n) of what is left of the previous solution."""

    def prior(self, n_via: int) -> GaussianPrior:
        """Gaussian over the search points."""

    def guesses(self, n_via: int) -> NDArray:
        """First guesses (S, P, n), the most promising one first."""


@documented
@dataclasses.dataclass(frozen=True)
class OnlineConfig:
    """Options of online VP-STO."""

    n_via: int = option(3, "largest number of via-points (N_max)", minimum=1, maximum=20)
    via_rate: float = option(
        0.0,
        "via-points per second of remaining motion (alpha of 4.4.2); 0 keeps N_max",
        unit="1/s",
        minimum=0.0,
        maximum=100.0,
    )
    stop_duration: float = option(
        0.4,
        "a valid trajectory without via-points is taken when it is shorter (T_stop)",
        unit="s",
        minimum=0.0,
        maximum=10.0,
    )
    warm_start: bool = option(True, "start from what is left of the previous solution")
    warm_sigma: float = option(
        0.25, "initial step size when warm-starting, relative to the prior", minimum=1e-3, maximum=10.0
    )
    search: VpstoConfig = dataclasses.field(default_factory=lambda: VpstoConfig(population=24, iterations=5))

    def __post_init__(self) -> None:
        validate(self)


@dataclasses.dataclass(frozen=True)
class OnlineResult:
    """Outcome of one planning step.

    Attributes:
        trajectory: best valid trajectory, None if no valid one was found.
        mode: "stop", "warm_start" or "explore".
        cost: its cost, inf if none was found.
        search: what the search reports, None in mode "stop".
    """

    trajectory: Trajectory | None
    mode: str
    cost: float
    search: SearchResult | None = None


class OnlineVpsto:
    """Algorithm 1: stop, warm-start or explore, then search until the deadline."""

    def __init__(self, config: OnlineConfig, rng: np.random.Generator) -> None:
        self.config = config
        self.rng = rng
        self.previous: Trajectory | None = None

    def step(
        self,
        problem: OnlineProblem,
        *,
        deadline: float | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> OnlineResult:
        """Plan once. Call :meth:`accept` when the result is going to be executed.

        Args:
            problem: what to solve, from the state in which the robot will be when the plan takes over.
            deadline: value of `clock` at which the best candidate so far is returned; None: run all
                iterations.
            clock: source of that time [s].
        """
        stop = self._stop(problem)
        if stop is not None:
            return stop
        previous = self.previous if self.config.warm_start else None
        mode = "explore" if previous is None else "warm_start"
        result = self._search(problem, previous, deadline, clock)
        if result.points is None:
            return OnlineResult(None, mode, math.inf, result)
        return OnlineResult(problem.trajectory(result.points), mode, result.cost, result)

    def accept(self, trajectory: Trajectory | None) -> None:
        """Remember the solution that is executed; None makes the next step explore."""
        self.previous = trajectory

    def _stop(self, problem: OnlineProblem) -> OnlineResult | None:
        points = problem.direct(self.previous)
        if points is None:
            return None
        evaluation = problem.evaluate(points[None])
        if not evaluation.valid[0]:
            return None
        trajectory = problem.trajectory(points)
        if trajectory.duration > self.config.stop_duration:
            return None
        return OnlineResult(trajectory, "stop", float(evaluation.cost[0]))

    def _search(
        self,
        problem: OnlineProblem,
        previous: Trajectory | None,
        deadline: float | None,
        clock: Callable[[], float],
    ) -> SearchResult:
        n_via = self._n_via(problem, previous)
        guesses, sigma = problem.guesses(n_via), self.config.search.sigma
        if previous is not None:
            guesses = np.concatenate([problem.shifted(previous, n_via)[None], guesses])
            sigma = self.config.warm_sigma
        return search(
            problem.prior(n_via), problem.evaluate, self.config.search, self.rng,
            means=guesses, sigma=sigma, deadline=deadline, clock=clock,
        )  # fmt: skip

    def _n_via(self, problem: OnlineProblem, previous: Trajectory | None) -> int:
        if previous is None or self.config.via_rate == 0.0:
            return self.config.n_via
        remaining = max(previous.end_time - problem.start_time, 0.0)
        return max(1, min(math.ceil(self.config.via_rate * remaining), self.config.n_via))
