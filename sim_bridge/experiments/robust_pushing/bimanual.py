"""Two arms push a disc along a circle without sensors (6.6.3, Figs 6.12 and 6.14).

Plans are made for a disc of 5 cm (bottle, can) and of 3 cm (glass): robust ones under both models of the
belief dynamics, and the deterministic baseline. Each is judged by 1000 noisy rollouts under each model. Some
are then played on the simulated arms: bottle, can (mass far off its centre, wooden cubes in its way) and
glass at five places each, with friction and mass that no planner knows.
"""

import argparse
import dataclasses
import pathlib
import time
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.belief.models import MODELS, disc_belief
from sim_bridge.experiments.robust_pushing.playback import play
from sim_bridge.experiments.robust_pushing.setups import pusher, random_plant
from sim_bridge.experiments.runs import (
    Execution,
    markdown_table,
    print_verdict,
    quantile,
    run_trials,
    success_interval,
    write_summary,
)
from sim_bridge.scene import BallsStart, Scene
from sim_bridge.simulation import Simulation
from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.planning.belief_space.plan_choice import best_plan
from vpsto_ros.planning.belief_space.receding_horizon import RobustPlan
from vpsto_ros.planning.belief_space.targets import PathTarget
from vpsto_ros.robot.kinds import TOOL_KINDS
from vpsto_ros.trajectory import Trajectory

START = np.array([0.42, 0.0])
"""Where the object is expected, and where the circle begins and ends [m]."""
CENTER = np.array([0.52, 0.0])
BALLS = np.array([0.34, 0.10, 0.34, -0.10])
PLACE_STD = 0.007
"""How exactly the object is put there [m]."""
ROLLOUTS = 1000
ATTEMPTS, ENOUGH = 3, 0.97
"""Robust plans are made anew until one reaches the end in this share of its own noisy rollouts."""
LARGEST_DEVIATION, LARGEST_FINAL_ERROR = 0.04, 0.02
"""Success: the object stays within the first of the path and ends within the second of its end [m]."""
STEP = 0.02
PLACES = 5


@dataclasses.dataclass(frozen=True)
class Variant:
    """A planner: a name, a title, its model of the dynamics, and whether it looks at the variance."""

    name: str
    title: str
    model: str
    robust: bool


VARIANTS = (
    Variant("robust_friction", "robust, particles with friction", "friction", True),
    Variant("robust_thesis", "robust, the thesis's model", "thesis", True),
    Variant("baseline", "deterministic baseline", "thesis", False),
)
OBJECTS = {"bottle": 0.05, "can": 0.05, "glass": 0.03}
"""Radius of each object [m]."""


@dataclasses.dataclass(frozen=True)
class PlanTask:
    """One plan to be made."""

    seed: int
    variant: Variant
    radius: float


@dataclasses.dataclass(frozen=True)
class PlanResult:
    """A plan and what noisy rollouts of it say.

    Attributes:
        motion: of the balls in the plane.
        reached: whether the planner says that it gets there.
        attempts: how many plans were made.
        seconds: processor time of planning, of all attempts, without rehearsals.
        horizons: searches, of the plan that was taken.
        violating: of these, searches without a valid candidate.
        success: share of successful rollouts by model.
        shown: some rolled-out paths of the object under the plan's own model, shape (R, S, 2) [m].
    """

    motion: Trajectory
    reached: bool
    attempts: int
    seconds: float
    horizons: int
    violating: int
    success: dict[str, float]
    shown: NDArray


def target() -> PathTarget:
    """The circle."""
    return PathTarget.circle(START, CENTER)


