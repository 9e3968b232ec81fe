"""Fig. 6.13: receding-horizon BS-VP-STO with few iterations, without the contact prior, in 14 joints.

Two balls push a disc of 5 cm along a circle of 10 cm radius, with the thesis's model. A run succeeds when the
mean of the belief is within 1 cm of the end of the path within 500 horizons. Here a horizon without a valid
candidate is never executed: the arms brake. The thesis executes nothing of the kind either but counts such a
plan as invalid; runs without any such horizon are reported apart. Every finished plan is also rolled out 1000
times with noise and fresh particles.
"""

import argparse
import dataclasses
import pathlib
from typing import Any

import numpy as np

from sim_bridge.experiments.belief import belief_ablation_figure, bimanual
from sim_bridge.experiments.belief.models import THESIS, mean_text
from sim_bridge.experiments.runs import (
    Execution,
    markdown_table,
    print_verdict,
    run_trials,
    success_interval,
    write_summary,
)
from vpsto_ros.optimization.vpsto import VpstoConfig
from vpsto_ros.planning.belief_space.config import RobustPushingConfig

ITERATIONS = (1, 2, 3, 4, 6, 8, 12, 16)
CURVES = {
    "prior": "4 coordinates, contact prior",
    "no_prior": "4 coordinates, no contact prior (Q_q = 0)",
    "dof14": "14 joints, contact prior",
}
HORIZONS = 500
ROLLOUTS, STEP, NEAR = 1000, 0.02, 0.02
"""Rollouts of a plan, their step [s], and how near to the end of the path the disc shall come in them [m]."""
REQUIRED_PRIOR, REQUIRED_JOINTS, CLEARLY_LOWER = 0.98, 0.95, 0.5


@dataclasses.dataclass(frozen=True)
class Task:
    """One plan: which curve, how many iterations, which seed; how many horizons at most."""

    curve: str
    iterations: int
    seed: int
    horizons: int


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What came of it.

    Attributes:
        reached: whether the mean got within 1 cm of the end of the path.
        horizons: how many were planned.
        violating: how many of them had no valid candidate and braked.
        seconds: planning time [s].
        near: share of the noisy rollouts that end within 2 cm of the end, None for a plan that fell short.
        aside: median over these of the largest distance from the path [m].
    """

    reached: bool
    horizons: int
    violating: int
    seconds: float
    near: float | None = None
    aside: float | None = None


def solve(task: Task) -> Outcome:
    """Plan once around the circle and roll the plan out."""
    rng = np.random.default_rng([task.seed, list(CURVES).index(task.curve)])
    joints = task.curve == "dof14"
    config = RobustPushingConfig(
        contact_prior=task.curve != "no_prior",
        search=VpstoConfig(population=30, iterations=task.iterations, strategy="cma"),
    )
    planner = bimanual.pusher(config, THESIS, joints=joints, rng=rng)
    start, prior = bimanual.start(joints), bimanual.belief(config.particles, rng)
    plan = planner.plan(start, prior, bimanual.TARGET, horizons=task.horizons)
    outcome = Outcome(plan.reached, plan.horizons, plan.violating, plan.seconds)
    if not plan.reached or plan.trajectory is None:
        return outcome
    motion = plan.trajectory
    times = np.linspace(motion.start_time, motion.end_time, max(2, round(motion.duration / STEP)))
    path = planner.space.plane(motion(times)[None])[0][0]
    rollout = planner.dynamics.simulate(bimanual.belief(ROLLOUTS, rng), path, rng, stride=20)
    final = rollout.belief.poses[:, :2] - bimanual.TARGET.points[-1]
    aside = bimanual.TARGET.distances(rollout.poses[..., :2]).max(axis=0)
    return dataclasses.replace(
        outcome, near=float((np.hypot(*final.T) <= NEAR).mean()), aside=float(np.median(aside))
    )


def warm_up() -> None:
    """Compile what plans use."""
    for curve in CURVES:
        solve(Task(curve, 1, 0, 2))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Fifty runs for every point of every curve unless asked otherwise."""
    parser.set_defaults(runs=50)


