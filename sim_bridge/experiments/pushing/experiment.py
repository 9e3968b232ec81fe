"""An experiment on pushing: variants of the planner on the same trials, a table, figures, summary.json."""

import argparse
import dataclasses
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sim_bridge.experiments.pushing.loop import PushingLoop
from sim_bridge.experiments.pushing.trials import Trial, TrialResult, run_trial, simulate, start_joints
from sim_bridge.experiments.runs import (
    Execution,
    markdown_table,
    print_verdict,
    quantile,
    run_trials,
    success_interval,
    write_summary,
)
from sim_bridge.warm_up import push_a_box
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.contact.pushing import PushingModel
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.planning.contact import ContactPlannerConfig, PushContactPlanner
from vpsto_ros.planning.pushing import PushingMpc
from vpsto_ros.planning.pushing_config import PushingMpcConfig
from vpsto_ros.robot.kinematics import fr3_pusher

TOOL_RADIUS = 0.015


@dataclasses.dataclass(frozen=True)
class Variant:
    """A planner to try: a name, what it is, its options, its class, and whether it is told where to touch."""

    name: str
    title: str
    config: PushingMpcConfig
    planner: type[PushingMpc] = PushingMpc
    contact_planner: bool = True


def run_variant(task: tuple[Variant, Trial]) -> TrialResult:
    """One closed-loop run of one variant."""
    variant, trial = task
    model = PushingModel(trial.plant.shape, PlanarShape.disc(TOOL_RADIUS))
    planner = variant.planner(variant.config, model, fr3_pusher(), np.random.default_rng([trial.seed, 2]))
    planner.warm_up()
    simulation = simulate(trial, start_joints(planner.table_map, trial.start, trial.plant.shape))
    contact_planner = PushContactPlanner(ContactPlannerConfig(), model) if variant.contact_planner else None
    loop = PushingLoop(simulation, planner, contact_planner, lambda now: trial.planar_goal)
    return run_trial(trial, loop, variant.config.workspace)


@dataclasses.dataclass(frozen=True)
class Targets:
    """What the planner has to reach for the experiment to pass; times in seconds."""

    success_rate: float
    median_time_to_goal: float = np.inf
    replan_p99: float = np.inf

    def missed(self, summary: dict[str, Any]) -> list[str]:
        """What a summary falls short of, in words."""
        median = summary["time_to_goal_s_median"]
        checks = {
            f"success rate {summary['success_rate']:.2f}, asked {self.success_rate}":
                summary["success_rate"] >= self.success_rate,
            f"median time to goal {median} s, asked {self.median_time_to_goal} s":
                (median or np.inf) <= self.median_time_to_goal,
            f"p99 of replanning {summary['compute_ms']['p99']:.1f} ms, asked {1e3 * self.replan_p99:.0f} ms":
                summary["compute_ms"]["p99"] <= 1e3 * self.replan_p99,
            f"{summary['limit_violations']} limit violations": summary["limit_violations"] == 0,
            f"the object left the workspace in {summary['left_workspace']} runs":
                summary["left_workspace"] == 0,
            f"planned tool height off by {1e3 * summary['planned_height_error_m_max']:.1f} mm, asked 5 mm":
                summary["planned_height_error_m_max"] <= 0.005,
        }  # fmt: skip
        return [text for text, good in checks.items() if not good]