def make_plan(task: PlanTask) -> PlanResult:
    """Plan, and roll the plan out; robust plans are the best of some."""
    rng = np.random.default_rng([task.seed, round(1e3 * task.radius)])
    variant, seconds = task.variant, []
    planner = pusher("two_balls", task.radius, variant.model, rng, robust=variant.robust)

    def make() -> RobustPlan:
        begin = time.thread_time()
        plan = planner.plan(
            BALLS, disc_belief(START, PLACE_STD, task.radius, planner.config.particles, rng), target()
        )
        seconds.append(time.thread_time() - begin)
        return plan

    def judged(plan: RobustPlan, names: Iterable[str]) -> dict[str, tuple[float, NDArray]]:
        assert plan.trajectory is not None, "the start is not the end of the path"
        # The baseline is judged from the expected place, as in the thesis.
        std = PLACE_STD if variant.robust else 0.0
        effectors = TOOL_KINDS["two_balls"].effectors
        models = {name: MODELS[name].dynamics(task.radius, effectors) for name in names}
        return {
            name: roll_out(model, plan.trajectory, std, task.radius, rng) for name, model in models.items()
        }

    plan, _ = best_plan(
        make, lambda plan: judged(plan, [variant.model]), lambda rollouts: rollouts[variant.model][0],
        ATTEMPTS if variant.robust else 1, enough=ENOUGH,
    )  # fmt: skip
    rolled = judged(plan, MODELS)  # drawn anew: what a plan was chosen by flatters it
    assert plan.trajectory is not None, "the start is not the end of the path"
    return PlanResult(
        plan.trajectory, plan.reached, len(seconds), sum(seconds), plan.horizons, plan.violating,
        {name: share for name, (share, _) in rolled.items()}, rolled[variant.model][1],
    )  # fmt: skip


def roll_out(
    model: BeliefDynamics, motion: Trajectory, std: float, radius: float, rng: np.random.Generator
) -> tuple[float, NDArray]:
    """Share of successful noisy rollouts, and some paths (R, 200, 2)."""
    times = np.linspace(motion.start_time, motion.end_time, int(motion.duration / STEP) + 2)
    rollout = model.simulate(disc_belief(START, std, radius, ROLLOUTS, rng), motion(times), rng, stride=10)
    good = succeeded(rollout.poses[..., :2])
    return float(good.mean()), rollout.poses[:, :200, :2]


def succeeded(paths: NDArray) -> NDArray:
    """Whether objects on paths (K, ..., 2) stayed near the circle and ended at its end."""
    circle = target()
    deviation = circle.distances(paths).max(axis=0)
    final = np.linalg.norm(paths[-1] - circle.points[-1], axis=-1)
    return (deviation <= LARGEST_DEVIATION) & (final <= LARGEST_FINAL_ERROR)


@dataclasses.dataclass(frozen=True)
class RunTask:
    """One plan played on the arms.

    Attributes:
        seed: of plant and place.
        name: of the object.
        plan: number of the plan.
        variant: its planner.
        motion: of the balls.
    """

    seed: int
    name: str
    plan: int
    variant: Variant
    motion: Trajectory


@dataclasses.dataclass(frozen=True)
class RunResult:
    """How it went; deviation and final error [m]."""

    success: bool
    deviation: float
    final_error: float
    arm_contacts: int
    limit_violations: int
    stretch: float
    path: NDArray
    friction: tuple[float, float]
    mass: float


def execute(task: RunTask) -> RunResult:
    """Play a plan on the simulated arms."""
    rng = np.random.default_rng([task.seed, list(OBJECTS).index(task.name), 1])
    radius, can = OBJECTS[task.name], task.name == "can"
    plant = random_plant(radius, rng, off_centre=0.3 if can else 0.1)
    place = START if not task.variant.robust else START + PLACE_STD * rng.standard_normal(2)
    scene = Scene(
        plant=plant, robot="two_balls", object_pose=(*place.tolist(), 0.0),
        balls=BallsStart(start=tuple(task.motion(task.motion.start_time).tolist())),
        cubes=cubes(rng) if can else (),
    )  # fmt: skip
    simulation = Simulation(scene, seed=task.seed)
    path = play(simulation, task.motion)
    positions, circle = path.poses[:, :2], target()
    return RunResult(
        bool(succeeded(positions)), float(circle.distances(positions).max()),
        float(np.linalg.norm(positions[-1] - circle.points[-1])), simulation.robot_contacts.arms,
        simulation.limits.violations, path.stretch, positions, (plant.table_friction, plant.tool_friction),
        plant.mass,
    )  # fmt: skip


