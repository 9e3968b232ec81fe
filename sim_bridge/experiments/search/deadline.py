"""How long before a deadline the search should stop, when iterations last as they do on a busy machine.

The durations of iterations are drawn, not measured, so that the result is the same everywhere: log-normal
about a median, and now and then one that is held up.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.search.problems import problems
from vpsto_ros.optimization.progress import Evaluation
from vpsto_ros.optimization.vpsto import VpstoConfig, search

DEADLINE = 0.020
MEDIAN, SPREAD = 0.001, 0.2
HOLD_UP, HOLD_UP_RATE = 0.005, 0.01
STEPS = 50
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
    """

    overrun: NDArray
    iterations: NDArray


class _BusyMachine:
    """Makes a problem's evaluations take time on a clock of its own."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.now, self.rng = 0.0, rng
        self.problem = problems()["clutter"].problem

    def __call__(self, points: NDArray) -> Evaluation:
        self.now += MEDIAN * float(np.exp(SPREAD * self.rng.standard_normal()))
        self.now += HOLD_UP * float(self.rng.uniform() < HOLD_UP_RATE)
        return self.problem.evaluate(points)

    def clock(self) -> float:
        return self.now


def run_task(task: DeadlineTask) -> DeadlineResult:
    """Search again and again, each time until the deadline."""
    prior = problems()["clutter"].prior
    config = VpstoConfig(iterations=1000, reserve=task.reserve)
    overrun, iterations = np.empty(STEPS), np.empty(STEPS)
    for step in range(STEPS):
        rng = np.random.default_rng([task.seed, step])
        machine = _BusyMachine(rng.spawn(1)[0])
        result = search(prior, machine, config, rng, deadline=DEADLINE, clock=machine.clock)
        overrun[step], iterations[step] = machine.now - DEADLINE, result.iterations
    return DeadlineResult(overrun, iterations)
