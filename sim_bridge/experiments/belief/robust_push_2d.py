"""Figs. 6.8 and 6.9: a rectangle of 20 x 6 cm pushes a disc of 4 cm radius into a region, open loop.

The disc is about 1 cm (one standard deviation) off where it is expected, and the region is a circle of 3 cm
radius 0.3 m away, to the side. The whole push is planned either as a single horizon, 4 points and 120
iterations, whose cost contains the distance that is left and the duration; or by the receding horizon, which
ends when the mean of the belief is within 8 mm of the centre and its standard deviation below 9 mm. Plans are
judged by 1000 noisy rollouts of the model they were made with, at steps of 0.05 s, from fresh particles.

The baseline knows nothing of variance and takes the expected place and the nominal model for true. Particles
that carry friction spread a little in any push with one flat side: that model allows a gain of 1.1 per step.
"""

import argparse
import dataclasses
import pathlib
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.belief import robust_push_2d_figure
from sim_bridge.experiments.belief.models import (
    FRICTION,
    MODELS,
    THESIS,
    Model,
    disc_belief,
    mean_interval,
    mean_text,
)
from sim_bridge.experiments.runs import (
    Execution,
    markdown_table,
    print_verdict,
    quantile,
    run_trials,
    write_summary,
)
from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.optimization.progress import Evaluation, Incumbents
from vpsto_ros.optimization.vpsto import VpstoConfig, search
from vpsto_ros.planning.belief_space.config import RobustPushingConfig
from vpsto_ros.planning.belief_space.contacts import ContactRule
from vpsto_ros.planning.belief_space.problem import RobustPushingProblem
from vpsto_ros.planning.belief_space.receding_horizon import RobustPusher
from vpsto_ros.planning.belief_space.spaces import PlaneSpace
from vpsto_ros.planning.belief_space.targets import GoalTarget
from vpsto_ros.trajectory import Trajectory

HAND, RADIUS = EndEffectors.rectangle(0.20, 0.06), 0.04
START, OBJECT, STD = np.array([0.30, -0.12, 0.0]), np.array([0.45, 0.0]), 0.01
GOAL, REGION = OBJECT + 0.3 * np.array([np.cos(0.6), np.sin(0.6)]), 0.03
TOOL_FRICTION = (0.0, 0.5)
"""Range of the friction that particles carry."""
SHOWN = (1, 10, 40, 120)
"""Iterations after which the best candidate of the single horizon is shown and judged."""
ROLLOUTS, STEP = 1000, 0.05
EXECUTED = 20
"""Steps that are executed of a horizon."""
HORIZONS, TRACKED = 300, 200
"""Horizons that are allowed, and particles with which the belief is carried from one to the next."""
REQUIRED = {"single_horizon": 0.95, "receding": 0.99}
WAYS = {"single_horizon": "single horizon", "receding": "receding horizon"}


def config_of(way: str, model: Model, robust: bool) -> RobustPushingConfig:
    """Options of one way to plan; found on seeds from 1000 on."""
    iterations = max(SHOWN) if way == "single_horizon" else 10
    common: dict[str, Any] = {
        "robust": robust, "particles": 50, "largest_gain": 1.1 if model is FRICTION else 1.0,
        "search": VpstoConfig(population=30, iterations=iterations, strategy="cma"),
    }  # fmt: skip
    if way == "receding":
        return RobustPushingConfig(**common)
    return RobustPushingConfig(
        points=4, steps=50, smoothness_spread=0.1, distance_weight=20.0, duration_weight=0.05, **common
    )


@dataclasses.dataclass(frozen=True)
class Task:
    """One plan: how, with which model, robust or not, with which seed."""

    way: str
    model: str
    robust: bool
    seed: int


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """A plan and what becomes of it.

    Attributes:
        success: share of the rollouts that end in the region; for a single horizon after each number of
            iterations in SHOWN, shape (4,); for the receding one a single number, shape (1,).
        trajectories: the plans behind these, None where nothing valid was known.
        samples: candidates of these iterations, each (B, N, 3); none for the receding horizon.
        reached: whether planning found a valid plan to the end.
        violating: share of the horizons without any valid candidate.
        horizons: how many were planned.
        seconds: planning time [s].
    """

    success: NDArray
    trajectories: list[Trajectory | None]
    samples: list[NDArray]
    reached: bool
    violating: float
    horizons: int
    seconds: float


