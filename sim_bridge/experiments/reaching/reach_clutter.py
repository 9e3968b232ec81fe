"""An FR3 from random to random postures in cluttered cells, offline and among obstacles that move or appear.

Every pair counts, also one without a way at all. A solved move is proven free at every instant, and checked
once more at ten times the resolution of the search.
"""

import argparse
import dataclasses
import pathlib
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.reaching import ompl_planner
from sim_bridge.experiments.reaching.cells import ReachTask, random_task
from sim_bridge.experiments.reaching.figures import draw_solutions
from sim_bridge.experiments.reaching.online import run_online
from sim_bridge.experiments.runs import (
    Execution,
    markdown_table,
    print_verdict,
    quantile,
    run_trials,
    success_interval,
    write_summary,
)
from vpsto_ros.collision.arm import ArmCollision
from vpsto_ros.collision.arm_cost import ArmPathCost
from vpsto_ros.optimization.costs import JointSpaceProblem
from vpsto_ros.planning.reaching import ReachConfig, plan_reach
from vpsto_ros.robot.kinematics import fr3_pusher
from vpsto_ros.trajectory import Limits, OptimalBasis, Trajectory, synthesize

MARGIN = 0.01  # kept at the samples [m]
SAMPLES = 40
N_VIA = 4
SECONDS = 1.0  # processor time of a search
OMPL_SECONDS = 1.0
LAST_CHANCE = 10.0  # OMPL's time for a pair that nobody has solved
DRAWN = 6
RATE_WANTED = 1e6
SUCCESS_WANTED = 0.98


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What may be left out."""
    parser.add_argument("--no-compare", action="store_true", help="leave out OMPL, even if it is installed")
    parser.add_argument("--no-online", action="store_true", help="leave out the runs with moving obstacles")


def run(arguments: argparse.Namespace) -> int:
    """Run, print the table, draw some solutions; 0 if the figures are reached."""
    folder = pathlib.Path(arguments.out)
    execution = Execution.from_arguments(arguments)
    compare = ompl_planner.available() and not arguments.no_compare
    if not compare:
        print("without the comparison with OMPL" + ("" if arguments.no_compare else " (pip install ompl)"))
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    moves = run_trials(offline_trial, [(seed, compare) for seed in seeds], execution, "reach")
    runs = []
    if not arguments.no_online:
        tasks = [(move["seed"], move["keys"]) for move in moves if move["keys"] is not None]
        runs = run_trials(online_trial, tasks, execution, "reach online")
    summary = {"experiment": "reach_clutter", "seed": arguments.seed, "runs": arguments.runs}
    summary |= _offline_figures(moves, compare) | _online_figures(runs) | posture_rate(arguments.seed)
    write_summary(folder, summary)
    table = _table(summary, compare)
    (folder / "table.md").write_text(table)
    solved = [move for move in moves if move["keys"] is not None and not move["straight_free"]][:DRAWN]
    if solved:
        draw_solutions(folder, [_picture(move) for move in solved])
    print(f"{table}\n{_remarks(summary)}\nresults in {folder}")
    return _verdict(summary)


def problem_of(task: ReachTask) -> tuple[JointSpaceProblem, ArmCollision]:
    """The search problem of a move, and the checker whose margin its samples keep."""
    checker = ArmCollision(None, task.obstacles, margin=MARGIN)
    checker.require_free(task.start, "start")
    checker.require_free(task.goal, "goal")
    problem = JointSpaceProblem(
        OptimalBasis.uniform(N_VIA), fr3_pusher().limits, task.start, task.goal,
        terms=(ArmPathCost(checker),), samples=SAMPLES,
    )  # fmt: skip
    return problem, checker


def offline_trial(task: tuple[int, bool]) -> dict[str, Any]:
    """One move: our search, the straight move, and OMPL if asked for."""
    seed, compare = task
    move = random_task(seed)
    _warm_up()
    begin = time.thread_time()
    problem, checker = problem_of(move)
    found = plan_reach(
        problem, checker.in_collision, ReachConfig(), np.random.default_rng(seed),
        deadline=begin + SECONDS, clock=time.thread_time,
    )  # fmt: skip
    seconds = time.thread_time() - begin
    result: dict[str, Any] = {
        "seed": seed, "solved": found.search.valid, "seconds": seconds, "rounds": found.rounds,
        "first": None if found.first_valid is None else found.first_valid - begin, "keys": None,
        "evaluations": found.evaluations, "collisions": 0, "duration": None,
    }  # fmt: skip
    if found.search.points is not None:
        motion = problem.trajectory(found.search.points)
        result |= {"keys": found.search.points, "duration": motion.duration}
        result["collisions"] = int(not _clean(motion, checker, problem.limits))
    result |= _straight(move, checker, problem.limits)
    return result | (_ompl(move, checker, problem.limits, found.search.valid) if compare else {})


def online_trial(task: tuple[int, NDArray]) -> dict[str, Any] | None:
    """One closed-loop run from a solved move, with a ball that appears (even seeds) or passes (odd ones)."""
    seed, points = task
    move = random_task(seed)
    first = problem_of(move)[0].trajectory(points)
    _warm_up()
    outcome = run_online(move, first, fr3_pusher().limits, seed, moving=seed % 2 == 1)
    return None if outcome is None else dataclasses.asdict(outcome)


def _clean(motion: Trajectory, checker: ArmCollision, limits: Limits) -> bool:
    """Within limits and free: at ten times the resolution of the search, and proven in between."""
    bare = checker.with_margin(0.0)
    times = np.linspace(motion.start_time, motion.end_time, 10 * SAMPLES)
    free = not bare.in_collision(motion(times)).any() and bare.free_along(motion).free
    return free and not motion.violations(limits)


def _straight(move: ReachTask, checker: ArmCollision, limits: Limits) -> dict[str, Any]:
    """The straight joint-space move, and the duration that the limits allow at least."""
    keys, still = np.stack([move.start, move.goal]), np.zeros(7)
    motion = synthesize(OptimalBasis.uniform(0), keys, still, still, limits)
    return {
        "straight_free": checker.with_margin(0.0).free_along(motion).free,
        "straight_duration": motion.duration,
        "bound": bang_bang_duration(move.goal - move.start, limits),
    }


def bang_bang_duration(step: NDArray, limits: Limits) -> float:
    """Least time [s] between two rests a step (n,) apart, joint by joint, whatever is in the way."""
    distance, v, a = np.abs(step), limits.velocity, limits.acceleration
    cruising = distance >= v * v / a
    return float(np.where(cruising, distance / v + v / a, 2.0 * np.sqrt(distance / a)).max())


def _ompl(move: ReachTask, checker: ArmCollision, limits: Limits, solved: bool) -> dict[str, Any]:
    plan = ompl_planner.plan_with_ompl(checker, limits, move.start, move.goal, seconds=OMPL_SECONDS)
    result = {
        "ompl_solved": plan.trajectory is not None,
        "ompl_path": plan.path is not None,
        "ompl_seconds": plan.seconds,
        "ompl_duration": None if plan.trajectory is None else plan.trajectory.duration,
        "unsolvable": False,
    }
    if not solved and plan.path is None:
        again = ompl_planner.plan_with_ompl(
            checker.with_margin(0.0), limits, move.start, move.goal, seconds=LAST_CHANCE
        )
        result["unsolvable"] = again.path is None
    return result


def posture_rate(seed: int, count: int = 200_000) -> dict[str, float]:
    """Posture checks per second of one core against ten obstacles: random postures, and free ones only."""
    checker = ArmCollision(None, random_task(seed).obstacles)
    model = checker.model
    postures = np.random.default_rng(seed).uniform(model.lower, model.upper, (count, 7))
    hit = checker.in_collision(postures)
    free = postures[~hit]
    return {
        "posture_checks_per_s": _rate(checker, free),
        "posture_checks_per_s_random": _rate(checker, postures),
        "posture_checks_hit_share": float(hit.mean()),
    }


def _rate(checker: ArmCollision, postures: NDArray) -> float:
    seconds = []
    for _ in range(7):
        begin = time.thread_time()
        checker.in_collision(postures)
        seconds.append(time.thread_time() - begin)
    return len(postures) / float(np.median(seconds))


_WARM: list[bool] = []


def _warm_up() -> None:
    """Load the compiled kernels, which the first search of a process would otherwise wait for."""
    if _WARM:
        return
    _WARM.append(True)
    move = random_task(1_000)
    problem, checker = problem_of(move)
    config = ReachConfig(rounds=1)
    plan_reach(problem, checker.in_collision, config, np.random.default_rng(0))
    checker.free_along(problem.trajectory(np.tile(move.start, (N_VIA, 1))))


def _offline_figures(moves: list[dict[str, Any]], compare: bool) -> dict[str, Any]:
    solved = [move for move in moves if move["solved"] and not move["collisions"]]
    low, high = success_interval(len(solved), len(moves))
    figures: dict[str, Any] = {
        "solved": len(solved),
        "success_rate": len(solved) / len(moves),
        "success_interval": [low, high],
        "collisions": sum(move["collisions"] for move in moves),
        "failed_seeds": [move["seed"] for move in moves if not move["solved"]],
        "seconds_p50": quantile([move["seconds"] for move in moves], 0.5),
        "seconds_max": max(move["seconds"] for move in moves),
        "first_valid_p50": quantile([move["first"] for move in moves], 0.5),
        "first_valid_p99": quantile([move["first"] for move in moves], 0.99),
        "straight_free": sum(move["straight_free"] for move in moves),
        "duration_p50": quantile([move["duration"] for move in solved], 0.5),
        "duration_to_straight_p50": _ratio(solved, "duration", "straight_duration"),
        "duration_to_bound_p50": _ratio(solved, "duration", "bound"),
    }
    if compare:
        figures |= {
            "ompl_success_rate": sum(move["ompl_solved"] for move in moves) / len(moves),
            "ompl_path_rate": sum(move["ompl_path"] for move in moves) / len(moves),
            "ompl_seconds_p50": quantile([move["ompl_seconds"] for move in moves], 0.5),
            "ompl_seconds_p99": quantile([move["ompl_seconds"] for move in moves], 0.99),
            "ompl_duration_p50": quantile([move["ompl_duration"] for move in moves], 0.5),
            "ompl_duration_to_bound_p50": _ratio(moves, "ompl_duration", "bound"),
            "ours_to_ompl_duration_p50": _ratio(solved, "duration", "ompl_duration"),
            "unsolvable_for_all": [move["seed"] for move in moves if move["unsolvable"]],
        }
    return figures


def _online_figures(runs: list[dict[str, Any] | None]) -> dict[str, Any]:
    done = [run for run in runs if run is not None]
    if not done:
        return {}
    good = sum(run["reached"] and not run["collisions"] for run in done)
    times = np.concatenate([run["replanning_ms"] for run in done])
    return {
        "online_runs": len(done),
        "online_without_room": len(runs) - len(done),
        "online_blocked": sum(run["replanned"] for run in done),
        "online_success_rate": good / len(done),
        "online_success_interval": list(success_interval(good, len(done))),
        "online_collisions": sum(run["collisions"] > 0 for run in done),
        "online_replanning_ms_p50": float(np.median(times)),
        "online_replanning_ms_p99": float(np.quantile(times, 0.99)),
    }


def _ratio(moves: list[dict[str, Any]], above: str, below: str) -> float | None:
    return quantile([m[above] / m[below] for m in moves if m.get(above) and m.get(below)], 0.5)


def _table(s: dict[str, Any], compare: bool) -> str:
    low, high = s["success_interval"]
    rows = [[
        "VP-STO", f"{s['solved']} of {s['runs']}", f"{low:.3f}-{high:.3f}", f"{s['collisions']}",
        f"{s['first_valid_p50'] or 0:.2f} / {s['seconds_p50']:.2f} s", f"{s['duration_p50'] or 0:.2f} s",
        f"{s['duration_to_bound_p50'] or 0:.2f}",
    ]]  # fmt: skip
    if compare:
        count = round(s["ompl_success_rate"] * s["runs"])
        low, high = success_interval(count, s["runs"])
        rows.append([
            "OMPL RRT-Connect, simplified", f"{count} of {s['runs']}", f"{low:.3f}-{high:.3f}", "0",
            f"{s['ompl_seconds_p50']:.2f} s", f"{s['ompl_duration_p50'] or 0:.2f} s",
            f"{s['ompl_duration_to_bound_p50'] or 0:.2f}",
        ])  # fmt: skip
    low, high = success_interval(s["straight_free"], s["runs"])
    count = f"{s['straight_free']} of {s['runs']}"
    rows.append(["straight move", count, f"{low:.3f}-{high:.3f}", "-", "-", "-", "-"])
    header = ["planner", "solved", "95 % CI", "in collision", "search, first / all", "duration", "to bound"]
    return markdown_table(header, rows)


def _remarks(s: dict[str, Any]) -> str:
    lines = [
        f"{s['posture_checks_per_s'] / 1e6:.2f} million free postures a second on one core, "
        f"{s['posture_checks_per_s_random'] / 1e6:.2f} million random ones "
        f"({100 * s['posture_checks_hit_share']:.0f} % hit)"
    ]
    if "online_runs" in s:
        low, high = s["online_success_interval"]
        lines.append(
            f"online at 20 Hz: {s['online_success_rate']:.3f} ({low:.3f}-{high:.3f}) of {s['online_runs']} "
            f"runs at the goal without collision; the ball was in the way in {s['online_blocked']}; "
            f"replanning {s['online_replanning_ms_p50']:.0f} ms, "
            f"p99 {s['online_replanning_ms_p99']:.0f} ms"
        )
    if s["failed_seeds"]:
        lines.append(f"not solved: seeds {s['failed_seeds']}")
    return "\n".join(lines)


def _picture(move: dict[str, Any]) -> tuple[str, ReachTask, NDArray]:
    task = random_task(move["seed"])
    motion = problem_of(task)[0].trajectory(move["keys"])
    postures = motion(np.linspace(motion.start_time, motion.end_time, 100))
    return f"seed {move['seed']}: {motion.duration:.2f} s", task, postures


def _verdict(s: dict[str, Any]) -> int:
    good = (
        s["success_rate"] >= SUCCESS_WANTED
        and s["collisions"] == 0
        and s["posture_checks_per_s"] >= RATE_WANTED
        and s["seconds_max"] <= 1.1 * SECONDS
    )
    return print_verdict(
        good,
        f"{100 * s['success_rate']:.1f} % solved (98 % wanted), {s['collisions']} in collision, longest "
        f"search {s['seconds_max']:.2f} s, {s['posture_checks_per_s'] / 1e6:.2f} million posture checks a "
        "second",
    )
