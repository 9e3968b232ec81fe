"""Every option of the search against its alternatives, one varied at a time round the default.

Single searches have a fixed budget of evaluations, so that a larger population means fewer iterations.
Replanning runs online VP-STO (4.4) through the plane with obstacles, with and without moving discs, at the
same number of evaluations per step. How long before a deadline to stop is compared on simulated time.
The verdict is that no alternative is clearly better than a default on any problem without being possibly
worse on another, or slower.
"""

import argparse
import math
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np

from sim_bridge.experiments.clutter import mpc_runs
from sim_bridge.experiments.runs import (
    Execution,
    markdown_table,
    print_verdict,
    run_trials,
    success_interval,
    write_summary,
)
from sim_bridge.experiments.search import deadline, figure, problems
from sim_bridge.experiments.search.statistics import Sample, dominates
from sim_bridge.experiments.search.variants import (
    OFFLINE,
    REPLANNING,
    RESERVES,
    STEP_EVALUATIONS,
    Choice,
    online_config,
    search_config,
)

START = "start_0.10_0.20"
WORLDS = {"standing": "obstacles that stand", "moving": "and moving discs"}
Rows = dict[tuple[str, str], dict[str, Sample]]
"""Samples by problem, by the names of choice and value."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Fewer runs by default than for other experiments: every one is repeated for over a hundred values."""
    parser.set_defaults(runs=20)


def run(arguments: argparse.Namespace) -> int:
    """Compare and print the tables; 0 when the defaults hold."""
    execution, folder = Execution.from_arguments(arguments), pathlib.Path(arguments.out)
    seeds = list(range(arguments.seed, arguments.seed + arguments.runs))
    searches = compare_searches(seeds, execution)
    replanning = compare_replanning(seeds, execution)
    reserves = compare_reserves(seeds, execution)
    better = beaten(OFFLINE, searches) + beaten(REPLANNING, replanning) + late(reserves)
    folder.mkdir(parents=True, exist_ok=True)
    titles = {name: posed.title for name, posed in problems.problems().items()}
    tables = [
        sample_table(OFFLINE, searches, titles),
        sample_table(REPLANNING, replanning, WORLDS),
        reserve_table(reserves),
    ]
    text = "\n".join(tables)
    (folder / "table.md").write_text(text)
    write_summary(folder, {
        "experiment": "search", "seed": arguments.seed, "runs": arguments.runs,
        "searches": summaries(searches), "replanning": summaries(replanning), "deadline": reserves,
        "better_than_the_default": better,
    })  # fmt: skip
    rows, choices = searches | replanning, (*OFFLINE, *REPLANNING)
    figure.draw(folder / "search.png", choices, rows, titles | WORLDS)
    print(f"{text}\nresults in {folder}")
    for line in better:
        print(f"better than the default: {line}")
    return print_verdict(not better, "no value is better than the default of its option")


def compare_searches(seeds: list[int], execution: Execution) -> Rows:
    """Single searches with a budget of evaluations."""

    def tasks(changes: dict[str, Any], problem: str) -> list[problems.Task]:
        return [problems.Task(problem, "search", search_config(changes), seed) for seed in seeds]

    rows = [(c, value, problem) for c in OFFLINE for value in c.values for problem in c.problems]
    every = {(c.name, value, problem): tasks(c.values[value], problem) for c, value, problem in rows}
    results = _results(problems.run_task, every, execution, "searches")
    best = {name: posed.optimum or math.inf for name, posed in problems.problems().items()}
    for (_, _, problem), outcomes in results.items():
        if not problems.problems()[problem].optimum:
            best[problem] = min([best[problem], *(outcome.cost for outcome in outcomes)])
    found: Rows = {}
    for (choice, value, problem), outcomes in results.items():
        found.setdefault((choice, value), {})[problem] = Sample(
            np.array([outcome.cost / best[problem] - 1.0 for outcome in outcomes]),
            float(np.median([outcome.evaluations for outcome in outcomes])),
            float(np.median([outcome.seconds for outcome in outcomes])),
        )
    return found


def compare_replanning(seeds: list[int], execution: Execution) -> Rows:
    """Online VP-STO to the goal; the cost is the time until it is reached, relative to the seed's fastest."""

    def tasks(changes: dict[str, Any], world: str) -> list[mpc_runs.Task]:
        config = online_config(changes)
        return [mpc_runs.Task(config, "vpsto", START, world == "moving", seed) for seed in seeds]

    rows = [(c, value, world) for c in REPLANNING for value in c.values for world in WORLDS]
    every = {(c.name, value, world): tasks(c.values[value], world) for c, value, world in rows}
    results = _results(time_to_goal, every, execution, "replanning")
    fastest = {
        world: np.min([[t for t, _ in runs] for (_, _, w), runs in results.items() if w == world], axis=0)
        for world in WORLDS
    }
    found: Rows = {}
    for (choice, value, world), runs in results.items():
        times = np.array([t for t, _ in runs])
        # A seed that nobody solves says nothing about the options; it counts as a failure of all of them.
        best = np.where(np.isfinite(fastest[world]), fastest[world], 1.0)
        found.setdefault((choice, value), {})[world] = Sample(
            times / best - 1.0, STEP_EVALUATIONS, float(np.median([seconds for _, seconds in runs]))
        )
    return found


