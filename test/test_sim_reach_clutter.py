"""Random reaching tasks: what a cell is, what counts as solved, and the whole experiment on a few seeds."""

import argparse
import dataclasses
import json

import numpy as np
import pytest

from sim_bridge.experiments.reaching import ompl_planner, reach_clutter
from sim_bridge.experiments.reaching.cells import POSTURE_CLEARANCE, random_task
from sim_bridge.experiments.reaching.online import Intruder, random_intruder, run_online
from vpsto_ros.collision.arm import ArmCollision
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.planning.reaching import ReachConfig, plan_reach, through
from vpsto_ros.robot.kinematics import fr3_pusher
from vpsto_ros.trajectory import Limits, OptimalBasis, synthesize

LIMITS = fr3_pusher().limits


@pytest.fixture(scope="module")
def solved():
    task = random_task(1004)
    problem, checker = reach_clutter.problem_of(task)
    config = ReachConfig(valid_rounds=1)
    found = plan_reach(problem, checker.in_collision, config, np.random.default_rng(4))
    assert found.search.valid
    return task, problem, checker, found.search.points


def test_tasks_have_ten_obstacles_and_keep_their_distance():
    seen = set()
    for seed in range(1000, 1020):
        task = random_task(seed)
        assert len(task.obstacles) == len({shape.name for shape in task.obstacles}) == 10
        distance = ArmCollision(None, task.obstacles).distance(np.stack([task.start, task.goal]))
        assert distance.min() >= POSTURE_CLEARANCE
        seen.add(task.start.tobytes())
        again = random_task(seed)
        np.testing.assert_array_equal(again.goal, task.goal)
    assert len(seen) == 20


def test_guesses_pass_through_their_postures(solved):
    _, problem, _, _ = solved
    posture = np.full((1, 1, 7), 0.3)
    (points,) = through(problem, posture)
    keys = np.stack([problem.start, posture[0, 0], problem.goal])
    motion = synthesize(OptimalBasis.uniform(1), keys, np.zeros(7), np.zeros(7), LIMITS)
    np.testing.assert_allclose(points, motion(motion.duration * np.arange(1, 5) / 5), atol=1e-9)


def test_search_goes_round_what_the_straight_move_hits(solved):
    task, problem, checker, points = solved
    keys = np.stack([task.start, task.goal])
    straight = synthesize(OptimalBasis.uniform(0), keys, np.zeros(7), np.zeros(7), LIMITS)
    bare = checker.with_margin(0.0)
    assert bare.in_collision(straight(np.linspace(0.0, straight.duration, 200))).any()
    motion = problem.trajectory(points)
    assert bare.distance(motion(np.linspace(0.0, motion.duration, 4000))).min() > 0.0
    assert motion.violations(LIMITS) == []
    np.testing.assert_allclose(motion(motion.duration), task.goal, atol=1e-12)


def test_search_is_the_same_for_the_same_seed_and_ends_at_a_deadline(solved):
    _, problem, checker, _ = solved
    config = ReachConfig(rounds=1)
    runs = [
        plan_reach(problem, checker.in_collision, config, np.random.default_rng(7)).search for _ in range(2)
    ]
    np.testing.assert_array_equal(runs[0].best_any_points, runs[1].best_any_points)
    ticks = iter(range(1000))
    late = plan_reach(
        problem, checker.in_collision, ReachConfig(valid_rounds=1000), np.random.default_rng(7),
        deadline=100.0, clock=lambda: float(next(ticks)),
    )  # fmt: skip
    assert 1 < late.rounds < 10 and next(ticks) < 200


def test_ends_in_collision_and_free_goals_are_refused(solved):
    task, problem, checker, _ = solved
    inside = task.start.copy()
    inside[1], inside[3] = 1.7, -0.3
    words = r"start is in collision .*fr3_link5_forearm is \d+\.\d mm deep in shelf board"
    with pytest.raises(InvalidInputError, match=words):
        reach_clutter.problem_of(type(task)(task.obstacles, inside, task.goal))
    free = dataclasses.replace(problem, goal=None)
    with pytest.raises(InvalidInputError, match="needs a goal"):
        plan_reach(free, checker.in_collision, ReachConfig(), np.random.default_rng(0))


def test_bang_bang_duration():
    limits = Limits(np.array([1.0, 1.0]), np.array([2.0, 2.0]))
    assert reach_clutter.bang_bang_duration(np.array([1.0, 0.1]), limits) == pytest.approx(1.5)
    assert reach_clutter.bang_bang_duration(np.array([0.0, -0.32]), limits) == pytest.approx(0.8)


def test_online_counts_a_collision_that_nobody_can_avoid(solved):
    """A ball dropped onto the arm counts; one that is never there does not."""
    task, problem, _, points = solved
    first = problem.trajectory(points)
    elbow = ArmCollision().capsules(first(0.5))[6].a
    away = Intruder(0.0, np.array([0.0, 0.0, 5.0]), np.zeros(3))
    calm = run_online(task, first, LIMITS, 0, intruder=away)
    assert calm.reached and calm.collisions == 0 and not calm.replanned
    struck = run_online(task, first, LIMITS, 0, intruder=Intruder(0.5, elbow, np.zeros(3)))
    assert struck.collisions > 0 and struck.replanned


def test_intruders_leave_room_when_they_show_up(solved):
    task, problem, _, points = solved
    first = problem.trajectory(points)
    for moving in (False, True):
        intruder = random_intruder(task, first, 0.3, np.random.default_rng(0), moving=moving)
        assert intruder is not None and np.any(intruder.velocity != 0.0) == moving
        for time in np.linspace(0.3, 0.6, 20):
            there = ArmCollision(None, [intruder.at(time)])
            assert there.distance(first(time)) > 0.1
        assert intruder.ahead(1.0).radius == intruder.at(1.0).radius


def test_polygon_is_timed_without_cutting_corners(solved):
    task, _, checker, points = solved
    path = np.vstack([task.start, points, task.goal])
    motion = ompl_planner.timed(path, checker, LIMITS)
    if motion is not None:
        assert checker.with_margin(0.0).free_along(motion).free and motion.violations(LIMITS) == []
    line = np.stack([task.start, task.start + 0.05])
    timed = ompl_planner.timed(line, ArmCollision(), LIMITS)
    assert timed is not None and timed.duration < 1.0


def test_experiment_leaves_its_figures(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(reach_clutter, "RATE_WANTED", 1.0)  # a busy machine is no reason to fail
    monkeypatch.setattr(reach_clutter, "SECONDS", 20.0)
    arguments = argparse.Namespace(
        runs=2, seed=1002, out=str(tmp_path), jobs=1, scheduler=None, resume=False, no_compare=True,
        no_online=True,
    )  # fmt: skip
    assert reach_clutter.run(arguments) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["success_rate"] == 1.0 and summary["collisions"] == 0
    assert summary["posture_checks_per_s"] > 0.0 and "ompl_success_rate" not in summary
    assert (tmp_path / "solutions.png").stat().st_size > 10_000
    text = capsys.readouterr().out
    assert "without the comparison with OMPL" in text
    assert text.strip().splitlines()[-1].startswith("verdict: passed")
