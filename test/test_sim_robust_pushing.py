"""Robust pushing on the simulated arms: repeated pushes, playback, closed loop, verdicts that can fail."""

import argparse
import dataclasses
import json

import numpy as np
import pytest

from sim_bridge.experiments.robust_pushing import bimanual, bimanual_closed_loop, single_hand
from sim_bridge.experiments.robust_pushing.closed_loop import BimanualLoop
from sim_bridge.experiments.robust_pushing.playback import play
from sim_bridge.experiments.robust_pushing.setups import random_plant
from sim_bridge.experiments.robust_pushing.there_and_back import ThereAndBack
from sim_bridge.scene import BallsStart, HandStart, Scene
from sim_bridge.simulation import Simulation
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.planning.belief_space.config import RobustMpcConfig
from vpsto_ros.trajectory import Limits, OptimalBasis, synthesize

HAND_LIMITS = Limits(np.array([0.2, 0.2, 1.0]), np.array([1.0, 1.0, 5.0]))


def straight(begin, end, limits):
    rest = np.zeros(len(begin))
    return synthesize(OptimalBasis.uniform(0), np.stack([begin, end]), rest, rest, limits)


@pytest.fixture(scope="module")
def cycle():
    motion = straight(single_hand.HAND_START, np.array([0.5, 0.05, 0.4]), HAND_LIMITS)
    return ThereAndBack(motion, single_hand.BEGIN, single_hand.END, single_hand.ASIDE)


def test_the_way_back_is_the_way_there_turned_by_half_a_turn(cycle):
    times = np.linspace(0.0, cycle.motion.duration, 50)
    there, back = cycle.push(0)(times), cycle.push(1)(times)
    middle = 0.5 * (single_hand.BEGIN + single_hand.END)
    np.testing.assert_allclose(back[:, :2] - middle, middle - there[:, :2], atol=1e-12)
    np.testing.assert_array_equal(back[:, 2], there[:, 2])  # a rectangle turned by pi is itself
    np.testing.assert_allclose(cycle.goal(0), single_hand.END)
    np.testing.assert_allclose(cycle.goal(1), single_hand.BEGIN)


@pytest.mark.parametrize("number", [0, 1])
def test_the_way_round_joins_two_pushes_and_keeps_clear_of_the_disc(cycle, number):
    way, last, first = cycle.way_round(number), cycle.push(number), cycle.push(number + 1)
    np.testing.assert_allclose(way(way.start_time), last(last.end_time), atol=1e-12)
    np.testing.assert_allclose(way(way.end_time), first(0.0), atol=1e-12)
    times = np.linspace(way.start_time, way.end_time, 400)
    hand = PlanarShape.box(2 * 0.10, 2 * 0.03)
    points = way(times)
    offset = cycle.goal(number) - points[:, :2]
    c, s = np.cos(points[:, 2]), np.sin(points[:, 2])
    local = np.column_stack([c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]])
    gaps = hand.signed_distance(local) - single_hand.RADIUS
    assert gaps.min() >= gaps[0] - 1e-9  # the hand begins beside the disc and never comes nearer


def test_playback_follows_the_plan():
    start = np.array([0.40, 0.15, 0.40, -0.15])
    motion = straight(start, start + 0.03, Limits(np.full(4, 0.1), np.full(4, 0.5)))
    balls = BallsStart(start=tuple(start.tolist()))
    simulation = Simulation(Scene(robot="two_balls", balls=balls, object_pose=(0.6, 0.0, 0.0)))
    played = play(simulation, motion)
    np.testing.assert_allclose(played.tools[0], start, atol=1e-3)
    np.testing.assert_allclose(played.tools[-1], start + 0.03, atol=1e-3)
    np.testing.assert_allclose(played.poses[-1], played.poses[0], atol=1e-4)
    assert played.stretch == 1.0 and simulation.limits.violations == 0


def test_a_flat_push_carries_a_disc_and_a_miss_loses_it():
    rng = np.random.default_rng(0)
    start = single_hand.HAND_START + [0.0, 0.02, 0.0]
    push = straight(start, start + [0.0, 0.1, 0.0], HAND_LIMITS)
    for aside, moved in ((0.0, True), (0.2, False)):
        x, y = single_hand.BEGIN + [aside, 0.0]
        scene = Scene(
            robot="hand", plant=random_plant(single_hand.RADIUS, rng), object_pose=(x, y, 0.0),
            hand=HandStart(start=tuple(start.tolist())),
        )  # fmt: skip
        poses = play(Simulation(scene), push).poses
        assert (np.linalg.norm(poses[-1, :2] - poses[0, :2]) > 0.03) == moved


@pytest.mark.parametrize("robust", [True, False])
def test_a_closed_loop_run_brings_the_can_nearer_and_keeps_all_limits(robust):
    goal = np.array([0.5, 0.0])
    usual = RobustMpcConfig()
    config = dataclasses.replace(usual, planning=dataclasses.replace(usual.planning, robust=robust))
    loop = BimanualLoop(1003, 0.05, np.array([0.45, 0.06]), goal, config)
    loop.advance(4.0)
    distance = np.linalg.norm(np.array(loop.recording.poses)[:, :2] - goal, axis=1)
    assert distance[-1] < 0.5 * distance[0]
    assert loop.simulation.limits.violations == loop.recording.rejected == 0
    assert loop.simulation.robot_contacts.arms == 0
    assert {"wait"} < set(loop.recording.modes) <= {"wait", "brake", "hold", "robust", "deterministic"}


