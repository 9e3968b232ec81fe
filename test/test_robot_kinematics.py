"""The arm against an independent modified-DH chain and against MuJoCo."""

import math

import mujoco
import numpy as np
import pytest

from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.robot.kinematics import (
    JOINT_NAMES,
    MODEL_PATH,
    Robot,
    forward_kinematics_batch,
    fr3_pusher,
    tip_velocity_batch,
)

# (a, d, alpha) of the modified Denavit-Hartenberg convention, from the maker's data sheet.
DH = [
    (0, 0.333, 0),
    (0, 0, -math.pi / 2),
    (0, 0.316, math.pi / 2),
    (0.0825, 0, math.pi / 2),
    (-0.0825, 0.384, -math.pi / 2),
    (0, 0, math.pi / 2),
    (0.088, 0, math.pi / 2),
]


def modified_dh(q):
    """Pose of the tip by multiplying textbook 4x4 matrices."""
    pose = np.eye(4)
    for (a, d, alpha), angle in zip(DH, q, strict=True):
        ca, sa, c, s = math.cos(alpha), math.sin(alpha), math.cos(angle), math.sin(angle)
        pose = pose @ np.array(
            [[c, -s, 0, a], [s * ca, c * ca, -sa, -d * sa], [s * sa, c * sa, ca, d * ca], [0, 0, 0, 1]]
        )
    lift = np.eye(4)
    lift[2, 3] = 0.107 + 0.16
    return pose @ lift


@pytest.fixture(scope="module")
def postures():
    limits = fr3_pusher().limits
    return np.random.default_rng(1).uniform(limits.lower, limits.upper, (100, 7))


@pytest.fixture(scope="module")
def simulated():
    model = mujoco.MjModel.from_xml_path(str(MODEL_PATH))
    return model, mujoco.MjData(model)


def test_forward_kinematics_agrees_with_textbook_matrices(postures):
    robot = fr3_pusher()
    batch = forward_kinematics_batch(postures)
    for q, tip in zip(postures, batch, strict=True):
        pose = modified_dh(q)
        position, rotation = robot.forward(q)
        np.testing.assert_allclose(position, pose[:3, 3], atol=1e-12)
        np.testing.assert_allclose(rotation, pose[:3, :3], atol=1e-12)
        np.testing.assert_allclose(tip, pose[:3, 3], atol=1e-12)


def test_mujoco_and_pinocchio_read_the_same_arm(postures, simulated):
    robot, (model, data) = fr3_pusher(), simulated
    rng = np.random.default_rng(2)
    inertia = np.empty((7, 7))
    for q in postures:
        qd, qdd = rng.normal(size=(2, 7))
        data.qpos[:], data.qvel[:] = q, qd
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        np.testing.assert_allclose(data.site("tool_tip").xpos, robot.forward(q)[0], atol=1e-9)
        np.testing.assert_allclose(robot.mass_matrix(q), inertia, atol=1e-9)
        np.testing.assert_allclose(
            robot.inverse_dynamics(q, qd, qdd), inertia @ qdd + data.qfrc_bias, atol=1e-9
        )
        data.qvel[:] = 0.0
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(
            robot.inverse_dynamics(q, np.zeros(7), np.zeros(7)), data.qfrc_bias, atol=1e-9
        )


def test_tip_velocity_is_jacobian_times_joint_velocity(postures):
    robot = fr3_pusher()
    rates = np.random.default_rng(3).normal(size=postures.shape)
    expected = [(robot.jacobian(q) @ qd)[:3] for q, qd in zip(postures, rates, strict=True)]
    np.testing.assert_allclose(tip_velocity_batch(postures, rates), expected, atol=1e-12)


def test_tip_velocity_is_the_derivative_of_the_position(postures):
    rates = np.random.default_rng(4).normal(size=postures.shape)
    step = 1e-6
    difference = forward_kinematics_batch(postures + step * rates) - forward_kinematics_batch(
        postures - step * rates
    )
    np.testing.assert_allclose(tip_velocity_batch(postures, rates), difference / (2 * step), atol=1e-8)


def test_limits_are_those_of_the_fr3():
    robot = fr3_pusher()
    assert robot.joint_names == JOINT_NAMES
    np.testing.assert_allclose(robot.limits.upper, [2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159])
    np.testing.assert_allclose(
        robot.limits.lower, [-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159]
    )
    np.testing.assert_allclose(robot.limits.velocity, [2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26])
    np.testing.assert_allclose(robot.limits.acceleration, 10.0)
    np.testing.assert_allclose(robot.torque_limits, [87, 87, 87, 87, 12, 12, 12])
    np.testing.assert_allclose(robot.torque_rate_limits, 1000.0)


def test_gravity_is_the_gradient_of_the_potential_energy(postures, simulated):
    """Independent of both libraries' recursions: heights of the centres of mass, differentiated."""
    model, data = simulated

    def energy(q):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        return 9.81 * float(model.body_mass @ data.xipos[:, 2])

    q, step = postures[0], 1e-5
    gradient = [(energy(q + step * axis) - energy(q - step * axis)) / (2 * step) for axis in np.eye(7)]
    np.testing.assert_allclose(
        fr3_pusher().inverse_dynamics(q, np.zeros(7), np.zeros(7)), gradient, atol=1e-6
    )


@pytest.mark.parametrize("shape", [(7,), (3, 6), (2, 2, 7)])
def test_wrong_shapes_are_refused(shape):
    with pytest.raises(InvalidInputError, match="shape"):
        forward_kinematics_batch(np.zeros(shape))


def test_misuse_is_named():
    with pytest.raises(InvalidInputError, match="rows"):
        tip_velocity_batch(np.zeros((2, 7)), np.zeros((3, 7)))
    with pytest.raises(InvalidInputError, match="q must have shape"):
        fr3_pusher().forward(np.zeros(6))
    with pytest.raises(ConfigurationError, match="no robot description"):
        Robot.from_mjcf("nowhere.xml")
    with pytest.raises(ConfigurationError, match=r"no frame 'hand'.*tool_tip"):
        Robot.from_mjcf(MODEL_PATH, tip="hand")
    with pytest.raises(ConfigurationError, match="velocity must be 7 positive"):
        Robot.from_mjcf(MODEL_PATH, velocity=[1.0] * 6)


def test_ordinary_postures_do_not_collide(simulated):
    model, data = simulated
    ready = [0, -math.pi / 4, 0, -3 * math.pi / 4, 0, math.pi / 2, math.pi / 4]
    for q in (
        ready,
        [0, 0.3, 0, -2.3, 0, 2.6, 0.8],
        [1.0, -0.5, 0.5, -2.0, -0.6, 2.0, 0],
        [0, 0, 0, -0.2, 0, 1.8, 0],
    ):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        assert data.ncon == 0, q


def test_a_folded_arm_does_collide(simulated):
    """The collision geometry is there at all: the flange pressed against the base."""
    model, data = simulated
    data.qpos[:] = [0, -1.6, 0, -3.04, 0, 0.6, 0]
    mujoco.mj_forward(model, data)
    assert data.ncon > 0
