"""The simulated driver: rules, topics, services, what it refuses and what it survives."""

import itertools
import math
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("mujoco")

import rclpy
from driver_bench import Cell, call
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.qos import ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from sim_bridge.franka_driver import FrankaDriver, FrankaDriverConfig
from sim_bridge.pacing import Pacer, Ticker
from vpsto_ros.nodes.contact_planner import ContactPlannerNode
from vpsto_ros.nodes.conversions import SIMULATED, read_observation
from vpsto_ros.nodes.diagnostics import Pulse
from vpsto_ros.nodes.joint_conversions import read_joint_state, trajectory_message
from vpsto_ros.nodes.markers import arm_points
from vpsto_ros.nodes.mpc_planner import MpcPlannerNode
from vpsto_ros.nodes.state_estimator import StateEstimator
from vpsto_ros.planning.plane_path import follow_plane
from vpsto_ros.robot.kinematics import JOINT_NAMES, fr3_bimanual
from vpsto_ros.trajectory import OptimalBasis, Trajectory, synthesize

ROOT = Path(__file__).resolve().parents[1]
CONFIG = ROOT / "config" / "push_box.yaml"


@pytest.fixture(scope="module", autouse=True)
def ros():
    rclpy.init()
    yield
    rclpy.try_shutdown()


@pytest.fixture
def cell():
    made = []

    def make(**overrides):
        made.append(Cell(**overrides))
        return made[-1]

    yield make
    for each in made:
        each.close()


def reach(cell, offset=0.2, stamp=None):
    """A motion of joint 1 from where the arm stands, as a message."""
    robot, sim = cell.driver.simulation.robot, cell.driver.simulation
    q = sim.follower.reference(sim.time)[0]
    keys = np.stack([q, q + offset * np.eye(7)[0]])
    start = sim.time if stamp is None else stamp
    trajectory = synthesize(
        OptimalBasis.uniform(0), keys, np.zeros(7), np.zeros(7), robot.limits, start_time=start
    )
    return trajectory_message(trajectory, JOINT_NAMES)


def test_topics_rates_and_stamps(cell):
    made = cell()
    made.listen(Clock, "/clock")
    made.listen(JointState, "joint_states")
    made.listen(JointState, "desired_joint_states")
    made.listen(PoseWithCovarianceStamped, "object_pose")
    made.listen(WrenchStamped, "external_wrench")
    made.listen(Odometry, "franka_driver/ground_truth/object")
    made.listen(Odometry, "franka_driver/ground_truth/tool")
    made.connect()
    made.advance(1.0)
    expected = {
        "/clock": 100,
        "joint_states": 100,
        "desired_joint_states": 50,
        "object_pose": 47,
        "external_wrench": 50,
    }
    expected |= {"franka_driver/ground_truth/object": 50, "franka_driver/ground_truth/tool": 50}
    for topic, count in expected.items():
        assert 0.8 * count <= len(made.received[topic]) <= 1.1 * count + 1, topic
    joints = made.received["joint_states"][-1]
    q, qd = read_joint_state(joints, JOINT_NAMES)
    assert np.allclose(q, made.driver.simulation.joint_position, atol=1e-3) and np.allclose(
        qd, 0.0, atol=1e-2
    )
    assert len(joints.effort) == 7 and SIMULATED.seconds(joints.header.stamp) <= made.driver.simulation.time
    frame = made.received["object_pose"][-1]
    reading, covariance = read_observation(frame, "fr3_link0")
    assert np.allclose(reading.pose[:2], made.driver.simulation.object_pose()[:2], atol=0.02)
    assert covariance[0, 0] == pytest.approx(0.002**2)
    tool = made.received["franka_driver/ground_truth/tool"][-1].pose.pose.position
    assert (tool.x, tool.y, tool.z) == pytest.approx((0.38, -0.22, 0.02), abs=2e-3)


def test_a_trajectory_is_followed_and_nothing_is_lost(cell):
    made = cell()
    made.connect()
    made.advance(0.1)
    message = reach(made)
    made.send(message)
    made.advance(1.5)
    target = message.points[-1].positions[0]
    assert made.driver.simulation.joint_position[0] == pytest.approx(target, abs=5e-3)
    report = made.driver.report()
    assert report.level == 0 and report.message == "running"
    assert report.values["limit_violations"] == 0
    assert report.values["trajectories_accepted"] == 1
    assert report.values["steps"] == round(made.driver.simulation.time * 1000)


