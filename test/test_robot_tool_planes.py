"""The two arms and the hand: true copies of one arm, tools as Pinocchio and MuJoCo see them, exact maps."""

import itertools
import xml.etree.ElementTree

import mujoco
import numpy as np
import pinocchio
import pytest

from vpsto_ros.exceptions import ConfigurationError, InfeasibleError, InvalidInputError
from vpsto_ros.robot import tip_kinematics as tools
from vpsto_ros.robot.bimanual_plane import WORKSPACE, BimanualPlane
from vpsto_ros.robot.hand_plane import HandPlane
from vpsto_ros.robot.inverse_kinematics import TableMap
from vpsto_ros.robot.kinematics import (
    BIMANUAL_MODEL_PATH,
    HAND_MODEL_PATH,
    MODEL_PATH,
    TIP_NAMES,
    fr3_bimanual,
    fr3_hand_pusher,
    fr3_pusher,
)

PLANES = {
    "rod": lambda height=0.02: TableMap(fr3_pusher(), height),
    "hand": lambda height=0.05: HandPlane(fr3_hand_pusher(), height),
    "balls": lambda height=0.035: BimanualPlane(fr3_bimanual(), height),
}
TIPS = {"rod": ("tool_tip",), "hand": ("tool_tip",), "balls": TIP_NAMES}
PATHS = {"rod": MODEL_PATH, "hand": HAND_MODEL_PATH, "balls": BIMANUAL_MODEL_PATH}
COPIES = [(HAND_MODEL_PATH, "", 0), (BIMANUAL_MODEL_PATH, "left_", 0), (BIMANUAL_MODEL_PATH, "right_", 7)]


@pytest.fixture(params=PLANES)
def name(request):
    return request.param


@pytest.fixture
def plane(name):
    return PLANES[name]()


def points_of(plane, count, seed=0):
    """Points within reach, spread over all of it."""
    rng, found = np.random.default_rng(seed), np.empty((0, plane.dof))
    low, high = [0.0, -0.8, 0.0, -0.8], [0.85, 0.8, 0.85, 0.8]
    if plane.dof == 3:
        low, high = [-0.85, -0.85, -3.0], [0.85, 0.85, 3.0]
    while len(found) < count:
        drawn = rng.uniform(low[: plane.dof], high[: plane.dof], (20 * count, plane.dof))
        found = np.concatenate([found, drawn[plane.contains(drawn, 0.01)]])
    return found[:count]


def postures_of(robot, count=100):
    lower, upper = robot.position_range
    return np.random.default_rng(1).uniform(lower, upper, (count, len(lower)))


def links(path, prefix):
    """Everything below each link of an arm but other bodies: attributes without the arm's prefix."""
    root = xml.etree.ElementTree.parse(path).getroot()
    bodies = {body.get("name"): body for body in root.iter("body")}
    found = {}
    for i in range(8):
        body = bodies[f"{prefix}fr3_link{i}"]
        place = {key: value for key, value in body.attrib.items() if key != "name" and (i or key != "pos")}
        parts = [(part.tag, sorted(part.attrib.items())) for part in body if part.tag != "body"]
        text = str((place, parts))
        found[i] = text.replace(f"'{prefix}", "'") if prefix else text
    return found


@pytest.mark.parametrize(("path", "prefix", "first"), COPIES)
def test_every_arm_is_the_one_of_the_rod(path, prefix, first):
    assert links(path, prefix) == links(MODEL_PATH, "")
    one, many = (pinocchio.buildModelFromMJCF(str(p)) for p in (MODEL_PATH, path))
    for j in range(1, 8):
        k = first + j
        if j > 1:
            np.testing.assert_allclose(
                many.jointPlacements[k].homogeneous, one.jointPlacements[j].homogeneous, atol=1e-15
            )
        if j < 7:  # link 7 carries the tool
            np.testing.assert_allclose(
                many.inertias[k].toDynamicParameters(), one.inertias[j].toDynamicParameters(), atol=1e-15
            )
    joints = slice(first, first + 7)
    np.testing.assert_array_equal(many.lowerPositionLimit[joints], one.lowerPositionLimit)
    np.testing.assert_array_equal(many.upperPositionLimit[joints], one.upperPositionLimit)
    np.testing.assert_array_equal(many.effortLimit[joints], one.effortLimit)


