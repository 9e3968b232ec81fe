"""How long before a deadline the search should stop: a trade of the cost it reaches against punctuality.

The durations of iterations are drawn from a measured distribution, so that the result is the same everywhere.
``python -m sim_bridge.experiments.search.deadline`` measures one.
"""

import dataclasses
import math
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.runs import success_interval
from sim_bridge.experiments.search.problems import problems
from sim_bridge.experiments.search.statistics import POSSIBLY_WORSE, Sample, better, lower
from sim_bridge.experiments.search.variants import Choice
from vpsto_ros.optimization.progress import Evaluation
from vpsto_ros.optimization.vpsto import VpstoConfig, search

PROBLEM = "clutter"
DEADLINE = 0.010
LEVELS = (0.0, 0.1, 0.5, 0.75, 0.9, 0.95, 0.97, 0.98, 0.99, 0.995, 0.999, 1.0)
ITERATION_MS = (0.165, 0.183, 0.205, 0.266, 0.369, 3.142, 4.396, 4.460, 4.579, 5.577, 8.540, 33.632)
"""Quantiles at these levels of 20 000 iterations of the default search in the plane with obstacles, by the
clock on the wall, on two cores that other processes kept busy."""

STEPS = 20
"""Searches per task, one after the other."""


@dataclasses.dataclass(frozen=True)
class DeadlineTask:
    """Searches on the plane with obstacles, each with a deadline.

    Attributes:
        reserve: option of the search.
        seed: of searches and durations.
    """

    reserve: str
    seed: int


@dataclasses.dataclass(frozen=True)
class DeadlineResult:
    """What came of the searches of a task.

    Attributes:
        overrun: how much later than the deadline each came back [s], shape (STEPS,); negative if earlier.
        iterations: of each, shape (STEPS,).
        cost: that each reached, inf without a valid motion, shape (STEPS,).
    """

    overrun: NDArray
    iterations: NDArray
    cost: NDArray


@dataclasses.dataclass(frozen=True, eq=False)
class Punctuality:
    """How a reserve did over all searches.

    Attributes:
        searches: how many there were.
        late: how many of them came back after the deadline.
        overrun_p99: 99 % quantile of how much later than the deadline they came back [s].
        iterations: mean.
        cost: gaps to the best known cost.
    """

    searches: int
    late: int
    overrun_p99: float
    iterations: float
    cost: Sample

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the share that is late."""
        return success_interval(self.late, self.searches)

    def summary(self) -> dict[str, Any]:
        """For summary.json."""
        gap, low, high = (value if math.isfinite(value) else None for value in self.cost.median())
        return {
            "searches": self.searches,
            "late": self.late,
            "late_interval": self.interval,
            "overrun_p99_ms": 1e3 * self.overrun_p99,
            "iterations_mean": self.iterations,
            "gap_p50": gap,
            "gap_interval": [low, high],
        }


class _BusyMachine:
    """Makes a problem's evaluations take time on a clock of its own."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.now, self.rng = 0.0, rng
        self.problem = problems()[PROBLEM].problem

    def __call__(self, points: NDArray) -> Evaluation:
        self.now += 1e-3 * float(np.interp(self.rng.uniform(), LEVELS, ITERATION_MS))
        return self.problem.evaluate(points)

    def clock(self) -> float:
        return self.now


def run_task(task: DeadlineTask) -> DeadlineResult:
    """Search again and again, each time until the deadline."""
    prior = problems()[PROBLEM].prior
    config = VpstoConfig(iterations=1000, reserve=task.reserve)
    overrun, iterations, cost = np.empty(STEPS), np.empty(STEPS), np.empty(STEPS)
    for step in range(STEPS):
        rng = np.random.default_rng([task.seed, step])
        machine = _BusyMachine(rng.spawn(1)[0])
        result = search(prior, machine, config, rng, deadline=DEADLINE, clock=machine.clock)
        overrun[step], iterations[step] = machine.now - DEADLINE, result.iterations
        cost[step] = result.cost
    return DeadlineResult(overrun, iterations, cost)


def punctuality(results: dict[str, list[DeadlineResult]]) -> dict[str, Punctuality]:
    """What the results of every reserve come to."""
    costs = {name: np.concatenate([each.cost for each in found]) for name, found in results.items()}
    best = min(cost.min() for cost in costs.values())
    best = best if math.isfinite(best) else 1.0
    rows = {}
    for name, found in results.items():
        overrun = np.concatenate([each.overrun for each in found])
        rows[name] = Punctuality(
            len(overrun), int((overrun > 0.0).sum()), float(np.quantile(overrun, 0.99)),
            float(np.mean([each.iterations.mean() for each in found])),
            Sample(costs[name] / best - 1.0, math.nan, math.nan),
        )  # fmt: skip
    return rows


def preferable(rows: dict[str, Punctuality], choice: Choice) -> list[str]:
    """Reserves that should replace the one in use: better in one respect and not possibly worse in the other.

    The respects are the cost that is reached and the share of searches that come back late.
    """
    used = rows[choice.in_use]
    found = []
    for name, row in rows.items():
        later, earlier = row.interval[0] > used.interval[1], row.interval[1] < used.interval[0]
        worse = lower(used.cost, row.cost, POSSIBLY_WORSE)
        if (better(row.cost, used.cost) and not later) or (earlier and not worse):
            found.append(f"{choice.name} = {name}")
    return found


def measure(searches: int = 100, iterations: int = 200) -> NDArray:
    """Durations of iterations on this machine [s], shape (searches * iterations,)."""
    posed, config = problems()[PROBLEM], VpstoConfig(iterations=iterations + 1, restarts=0)
    times: list[float] = []

    def evaluate(points: NDArray) -> Evaluation:
        times.append(time.perf_counter())
        return posed.problem.evaluate(points)

    for seed in range(searches + 1):  # the first one loads the kernels
        search(posed.prior, evaluate, config, np.random.default_rng(seed))
    return np.diff(np.array(times).reshape(searches + 1, -1)[1:], axis=1).ravel()


if __name__ == "__main__":
    print(", ".join(f"{1e3 * value:.3f}" for value in np.quantile(measure(), LEVELS)))