def test_two_arms_are_driven_like_one(cell):
    made = cell(scene__robot="two_balls", object__kind="disc", object__size=[0.1, 0.1], base_frame="table")
    made.listen(JointState, "joint_states")
    made.listen(WrenchStamped, "external_wrench")
    made.listen(Odometry, "franka_driver/ground_truth/tool")
    made.listen(MarkerArray, "franka_driver/markers")
    made.connect()
    made.advance(0.1)
    sim, names = made.driver.simulation, fr3_bimanual().joint_names
    start = np.array(sim.scene.balls.start)
    keys = np.stack([start, np.array([0.415, 0.036, 0.415, -0.036]), np.array([0.465, 0.036, 0.465, -0.036])])
    times = sim.time + 0.05 + np.array([0.0, 1.5, 2.5])
    plane = Trajectory.from_points(times, keys, np.zeros_like(keys))
    motion = follow_plane(plane, sim.plane).trajectory
    made.send(trajectory_message(motion, names))
    made.advance(2.8)
    report = made.driver.report()
    assert report.level == 0, report.message
    assert report.values["trajectories_accepted"] == 1 and report.values["limit_violations"] == 0
    assert report.values["contact.arms.steps"] == report.values["contact.table.steps"] == 0
    joints = made.received["joint_states"][-1]
    assert tuple(joints.name) == names and len(joints.effort) == 14
    assert read_joint_state(joints, names)[0] == pytest.approx(motion(motion.end_time), abs=5e-3)
    tools = {message.child_frame_id: message for message in made.received["franka_driver/ground_truth/tool"]}
    assert set(tools) == {"left_fr3_tool", "right_fr3_tool"}
    for side, y in (("left", 0.036), ("right", -0.036)):
        tool = tools[f"{side}_fr3_tool"].pose.pose.position
        assert (tool.x, tool.y, tool.z) == pytest.approx((0.465, y, 0.035), abs=3e-3)
    pushed = 0.465 + math.sqrt(0.08**2 - 0.036**2)
    assert sim.object_pose()[:2] == pytest.approx((pushed, 0.0), abs=4e-3)
    assert min(message.wrench.force.x for message in made.received["external_wrench"]) < -1.0
    drawn = {marker.ns: marker for marker in made.received["franka_driver/markers"][-1].markers}
    assert {"left_robot", "right_robot", "balls", "object"} <= set(drawn)
    for side, end in zip(("left", "right"), sim.plane.tips(sim.joint_position), strict=True):
        line = [(p.x, p.y, p.z) for p in drawn[f"{side}_robot"].points]
        assert line[0] == pytest.approx((0.0, 0.22 if side == "left" else -0.22, 0.0))
        assert len(line) == 11 and line[-1] == pytest.approx(tuple(end), abs=1e-3)
        assert line[-2][2] == pytest.approx(end[2] + 0.2, abs=2e-3), "the crank's corner is above the ball"


def test_the_hand_is_published_with_its_yaw(cell):
    made = cell(scene__robot="hand", scene__hand__start=[0.4, -0.1, 2.0])
    made.listen(Odometry, "franka_driver/ground_truth/tool")
    made.listen(MarkerArray, "franka_driver/markers")
    made.connect()
    made.advance(0.2)
    pose = made.received["franka_driver/ground_truth/tool"][-1].pose.pose
    assert 2.0 * math.atan2(pose.orientation.z, pose.orientation.w) == pytest.approx(2.0, abs=1e-3)
    assert (pose.position.x, pose.position.y) == pytest.approx((0.4, -0.1), abs=1e-3)
    assert {"robot", "hand"} <= {marker.ns for marker in made.received["franka_driver/markers"][-1].markers}


def test_the_markers_of_the_rod_are_the_arm_from_base_to_tip(cell):
    made = cell()
    made.advance(0.05)
    sim = made.driver.simulation
    np.testing.assert_allclose(sim.arm_points()[0], arm_points(sim.joint_position), atol=1e-5)


