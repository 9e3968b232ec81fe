"""Offline VP-STO among three obstacles (Fig. 4.4): which ways around them it finds, how fast and how surely.

The reference setting is the plain one: three free via-points, 25 candidates, 200 iterations of CMA-ES, no
restart, the cost being the duration and 100 per second in collision. The first population comes from the
smoothness prior around the straight line with a mean standard deviation of 0.1 m, a third of the way to the
goal. Spread and weight were chosen on seeds from 1000 on. The rows "plain setting" of
``vpsto experiment search`` compare strategy and spread with others.

A second table gives the search more via-points and restarts: it begins anew whenever it has converged, until
2000 iterations are used up (50 000 candidates), with a tenth of the runs.

Every result is checked twice: at every instant, from the roots of its polynomials, and by samples every
0.1 ms.
"""

import argparse
import dataclasses
import pathlib
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.clutter import clutter_2d_figure
from sim_bridge.experiments.clutter.world import CLUTTER, GOAL, LIMITS, STARTS, homotopy_class
from sim_bridge.experiments.runs import (
    Execution,
    markdown_table,
    print_verdict,
    quantile,
    run_trials,
    write_summary,
)
from sim_bridge.warm_up import plan_in_clutter
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.optimization.costs import CostWeights, JointSpaceProblem
from vpsto_ros.optimization.vpsto import VpstoConfig, search
from vpsto_ros.trajectory import OptimalBasis

SPREAD = 0.1
N_VIA = 3
MORE_VIA_POINTS = (5, 7, 9)
PLAIN = VpstoConfig(population=25, iterations=200, restarts=0, strategy="cma")
LONG = VpstoConfig(
    population=25, iterations=2000, restarts=100, restart="converged", restart_widening=1.0, strategy="cma",
    tolerance=1e-4, patience=20,
)  # fmt: skip
SAMPLE_STEP = 1e-4
SETTLED = 1e-3

EXPECTED = {
    "start_0.10_0.20": {"LR": 5.15, "R": 4.96, "LTR": 5.91},
    "start_0.05_0.20": {"LR": 5.08, "R": 4.62, "LTR": 5.91},
}
"""Durations [s] of a plain VP-STO by class of solution."""
MARGIN = 1.02
RARE = {"LTR"}
"""Found about 3 times in a hundred runs: one block of seeds in twenty does without, so that is only noted."""
JUDGED_VIA_POINTS, LONGEST_WITH_MORE = 7, {"start_0.10_0.20": 4.65}
"""The setting of more via-points whose median duration [s] is judged, and how long it may be."""
MOST_MS = 100.0
RUNS_FOR_ALL_CLASSES = 100


@dataclasses.dataclass(frozen=True)
class Task:
    """One search.

    Attributes:
        start: position [m].
        goal: position [m].
        n_via: free via-points.
        config: of the search.
        seed: of its randomness.
    """

    start: tuple[float, ...]
    goal: tuple[float, ...]
    n_via: int
    config: VpstoConfig
    seed: int

    @property
    def problem(self) -> JointSpaceProblem:
        """What is searched: the shortest motion out of collision."""
        return problem(np.array(self.start), np.array(self.goal), self.n_via)


@dataclasses.dataclass(frozen=True, eq=False)
class Outcome:
    """What one search found.

    Attributes:
        points: via-points (N, 2) of the best valid motion, or of the best invalid one [m].
        valid: whether it is out of collision and within all limits at every instant.
        sampled_hits: how many samples every 0.1 ms are in collision.
        duration: of the motion [s].
        letters: obstacles that it passes above.
        settled: iterations until the best valid cost was within 0.1 % of its final value.
        milliseconds: processor time of the search.
        reasons: what is wrong with it, in words.
    """

    points: NDArray[np.float64]
    valid: bool
    sampled_hits: int
    duration: float
    letters: str
    settled: int | None
    milliseconds: float
    reasons: tuple[str, ...]


def problem(start: NDArray, goal: NDArray, n_via: int) -> JointSpaceProblem:
    """The shortest motion between two points of the clutter.

    Raises:
        InvalidInputError: an end is in collision or out of bounds, or both are the same.
    """
    if np.array_equal(start, goal):
        raise InvalidInputError(f"start and goal are the same point {start.tolist()}: nothing to plan")
    return JointSpaceProblem(
        OptimalBasis.uniform(n_via), LIMITS, start, goal, terms=(CLUTTER.term(),),
        weights=CostWeights(smoothness=0.0), samples=2,
    )  # fmt: skip


