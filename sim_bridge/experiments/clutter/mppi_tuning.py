"""How good the settings of the sampling MPC are: each horizon with its settings varied one at a time.

Only on seeds from 1000 on, which no reported figure uses. From a start in the bay that the obstacle L forms,
and from an open one.
"""

import argparse
import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from sim_bridge.experiments.clutter.mpc_runs import Result, Task, run_task
from sim_bridge.experiments.clutter.mppi import MppiConfig
from sim_bridge.experiments.runs import (
    Execution,
    markdown_table,
    print_verdict,
    quantile,
    run_trials,
    write_summary,
)
from sim_bridge.warm_up import plan_in_clutter

FIRST_SEED, RUNS, LONGEST = 1000, 8, 12.0
"""First seed, most runs per setting and start, and the end of a run [s]."""

STARTS = ("start_0.10_0.20", "open")

LUCK = 0.002
"""Below this probability a difference is not luck; small, since there are 90 comparisons."""

CHOSEN = "chosen"


def variations(chosen: MppiConfig) -> dict[str, MppiConfig]:
    """The chosen setting and others that differ from it in one thing, by what differs."""
    change = dataclasses.replace
    found = {CHOSEN: chosen}
    for name, factors in (("temperature", (0.1, 10.0)), ("noise", (0.5, 2.0)), ("terminal", (0.0, 4.0))):
        for factor in factors:
            value = factor * getattr(chosen, name)
            found[f"{name} {value:.3g}"] = change(chosen, **{name: value})
    found["accelerations"] = change(chosen, accelerations=True)
    found["accelerations, twice the noise"] = change(chosen, accelerations=True, noise=2.0 * chosen.noise)
    return found


def run(arguments: argparse.Namespace, chosen: Mapping[float, MppiConfig]) -> int:
    """Run all variations; 0 when none is clearly better than the chosen setting of its horizon.

    Args:
        arguments: those of every experiment; seeds begin at 1000 at least, and at most eight are used.
        chosen: settings by horizon [s].
    """
    first = max(arguments.seed, FIRST_SEED)
    seeds = range(first, first + min(arguments.runs, RUNS))
    settings = {(horizon, name): c for horizon in chosen for name, c in variations(chosen[horizon]).items()}
    tasks = [
        Task(config, f"horizon {horizon} s, {name}", start, False, seed, LONGEST)
        for (horizon, name), config in settings.items()
        for start in STARTS
        for seed in seeds
    ]
    execution = Execution.from_arguments(arguments)
    results = iter(run_trials(run_task, tasks, execution, "mppi_tuning", plan_in_clutter))
    figures = {
        setting: {start: _figures([next(results) for _ in seeds]) for start in STARTS} for setting in settings
    }
    return _report(pathlib.Path(arguments.out), figures, seeds)


def _figures(results: list[Result]) -> dict[str, Any]:
    """Runs at the goal without collision, and their median time to it."""
    times = [result.time_to_goal if result.success else None for result in results]
    return {
        "runs": len(results),
        "times_s": times,
        "successes": sum(result.success for result in results),
        "time_to_goal_s": quantile(times, 0.5),
    }


Figures = dict[tuple[float, str], dict[str, dict[str, Any]]]


def _report(folder: pathlib.Path, figures: Figures, seeds: range) -> int:
    rows = [
        [f"{horizon} s", name, *(_cell(each[start]) for start in STARTS)]
        for (horizon, name), each in figures.items()
    ]
    table = markdown_table(["horizon", "setting", *(f"from {start}" for start in STARTS)], rows)
    listed = [{"horizon_s": horizon, "setting": name, **each} for (horizon, name), each in figures.items()]
    better = clearly_better(figures)
    summary = {"experiment": "clutter_2d_mpc --tune", "seed": seeds.start, "runs": len(seeds)}
    write_summary(folder, {**summary, "settings": listed, "clearly_better": better})
    (folder / "table.md").write_text(table)
    print(f"The sampling MPC with one setting changed at a time, seeds from {seeds.start} on\n\n{table}")
    print(f"results in {folder}")
    return print_verdict(not better, "; ".join(better) or "no change of one setting is clearly better")


def _cell(figures: dict[str, Any]) -> str:
    time = figures["time_to_goal_s"]
    return f"{figures['successes']} of {figures['runs']}" + ("" if time is None else f", {time:.2f} s")


def clearly_better(figures: Figures) -> list[str]:
    """Settings that beat the chosen one of their horizon, in words.

    Better is as many successes from every start, and times to the goal that are less from one of them by
    more than luck explains: a rank test in which a failure takes for ever. Fewer than six runs show nothing.
    """
    found = []
    for (horizon, name), each in figures.items():
        if name == CHOSEN:
            continue
        reference = figures[horizon, CHOSEN]
        as_sure = all(each[start]["successes"] >= reference[start]["successes"] for start in STARTS)
        if as_sure and min(_luck(each[start], reference[start]) for start in STARTS) < LUCK:
            found.append(f"horizon {horizon} s is better with {name}")
    return found


def _luck(figures: dict[str, Any], reference: dict[str, Any]) -> float:
    """Probability of times so much less than the reference's if the setting made no difference."""
    from scipy.stats import mannwhitneyu  # takes a second to load, which every worker would spend

    ours, others = ([np.inf if t is None else t for t in f["times_s"]] for f in (figures, reference))
    return float(mannwhitneyu(ours, others, alternative="less").pvalue)