def wrong_names(message):
    message.joint_names = [f"panda_joint{i}" for i in range(1, 8)]


def missing_joint(message):
    message.joint_names = message.joint_names[:6]


def not_a_number(message):
    message.points[1].positions[2] = np.nan


def backwards(message):
    message.points[-1].time_from_start.sec = -1


def ends_moving(message):
    message.points[-1].velocities[0] = 0.5


def too_fast(message):
    for point in message.points:
        nanoseconds = (point.time_from_start.sec * 10**9 + point.time_from_start.nanosec) // 4
        point.time_from_start.sec, point.time_from_start.nanosec = divmod(nanoseconds, 10**9)


def jumps(message):
    for point in message.points:
        point.positions[0] += 0.1


def stale(message):
    message.header.stamp = SIMULATED.stamp(0.001)
    for index, point in enumerate(message.points):
        point.time_from_start.sec, point.time_from_start.nanosec = 0, 1000 * (index + 1)


def far_future(message):
    message.header.stamp.sec += 1000


def empty(message):
    message.points = []


@pytest.mark.parametrize(
    ("spoil", "rule"),
    [
        (wrong_names, "joint_names"),
        (missing_joint, "shape"),
        (not_a_number, "finite"),
        (backwards, "time"),
        (ends_moving, "end_velocity"),
        (too_fast, "limits"),
        (jumps, "jump"),
        (stale, "past"),
        (far_future, "future"),
        (empty, "shape"),
    ],
)
def test_broken_trajectories_are_refused_by_rule_and_the_arm_stays_safe(cell, spoil, rule):
    made = cell()
    made.connect()
    made.advance(0.1)
    message = reach(made)
    spoil(message)
    made.send(message)
    made.advance(0.1)
    assert made.counts()[f"joint_trajectory.{rule}"] == 1, made.counts()
    report = made.driver.report()
    assert report.level == 1 and rule in report.message
    assert report.values[f"rejected.joint_trajectory.{rule}"] == "1"
    assert np.allclose(made.driver.simulation.joint_velocity, 0.0, atol=1e-2)
    made.send(reach(made))
    made.advance(0.3)
    assert made.driver.report().values["trajectories_accepted"] == 1


def test_a_second_planner_is_noticed_and_what_comes_out_of_order_is_refused(cell):
    made = cell()
    other = made.helper.create_publisher(JointTrajectory, "joint_trajectory", 1)
    made.connect()
    made.advance(0.3)
    made.send(reach(made))
    made.advance(0.3)
    late = reach(made, offset=-0.2, stamp=made.driver.simulation.time - 0.35)
    other.publish(late)
    made.spin(0.05)
    made.advance(0.01)
    assert made.counts()["joint_trajectory.order"] == 1
    other.publish(reach(made, offset=-0.2))
    made.spin(0.05)
    made.advance(0.3)
    assert made.counts()["joint_trajectory.jump"] == 1
    assert "2 publishers" in made.driver.report().message and made.counts()["second_planner"] >= 1
    assert made.driver.report().values["limit_violations"] == 0


def test_a_plan_for_later_does_not_shut_out_what_is_sent_before_it(cell):
    made = cell()
    made.connect()
    made.advance(0.1)
    made.send(reach(made, stamp=made.driver.simulation.time + 9.0))
    assert made.counts()["joint_trajectory.future"] == 1
    made.send(reach(made, offset=-0.1, stamp=made.driver.simulation.time + 0.9))
    made.advance(0.1)
    message = reach(made)
    made.send(message)
    made.advance(1.5)
    assert made.driver.report().values["trajectories_accepted"] == 2
    assert not made.counts()["joint_trajectory.order"]
    q = made.driver.simulation.joint_position
    assert q[0] == pytest.approx(message.points[-1].positions[0], abs=5e-3), "the later one rules"


def test_a_late_plan_does_not_undo_a_stop_that_was_sent_after_it(cell):
    made = cell()
    made.connect()
    made.advance(0.3)
    late = reach(made)
    made.advance(0.02)
    made.send(reach(made, offset=0.01, stamp=made.driver.simulation.time + 0.05))
    made.send(late)
    assert made.counts()["joint_trajectory.order"] == 1