def test_the_constants_are_those_of_the_files():
    model = mujoco.MjModel.from_xml_path(str(BIMANUAL_MODEL_PATH))
    for i, side in enumerate(("left", "right")):
        np.testing.assert_array_equal(model.body(f"{side}_fr3_link0").pos, tools.BALL_BASES[i])
        tip = model.site(f"{side}_tool_tip").pos + model.body(f"{side}_tool").pos
        np.testing.assert_allclose(tip, tools.BALL_TIPS[i], atol=1e-12)
        np.testing.assert_array_equal(model.geom(f"{side}_ball").pos, model.site(f"{side}_tool_tip").pos)
        assert model.geom(f"{side}_ball").size[0] == tools.BALL_RADIUS
    model = mujoco.MjModel.from_xml_path(str(HAND_MODEL_PATH))
    np.testing.assert_array_equal(model.geom("hand").size[:2], tools.HAND_HALF_SIZE)
    np.testing.assert_array_equal(model.geom("hand").pos, model.site("tool_tip").pos)


def test_limits_are_those_of_one_arm_twice():
    one, two = fr3_pusher(), fr3_bimanual()
    sides = [f"{side}_{joint}" for side in ("left", "right") for joint in one.joint_names]
    assert two.joint_names == tuple(sides)
    for field in ("lower", "upper", "velocity", "acceleration"):
        np.testing.assert_array_equal(getattr(two.limits, field), np.tile(getattr(one.limits, field), 2))
    np.testing.assert_array_equal(two.torque_limits, np.tile(one.torque_limits, 2))
    np.testing.assert_array_equal(two.torque_rate_limits, np.tile(one.torque_rate_limits, 2))
    assert fr3_hand_pusher().joint_names == one.joint_names


def test_sines_and_cosines_agree_with_numpy():
    edges = np.arange(-40, 41) * np.pi / 4
    angles = np.concatenate([np.random.default_rng(0).uniform(-50, 50, 20_000), edges, edges + 1e-9, [-0.0]])
    sine, cosine = np.empty_like(angles), np.empty_like(angles)
    tools.sines_and_cosines(angles, sine, cosine)
    np.testing.assert_allclose(sine, np.sin(angles), rtol=0, atol=4e-16)
    np.testing.assert_allclose(cosine, np.cos(angles), rtol=0, atol=4e-16)


def test_mujoco_and_pinocchio_read_the_same_robot(name, plane):
    robot, model = plane.robot, mujoco.MjModel.from_xml_path(str(PATHS[name]))
    data, inertia = mujoco.MjData(model), np.empty((model.nv, model.nv))
    rng = np.random.default_rng(2)
    assert tuple(model.joint(i).name for i in range(model.njnt)) == robot.joint_names
    for q in postures_of(robot, 30):
        qd, qdd = rng.normal(size=(2, model.nv))
        data.qpos[:], data.qvel[:] = q, qd
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        np.testing.assert_allclose(robot.mass_matrix(q), inertia, atol=1e-9)
        np.testing.assert_allclose(
            robot.inverse_dynamics(q, qd, qdd), inertia @ qdd + data.qfrc_bias, atol=1e-9
        )
        for tip, position in zip(TIPS[name], plane.tips(q), strict=True):
            np.testing.assert_allclose(data.site(tip).xpos, robot.forward(q, tip)[0], atol=1e-9)
            np.testing.assert_allclose(position, data.site(tip).xpos, atol=1e-9)


def test_velocities_of_the_tips_are_jacobian_times_joint_velocity(name, plane):
    robot, q = plane.robot, postures_of(plane.robot)
    qd = np.random.default_rng(3).normal(size=q.shape)
    expected = [[robot.jacobian(a, tip)[:3] @ b for tip in TIPS[name]] for a, b in zip(q, qd, strict=True)]
    np.testing.assert_allclose(plane.tip_velocities(q, qd), expected, atol=1e-9)
    np.testing.assert_allclose(plane.tip_velocities(q[0], qd[0]), expected[0], atol=1e-9)


def test_any_shape_of_postures_is_taken(plane):
    q = postures_of(plane.robot, 12).reshape(3, 4, -1)
    tips = plane.tips(q)
    np.testing.assert_array_equal(tips[1, 2], plane.tips(q[1, 2]))
    np.testing.assert_array_equal(plane.tool_heights(q), tips[..., 2])
    assert plane.tool(q).shape == plane.tool_velocity(q, q).shape == (3, 4, plane.dof)


