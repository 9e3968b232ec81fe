"""Moves of an arm through random cells with a budget of evaluations: what the options are worth there."""

import dataclasses
import time

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.reaching.cells import random_task
from sim_bridge.experiments.reaching.reach_clutter import problem_of
from sim_bridge.experiments.search.problems import Result
from sim_bridge.warm_up import plan_in_a_cell
from vpsto_ros.planning.reaching import ReachConfig, plan_reach
from vpsto_ros.trajectory import TrajectoryBatch

TITLES = {"cells": "arm in random cells", "cells_stop": "the same, until enough rounds are valid"}
BUDGETS = {"cells": 8000, "cells_stop": 20_000}
"""Evaluations; 8000 take about half a second."""


@dataclasses.dataclass(frozen=True)
class Task:
    """One move.

    Attributes:
        name: "cells" uses up its budget, "cells_stop" ends after as many valid rounds as the options say.
        config: options.
        seed: of cell, postures and search.
    """

    name: str
    config: ReachConfig
    seed: int


class _Counter:
    """A term that costs nothing and counts what is evaluated."""

    def __init__(self) -> None:
        self.evaluations = 0

    def __call__(self, batch: TrajectoryBatch) -> tuple[NDArray, NDArray]:
        size = len(batch.duration)
        self.evaluations += size
        return np.zeros(size), np.ones(size, dtype=bool)

    def clock(self) -> float:
        return float(self.evaluations)


def run_task(task: Task, budget: int | None = None) -> Result:
    """Search until the budget is used up."""
    problem, checker = problem_of(random_task(task.seed))
    counter = _Counter()
    counted = dataclasses.replace(problem, terms=(*problem.terms, counter))
    config = task.config
    if task.name == "cells":
        config = dataclasses.replace(config, valid_rounds=config.rounds)
    begin = time.thread_time()
    found = plan_reach(
        counted, checker.in_collision, config, np.random.default_rng(task.seed),
        deadline=(BUDGETS[task.name] if budget is None else budget) + 1.0, clock=counter.clock,
    )  # fmt: skip
    return Result(found.search.cost, counter.evaluations, time.thread_time() - begin)


def warm_up() -> None:
    """Load what the moves need."""
    plan_in_a_cell()
    run_task(Task("cells", ReachConfig(), 1000), budget=1)
