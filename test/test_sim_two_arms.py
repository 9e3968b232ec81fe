"""Two arms with balls, the hand, and what makes pushing harder: slope, cubes, displaced objects."""

import numpy as np
import pytest

from sim_bridge.impedance import ImpedanceConfig
from sim_bridge.scene import CUBE_SIDE, BallsStart, HandStart, ObjectPlant, Scene, build
from sim_bridge.simulation import Simulation
from sim_bridge.trajectory_follower import TrajectoryCommand
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.planning.plane_path import follow_plane
from vpsto_ros.robot.tip_kinematics import BALL_RADIUS
from vpsto_ros.trajectory import Trajectory

CAN = ObjectPlant(shape=PlanarShape.disc(0.05), height=0.12, mass=0.4)
APART = (0.35, 0.3, 0.35, -0.3)


def scene(robot="two_balls", start=None, plant=CAN, **fields):
    if start is not None:
        fields |= {"balls": BallsStart(start)} if robot == "two_balls" else {"hand": HandStart(start)}
    return Scene(robot=robot, plant=plant, **fields)


def around(centre, left, right, gap=0.001, radius=0.05):
    """Where the balls are when they touch a disc at two angles, give or take a gap."""
    reach = radius + BALL_RADIUS + gap
    spots = [np.add(centre, reach * np.array([np.cos(a), np.sin(a)])) for a in (left, right)]
    return tuple(float(v) for v in np.concatenate(spots))


def go(simulation, *points, speed=0.1):
    """Let the tools move through plane points from where they are, resting at each."""
    here = simulation.plane.tool(simulation.follower.reference(simulation.time)[0])
    keys = np.array([here, *points])
    durations = np.abs(np.diff(keys, axis=0)).max(axis=1) / speed
    times = simulation.time + np.concatenate([[0.0], np.cumsum(np.maximum(durations, 0.2))])
    plane = Trajectory.from_points(times, keys, np.zeros_like(keys))
    joints = follow_plane(plane, simulation.plane).trajectory
    simulation.follower.accept(TrajectoryCommand.of(joints, simulation.robot.joint_names), simulation.time)
    simulation.advance(joints.duration + 0.2)
    return simulation


def test_the_same_simulation_steps_every_robot():
    for robot, joints in (("rod", 7), ("hand", 7), ("two_balls", 14)):
        simulation = Simulation(Scene(robot=robot))
        simulation.advance(0.3)
        assert simulation.joint_position.shape == simulation.joint_torque.shape == (joints,)
        np.testing.assert_allclose(simulation.joint_position, simulation.scene.joints(), atol=1e-4)
        np.testing.assert_allclose(simulation.object_pose(), [0.5, 0.0, 0.0], atol=1e-4)
        assert simulation.tool_height_deviation < 1e-4
        assert simulation.limits.violations == 0 and not simulation.robot_contacts.any


def test_two_balls_cradle_a_can_and_take_it_along():
    start = around((0.45, 0.0), np.pi - 0.6, np.pi + 0.6)
    simulation = Simulation(scene(start=start, object_pose=(0.45, 0.0, 0.0)))
    forward = np.add(start, [0.1, 0.0, 0.1, 0.0])
    go(simulation, forward)
    np.testing.assert_allclose(simulation.object_pose()[:2], [0.55, 0.0], atol=3e-3)
    for tool in range(2):
        expected = [*forward[2 * tool : 2 * tool + 2], 0.035]
        np.testing.assert_allclose(simulation.tool_position(tool), expected, atol=3e-3)
    assert simulation.tool_height_deviation < 1e-3
    assert simulation.limits.violations == 0 and not simulation.robot_contacts.any


