"""The air-hockey world: its arm, and what table, puck and mallet were measured to do."""

import math

import mujoco
import numpy as np
import pytest

from sim_bridge.camera import CameraConfig
from sim_bridge.hockey import table
from sim_bridge.hockey.mallet import MalletConfig
from sim_bridge.hockey.scene import START_JOINTS, AirHockeyScene, build
from sim_bridge.hockey.world import AirHockeyWorld, ArmGains
from sim_bridge.trajectory_follower import TrajectoryCommand
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.robot.iiwa import JOINT_NAMES, MODEL_PATH, iiwa14
from vpsto_ros.trajectory import OptimalBasis, synthesize

Q0 = np.array(START_JOINTS)
TOUCHING = table.PUCK_RADIUS + table.MALLET_RADIUS


@pytest.fixture(scope="module")
def shared():
    """One world for tests that reset it."""
    return AirHockeyWorld()


@pytest.fixture(scope="module")
def postures():
    limits = iiwa14().limits
    return np.random.default_rng(1).uniform(limits.lower, limits.upper, (20, 7))


def in_base(x, y, yaw=0.0):
    """Pose of the puck from table coordinates."""
    return (*table.to_base([x, y]), yaw)


def until_a_contact_has_ended(world, limit=400):
    for _ in range(limit):
        if world.contacts:
            return world.contacts[0]
        world.step()
    raise AssertionError("nothing was touched")


# The arm.


def standard_dh(q):
    """Pose of the universal joint by multiplying textbook 4x4 matrices of the standard convention."""
    pose = np.eye(4)
    alphas, offsets = (-90, 90, 90, -90, -90, 90, 0), (0.36, 0, 0.42, 0, 0.40, 0, 0.126)
    for angle, alpha, d in zip(q, np.deg2rad(alphas), offsets, strict=True):
        c, s, ca, sa = math.cos(angle), math.sin(angle), math.cos(alpha), math.sin(alpha)
        turn = [[c, -s * ca, s * sa, 0], [s, c * ca, -c * sa, 0], [0, sa, ca, d], [0, 0, 0, 1]]
        pose = pose @ np.array(turn)
    return pose @ np.block([[np.eye(3), np.array([[0], [0], [0.540]])], [0, 0, 0, 1]])


def test_mujoco_and_pinocchio_read_the_same_arm_as_the_dh_table(postures):
    robot, model = iiwa14(), mujoco.MjModel.from_xml_path(str(MODEL_PATH))
    data, inertia, rng = mujoco.MjData(model), np.empty((7, 7)), np.random.default_rng(2)
    for q in postures:
        qd, qdd = rng.normal(size=(2, 7))
        data.qpos[:], data.qvel[:] = q, qd
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        position, rotation = robot.forward(q)
        np.testing.assert_allclose(position, standard_dh(q)[:3, 3], atol=1e-9)
        np.testing.assert_allclose(rotation, standard_dh(q)[:3, :3], atol=1e-9)
        np.testing.assert_allclose(position, data.site("universal_joint").xpos, atol=1e-9)
        np.testing.assert_allclose(robot.mass_matrix(q), inertia, atol=1e-9)
        expected = inertia @ qdd + data.qfrc_bias
        np.testing.assert_allclose(robot.inverse_dynamics(q, qd, qdd), expected, atol=1e-9)


def test_limits_are_those_of_the_iiwa():
    robot = iiwa14()
    assert robot.joint_names == JOINT_NAMES
    np.testing.assert_allclose(np.rad2deg(robot.limits.upper), [170, 120, 170, 120, 170, 120, 175])
    np.testing.assert_allclose(robot.limits.lower, -robot.limits.upper)
    np.testing.assert_allclose(np.rad2deg(robot.limits.velocity), [85, 85, 100, 75, 130, 135, 135])
    np.testing.assert_allclose(robot.limits.acceleration, 10.0 * robot.limits.velocity)
    np.testing.assert_allclose(robot.torque_limits, [320, 320, 176, 176, 110, 40, 40])


