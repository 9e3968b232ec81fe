"""Every option of the search against its alternatives, one varied at a time round the setting in use.

Single searches have a fixed budget of evaluations, so that a larger population means fewer iterations.
Replanning runs online VP-STO (4.4) through the plane with obstacles, with and without moving discs, at the
same number of evaluations per step. Reaching moves an arm through random cells. How long before a deadline to
stop is a trade of cost against punctuality, on simulated time.

The setting in use is the default, or that of an experiment where it differs: every row says whose it is. The
verdict is that no alternative is clearly better on any problem without being possibly worse on another, or
slower.
"""

import argparse
import dataclasses
import math
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.clutter import mpc_runs
from sim_bridge.experiments.runs import Execution, print_verdict, run_trials, write_summary
from sim_bridge.experiments.search import deadline, figure, problems, reach, variants
from sim_bridge.experiments.search.problems import Result
from sim_bridge.experiments.search.statistics import Rows, Sample, dominates
from sim_bridge.experiments.search.tables import reserve_table, sample_table, summaries
from sim_bridge.experiments.search.variants import Choice, changed
from sim_bridge.warm_up import plan_in_clutter

START = "start_0.10_0.20"
WORLDS = {"standing": "obstacles that stand", "moving": "and moving discs"}


@dataclasses.dataclass(frozen=True)
class Group:
    """Choices that are compared by the same kind of trial.

    Attributes:
        label: for messages.
        choices: what is compared.
        titles: of the problems, by name.
        trial: from task to :class:`Result`, at module level.
        task: from choice, changes, problem and seed to a task.
        best: from a problem and its costs (rows, seeds) to the best known cost (seeds,).
        warm_up: what the trials use, at module level.
    """

    label: str
    choices: tuple[Choice, ...]
    titles: dict[str, str]
    trial: Callable[[Any], Result]
    task: Callable[[Choice, dict[str, Any], str, int], Any]
    best: Callable[[str, NDArray], NDArray]
    warm_up: Callable[[], None]


