"""Messages and value types: round trips are exact; what is broken is refused with a message that says why."""

import math
import re

import numpy as np
import pytest

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Pose, PoseStamped, PoseWithCovarianceStamped, Quaternion
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.nodes.conversions import (
    TimeBase,
    belief_message,
    contact_message,
    goal_message,
    observation_message,
    planar_pose,
    read_belief,
    read_contact,
    read_goal,
    read_observation,
    read_pose,
    read_state,
    state_message,
)
from vpsto_ros.nodes.joint_conversions import (
    joint_state_message,
    read_joint_state,
    read_trajectory,
    trajectory_from_message,
    trajectory_message,
)
from vpsto_ros.planning.contact import ContactPlan
from vpsto_ros.planning.goal import PlanarGoal
from vpsto_ros.trajectory import Limits, OptimalBasis, Trajectory, synthesize

NAMES = tuple(f"fr3_joint{i}" for i in range(1, 8))
LIMITS = Limits(np.full(7, 2.0), np.full(7, 10.0))
FRAME = "fr3_link0"


def spline(rng, n_via=20, start=0.0, velocity=None):
    keys = np.cumsum(rng.normal(0.0, 0.1, (n_via + 2, 7)), axis=0)
    velocity = np.zeros(7) if velocity is None else velocity
    return synthesize(OptimalBasis.uniform(n_via), keys, velocity, np.zeros(7), LIMITS, start_time=start)


def replanned(rng, start):
    """What an MPC publishes: the rest of a running spline, then a new one with another acceleration."""
    running = spline(rng, start=start)
    takeover = start + 0.4 * running.duration
    q, qd, _ = running.state(takeover)
    keys = q + np.cumsum(np.vstack([np.zeros(7), rng.normal(0.0, 0.1, (21, 7))]), axis=0)
    new = synthesize(OptimalBasis.uniform(20), keys, qd, np.zeros(7), LIMITS, start_time=takeover)
    return running.clipped(start + 0.31 * running.duration, takeover).followed_by(new)


@pytest.mark.parametrize("start", [0.0, 12.345678901234, 4000.0])
def test_a_controller_reproduces_a_replanned_trajectory_exactly(start):
    rng = np.random.default_rng(3)
    for _ in range(20):
        sent = replanned(rng, start)
        message = trajectory_message(sent, NAMES, frame=FRAME)
        got = trajectory_from_message(message)
        times = np.linspace(max(sent.start_time, got.start_time), got.end_time, 2000)
        times = times[np.abs(times[:, None] - sent.times).min(axis=1) > 1e-8]
        assert np.abs(got(times) - sent(times)).max() < 1e-9
        assert np.abs(got(times, 1) - sent(times, 1)).max() < 1e-7
        assert np.abs(got(times, 2) - sent(times, 2)).max() < 1e-4
        assert got.violations(LIMITS, relative_tolerance=1e-5) == []
        empty = [i for i, point in enumerate(message.points) if not point.accelerations]
        assert len(empty) == 1
        assert list(message.points[-1].velocities) == [0.0] * 7


def test_limits_survive_the_rounding_to_nanoseconds():
    """Knots a few microseconds apart: their accelerations are the first to suffer from rounding."""
    rng = np.random.default_rng(8)
    worst = 0.0
    for gap in (2e-3, 1e-4, 1e-5, 2e-6):
        running = spline(rng)
        begin = running.times[7] - 0.01
        sent = running.clipped(begin, running.times[7] + gap).followed_by(
            running.clipped(running.times[7] + gap, running.end_time)
        )
        got = trajectory_from_message(trajectory_message(sent, NAMES))
        peak = max(np.abs(got.extrema(2)).max() / 10.0, np.abs(got.extrema(1)).max() / 2.0)
        worst = max(worst, peak - 1.0)
    assert worst < 1e-3