def test_the_start_posture_holds_the_mallet_over_the_table(shared):
    shared.reset()
    mallet = shared.mallet_state()
    # The angles are rounded to milliradians, of which 0.4 mrad make half a millimetre.
    np.testing.assert_allclose(mallet.joint_position, [0.65, 0.0, 0.1645], atol=5e-4)
    np.testing.assert_allclose(mallet.position - mallet.joint_position, [0.0, 0.0, -0.0505], atol=1e-12)
    np.testing.assert_allclose(table.to_table(mallet.joint_position)[2], 0.0645, atol=5e-4)


def test_the_simulated_arm_weighs_what_its_controller_thinks(shared):
    """The mallet hangs from its joint, so that it loads the arm like a point there, however the rod leans."""
    for q in (Q0, Q0 + [0.5, 0.3, -0.4, 0.2, 0.3, -0.3, 1.0]):
        shared.reset(joints=q)
        weight = iiwa14().inverse_dynamics(q, np.zeros(7), np.zeros(7))
        np.testing.assert_allclose(shared.data.qfrc_bias[:7], weight, atol=1e-9)
        np.testing.assert_allclose(shared.data.qfrc_bias[7:9], 0.0, atol=1e-9)
        shared.advance(0.1)
        np.testing.assert_allclose(shared.joint_position, q, atol=1e-6)
        np.testing.assert_allclose(shared.mallet_state().tilt, 0.0, atol=1e-6)


def test_a_slow_motion_is_tracked_within_a_millimetre(shared):
    shared.reset()
    violations = shared.limits.violations
    goal = Q0 + [0.3, 0.05, 0.1, -0.05, 0.2, -0.1, 0.3]
    s = np.linspace(0.0, 1.0, 41)[:, None]
    blend, rate = 10 * s**3 - 15 * s**4 + 6 * s**5, 30 * (s * (1 - s)) ** 2 / 2.0
    way = goal - Q0
    command = TrajectoryCommand(JOINT_NAMES, 0.0, 2.0 * s[:, 0], Q0 + blend * way, rate * way)
    shared.follower.accept(command, shared.time)
    worst = 0.0
    for _ in range(220):
        shared.advance(0.01)
        wanted = iiwa14().forward(shared.follower.reference(shared.time)[0])[0]
        worst = max(worst, np.linalg.norm(shared.mallet_state().joint_position - wanted))
    assert 0.0 < worst < 1e-3
    assert shared.limits.violations == violations
    assert shared.controller.saturated.sum() == 0


# Table and puck.


def test_the_table_stands_where_the_robot_expects_it():
    model = build(AirHockeyScene())
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    left, far, post = (data.geom(name) for name in ("rim_left", "rim_far_right", "rim_far_right_post"))
    size = {name: model.geom(name).size for name in ("rim_left", "rim_far_right", "rim_far_right_post")}
    assert left.xpos[1] - size["rim_left"][1] == pytest.approx(0.519)
    assert left.xpos[2] + size["rim_left"][2] == pytest.approx(0.13)
    assert far.xpos[0] - size["rim_far_right"][0] == pytest.approx(1.51 + 0.974)
    assert far.xpos[0] + size["rim_far_right"][0] == pytest.approx(1.51 + 1.064)
    assert post.xpos[1] + size["rim_far_right_post"][0] == pytest.approx(-0.125)
    assert post.xpos[0] - size["rim_far_right_post"][0] == pytest.approx(1.51 + 0.974)
    np.testing.assert_allclose(table.to_base(table.to_table([0.3, -0.2, 0.1])), [0.3, -0.2, 0.1])
    np.testing.assert_allclose(table.to_base([0.0, 0.0, 0.0]), [1.51, 0.0, 0.1])


def test_the_puck_slows_down_by_its_drag(shared):
    shared.reset(in_base(-0.5, 0.2), (0.8, -0.1, 20.0))
    shared.advance(1.0)
    np.testing.assert_allclose(shared.puck_twist()[:2], np.array([0.8, -0.1]) * math.exp(-0.5), rtol=1e-3)
    assert shared.puck_twist()[2] == pytest.approx(20.0 * math.exp(-0.4), rel=1e-3)
    assert shared.contacts == []
    expected = 0.8 * (1.0 - math.exp(-0.5)) / 0.5
    assert table.to_table(shared.puck_pose()[:2])[0] == pytest.approx(-0.5 + expected, abs=1e-3)


