"""Costs of motions at the air-hockey table against a twin that samples whole trajectories densely."""

import math

import numpy as np
import pytest

from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.planning.hockey.motions import ArmState, Play, PlayMotion
from vpsto_ros.planning.hockey.rules import PlayRules
from vpsto_ros.robot.iiwa import iiwa14
from vpsto_ros.robot.iiwa_kinematics import arm_points
from vpsto_ros.trajectory import OptimalBasis

RULES, ROBOT = PlayRules(), iiwa14()
HOME = np.array(RULES.home)


@pytest.fixture(scope="module")
def play():
    return Play(RULES, RULES.limits(ROBOT))


def motion(play, seed, timed, moving=True):
    """From a state near home to another, within reach in most cases."""
    rng = np.random.default_rng(seed)
    ends = play.raised(HOME + rng.uniform(0.05, 0.35) * rng.standard_normal((1, 2, 7)))[0]
    rates = 0.3 * moving * rng.standard_normal((2, 7))
    finish = 1.0 + rng.uniform(0.5, 2.0) if timed else np.inf
    begin, end = ArmState(1.0, ends[0], rates[0]), ArmState(finish, ends[1], (timed * 1.0) * rates[1])
    return PlayMotion(play, begin, end, 0.5 * (ends[0] + ends[1]), 0.15)


def candidates(problem, count, n_via, seed, spread=0.4):
    noise = np.random.default_rng(seed).standard_normal((count, n_via, 7))
    middle = problem.guesses(n_via)[1]
    return middle + np.linspace(0.0, spread, count)[:, None, None] * noise


def excess_of_places(q):
    """How far postures (T, 7) are from the allowed places, one by one."""
    points = arm_points(q)
    joint = points[:, 3]
    rods = (joint[:, 2] - points[:, 2, 2]) / np.linalg.norm(joint - points[:, 2], axis=1)
    outside = np.maximum(0.0, np.abs(joint[:, 2] - RULES.height) - RULES.height_tolerance)
    outside += np.maximum(0.0, RULES.least_x - joint[:, 0])
    outside += np.maximum(0.0, np.abs(joint[:, 1]) - RULES.most_y)
    outside += np.maximum(0.0, RULES.clearance - points[:, 1:3, 2].min(axis=1))
    return outside + np.maximum(0.0, rods + math.cos(RULES.rod_tilt))


def twin(play, trajectory):
    """Excess of limits and of places of a motion, and its effort, by 2000 samples of it."""
    times = np.linspace(trajectory.start_time, trajectory.end_time, 2001)
    # Accelerations jump at the knots: both sides count.
    both = np.concatenate([times, trajectory.times[:-1] + 1e-9, trajectory.times[1:] - 1e-9])
    q, qd, qdd = trajectory(both), trajectory(both, 1), trajectory(both, 2)
    lower, upper = play.limits.position_range
    rates = np.abs(qd) / play.limits.velocity
    bends = np.abs(qdd) / play.limits.acceleration
    beyond = max(0.0, rates.max() - 1.0, bends.max() - 1.0, (lower - q).max(), (q - upper).max())
    share = (trajectory(0.5 * (times[1:] + times[:-1]), 2) / play.limits.acceleration) ** 2
    effort = share.sum() * (times[1] - times[0])
    return beyond, excess_of_places(q).max(), effort


@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize("seed", range(1031, 1035))
def test_costs_and_validity_are_those_of_the_sampled_trajectory(play, seed, timed):
    problem = motion(play, seed, timed)
    for n_via in (1, 3):
        points = candidates(problem, 12, n_via, seed)
        rated = problem.evaluate(points)
        for row, cost, valid in zip(points, rated.cost, rated.valid, strict=True):
            trajectory = problem.trajectory(row)
            beyond, away, effort = twin(play, trajectory)
            expected = play.weights @ [trajectory.duration, effort, beyond + 10.0 * away]
            # Places are looked at every 20 ms, and positions with them: the worst may be in between.
            slack = 1e-3 * expected + play.weights[2] * (2e-3 + 0.03 * beyond + 0.3 * away)
            assert abs(cost - expected) < slack
            assert cost < expected + 1e-3 * expected + 1e-6
            if valid:
                assert beyond < 1e-3 and away < 1e-3
            if beyond > 0.02 or away > 0.005:
                assert not valid