def test_torque_beyond_the_limit_is_a_violation_and_its_rate_is_not(cell):
    made = cell()
    made.connect()
    made.advance(0.05)
    limits, sim = made.driver.simulation.limits, made.driver.simulation
    still = (sim.joint_position, np.zeros(7), np.zeros(7), sim.joint_position, np.zeros(7))
    limits.observe(*still, np.stack([np.zeros(7), np.full(7, 2.0)]))
    report = made.driver.report()
    assert report.level == 0 and report.values["limit_violations"] == 0 == limits.violations
    assert report.values["demand.torque_rate.instants"] >= 1
    limits.observe(*still, np.stack([np.full(7, 1.5), np.zeros(7)]))
    report = made.driver.report()
    assert report.level == 2 and report.values["limit_violations"] == 1 == limits.violations
    assert report.values["limit.torque.instants"] == 1


def test_a_simulation_that_nobody_advances_is_stale(cell):
    made = cell()
    made.connect()
    made.advance(0.05)
    made.driver._advanced = Pulse(itertools.count(0.0, 2.0).__next__)
    report = made.driver.report()
    assert report.level == 3 and "not been advanced" in report.message


def test_transitions_wait_for_the_end_of_a_slice(cell):
    made = cell()
    made.connect()
    stop, failures = threading.Event(), []

    def physics():
        while not stop.is_set():
            try:
                made.driver.advance()
            except Exception as error:
                failures.append(error)
                return

    thread = threading.Thread(target=physics)
    thread.start()
    try:
        for _ in range(3):
            made.driver.trigger_deactivate()
            made.driver.trigger_cleanup()
            assert made.driver.failure is None and not made.driver.configured
            made.driver.start()
    finally:
        stop.set()
        thread.join()
    assert not failures


def test_pause_and_reset(cell):
    made = cell()
    made.connect()
    made.advance(0.1)
    made.send(reach(made))
    made.advance(0.5)
    assert call(made, SetBool, "franka_driver/pause", SetBool.Request(data=True)).success
    frozen = made.driver.simulation.time
    made.advance(0.05)
    assert made.driver.simulation.time == frozen and made.driver.report().message == "paused"
    assert call(made, SetBool, "franka_driver/pause", SetBool.Request(data=False)).success
    assert call(made, Trigger, "franka_driver/reset", Trigger.Request()).success
    assert made.driver.simulation.time >= frozen
    made.advance(0.1)
    assert np.allclose(
        made.driver.simulation.joint_position, made.driver.simulation.scene.joints(), atol=5e-3
    )
    made.driver.trigger_deactivate()
    answer = made.helper.create_client(Trigger, "franka_driver/reset").call_async(Trigger.Request())
    made.executor.spin_until_future_complete(answer, timeout_sec=5.0)
    assert not answer.result().success and "not active" in answer.result().message


def push(cell, force, frame="fr3_link0"):
    message = WrenchStamped()
    message.header.frame_id = frame
    message.wrench.force.x = force
    cell.hand.publish(message)
    cell.spin(0.02)


def test_a_hand_pushes_the_object_for_as_long_as_it_says_so(cell):
    made = cell()
    made.connect()
    made.advance(0.1)
    before = made.driver.simulation.object_pose()[0]
    for _ in range(4):
        push(made, 4.0)
        made.advance(0.05)
    moved = made.driver.simulation.object_pose()[0] - before
    assert moved > 0.02
    made.advance(1.0)
    rest = made.driver.simulation.object_pose()[0]
    made.advance(0.3)
    assert made.driver.simulation.object_pose()[0] == pytest.approx(rest, abs=1e-4)
    broken = ((np.nan, "fr3_link0", "not finite"), (4.0, "map", "frame 'map'"), (1e4, "fr3_link0", "hand"))
    for force, frame, reason in broken:
        push(made, force, frame)
        assert reason in made.driver.complaints.recent()


def test_topics_live_in_the_namespace_of_the_node(cell):
    made = cell(namespace="cell_1")
    made.listen(JointState, "joint_states")
    made.connect()
    made.advance(0.1)
    assert made.received["joint_states"] and made.helper.count_publishers("/cell_1/joint_states") == 1