def time_to_goal(task: mpc_runs.Task) -> tuple[float, float]:
    """Time to the goal [s], inf if it is not reached or something is hit, and processor time of a step."""
    result = mpc_runs.run_task(task)
    reached = result.time_to_goal if result.success and result.time_to_goal is not None else math.inf
    return reached, float(np.median(result.step_seconds))


def compare_reserves(seeds: list[int], execution: Execution) -> dict[str, dict[str, Any]]:
    """How often a search comes back late, and how many iterations it gets done."""
    found = {}
    tasks = {name: [deadline.DeadlineTask(name, seed) for seed in seeds] for name in RESERVES.values}
    results = _results(deadline.run_task, tasks, execution, "deadlines")
    for name, outcomes in results.items():
        overrun = np.concatenate([outcome.overrun for outcome in outcomes])
        count = int((overrun > 0.0).sum())
        found[name] = {
            "searches": len(overrun),
            "late": count,
            "late_interval": success_interval(count, len(overrun)),
            "overrun_p99_ms": 1e3 * float(np.quantile(overrun, 0.99)),
            "iterations_mean": float(np.mean([outcome.iterations.mean() for outcome in outcomes])),
        }
    return found


def _results(
    trial: Callable[[Any], Any], tasks: dict[Any, list[Any]], execution: Execution, label: str
) -> dict[Any, list[Any]]:
    """Results by row; a task that several rows share, as those of the defaults do, runs once."""
    unique = list(dict.fromkeys(task for row in tasks.values() for task in row))
    by_task = dict(zip(unique, run_trials(trial, unique, execution, label), strict=True))
    return {name: [by_task[task] for task in row] for name, row in tasks.items()}


def default_value(choice: Choice) -> str:
    """The name of the default's own value."""
    return next(name for name, changes in choice.values.items() if not changes)


def beaten(choices: tuple[Choice, ...], rows: Rows) -> list[str]:
    """Values that should replace the default of their option."""
    return [
        f"{choice.name} = {value}"
        for choice in choices
        for value, changes in choice.values.items()
        if changes and dominates(rows[choice.name, value], rows[choice.name, default_value(choice)])
    ]


def late(reserves: dict[str, dict[str, Any]]) -> list[str]:
    """Values that keep the deadline clearly more often than the default."""
    bound = reserves[default_value(RESERVES)]["late_interval"][0]
    return [f"{RESERVES.name} = {name}" for name, row in reserves.items() if row["late_interval"][1] < bound]


def summaries(rows: Rows) -> list[dict[str, Any]]:
    """One entry per choice, value and problem."""
    return [
        {"choice": choice, "value": value, "problem": problem, **sample.summary()}
        for (choice, value), samples in rows.items()
        for problem, sample in samples.items()
    ]


def sample_table(choices: tuple[Choice, ...], rows: Rows, titles: dict[str, str]) -> str:
    """Median gap to the best known with its 95 % interval, successes, and processor time, by problem."""
    shown = [name for name in titles if any(name in samples for samples in rows.values())]
    body = []
    for choice in choices:
        for value, changes in choice.values.items():
            samples = rows[choice.name, value]
            cells = [_cell(samples[name]) if name in samples else "" for name in shown]
            body.append([choice.name, value if changes else f"**{value}** (default)", *cells])
    return markdown_table(["option", "value", *(titles[name] for name in shown)], body)


def _cell(sample: Sample) -> str:
    middle, low, high = (
        f"{100.0 * value:.2f}" if math.isfinite(value) else "fails" for value in sample.median()
    )
    failed = len(sample.gaps) - sample.successes
    valid = f", {failed} of {len(sample.gaps)} failed" if failed else ""
    return f"{middle} % ({low} to {high}){valid}; {1e3 * sample.seconds:.1f} ms"


def reserve_table(reserves: dict[str, dict[str, Any]]) -> str:
    """The table of deadlines."""
    return markdown_table(
        [RESERVES.name, "late (95 % interval)", "p99 overrun", "iterations"],
        [
            [
                f"**{name}** (default)" if name == default_value(RESERVES) else name,
                f"{100.0 * row['late'] / row['searches']:.1f} % "
                f"({100.0 * row['late_interval'][0]:.1f} to {100.0 * row['late_interval'][1]:.1f})",
                f"{row['overrun_p99_ms']:.2f} ms",
                f"{row['iterations_mean']:.1f}",
            ]
            for name, row in reserves.items()
        ],
    )
