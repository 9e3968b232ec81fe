"""The rules of a stock joint_trajectory_controller, one by one, and the reference between points."""

import numpy as np
import pytest
from scipy.interpolate import BPoly, CubicHermiteSpline

from sim_bridge.trajectory_follower import (
    FollowerConfig,
    TrajectoryCommand,
    TrajectoryFollower,
    TrajectoryRejected,
)
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.trajectory import Limits

NAMES = ("a", "b")
LIMITS = Limits(
    velocity=np.array([1.0, 2.0]),
    acceleration=np.array([5.0, 5.0]),
    lower=np.full(2, -2.0),
    upper=np.full(2, 2.0),
)
START = np.array([0.1, -0.2])


@pytest.fixture
def follower():
    return TrajectoryFollower(LIMITS, NAMES, START)


def smooth(stamp=0.0, start=START, shift=(0.3, 0.3), duration=2.0, count=9, first=0.0, **changes):
    """A rest-to-rest motion with positions and velocities, and what a test changes about it."""
    s = np.linspace(0.0, 1.0, count)[:, None]
    fields = {
        "joint_names": NAMES,
        "stamp": stamp,
        "time_from_start": first + duration * s[:, 0],
        "positions": start + (3 * s**2 - 2 * s**3) * np.array(shift),
        "velocities": 6 * s * (1 - s) * np.array(shift) / duration,
    }
    return TrajectoryCommand(**(fields | changes))


def refused(follower, command, rule, message, now=0.0):
    before = follower.reference(now)
    with pytest.raises(TrajectoryRejected, match=message) as caught:
        follower.accept(command, now)
    assert caught.value.rule == rule
    assert isinstance(caught.value, InvalidInputError)
    # A refused command changes nothing.
    for kept, was in zip(follower.reference(now), before, strict=True):
        np.testing.assert_array_equal(kept, was)


def test_holds_its_start_until_told_otherwise(follower):
    for t in (0.0, 0.5, 100.0):
        q, qd, qdd = follower.reference(t)
        np.testing.assert_allclose(q, START)
        assert not qd.any()
        assert not qdd.any()


def test_follows_and_stays_at_the_end(follower):
    follower.accept(smooth(stamp=1.0), 1.0)
    np.testing.assert_allclose(follower.reference(2.0)[0], START + 0.15)
    np.testing.assert_allclose(follower.reference(9.0)[0], START + 0.3)
    assert not follower.reference(9.0)[1].any()


def test_cubic_between_points_with_velocities(follower):
    command = smooth(count=4)
    follower.accept(command, 0.0)
    oracle = CubicHermiteSpline(command.time_from_start, command.positions, command.velocities)
    for t in np.linspace(0.01, 1.99, 23):
        q, qd, qdd = follower.reference(t)
        np.testing.assert_allclose(q, oracle(t), atol=1e-12)
        np.testing.assert_allclose(qd, oracle(t, 1), atol=1e-12)
        np.testing.assert_allclose(qdd, oracle(t, 2), atol=1e-10)


def test_quintic_where_both_points_have_accelerations_and_cubic_elsewhere(follower):
    accelerations = np.array([[0.1, 0.2], [0.3, -0.1], [np.nan, np.nan], [0.0, 0.0]])
    command = smooth(count=4, accelerations=accelerations)
    follower.accept(command, 0.0)
    t, q, v = command.time_from_start, command.positions, command.velocities
    quintic = BPoly.from_derivatives(t[:2], [[q[i], v[i], accelerations[i]] for i in range(2)])
    cubic = CubicHermiteSpline(t, q, v)
    np.testing.assert_allclose(follower.reference(0.3)[0], quintic(0.3), atol=1e-12)
    np.testing.assert_allclose(follower.reference(1.0)[0], cubic(1.0), atol=1e-12)
    np.testing.assert_allclose(follower.reference(1.9)[0], cubic(1.9), atol=1e-12)


def test_joints_may_come_in_any_order(follower):
    command = smooth(shift=(0.3, 0.1))
    flipped = smooth(
        joint_names=("b", "a"), positions=command.positions[:, ::-1], velocities=command.velocities[:, ::-1]
    )
    follower.accept(flipped, 0.0)
    np.testing.assert_allclose(follower.reference(5.0)[0], START + np.array([0.3, 0.1]))


