"""The closed-form map of the tool plane, its derivatives and limits; damped least squares."""

import mujoco
import numpy as np
import pytest

from vpsto_ros.exceptions import InfeasibleError, InvalidInputError
from vpsto_ros.robot.inverse_kinematics import TableMap, solve
from vpsto_ros.robot.kinematics import MODEL_PATH, forward_kinematics_batch, fr3_pusher

JOINTS = [0, 1, 3, 5]


@pytest.fixture(scope="module")
def table():
    return TableMap(fr3_pusher())


def plane_points(table, count, seed=0, margin=0.0):
    rng = np.random.default_rng(seed)
    low, high = table.radius_range
    radius = rng.uniform(low + margin, high - margin, count)
    angle = rng.uniform(-2.6, 2.6, count)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def test_tip_is_at_the_point_at_the_height_and_upright(table):
    points = plane_points(table, 200)
    q = table.joints(points)
    np.testing.assert_allclose(
        forward_kinematics_batch(q), np.column_stack([points, np.full(200, 0.02)]), atol=1e-12
    )
    for posture in q[::10]:
        np.testing.assert_allclose(fr3_pusher().forward(posture)[1][:, 2], [0, 0, -1], atol=1e-12)


@pytest.mark.parametrize("height", [0.005, 0.05, 0.12])
def test_other_heights(height):
    table = TableMap(fr3_pusher(), height)
    q = table.joints(plane_points(table, 20))
    np.testing.assert_allclose(forward_kinematics_batch(q)[:, 2], height, atol=1e-12)


def test_the_workspace_of_the_demos_is_covered(table):
    low, high = table.radius_range
    assert low < 0.305
    assert high > 0.75


def test_joint_limits_hold_in_the_whole_annulus_with_margin(table):
    limits = fr3_pusher().limits
    radii = np.linspace(*table.radius_range, 500)
    q = table.joints(np.column_stack([radii, np.zeros(500)]))
    assert np.all(q >= limits.lower + 0.02 - 1e-9)
    assert np.all(q <= limits.upper - 0.02 + 1e-9)


def test_the_arm_does_not_collide_with_itself_in_the_annulus(table):
    model = mujoco.MjModel.from_xml_path(str(MODEL_PATH))
    data = mujoco.MjData(model)
    for q in table.joints(np.column_stack([np.linspace(*table.radius_range, 60), np.zeros(60)])):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        assert data.ncon == 0, q


def test_jacobian_is_the_derivative(table):
    points, step = plane_points(table, 50, margin=0.01), 1e-6
    for k, axis in enumerate(np.eye(2)):
        difference = (table.joints(points + step * axis) - table.joints(points - step * axis)) / (2 * step)
        np.testing.assert_allclose(table.jacobian(points)[:, :, k], difference, rtol=1e-6, atol=1e-6)


def test_motion_of_joints_is_the_derivative_along_a_path(table):
    rng = np.random.default_rng(5)
    points = plane_points(table, 60, seed=6, margin=0.02)
    velocity, acceleration = rng.normal(size=(2, 60, 2)) * 0.3

    def joints(t):
        return table.joints(points + t * velocity + 0.5 * t * t * acceleration)

    q, qd, qdd = table.joint_motion(points, velocity, acceleration)
    step = 1e-4
    before, after = joints(-step), joints(step)
    np.testing.assert_allclose(q, table.joints(points))
    np.testing.assert_allclose(qd, (after - before) / (2 * step), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(qdd, (after - 2 * q + before) / step**2, rtol=1e-4, atol=1e-3)


def test_velocities_map_there_and_back(table):
    points = plane_points(table, 30)
    velocity = np.random.default_rng(7).normal(size=(30, 2))
    qd = table.joint_velocity(points, velocity)
    q = table.joints(points)
    np.testing.assert_allclose(table.tool(q), points, atol=1e-12)
    np.testing.assert_allclose(table.tool_velocity(q, qd), velocity, atol=1e-12)
    np.testing.assert_allclose(table.tool_velocity(q[0], qd[0]), velocity[0], atol=1e-12)
    np.testing.assert_allclose(table.joint_velocity(points[0], velocity[0]), qd[0])


def test_out_of_reach_is_an_error_not_a_nan(table):
    assert not table.contains([0.9, 0.0])
    assert table.contains([[0.5, 0.1], [0.1, 0.1]]).tolist() == [True, False]
    with pytest.raises(InfeasibleError, match=r"cannot reach 0\.900 m.*usable radii"):
        table.joints([[0.5, 0.0], [0.9, 0.0]])
    with pytest.raises(InvalidInputError, match=r"shape \(K, 2\)"):
        table.joints([0.5, 0.0])


def test_solve_reaches_poses_near_its_seed():
    robot = fr3_pusher()
    rng = np.random.default_rng(9)
    limits = robot.limits
    middle, half = (limits.upper + limits.lower) / 2, (limits.upper - limits.lower) / 2
    for _ in range(30):
        q = middle + 0.8 * half * rng.uniform(-1, 1, 7)
        position, rotation = robot.forward(q)
        found = solve(robot, position, rotation, q + rng.normal(scale=0.1, size=7))
        reached = robot.forward(found)
        np.testing.assert_allclose(reached[0], position, atol=1e-7)
        np.testing.assert_allclose(reached[1], rotation, atol=1e-7)
        assert np.all((found >= limits.lower) & (found <= limits.upper))


def test_solve_agrees_with_the_closed_form(table):
    robot = fr3_pusher()
    expected = table.joints([[0.45, 0.2]])[0]
    position, rotation = robot.forward(expected)
    free = solve(robot, position, None, expected + 0.05)
    np.testing.assert_allclose(robot.forward(free)[0], position, atol=1e-7)
    bound = solve(robot, position, rotation, expected + 0.02)
    np.testing.assert_allclose(robot.forward(bound)[1], rotation, atol=1e-7)


def test_solve_says_when_there_is_no_posture(table):
    seed = table.joints([[0.45, 0.2]])[0]
    with pytest.raises(InfeasibleError, match="another seed"):
        solve(fr3_pusher(), [2.0, 0.0, 0.5], None, seed)
    with pytest.raises(InvalidInputError):
        solve(fr3_pusher(), [2.0, 0.0], None, seed)