def solve(task: Task) -> Outcome:
    """Search, then look at the result in other ways than the search does."""
    plan, rng = task.problem, np.random.default_rng(task.seed)
    begin = time.thread_time()
    result = search(plan.prior(spread=SPREAD), plan.evaluate, task.config, rng)
    milliseconds = 1e3 * (time.thread_time() - begin)
    points = result.best_any_points if result.points is None else result.points
    assert points is not None, "every candidate has a finite cost"
    trajectory = plan.trajectory(points)
    samples = trajectory(np.arange(0.0, trajectory.duration, SAMPLE_STEP))
    reasons = tuple(plan.explain(points))
    best = np.array([entry.best_valid_cost for entry in result.history])
    settled = int(np.argmax(best <= (1.0 + SETTLED) * best[-1])) + 1 if result.valid else None
    return Outcome(
        points, not reasons, int(CLUTTER.inside(samples).sum()), trajectory.duration, homotopy_class(samples),
        settled, milliseconds, reasons,
    )  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Another motion than the two of the figure."""
    for end, where in (("start", "instead of the two starts of the figure"), ("goal", "default 0.4 0.3")):
        parser.add_argument(
            f"--{end}", nargs=2, type=float, metavar=("X", "Y"), help=f"{end} of the motion [m], {where}"
        )


def run(arguments: argparse.Namespace) -> int:
    """Search from every start with every seed; 0 when classes, durations, validity and time are as wanted."""
    goal = GOAL if getattr(arguments, "goal", None) is None else np.array(arguments.goal)
    given = getattr(arguments, "start", None)
    starts = STARTS if given is None else {f"start_{given[0]:.2f}_{given[1]:.2f}": np.array(given)}
    for start in starts.values():
        problem(start, goal, N_VIA)  # refuse what makes no sense before the first run
    execution = Execution.from_arguments(arguments)
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    folder = pathlib.Path(arguments.out)
    folder.mkdir(parents=True, exist_ok=True)
    results = {}
    for name, start in starts.items():
        plain = run_trials(solve, _tasks(start, goal, N_VIA, PLAIN, seeds), execution, name, plan_in_clutter)
        few = seeds[: max(1, len(seeds) // 10)]
        more = {
            n: run_trials(
                solve, _tasks(start, goal, n, LONG, few), execution, f"{name}, {n} via-points",
                plan_in_clutter,
            )
            for n in MORE_VIA_POINTS
        }
        results[name] = summarise(plain, more)
        clutter_2d_figure.write(folder / f"{name}.png", problem(start, goal, N_VIA), plain)
    summary = {"experiment": "clutter_2d", "seed": arguments.seed, "runs": arguments.runs, **results}
    write_summary(folder, summary)
    expected = _expected(starts, goal)
    tables = class_table(results, expected) + "\n" + more_table(results)
    (folder / "table.md").write_text(tables)
    print(f"{tables}\nresults in {folder}")
    for note in unlucky(results, arguments.runs, expected):
        print(f"note: {note}")
    missed = shortcomings(results, arguments.runs, expected)
    return print_verdict(
        not missed, "; ".join(missed) or "every run valid at every instant, durations and time as wanted"
    )


def _expected(starts: dict[str, NDArray], goal: NDArray) -> dict[str, dict[str, float]]:
    """The reference durations of those starts that are exactly the ones of the figure, to its goal."""
    return {
        name: EXPECTED[name]
        for name, start in starts.items()
        if name in STARTS and np.array_equal(start, STARTS[name]) and np.array_equal(goal, GOAL)
    }


def _tasks(start: NDArray, goal: NDArray, n_via: int, config: VpstoConfig, seeds: range) -> list[Task]:
    return [Task(tuple(start.tolist()), tuple(goal.tolist()), n_via, config, seed) for seed in seeds]


def summarise(plain: list[Outcome], more: dict[int, list[Outcome]]) -> dict[str, Any]:
    """What the runs from one start show.

    ``best_duration_s`` is the least of all runs, whatever the class and the number of via-points: the best
    that is known, not what to expect of a run. For that there are the medians of the classes and settings.
    """
    valid = [outcome for outcome in plain if outcome.valid]
    longer = {
        str(n): {
            "runs": len(outcomes),
            "invalid": sum(not outcome.valid for outcome in outcomes),
            "best_duration_s": min((o.duration for o in outcomes if o.valid), default=None),
            "median_duration_s": quantile([o.duration for o in outcomes if o.valid], 0.5),
            "solve_ms_p50": quantile([o.milliseconds for o in outcomes], 0.5),
        }
        for n, outcomes in more.items()
    }
    best = min((o.duration for o in valid), default=None)
    best_more = min((v["best_duration_s"] for v in longer.values() if v["best_duration_s"]), default=None)
    everything = [*plain, *(outcome for outcomes in more.values() for outcome in outcomes)]
    return {
        "invalid": len(plain) - len(valid),
        "hit_when_sampled": sum(outcome.sampled_hits > 0 for outcome in everything if outcome.valid),
        "best_duration_s": min((t for t in (best, best_more) if t is not None), default=None),
        "best_duration_three_via_points_s": best,
        "best_duration_more_via_points_s": best_more,
        "classes": _classes(valid),
        "iterations_to_converge_p50": quantile([o.settled for o in valid], 0.5),
        "iterations_to_converge_p90": quantile([o.settled for o in valid], 0.9),
        "solve_ms_p50": quantile([outcome.milliseconds for outcome in plain], 0.5),
        "solve_ms_p99": quantile([outcome.milliseconds for outcome in plain], 0.99),
        "more_via_points": longer,
        "why_invalid": [list(outcome.reasons) for outcome in everything if not outcome.valid],
    }


def _classes(outcomes: list[Outcome]) -> dict[str, dict[str, float]]:
    """Count and durations of each class, the most frequent one first; `duration_s` is the median."""
    letters = [outcome.letters for outcome in outcomes]
    classes = {}
    for name in sorted(set(letters), key=lambda each: (-letters.count(each), each)):
        durations = [outcome.duration for outcome in outcomes if outcome.letters == name]
        classes[name] = {
            "count": len(durations),
            "duration_s": float(np.median(durations)),
            "best_duration_s": min(durations),
        }
    return classes


def shortcomings(results: dict[str, Any], runs: int, expected: dict[str, dict[str, float]]) -> list[str]:
    """Where the results fall short, in words.

    The median of each class is compared with the duration of a plain VP-STO, and so is that of one setting
    with more via-points. A class that is not found counts from a hundred runs on, unless it is rare.
    """
    found = []
    for name, result in results.items():
        if result["invalid"]:
            found.append(f"{result['invalid']} runs from {name} are invalid")
        found += [
            f"{more['invalid']} of {more['runs']} runs from {name} with {n} via-points are invalid"
            for n, more in result["more_via_points"].items()
            if more["invalid"]
        ]
        if result["hit_when_sampled"]:
            found.append(f"{result['hit_when_sampled']} valid motions from {name} collide when sampled")
        if result["solve_ms_p50"] > MOST_MS:
            found.append(f"a search from {name} takes {result['solve_ms_p50']:.0f} ms")
        for letters, duration in expected.get(name, {}).items():
            if letters in result["classes"]:
                median = result["classes"][letters]["duration_s"]
                if median > MARGIN * duration:
                    found.append(f"{letters} from {name} takes {median:.2f} s, more than {duration} s + 2 %")
            elif runs >= RUNS_FOR_ALL_CLASSES and letters not in RARE:
                found.append(f"{letters} was never found from {name}")
        judged = result["more_via_points"].get(str(JUDGED_VIA_POINTS))
        if name in expected and name in LONGEST_WITH_MORE and judged is not None:
            median, longest = judged["median_duration_s"], LONGEST_WITH_MORE[name]
            if median is None or median > longest:
                took = "no valid run" if median is None else f"a median of {median:.2f} s"
                found.append(f"{JUDGED_VIA_POINTS} via-points from {name}: {took}, asked {longest} s")
    return found


def unlucky(results: dict[str, Any], runs: int, expected: dict[str, dict[str, float]]) -> list[str]:
    """Rare classes that no run found, in words; no shortcoming, because that happens by chance."""
    return [
        f"{letters}, which about 3 of 100 runs find, was not found from {name} in {runs}"
        for name, durations in expected.items()
        for letters in durations
        if letters in RARE and letters not in results[name]["classes"]
    ]


def class_table(results: dict[str, Any], expected: dict[str, dict[str, float]]) -> str:
    """The ways around the obstacles, with the plain setting; with the known durations, where there are."""
    header = [
        "start", "passes above", "runs", "T median / best", "plain VP-STO", "invalid",
        "iterations, median / p90", "time, median / p99",
    ]  # fmt: skip
    rows = []
    for name, r in results.items():
        common = [
            f"{r['invalid']}",
            f"{r['iterations_to_converge_p50'] or 0:.0f} / {r['iterations_to_converge_p90'] or 0:.0f}",
            f"{r['solve_ms_p50']:.0f} / {r['solve_ms_p99']:.0f} ms",
        ]
        for letters, c in r["classes"].items():
            known = expected.get(name, {}).get(letters)
            rows.append([
                name, letters, f"{c['count']}", _seconds(c["duration_s"], c["best_duration_s"]),
                f"{known} s" if known else "", *common,
            ])  # fmt: skip
            common = [""] * 3
        if not r["classes"]:
            rows.append([name, "none", "0", "", "", *common])
    return markdown_table(header, rows)


def _seconds(*values: float | None) -> str:
    return "" if None in values else " / ".join(f"{value:.3f}" for value in values) + " s"


def more_table(results: dict[str, Any]) -> str:
    """What more via-points and restarts give."""
    header = ["start", "via-points", "runs", "T best / median", "invalid", "time, median"]
    rows = [
        [
            name, n, f"{m['runs']}",
            _seconds(m["best_duration_s"], m["median_duration_s"]), f"{m['invalid']}",
            f"{m['solve_ms_p50']:.0f} ms",
        ]
        for name, r in results.items()
        for n, m in r["more_via_points"].items()
    ]  # fmt: skip
    return markdown_table(header, rows)
