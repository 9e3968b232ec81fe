"""What the number of via-points does to a time-optimal move (Fig. 4.6), against the true optimum.

A double integrator moves from 0 to 1 from rest to rest with |v| <= 0.1 and |a| <= 0.2; without the
restriction to splines the answer is bang-bang, 10.5 s. Seven joints then move by 1 rad each, under the limits
that the author's code is timed with. The optimum over the via-points is known from linear programs, so the
gap that the search leaves is exact.

With uniform phases the optimum is 10 (N + 1) / (N + 1/3) seconds for 3 <= N <= 9: the first segment speeds up
with an acceleration that falls linearly to zero, which takes at least 2 v / a = 1 s, and segments are that
long up to N = 9. From N = 10 on speeding up needs two segments, and one more via-point may lengthen the
motion.

Full CMA-ES and its populations are backed by the rows "time-optimal" of ``vpsto experiment search``.
"""

import argparse
import dataclasses
import functools
import pathlib
import time

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.runs import Execution, markdown_table, print_verdict, run_trials, write_summary
from sim_bridge.experiments.timing import via_points_figure
from sim_bridge.experiments.timing.linear_program import optimal_duration
from sim_bridge.warm_up import plan_in_clutter
from vpsto_ros.optimization.costs import CostWeights, JointSpaceProblem
from vpsto_ros.optimization.vpsto import VpstoConfig, search
from vpsto_ros.trajectory import Limits, OptimalBasis, Trajectory, time_key_positions

BANG_BANG = 10.5
LARGEST_GAP = 0.005
MOST_SECONDS = 0.15
MOST_VIA_POINTS = 12
JUDGED = range(1, 11)

ONE = Limits(np.array([0.1]), np.array([0.2]))
SEVEN = Limits(
    np.array([1.0, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5]), np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])
)


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """One move from 0 to 1 in every degree of freedom, and how it is searched.

    Attributes:
        name: for tables and records.
        n_via: free via-points N.
        limits: of n degrees of freedom.
        config: of the search.
    """

    name: str
    n_via: int
    limits: Limits
    config: VpstoConfig

    @functools.cached_property
    def problem(self) -> JointSpaceProblem:
        """Duration alone: nothing else is asked for, and there is nothing to sample for."""
        still = np.zeros(self.limits.dof)
        return JointSpaceProblem(
            OptimalBasis.uniform(self.n_via), self.limits, start=still, goal=still + 1.0,
            weights=CostWeights(smoothness=0.0), samples=2,
        )  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class Outcome:
    """What one search found.

    Attributes:
        duration: of the motion [s].
        points: (N, n) via-points.
        iterations: how many it took.
        seconds: processor time of the search [s].
        broken: limits that the motion exceeds at any instant, in words.
    """

    duration: float
    points: NDArray[np.float64]
    iterations: int
    seconds: float
    broken: tuple[str, ...]


def cases() -> tuple[list[Case], list[Case]]:
    """One-dimensional moves for N = 1 .. 12, seven-joint ones for the author's N_via = 5 and 10."""
    # Over three iterations: now and then two successive best costs agree by chance.
    until_settled = VpstoConfig(
        population=32, iterations=2000, restarts=0, strategy="cma", tolerance=1e-6, patience=3
    )
    ones = [Case(f"1d_{n}", n, ONE, until_settled) for n in range(1, MOST_VIA_POINTS + 1)]
    budgets = {"7dof_n5": (4, 32, 300), "7dof_n10": (9, 64, 600)}
    sevens = [
        Case(name, n, SEVEN, VpstoConfig(population=size, iterations=most, restarts=0, strategy="cma"))
        for name, (n, size, most) in budgets.items()
    ]
    return ones, sevens


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """One search of a case; its randomness comes from the seed."""

    case: Case
    seed: int

    @property
    def name(self) -> str:
        """What to call it in messages."""
        return self.case.name


def solve(task: Task) -> Outcome:
    """One search from its seed."""
    case = task.case
    problem, rng = case.problem, np.random.default_rng(task.seed)
    begin = time.thread_time()
    result = search(problem.prior(), problem.evaluate, case.config, rng)
    seconds = time.thread_time() - begin
    assert result.points is not None  # without obstacles every candidate is valid
    trajectory = problem.trajectory(result.points)
    broken = tuple(trajectory.violations(case.limits))
    return Outcome(trajectory.duration, result.points, result.iterations, seconds, broken)