@pytest.mark.parametrize("smooth", [True, False])
def test_a_motion_at_the_limits_is_taken_as_it_was_planned_and_followed(smooth):
    """Round the can and back, slowed down as the joints need it; the controller sees the same polynomials."""
    t = np.linspace(0.0, 1.0, 21)
    turn = 4.0 * np.pi * t**2 * (3.0 - 2.0 * t)
    rate, bend = 4.0 * np.pi * (6.0 * t - 6.0 * t**2), 4.0 * np.pi * (6.0 - 12.0 * t)
    sides, parts = np.array([1.0, 1.0]), [np.zeros((21, 4)) for _ in range(3)]
    parts[0] += APART
    for k in (0, 2):
        parts[0][:, k : k + 2] += 0.05 * np.column_stack([np.cos(turn) - 1.0, np.sin(turn)]) * sides
        parts[1][:, k : k + 2] = 0.05 * rate[:, None] * np.column_stack([-np.sin(turn), np.cos(turn)])
        swing, pull = (
            np.column_stack([-np.sin(turn), np.cos(turn)]),
            np.column_stack([np.cos(turn), np.sin(turn)]),
        )
        parts[2][:, k : k + 2] = 0.05 * (bend[:, None] * swing - (rate**2)[:, None] * pull)
    plane = Trajectory.from_points(t, parts[0], parts[1], parts[2] if smooth else None)
    simulation = Simulation(scene(start=APART))
    followed = follow_plane(plane, simulation.plane)
    assert followed.stretch > 1.0
    joints = followed.trajectory
    simulation.follower.accept(TrajectoryCommand.of(joints, simulation.robot.joint_names), 0.0)
    taken = simulation.follower.active
    np.testing.assert_allclose(taken.coefficients, joints.coefficients, rtol=1e-6, atol=1e-5)
    simulation.advance(joints.duration)
    assert simulation.limits.violations == 0
    np.testing.assert_allclose(simulation.plane.tool(simulation.joint_position), plane(1.0), atol=4e-3)


def test_forces_of_both_balls_add_up_to_the_friction_of_the_table():
    start = around((0.45, 0.0), np.pi - 0.6, np.pi + 0.6)
    simulation = Simulation(scene(start=start, object_pose=(0.45, 0.0, 0.0)))
    here = np.array(start)
    times = np.array([0.0, 0.5, 2.5, 3.0])
    along = np.array([1.0, 0.0, 1.0, 0.0])
    points = here + np.array([0.0, 0.0125, 0.1125, 0.125])[:, None] * along
    rates = np.array([0.0, 0.05, 0.05, 0.0])[:, None] * along
    joints = follow_plane(Trajectory.from_points(times, points, rates), simulation.plane).trajectory
    simulation.follower.accept(TrajectoryCommand.of(joints, simulation.robot.joint_names), 0.0)
    simulation.advance(1.2)
    forces = []
    for _ in range(800):
        simulation.step()
        forces.append([simulation.tool_contact_force(0), simulation.tool_contact_force(1)])
    left, right = np.mean(forces, axis=0)
    friction = CAN.table_friction * CAN.mass * 9.81
    assert (left + right)[0] == pytest.approx(friction, rel=0.05)
    np.testing.assert_allclose(left[:2], right[:2] * [1, -1], atol=0.1 * friction)
    assert left[1] < 0.0 < right[1]
    np.testing.assert_allclose(
        simulation.tool_contact_force(), sum(simulation.tool_contact_force(k) for k in range(2))
    )


def test_the_hand_pushes_and_turns_a_box():
    box = ObjectPlant(shape=PlanarShape.box(0.1, 0.1))
    simulation = Simulation(scene("hand", (0.38, 0.0, np.pi / 2), box, object_pose=(0.48, 0.0, 0.0)))
    go(simulation, (0.48, 0.0, np.pi / 2))
    x, y, yaw = simulation.object_pose()
    assert x == pytest.approx(0.48 + 0.03 + 0.05, abs=2e-3) and abs(y) < 2e-3 and abs(yaw) < 0.02
    before = simulation.plane.tool(simulation.joint_position)
    go(simulation, (0.5, 0.03, np.pi / 2 + 0.4), speed=0.15)
    turned = simulation.plane.tool(simulation.joint_position) - before
    np.testing.assert_allclose(turned, [0.02, 0.03, 0.4], atol=5e-3)
    assert simulation.object_pose()[2] > 0.2
    assert simulation.limits.violations == 0 and not simulation.robot_contacts.any