def spring_restitution(damping):
    """Restitution of a damped spring that cannot pull."""
    root = math.sqrt(1.0 - damping**2)
    return math.exp(-2.0 * damping / root * math.atan2(root, damping))


def bounces(world, count, slope):
    """Bounces off the left rim at any phase of the step, at 0.5 to 3 m/s."""
    rng = np.random.default_rng(3)
    y = table.HALF_WIDTH - table.PUCK_RADIUS
    for _ in range(count):
        speed = rng.uniform(0.5, 3.0)
        world.reset(in_base(0.2, y - rng.uniform(1.0, 2.0) * 1e-3 * speed), (slope * speed, speed, 0.0))
        contact = until_a_contact_has_ended(world)
        assert contact.surface == "left" and contact.duration < 4.5e-3
        yield contact.velocity_before, contact.velocity_after


def test_rims_return_three_quarters_of_the_speed_with_scatter(shared):
    restitution = np.array([-after[1] / before[1] for before, after in bounces(shared, 60, 0.0)])
    assert np.median(restitution) == pytest.approx(0.74, abs=0.02)
    assert np.mean((restitution > 0.695) & (restitution < 0.77)) > 0.75
    # A contact that begins late in a step is over before the damping of its second step has acted.
    assert restitution.min() > 0.69 and 0.85 < restitution.max() < 1.06


def test_rims_turn_sliding_into_spin(shared):
    rows = [(before, after) for before, after in bounces(shared, 20, 0.7)]
    tangential = np.array([after[0] / before[0] for before, after in rows])
    assert np.median(tangential) == pytest.approx(0.84, abs=0.01)
    for before, after in rows:
        # Off the left rim the yaw rate is positive for a puck that moves along +x. The impulse that takes
        # the tangential speed is what spins the puck: this law holds for every bounce.
        spin = after[2] * table.PUCK_RADIUS
        lost = before[0] - after[0]
        inertia = table.PUCK_INERTIA / (table.PUCK_MASS * table.PUCK_RADIUS**2)
        # The dent of up to 1.5 mm shortens the lever, and the drag takes a little, too.
        assert spin * inertia == pytest.approx(lost, rel=0.03)
    gain = np.median([after[2] * table.PUCK_RADIUS / after[0] for _, after in rows])
    assert gain == pytest.approx(0.37, abs=0.02)


@pytest.mark.parametrize("damping", [0.02, 0.0265, 0.06, 0.15])
def test_the_rims_damping_ratio_sets_their_restitution(damping):
    world = AirHockeyWorld(AirHockeyScene(rim_damping=damping, drag=0.35))
    restitution = [-after[1] / before[1] for before, after in bounces(world, 20, 0.0)]
    assert np.median(restitution) == pytest.approx(spring_restitution(damping), abs=0.06)


@pytest.mark.parametrize("damping", [0.02, 0.075, 0.6])
def test_the_mallets_damping_ratio_sets_its_restitution(damping):
    world = AirHockeyWorld(AirHockeyScene(mallet_damping=damping))
    assert rebound(world, 1.0)[1] == pytest.approx(spring_restitution(damping), abs=0.03)


def test_posts_are_rounded(shared):
    """A puck that meets the round corner of a post is thrown aside; off the face of the rim it is not."""
    corner = table.GOAL_HALF_WIDTH + table.POST_RADIUS
    sideways = {}
    for y in (corner + 0.02, corner - 0.015):
        shared.reset(in_base(0.9, y), (1.0, 0.0, 0.0))
        contact = until_a_contact_has_ended(shared)
        assert contact.surface == "far"
        sideways[y] = contact.velocity_after[1]
    assert abs(sideways[corner + 0.02]) < 0.01
    assert sideways[corner - 0.015] < -0.3


def test_posts_throw_no_puck_off_at_many_times_its_speed(shared):
    """Where it touches a post and a face at once: there the contact is stiffer than the step likes."""
    for y in np.linspace(0.08, 0.18, 26):
        for angle in (-0.9, -0.3, 0.3, 0.9):
            speed = 1.8
            shared.reset(in_base(0.9, y - 0.05 * math.tan(angle)), (speed, speed * math.tan(angle), 0.0))
            before = math.hypot(*shared.puck_twist()[:2])
            shared.advance(0.08)
            assert math.hypot(*shared.puck_twist()[:2]) < 1.5 * before, (y, angle)