def test_knots_that_would_coincide_in_nanoseconds_are_merged():
    running = spline(np.random.default_rng(1))
    tau = running.times[5]
    sent = running.clipped(0.0, tau + 3e-10).followed_by(running.clipped(tau + 3e-10, running.end_time))
    message = trajectory_message(sent, NAMES)
    offsets = [point.time_from_start.sec * 10**9 + point.time_from_start.nanosec for point in message.points]
    assert min(np.diff(offsets)) >= 1000
    got = trajectory_from_message(message)
    times = np.linspace(0.0, got.end_time, 500)
    assert np.abs(got(times) - sent(times)).max() < 1e-9


def test_a_lead_in_shorter_than_a_millisecond_is_left_out():
    running = spline(np.random.default_rng(1))
    message = trajectory_message(running.clipped(running.times[3] - 2e-4, running.end_time), NAMES)
    assert TimeBase().seconds(message.header.stamp) == pytest.approx(running.times[3], abs=1e-9)


def test_wall_clock_times_keep_their_precision():
    base = TimeBase(1_790_000_000)
    sent = spline(np.random.default_rng(2), start=321.123456789)
    message = trajectory_message(sent, NAMES, base)
    assert message.header.stamp == Time(sec=1_790_000_321, nanosec=123456789)
    got = trajectory_from_message(message, base)
    times = np.linspace(sent.start_time, sent.end_time, 500)
    assert np.abs(got(times) - sent(times)).max() < 1e-9
    assert base.seconds(base.stamp(-0.25)) == -0.25


def test_a_quintic_that_ends_in_an_acceleration_jump_cannot_be_sent():
    rng = np.random.default_rng(0)
    times, q, v = np.arange(3.0), rng.normal(size=(3, 7)), rng.normal(size=(3, 7))
    smooth = Trajectory.from_points(times, q, v, rng.normal(size=(3, 7)))
    read = trajectory_from_message(trajectory_message(smooth, NAMES))
    probe = np.linspace(0.0, 2.0, 99)
    assert np.allclose(read(probe), smooth(probe), atol=1e-12)
    broken = Trajectory(
        times, smooth.coefficients + np.array([[[0.0]] * 6, [[0.0], [0.0], [1.0], [0.0], [0.0], [0.0]]])
    )
    with pytest.raises(InvalidInputError, match="acceleration jump"):
        trajectory_message(broken, NAMES)
    with pytest.raises(InvalidInputError, match="6 joint names"):
        trajectory_message(smooth, NAMES[:6])


def points(*rows):
    return [JointTrajectoryPoint(time_from_start=Duration(sec=i), **row) for i, row in enumerate(rows)]


def test_reading_a_trajectory_message():
    message = JointTrajectory(joint_names=["a", "b"])
    with pytest.raises(InvalidInputError, match="no points"):
        read_trajectory(message)
    with pytest.raises(InvalidInputError, match="names no joints"):
        read_trajectory(JointTrajectory(points=[JointTrajectoryPoint()]))
    message.points = points({"positions": [0.0, 1.0]}, {"positions": [1.0, 1.0], "accelerations": [2.0, 3.0]})
    read = read_trajectory(message)
    assert (read.joint_names, read.stamp, read.velocities) == (("a", "b"), 0.0, None)
    assert read.time_from_start.tolist() == [0.0, 1.0]
    assert np.isnan(read.accelerations[0]).all() and read.accelerations[1].tolist() == [2.0, 3.0]


@pytest.mark.parametrize(
    ("rows", "reason"),
    [
        (
            ({"positions": [0.0, 1.0]}, {"velocities": [0.0, 0.0]}),
            "point 1 has 0 positions for 2 joint names",
        ),
        (({"positions": [0.0, 1.0, 2.0]},), "point 0 has 3 positions"),
        (({"positions": [0.0, 1.0], "velocities": [0.0]},), "point 0 has 1 velocities"),
        (
            ({"positions": [0.0, 1.0], "velocities": [0.0, 0.0]}, {"positions": [0.0, 1.0]}),
            "point 1 has 0 velocities",
        ),
    ],
)
def test_malformed_points_are_named(rows, reason):
    with pytest.raises(InvalidInputError, match=reason):
        read_trajectory(JointTrajectory(joint_names=["a", "b"], points=points(*rows)))