def test_zero_stamp_starts_now(follower):
    follower.accept(smooth(stamp=0.0), 7.0)
    np.testing.assert_allclose(follower.reference(8.0)[0], START + 0.15)


def test_a_past_start_joins_the_trajectory_where_it_is_now(follower):
    follower.accept(smooth(stamp=1.0), 1.0)
    follower.accept(smooth(stamp=1.0), 1.6)
    np.testing.assert_allclose(follower.reference(2.0)[0], START + 0.15)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("a",), "partial.*'b' is missing"),
        (("a", "c"), "no joint 'c' here; available: a, b"),
        (("a", "b", "b"), "named twice"),
        ((), "names no joints"),
    ],
)
def test_joint_names_must_match(follower, names, message):
    refused(follower, smooth(joint_names=names), "joint_names", message)


def test_there_must_be_points(follower):
    refused(follower, smooth(time_from_start=[], positions=np.empty((0, 2))), "empty", "no points")


@pytest.mark.parametrize("name", ["positions", "velocities", "accelerations"])
def test_every_point_must_have_a_value_per_joint(follower, name):
    refused(
        follower,
        smooth(**{name: np.zeros((9, 1))}),
        "shape",
        f"{name} must have one value per point and joint",
    )
    refused(follower, smooth(**{name: [[0.0, 0.0]] * 8 + [[0.0]]}), "shape", f"{name} must be a table")