def free_timing(n_via: int) -> Trajectory:
    """The one-dimensional move with the phases free as well: key positions of a linear program, then timed.

    The via-points that are best for equal spacing keep equal spacing, so timing alone gains nothing there.
    Phases with short segments at the ends, where the acceleration has to change, lead elsewhere: first to a
    segment of 2 v / a each, then to one of constant acceleration and a short one in which it falls.
    """
    best: Trajectory | None = None
    for first, last in (((), ()), ((), (1.0,)), ((1.0,), (1.0,)), ((0.45, 0.1), (0.1, 0.45))):
        inner = n_via + 1 - len(first) - len(last)
        if inner < 1:
            continue
        cruise = (BANG_BANG - sum(first) - sum(last)) / inner
        phases = np.cumsum([*first, *[cruise] * inner, *last]) / BANG_BANG
        phases[-1] = 1.0
        optimum = optimal_duration(OptimalBasis(phases), [0.0], [1.0], ONE)
        motion = time_key_positions(np.vstack([[[0.0]], optimum.via_points, [[1.0]]]), ONE).trajectory
        if best is None or motion.duration < best.duration:
            best = motion
    assert best is not None
    return best


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Nothing beyond the options of every experiment."""


def run(arguments: argparse.Namespace) -> int:
    """Search every case with every seed; 0 when the gaps and the time are as small as they have to be."""
    ones, sevens = cases()
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    tasks = [Task(case, seed) for case in (*ones, *sevens) for seed in seeds]
    found = run_trials(solve, tasks, Execution.from_arguments(arguments), "via_points", plan_in_clutter)
    outcomes = {
        case.name: found[i * len(seeds) : (i + 1) * len(seeds)] for i, case in enumerate((*ones, *sevens))
    }
    rows = {case.name: summarise(case, outcomes[case.name]) for case in (*ones, *sevens)}
    for case in ones:
        rows[case.name]["free_timing_s"] = free_timing(case.n_via).duration
    summary = {
        "experiment": "via_points",
        "seed": arguments.seed,
        "runs": arguments.runs,
        # The worst over N = 1 .. 10 and all seeds.
        "worst_gap_to_lp": max(rows[f"1d_{n}"]["gap_worst"] for n in JUDGED),
        "gap_7dof_n5": rows["7dof_n5"]["gap_worst"],
        "gap_7dof_n10": rows["7dof_n10"]["gap_worst"],
        "seconds_7dof_n5_p50": rows["7dof_n5"]["seconds_p50"],
        "seconds_7dof_n10_p50": rows["7dof_n10"]["seconds_p50"],
        "limits_broken": sum(row["limits_broken"] for row in rows.values()),
        "cases": rows,
    }
    folder = pathlib.Path(arguments.out)
    write_summary(folder, summary)
    table = _table(ones, rows) + "\n" + _seven_table(sevens, rows)
    (folder / "table.md").write_text(table)
    profiles = {case.n_via: case.problem.trajectory(outcomes[case.name][0].points) for case in ones}
    via_points_figure.write(folder / "via_points.png", rows, profiles, BANG_BANG, ONE)
    print(f"{table}\nresults in {folder}")
    return verdict(summary)


def summarise(case: Case, outcomes: list[Outcome]) -> dict[str, float]:
    """Durations, gaps, iterations and times over the seeds of one case."""
    still = np.zeros(case.limits.dof)
    optimum = optimal_duration(case.problem.basis, still, still + 1.0, case.limits).duration
    durations = np.array([outcome.duration for outcome in outcomes])
    iterations = np.array([outcome.iterations for outcome in outcomes])
    return {
        "n_via": case.n_via,
        "optimum_s": optimum,
        "duration_s_p50": float(np.median(durations)),
        "duration_s_worst": float(durations.max()),
        "gap_p50": float(np.median(durations) / optimum - 1.0),
        "gap_worst": float(durations.max() / optimum - 1.0),
        "iterations_p10": float(np.quantile(iterations, 0.1)),
        "iterations_p50": float(np.median(iterations)),
        "iterations_p90": float(np.quantile(iterations, 0.9)),
        "seconds_p50": float(np.median([outcome.seconds for outcome in outcomes])),
        "limits_broken": sum(len(outcome.broken) for outcome in outcomes),
    }


def verdict(summary: dict) -> int:
    """Print the verdict; 0 when the search is within half a percent everywhere, fast and within limits."""
    gaps = [summary[key] for key in ("worst_gap_to_lp", "gap_7dof_n5", "gap_7dof_n10")]
    seconds = summary["seconds_7dof_n5_p50"]
    near = all(gap <= LARGEST_GAP for gap in gaps)  # max(gaps) could hide a nan
    good = near and seconds <= MOST_SECONDS and summary["limits_broken"] == 0
    return print_verdict(
        good,
        f"worst gaps to the optimum {100 * gaps[0]:.3f} % (1-D), {100 * gaps[1]:.3f} % and "
        f"{100 * gaps[2]:.3f} % (7 joints, 4 and 9 via-points), at most {100 * LARGEST_GAP:g} %; the first "
        f"in {seconds:.3f} s, at most {MOST_SECONDS:g} s; {summary['limits_broken']} limits broken",
    )


def _table(ones: list[Case], rows: dict[str, dict[str, float]]) -> str:
    header = [
        "free via-points", "optimum", "found, median / worst", "gap, median / worst",
        "iterations, median (p10-p90)", "time, median", "with free timing",
    ]  # fmt: skip
    return markdown_table(header, [
        [
            f"{r['n_via']}", f"{r['optimum_s']:.4f} s", _found(r),
            f"{100 * r['gap_p50']:.4f} / {100 * r['gap_worst']:.4f} %",
            f"{r['iterations_p50']:.0f} ({r['iterations_p10']:.0f}-{r['iterations_p90']:.0f})",
            f"{1e3 * r['seconds_p50']:.0f} ms", f"{r['free_timing_s']:.3f} s",
        ]
        for r in (rows[case.name] for case in ones)
    ])  # fmt: skip


def _seven_table(sevens: list[Case], rows: dict[str, dict[str, float]]) -> str:
    header = [
        "free via-points of seven joints", "optimum", "found, median / worst", "gap, median / worst",
        "time, median",
    ]  # fmt: skip
    return markdown_table(header, [
        [
            f"{r['n_via']}", f"{r['optimum_s']:.4f} s", _found(r),
            f"{100 * r['gap_p50']:.4f} / {100 * r['gap_worst']:.4f} %", f"{1e3 * r['seconds_p50']:.0f} ms",
        ]
        for r in (rows[case.name] for case in sevens)
    ])  # fmt: skip


def _found(row: dict[str, float]) -> str:
    return f"{row['duration_s_p50']:.4f} / {row['duration_s_worst']:.4f} s"