def cubes(rng: np.random.Generator) -> tuple[tuple[float, float], ...]:
    """Six places on the circle, away from where the object starts."""
    angles = np.arctan2(*(START - CENTER)[::-1]) + rng.uniform(0.9, 5.4, 6)
    radius = float(np.hypot(*(START - CENTER)))
    points = CENTER + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return tuple((float(x), float(y)) for x, y in points)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options beyond those that every experiment has."""
    parser.set_defaults(runs=40)
    parser.add_argument(
        "--executed", type=int, default=4, metavar="N",
        help="how many of the plans of each planner are played on the arms, 15 times each (default 4)",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Run the experiment; 0 when robust plans hold as asked."""
    folder, execution = pathlib.Path(arguments.out), Execution.from_arguments(arguments)
    folder.mkdir(parents=True, exist_ok=True)
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    radii = sorted(set(OBJECTS.values()), reverse=True)
    tasks = [PlanTask(seed, variant, r) for variant in VARIANTS for r in radii for seed in seeds]
    made = run_trials(make_plan, tasks, execution, "bimanual plans", warm_up=warm_up)
    plans = {(t.variant.name, t.radius, t.seed): plan for t, plan in zip(tasks, made, strict=True)}
    played = seeds[: arguments.executed]
    run_tasks = [
        RunTask(100 * seed + place, name, seed, variant, plans[variant.name, radius, seed].motion)
        for variant in VARIANTS for seed in played for name, radius in OBJECTS.items()
        for place in range(PLACES)
    ]  # fmt: skip
    runs = run_trials(execute, run_tasks, execution, "bimanual runs")
    return report(folder, plans, run_tasks, runs, len(seeds))


def warm_up() -> None:
    """Compile what planning uses."""
    for variant in VARIANTS:
        rng = np.random.default_rng(0)
        planner = pusher("two_balls", 0.05, variant.model, rng, robust=variant.robust)
        planner.plan(BALLS, disc_belief(START, PLACE_STD, 0.05, 20, rng), target(), horizons=2)


def report(
    folder: pathlib.Path,
    plans: dict[tuple[str, float, int], PlanResult],
    tasks: list[RunTask],
    runs: list[RunResult],
    count: int,
) -> int:
    """Tables, figures, summary and verdict."""
    from sim_bridge.experiments.robust_pushing import bimanual_figure

    summary = summarise(plans, tasks, runs)
    write_summary(folder, summary)
    text = f"{plan_table(plans)}\n{run_table(tasks, runs)}"
    (folder / "table.md").write_text(f"# Two arms push a disc along a circle, open loop\n\n{text}")
    bimanual_figure.write(folder, plans, tasks, runs)
    print(f"{text}\n{count} plans of each kind; results in {folder}")
    missed = missed_targets(summary)
    return print_verdict(not missed, "; ".join(missed) or "robust plans hold in rollouts and on the arms")


def summarise(
    plans: dict[tuple[str, float, int], PlanResult], tasks: list[RunTask], runs: list[RunResult]
) -> dict[str, Any]:
    """The figures of the experiment."""

    def rollout_success(name: str, radius: float) -> float:
        model = next(v.model for v in VARIANTS if v.name == name)
        found = [plan.success[model] for (n, r, _), plan in plans.items() if n == name and r == radius]
        return float(np.mean(found))

    def seconds(name: str) -> float | None:
        return quantile([plan.seconds for (n, _, _), plan in plans.items() if n == name], 0.5)

    mine = [run for task, run in zip(tasks, runs, strict=True) if task.variant.name == "robust_friction"]
    wins = sum(run.success for run in mine)
    return {
        "experiment": "bimanual",
        "rollout_success_r5": rollout_success("robust_friction", 0.05),
        "rollout_success_r3": rollout_success("robust_friction", 0.03),
        "rollout_success_r5_thesis_model": rollout_success("robust_thesis", 0.05),
        "rollout_success_r3_thesis_model": rollout_success("robust_thesis", 0.03),
        "baseline_rollout_success_r5": rollout_success("baseline", 0.05),
        "baseline_rollout_success_r3": rollout_success("baseline", 0.03),
        "mujoco_success": wins,
        "mujoco_runs": len(mine),
        "mujoco_ci95": success_interval(wins, len(mine)) if mine else None,
        "mujoco_by_planner": {
            v.name: [
                sum(r.success for t, r in zip(tasks, runs, strict=True) if t.variant == v),
                sum(t.variant == v for t in tasks),
            ]
            for v in VARIANTS
        },
        "largest_deviation_m": max((run.deviation for run in mine), default=None),
        "arm_contacts": sum(run.arm_contacts for run in mine),
        "limit_violations": sum(run.limit_violations for run in mine),
        "limit_violations_others": sum(run.limit_violations for run in runs)
        - sum(run.limit_violations for run in mine),
        "plan_s_p50": seconds("robust_thesis"),
        "plan_s_p50_rich": seconds("robust_friction"),
    }