def test_joint_states_are_reordered_and_checked():
    q, qd = np.arange(7.0), np.arange(7.0) / 10.0
    message = joint_state_message(NAMES, q, qd, q, Time(sec=3), FRAME)
    assert (message.header.stamp.sec, message.header.frame_id, list(message.effort)) == (3, FRAME, q.tolist())
    position, velocity = read_joint_state(message, NAMES[::-1])
    assert position.tolist() == q[::-1].tolist() and velocity.tolist() == qd[::-1].tolist()
    panda = JointState(name=["panda_joint1"], position=[0.0], velocity=[0.0])
    with pytest.raises(InvalidInputError, match=r"no joint 'fr3_joint1'.*available: panda_joint1"):
        read_joint_state(panda, NAMES)
    with pytest.raises(InvalidInputError, match="0 entries of velocity for 1 joint"):
        read_joint_state(JointState(name=["a"], position=[0.0]), ["a"])
    with pytest.raises(InvalidInputError, match="not finite"):
        read_joint_state(JointState(name=["a"], position=[math.nan], velocity=[0.0]), ["a"])


def test_poses_and_goals_round_trip():
    rng = np.random.default_rng(5)
    for pose in rng.uniform(-3.1, 3.1, (50, 3)):
        assert np.allclose(read_pose(planar_pose(pose)).pose, pose, atol=1e-12)
        message = goal_message(PlanarGoal(pose[:2], pose[2]), Time(), FRAME)
        goal = read_goal(message, FRAME, orientation=True)
        assert np.allclose(goal.position, pose[:2]) and goal.yaw == pytest.approx(pose[2])
        assert read_goal(message, FRAME, orientation=False).yaw is None


def test_tilt_and_height_are_reported():
    half = 0.5 * 0.3
    message = Pose(orientation=Quaternion(x=math.sin(half), w=math.cos(half)))
    message.position.z = 0.25
    reading = read_pose(message)
    assert reading.tilt == pytest.approx(0.3) and reading.height == 0.25


@pytest.mark.parametrize(
    ("quaternion", "reason"),
    [
        (Quaternion(x=0.0, y=0.0, z=0.0, w=0.0), "quaternion is zero"),
        (Quaternion(w=2.0), "norm 2"),
        (Quaternion(w=math.nan), "not finite"),
        (Quaternion(w=math.inf), "not finite"),
    ],
)
def test_broken_quaternions_are_refused(quaternion, reason):
    goal = PoseStamped(pose=Pose(orientation=quaternion))
    goal.header.frame_id = FRAME
    for orientation in (True, False):
        with pytest.raises(InvalidInputError, match=reason):
            read_goal(goal, FRAME, orientation=orientation)


def test_wrong_frames_and_nan_positions_are_refused():
    goal = goal_message(PlanarGoal(np.zeros(2)), Time(), "map")
    with pytest.raises(InvalidInputError, match="frame 'map'; expected 'fr3_link0'"):
        read_goal(goal, FRAME, orientation=False)
    goal = goal_message(PlanarGoal(np.zeros(2)), Time(), FRAME)
    goal.pose.position.x = math.nan
    with pytest.raises(InvalidInputError, match="position has a number that is not finite"):
        read_goal(goal, FRAME, orientation=False)


def covariance(rng, size):
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.1 * np.eye(size)


def test_observations_round_trip_and_zero_covariance_means_unknown():
    rng = np.random.default_rng(6)
    pose, spread = rng.normal(size=3), covariance(rng, 3)
    message = observation_message(pose, spread, Time(sec=1), FRAME)
    reading, read = read_observation(message, FRAME)
    assert np.allclose(reading.pose, pose) and np.allclose(read, spread)
    unknown = PoseWithCovarianceStamped(header=message.header)
    assert read_observation(unknown, FRAME)[1] is None
    message.pose.covariance[0] = -1.0
    with pytest.raises(InvalidInputError, match="not positive definite"):
        read_observation(message, FRAME)