def test_the_scene_is_a_matter_of_parameters(cell):
    tee = {"object__kind": "tee", "object__size": [0.12, 0.04], "scene__plant__mass": 0.8}
    made = cell(**tee, scene__object_pose=[0.55, 0.1, 0.5], camera__latency=0.1, seed=7)
    sim = made.driver.simulation
    assert len(sim.scene.plant.shape.primitives) == 2 and sim.scene.plant.mass == 0.8
    assert np.allclose(sim.object_pose(), (0.55, 0.1, 0.5), atol=1e-6) and sim.camera.config.latency == 0.1


@pytest.mark.parametrize("node", [FrankaDriver, StateEstimator, ContactPlannerNode, MpcPlannerNode])
def test_the_shipped_parameters_are_accepted(node):
    names = {
        FrankaDriver: "franka_driver",
        StateEstimator: "state_estimator",
        ContactPlannerNode: "contact_planner",
        MpcPlannerNode: "mpc_planner",
    }
    made = node(names[node], cli_args=["--ros-args", "--params-file", str(CONFIG)])
    assert made.get_parameter("base_frame").value == "fr3_link0"
    made.trigger_configure()
    assert made.failure is None and made.configured
    made.destroy_node()


def test_the_defaults_of_driver_and_planners_describe_the_same_scene():
    driver, planner, contact = (
        FrankaDriverConfig(),
        MpcPlannerNode.default_config,
        ContactPlannerNode.default_config,
    )
    assert driver.object == planner.model.object == contact.model.object
    assert driver.scene.tool_height == planner.planner.tool_height


def test_a_wrong_scene_ends_the_process_with_one_clear_line():
    code = "import sys; from sim_bridge.franka_driver import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "--ros-args", "-p", "scene.start_tool:=[0.05, 0.0]"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60)
    lines = [line for line in (done.stdout + done.stderr).splitlines() if line.strip()]
    assert done.returncode == 2 and len(lines) == 1
    assert "start_tool" in lines[0] and "out of reach" in lines[0]


class FakeTime:
    def __init__(self):
        self.now = 0.0
        self.slept = 0.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.slept += seconds
        self.now += seconds


def test_pacing_waits_catches_up_and_gives_up_on_long_interruptions():
    fake = FakeTime()
    pacer = Pacer(2.0, clock=fake, sleep=fake.sleep)
    pacer.start(0.0)
    pacer.wait(1.0)
    assert fake.now == pytest.approx(0.5)
    fake.now += 0.1  # the host was busy
    before = fake.slept
    pacer.wait(1.1)
    assert fake.slept == before
    pacer.wait(1.4)
    assert fake.now == pytest.approx(0.7) and pacer.delayed == 0.0
    fake.now += 10.0
    pacer.wait(1.5)
    assert pacer.delayed == pytest.approx(9.95)
    pacer.wait(1.7)
    assert fake.now == pytest.approx(10.8)


def test_tickers_keep_their_rate_on_any_grid():
    ticker = Ticker(30.0)
    ticks = [t for t in np.arange(0.005, 10.0001, 0.005) if ticker.due(t)]
    assert len(ticks) == pytest.approx(300, abs=1)
    ticker = Ticker(100.0)
    assert (
        ticker.due(0.005)
        and not ticker.due(0.009)
        and ticker.due(1.0)
        and not ticker.due(1.005)
        and ticker.due(1.01)
    )


def test_publishers_offer_what_their_readers_need(cell):
    made = cell()
    made.connect()
    reliable, best_effort = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
    expected = {
        "/clock": best_effort,
        "/joint_states": reliable,
        "/object_pose": reliable,
        "/external_wrench": reliable,
        "/franka_driver/ground_truth/object": best_effort,
        "/franka_driver/markers": reliable,
        "/diagnostics": reliable,
    }
    for topic, reliability in expected.items():
        (info,) = made.helper.get_publishers_info_by_topic(topic)
        assert info.qos_profile.reliability == reliability, topic
    for topic in ("/joint_trajectory", "/disturbance"):
        (info,) = made.helper.get_subscriptions_info_by_topic(topic)
        assert info.qos_profile.reliability == best_effort, topic
