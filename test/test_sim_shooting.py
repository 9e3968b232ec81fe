"""The shooting experiment: pucks and worlds, when a shot ends and what counts, sums and verdict."""

import dataclasses
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from sim_bridge.experiments.hockey import shooting, shooting_figures, shooting_trials
from sim_bridge.experiments.hockey.shooting_players import (
    BASELINES,
    OBJECTIVES,
    PLAYERS,
    Middle,
    certain,
    config,
    puck_model,
)
from sim_bridge.experiments.hockey.shooting_starts import (
    GRID_X,
    GRID_Y,
    JITTER,
    SPREAD,
    ShotTask,
    plant,
    start,
    world_of,
)
from sim_bridge.experiments.hockey.shooting_summary import (
    SCORES,
    SPEEDS,
    missed_targets,
    reliability,
    summarise,
    table,
)
from sim_bridge.experiments.hockey.shooting_trials import GOAL, ShotResult, Trial, banks
from sim_bridge.hockey import table as field
from sim_bridge.hockey.contact_log import PuckContact
from sim_bridge.hockey.mallet import MalletConfig
from sim_bridge.hockey.recordings import Strike, strike_command
from sim_bridge.hockey.scene import AirHockeyScene
from sim_bridge.hockey.world import AirHockeyWorld
from vpsto_ros.contact.puck import ShotOutlook
from vpsto_ros.planning.hockey.shooting_config import SETTINGS, Shot

NAN = math.nan


# Pucks and worlds.


def test_pucks_are_on_the_grid_each_place_as_often_as_any_other():
    states = np.array([start(ShotTask("balanced", seed)) for seed in range(1000, 1100)])
    nearest = [np.abs(states[:, k, None] - grid).argmin(axis=1) for k, grid in enumerate((GRID_X, GRID_Y))]
    assert (np.unique(np.stack(nearest), axis=1, return_counts=True)[1] == 4).all()
    for k, grid in enumerate((GRID_X, GRID_Y)):
        assert np.abs(states[:, k] - grid[nearest[k]]).max() <= JITTER
    drift = np.hypot(*states[:, 2:].T)
    assert drift.max() <= 0.1 and drift.min() < 0.02 and drift.max() > 0.08


def test_all_players_that_are_compared_get_the_same_pucks_and_worlds():
    for name in PLAYERS:
        if name != "moving":
            np.testing.assert_array_equal(start(ShotTask(name, 1003)), start(ShotTask("conservative", 1003)))
        assert plant(ShotTask(name, 1003)) == plant(ShotTask("conservative", 1003))


def test_moving_pucks_come_towards_the_robot():
    states = np.array([start(ShotTask("moving", seed)) for seed in range(1000, 1200)])
    speed = np.hypot(*states[:, 2:].T)
    assert np.abs(states[:, :2]).max(axis=0) == pytest.approx([0.2, 0.3], abs=0.02)
    assert (speed >= 0.2).all() and (speed <= 0.5).all()
    assert (-states[:, 2] / speed >= 0.5 - 1e-12).all()


def parameters(scene, mallet):
    hinges = {"hinge_stiffness": mallet.stiffness, "hinge_damping": mallet.damping}
    return {**dataclasses.asdict(scene), **hinges}


def test_worlds_differ_from_the_nominal_one_within_the_spread():
    assert plant(ShotTask("conservative", 1000, nominal=True)) == (AirHockeyScene(), MalletConfig())
    nominal = parameters(AirHockeyScene(), MalletConfig())
    drawn = [parameters(*plant(ShotTask("conservative", seed))) for seed in range(1000, 1200)]
    for name, share in SPREAD.items():
        ratios = np.array([world[name] for world in drawn]) / nominal[name]
        assert 0.9 * share < np.abs(ratios - 1.0).max() <= share


# Players.


def test_settings_are_those_of_the_thesis_and_one_that_must_use_a_rim():
    assert {name: OBJECTIVES[name] for name in SETTINGS} == SETTINGS
    assert OBJECTIVES["forced_bank"].least_banks == 1 and config("moving") == config("conservative")
    thesis = dataclasses.replace(SETTINGS["aggressive"], beta=0.5)
    assert OBJECTIVES["aggressive_thesis"] == thesis and thesis.lambda1 == 0.0
    assert set(SCORES) == set(OBJECTIVES) - {"aggressive_thesis"}, "which is only compared with"


def test_the_baseline_prefers_the_middle_of_the_goal_and_no_rims():
    offset = np.array([[0.0, 0.0], [0.06, 0.0], [0.0, 0.0], [NAN, NAN]])
    goal = np.array([1.0, 1.0, 1.0, 0.0])
    outlook = ShotOutlook(goal, goal, goal, offset, np.array([0, 0, 1, 0]))
    np.testing.assert_allclose(Middle().values(outlook)[:3], [1.0, 0.52, -1.0])
    assert Middle().allowed(outlook).tolist() == [True, True, False, False]
    assert np.argmax(Middle().scores(outlook)) == 0