@pytest.mark.parametrize(
    ("start", "velocity", "goal"),
    [
        ((0.9, 0.05), (1.5, 0.1), "far"),
        ((-0.9, -0.08), (-1.5, 0.0), "near"),
        ((0.9, 0.17), (1.5, 0.0), None),
        ((0.9, 0.125), (0.5, 0.0), None),  # the post
    ],
)
def test_goals_are_seen(shared, start, velocity, goal):
    shared.reset(in_base(*start), (*velocity, 0.0), joints=Q0 + [0.6, 0, 0, 0, 0, 0, 0])
    at = shared.time
    shared.advance(0.2)
    if goal is None:
        assert shared.goal is None and not shared.off_table
        assert [contact.surface for contact in shared.contacts] == ["far"]
        return
    assert shared.goal.end == goal and shared.off_table
    x, y = table.to_table(shared.goal.position)
    assert 0.974 < abs(x) < 0.974 + 2e-3 * 1.5 and abs(y) < 0.125
    assert shared.goal.velocity[0] == pytest.approx(velocity[0], rel=0.05)
    assert shared.goal.time - at == pytest.approx(0.074 / 1.5, abs=2e-3)
    shared.reset()
    assert shared.goal is None


def test_a_goal_is_x_beyond_the_line_and_y_between_the_posts():
    assert table.goal_at(table.to_base([0.9741, 0.1249])) == "far"
    assert table.goal_at(table.to_base([-0.9741, -0.1249])) == "near"
    for point in ([0.9739, 0.0], [0.98, 0.1251], [-0.98, -0.1251], [0.0, 0.6]):
        assert table.goal_at(table.to_base(point)) is None


# The mallet.


def at_puck_height(mallet):
    """Velocity along x of the mallet's point at the middle of the puck."""
    drop = mallet.joint_position[2] - table.TABLE_ORIGIN[2] - table.PUCK_HEIGHT / 2
    swing = (mallet.velocity - mallet.joint_velocity) / table.MALLET_OFFSET
    return (mallet.joint_velocity + swing * drop)[0]


def restitution(world, contact):
    """Relative speed along x after a contact that has just ended, over that before."""
    approach = at_puck_height(contact.mallet) - contact.velocity_before[0]
    return (contact.velocity_after[0] - at_puck_height(world.mallet_state())) / approach


def rebound(world, speed):
    """The contact of a puck with a resting mallet, and its restitution."""
    world.reset((0.65 + TOUCHING + 0.01, 0.0, 0.0), (-speed, 0.0, 0.0))
    contact = until_a_contact_has_ended(world)
    return contact, restitution(world, contact)


@pytest.mark.parametrize("speed", [0.3, 0.7, 1.2, 2.0])
def test_the_puck_comes_back_from_a_resting_mallet(shared, speed):
    contact, share = rebound(shared, speed)
    assert contact.surface == "mallet"
    assert contact.duration == pytest.approx(0.0185, abs=1.6e-3)
    assert share == pytest.approx(spring_restitution(0.3), abs=0.035)
    assert abs(contact.velocity_after[1]) < 0.01 * speed


def straight_strike(acceleration, speed):
    """The mallet along x from the start posture: speeding up to a speed, then braking."""
    robot, q, x, v, period = iiwa14(), Q0.copy(), iiwa14().forward(Q0)[0][0], 0.0, 0.01
    rows, rates, rising = [q], [np.zeros(7)], True
    height = robot.forward(Q0)[0][2]
    while rising or v > 1e-9:
        x += 0.5 * period * v
        v = max(v + (acceleration if rising else -acceleration) * period, 0.0)
        x += 0.5 * period * v
        rising = rising and v < speed
        for _ in range(3):
            q = q + np.linalg.pinv(robot.jacobian(q)[:3]) @ ((x, 0.0, height) - robot.forward(q)[0])
        rows.append(q)
        rates.append(np.linalg.pinv(robot.jacobian(q)[:3]) @ (v, 0.0, 0.0))
    times = period * np.arange(len(rows))
    return TrajectoryCommand(JOINT_NAMES, 0.0, times, np.array(rows), np.array(rates))


