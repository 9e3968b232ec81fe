"""Whole motions in the plane as joint trajectories: exact at knots, within limits at every instant."""

import numpy as np
import pytest

from vpsto_ros.exceptions import InfeasibleError, InvalidInputError
from vpsto_ros.planning.plane_path import follow_plane
from vpsto_ros.robot.bimanual_plane import BimanualPlane
from vpsto_ros.robot.hand_plane import HandPlane
from vpsto_ros.robot.inverse_kinematics import TableMap
from vpsto_ros.robot.kinematics import fr3_bimanual, fr3_hand_pusher, fr3_pusher
from vpsto_ros.trajectory import Limits, OptimalBasis, Trajectory, synthesize

PLANES = {
    "rod": (lambda: TableMap(fr3_pusher()), [0.5, 0.0]),
    "hand": (lambda: HandPlane(fr3_hand_pusher()), [0.5, 0.0, 1.2]),
    "balls": (lambda: BimanualPlane(fr3_bimanual()), [0.5, 0.08, 0.5, -0.08]),
}


@pytest.fixture(params=PLANES)
def case(request):
    make, middle = PLANES[request.param]
    return make(), np.array(middle)


def wander(middle, count=6, speed=0.3, seed=0):
    """A smooth motion through random points around the middle, from rest to rest."""
    rng, size = np.random.default_rng(seed), len(middle)
    keys = middle + rng.uniform(-0.06, 0.06, (count + 2, size))
    limits = Limits(np.full(size, speed), np.full(size, 2.0))
    return synthesize(OptimalBasis.uniform(count), keys, np.zeros(size), np.zeros(size), limits)


def loops(middle, duration, rate):
    """Circles of 8 cm as a dense quintic."""
    t = np.arange(0.0, duration + 1e-9, 0.1)[:, None]
    phase = 2 * np.pi * rate * t + 0.7 * np.arange(len(middle))
    w = 2 * np.pi * rate
    return Trajectory.from_points(
        t[:, 0], middle + 0.08 * np.sin(phase), 0.08 * w * np.cos(phase), -0.08 * w * w * np.sin(phase)
    )


def test_tools_follow_the_plane(case):
    tool_plane, middle = case
    plane = wander(middle).shifted(3.0)
    followed = follow_plane(plane, tool_plane)
    joints = followed.trajectory
    assert followed.stretch == 1.0 and followed.height_deviation < 1e-6
    assert (joints.start_time, joints.end_time) == (plane.start_time, plane.end_time)
    assert np.diff(joints.times).max() <= 0.02 + 1e-9
    assert set(plane.times) <= set(joints.times)
    expected = tool_plane.joint_motion(plane(joints.times), plane(joints.times, 1), plane(joints.times, 2))
    for order in (0, 1):
        np.testing.assert_allclose(joints(joints.times, order), expected[order], atol=1e-9)
    np.testing.assert_allclose(joints(joints.times, 2), expected[2], atol=1e-6)
    times = np.linspace(plane.start_time, plane.end_time, 3001)
    np.testing.assert_allclose(tool_plane.tool(joints(times)), plane(times), atol=1e-7)
    rates = tool_plane.tool_velocity(joints(times), joints(times, 1))
    np.testing.assert_allclose(rates, plane(times, 1), atol=1e-5)
    assert joints.violations(tool_plane.robot.limits) == []


def test_a_hundred_seconds_are_followed_as_well(case):
    tool_plane, middle = case
    plane = loops(middle, 100.0, 0.25)
    followed = follow_plane(plane, tool_plane)
    assert len(followed.trajectory.times) == 5001
    times = np.linspace(0.0, 100.0, 20_000)
    np.testing.assert_allclose(tool_plane.tool(followed.trajectory(times)), plane(times), atol=1e-6)


