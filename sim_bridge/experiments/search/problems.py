"""What the options of the search are compared on: problems with a fixed budget of evaluations each.

A plane with obstacles and several local optima, with the budget of the thesis and with four times as much;
seven joints in free space, time-optimal; one degree of freedom, time-optimal; and seven joints past two walls
with narrow gaps, with a budget in which a valid motion is not certain.
"""

import dataclasses
import functools
import time

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.clutter.world import CLUTTER, GOAL, LIMITS, STARTS
from sim_bridge.experiments.timing.linear_program import optimal_duration
from sim_bridge.experiments.timing.via_points import ONE, SEVEN
from vpsto_ros.optimization.costs import CostWeights, JointSpaceProblem
from vpsto_ros.optimization.progress import Evaluation
from vpsto_ros.optimization.vpsto import VpstoConfig, search
from vpsto_ros.priors.gaussian import GaussianPrior
from vpsto_ros.trajectory import Limits, OptimalBasis


@dataclasses.dataclass(frozen=True, eq=False)
class BudgetedProblem:
    """A problem and what it may cost to solve.

    Attributes:
        title: for the table.
        problem: start, goal, limits, constraints.
        spread: standard deviation of the prior, in the unit of the positions.
        budget: evaluations of candidates.
        optimum: lowest cost there is, 0 if it is not known.
    """

    title: str
    problem: JointSpaceProblem
    spread: float
    budget: int
    optimum: float = 0.0

    @functools.cached_property
    def prior(self) -> GaussianPrior:
        """Where candidates come from."""
        return self.problem.prior(spread=self.spread)


def _clutter(title: str, budget: int) -> BudgetedProblem:
    problem = JointSpaceProblem(
        OptimalBasis.uniform(5), LIMITS, STARTS["start_0.10_0.20"], GOAL, terms=(CLUTTER.term(),), samples=2
    )
    return BudgetedProblem(title, problem, 0.1, budget)


def _time_optimal(title: str, limits: Limits, n_via: int, budget: int) -> BudgetedProblem:
    problem = JointSpaceProblem(
        OptimalBasis.uniform(n_via), limits, np.zeros(limits.dof), np.ones(limits.dof),
        weights=CostWeights(smoothness=0.0), samples=2,
    )  # fmt: skip
    optimum = optimal_duration(problem.basis, problem.start, np.ones(limits.dof), limits).duration
    return BudgetedProblem(title, problem, 0.1, budget, optimum)


def _walls() -> BudgetedProblem:
    def hit(q: NDArray) -> NDArray:
        first = (np.abs(q[..., 0] - 0.3) < 0.05) & (q[..., 1] < 0.5)
        second = (np.abs(q[..., 0] - 0.7) < 0.05) & ((q[..., 1] > -0.4) | (q[..., 2] < 0.3))
        return first | second

    limits = Limits(np.full(7, 2.0), np.full(7, 8.0), np.full(7, -2.0), np.full(7, 2.0))
    problem = JointSpaceProblem(
        OptimalBasis.uniform(4), limits, np.zeros(7), np.eye(7)[0], collision=hit, samples=60
    )
    return BudgetedProblem("seven joints past two walls", problem, 0.4, 1500)


@functools.cache
def problems() -> dict[str, BudgetedProblem]:
    """All of them by name."""
    return {
        "clutter": _clutter("plane with obstacles", 5000),
        "clutter_long": _clutter("the same, four times the budget", 20_000),
        "arm": _time_optimal("seven joints, free", SEVEN, 4, 5000),
        "line": _time_optimal("one joint, free", ONE, 6, 1500),
        "walls": _walls(),
    }


@dataclasses.dataclass(frozen=True)
class Task:
    """One search.

    Attributes:
        problem: name of the problem.
        name: which option has which value.
        config: options of the search; its number of iterations is ignored.
        seed: of the search.
    """

    problem: str
    name: str
    config: VpstoConfig
    seed: int


@dataclasses.dataclass(frozen=True)
class Result:
    """What came of a search.

    Attributes:
        cost: of the best valid candidate, inf without one.
        evaluations: how many candidates were evaluated.
        seconds: processor time.
    """

    cost: float
    evaluations: int
    seconds: float


class _Counted:
    """A problem that counts its evaluations: the clock of a search with a budget."""

    def __init__(self, problem: JointSpaceProblem) -> None:
        self.problem, self.evaluations = problem, 0

    def __call__(self, points: NDArray) -> Evaluation:
        self.evaluations += len(points)
        return self.problem.evaluate(points)

    def clock(self) -> float:
        return float(self.evaluations)


def run_task(task: Task) -> Result:
    """Search until the budget is used up."""
    posed = problems()[task.problem]
    warm_up(task.problem, task.config.strategy)
    counted = _Counted(posed.problem)
    # One more than the budget, because an iteration has to end before the deadline.
    config = dataclasses.replace(task.config, iterations=posed.budget)
    begin = time.thread_time()
    result = search(
        posed.prior, counted, config, np.random.default_rng(task.seed),
        deadline=posed.budget + 1.0, clock=counted.clock,
    )  # fmt: skip
    return Result(result.cost, result.evaluations, time.thread_time() - begin)


@functools.cache
def warm_up(name: str, strategy: str) -> None:
    """Compile and import what a search needs, so that no run has to."""
    posed = problems()[name]
    config = VpstoConfig(iterations=2, strategy=strategy)
    search(posed.prior, posed.problem.evaluate, config, np.random.default_rng(0))
