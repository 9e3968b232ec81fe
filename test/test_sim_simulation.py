"""The whole plant in lock-step: determinism, disturbances, bookkeeping of limits, and pushing."""

import numpy as np
import pytest

from sim_bridge.camera import CameraConfig
from sim_bridge.scene import ObjectPlant, Scene
from sim_bridge.simulation import Simulation
from sim_bridge.trajectory_follower import TrajectoryCommand
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.inverse_kinematics import TableMap
from vpsto_ros.robot.kinematics import JOINT_NAMES, fr3_pusher


def straight(start, end, duration, stamp, count=120):
    """Minimum-jerk motion of the rod along a line, as a command."""
    s = np.linspace(0.0, 1.0, count)[:, None]
    along = np.subtract(end, start)[None]
    q, qd, qdd = TableMap(fr3_pusher()).joint_motion(
        start + (10 * s**3 - 15 * s**4 + 6 * s**5) * along,
        30 * (s * (1 - s)) ** 2 * along / duration,
        60 * s * (1 - s) * (1 - 2 * s) * along / duration**2,
    )
    qd[[0, -1]] = 0.0
    return TrajectoryCommand(JOINT_NAMES, stamp, duration * s[:, 0], q, qd, qdd)


def pushed(seed=0, **plant):
    simulation = Simulation(Scene(plant=ObjectPlant(**plant), start_tool=(0.5, -0.2)), seed=seed)
    simulation.follower.accept(straight((0.5, -0.2), (0.5, 0.05), 2.0, simulation.time), simulation.time)
    simulation.advance(2.3)
    return simulation


def test_the_rod_pushes_the_box_as_far_as_it_goes():
    simulation = pushed()
    x, y, yaw = simulation.object_pose()
    # The rod ends at y = 0.05: its radius and half a side further is the box, give or take compliance.
    assert y == pytest.approx(0.05 + 0.015 + 0.06, abs=2e-3)
    assert abs(x - 0.5) < 2e-3
    assert abs(yaw) < 0.05
    np.testing.assert_allclose(simulation.tool_position(), [0.5, 0.05, 0.02], atol=2e-3)


def test_the_pushing_force_is_the_table_friction():
    plant = {"mass": 0.8, "table_friction": 0.4}
    simulation = Simulation(Scene(plant=ObjectPlant(**plant), start_tool=(0.5, -0.2)))
    simulation.follower.accept(straight((0.5, -0.2), (0.5, 0.05), 4.0, 0.0), 0.0)
    simulation.advance(2.0)
    forces = []
    for _ in range(1000):
        simulation.step()
        forces.append(simulation.tool_contact_force())
    mean = np.mean(forces, axis=0)
    assert mean[1] == pytest.approx(0.4 * 0.8 * 9.81, rel=0.05)
    assert abs(mean[0]) < 0.3


@pytest.mark.parametrize("shape", [PlanarShape.tee(), PlanarShape.disc(0.05)], ids=["tee", "disc"])
def test_other_shapes_are_pushed_too(shape):
    assert pushed(shape=shape).object_pose()[1] > 0.05


def test_same_seed_same_run_and_another_seed_differs_only_in_the_camera():
    first, second, third = pushed(), pushed(), pushed(seed=1)
    np.testing.assert_array_equal(first.object_pose(), second.object_pose())
    np.testing.assert_array_equal(first.object_pose(), third.object_pose())
    frames = [simulation.camera_frames() for simulation in (first, second, third)]
    assert [f.pose.tolist() for f in frames[0]] == [f.pose.tolist() for f in frames[1]]
    assert [f.pose.tolist() for f in frames[0]] != [f.pose.tolist() for f in frames[2]]


def test_an_ordinary_push_breaks_no_limit_but_the_torque_rate_at_the_impact():
    simulation = pushed()
    report = simulation.limits.report()
    assert {kind for kind, seen in report.items() if seen.instants} <= {"torque_rate"}
    assert report["torque_rate"].instants < 20
    assert report["reference_velocity"].worst > 0.0
    assert 1 <= report["torque"].joint <= 7
    assert simulation.limits.instants == simulation.steps == 2300
    assert simulation.tool_height_deviation < 1e-3
    assert simulation.controller.saturated.sum() == 0


def test_limits_that_are_broken_are_counted():
    simulation = Simulation()
    q = simulation.joint_position
    demand = np.zeros((2, 7))
    demand[1, 2] = 1.5
    fast = np.zeros(7)
    fast[4] = -6.0
    simulation.limits.observe(
        q, fast, np.full(7, 9.9), q + np.array([4, 0, 0, 0, 0, 0, 0]), np.zeros(7), demand
    )
    report = simulation.limits.report()
    seen = {kind: entry.instants for kind, entry in report.items() if entry.instants}
    assert seen == {"reference_velocity": 1, "joint_position": 1, "torque_rate": 1}
    assert (report["reference_velocity"].joint, report["torque_rate"].joint) == (5, 3)
    assert report["reference_velocity"].worst == pytest.approx(6.0 / 5.26)
    assert simulation.limits.violations == 2  # cuts of the torque rate are no violations
    simulation.limits.reset()
    assert simulation.limits.violations == simulation.limits.instants == 0