@pytest.mark.parametrize("raised", [0.0, 0.03, 0.1])
def test_tools_are_upright_at_their_points_and_height(name, raised):
    height = PLANES[name]().height + raised
    plane = PLANES[name](height)
    points = points_of(plane, 100)
    q = plane.joints(points)
    np.testing.assert_allclose(plane.tool(q), points, atol=1e-9)
    np.testing.assert_allclose(plane.tool_heights(q), height, atol=1e-9)
    for posture in q[::10]:
        for tip in TIPS[name]:
            np.testing.assert_allclose(plane.robot.forward(posture, tip)[1][:, 2], [0, 0, -1], atol=1e-9)


def test_joint_limits_hold_wherever_contains_says_so(plane):
    q = plane.joints(points_of(plane, 3000))
    lower, upper = plane.robot.position_range
    assert len(points_of(plane, 3000)) == 3000
    if plane.dof > 2:  # the rod's map leaves joint 1 to its workspace
        assert np.all((q > lower + 0.0199) & (q < upper - 0.0199))


def test_cranks_keep_their_direction():
    plane = PLANES["balls"]()
    for q in plane.joints(points_of(plane, 20)):
        for side, aside in zip(("left", "right"), (1.0, -1.0), strict=True):
            offset = (
                plane.robot.forward(q, f"{side}_flange")[0] - plane.robot.forward(q, f"{side}_tool_tip")[0]
            )
            np.testing.assert_allclose(offset, [0.0, aside * tools.CRANK, tools.BALL_DROP], atol=1e-9)