def missed_targets(summary: dict[str, Any]) -> list[str]:
    """What falls short, in words."""
    checks = {
        f"rollouts r = 5 cm {summary['rollout_success_r5']:.3f}, asked 0.97":
            summary["rollout_success_r5"] >= 0.97,
        f"rollouts r = 3 cm {summary['rollout_success_r3']:.3f}, asked 0.97":
            summary["rollout_success_r3"] >= 0.97,
        f"on the arms {summary['mujoco_success']} of {summary['mujoco_runs']}":
            summary["mujoco_success"] == summary["mujoco_runs"] > 0,
        f"baseline's rollouts {summary['baseline_rollout_success_r5']:.2f}: no worse than robust plans":
            summary["baseline_rollout_success_r5"] < 0.5,
        f"{summary['arm_contacts']} instants with arms in contact": summary["arm_contacts"] == 0,
        f"{summary['limit_violations']} limit violations": summary["limit_violations"] == 0,
        f"planning {summary['plan_s_p50']:.2f} s with the thesis's model, asked 0.5 s":
            summary["plan_s_p50"] <= 0.5,
        f"planning {summary['plan_s_p50_rich']:.2f} s with friction, asked 1.5 s":
            summary["plan_s_p50_rich"] <= 1.5,
    }  # fmt: skip
    return [text for text, good in checks.items() if not good]


def plan_table(plans: dict[tuple[str, float, int], PlanResult]) -> str:
    """Plans by planner and radius."""
    header = [
        "planner", "r", "reached", "rollouts: thesis's model", "with friction", "worst plan", "duration",
        "plans made", "planning", "horizons braked",
    ]  # fmt: skip
    rows = []
    for variant in VARIANTS:
        for radius in sorted(set(OBJECTS.values()), reverse=True):
            mine = [p for (n, r, _), p in plans.items() if n == variant.name and r == radius]
            own = [p.success[variant.model] for p in mine]
            rows.append([
                variant.title, f"{100 * radius:.0f} cm", f"{sum(p.reached for p in mine)} of {len(mine)}",
                *(f"{100 * np.mean([p.success[model] for p in mine]):.1f} %" for model in MODELS),
                f"{100 * min(own):.1f} %", f"{np.median([p.motion.duration for p in mine]):.0f} s",
                f"{np.mean([p.attempts for p in mine]):.2f}", f"{np.median([p.seconds for p in mine]):.2f} s",
                f"{100 * sum(p.violating for p in mine) / sum(p.horizons for p in mine):.1f} %",
            ])  # fmt: skip
    return markdown_table(header, rows)


def run_table(tasks: list[RunTask], runs: list[RunResult]) -> str:
    """Runs on the arms by planner and plan."""
    header = ["planner", "plan", *OBJECTS, "largest deviation", "largest final error"]
    rows = []
    for variant in VARIANTS:
        for plan in sorted({task.plan for task in tasks}):
            mine = [
                (t, r) for t, r in zip(tasks, runs, strict=True) if t.variant == variant and t.plan == plan
            ]
            cells = [[r.success for t, r in mine if t.name == name] for name in OBJECTS]
            rows.append([
                variant.title, str(plan), *(f"{sum(cell)} of {len(cell)}" for cell in cells),
                f"{1e3 * max(r.deviation for _, r in mine):.0f} mm",
                f"{1e3 * max(r.final_error for _, r in mine):.0f} mm",
            ])  # fmt: skip
    return markdown_table(header, rows)