def test_planners_without_chances_expect_the_same_ways_for_certain():
    model, puck = puck_model(), shooting_figures.PUCK
    sure = certain(model)
    angles = np.radians(np.linspace(-60.0, 60.0, 241))
    normal = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    mallets = np.hstack([puck[:2] - model.table.contact_distance * normal, 1.5 * normal])
    still = 1e-12 * np.eye(4)
    chances, certainties = model.shots(puck, still, mallets), sure.shots(puck, still, mallets)
    direct = (chances.banks == 0) & (chances.goal > 0.0) & (certainties.banks == 0)
    assert direct.sum() > 5
    np.testing.assert_allclose(certainties.offset[direct, 0], chances.offset[direct, 0], atol=1e-6)
    decided = np.minimum(certainties.goal, 1.0 - certainties.goal)
    assert np.quantile(decided, 0.95) < 1e-3 < np.quantile(np.minimum(chances.goal, 1.0 - chances.goal), 0.95)
    for name in BASELINES:
        assert config(name).aim_std == config(name).speed_std == 0.0


# When a shot ends, with the real world and a stand-in for the agent.

TASK = ShotTask("conservative", 1000, nominal=True)
STRIKE = Strike(
    place=np.array([-0.5, 0.0]), angle=0.0, speed=0.85, length=0.25, phase=0.5, aside=0.0,
    puck_velocity=np.zeros(2),
)  # fmt: skip
INTENDED = Shot(
    time=0.0, puck=np.array([-0.5, 0.0, 0.0, 0.0]), angle=0.0, speed=0.85, goal=0.9, goal_speed=0.5, banks=0,
    value=0.9, contact_distance=0.0798,
)  # fmt: skip


class StandIn:
    """Lets the arm make a given motion, and says what it intends."""

    def __init__(self, world, command=None, shot=None):
        self.world, self.command, self.shot, self.observations = world, command, shot, []

    def act(self, observation):
        if self.command is not None and not self.observations:
            self.world.follower.accept(self.command, self.world.time)
        self.observations.append(observation)
        return SimpleNamespace(shot=self.shot, step=SimpleNamespace(trajectory=None))


@pytest.fixture(scope="module")
def world():
    return AirHockeyWorld()


def shoot(world, strike=STRIKE, velocity=(0.0, 0.0)):
    command = strike_command(strike, world.robot)
    world.limits.reset()
    pose = (*field.to_base(strike.puck_start()), 0.0)
    world.reset(pose, (*velocity, 0.0), joints=np.asarray(command.positions)[0])
    agent = StandIn(world, command, INTENDED)
    return Trial(TASK, world, agent).run(), agent


def roll(world, place, velocity):
    world.reset((*field.to_base(place), 0.0), (*velocity, 0.0))
    return Trial(TASK, world, StandIn(world)).run()


def test_a_straight_strike_scores_and_is_described(world):
    result, agent = shoot(world)
    assert result.end == GOAL and result.scored and result.banks == 0
    # Drag takes 0.5 /s times the way from the speed that the touch gives: 1.4 times the mallet's.
    assert result.goal_speed == pytest.approx(1.4 * 0.85 - 0.5 * 1.47, abs=0.1)
    assert result.predicted == 0.9 and result.shot is INTENDED
    along, across, speed_error = result.mallet_error
    assert abs(across) < 3e-3 and abs(along) < 0.02 and abs(speed_error) < 0.1
    assert len(result.computing) == len(result.elapsed) == len(agent.observations)
    times = np.array([observation.time for observation in agent.observations])
    np.testing.assert_allclose(np.diff(times), 0.02, atol=1e-9)
    way = result.path[result.touched :]
    assert way[0, 2] > 0.5 and way[-1, 0] > field.HALF_LENGTH
    assert np.abs(result.path[: result.touched, 2:]).max() < 0.01


def test_the_arm_is_watched_after_the_goal(world):
    result, agent = shoot(world)
    after = agent.observations[-1].time - agent.observations[result.touched - 1].time
    assert after >= shooting_trials.WATCHED - 0.04


def test_only_what_the_camera_delivers_is_told(world):
    _, agent = shoot(world)
    sightings = [sighting for each in agent.observations for sighting in each.sightings]
    stamps = np.array([sighting.time for sighting in sightings])
    assert (np.diff(stamps) > 0.0).all() and 80 < len(stamps) / (stamps[-1] - stamps[0]) < 121
    for each in agent.observations:
        assert all(sighting.time <= each.time - 0.009 for sighting in each.sightings)


