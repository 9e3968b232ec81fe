"""The impedance controller on an arm without and with friction."""

import numpy as np
import pytest

from sim_bridge.impedance import (
    ImpedanceConfig,
    ImpedanceController,
    JointController,
    critical_damping,
)
from sim_bridge.scene import Scene
from sim_bridge.simulation import Simulation
from sim_bridge.trajectory_follower import TrajectoryCommand
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.robot.inverse_kinematics import TableMap
from vpsto_ros.robot.kinematics import JOINT_NAMES, fr3_pusher

AWAY = (1.2, 1.2, 0.0)  # the object, out of the arm's way


@pytest.fixture
def posture():
    return TableMap(fr3_pusher()).joints([[0.5, 0.0]])[0]


def test_the_law_is_equation_2_5(posture):
    robot = fr3_pusher()
    controller = ImpedanceController(robot, posture)
    rng = np.random.default_rng(0)
    q, qd = posture + 1e-3 * rng.normal(size=7), 1e-2 * rng.normal(size=7)
    q_des, qd_des, qdd_des = posture, 1e-2 * rng.normal(size=7), rng.normal(size=7)
    stiffness = np.diag(ImpedanceConfig().stiffness)
    damping = critical_damping(robot.mass_matrix(posture), np.diag(stiffness))
    coriolis_gravity = robot.inverse_dynamics(q, qd, np.zeros(7))
    expected = (
        coriolis_gravity - stiffness @ (q - q_des) - damping @ (qd - qd_des) + robot.mass_matrix(q) @ qdd_des
    )
    np.testing.assert_allclose(controller.torque(q, qd, q_des, qd_des, qdd_des), expected, atol=1e-9)
    assert controller.saturated.sum() == controller.rate_limited.sum() == 0


def test_every_mode_is_critically_damped(posture):
    mass, stiffness = fr3_pusher().mass_matrix(posture), np.array(ImpedanceConfig().stiffness)
    damping = critical_damping(mass, stiffness)
    assert np.all(np.linalg.eigvalsh(damping) > 0.0)
    inverse = np.linalg.inv(mass)
    system = np.block([[np.zeros((7, 7)), np.eye(7)], [-inverse @ np.diag(stiffness), -inverse @ damping]])
    poles = np.linalg.eigvals(system)
    # Double real poles split by the square root of the round-off.
    assert np.abs(poles.imag).max() < 1e-4 * np.abs(poles.real).max()


def test_torques_and_their_rates_are_cut_and_counted(posture):
    controller = ImpedanceController(fr3_pusher(), posture)
    zero = np.zeros(7)
    gravity = controller.torque(posture, zero, posture, zero, zero).copy()
    far = posture.copy()
    far[[1, 4]] += 0.5
    stepped = controller.torque(posture, zero, far, zero, zero).copy()
    np.testing.assert_allclose((stepped - gravity)[[1, 4]], 1.0)  # 1000 Nm/s in a millisecond
    np.testing.assert_allclose(np.delete(stepped - gravity, [1, 4]), 0.0, atol=1e-12)
    for _ in range(200):
        torque = controller.torque(posture, zero, far, zero, zero)
    np.testing.assert_allclose(np.abs(torque[[1, 4]]), [87.0, 12.0])
    assert np.flatnonzero(controller.saturated).tolist() == [1, 4]
    assert np.flatnonzero(controller.rate_limited).tolist() == [1, 4]
    assert np.all(controller.demand[0, [1, 4]] > 1.0)
    controller.reset()
    np.testing.assert_allclose(controller.torque(posture, zero, posture, zero, zero), gravity)


def test_a_steady_force_bends_the_arm_by_its_compliance():
    """Eq. (2.7): at rest tau_ext = K (q - q_des), hence J K^-1 J' F at the tip without joint friction."""
    simulation = Simulation(Scene(object_pose=AWAY, start_tool=(0.5, 0.0), joint_friction=0.0))
    start, q = simulation.tool_position(), simulation.joint_position
    force = np.array([3.0, -5.0, 0.0])
    body = simulation.model.body("tool").id
    simulation.data.xfrc_applied[body, :3] = force
    simulation.data.xfrc_applied[body, 3:] = np.cross(start - simulation.data.xipos[body], force)
    simulation.advance(3.0)
    jacobian = fr3_pusher().jacobian(q)[:3]
    expected = jacobian @ np.diag(1.0 / np.array(ImpedanceConfig().stiffness)) @ jacobian.T @ force
    np.testing.assert_allclose(simulation.tool_position() - start, expected, atol=5e-5)


@pytest.mark.parametrize("radius", [0.35, 0.5, 0.65])
def test_a_push_of_6_newton_costs_at_most_3_millimetres(radius):
    q = TableMap(fr3_pusher()).joints([[radius, 0.0]])[0]
    jacobian = fr3_pusher().jacobian(q)[:2]
    compliance = jacobian @ np.diag(1.0 / np.array(ImpedanceConfig().stiffness)) @ jacobian.T
    assert 6.0 * np.linalg.eigvalsh(compliance).max() < 0.003


def test_without_friction_the_reference_is_followed_closely_and_with_it_within_a_millimetre():
    table = TableMap(fr3_pusher())
    worst = {}
    for scale in (0.0, 1.0):
        simulation = Simulation(
            Scene(object_pose=AWAY, start_tool=(0.45, -0.2), joint_friction=scale, joint_damping=scale)
        )
        s = np.linspace(0.0, 1.0, 150)[:, None]
        path, along = np.array([[0.45, -0.2]]), np.array([[0.05, 0.4]])
        q, qd, qdd = table.joint_motion(
            path + (10 * s**3 - 15 * s**4 + 6 * s**5) * along,
            30 * (s * (1 - s)) ** 2 * along / 2.2,
            60 * s * (1 - s) * (1 - 2 * s) * along / 2.2**2,
        )
        qd[-1] = 0.0
        simulation.follower.accept(TrajectoryCommand(JOINT_NAMES, 0.0, 2.2 * s[:, 0], q, qd, qdd), 0.0)
        trajectory = simulation.follower.active
        errors = []
        for _ in range(2400):
            simulation.step()
            errors.append(
                np.linalg.norm(simulation.tool_position()[:2] - table.tool(trajectory(simulation.time)))
            )
        worst[scale] = max(errors)
        assert simulation.tool_height_deviation < 2e-4
        assert simulation.limits.violations == 0
    assert worst[0.0] < 5e-5
    assert worst[1.0] < 1e-3


def test_misuse_is_named(posture):
    with pytest.raises(ConfigurationError, match="stiffness"):
        ImpedanceConfig(stiffness=(1.0, 2.0))
    with pytest.raises(InvalidInputError, match="period"):
        ImpedanceController(fr3_pusher(), posture, period=0.0)


def test_gains_can_be_given(posture):
    robot, zero = fr3_pusher(), np.zeros(7)
    stiffness, damping = np.arange(1.0, 8.0), np.diag(np.arange(0.1, 0.8, 0.1))
    controller = JointController(robot, stiffness, damping)
    q, qd = posture + 1e-3, np.full(7, 1e-2)
    expected = robot.inverse_dynamics(q, qd, zero) - 1e-3 * stiffness - 1e-2 * damping.diagonal()
    np.testing.assert_allclose(controller.torque(q, qd, posture, zero, zero), expected, atol=1e-9)
    with pytest.raises(InvalidInputError, match=r"damping \(7, 7\), got \(7,\) and \(7,\)"):
        JointController(robot, stiffness, damping.diagonal())