@pytest.mark.parametrize("name", ["positions", "velocities"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_must_be_finite(follower, name, value):
    rows = getattr(smooth(), name).copy()
    rows[3, 1] = value
    refused(follower, smooth(**{name: rows}), "finite", f"{name} must be finite")


def test_an_acceleration_may_be_missing_but_not_by_halves(follower):
    accelerations = np.full((9, 2), np.nan)
    follower.accept(smooth(accelerations=accelerations), 0.0)
    accelerations[4, 0] = 0.0
    refused(follower, smooth(accelerations=accelerations), "finite", "accelerations must be finite")


def test_times_and_stamp_must_be_finite(follower):
    refused(follower, smooth(stamp=np.nan), "finite", "stamp")
    refused(follower, smooth(time_from_start=[0, 1, 2, 3, np.nan, 5, 6, 7, 8]), "finite", "time_from_start")


@pytest.mark.parametrize("times", [[0, 1, 1, 2], [0, 2, 1, 3], [-1, 0, 1, 2]])
def test_times_must_increase_strictly_from_zero(follower, times):
    refused(follower, smooth(count=4, time_from_start=times), "time", "increase strictly")


def test_a_trajectory_that_ended_is_refused(follower):
    refused(follower, smooth(stamp=1.0), "past", "ended at 3.000 s and now is 3.500 s", now=3.5)
    follower.accept(
        smooth(stamp=1.0, shift=(0.0, 0.0)), 3.0
    )  # ends now: still taken, as the stock controller does


def test_a_stamp_far_in_the_future_is_refused(follower):
    refused(follower, smooth(stamp=1.7e9), "future", "same clock")


def test_the_last_point_must_be_at_rest(follower):
    velocities = smooth().velocities.copy()
    velocities[-1, 1] = 1e-3
    refused(follower, smooth(velocities=velocities), "end_velocity", "b still moves at 0.001")
    velocities[-1, 1] = 1e-8
    follower.accept(smooth(velocities=velocities), 0.0)


def test_limits_hold_between_points_too(follower):
    """Slow at both points, but between them 1.5 times the mean velocity."""
    command = smooth(count=2, duration=0.4, shift=(0.3, 0.0))
    refused(follower, command, "limits", "velocity of joint 1: 1.125.*slow it down")
    refused(follower, smooth(shift=(2.5, 0.0), duration=8.0), "limits", "position of joint 1")
    refused(follower, smooth(shift=(0.1, 0.1), duration=0.3), "limits", "acceleration")


def test_the_reference_must_not_jump(follower):
    refused(
        follower,
        smooth(start=START + np.array([0.003, 0.0])),
        "jump",
        "position of a would step from 0.1 to 0.103",
    )
    follower.accept(smooth(start=START + 0.001), 0.0)
    moving = smooth(stamp=1.0, start=follower.reference(1.0)[0])
    refused(follower, moving, "jump", "velocity of a would step", now=1.0)


def test_straight_lines_that_jump_in_velocity_are_refused(follower):
    refused(follower, smooth(velocities=None), "jump", "send velocities")
    follower.accept(smooth(velocities=None, shift=(0.0, 0.0)), 0.0)


def test_until_the_first_point_the_running_trajectory_goes_on_if_it_leads_there(follower):
    follower.accept(smooth(), 0.0)
    middle, speed, _ = follower.active.state(1.0)
    onward = TrajectoryCommand(NAMES, 1.0, [0.0, 1.0], [middle, middle + 0.1], [speed, [0.0, 0.0]])
    expected = follower.active.state(0.8)[0]
    follower.accept(onward, 0.5)
    np.testing.assert_allclose(follower.reference(0.8)[0], expected)
    np.testing.assert_allclose(follower.reference(2.5)[0], middle + 0.1)


def test_otherwise_a_bridge_leads_to_the_first_point(follower):
    target = START + np.array([0.2, -0.1])
    follower.accept(smooth(start=target, stamp=2.0, first=0.5, shift=(0.1, 0.1)), 1.0)
    oracle = CubicHermiteSpline([1.0, 2.5], [START, target], np.zeros((2, 2)))
    for t in (1.2, 2.0, 2.4):
        np.testing.assert_allclose(follower.reference(t)[0], oracle(t))
    np.testing.assert_allclose(follower.reference(2.5)[0], target)
    np.testing.assert_allclose(follower.reference(9.0)[0], target + 0.1)


def test_the_bridge_keeps_the_limits_or_is_refused(follower):
    refused(follower, smooth(start=START + 1.0, stamp=0.1, shift=(0.1, 0.1)), "limits", "velocity", now=0.0)


def test_commands_queued_one_after_the_other(follower):
    """A second command accepted before the first one's first point: each takes over at its own time."""
    follower.accept(smooth(stamp=1.0), 0.0)
    middle, speed, _ = follower.active.state(2.0)
    follower.accept(TrajectoryCommand(NAMES, 2.0, [0.0, 1.0], [middle, middle], [speed, [0.0, 0.0]]), 0.5)
    np.testing.assert_allclose(follower.reference(0.9)[0], START)
    np.testing.assert_allclose(follower.reference(1.5)[0], START + 0.3 * (3 / 16 - 2 / 64))
    np.testing.assert_allclose(follower.reference(3.5)[0], middle)


def test_a_single_point_is_reached_and_held(follower):
    follower.accept(TrajectoryCommand(NAMES, 0.0, [1.0], [START + 0.2]), 3.0)
    np.testing.assert_allclose(follower.reference(3.5)[0], START + 0.1)
    np.testing.assert_allclose(follower.reference(9.0)[0], START + 0.2)


def test_stop_brakes_within_the_limits_and_holds(follower):
    follower.accept(smooth(), 0.0)
    _, speed, _ = follower.reference(1.0)
    stop = follower.stop(1.0)
    assert stop.violations(LIMITS) == []
    np.testing.assert_allclose(follower.reference(1.0)[1], speed)
    assert not follower.reference(stop.end_time + 1e-9)[1].any()
    np.testing.assert_allclose(stop.duration, np.max(np.abs(speed) / LIMITS.acceleration))
    at_rest = follower.reference(9.0)[0]
    follower.stop(9.0)
    np.testing.assert_allclose(follower.reference(10.0)[0], at_rest)


def test_the_reference_is_continuous_over_random_streams():
    """Replanning at 20 Hz towards random targets, always from the reference: nothing is refused or jumps."""
    rng = np.random.default_rng(3)
    follower = TrajectoryFollower(LIMITS, NAMES, np.zeros(2))
    previous, worst = np.zeros(2), 0.0
    for k in range(100):
        now = 0.05 * k
        q, qd, _ = follower.reference(now)
        command = TrajectoryCommand(
            NAMES, now, [0.0, 2.0], [q, np.clip(q + rng.uniform(-0.2, 0.2, 2), -1, 1)], [qd, np.zeros(2)]
        )
        follower.accept(command, now)
        for t in np.arange(now, now + 0.05, 0.001):
            reference = follower.reference(t)[0]
            worst = max(worst, np.abs(reference - previous).max())
            previous = reference
    assert worst < 2.0 * 0.001


def test_misuse_is_named():
    with pytest.raises(InvalidInputError, match="do not fit"):
        TrajectoryFollower(LIMITS, ("a",), START)
    with pytest.raises(ConfigurationError, match="horizon"):
        FollowerConfig(horizon=-1.0)
