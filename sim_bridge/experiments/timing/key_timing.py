"""What the timing of given key positions is worth (3.2.2, Fig. 3.5): free durations against equal spacing.

Random sets of key positions: walks in the plane with steps of similar and of very different length, and
postures all over the joint range of the FR3. Every set is timed three ways: equally spaced in time, in
proportion to the chords, and with the durations that make the motion shortest.
"""

import argparse
import dataclasses
import functools
import pathlib
import time

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.runs import Execution, markdown_table, print_verdict, run_trials, write_summary
from sim_bridge.experiments.timing import key_timing_figure
from sim_bridge.warm_up import evaluate_a_trajectory
from vpsto_ros.trajectory import (
    Limits,
    OptimalBasis,
    minimal_duration,
    time_key_positions,
)

PLANE = Limits(np.array([1.0, 1.0]), np.array([2.0, 2.0]))
SETS = {
    "plane_uneven": "plane, steps from 0.05 to 1",
    "plane_even": "plane, steps of equal length",
    "fr3": "FR3, random postures",
}
GAINS = {"plane_uneven": 0.85, "fr3": 0.95}
"""Largest median of T / T(equal spacing) that counts as a clear gain."""
COUNTS = (2, 4, 8)
"""Key positions between start and end."""


@dataclasses.dataclass(frozen=True)
class Task:
    """One set of key positions; its randomness comes from the seed."""

    name: str
    n_via: int
    seed: int


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Durations of the three timings [s], processor time of the third [s], limits it breaks, in words."""

    best: float
    equal: float
    chord: float
    seconds: float
    broken: tuple[str, ...]


def key_positions(task: Task) -> tuple[NDArray[np.float64], Limits]:
    """The key positions (N + 2, n) of a task, and their limits."""
    rng = np.random.default_rng([task.seed, task.n_via, list(SETS).index(task.name)])
    if task.name == "fr3":
        limits = _fr3_limits()
        assert limits.lower is not None and limits.upper is not None
        return rng.uniform(limits.lower, limits.upper, (task.n_via + 2, limits.dof)), limits
    # Directions that turn by at most a quarter: a path one would draw by hand.
    angles = np.cumsum(rng.uniform(-np.pi / 2.0, np.pi / 2.0, task.n_via + 1))
    lengths = np.full(task.n_via + 1, 0.5)
    if task.name == "plane_uneven":
        lengths = np.exp(rng.uniform(np.log(0.05), 0.0, task.n_via + 1))
    steps = lengths[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), PLANE


@functools.cache
def _fr3_limits() -> Limits:
    from vpsto_ros.robot.kinematics import fr3_pusher  # loads Pinocchio

    return fr3_pusher().limits


def chord_phases(keys: NDArray[np.float64], limits: Limits) -> NDArray[np.float64]:
    """Phases (N + 1,) in proportion to the distances in units of the velocity limits."""
    distances = np.cumsum(np.linalg.norm(np.diff(keys, axis=0) / limits.velocity, axis=1))
    return distances / distances[-1]


def solve(task: Task) -> Outcome:
    """Time one set of key positions in three ways."""
    keys, limits = key_positions(task)
    begin = time.thread_time()
    timed = time_key_positions(keys, limits)
    seconds = time.thread_time() - begin
    still = np.zeros(limits.dof)
    chord = minimal_duration(OptimalBasis(chord_phases(keys, limits)), keys, still, still, limits)
    broken = timed.trajectory.violations(dataclasses.replace(limits, lower=None, upper=None))
    return Outcome(timed.duration, timed.equal_spacing, float(chord), seconds, tuple(broken))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Nothing beyond the options of every experiment."""


def run(arguments: argparse.Namespace) -> int:
    """Time all sets and print the table; 0 when nothing got longer and uneven spacing clearly gains."""
    kinds = [(name, n) for name in SETS for n in COUNTS]
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    tasks = [Task(name, n, seed) for name, n in kinds for seed in seeds]
    found = run_trials(solve, tasks, Execution.from_arguments(arguments), "key_timing", evaluate_a_trajectory)
    size = len(seeds)
    outcomes = {kind: found[i * size : (i + 1) * size] for i, kind in enumerate(kinds)}
    rows: list[dict] = [{"set": name, "n_via": n, **summarise(outcomes[name, n])} for name, n in kinds]
    medians = {
        name: float(np.median([o.best / o.equal for n in COUNTS for o in outcomes[name, n]])) for name in SETS
    }
    summary = {
        "experiment": "key_timing",
        "seed": arguments.seed,
        "runs": arguments.runs,
        "worst_ratio": max(row["to_equal_max"] for row in rows),
        "median_ratio": medians,
        "limits_broken": sum(row["limits_broken"] for row in rows),
        "rows": rows,
    }
    folder = pathlib.Path(arguments.out)
    write_summary(folder, summary)
    table = _table(rows)
    (folder / "table.md").write_text(table)
    keys, limits = key_positions(Task("plane_uneven", COUNTS[1], arguments.seed))
    key_timing_figure.write(folder / "key_timing.png", keys, limits, time_key_positions(keys, limits))
    print(f"{table}\nresults in {folder}")
    return verdict(summary)


def summarise(outcomes: list[Outcome]) -> dict[str, float]:
    """Ratios of durations and times over the seeds of one kind of set."""
    to_equal = np.array([outcome.best / outcome.equal for outcome in outcomes])
    to_chord = np.array([outcome.best / outcome.chord for outcome in outcomes])
    row = {"to_equal_max": float(to_equal.max()), "to_chord_max": float(to_chord.max())}
    for name, values in (("to_equal", to_equal), ("to_chord", to_chord)):
        for q in (10, 50, 90):
            row[f"{name}_p{q}"] = float(np.quantile(values, q / 100.0))
    row["seconds_p50"] = float(np.median([outcome.seconds for outcome in outcomes]))
    row["limits_broken"] = sum(len(outcome.broken) for outcome in outcomes)
    return row


def verdict(summary: dict) -> int:
    """Print the verdict; 0 when no motion got longer or breaks a limit, and the medians show a clear gain."""
    medians = summary["median_ratio"]
    good = (
        summary["worst_ratio"] <= 1.0
        and summary["limits_broken"] == 0
        and all(medians[name] <= most for name, most in GAINS.items())
    )
    gains = ", ".join(f"{medians[name]:.3f} (at most {most:g}) {name}" for name, most in GAINS.items())
    return print_verdict(
        good,
        f"duration over that of equal spacing at most {summary['worst_ratio']:.6f}; median {gains}; "
        f"{summary['limits_broken']} limits broken",
    )


def _table(rows: list[dict]) -> str:
    header = [
        "key positions", "between start and end", "T / T(equal spacing), median (p10-p90)", "largest",
        "T / T(chord length), median (p10-p90)", "time, median",
    ]  # fmt: skip
    return markdown_table(header, [
        [
            SETS[r["set"]], f"{r['n_via']}", _spread(r, "to_equal"), f"{r['to_equal_max']:.3f}",
            _spread(r, "to_chord"), f"{1e3 * r['seconds_p50']:.0f} ms",
        ]
        for r in rows
    ])  # fmt: skip


def _spread(row: dict, name: str) -> str:
    return f"{row[name + '_p50']:.3f} ({row[name + '_p10']:.3f}-{row[name + '_p90']:.3f})"
