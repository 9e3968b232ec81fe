"""Rows of planning in belief space: an iteration of BS-VP-STO inside a search, and a whole robust plan.

They count the processor time of their one thread: the longer ones would otherwise measure, on a machine that
has other things to do, how often these interrupt.
"""

from __future__ import annotations

import functools
import itertools
import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from sim_bridge.bench.measuring import Action, Cores, Row, at_most
from sim_bridge.experiments.belief import bimanual
from sim_bridge.experiments.belief.models import FRICTION, THESIS, Model
from vpsto_ros.optimization.cma import make_strategy
from vpsto_ros.optimization.vpsto import VpstoConfig
from vpsto_ros.planning.belief_space.config import RobustPushingConfig
from vpsto_ros.planning.belief_space.problem import RobustPushingProblem

CANDIDATES, PARTICLES, STEPS = (30, 120, 480), (20, 80, 320), (50, 200, 800)
"""Sizes over which growth is measured; the first of each is the size that plans have."""
ITERATIONS = 10
"""Of a search, after which the next one begins somewhere else on the way."""


def iteration_name(candidates: int, particles: int, steps: int) -> str:
    """Name of the row of one iteration for 4 coordinates."""
    return f"belief_iteration_4dof_b{candidates}_p{particles}_k{steps}"


@functools.cache
def problems(joints: bool, model: Model, particles: int, steps: int) -> list[RobustPushingProblem]:
    """Horizons on the way around the circle, as a plan of ordinary size meets them."""
    found: list[RobustPushingProblem] = []
    rng = np.random.default_rng(0)
    config = RobustPushingConfig(search=VpstoConfig(population=30, iterations=10, strategy="cma"))
    planner = bimanual.pusher(config, model, joints=joints, rng=rng)
    position, belief, target = bimanual.start(joints), bimanual.belief(particles, rng), bimanual.TARGET
    velocity, progress = np.zeros_like(position), 0.0
    larger = RobustPushingConfig(particles=particles, steps=steps)
    for _ in range(8):
        step = planner.horizon(position, velocity, belief, target.way(progress))
        found.append(
            RobustPushingProblem(
                larger, planner.dynamics, planner.space, planner.rule, start=position, velocity=velocity,
                belief=belief.jittered(config.jitter, rng), way=target.way(progress), reach=planner.reach,
            )
        )  # fmt: skip
        executed = planner.executed_time(step)
        path = step.trajectory(np.linspace(0.0, executed, 13))
        belief = planner.dynamics.simulate(belief, planner.space.plane(path[None])[0][0], rng).belief
        position, velocity, _ = step.trajectory.state(executed)
        progress = target.advanced(progress, belief.mean[:2])
    return found


def processor_time(work: Callable[[], None]) -> Action:
    """An action that returns what a call takes of the processor [s]."""

    def timed() -> list[float]:
        began = time.thread_time()
        work()
        return [time.thread_time() - began]

    return timed


def iteration(
    joints: bool, model: Model, candidates: int, particles: int, steps: int, _cores: Cores
) -> Action:
    """Ask, synthesis, kinematics, rollout of the belief, costs and tell, two points per horizon."""
    rng = np.random.default_rng(0)
    horizons = itertools.cycle([(p, p.prior()) for p in problems(joints, model, particles, steps)])

    def iterations() -> Iterator[None]:
        for problem, prior in horizons:
            strategy = make_strategy("cma", prior.dimension, candidates, rng)
            for _ in range(ITERATIONS):
                latent = strategy.ask()
                strategy.tell(latent, problem.evaluate(prior.to_points(latent)).cost)
                yield

    return processor_time(iterations().__next__)


def circle_plan(model: Model, _cores: Cores) -> Action:
    """A robust plan all around the circle, with ten iterations per horizon."""
    config = RobustPushingConfig()
    seeds = itertools.count()

    def plan() -> None:
        rng = np.random.default_rng(next(seeds))
        planner = bimanual.pusher(config, model, joints=False, rng=rng)
        planner.plan(bimanual.START, bimanual.belief(config.particles, rng), bimanual.TARGET)

    plan()  # compiles and loads what there is to compile and load
    return processor_time(plan)


SIZES = tuple(
    dict.fromkeys(
        [(b, PARTICLES[0], STEPS[0]) for b in CANDIDATES]
        + [(CANDIDATES[0], p, STEPS[0]) for p in PARTICLES]
        + [(CANDIDATES[0], PARTICLES[0], k) for k in STEPS]
    )
)
ROWS = (
    *(
        Row(
            iteration_name(*size),
            partial(iteration, False, THESIS, *size),
            own_times=True,
            wanted=at_most(0.4) if size == SIZES[0] else None,
        )
        for size in SIZES
    ),
    Row(
        f"{iteration_name(*SIZES[0])}_rich",
        partial(iteration, False, FRICTION, *SIZES[0]),
        own_times=True,
        wanted=at_most(0.8),
    ),
    Row(
        "belief_iteration_14dof_b30_p20_k50",
        partial(iteration, True, THESIS, *SIZES[0]),
        own_times=True,
        wanted=at_most(1.0),
    ),
    Row("robust_circle_plan", partial(circle_plan, THESIS), calls=4, own_times=True, wanted=at_most(500.0)),
    Row(
        "robust_circle_plan_rich",
        partial(circle_plan, FRICTION),
        calls=4,
        own_times=True,
        wanted=at_most(1500.0),
    ),
)