@dataclasses.dataclass(frozen=True)
class PushingExperiment:
    """What is run, on which trials, and what must come out."""

    name: str
    title: str
    random_trial: Callable[[int], Trial]
    variants: tuple[Variant, ...]
    targets: Targets

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Options of this experiment."""
        names = [variant.name for variant in self.variants]
        parser.add_argument(
            "--only",
            action="append",
            metavar="VARIANT",
            help=f"run only this variant, may be repeated; one of: {', '.join(names)}",
        )

    def run(self, arguments: argparse.Namespace) -> int:
        """Run all variants on the same trials, write the results; 0 when the first reaches its targets."""
        folder = pathlib.Path(arguments.out)
        folder.mkdir(parents=True, exist_ok=True)
        trials = [self.random_trial(seed) for seed in range(arguments.seed, arguments.seed + arguments.runs)]
        variants = self._chosen(arguments.only)
        tasks = [(variant, trial) for variant in variants for trial in trials]
        execution = Execution.from_arguments(arguments)
        runs = run_trials(run_variant, tasks, execution, self.name, warm_up=push_a_box)
        results = {
            variant.name: runs[k * len(trials) : (k + 1) * len(trials)] for k, variant in enumerate(variants)
        }
        return self._report(folder, trials, results)

    def _chosen(self, names: Sequence[str] | None) -> list[Variant]:
        known = {variant.name: variant for variant in self.variants}
        for name in names or ():
            if name not in known:
                raise ConfigurationError(f"--only {name}: no such variant; there are {', '.join(known)}")
        return [variant for variant in self.variants if not names or variant.name in names]

    def _report(
        self, folder: pathlib.Path, trials: list[Trial], results: dict[str, list[TrialResult]]
    ) -> int:
        from sim_bridge.experiments.pushing import figures

        summaries = {name: summarise(runs) for name, runs in results.items()}
        first, *others = summaries
        summary: dict[str, Any] = {"experiment": self.name, "seed": trials[0].seed, **summaries[first]}
        summary["baselines"] = {name: summaries[name] for name in others}
        write_summary(folder, summary)
        titles = {variant.name: variant.title for variant in self.variants}
        table = results_table(titles, summaries)
        (folder / "table.md").write_text(f"# {self.title}\n\n{table}")
        figures.write(folder, titles, trials, results)
        print(f"{self.title}\n\n{table}\nresults in {folder}")
        missed = self.targets.missed(summaries[first])
        return print_verdict(not missed, f"{titles[first]}: {'; '.join(missed) or 'all targets reached'}")


def summarise(runs: list[TrialResult]) -> dict[str, Any]:
    """The figures of one variant."""
    successes = sum(run.success for run in runs)
    times = [run.time_to_goal for run in runs]
    compute = 1e3 * np.concatenate([run.compute for run in runs])
    return {
        "runs": len(runs),
        "success_rate": successes / len(runs),
        "success_ci95": success_interval(successes, len(runs)),
        "limit_violations": sum(run.limit_violations for run in runs),
        "left_workspace": sum(run.left_workspace for run in runs),
        "time_to_goal_s_median": quantile(times, 0.5),
        "time_to_goal_s_p90": quantile(times, 0.9),
        "time_to_goal_before_knock_s_median": quantile((run.time_to_goal_before_knock for run in runs), 0.5),
        "final_error_m_median": quantile((run.final_error for run in runs), 0.5),
        "planned_height_error_m_max": max(run.planned_height_error for run in runs),
        "tool_height_error_m_max": max(run.tool_height_error for run in runs),
        "rejected_trajectories": sum(run.rejected for run in runs),
        "late_plans": int((compute > 40.0).sum()),
        "compute_ms": {
            "p50": quantile(compute, 0.5),
            "p99": quantile(compute, 0.99),
            "max": float(compute.max()),
        },
        "failed_seeds": [run.seed for run in runs if not run.success],
    }


def results_table(titles: dict[str, str], summaries: dict[str, dict[str, Any]]) -> str:
    """The table that goes into the README."""
    header = [
        "planner",
        "success",
        "95 % CI",
        "time to goal, median / p90",
        "left workspace",
        "limits broken",
        "replan p99",
    ]
    rows = []
    for name, s in summaries.items():
        low, high = s["success_ci95"]
        times = [s["time_to_goal_s_median"], s["time_to_goal_s_p90"]]
        rows.append([
            titles[name], f"{round(s['success_rate'] * s['runs'])} of {s['runs']}", f"{low:.3f}-{high:.3f}",
            " / ".join("-" if t is None else f"{t:.1f}" for t in times) + " s",
            f"{s['left_workspace']}", f"{s['limit_violations']}", f"{s['compute_ms']['p99']:.1f} ms",
        ])  # fmt: skip
    return markdown_table(header, rows)