def test_a_strike_sends_the_puck_off_at_half_as_much_again(shared):
    """The mallet still speeds up while it touches, which adds to what the contact gives by itself."""
    shared.reset((0.65 + TOUCHING + 0.06, 0.0, 0.0))
    shared.follower.accept(straight_strike(3.0, 0.75), shared.time)
    contact = until_a_contact_has_ended(shared)
    assert contact.mallet.velocity[0] == pytest.approx(0.6, abs=0.05)
    assert contact.duration == pytest.approx(0.0185, abs=1.6e-3)
    assert 0.38 < restitution(shared, contact) < 0.45
    gain = contact.velocity_after[0] / contact.mallet.velocity[0] - 1.0
    assert 0.45 < gain < 0.53
    assert shared.height_deviation < 5e-3


@pytest.mark.parametrize(("joint", "axis"), [(5, 0), (2, 1)])
def test_the_mallet_follows_the_vertical_78_ms_late(shared, joint, axis):
    """While the rod turns at a constant rate, the mallet leans by that rate times damping / stiffness.

    Damping / stiffness is 78 ms. The mallet's own weight helps the stiffness, which leaves 74 ms.
    """
    shared.reset()
    rate = 0.1
    times, rows = [0.0, 0.1, 1.4, 1.6], np.zeros((4, 7)) + Q0
    rows[:, joint] += rate * np.array([0.0, 0.05, 1.35, 1.45])
    rates = np.zeros((4, 7))
    rates[1:3, joint] = rate
    shared.follower.accept(TrajectoryCommand(JOINT_NAMES, 0.0, times, rows, rates), shared.time)
    shared.advance(1.2)
    before, _ = shared._mallet.vertical(), shared.advance(0.1)
    turned = np.subtract(shared._mallet.vertical(), before) / 0.1
    lean = shared.mallet_state().tilt[axis]
    weight = table.MALLET_MASS * 9.81 * table.MALLET_COM_OFFSET
    assert abs(lean / turned[axis]) == pytest.approx(0.31 / (4.0 + weight), rel=0.015)


def test_a_push_on_the_mallet_decays_without_swinging(shared):
    """Its hinges' gains damp its inertia critically, so that it returns from one side only."""
    shared.reset()
    shared.data.qpos[7] += 0.1
    tilts = []
    for _ in range(50):
        shared.advance(0.01)
        tilts.append(shared.mallet_state().tilt[0])
    tilts = np.array(tilts) / tilts[0]
    assert np.abs(tilts[-10:]).max() < 0.01
    assert tilts.min() > -0.02


# Observation, determinism, misuse.


def test_the_camera_is_noisy_late_and_loses_frames():
    world = AirHockeyWorld(seed=4)
    world.advance(2.0)
    frames = world.camera_frames()
    errors = np.array([frame.pose[:2] - [1.0, 0.0] for frame in frames])
    assert errors.var() == pytest.approx(5e-7, rel=0.2)
    assert 0.9 * 240 < len(frames) < 240
    assert world.time - frames[-1].stamp >= world.camera.config.latency - 1e-9


def test_the_same_seed_gives_the_same_run():
    runs = []
    for _ in range(2):
        world = AirHockeyWorld(seed=5)
        world.reset((0.85, 0.01, 0.0), (-1.0, 0.0, 0.0))
        world.advance(0.2)
        runs.append((world.puck_pose(), world.joint_position, [f.pose for f in world.camera_frames()]))
    for first, second in zip(*runs, strict=True):
        np.testing.assert_array_equal(first, second)


