"""The compiled kinematics of the iiwa against Pinocchio's and against finite differences."""

import numpy as np
import pytest

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.planning.hockey.rules import PlayRules
from vpsto_ros.robot.iiwa import iiwa14
from vpsto_ros.robot.iiwa_kinematics import (
    FOREARM,
    SHOULDER,
    UPPER_ARM,
    arm_points,
    chain,
    jacobian,
    move_to,
    move_to_height,
)

HOME = np.array(PlayRules().home)


def kinematics(q):
    """Points, axes and Jacobian of one posture."""
    points, axes, jac = np.empty((4, 3)), np.empty((7, 3)), np.empty((3, 6))
    chain(q, points, axes)
    jacobian(points, axes, jac)
    return points, axes, jac


def workspace():
    return np.empty((4, 3)), np.empty((7, 3)), np.empty((3, 6))


@pytest.fixture(scope="module")
def postures():
    limits = iiwa14().limits
    return np.random.default_rng(1001).uniform(limits.lower, limits.upper, (60, 7))


def test_the_universal_joint_and_the_rod_are_pinocchios(postures):
    robot = iiwa14()
    for q in [HOME, np.zeros(7), *postures]:
        points, axes, _ = kinematics(q)
        place, turn = robot.forward(q)
        np.testing.assert_allclose(points[3], place, atol=1e-12)
        np.testing.assert_allclose(axes[6], turn[:, 2], atol=1e-12)


def test_the_jacobian_is_pinocchios_and_joint_seven_moves_nothing(postures):
    robot = iiwa14()
    for q in [HOME, np.zeros(7), *postures]:
        _, axes, jac = kinematics(q)
        full = robot.jacobian(q)
        np.testing.assert_allclose(jac, full[:3, :6], atol=1e-12)
        np.testing.assert_allclose(full[:3, 6], 0.0, atol=1e-12)
        np.testing.assert_allclose(axes.T, full[3:], atol=1e-12)


def test_the_jacobian_is_the_derivative(postures):
    step = 1e-6
    for q in postures[:20]:
        jac = kinematics(q)[2]
        for j in range(6):
            ahead = np.zeros(7)
            ahead[j] = step
            slope = (kinematics(q + ahead)[0][3] - kinematics(q - ahead)[0][3]) / (2.0 * step)
            np.testing.assert_allclose(jac[:, j], slope, atol=1e-8)


def test_links_keep_their_lengths_and_every_axis_its_points(postures):
    for q in postures:
        points, axes, _ = kinematics(q)
        np.testing.assert_allclose(points[0], [0.0, 0.0, SHOULDER])
        lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
        np.testing.assert_allclose(lengths, [UPPER_ARM, FOREARM, 0.666], atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0, atol=1e-12)
        # Odd joints turn about the link that they end, so that they do not move its end.
        for k in range(3):
            np.testing.assert_allclose(np.cross(axes[2 * k + 2], points[k + 1] - points[k]), 0.0, atol=1e-12)


def test_many_postures_at_once(postures):
    expected = np.stack([kinematics(q)[0] for q in postures])
    np.testing.assert_array_equal(arm_points(postures), expected)
    for bad in (HOME, postures[:, :6], np.zeros((2, 2, 7))):
        with pytest.raises(InvalidInputError, match=r"\(B, 7\)"):
            arm_points(bad)


def test_moving_to_a_place_gets_there_by_about_the_least_motion():
    rng, robot = np.random.default_rng(1002), iiwa14()
    for _ in range(50):
        q = HOME + 0.3 * rng.standard_normal(7)
        aim = robot.forward(q)[0] + 0.02 * rng.standard_normal(3)
        moved, work = q.copy(), workspace()
        assert move_to(moved, *aim, *work)
        np.testing.assert_allclose(robot.forward(moved)[0], aim, atol=1e-7)
        assert moved[6] == q[6]
        # Outputs are those of the result, not of an iterate before it.
        for given, expected in zip(work, kinematics(moved), strict=True):
            np.testing.assert_allclose(given, expected, atol=1e-12)
        least = np.linalg.pinv(robot.jacobian(q)[:3, :6]) @ (aim - robot.forward(q)[0])
        assert np.linalg.norm(moved - q) < 1.2 * np.linalg.norm(least) + 1e-3


def test_a_place_out_of_reach_is_told():
    reach = UPPER_ARM + FOREARM + 0.666
    assert not move_to(HOME.copy(), reach + 0.1, 0.0, SHOULDER, *workspace())
    assert not move_to(HOME.copy(), 5.0, 0.0, 0.1645, *workspace())


def test_moving_to_the_plane_changes_the_height_by_the_least_motion():
    rng, robot = np.random.default_rng(1003), iiwa14()
    for _ in range(50):
        q = HOME + 0.2 * rng.standard_normal(7)
        low = q.copy()
        aim = robot.forward(q)[0][2] + 0.03 * rng.uniform(-1.0, 1.0)
        move_to_height(low, aim, *workspace())
        assert abs(robot.forward(low)[0][2] - aim) < 2e-4  # two Newton steps
        row = robot.jacobian(q)[2]
        least = row * (aim - robot.forward(q)[0][2]) / (row @ row)
        np.testing.assert_allclose(low - q, least, atol=0.2 * np.linalg.norm(least) + 1e-6)
