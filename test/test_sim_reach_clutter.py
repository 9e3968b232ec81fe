"""Random reaching tasks: what a cell is, what counts as solved, and the whole experiment on a few seeds."""

import argparse
import dataclasses
import json

import numpy as np
import pytest

from sim_bridge.experiments.reaching import ompl_planner, online, reach_clutter
from sim_bridge.experiments.reaching import summary as summary_of
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


def test_search_keeps_to_its_budget_of_evaluations(solved):
    _, problem, checker, _ = solved
    for budget in (197, 1000, 5000):
        config = ReachConfig(evaluations=budget, valid_rounds=1000)
        runs = [
            plan_reach(problem, checker.in_collision, config, np.random.default_rng(7)) for _ in range(2)
        ]
        assert budget - 197 < runs[0].evaluations <= budget
        np.testing.assert_array_equal(runs[0].search.best_any_points, runs[1].search.best_any_points)
    with pytest.raises(InvalidInputError, match="196 evaluations are too few"):
        config = ReachConfig(evaluations=196)
        plan_reach(problem, checker.in_collision, config, np.random.default_rng(7))


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


def test_online_judges_a_collision_that_nobody_can_avoid(solved, monkeypatch):
    """A ball dropped onto the arm counts; one that is never there does not."""
    task, problem, _, points = solved
    first = problem.trajectory(points)
    elbow = ArmCollision().capsules(first(0.5))[6].a
    away = Intruder(0.0, np.array([0.0, 0.0, 5.0]), np.zeros(3))
    calm = run_online(task, first, LIMITS, 0, intruder=away)
    assert calm.reached and calm.contact is None and not calm.blocked and calm.broken == []
    np.testing.assert_array_equal(calm.motion(0.0), task.start)
    monkeypatch.setattr(online, "TIMEOUT", 1.5)
    struck = run_online(task, first, LIMITS, 0, intruder=Intruder(0.5, elbow, np.zeros(3)))
    assert "in intruder" in struck.contact and struck.blocked


def test_online_is_the_same_every_time_and_certified(solved):
    task, problem, _, points = solved
    first = problem.trajectory(points)
    runs = [run_online(task, first, LIMITS, 3, moving=True) for _ in range(2)]
    np.testing.assert_array_equal(runs[0].motion.times, runs[1].motion.times)
    np.testing.assert_array_equal(runs[0].motion.coefficients, runs[1].motion.coefficients)
    assert runs[0].reached and runs[0].contact is None and runs[0].broken == []
    assert len(runs[0].step_seconds) == pytest.approx(runs[0].motion.duration / online.PERIOD)


def test_a_moving_ball_is_met_where_the_arm_is_then(solved):
    """The judge of a run: contacts at the right time, steps and limits, none of which samples would show."""
    task, problem, _, points = solved
    motion, cell = problem.trajectory(points), ArmCollision(None, task.obstacles)
    assert online.first_contact(motion, cell, None) is None
    middle, velocity = 0.5 * motion.duration, np.array([0.0, 0.2, 0.0])
    tool = ArmCollision().capsules(motion(middle))[-1].b
    for late, met in ((0.0, True), (5.0, False)):
        ball = Intruder(0.0, tool - (middle + late) * velocity, velocity)
        found = online.first_contact(motion, cell, ball)
        times = np.linspace(0.0, motion.duration, 4000)
        depth = [float(cell.with_obstacles([ball.at(t)]).distance(motion(t))) for t in times[::8]]
        assert (found is not None) == (min(depth) < 0.0) == met
    early = Intruder(0.0, tool - middle * velocity, velocity)
    when = float(online.first_contact(motion, cell, early).split(" at ")[-1].removesuffix(" s"))
    there = cell.with_obstacles([early.at(when)])
    assert abs(float(there.distance(motion(when)))) < 0.005 and when < middle
    assert online.broken(motion, LIMITS) == []
    fast = Limits(0.5 * LIMITS.velocity, LIMITS.acceleration)
    assert any("velocity" in words for words in online.broken(motion, fast))
    halves = [motion.clipped(0.0, middle), motion.shifted(1e-4).clipped(middle, motion.duration)]
    assert any("steps of" in words for words in online.broken(online.stitched(halves), LIMITS))
    assert online.at_rest_at(motion, task.goal) and not online.at_rest_at(halves[0], task.goal)
    assert not online.at_rest_at(halves[0], halves[0](middle))  # passing is not arriving


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
    assert motion is not None
    assert checker.with_margin(0.0).free_along(motion).free and motion.violations(LIMITS) == []
    line = np.stack([task.start, task.start + 0.05])
    timed = ompl_planner.timed(line, ArmCollision(), LIMITS)
    assert timed is not None and timed.duration < 1.0