def test_object_states_round_trip_with_the_twist_in_the_object_frame():
    rng = np.random.default_rng(7)
    full = np.zeros((6, 6))
    full[:3, :3], full[3:, 3:] = covariance(rng, 3), covariance(rng, 3)
    state = ObjectState(12.5, np.array([0.5, -0.1, 0.5 * math.pi]), np.array([0.0, 0.2, 0.3]), full)
    message = state_message(state, TimeBase(), FRAME)
    # Moving along the y axis of the base is moving along the x axis of an object turned by 90 degrees.
    assert message.twist.twist.linear.x == pytest.approx(
        0.2
    ) and message.twist.twist.linear.y == pytest.approx(0.0)
    read = read_state(message, TimeBase(), FRAME)
    assert read.stamp == state.stamp
    for name in ("pose", "twist", "covariance"):
        assert np.allclose(getattr(read, name), getattr(state, name), atol=1e-12)
    message.twist.twist.angular.z = math.inf
    with pytest.raises(InvalidInputError, match="twist has a number that is not finite"):
        read_state(message, TimeBase(), FRAME)


def test_beliefs_round_trip():
    poses = np.random.default_rng(0).normal(size=(40, 3))
    message = belief_message(poses, TimeBase().stamp(1.5), FRAME)
    assert TimeBase().seconds(message.header.stamp) == 1.5
    wrapped = poses - [0.0, 0.0, 1.0] * (2.0 * np.pi * np.round(poses / (2.0 * np.pi)))
    assert np.allclose(read_belief(message, FRAME), wrapped, atol=1e-12)
    one_by_one = [read_pose(pose).pose for pose in message.poses]
    assert np.allclose(read_belief(message, FRAME), one_by_one, atol=1e-12)
    assert read_belief(belief_message(poses[:0], TimeBase().stamp(1.5), FRAME), FRAME).shape == (0, 3)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda p: setattr(p.position, "x", math.nan), "position has a number that is not finite"),
        (lambda p: setattr(p.position, "z", math.inf), "position has a number that is not finite"),
        (lambda p: setattr(p.orientation, "w", math.nan), "quaternion has a number that is not finite"),
        (lambda p: setattr(p.orientation, "w", 3.0), "the quaternion has norm"),
    ],
)
def test_one_broken_pose_spoils_a_belief(change, reason):
    message = belief_message(np.zeros((5, 3)), TimeBase().stamp(1.5), FRAME)
    change(message.poses[3])
    with pytest.raises(InvalidInputError, match=reason):
        read_belief(message, FRAME)


def test_contact_plans_round_trip_and_broken_ones_are_refused():
    rng = np.random.default_rng(9)
    plan = ContactPlan(3.25, rng.normal(size=2), rng.normal(size=2), covariance(rng, 2))
    message = contact_message(plan, TimeBase(), FRAME, "fr3_tool")
    assert message.child_frame_id == "fr3_tool"
    read = read_contact(message, TimeBase(), FRAME)
    assert read.stamp == plan.stamp
    for name in ("position", "velocity", "covariance"):
        assert np.allclose(getattr(read, name), getattr(plan, name))
    empty = Odometry(header=message.header)
    with pytest.raises(InvalidInputError, match="positive definite"):
        read_contact(empty, TimeBase(), FRAME)


def test_a_long_trajectory_becomes_one_point_per_knot():
    sent = spline(np.random.default_rng(0), n_via=58)
    assert len(trajectory_message(sent, NAMES).points) == 60


def test_time_text_in_errors_is_plain():
    with pytest.raises(InvalidInputError) as caught:
        read_pose(Pose(orientation=Quaternion(w=0.0)))
    assert re.search(r"no rotation is \(x, y, z, w\) = \(0, 0, 0, 1\)", str(caught.value))