def planner(task: Task, rng: np.random.Generator) -> RobustPusher:
    """The planner of a task."""
    config = config_of(task.way, MODELS[task.model], task.robust)
    rule = ContactRule.of(config, HAND, PlanarShape.disc(RADIUS))
    dynamics = MODELS[task.model].dynamics(RADIUS, HAND)
    return RobustPusher(config, dynamics, PlaneSpace(HAND, config), rule, rng, executed=EXECUTED)


def belief(count: int, rng: np.random.Generator) -> ObjectBelief:
    """Where the disc may be."""
    return disc_belief(OBJECT, STD, RADIUS, count, rng, friction=TOOL_FRICTION)


def solve(task: Task) -> Plan:
    """Plan and judge."""
    rng = np.random.default_rng([task.seed, list(MODELS).index(task.model)])
    return single_horizon(task, rng) if task.way == "single_horizon" else receding_horizon(task, rng)


def single_horizon(task: Task, rng: np.random.Generator) -> Plan:
    """One search, whose best candidates are noted on the way."""
    pusher, prior = planner(task, rng), belief(50, rng)
    if not task.robust:
        prior = ObjectBelief(np.tile(prior.mean, (2, 1)))
    problem = RobustPushingProblem(
        pusher.config, pusher.dynamics, pusher.space, pusher.rule, start=START, velocity=np.zeros(3),
        belief=prior, way=np.array([[*GOAL, 0.0]]),
    )  # fmt: skip
    watch, began = _Watch(problem), time.perf_counter()
    result = search(problem.prior(), watch.evaluate, pusher.config.search, rng)
    seconds = time.perf_counter() - began
    best = [*watch.best, *[result.points] * (len(SHOWN) - len(watch.best))]  # a search may converge early
    plans = [None if points is None else problem.trajectory(points) for points in best]
    success = np.array([share_in_region(pusher, plan, rng) for plan in plans])
    valid = result.points is not None
    return Plan(success, plans, watch.samples, valid, float(not valid), 1, seconds)


class _Watch:
    """Notes candidates and the best valid one after the iterations to be shown."""

    def __init__(self, problem: RobustPushingProblem) -> None:
        self.samples: list[NDArray] = []
        self.best: list[NDArray | None] = []
        self._problem, self._iteration = problem, 0
        self._incumbents = Incumbents()

    def evaluate(self, points: NDArray) -> Evaluation:
        evaluation = self._problem.evaluate(points)
        self._iteration += 1
        self._incumbents.update(points, evaluation)
        if self._iteration in SHOWN:
            self.samples.append(points.copy())
            self.best.append(self._incumbents.points)
        return evaluation


def receding_horizon(task: Task, rng: np.random.Generator) -> Plan:
    """Algorithm 3 until the belief is tight in the middle of the region."""
    pusher = planner(task, rng)
    plan = pusher.plan(
        START, belief(TRACKED, rng), GoalTarget(GOAL, tolerance=0.008, largest_std=0.009), horizons=HORIZONS
    )
    success = np.array([share_in_region(pusher, plan.trajectory, rng)])
    violating = plan.violating / max(plan.horizons, 1)
    return Plan(success, [plan.trajectory], [], plan.reached, violating, plan.horizons, plan.seconds)


def share_in_region(pusher: RobustPusher, motion: Trajectory | None, rng: np.random.Generator) -> float:
    """Share of noisy rollouts of a motion that end in the region; none without a motion."""
    if motion is None or motion.duration < STEP:
        return 0.0
    poses = pusher.dynamics.simulate(belief(ROLLOUTS, rng), motion(sampled_times(motion)), rng).belief.poses
    return float((np.hypot(*(poses[:, :2] - GOAL).T) <= REGION).mean())


def sampled_times(motion: Trajectory) -> NDArray:
    """Times of the steps of a rollout."""
    return np.linspace(motion.start_time, motion.end_time, max(2, round(motion.duration / STEP)) + 1)