def test_a_shot_beside_the_goal_is_a_miss():
    lively = AirHockeyWorld(AirHockeyScene(drag=0.1, rim_damping=0.03))
    result, _ = shoot(lively, dataclasses.replace(STRIKE, place=np.array([-0.5, 0.3])))
    assert not result.scored and result.end == "missed, and came back"
    assert math.isnan(result.goal_speed) and result.banks == 0
    way = result.path[result.touched :]
    assert way[:, 0].max() > 0.9 and -0.02 < way[-1, 0] < 0.0


def test_a_slow_shot_is_over_when_the_puck_rests(world):
    slow = dataclasses.replace(STRIKE, speed=0.25, length=0.1)
    result, _ = shoot(world, slow)
    assert not result.scored and result.end in ("came to rest", "no goal in time")


@pytest.mark.parametrize(
    ("place", "velocity", "end"),
    [
        ([-0.5, 0.3], [0.0, 0.0], "never touched"),
        ([0.5, 0.0], [2.0, 0.0], "a goal without a touch"),
        ([0.0, 0.09], [-1.5, 0.0], "the robot's own goal"),
    ],
)
def test_what_the_arm_does_not_strike_is_a_miss(world, monkeypatch, place, velocity, end):
    monkeypatch.setattr(shooting_trials, "WITHOUT_TOUCH", 1.5)
    result = roll(world, place, velocity)
    assert result.end == end and not result.scored
    assert math.isnan(result.predicted) and np.isnan(result.mallet_error).all()
    assert result.mallet is None and result.touched == len(result.path)


def test_a_goal_after_a_later_second_touch_is_another_shot(world, monkeypatch):
    monkeypatch.setattr(shooting_trials, "ONE_TOUCH", 0.0)  # the contact of one strike lasts 18 ms
    result, _ = shoot(world)
    assert result.end == "struck twice" and not result.scored


def test_motions_beyond_the_rules_are_counted(world):
    world.limits.reset()
    joints = np.array(AirHockeyScene().joints)
    joints[3] += 0.2  # lifts the mallet by more than its tolerance
    world.reset((*field.to_base([0.3, 0.4]), 0.0), (2.0, -0.2, 0.0), joints=joints)
    result = Trial(TASK, world, StandIn(world)).run()
    assert result.violations["height"] > 100


def test_the_mallet_is_off_along_and_across_its_intended_motion():
    diagonal = dataclasses.replace(INTENDED, angle=0.5 * math.pi)  # along +y
    off = dataclasses.replace(
        result("balanced", 0), shot=diagonal, mallet=diagonal.mallet + np.array([-0.001, 0.002, 0.1, 0.03])
    )
    np.testing.assert_allclose(off.mallet_error, [0.002, 0.001, 0.03], atol=1e-12)


def test_banks_are_rims_between_touch_and_goal():
    def contact(surface, at):
        return PuckContact(surface, at, at + 0.01, np.zeros(3), np.zeros(3), np.zeros(3))

    touched = [contact("left", 0.5), contact("mallet", 1.0), contact("right", 1.2), contact("far", 1.4)]
    assert banks([*touched, contact("far", 2.1)], 1.0, 2.0) == 2


def test_a_trial_is_the_same_again():
    first, second = (world_of(ShotTask("moving", 1001)) for _ in range(2))
    for each in (first, second):
        each.advance(0.2)
    np.testing.assert_array_equal(first.puck_pose(), second.puck_pose())
    seen = [[frame.pose for frame in each.camera_frames()] for each in (first, second)]
    np.testing.assert_array_equal(*seen)


# Sums and verdict.


def result(name, seed, scored=True, predicted=0.9, speed=1.8, violations=None, step=2e-3):
    return ShotResult(
        ShotTask(name, seed), GOAL if scored else "never touched", speed if scored else NAN,
        1 if scored and name == "forced_bank" else 0,
        None if math.isnan(predicted) else dataclasses.replace(INTENDED, goal=predicted),
        INTENDED.mallet + np.array([2e-3, 1e-3, 0.01, 0.0]), violations or {}, 0,
        np.full(50, step), np.full(50, 2 * step), np.zeros((3, 4)), 1,
    )  # fmt: skip


def results(**changes):
    return [result(name, seed, **changes) for name in PLAYERS for seed in range(40)]