def test_places_to_put_the_can_are_clear_of_the_balls():
    rng = np.random.default_rng(1)
    for _ in range(50):
        tools = bimanual_closed_loop.GOAL[[0, 1, 0, 1]] + rng.uniform(-0.12, 0.12, 4)
        place = bimanual_closed_loop._clear(bimanual_closed_loop._place(rng), tools)
        assert np.linalg.norm(tools.reshape(2, 2) - place, axis=1).min() > 0.08
        assert np.linalg.norm(place - bimanual_closed_loop.GOAL) >= 0.06


def test_success_needs_the_whole_way_and_its_end():
    circle = bimanual.target().points
    good = np.repeat(circle[:, None], 3, axis=1)
    off, short = good.copy(), good.copy()
    off[60:80, 1] = bimanual.CENTER + 1.5 * (off[60:80, 1] - bimanual.CENTER)
    short[90:, 2] = short[90, 2]
    paths = np.stack([good[:, 0], off[:, 1], short[:, 2]], axis=1)
    np.testing.assert_array_equal(bimanual.succeeded(paths), [True, False, False])


def test_the_open_loop_experiment_writes_what_it_says(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bimanual, "ROLLOUTS", 200)
    monkeypatch.setattr(bimanual, "PLACES", 1)
    monkeypatch.setattr(bimanual, "VARIANTS", (bimanual.VARIANTS[1], bimanual.VARIANTS[2]))
    monkeypatch.setattr(bimanual, "OBJECTS", {"bottle": 0.05})
    tasks = [bimanual.PlanTask(1000, variant, 0.05) for variant in bimanual.VARIANTS]
    plans = {(t.variant.name, 0.05, 1000): bimanual.make_plan(t) for t in tasks}
    robust, baseline = (plans[t.variant.name, 0.05, 1000].success["thesis"] for t in tasks)
    assert robust > 0.9 > 0.5 > baseline
    motions = [plans[t.variant.name, 0.05, 1000].motion for t in tasks]
    run_tasks = [
        bimanual.RunTask(0, "bottle", 1000, task.variant, motion)
        for task, motion in zip(tasks, motions, strict=True)
    ]
    runs = [bimanual.execute(task) for task in run_tasks]
    assert all(run.limit_violations == run.arm_contacts == 0 and run.stretch == 1.0 for run in runs)
    assert "bottle" in bimanual.run_table(run_tasks, runs)
    assert "reached" in bimanual.plan_table(plans)


GOOD = {
    "rollout_success_r5": 1.0, "rollout_success_r3": 0.98, "baseline_rollout_success_r5": 0.05,
    "mujoco_success": 60, "mujoco_runs": 60, "arm_contacts": 0, "limit_violations": 0, "plan_s_p50": 0.3,
    "plan_s_p50_rich": 1.2,
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rollout_success_r5", 0.9), ("rollout_success_r3", 0.9), ("baseline_rollout_success_r5", 0.7),
        ("mujoco_success", 59), ("arm_contacts", 1), ("limit_violations", 1), ("plan_s_p50", 0.6),
        ("plan_s_p50_rich", 1.6),
    ],
)  # fmt: skip
def test_every_target_of_the_open_loop_can_be_missed(name, value):
    assert bimanual.missed_targets(GOOD) == []
    assert len(bimanual.missed_targets({**GOOD, name: value})) == 1


@pytest.mark.parametrize(
    ("name", "value"), [("robust_runs_min", 39), ("baseline_runs_mean", 12.0), ("limit_violations", 3)]
)
def test_every_target_of_the_hand_can_be_missed(name, value):
    good = {"robust_runs_min": 40, "baseline_runs_mean": 7.0, "limit_violations": 0}
    assert single_hand.missed_targets(good) == []
    assert len(single_hand.missed_targets({**good, name: value})) == 1


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("median_time_ratio", 0.9), ("median_time_ratio_ci95", [0.7, 1.05]), ("late_cycles", 0.1),
        ("reached", {"robust": [150, 180]}), ("arm_contacts", 2), ("limit_violations", 2),
        ("rejected", 1),
    ],
)  # fmt: skip
def test_every_target_of_the_closed_loop_can_be_missed(name, value):
    good = {
        "median_time_ratio": 0.8, "median_time_ratio_ci95": [0.7, 0.9], "late_cycles": 0.0, "rate_hz": 20.0,
        "reached": {"robust": [180, 180]}, "arm_contacts": 0, "limit_violations": 0, "rejected": 0,
    }  # fmt: skip
    assert bimanual_closed_loop.missed_targets(good) == []
    assert len(bimanual_closed_loop.missed_targets({**good, name: value})) == 1


def test_the_hand_experiment_counts_pushes_until_the_disc_is_lost(tmp_path, capsys, monkeypatch):
    """A straight plan of a few pushes on one plant, through to the verdict."""
    monkeypatch.setattr(single_hand, "MOST_PUSHES", 2)
    monkeypatch.setattr(single_hand, "ATTEMPTS", 1)
    arguments = argparse.Namespace(
        runs=1, seed=1000, plans=1, out=str(tmp_path), jobs=1, scheduler=None, resume=False
    )
    single_hand.run(arguments)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["robust_runs_min"] == summary["robust_runs_mean"] == 2, "never lost in two pushes"
    assert 0 <= summary["baseline_runs_min"] <= 2
    assert (tmp_path / "pushes.png").stat().st_size > 10_000
    assert "verdict:" in capsys.readouterr().out