def test_reset_puts_everything_back_while_time_goes_on(shared):
    shared.reset((0.85, 0.01, 0.0), (-1.0, 0.0, 0.0))
    shared.advance(0.2)
    at = shared.time
    assert shared.contacts
    shared.reset()
    assert shared.time == at and shared.contacts == [] and shared.touching == ()
    np.testing.assert_array_equal(shared.joint_position, Q0)
    np.testing.assert_allclose(shared.puck_pose(), [1.0, 0.0, 0.0], atol=1e-12)
    assert not shared.puck_twist().any() and not shared.joint_velocity.any()
    shared.advance(0.1)
    np.testing.assert_allclose(shared.puck_pose(), [1.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("config", "options", "message"),
    [
        (AirHockeyScene, {"drag": -0.1}, r"drag.*0.0 to 5.0"),
        (AirHockeyScene, {"rim_damping": 0.0}, r"rim_damping.*0.02 to 0.15"),
        (AirHockeyScene, {"mallet_damping": 1.5}, "mallet_damping"),
        (AirHockeyScene, {"joints": (0.0,) * 6}, "joints.*7 numbers"),
        (AirHockeyScene, {"puck": (1.0, math.nan, 0.0)}, "puck"),
        (MalletConfig, {"damping": 7.0}, "damping"),
        (ArmGains, {"stiffness": (1e4,) * 7}, "stiffness"),
        (CameraConfig, {"rate": 0.0}, "rate"),
    ],
)
def test_options_out_of_range_are_named(config, options, message):
    with pytest.raises(ConfigurationError, match=message):
        config(**options)


@pytest.mark.parametrize(
    ("misuse", "message"),
    [
        ({"puck": (1.0, 0.0)}, "puck must be 3 finite numbers"),
        ({"puck": (1.0, 0.5, 0.0)}, r"not on the table.*y from -0.519 to 0.519"),
        ({"puck": (0.0, 0.0, 0.0)}, r"not on the table.*x from 0.536 to 2.484"),
        ({"puck": (0.70, 0.02, 0.0)}, "under the mallet.*0.0798"),
        ({"puck_velocity": (math.inf, 0.0, 0.0)}, "puck_velocity"),
        ({"joints": np.zeros(6)}, "joints must be 7"),
        ({"joints": np.full(7, 2.5)}, "position limits"),
        ({"joints": np.zeros(7)}, "points upwards"),
    ],
)
def test_misuse_of_reset_is_named_and_changes_nothing(misuse, message):
    world = AirHockeyWorld()
    with pytest.raises(InvalidInputError, match=message):
        world.reset(**misuse)
    np.testing.assert_array_equal(world.joint_position, Q0)
    np.testing.assert_allclose(world.puck_pose(), [1.0, 0.0, 0.0])


def test_a_puck_put_back_by_a_hand_leaves_the_arm_alone(shared):
    shared.reset()
    q = shared.joint_position
    keys = np.stack([q, q + 0.2 * np.eye(7)[0]])
    motion = synthesize(
        OptimalBasis.uniform(0), keys, np.zeros(7), np.zeros(7), shared.robot.limits, start_time=shared.time
    )
    shared.follower.accept(TrajectoryCommand.of(motion, JOINT_NAMES), shared.time)
    shared.advance(0.1)
    before = shared.joint_velocity
    shared.place_puck((1.1, 0.2, 0.0), (0.05, -0.02, 0.0))
    np.testing.assert_array_equal(shared.joint_velocity, before)
    np.testing.assert_allclose(shared.puck_pose(), [1.1, 0.2, 0.0], atol=1e-12)
    np.testing.assert_allclose(shared.object_twist(), [0.05, -0.02, 0.0])
    shared.advance(motion.duration)
    np.testing.assert_allclose(shared.joint_position, keys[1], atol=5e-3)


def test_a_puck_cannot_be_put_under_the_mallet_where_that_is_now(shared):
    shared.reset()
    mallet = shared.mallet_state().position
    for place, message in (((*mallet[:2], 0.0), "under the mallet"), ((3.0, 0.0, 0.0), "not on the table")):
        with pytest.raises(InvalidInputError, match=message):
            shared.place_puck(place)
    np.testing.assert_allclose(shared.puck_pose(), [1.0, 0.0, 0.0], atol=1e-12)


def test_the_camera_sees_a_puck_in_a_goal_but_not_one_that_is_gone():
    world = AirHockeyWorld(camera=CameraConfig(rate=100.0, latency=0.0, position_std=0.0, dropout=0.0))
    world.reset(in_base(0.8, 0.0), (2.0, 0.0, 0.0))
    world.advance(0.4)
    seen = [frame.pose[0] - table.TABLE_ORIGIN[0] for frame in world.camera_frames()]
    assert table.HALF_LENGTH < max(seen) <= table.HALF_LENGTH + 0.1
    assert world.goal.end == "far" and world.object_pose()[0] > max(seen) + table.TABLE_ORIGIN[0]