def test_motion_of_joints_is_the_derivative_along_a_path(plane):
    rng, points = np.random.default_rng(5), points_of(plane, 60, seed=6)
    velocity, acceleration = rng.normal(size=(2, *points.shape)) * 0.2

    def joints(t):
        return plane.joints(points + t * velocity + 0.5 * t * t * acceleration)

    q, qd, qdd = plane.joint_motion(points, velocity, acceleration)
    step = 1e-4
    before, after = joints(-step), joints(step)
    np.testing.assert_allclose(q, plane.joints(points))
    np.testing.assert_allclose(qd, (after - before) / (2 * step), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(qdd, (after - 2 * q + before) / step**2, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(plane.tool_velocity(q, qd), velocity, atol=1e-9)


def test_rates_of_a_leaning_hand_are_the_derivative_of_its_pose():
    plane, step = PLANES["hand"](), 1e-6
    q = plane.joints(points_of(plane, 20)) + np.random.default_rng(7).normal(scale=0.1, size=(20, 7))
    qd = np.random.default_rng(8).normal(size=q.shape)
    difference = (plane.tool(q + step * qd) - plane.tool(q - step * qd)) / (2 * step)
    np.testing.assert_allclose(plane.tool_velocity(q, qd), difference, atol=1e-7)


def test_the_yaw_of_the_hand_does_not_wrap():
    plane = PLANES["hand"]()
    turns = np.column_stack([np.full(50, 0.4), np.full(50, 0.2), np.linspace(-2.5, 3.4, 50)])
    assert plane.contains(turns).all()
    q = plane.joints(turns)
    np.testing.assert_allclose(plane.tool(q), turns, atol=1e-9)
    assert np.abs(np.diff(q, axis=0)).max() < 0.15


def pairs_of_balls(count, seed, near):
    """Both balls anywhere in the workspace, or close to each other in it."""
    rng, (x, y) = np.random.default_rng(seed), WORKSPACE
    points = rng.uniform([x[0], y[0]] * 2, [x[1], y[1]] * 2, (count, 4))
    if near:
        turn, reach = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.065, 0.2, count)
        points[:, 2:] = points[:, :2] + reach[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    return points[((points[:, 2:] >= [x[0], y[0]]) & (points[:, 2:] <= [x[1], y[1]])).all(axis=1)]


@pytest.mark.parametrize("near", [False, True])
def test_arms_keep_clear_of_each_other_and_themselves_where_the_rule_says_so(near):
    plane, model = PLANES["balls"](), mujoco.MjModel.from_xml_path(str(BIMANUAL_MODEL_PATH))
    data, points = mujoco.MjData(model), pairs_of_balls(4000, 3, near)
    assert plane.contains(points).all()
    apart = plane.arms_apart(points)
    assert 0.1 < apart.mean() < 1.0
    for k, q in enumerate(plane.joints(points)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        assert not (apart[k] and data.ncon), points[k]
    assert (plane.arms_apart(points, 0.02) <= apart).all()


def test_the_rule_leaves_five_millimetres_between_all_that_is_seen_of_the_arms():
    plane, model = PLANES["balls"](), mujoco.MjModel.from_xml_path(str(BIMANUAL_MODEL_PATH))
    data, points = mujoco.MjData(model), pairs_of_balls(400, 4, near=True)
    hulls = [i for i in range(model.ngeom) if model.geom(i).name.endswith("_envelope")]
    sides = [[i for i in hulls if model.geom(i).name.startswith(side)] for side in ("left", "right")]
    for q in plane.joints(points[plane.arms_apart(points)])[:100]:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for i, j in itertools.product(*sides):
            gap = np.linalg.norm(data.geom_xpos[i] - data.geom_xpos[j]) - model.geom_rbound[[i, j]].sum()
            if gap < 0.005:
                assert mujoco.mj_geomDistance(model, data, i, j, 0.1, None) > 0.0049, (i, j)


def test_mirrored_balls_are_mirrored_joints():
    """Joints 1 and 7 (and 3, 5, here zero) change sign when the cell is mirrored at y = 0."""
    plane = PLANES["balls"]()
    points = points_of(plane, 50)
    q, mirrored = plane.joints(points), plane.joints(points[:, [2, 3, 0, 1]] * [1, -1, 1, -1])
    sign = np.array([-1, 1, -1, 1, -1, 1, -1])
    np.testing.assert_allclose(mirrored, np.hstack([q[:, 7:] * sign, q[:, :7] * sign]), atol=1e-12)


@pytest.mark.parametrize("margin", [0.0, 0.01, -0.01])
def test_reach_of_two_balls_agrees_with_that_of_their_arms(margin):
    """The compiled check against each arm's own, and for any shape of points."""
    plane = PLANES["balls"]()
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 500, 4))
    points[3, 3] = np.nan
    expected = np.ones((40, 500), dtype=bool)
    for k, arm in enumerate(plane._arms):
        flange = points[..., 2 * k : 2 * k + 2] + plane._shift[k]
        pan = np.arctan2(flange[..., 1], flange[..., 0])
        expected &= arm.reaches(flange, margin) & arm.within([0, 6], np.stack([pan, pan], axis=-1))
    np.testing.assert_array_equal(plane.contains(points, margin), expected)
    assert 0.05 < expected.mean() < 0.5
    assert plane.contains(points[0, 0], margin).shape == ()


def test_out_of_reach_and_wrong_shapes_are_errors_in_words():
    balls, hand = PLANES["balls"](), PLANES["hand"]()
    assert not balls.contains([0.5, 0.1, 1.2, -0.1]) and balls.contains([0.5, 0.1, 0.5, -0.1])
    assert not hand.contains([0.5, 0.0, 3.1]) and hand.contains([0.5, 0.0, 2.9])
    with pytest.raises(InfeasibleError, match=r"the right tool cannot reach 1\.20. m.*usable radii"):
        balls.joints([[0.5, 0.1, 1.2, -0.1]])
    with pytest.raises(InfeasibleError, match="the upright hand cannot reach"):
        hand.joints([[1.0, 0.1, 0.0]])
    with pytest.raises(InvalidInputError, match=r"shape \(K, 4\)"):
        balls.joints([0.5, 0.1, 0.5, -0.1])
    with pytest.raises(InvalidInputError, match="equal shapes"):
        hand.joint_motion(np.zeros((2, 3)), np.zeros((3, 3)), np.zeros((2, 3)))
    with pytest.raises(InvalidInputError, match=r"shape \(\.\.\., 14\)"):
        tools.bimanual_tips(np.zeros((5, 7)))
    with pytest.raises(InvalidInputError, match="equal shapes"):
        balls.tip_velocities(np.zeros((5, 14)), np.zeros((4, 14)))
    with pytest.raises(ConfigurationError, match=r"no frame 'thumb'.*left_tool_tip"):
        fr3_bimanual().jacobian(np.zeros(14), "thumb")
    for make in (lambda: BimanualPlane(fr3_pusher()), lambda: HandPlane(fr3_pusher())):
        with pytest.raises(InvalidInputError):
            make()
