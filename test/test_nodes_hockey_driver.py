"""The simulated driver with an air-hockey table: its topics, pucks, goals and rules."""

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("mujoco")

import rclpy
from driver_bench import Cell, call
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from sim_bridge.driver_config import FrankaDriverConfig
from sim_bridge.hockey import table
from sim_bridge.hockey.messages import scene_markers, true_mallet
from sim_bridge.hockey.puck_places import PuckPlaces
from sim_bridge.hockey.world import AirHockeyWorld
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.nodes.conversions import SIMULATED, read_observation, read_state
from vpsto_ros.nodes.joint_conversions import read_joint_state, trajectory_message
from vpsto_ros.robot.iiwa import JOINT_NAMES
from vpsto_ros.trajectory import OptimalBasis, synthesize

BASE = "iiwa_link_0"


@pytest.fixture(scope="module", autouse=True)
def ros():
    rclpy.init()
    yield
    rclpy.try_shutdown()


@pytest.fixture
def cell():
    made = []

    def make(**overrides):
        made.append(Cell(world="air_hockey", base_frame=BASE, **overrides))
        return made[-1]

    yield make
    for each in made:
        each.close()


def reach(world, offset):
    """A motion of joint 1 by an offset [rad], as a message."""
    q = world.joint_position
    keys = np.stack([q, q + offset * np.eye(7)[0]])
    motion = synthesize(
        OptimalBasis.uniform(0), keys, np.zeros(7), np.zeros(7), world.robot.limits, start_time=world.time
    )
    return trajectory_message(motion, JOINT_NAMES, frame=BASE)


def test_topics_rates_and_what_a_table_does_not_have(cell):
    made = cell(hockey__camera__dropout=0.0)
    made.listen(JointState, "joint_states")
    made.listen(PoseWithCovarianceStamped, "object_pose")
    made.listen(Odometry, "franka_driver/ground_truth/object")
    made.listen(Odometry, "franka_driver/ground_truth/mallet")
    made.connect()
    made.advance(1.0)
    counts = {topic: len(messages) for topic, messages in made.received.items()}
    assert 110 <= counts["object_pose"] <= 121 and 95 <= counts["joint_states"] <= 101
    q, _ = read_joint_state(made.received["joint_states"][-1], JOINT_NAMES)
    np.testing.assert_allclose(q, made.driver.simulation.joint_position, atol=1e-3)
    seen = made.received["object_pose"][-1]
    reading, covariance = read_observation(seen, BASE)
    np.testing.assert_allclose(reading.pose[:2], [1.0, 0.0], atol=5e-3)
    assert reading.height == pytest.approx(table.TABLE_ORIGIN[2])
    assert covariance[0, 0] == pytest.approx(5e-7)
    mallet = made.received["franka_driver/ground_truth/mallet"][-1].pose.pose
    assert (mallet.position.x, mallet.position.y) == pytest.approx((0.65, 0.0), abs=2e-3)
    assert mallet.orientation.w == pytest.approx(1.0, abs=1e-4)
    # Nobody can push a puck by a wrench here, and no tool feels.
    assert not made.helper.count_publishers("external_wrench")
    made.helper.destroy_publisher(made.hand)
    assert not made.helper.count_subscribers("disturbance")
    assert made.driver.report().values["pucks"] == 0


def test_new_pucks_come_where_they_should_and_leave_a_moving_arm_alone(cell):
    made = cell(seed=1001, hockey__pucks__x=[0.9, 1.1], hockey__pucks__drift=0.05)
    made.connect()
    made.advance(0.1)
    world, places = made.driver.simulation, []
    message = reach(world, 0.3)
    made.send(message)
    for _ in range(4):
        answer = call(made, Trigger, "franka_driver/new_puck", Trigger.Request())
        assert answer.success and "a puck is at" in answer.message
        places.append(world.puck_pose()[:2])
        assert np.hypot(*world.puck_twist()[:2]) <= 0.05
    assert all(0.88 <= x <= 1.12 and abs(y) <= 0.37 for x, y in places)
    assert len({round(x, 3) for x, _ in places}) == 4
    made.advance(2.0)
    assert world.joint_position[0] == pytest.approx(message.points[-1].positions[0], abs=5e-3)
    assert made.driver.report().values["pucks"] == 4


def test_the_same_seed_puts_pucks_at_the_same_places():
    draws = [PuckPlaces().draw(np.random.default_rng([1002, 1])) for _ in range(2)]
    np.testing.assert_array_equal(draws[0], draws[1])
    rng, places = np.random.default_rng(1003), PuckPlaces(x=(0.9, 1.0), y=(-0.1, 0.2), drift=0.3)
    poses, twists = map(np.array, zip(*(places.draw(rng) for _ in range(500)), strict=True))
    assert poses[:, 0].min() >= 0.9 and poses[:, 0].max() <= 1.0 and np.ptp(poses[:, 0]) > 0.09
    assert poses[:, 1].min() >= -0.1 and poses[:, 1].max() <= 0.2
    speeds = np.hypot(*twists.T[:2])
    assert 0.27 < speeds.max() <= 0.3 and not twists[:, 2].any()


@pytest.mark.parametrize(
    ("options", "message"), [({"x": (1.0, 0.9)}, "must not be above"), ({"drift": -1.0}, "drift")]
)
def test_places_off_the_table_are_named(options, message):
    with pytest.raises(ConfigurationError, match=message):
        PuckPlaces(**options)


