"""What the options of the search are compared on: problems with a fixed budget of evaluations each.

A plane with obstacles and several local optima, with the budget of the thesis and with four times as much,
and the plain setting of Fig. 4.4 in it; seven joints in free space, time-optimal, with four and with nine
via-points; one degree of freedom, time-optimal; and seven joints past two walls with narrow gaps, with a
budget in which a valid motion is not certain.
"""

import dataclasses
import functools
import time

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.clutter import clutter_2d
from sim_bridge.experiments.clutter.world import CLUTTER, GOAL, LIMITS, STARTS
from sim_bridge.experiments.timing.linear_program import optimal_duration
from sim_bridge.experiments.timing.via_points import ONE, SEVEN
from sim_bridge.warm_up import plan_in_clutter
from vpsto_ros.optimization.cma import STRATEGIES
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
        "clutter_plain": BudgetedProblem(
            "the same, plain setting",
            clutter_2d.problem(STARTS["start_0.10_0.20"], GOAL, clutter_2d.N_VIA), clutter_2d.SPREAD, 5000,
        ),
        "arm": _time_optimal("seven joints, free", SEVEN, 4, 5000),
        "arm_long": _time_optimal("the same, nine via-points", SEVEN, 9, 38_400),
        "line": _time_optimal("one joint, free", ONE, 6, 1500),
        "walls": _walls(),
    }  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Task:
    """One search.

    Attributes:
        name: of the problem.
        config: options of the search; its number of iterations is ignored.
        seed: of the search.
        spread: of the prior instead of the problem's own.
    """

    name: str
    config: VpstoConfig
    seed: int
    spread: float | None = None


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


def run_task(task: Task, budget: int | None = None) -> Result:
    """Search until the budget, by default the problem's own, is used up."""
    posed = problems()[task.name]
    prior = posed.prior if task.spread is None else posed.problem.prior(spread=task.spread)
    counted = _Counted(posed.problem)
    # One more than the budget, because an iteration has to end before the deadline.
    config = dataclasses.replace(task.config, iterations=posed.budget)
    budget = posed.budget if budget is None else budget
    begin = time.thread_time()
    result = search(
        prior, counted, config, np.random.default_rng(task.seed),
        deadline=budget + 1.0, clock=counted.clock,
    )  # fmt: skip
    return Result(result.cost, result.evaluations, time.thread_time() - begin)


def warm_up() -> None:
    """Pose all problems, and load what their searches need."""
    plan_in_clutter()
    for name in problems():
        for strategy in STRATEGIES:
            run_task(Task(name, VpstoConfig(strategy=strategy), 0), budget=64)
