"""An FR3 from random to random postures in cluttered cells, offline and among obstacles that move or appear.

Every pair counts, also one without a way at all. A move is solved if a motion was found in time that is
within the limits and proven free at every instant, and was checked once more at ten times the resolution of
the search.
"""

import argparse
import pathlib
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.reaching import ompl_planner
from sim_bridge.experiments.reaching import summary as summaries
from sim_bridge.experiments.reaching.cells import ReachTask, random_task
from sim_bridge.experiments.reaching.figures import draw_solutions
from sim_bridge.experiments.reaching.online import run_online
from sim_bridge.experiments.runs import (
    Execution,
    print_verdict,
    run_trials,
    write_summary,
)
from sim_bridge.warm_up import plan_in_a_cell
from vpsto_ros.collision.arm import ArmCollision
from vpsto_ros.collision.arm_cost import ArmPathCost
from vpsto_ros.optimization.costs import JointSpaceProblem
from vpsto_ros.planning.reaching import ReachConfig, plan_reach
from vpsto_ros.robot.kinematics import fr3_pusher
from vpsto_ros.trajectory import Limits, OptimalBasis, Trajectory, synthesize

MARGIN = 0.01  # kept at the samples [m]
SAMPLES = 40
N_VIA = 4
SEARCH = ReachConfig(evaluations=7000)  # which takes 0.5 s, and 0.7 s at most
OMPL_SECONDS = 1.0
LAST_CHANCE = 10.0  # OMPL's time for a pair that nobody has solved
DRAWN = 6


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
    moves = run_trials(offline_trial, [(seed, compare) for seed in seeds], execution, "reach", warm_up)
    runs: list[dict[str, Any] | None] = []
    if not arguments.no_online:
        tasks = [(move["seed"], move["keys"]) for move in moves if move["keys"] is not None]
        runs = run_trials(online_trial, tasks, execution, "reach online", warm_up)
    summary = {"experiment": "reach_clutter", "seed": arguments.seed, "runs": arguments.runs}
    summary |= summaries.offline_figures(moves, compare) | summaries.online_figures(runs)
    summary |= posture_rate(arguments.seed)
    for what in ("collisions", "limit_violations"):
        summary[what] = summary[f"offline_{what}"] + summary.get(f"online_{what}", 0)
    write_summary(folder, summary)
    table = summaries.table(summary, compare)
    (folder / "table.md").write_text(table)
    drawn = [move for move in moves if move["keys"] is not None and not move["straight_free"]][:DRAWN]
    if drawn:
        draw_solutions(folder, [_picture(move) for move in drawn])
    print(f"{table}\n{summaries.remarks(summary, compare)}\nresults in {folder}")
    wrong = summaries.shortcomings(summary, online=not arguments.no_online)
    return print_verdict(not wrong, "; ".join(wrong) or summaries.in_short(summary))


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
    """One move: our search, the straight move, and OMPL if asked for.

    The search may evaluate a number of candidates, so that what it finds is the same on every machine; how
    long that takes is measured. A move is solved if a motion was found in time and nothing is wrong with it.
    """
    seed, compare = task
    move = random_task(seed)
    begin = time.thread_time()
    problem, checker = problem_of(move)
    found = plan_reach(
        problem, checker.in_collision, SEARCH, np.random.default_rng(seed), clock=time.thread_time
    )
    seconds = time.thread_time() - begin
    result: dict[str, Any] = {
        "seed": seed, "found": found.search.valid, "seconds": seconds, "rounds": found.rounds,
        "first": None if found.first_valid is None else found.first_valid - begin, "keys": None,
        "evaluations": found.evaluations, "free": True, "broken": [], "duration": None,
    }  # fmt: skip
    if found.search.points is not None:
        motion = problem.trajectory(found.search.points)
        result |= {"keys": found.search.points, "duration": motion.duration}
        result |= {"free": certified(motion, checker), "broken": motion.violations(problem.limits)}
    result |= _straight(move, checker, problem.limits)
    return result | (_ompl(move, checker, problem.limits, found.search.valid) if compare else {})


def online_trial(task: tuple[int, NDArray]) -> dict[str, Any] | None:
    """One closed-loop run from a motion found, with a ball that appears (even seeds) or passes (odd ones).

    None if there is no room for the ball.
    """
    seed, points = task
    move = random_task(seed)
    first = problem_of(move)[0].trajectory(points)
    outcome = run_online(move, first, fr3_pusher().limits, seed, moving=seed % 2 == 1)
    if outcome is None:
        return None
    return {
        "seed": seed, "reached": outcome.reached, "contact": outcome.contact, "broken": outcome.broken,
        "blocked": outcome.blocked, "duration": outcome.motion.duration,
        "step_ms": 1e3 * outcome.step_seconds,
    }  # fmt: skip


def warm_up() -> None:
    """Compile and load what the trials use."""
    plan_in_a_cell()
    move = random_task(1_000)
    problem, checker = problem_of(move)
    found = plan_reach(problem, checker.in_collision, ReachConfig(rounds=1), np.random.default_rng(0))
    if found.search.points is not None:
        motion = problem.trajectory(found.search.points)
        certified(motion, checker)
        run_online(move, motion, problem.limits, 0)


def certified(motion: Trajectory, checker: ArmCollision) -> bool:
    """Free at ten times the resolution of the search, and proven in between."""
    bare = checker.with_margin(0.0)
    times = np.linspace(motion.start_time, motion.end_time, 10 * SAMPLES)
    return not bare.in_collision(motion(times)).any() and bare.free_along(motion).free


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
        "ompl_free": plan.trajectory is not None and certified(plan.trajectory, checker),
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


def _picture(move: dict[str, Any]) -> tuple[str, ReachTask, NDArray]:
    task = random_task(move["seed"])
    motion = problem_of(task)[0].trajectory(move["keys"])
    postures = motion(np.linspace(motion.start_time, motion.end_time, 100))
    return f"seed {move['seed']}: {motion.duration:.2f} s", task, postures