def test_steps_of_the_acceleration_are_followed_by_cubics(case):
    """Constant acceleration, then constant deceleration: a quintic would swing about the step."""
    tool_plane, middle = case
    along = 0.06 * np.ones_like(middle)
    plane = Trajectory.from_points([0.0, 0.3, 0.6], [middle, middle + along / 2, middle + along])
    times, positions = plane.times, plane(plane.times)
    velocities = np.array([np.zeros_like(middle), along / 0.3, np.zeros_like(middle)])
    plane = Trajectory.from_points(times, positions, velocities)
    joints = follow_plane(plane, tool_plane).trajectory
    assert np.abs(joints.coefficients[:, 4:]).max() == 0.0
    dense = np.linspace(0.0, 0.6, 1001)
    np.testing.assert_allclose(tool_plane.tool(joints(dense)), plane(dense), atol=1e-6)
    exact = tool_plane.joint_motion(plane(dense), plane(dense, 1), plane(dense, 2))[2]
    np.testing.assert_allclose(joints(dense, 2)[2:-2], exact[2:-2], atol=0.1 * np.abs(exact).max())


@pytest.mark.parametrize("rate", [3.0, 8.0])
def test_too_fast_a_motion_is_slowed_down_as_much_as_needed_and_keeps_its_path(case, rate):
    tool_plane, middle = case
    plane = loops(middle, 1.0, 0.5)
    fast = Trajectory(plane.times / rate, plane.coefficients * rate ** np.arange(6.0)[:, None])
    limits = tool_plane.robot.limits
    followed = follow_plane(fast, tool_plane, spacing=0.02 / rate)
    joints = followed.trajectory
    assert followed.stretch > 1.0
    assert joints.duration == pytest.approx(followed.stretch * fast.duration)
    assert joints.violations(limits) == []
    shares = [
        np.abs(joints.extrema(k)).max(axis=0) / part
        for k, part in enumerate((1.0, limits.velocity, limits.acceleration))
    ]
    assert max(shares[1].max(), shares[2].max()) == pytest.approx(1.0, abs=1e-6), "no slower than needed"
    share = np.linspace(0.0, 1.0, 500)
    on_path = fast(fast.start_time + share * fast.duration)
    np.testing.assert_allclose(
        tool_plane.tool(joints(joints.start_time + share * joints.duration)), on_path, atol=1e-6
    )


def test_what_cannot_be_followed_is_said_in_words(case):
    tool_plane, middle = case
    away = middle.copy()
    away[0] += 0.6
    still = np.zeros((2, len(middle)))
    with pytest.raises(InfeasibleError, match=r"at 0\.\d+ s the tool at .* is out of reach"):
        follow_plane(Trajectory.from_points([0.0, 1.0], [middle, away], still), tool_plane)
    with pytest.raises(InfeasibleError, match=r"leave its height by .* mm"):
        follow_plane(wander(middle), tool_plane, spacing=0.5, height_tolerance=1e-9)
    with pytest.raises(InvalidInputError, match="has 1 coordinates"):
        follow_plane(Trajectory.from_points([0.0, 1.0], [[0.5], [0.6]]), tool_plane)
    with pytest.raises(InvalidInputError, match="spacing"):
        follow_plane(wander(middle), tool_plane, spacing=0.0)
    corner = Trajectory.from_points([0.0, 1.0, 2.0], [middle, middle + 0.01, middle])
    with pytest.raises(InvalidInputError, match=r"steps in velocity by 0\.02"):
        follow_plane(corner, tool_plane)


def test_joint_limits_that_the_plane_does_not_know_are_checked():
    """The rod's map covers all around the base, joint 1 does not."""
    angle = np.linspace(2.5, 3.0, 40)
    circle = 0.5 * np.column_stack([np.cos(angle), np.sin(angle)])
    rates = 0.5 * 0.1 * np.column_stack([-np.sin(angle), np.cos(angle)])
    plane = Trajectory.from_points(10.0 * angle - 25.0, circle, rates)
    with pytest.raises(InfeasibleError, match="position of joint 1"):
        follow_plane(plane, TableMap(fr3_pusher()))