@pytest.mark.parametrize("displacement", [(0.05, 0.0), (-0.03, 0.08), (0.0, -0.1)])
@pytest.mark.parametrize(
    "plant", [{}, {"mass": 1.0, "table_friction": 0.6}, {"mass": 0.2, "table_friction": 0.2}]
)
def test_a_knock_moves_the_object_about_that_far(displacement, plant):
    simulation = Simulation(Scene(plant=ObjectPlant(**plant), start_tool=(0.35, 0.25)))
    before = simulation.object_pose()
    simulation.knock(displacement)
    simulation.advance(0.5)
    np.testing.assert_allclose((simulation.object_pose() - before)[:2], displacement, atol=0.005)
    assert abs(simulation.object_twist()[:2]).max() < 1e-3


def test_a_knock_against_the_rod_gives_way():
    simulation = Simulation(Scene(object_pose=(0.5, 0.0, 0.0), start_tool=(0.5, -0.09)))
    simulation.knock((0.0, -0.08))
    simulation.advance(0.6)
    assert simulation.object_pose()[1] > -0.03
    assert np.linalg.norm(simulation.tool_position()[:2] - [0.5, -0.09]) < 0.02


def test_a_push_acts_for_its_duration_only():
    simulation = Simulation()
    simulation.push_object((3.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.1)
    simulation.advance(0.1)
    assert simulation.object_twist()[0] > 0.1
    simulation.advance(0.5)
    assert abs(simulation.object_twist()[0]) < 1e-3
    assert not simulation.data.xfrc_applied.any()


def test_disturbances_add_up():
    simulation = Simulation()
    simulation.push_object((3.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.2)
    simulation.push_object((-3.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.2)
    before = simulation.object_pose()
    simulation.advance(0.2)
    np.testing.assert_allclose(simulation.object_pose(), before, atol=1e-5)


def test_pose_and_twist_agree():
    simulation = Simulation(Scene(object_pose=(0.5, 0.0, 3.0)))
    simulation.push_object((2.5, 1.0, 0.0), (0.0, 0.0, 0.15), 1.0)
    simulation.advance(0.2)
    before = simulation.object_pose()
    simulation.step()
    # Semi-implicit integration moves the pose with the velocity after the step.
    twist = simulation.object_twist()
    turn = (simulation.object_pose() - before + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turn / 1e-3, twist, atol=1e-3)
    assert abs(twist[2]) > 0.1


def test_reset_puts_everything_back_while_time_goes_on():
    simulation = pushed()
    at = simulation.time
    simulation.reset(object_pose=(0.45, 0.1, 0.7))
    np.testing.assert_allclose(simulation.object_pose(), [0.45, 0.1, 0.7], atol=1e-12)
    np.testing.assert_allclose(simulation.joint_position, simulation.scene.joints())
    assert simulation.time == at
    assert simulation.camera_frames() == []
    simulation.advance(0.3)
    np.testing.assert_allclose(simulation.joint_position, simulation.scene.joints(), atol=1e-3)
    np.testing.assert_allclose(simulation.object_pose(), [0.45, 0.1, 0.7], atol=1e-4)


def test_the_camera_sees_the_object():
    simulation = Simulation(camera=CameraConfig(position_std=0.0, yaw_std=0.0, dropout=0.0))
    simulation.advance(0.1)
    frames = simulation.camera_frames()
    assert [round(frame.stamp, 6) for frame in frames] == [0.0, 0.02, 0.04, 0.06]
    np.testing.assert_allclose(frames[-1].pose, [0.5, 0.0, 0.0], atol=1e-6)


def test_time_counts_milliseconds_exactly():
    simulation = Simulation()
    simulation.advance(0.3)
    assert simulation.steps == 300
    assert simulation.time == pytest.approx(0.3, abs=1e-12)


def test_the_goal_marker_is_only_seen():
    simulation = Simulation()
    simulation.data.mocap_pos[simulation.model.body("goal").mocapid[0]] = (0.51, 0.01, 0.0)
    simulation.advance(0.1)
    np.testing.assert_allclose(simulation.object_pose(), [0.5, 0.0, 0.0], atol=1e-6)


@pytest.mark.parametrize(
    ("misuse", "message"),
    [
        (lambda s: s.knock((0.1, np.nan)), "displacement"),
        (lambda s: s.push_object((1.0, 0.0), (0.0, 0.0, 0.0), 0.1), "force"),
        (lambda s: s.push_object((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0), "duration"),
        (lambda s: s.reset(joints=np.zeros(7)), "position limits"),
        (lambda s: s.reset(object_pose=(0.0, 0.0)), "object_pose"),
    ],
)
def test_misuse_is_named(misuse, message):
    with pytest.raises(InvalidInputError, match=message):
        misuse(Simulation())