def test_limit_excess_alone_is_exact(play):
    """Of motions that break velocities or accelerations only."""
    basis = OptimalBasis.uniform(2)
    rng = np.random.default_rng(1035)
    checked = 0
    for _ in range(60):
        keys = HOME + 0.1 * rng.standard_normal((1, 4, 7))
        for _ in range(4):  # until raising them once more, as the motion does, changes nothing
            keys = play.raised(keys)
        rates, duration = 0.3 * rng.standard_normal((2, 7)), rng.uniform(0.2, 0.8)
        free = Play(RULES, play.limits, weights=np.array([0.0, 0.0, 1.0]))
        cost = free.assess(basis, keys, rates[0], rates[1], np.array([duration])).cost[0]
        begin, end = ArmState(0.0, keys[0, 0], rates[0]), ArmState(duration, keys[0, -1], rates[1])
        trajectory = PlayMotion(free, begin, end, HOME).trajectory(keys[0, 1:-1])
        beyond, away, _ = twin(free, trajectory)
        if away == 0.0 and beyond > 0.0:
            assert cost == pytest.approx(beyond, rel=1e-4)
            checked += 1
    assert checked > 10


@pytest.mark.parametrize("timed", [True, False])
def test_what_is_called_valid_keeps_limits_at_every_instant_and_places_on_a_fine_grid(play, timed):
    count = 0
    for seed in range(1036, 1076):
        problem = motion(play, seed, timed, moving=seed % 2 == 0)
        points = candidates(problem, 10, 2, seed, spread=0.1)
        for row in points[problem.evaluate(points).valid]:
            trajectory, count = problem.trajectory(row), count + 1
            assert trajectory.violations(play.limits, relative_tolerance=2e-6) == []
            fine = trajectory(np.arange(trajectory.start_time, trajectory.end_time, 1e-3))
            assert excess_of_places(fine).max() < 1e-3
    assert count > 20


def test_effort_is_the_integral_of_squared_accelerations(play):
    problem = motion(play, 1046, True)
    points = problem.guesses(2)[:1]
    only = Play(RULES, play.limits, weights=np.array([0.0, 1.0, 0.0]))
    cost = PlayMotion(only, problem.begin, problem.end, HOME, 0.15).evaluate(points).cost[0]
    # The sum over a fine grid is blurred where the accelerations jump.
    assert cost == pytest.approx(twin(play, problem.trajectory(points[0]))[2], rel=2e-3)


def test_candidates_without_a_duration_are_invalid(play):
    keys = np.tile(HOME, (2, 3, 1))
    rated = play.assess(
        OptimalBasis.uniform(1), keys, np.zeros(7), np.zeros(7), np.array([np.inf, np.nan])
    )
    assert np.isinf(rated.cost).all() and not rated.valid.any()


def test_via_points_are_moved_into_the_plane_of_play(play):
    rng = np.random.default_rng(1047)
    points = HOME + 0.08 * rng.standard_normal((20, 3, 7))
    raised = play.raised(points)
    heights = arm_points(raised.reshape(-1, 7))[:, 3, 2]
    assert np.abs(heights - RULES.height).max() < 0.2 * RULES.height_tolerance
    np.testing.assert_allclose(play.raised(raised), raised, atol=5e-3)
    # By the least motion: nothing along what leaves the height as it is.
    for before, after in zip(points.reshape(-1, 7), raised.reshape(-1, 7), strict=True):
        row = ROBOT.jacobian(0.5 * (before + after))[2]
        change = after - before
        along = (change @ row) / (row @ row) * row
        assert np.linalg.norm(change - along) < 0.2 * np.linalg.norm(change) + 1e-6