def run(arguments: argparse.Namespace) -> int:
    """Plan for every point of every curve; 0 when the success rates are as high as in the thesis."""
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    points = [(curve, iterations) for curve in CURVES for iterations in ITERATIONS]
    tasks = [Task(*point, seed, HORIZONS) for point in points for seed in seeds]
    found = run_trials(solve, tasks, Execution.from_arguments(arguments), "belief_ablation", warm_up)
    outcomes = {point: found[i * len(seeds) : (i + 1) * len(seeds)] for i, point in enumerate(points)}
    rows = {curve: {m: summarise(outcomes[curve, m]) for m in ITERATIONS} for curve in CURVES}
    best, best_m = max((rows["dof14"][m]["success"], -m) for m in ITERATIONS)
    prior, bare = rows["prior"][4]["success"], rows["no_prior"][4]["success"]
    summary = {
        "experiment": "belief_ablation",
        "seed": arguments.seed,
        "runs": arguments.runs,
        "prior_m4": prior,
        "no_prior_m4": bare,
        "dof14_best": best,
        "dof14_best_m": -best_m,
        "curves": {curve: {str(m): row for m, row in each.items()} for curve, each in rows.items()},
    }
    folder = pathlib.Path(arguments.out)
    write_summary(folder, summary)
    text = table(outcomes)
    (folder / "table.md").write_text(text)
    belief_ablation_figure.write(folder / "belief_ablation.png", rows)
    print(f"{text}\nresults in {folder}")
    missed = missed_targets(summary)
    return print_verdict(not missed, "; ".join(missed or _checks(summary)))


def missed_targets(summary: dict[str, Any]) -> list[str]:
    """What falls short, in words."""
    return [text for text, good in _checks(summary).items() if not good]


def _checks(summary: dict[str, Any]) -> dict[str, bool]:
    """What is compared with its target, in words, and whether it is as asked."""
    prior, bare, joints = summary["prior_m4"], summary["no_prior_m4"], summary["dof14_best"]
    return {
        f"with 4 iterations {100 * prior:.0f} % reach the goal (at least {100 * REQUIRED_PRIOR:.0f} %)":
            prior >= REQUIRED_PRIOR,
        f"{100 * bare:.0f} % without the contact prior (at most half of {100 * prior:.0f} %)":
            bare <= CLEARLY_LOWER * prior,
        f"in 14 joints {100 * joints:.0f} % with {summary['dof14_best_m']} iterations (at least "
        f"{100 * REQUIRED_JOINTS:.0f} % with at most {max(ITERATIONS)})": joints >= REQUIRED_JOINTS,
    }  # fmt: skip


def summarise(runs: list[Outcome]) -> dict[str, Any]:
    """Rates with Wilson's intervals, and what the finished plans do in noisy rollouts."""
    count = len(runs)
    reached, clean = sum(r.reached for r in runs), sum(r.reached and not r.violating for r in runs)
    near = [r.near for r in runs if r.near is not None]
    horizons = sum(r.horizons for r in runs)
    return {
        "success": reached / count,
        "success_interval": success_interval(reached, count),
        "success_without_violation": clean / count,
        "success_without_violation_interval": success_interval(clean, count),
        "violating_share": sum(r.violating for r in runs) / max(horizons, 1),
        "horizons_p50": float(np.median([r.horizons for r in runs])),
        "planning_s_p50": float(np.median([r.seconds for r in runs])),
        "rollouts_near": float(np.mean(near)) if near else None,
        "aside_m_p50": float(np.median([r.aside for r in runs if r.aside is not None])) if near else None,
    }


def table(outcomes: dict[tuple[str, int], list[Outcome]]) -> str:
    """One row per curve and number of iterations."""
    header = [
        "search", "M", "reached (95 %)", "and no violating horizon", "violating horizons", "horizons",
        "planning time", "rollouts within 2 cm (95 %)", "largest distance from the path",
    ]  # fmt: skip
    body = []
    for (curve, iterations), runs in outcomes.items():
        row, near = summarise(runs), [r.near for r in runs if r.near is not None]
        body.append([
            CURVES[curve], f"{iterations}", _rate(row, "success"), _rate(row, "success_without_violation"),
            f"{100 * row['violating_share']:.1f} %", f"{row['horizons_p50']:.0f}",
            f"{row['planning_s_p50']:.2f} s", f"{mean_text(near, 100.0, '.1f')} %" if near else "-",
            f"{1e3 * row['aside_m_p50']:.0f} mm" if near else "-",
        ])  # fmt: skip
    return markdown_table(header, body) + "\nHorizons, time and distance are medians.\n"


def _rate(row: dict[str, Any], name: str) -> str:
    low, high = row[f"{name}_interval"]
    return f"{100 * row[name]:.0f} % ({100 * low:.0f}-{100 * high:.0f})"