def test_the_summary_has_what_is_reported():
    found = results()
    found[0] = result(PLAYERS[0], 0, scored=False)
    summary = json.loads(json.dumps(summarise(found)))
    for name in ("conservative", "balanced", "aggressive", "baseline", "forced_bank"):
        assert {"shots", "score", "speed_mean", "speed_std", "banks_mean"} <= summary[name].keys()
    assert summary["moving_conservative_score"] == 1.0 and summary["constraint_violations"] == 0
    assert summary["step_ms_p99"] == pytest.approx(2.0) and summary["step_wall_ms_max"] == pytest.approx(4.0)
    row = summary["conservative"]
    assert row["score"] == 39 / 40 and row["misses"] == {"0": "never touched"}
    assert row["score_interval"][0] < 39 / 40 < row["score_interval"][1]
    assert row["mallet_along_rms"] == pytest.approx(2e-3) and row["mallet_across_rms"] == pytest.approx(1e-3)
    assert row["predicted_mean"] == pytest.approx(0.9) and row["observed_of_predicted"] == 39 / 40
    assert "conservative 0: never touched" in table(summary)


def test_nothing_to_average_is_no_number():
    summary = summarise([result("aggressive", 0, scored=False, predicted=NAN)])
    assert summary["aggressive"]["speed_mean"] is None and summary["aggressive"]["predicted_mean"] is None
    assert summary["aggressive"]["reliability"] == [] and "| aggressive | 1 " in table(summary)
    json.dumps(summary, allow_nan=False)


def test_reliability_holds_for_chances_that_are_right():
    rng = np.random.default_rng(0)
    chances = rng.uniform(0.5, 1.0, 4000)
    found = [result("balanced", k, rng.random() < p, p) for k, p in enumerate(chances)]
    rows = reliability(found)
    assert sum(row["shots"] for row in rows) == 4000
    inside = [row["interval"][0] <= row["predicted"] <= row["interval"][1] for row in rows]
    assert sum(inside) >= len(rows) - 1
    certain_ones = reliability([result("balanced", 0, predicted=1.0)])
    assert [row["shots"] for row in certain_ones] == [1]


def test_every_target_can_be_missed():
    good = summarise(results())
    assert missed_targets(good) == []
    for name in SCORES:
        assert len(missed_targets({**good, name: {**good[name], "score": SCORES[name] - 0.01}})) == 1
        assert missed_targets({key: row for key, row in good.items() if key != name}) == [
            f"{name} did not shoot"
        ]
        others = {key: row for key, row in good.items() if key != name}
        assert missed_targets(others, [player for player in PLAYERS if player != name]) == []
    for name in SPEEDS:
        for speed in (SPEEDS[name] - 0.01, None):
            assert len(missed_targets({**good, name: {**good[name], "speed_mean": speed}})) == 1
    for key, value in (("constraint_violations", 1), ("step_ms_p99", 10.1), ("step_ms_max", 20.1)):
        assert len(missed_targets({**good, key: value})) == 1


def test_broken_rules_are_named_in_the_verdict():
    summary = summarise(results(violations={"limits": 2, "height": 3}))
    assert summary["constraint_violations"] == 5 * 40 * len(PLAYERS)
    (missed,) = missed_targets(summary)
    cycles = 40 * len(PLAYERS)
    assert f"limits {2 * cycles}" in missed and f"height {3 * cycles}" in missed


def test_trajectories_that_the_controller_refused_are_named_in_the_verdict():
    (missed,) = missed_targets(summarise([dataclasses.replace(shot, refused=2) for shot in results()]))
    assert f"refused {80 * len(PLAYERS)} trajectories" in missed


def test_the_command_fails_and_says_why(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(shooting, "shots", lambda *_args, **_more: results(scored=False))
    arguments = SimpleNamespace(
        players=list(PLAYERS), seed=1000, runs=40, nominal=True, out=str(tmp_path), jobs=1, resume=False
    )
    assert shooting.run(arguments) == 1
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("verdict: FAILED: conservative scores in 0.0 %")
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["nominal"]["balanced"]["shots"] == 40 and summary["spread"]
    for name in ("shooting.png", "shooting_chances.png", "shooting_plans.png"):
        assert (tmp_path / name).stat().st_size > 10_000
    monkeypatch.setattr(shooting, "shots", lambda *_args, **_more: results())
    monkeypatch.setattr(shooting_figures, "write", lambda *_args: None)
    assert shooting.run(arguments) == 0


# Figures.


@pytest.mark.parametrize(("banks_wanted", "speed"), [(0, 1.2), (0, 2.0), (1, 1.2)])
def test_rollouts_score_as_often_as_predicted(banks_wanted, speed):
    model = puck_model()
    mallet = shooting_figures.aimed(model, banks_wanted, speed)
    outlook = model.shots(shooting_figures.PUCK, 1e-8 * np.eye(4), mallet[None])
    assert outlook.banks[0] == banks_wanted and abs(outlook.offset[0, 0]) < 0.01
    share = np.mean([shooting_figures.scores(way) for way in shooting_figures.rollouts(model, mallet)])
    assert share == pytest.approx(outlook.goal[0], abs=0.08)