# Motions as problems.


@pytest.mark.parametrize("timed", [True, False])
def test_motions_begin_and_end_as_asked(play, timed):
    for seed in range(1048, 1054):
        problem = motion(play, seed, timed)
        for n_via in (0, 1, 4):
            points = candidates(problem, 1, n_via, seed)[0] if n_via else np.zeros((0, 7))
            trajectory = problem.trajectory(points)
            position, velocity, _ = trajectory.state(trajectory.start_time)
            assert trajectory.start_time == problem.start_time
            np.testing.assert_allclose(position, problem.begin.position, atol=1e-9)
            np.testing.assert_allclose(velocity, problem.begin.velocity, atol=1e-9)
            position, velocity, _ = trajectory.state(trajectory.end_time)
            np.testing.assert_allclose(position, problem.end.position, atol=1e-9)
            np.testing.assert_allclose(velocity, problem.end.velocity, atol=1e-7)
            if timed:
                assert trajectory.end_time == pytest.approx(problem.end.time, abs=1e-9)
            assert np.abs(np.concatenate(trajectory.jumps())).max() < 1e-7


def test_the_last_via_point_of_a_timed_motion_is_where_the_run_up_begins(play):
    begin = ArmState(0.0, HOME, np.zeros(7))
    problem = PlayMotion(play, begin, ArmState(1.0, HOME + 0.1, np.zeros(7)), HOME, 0.2)
    np.testing.assert_allclose(problem.basis(2).phases, [0.4, 0.8, 1.0])
    hasty = PlayMotion(play, begin, ArmState(0.3, HOME + 0.1, np.zeros(7)), HOME, 0.2)
    np.testing.assert_allclose(hasty.basis(2).phases, [1 / 3, 2 / 3, 1.0])


def test_without_a_run_up_via_points_are_evenly_spaced(play):
    begin = ArmState(0.0, HOME, np.zeros(7))
    problem = PlayMotion(play, begin, ArmState(1.0, HOME + 0.1, np.zeros(7)), HOME)
    np.testing.assert_allclose(problem.basis(3).phases, [0.25, 0.5, 0.75, 1.0])


def test_what_is_left_of_a_motion_is_its_own_warm_start(play):
    problem = motion(play, 1055, True)
    whole = problem.trajectory(problem.guesses(3)[1])
    now = 0.5 * (whole.start_time + whole.end_time)
    position, velocity, _ = whole.state(now)
    later = PlayMotion(play, ArmState(now, position, velocity), problem.end, HOME, 0.05)
    again = later.trajectory(later.shifted(whole, 3))
    times = np.linspace(now, whole.end_time, 50)
    assert np.abs(again(times) - whole(times)).max() < 0.02


# Rules.


def test_the_limits_planned_with_are_shares_within_what_the_rules_allow():
    limits, full = RULES.limits(ROBOT), ROBOT.limits
    np.testing.assert_allclose(limits.velocity, RULES.velocity_share * full.velocity)
    lower, upper = ROBOT.position_range
    given = limits.position_range
    assert np.all(given[0] > 0.95 * lower) and np.all(given[1] < 0.95 * upper)
    assert np.all(limits.velocity < 0.95 * full.velocity)
    assert np.all(limits.acceleration < full.acceleration)


def test_home_keeps_the_rules():
    assert excess_of_places(HOME[None])[0] == 0.0
    lower, upper = RULES.limits(ROBOT).position_range
    assert np.all(np.abs(HOME - 0.5 * (lower + upper)) < 0.5 * (upper - lower))
    np.testing.assert_allclose(RULES.table, [1.51, 0.0])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("height", -1.0), ("velocity_share", 1.2), ("home", (0.0, 1.0)), ("rod_tilt", 2.0),
        ("table_x", math.nan),
    ],
)
def test_rules_out_of_range_are_named(name, value):
    with pytest.raises(ConfigurationError, match=name):
        PlayRules(**{name: value})