@pytest.mark.parametrize("radius", [0.05, 0.03])
@pytest.mark.parametrize(
    ("left", "right"), [(150, 210), (90, -90), (0, 180), (180, 0), (-40, 140), (220, 40)]
)
def test_arms_keep_clear_with_the_balls_on_any_side_that_is_promised(radius, left, right):
    """Also across each other: at -40 degrees the left ball is to the right of the right one."""
    start = around((0.5, 0.0), np.radians(left), np.radians(right), radius=radius)
    plant = ObjectPlant(shape=PlanarShape.disc(radius), height=0.12)
    simulation = Simulation(scene(start=start, plant=plant))
    simulation.advance(0.05)
    assert not simulation.robot_contacts.any
    assert np.abs(simulation.object_pose()[:2] - [0.5, 0.0]).max() < 1e-4


def test_arms_that_meet_stop_each_other_and_are_counted():
    simulation = Simulation(scene(start=(0.5, 0.06, 0.5, -0.06), object_pose=(0.8, 0.0, 0.0)))
    go(simulation, (0.5, 0.01, 0.5, -0.01), speed=0.05)
    contacts = simulation.robot_contacts
    assert contacts.arms > 100 and contacts.table == contacts.object == 0
    gap = simulation.tool_position(0) - simulation.tool_position(1)
    assert np.linalg.norm(gap) > 2 * BALL_RADIUS - 0.003, "the balls do not pass through each other"


def test_contacts_with_the_table_and_of_links_with_the_object_are_counted():
    simulation = Simulation(scene(start=APART))
    q = simulation.plane.joints([APART])[0]
    q[1] += 0.15
    simulation.reset(joints=q)
    simulation.advance(0.02)
    assert simulation.robot_contacts.table > 0 and simulation.robot_contacts.arms == 0
    tall = ObjectPlant(shape=PlanarShape.disc(0.05), height=0.28, mass=0.4)
    simulation = Simulation(scene(start=(0.4, 0.1, 0.4, -0.1), plant=tall, object_pose=(0.4, 0.2, 0.0)))
    simulation.advance(0.02)
    assert simulation.robot_contacts.object > 0


def test_a_can_on_a_slope_slides_when_it_is_steeper_than_friction_and_only_then():
    slippery = ObjectPlant(shape=PlanarShape.disc(0.05), height=0.12, table_friction=0.02)
    slope = np.radians(2.0)
    held = Simulation(scene(start=APART, slope=(slope, 0.0)))
    slid = Simulation(scene(start=APART, slope=(0.0, -slope), plant=slippery))
    for simulation in (held, slid):
        simulation.advance(0.5)
    np.testing.assert_allclose(held.object_pose()[:2], [0.5, 0.0], atol=2e-4)
    pull = 9.81 * (np.sin(slope) - 0.02 * np.cos(slope))
    np.testing.assert_allclose(slid.object_pose()[:2], [0.5, -0.5 * pull * 0.5**2], rtol=0.03, atol=1e-4)
    assert np.linalg.norm(build(slid.scene).opt.gravity) == pytest.approx(9.81)
    assert held.tool_height_deviation < 1e-3, "the arms lean by less than a millimetre"


def test_cubes_lie_still_are_pushed_by_can_and_ball_and_go_back():
    cubes = ((0.58, 0.0), (0.5, 0.25), (0.65, -0.3))
    start = around((0.5, 0.0), np.pi - 0.6, np.pi + 0.6)
    simulation = Simulation(scene(start=start, cubes=cubes))
    where = [simulation.data.xpos[simulation.model.body(f"cube{i}").id] for i in range(3)]
    simulation.advance(1.0)
    for spot, cube in zip(where, cubes, strict=True):
        np.testing.assert_allclose(spot, [*cube, CUBE_SIDE / 2], atol=1e-3)
    go(simulation, np.add(start, [0.08, 0.0, 0.08, 0.0]))
    x, y, _ = simulation.object_pose()
    assert x > 0.56
    assert np.hypot(*(where[0][:2] - [x, y])) > 0.05 + 0.4 * CUBE_SIDE, "the cube is outside the can"
    assert where[0][2] == pytest.approx(CUBE_SIDE / 2, abs=5e-3)
    np.testing.assert_allclose(where[2][:2], cubes[2], atol=1e-3)
    simulation.reset()
    np.testing.assert_allclose(where[0], [*cubes[0], CUBE_SIDE / 2], atol=1e-9)