def test_reset_brings_the_arm_home_unless_it_moves(cell):
    made = cell()
    made.connect()
    made.advance(0.1)
    world = made.driver.simulation
    made.send(reach(world, 0.3))
    made.advance(0.2)
    answer = call(made, Trigger, "franka_driver/reset", Trigger.Request())
    assert answer.success and "moves, and goes on" in answer.message
    made.advance(2.0)
    assert world.joint_position[0] == pytest.approx(0.3, abs=5e-3)
    answer = call(made, Trigger, "franka_driver/reset", Trigger.Request())
    assert answer.success and "back where it started" in answer.message
    np.testing.assert_allclose(world.joint_position, world.scene.joints, atol=5e-3)


def test_a_puck_that_finds_no_place_is_refused_with_the_reason(cell):
    made = cell(hockey__pucks__x=[0.65, 0.65], hockey__pucks__y=[0.0, 0.0])
    made.connect()
    made.advance(0.1)
    answer = call(made, Trigger, "franka_driver/new_puck", Trigger.Request())
    assert not answer.success and "under the mallet" in answer.message
    assert made.driver.report().values["pucks"] == 0


def test_a_reset_without_a_place_for_the_puck_changes_nothing(cell):
    made = cell(hockey__pucks__x=[0.65, 0.65], hockey__pucks__y=[0.0, 0.0])
    made.connect()
    made.advance(0.1)
    world = made.driver.simulation
    made.send(reach(world, 0.3))
    made.advance(2.5)
    puck = world.puck_pose()
    answer = call(made, Trigger, "franka_driver/reset", Trigger.Request())
    assert not answer.success and "under the mallet" in answer.message
    assert world.joint_position[0] == pytest.approx(0.3, abs=5e-3)
    np.testing.assert_allclose(world.puck_pose(), puck, atol=1e-6)


def test_goals_are_announced_once_and_counted(cell):
    made = cell()
    made.listen(Odometry, "franka_driver/goals")
    made.connect()
    made.advance(0.1)
    for direction in (1.0, -1.0, 1.0):
        made.driver.simulation.place_puck((1.51 + 0.8 * direction, 0.08, 0.0), (2.0 * direction, 0.0, 0.0))
        made.advance(0.2)
    events = made.received["franka_driver/goals"]
    assert [event.child_frame_id for event in events] == ["far", "near", "far"]
    passed = read_state(events[0], SIMULATED, BASE)
    assert passed.pose[0] == pytest.approx(table.TABLE_ORIGIN[0] + table.HALF_LENGTH, abs=3e-3)
    assert 1.5 < passed.twist[0] < 2.0
    values = made.driver.report().values
    assert (values["goals.far"], values["goals.near"]) == (2, 1)


def test_broken_rules_are_an_error_that_names_them(cell):
    made = cell()
    made.connect()
    made.advance(0.1)
    assert made.driver.report().level == 0 and made.driver.report().values["rule_violations"] == 0
    made.send(reach(made.driver.simulation, 0.9))  # sideways over the rim
    made.advance(2.5)
    report = made.driver.report()
    assert report.values["rule.side.instants"] > 0 and report.values["rule.elbow.instants"] == 0
    assert "rules were broken" in report.message and "side" in report.message


def test_markers_show_table_puck_mallet_and_arm():
    world = AirHockeyWorld()
    drawn = {marker.ns: marker for marker in scene_markers(world, BASE).markers}
    assert set(drawn) == {"robot", "puck", "mallet", "rims", "goals"}
    assert all(len(marker.points) > 1 and marker.header.frame_id == BASE for marker in drawn.values())
    puck = np.array([(p.x, p.y, p.z) for p in drawn["puck"].points])
    np.testing.assert_allclose(np.hypot(*(puck[:, :2] - [1.0, 0.0]).T), table.PUCK_RADIUS, atol=1e-6)
    np.testing.assert_allclose(puck[:, 2], table.TABLE_ORIGIN[2], atol=0.01)
    goals = np.array([(p.x, p.y) for p in drawn["goals"].points])
    assert np.ptp(goals[:, 0]) == pytest.approx(2 * table.HALF_LENGTH) and goals[:, 1].max() == 0.125
    arm = drawn["robot"].points
    assert (arm[-1].x, arm[-1].z) == pytest.approx((0.65, table.UNIVERSAL_JOINT_HEIGHT), abs=2e-3)


def test_the_mallets_tilt_is_its_orientation():
    world = AirHockeyWorld()
    world.data.qvel[7:9] = 3.0, -2.0  # the hinges swing
    world.advance(0.03)
    state, message = world.mallet_state(), true_mallet(world, BASE)
    q = message.pose.pose.orientation
    # Where the quaternion turns the vertical, by its rotation matrix's third column.
    down = -np.array([2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x**2 + q.y**2)])
    offset = state.position - state.joint_position
    np.testing.assert_allclose(down, offset / np.linalg.norm(offset), atol=1e-6)
    assert np.hypot(*state.tilt) > 0.01


def test_worlds_are_chosen_by_a_parameter():
    with pytest.raises(ConfigurationError, match="air_hockey"):
        FrankaDriverConfig(world="tennis")
    assert type(FrankaDriverConfig().simulation()).__name__ == "Simulation"
    assert isinstance(FrankaDriverConfig(world="air_hockey").simulation(), AirHockeyWorld)


def test_touches_of_the_mallet_are_announced_when_they_have_ended(cell):
    made = cell()
    made.listen(Odometry, "franka_driver/touches")
    made.connect()
    made.advance(0.1)
    for _ in range(2):
        made.driver.simulation.place_puck((0.85, 0.0, 0.0), (-0.8, 0.0, 0.0))
        made.driver.cell._touches = 0
        made.advance(0.3)
    events = made.received["franka_driver/touches"]
    assert len(events) == 2
    hit = read_state(events[0], SIMULATED, BASE)
    assert hit.pose[0] == pytest.approx(0.65 + table.PUCK_RADIUS + table.MALLET_RADIUS, abs=5e-3)
    assert 0.2 < hit.twist[0] < 0.8, "it comes back from the mallet"