def test_experiment_leaves_its_figures(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(summary_of, "RATE_WANTED", 1.0)  # a busy machine is no reason to fail
    monkeypatch.setattr(summary_of, "SECONDS", 20.0)
    arguments = argparse.Namespace(
        runs=1, seed=1004, out=str(tmp_path), jobs=1, scheduler=None, resume=False, no_compare=True,
        no_online=False,
    )  # fmt: skip
    assert reach_clutter.run(arguments) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["success_rate"] == 1.0 and summary["late_seeds"] == []
    assert summary["collisions"] == summary["offline_collisions"] + summary["online_collisions"] == 0
    assert summary["online_runs"] + summary["online_without_room"] == 1
    assert summary["posture_checks_per_s"] > 0.0 and "ompl_success_rate" not in summary
    assert (tmp_path / "solutions.png").stat().st_size > 10_000
    text = capsys.readouterr().out
    assert "without the comparison with OMPL" in text
    assert text.strip().splitlines()[-1].startswith("verdict: passed")


MOVE = {
    "seed": 7, "found": True, "seconds": 0.5, "first": 0.2, "free": True, "broken": [], "duration": 1.5,
    "straight_duration": 1.2, "straight_free": False, "bound": 1.0, "evaluations": 100,
}  # fmt: skip
RUN = {"seed": 7, "reached": True, "contact": None, "broken": [], "blocked": True, "step_ms": np.ones(3)}


def summary_from(moves, runs, rate=2e6):
    return (
        summary_of.offline_figures(moves, False)
        | summary_of.online_figures(runs)
        | {"posture_checks_per_s": rate}
    )


def test_verdict_is_good_only_if_nothing_is_wrong():
    fine = summary_from([MOVE] * 50, [RUN] * 50)
    assert summary_of.shortcomings(fine, online=True) == []
    assert summary_of.shortcomings(summary_from([MOVE] * 50, []), online=False) == []
    one_late = summary_from([MOVE] * 49 + [MOVE | {"seconds": 1.01}], [RUN] * 50)
    assert one_late["success_rate"] == 0.98 and one_late["late_seeds"] == [7]
    assert summary_of.shortcomings(one_late, online=True) == []


@pytest.mark.parametrize(
    ("moves", "runs", "rate", "words"),
    [
        ([MOVE] * 48 + [MOVE | {"found": False}] * 2, [RUN], 2e6, "only 96.0 % solved"),
        ([MOVE] * 48 + [MOVE | {"seconds": 1.01}] * 2, [RUN], 2e6, "only 96.0 % solved"),
        ([MOVE] * 99 + [MOVE | {"free": False}], [RUN], 2e6, "1 offline in collision"),
        ([MOVE] * 99 + [MOVE | {"broken": ["too fast"]}], [RUN], 2e6, "1 offline beyond limits"),
        ([MOVE], [RUN], 0.9e6, "9e+05 checks a second"),
        ([MOVE], [None, None], 2e6, "no closed loop could be started"),
        ([MOVE], [], 2e6, "no closed loop could be started"),
        ([MOVE], [RUN] * 48 + [RUN | {"reached": False}] * 2, 2e6, "only 96.0 % at the goal online"),
        ([MOVE], [None] * 50 + [RUN | {"reached": False}], 2e6, "only 0.0 % at the goal online"),
        ([MOVE], [RUN] * 99 + [RUN | {"contact": "elbow in ball"}], 2e6, "1 online in collision"),
        ([MOVE], [RUN] * 99 + [RUN | {"broken": ["too fast"]}], 2e6, "1 online beyond limits"),
    ],
)
def test_verdict_fails_for_every_criterion(moves, runs, rate, words):
    wrong = summary_of.shortcomings(summary_from(moves, runs, rate), online=True)
    assert len(wrong) == 1 and words in wrong[0]


def test_table_says_what_was_measured():
    compared = MOVE | {
        "ompl_solved": True, "ompl_path": True, "ompl_free": False, "ompl_seconds": 0.1,
        "ompl_duration": 2.0, "unsolvable": False,
    }  # fmt: skip
    summary = summary_of.offline_figures([compared] * 3, True) | summary_of.online_figures([RUN, None])
    summary |= {"runs": 3, "collisions": 0, "posture_checks_per_s": 2e6, "posture_checks_per_s_random": 3e6}
    summary["posture_checks_hit_share"] = 0.7
    lines = summary_of.table(summary, True).splitlines()
    ompl = [cell.strip() for cell in next(line for line in lines if "OMPL" in line).split("|")]
    assert ompl[2] == "3 of 3" and ompl[4] == "3"
    remarks = summary_of.remarks(summary, True)
    assert "OMPL found a path for 100 %" in remarks and "1 scenes without room" in remarks