def warm_up() -> None:
    """Compile what plans use."""
    for name in MODELS:
        for way in WAYS:
            rng = np.random.default_rng(0)
            planner(Task(way, name, True, 0), rng).plan(START, belief(50, rng), GoalTarget(GOAL), horizons=1)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Twenty seeds unless asked otherwise."""
    parser.set_defaults(runs=20)


def run(arguments: argparse.Namespace) -> int:
    """Plan with every variant and seed; 0 when the thesis's model reaches its figures."""
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    variants = [(way, model, robust) for way in WAYS for model in MODELS for robust in (True, False)]
    tasks = [Task(*variant, seed) for variant in variants for seed in seeds]
    found = run_trials(solve, tasks, Execution.from_arguments(arguments), "robust_push_2d", warm_up)
    plans = {variant: found[i * len(seeds) : (i + 1) * len(seeds)] for i, variant in enumerate(variants)}
    success = {way: float(np.mean([p.success[-1] for p in plans[way, THESIS.name, True]])) for way in WAYS}
    summary = {
        "experiment": "robust_push_2d",
        "seed": arguments.seed,
        "runs": arguments.runs,
        "rollouts": ROLLOUTS,
        "region_radius_m": REGION,
        "single_horizon_success": success["single_horizon"],
        "receding_success": success["receding"],
        "variants": {label(variant): summarise(rows) for variant, rows in plans.items()},
    }
    folder = pathlib.Path(arguments.out)
    write_summary(folder, summary)
    text = table(plans)
    (folder / "table.md").write_text(text)
    for model in MODELS:
        index = typical(plans["receding", model, True])
        shown = {way: plans[way, model, True][index] for way in WAYS}
        robust_push_2d_figure.write(folder / f"robust_push_2d_{model}.png", shown, model, seeds[index])
    print(f"{text}\nresults in {folder}")
    missed = missed_targets(summary)
    return print_verdict(not missed, "; ".join(missed or _checks(summary)))


def missed_targets(summary: dict[str, Any]) -> list[str]:
    """What falls short, in words."""
    return [text for text, good in _checks(summary).items() if not good]


def _checks(summary: dict[str, Any]) -> dict[str, bool]:
    """What is compared with its target, in words, and whether it is as asked."""
    success = {way: summary[f"{way}_success"] for way in WAYS}
    return {
        f"{WAYS[way]}: {100 * success[way]:.1f} % of the rollouts end in the region (at least "
        f"{100 * REQUIRED[way]:.0f} %)": success[way] >= REQUIRED[way]
        for way in WAYS
    }


def label(variant: tuple[str, str, bool]) -> str:
    """Key of a variant in summary.json."""
    way, model, robust = variant
    return f"{way}_{model}{'' if robust else '_baseline'}"


def typical(plans: list[Plan]) -> int:
    """Which plan has the median number of horizons: the one to be shown."""
    return int(np.argsort([plan.horizons for plan in plans], kind="stable")[(len(plans) - 1) // 2])


def summarise(plans: list[Plan]) -> dict[str, Any]:
    """Success over seeds, with bootstrapped intervals."""
    final, last = [plan.success[-1] for plan in plans], [plan.trajectories[-1] for plan in plans]
    entries: dict[str, Any] = {
        "success": float(np.mean(final)),
        "interval": mean_interval(final),
        "worst_seed": float(np.min(final)),
        "reached": sum(plan.reached for plan in plans),
        "horizons_p50": float(np.median([plan.horizons for plan in plans])),
        "violating_share": float(np.mean([plan.violating for plan in plans])),
        "duration_s_p50": quantile([m.duration if m else None for m in last], 0.5),
        "planning_s_p50": float(np.median([plan.seconds for plan in plans])),
    }
    if len(plans[0].success) == len(SHOWN):
        means = np.mean([plan.success for plan in plans], axis=0)
        entries["success_after_iterations"] = dict(zip(map(str, SHOWN), map(float, means), strict=True))
    return entries


def table(plans: dict[tuple[str, str, bool], list[Plan]]) -> str:
    """One row per variant."""
    header = [
        "planned as", "model", "planner", "rollouts in the region (95 %)", "worst seed", "plan found",
        f"after {' / '.join(map(str, SHOWN))} iterations", "duration", "planning time",
    ]  # fmt: skip
    rows = []
    for (way, model, robust), each in plans.items():
        found = summarise(each)
        steps = found.get("success_after_iterations", {}).values()
        rows.append([
            WAYS[way], MODELS[model].title, "robust" if robust else "baseline",
            f"{mean_text([plan.success[-1] for plan in each], 100.0, '.1f')} %",
            f"{100 * found['worst_seed']:.1f} %", f"{found['reached']} of {len(each)}",
            " / ".join(f"{100 * share:.0f}" for share in steps) + (" %" if steps else ""),
            "-" if found["duration_s_p50"] is None else f"{found['duration_s_p50']:.1f} s",
            f"{found['planning_s_p50']:.2f} s",
        ])  # fmt: skip
    return markdown_table(header, rows)