def test_without_slope_and_cubes_the_plant_is_the_one_before():
    plain, other = build(Scene()), build(Scene(slope=(0.0, 0.0), cubes=()))
    np.testing.assert_array_equal(plain.opt.gravity, [0.0, 0.0, -9.81])
    assert (plain.nq, plain.ngeom) == (other.nq, other.ngeom) == (14, plain.ngeom)


def test_the_object_is_displaced_at_rest():
    simulation = Simulation(scene(start=APART))
    simulation.push_object((3.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.1)
    simulation.advance(0.1)
    before = simulation.object_pose()
    simulation.displace_object(0.004, -0.003)
    np.testing.assert_allclose(simulation.object_pose() - before, [0.004, -0.003, 0.0], atol=1e-9)
    simulation.advance(0.2)
    np.testing.assert_allclose(simulation.object_pose() - before, [0.004, -0.003, 0.0], atol=1e-4)
    for bad in ((0.2, 0.0), (np.nan, 0.0)):
        with pytest.raises(InvalidInputError, match="displace"):
            simulation.displace_object(*bad)


def test_two_arms_bend_under_a_force_as_their_compliance_says():
    """The stiffness of joint 7 counts: a force on the ball has a lever about it."""
    simulation = Simulation(scene(start=APART, joint_friction=0.0))
    q, stiffness = simulation.joint_position, ImpedanceConfig().for_arms(2, round_tool=False)
    assert stiffness[6] == stiffness[13] == ImpedanceConfig().offset_stiffness
    force, body = np.array([3.0, -2.0, 0.0]), simulation.model.body("left_tool").id
    start = simulation.tool_position(0)
    simulation.data.xfrc_applied[body, :3] = force
    simulation.data.xfrc_applied[body, 3:] = np.cross(start - simulation.data.xipos[body], force)
    simulation.advance(3.0)
    jacobian = simulation.robot.jacobian(q, "left_tool_tip")[:3]
    expected = jacobian @ np.diag(1.0 / stiffness) @ jacobian.T @ force
    np.testing.assert_allclose(simulation.tool_position(0) - start, expected, atol=1e-4)
    np.testing.assert_allclose(simulation.tool_position(1), [0.35, -0.3, 0.035], atol=1e-5)


def test_tools_have_exactly_the_plant_s_friction():
    for robot, tools in (("hand", ("hand",)), ("two_balls", ("left_ball", "right_ball"))):
        model = build(scene(robot, plant=ObjectPlant(tool_friction=0.37)))
        for tool in tools:
            pairs = [i for i in range(model.npair) if model.pair_geom1[i] == model.geom(tool).id]
            assert len(pairs) == 1
            np.testing.assert_allclose(model.pair_friction[pairs[0], :2], 0.37)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Scene(robot="three_balls"), "'rod', 'hand', 'two_balls'"),
        (lambda: scene(start=(0.9, 0.1, 0.4, -0.1)).joints(), r"balls\.start = .* is out of reach"),
        (lambda: scene("hand", (0.5, 0.0, 3.5)).joints(), r"hand\.start = .* is out of reach"),
        (lambda: scene(start_joints=(0.0,) * 7).joints(), "must be 14 angles"),
        (lambda: Scene(cubes=((0.1, 0.2, 0.3),)), "cubes"),
        (lambda: Scene(slope=(0.5, 0.0)), "slope"),
    ],
)
def test_misuse_is_named(make, message):
    with pytest.raises(ConfigurationError, match=message):
        make()