def groups() -> tuple[Group, ...]:
    """Everything that is compared."""
    searched = {name: posed.title for name, posed in problems.problems().items()}
    return (
        Group(
            "searches", variants.OFFLINE, searched, problems.run_task, search_task, known_optimum,
            problems.warm_up,
        ),
        Group(
            "replanning", variants.REPLANNING, WORLDS, time_to_goal, replanning_task, best_of_seed,
            plan_in_clutter,
        ),
        Group(
            "reaching", variants.REACHING, reach.TITLES, reach.run_task, reach_task, best_of_seed,
            reach.warm_up,
        ),
    )  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Fewer runs by default than for other experiments: every one is repeated for over a hundred values."""
    parser.set_defaults(runs=20)


def run(arguments: argparse.Namespace) -> int:
    """Compare and print the tables; 0 when the settings in use hold."""
    execution, folder = Execution.from_arguments(arguments), pathlib.Path(arguments.out)
    seeds = list(range(arguments.seed, arguments.seed + arguments.runs))
    compared = {group.label: group for group in groups()}
    rows = {label: compare(group, seeds, execution) for label, group in compared.items()}
    reserves = compare_reserves(seeds, execution)
    better = [line for label, group in compared.items() for line in beaten(group.choices, rows[label])]
    better += deadline.preferable(reserves, variants.RESERVES)
    tables = [sample_table(group.choices, rows[label], group.titles) for label, group in compared.items()]
    text = "\n".join([*tables, reserve_table(reserves, variants.RESERVES)])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "table.md").write_text(text)
    write_summary(folder, {
        "experiment": "search", "seed": arguments.seed, "runs": arguments.runs,
        **{label: summaries(found) for label, found in rows.items()},
        "deadline": {name: row.summary() for name, row in reserves.items()},
        "better_than_in_use": better,
    })  # fmt: skip
    every = [choice for group in compared.values() for choice in group.choices]
    titles = {name: title for group in compared.values() for name, title in group.titles.items()}
    samples = {key: sample for found in rows.values() for key, sample in found.items()}
    figure.draw(folder / "search.png", every, samples, titles)
    print(f"{text}\nresults in {folder}")
    return print_verdict(
        not better,
        f"better than the value in use: {', '.join(better)}"
        if better
        else "of no option is there a better value than the one in use",
    )


def compare(group: Group, seeds: list[int], execution: Execution) -> Rows:
    """Results of a group, as relative excess over the best known cost."""
    rows = [
        (choice, value, problem)
        for choice in group.choices
        for value in choice.values
        for problem in choice.problems
    ]
    tasks = {
        (choice.name, value, problem): [
            group.task(choice, choice.values[value], problem, seed) for seed in seeds
        ]
        for choice, value, problem in rows
    }
    results = _results(group.trial, tasks, execution, group.label, group.warm_up)
    costs = {row: np.array([each.cost for each in outcomes]) for row, outcomes in results.items()}
    found: Rows = {}
    for (choice, value, problem), outcomes in results.items():
        best = group.best(problem, np.stack([cost for row, cost in costs.items() if row[2] == problem]))
        # What nobody solves says nothing about the options; it counts as a failure of all of them.
        best = np.where(np.isfinite(best), best, 1.0)
        found.setdefault((choice, value), {})[problem] = Sample(
            costs[choice, value, problem] / best - 1.0,
            float(np.median([outcome.evaluations for outcome in outcomes])),
            float(np.median([outcome.seconds for outcome in outcomes])),
        )
    return found


def search_task(choice: Choice, changes: dict[str, Any], problem: str, seed: int) -> problems.Task:
    """A single search."""
    options = {name: value for name, value in changes.items() if name != "spread"}
    return problems.Task(problem, changed(choice.base, options), seed, changes.get("spread"))


def replanning_task(choice: Choice, changes: dict[str, Any], world: str, seed: int) -> mpc_runs.Task:
    """Online VP-STO to the goal."""
    return mpc_runs.Task(changed(choice.base, changes), "vpsto", START, world == "moving", seed)


def reach_task(choice: Choice, changes: dict[str, Any], problem: str, seed: int) -> reach.Task:
    """A move through a random cell."""
    return reach.Task(problem, changed(choice.base, changes), seed)


def known_optimum(problem: str, costs: NDArray) -> NDArray:
    """The optimum, or the best that anybody found: the seeds share the problem."""
    return np.full(costs.shape[1], problems.problems()[problem].optimum or costs.min())


def best_of_seed(_problem: str, costs: NDArray) -> NDArray:
    """The best that anybody found with each seed, which is another problem each time."""
    return costs.min(axis=0)


def time_to_goal(task: mpc_runs.Task) -> Result:
    """Time to the goal [s], inf if it is not reached or something is hit, and processor time of a step."""
    result = mpc_runs.run_task(task)
    reached = result.time_to_goal if result.success and result.time_to_goal is not None else math.inf
    return Result(reached, variants.STEP_EVALUATIONS, float(np.median(result.step_seconds)))


def compare_reserves(seeds: list[int], execution: Execution) -> dict[str, deadline.Punctuality]:
    """What a search comes to before its deadline, and how often it is late, by name of the reserve."""
    tasks = {name: [deadline.DeadlineTask(name, seed) for seed in seeds] for name in variants.RESERVES.values}
    results = _results(deadline.run_task, tasks, execution, "deadlines", problems.warm_up)
    return deadline.punctuality(results)


def _results(
    trial: Callable[[Any], Any],
    tasks: dict[Any, list[Any]],
    execution: Execution,
    label: str,
    warm_up: Callable[[], None],
) -> dict[Any, list[Any]]:
    """Results by row; a task that several rows share, as those of the values in use do, runs once."""
    unique = list(dict.fromkeys(task for row in tasks.values() for task in row))
    by_task = dict(zip(unique, run_trials(trial, unique, execution, label, warm_up), strict=True))
    return {name: [by_task[task] for task in row] for name, row in tasks.items()}


def beaten(choices: tuple[Choice, ...], rows: Rows) -> list[str]:
    """Values that should replace the one in use."""
    return [
        f"{choice.name} = {value}"
        for choice in choices
        for value, changes in choice.values.items()
        if changes and dominates(rows[choice.name, value], rows[choice.name, choice.in_use])
    ]
