"""Robust pushing in the nodes: particles, contact plans of two tools, two arms; refusals and stops."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from geometry_msgs.msg import PoseArray, PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from nav_msgs.msg import Odometry
from node_bench import Bench
from rclpy.qos import DurabilityPolicy
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.estimation.measurement import MeasurementLimits
from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.estimation.planar_kalman import PlanarKalmanConfig
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.nodes.contact_conversions import contact_messages, read_effector_contact
from vpsto_ros.nodes.contact_planner import ContactPlannerNode
from vpsto_ros.nodes.contact_planner_config import ContactPlannerNodeConfig
from vpsto_ros.nodes.conversions import (
    SIMULATED,
    belief_message,
    goal_message,
    observation_message,
    read_belief,
    read_state,
)
from vpsto_ros.nodes.estimators import Bridging, KalmanEstimator
from vpsto_ros.nodes.joint_conversions import joint_state_message, trajectory_from_message
from vpsto_ros.nodes.mpc_planner import MpcPlannerNode
from vpsto_ros.nodes.mpc_planner_config import MpcPlannerConfig
from vpsto_ros.nodes.robots import BeliefModelConfig, RobotConfig, contact_rule
from vpsto_ros.nodes.scene import ModelConfig, ShapeConfig, TableConfig
from vpsto_ros.nodes.state_estimator import StateEstimator
from vpsto_ros.nodes.state_estimator_config import StateEstimatorConfig
from vpsto_ros.planning.belief_space.config import RobustMpcConfig, RobustPushingConfig
from vpsto_ros.planning.belief_space.contact_plan import RobustContactPlan
from vpsto_ros.planning.goal import PlanarGoal
from vpsto_ros.robot.bimanual_plane import BimanualPlane
from vpsto_ros.robot.kinds import TOOL_KINDS
from vpsto_ros.robot.kinematics import JOINT_NAMES, fr3_bimanual

FRAME = "fr3_link0"
ARMS = BimanualPlane(fr3_bimanual())
NAMES = ARMS.robot.joint_names
EFFECTORS = TOOL_KINDS["two_balls"].effectors
TOOLS = TOOL_KINDS["two_balls"].frames
CAN = {"model__object__kind": "disc", "model__object__size": [0.1, 0.1]}
BIMANUAL = {"robot__kind": "two_balls", **CAN}
ROBUST = {"kind": "robust_pushing", **BIMANUAL}
START = np.array([0.36, 0.08, 0.36, -0.08])
PLACE = np.array([0.47, 0.0, 0.0])
KNOWN = ((JointState, "joint_states"), (PoseArray, "object_belief"), (PoseStamped, "goal_pose"))
BALLS, HAND = RobotConfig("two_balls"), RobotConfig("hand")


@pytest.fixture(scope="module", autouse=True)
def ros():
    rclpy.init()
    yield
    rclpy.try_shutdown()


@pytest.fixture
def bench():
    made = []

    def make(*arguments, **overrides):
        made.append(Bench(*arguments, **overrides))
        return made[-1]

    yield make
    for each in made:
        each.close()


def joints(bench, q, velocity=None, names=NAMES):
    velocity = np.zeros(len(q)) if velocity is None else velocity
    return joint_state_message(names, q, velocity, np.zeros(len(q)), bench.stamp(), FRAME)


def belief(bench, place=PLACE, std=0.003, count=50, age=0.02, frame=FRAME):
    rng = np.random.default_rng(round(bench.time * 1e3))
    poses = place + np.append(std, [std, 0.1]) * rng.standard_normal((count, 3))
    return belief_message(poses, bench.stamp(-age), frame)


def goal(bench, x=0.56, y=0.05):
    bench.send("goal_pose", goal_message(PlanarGoal(np.array([x, y])), bench.stamp(), FRAME))


# State estimator with particles


@pytest.fixture
def estimator(bench):
    made = bench(StateEstimator, "state_estimator", kind="particles", **BIMANUAL)
    made.talk(PoseWithCovarianceStamped, "object_pose")
    made.talk(JointState, "joint_states")
    made.listen(Odometry, "object_state")
    made.listen(PoseArray, "object_belief")
    made.connect()
    return made


def see(bench, pose, age=0.06, std=0.003):
    covariance = np.diag([std**2, std**2, 0.04])
    bench.send("object_pose", observation_message(np.array(pose), covariance, bench.stamp(-age), FRAME))


def watched(bench, point=START, pose=PLACE, *, camera=True):
    """Arms whose balls are at point(time), and a camera that sees the object at a pose."""
    place = point if callable(point) else lambda _: point

    def each(t):
        bench.send("joint_states", joints(bench, ARMS.joints(place(t)[None])[0]))
        if camera and round(t * 100) % 3 == 0:
            see(bench, pose)

    return each


def test_particles_are_published_as_they_are(estimator):
    estimator.advance(1.0, each=watched(estimator))
    state = read_state(estimator.received["object_state"][-1], SIMULATED, FRAME)
    assert np.allclose(state.pose[:2], PLACE[:2], atol=2e-3)
    assert state.stamp == pytest.approx(estimator.time, abs=0.03), "a belief is of the latest posture"
    message = estimator.received["object_belief"][-1]
    poses = read_belief(message, FRAME)
    assert poses.shape == (50, 3) and np.allclose(poses[:, :2].mean(axis=0), PLACE[:2], atol=2e-3)
    assert message.header.frame_id == FRAME
    report = estimator.node.report()
    assert report.level == 0 and report.values["filter"] == "tracking" and report.values["particles"] == 200


def test_particles_are_pushed_along_while_the_camera_is_silent(estimator):
    estimator.advance(0.6, each=watched(estimator))
    begin = estimator.time

    def pushing(t):
        ahead = min(0.35 * (t - begin), 0.13)  # from 11 cm behind the can until it has moved by some
        return START + np.array([ahead, -0.04, ahead, 0.04])

    estimator.advance(0.4, each=watched(estimator, pushing, camera=False))
    state = read_state(estimator.received["object_state"][-1], SIMULATED, FRAME)
    ahead = np.sqrt(0.08**2 - 0.04**2)  # of balls 4 cm aside, the centre of a can that both touch
    assert state.pose[0] == pytest.approx(START[0] + 0.13 + ahead, abs=0.01)
    assert state.pose[0] > PLACE[0] + 0.05
    assert state.stamp > begin + 0.3
    estimator.advance(0.3, each=watched(estimator, pushing, camera=False))
    before = len(estimator.received["object_state"])
    estimator.advance(0.3, each=watched(estimator, pushing, camera=False))
    assert len(estimator.received["object_state"]) == before, "not for ever"
    report = estimator.node.report()
    assert report.level == 3 and "silent" in report.message


def test_without_joint_states_nothing_is_known(estimator):
    estimator.advance(0.3, each=lambda _: see(estimator, PLACE))
    report = estimator.node.report()
    assert report.level == 3 and "no joint_states yet" in report.message
    assert not estimator.received["object_state"] and not estimator.received["object_belief"]
    estimator.advance(0.4, each=watched(estimator))
    assert estimator.received["object_state"] and estimator.node.report().level != 3


def test_joint_states_of_another_robot_are_refused_by_name(estimator):
    estimator.advance(0.2, each=lambda _: estimator.send(
        "joint_states", joints(estimator, np.zeros(7), names=JOINT_NAMES)))  # fmt: skip
    assert "no joint 'left_fr3_joint1'" in estimator.node.complaints.recent(60.0)
    assert "no joint_states yet" in estimator.node.report().message


def test_a_moved_object_is_found_again_and_the_filter_says_so(estimator):
    estimator.advance(0.5, each=watched(estimator))
    estimator.advance(0.15, each=watched(estimator, pose=PLACE + [0.05, 0.05, 0.0]))
    assert estimator.node.report().values["reinitialized"] == 1
    estimator.advance(0.4, each=watched(estimator, pose=PLACE + [0.05, 0.05, 0.0]))
    state = read_state(estimator.received["object_state"][-1], SIMULATED, FRAME)
    assert np.allclose(state.pose[:2], PLACE[:2] + 0.05, atol=3e-3)


def test_a_restarted_simulation_starts_the_particles_afresh(estimator):
    estimator.advance(0.5, each=watched(estimator))
    estimator.time = 0.0
    estimator.advance(0.5, each=watched(estimator, pose=PLACE + [0.1, 0.0, 0.0]))
    assert estimator.node.complaints.counts["clock_reset"] == 1
    state = read_state(estimator.received["object_state"][-1], SIMULATED, FRAME)
    assert np.allclose(state.pose[:2], PLACE[:2] + [0.1, 0.0], atol=3e-3)


LIMITS = {"max_age": 0.2, "max_ahead": 0.02, "table__x": [0.3, 0.55], "table__y": [-0.2, 0.2]}


def test_limits_set_on_the_node_are_those_of_its_particles(bench):
    made = bench(StateEstimator, "state_estimator", kind="particles", **LIMITS, **BIMANUAL)
    limits = MeasurementLimits((0.3, 0.55), (-0.2, 0.2), max_age=0.2, max_ahead=0.02)
    assert made.node.config.limits == made.node.estimator.limits == limits
    names = made.node.get_parameters_by_prefix("particles")
    assert names and not {"history", "max_ahead", "table_x", "table_y"} & set(names), "set once only"


def test_every_limit_that_a_node_takes_its_particles_take():
    for field in dataclasses.fields(StateEstimatorConfig):
        if field.name in ("max_age", "max_ahead"):
            for bound in ("minimum", "maximum"):
                made = StateEstimatorConfig(**{field.name: field.metadata[bound]}).limits
                assert getattr(made, field.name) == field.metadata[bound]
    wide = StateEstimatorConfig(table=TableConfig((-3.0, 3.0), (-3.0, 3.0))).limits
    assert wide.table_x == wide.table_y == (-3.0, 3.0)
    assert StateEstimatorConfig().limits == MeasurementLimits(), "one default, with or without nodes"


def test_particles_take_frames_as_old_as_the_node_allows(bench):
    for allowed, age, counted in ((1.0, 0.7, 0), (0.2, 0.15, 0), (0.2, 0.3, 1)):
        made = bench(StateEstimator, "state_estimator", kind="particles", max_age=allowed, **BIMANUAL)
        made.talk(PoseWithCovarianceStamped, "object_pose")
        made.talk(JointState, "joint_states")
        made.connect()
        made.advance(1.0, each=watched(made, camera=False))
        see(made, PLACE, age=age)
        made.advance(0.02)
        assert sum(made.node.complaints.counts.values()) == counted, made.node.complaints.counts
        assert np.isfinite(made.node.estimator.frame_stamp) == (not counted)
        made.close()


def test_a_frame_ahead_of_the_last_joint_states_is_refused_by_the_limit_of_the_node(bench):
    for allowed, counted in ((0.2, 0), (0.02, 1)):
        made = bench(StateEstimator, "state_estimator", kind="particles", max_ahead=allowed, **BIMANUAL)
        made.talk(PoseWithCovarianceStamped, "object_pose")
        made.talk(JointState, "joint_states")
        made.connect()
        made.advance(0.3, each=watched(made, camera=False))
        made.advance(0.1)
        see(made, PLACE, age=0.0)
        made.advance(0.02)
        assert made.node.complaints.counts["invalid"] == counted, made.node.complaints.counts
        made.close()


def wrench(bench, force, age=0.0):
    message = WrenchStamped()
    message.header.stamp, message.header.frame_id = bench.stamp(-age), FRAME
    message.wrench.force.x, message.wrench.force.y = force
    bench.send("external_wrench", message)


@pytest.fixture
def feeling(bench):
    made = bench(StateEstimator, "state_estimator", kind="particles", touch=True, **BIMANUAL)
    made.talk(PoseWithCovarianceStamped, "object_pose")
    made.talk(JointState, "joint_states")
    made.talk(WrenchStamped, "external_wrench")
    made.connect()
    return made


def feel(bench, duration, force, age=0.0, *, camera=True):
    """A force that is measured at 50 Hz while the balls stand away from an object that is seen."""
    follow = watched(bench, camera=camera)

    def each(t):
        follow(t)
        if round(t * 100) % 2 == 0:
            wrench(bench, force, age)

    bench.advance(duration, each=each)


def test_forces_that_say_nothing_new_are_no_complaint(feeling):
    """Nor are those that come before the object is seen."""
    feel(feeling, 0.4, (0.0, 0.0), camera=False)
    feel(feeling, 0.8, (0.0, 0.0))
    report = feeling.node.report()
    assert report.level == 0, report.message
    assert not feeling.node.complaints.counts and not any("touch" in name for name in report.values)


NOBODY_NEAR = "a force is felt where no particle is near"


def test_a_force_where_no_particle_is_near_is_counted_and_said(feeling):
    feel(feeling, 0.4, (0.0, 0.0))
    feel(feeling, 0.5, (-3.0, 0.0))
    report = feeling.node.report()
    assert report.level == 1 and report.message == "force not used, outlier: " + NOBODY_NEAR
    assert 3 <= int(report.values["rejected.touch_outlier"]) <= 7, "once per touch.interval, not at 50 Hz"
    assert "rejected.outlier" not in report.values, "poses are counted apart"


@pytest.mark.parametrize(
    ("age", "kind", "words"),
    [
        (1.5, "external_wrench", "external_wrench refused: it is 1.5"),
        (-0.3, "external_wrench", "in the future (allowed 0.1 s)"),
    ],
)
def test_forces_too_old_or_ahead_are_refused_by_the_limits_of_the_node(feeling, age, kind, words):
    feel(feeling, 0.4, (0.0, 0.0))
    feel(feeling, 0.2, (-3.0, 0.0), age)
    assert feeling.node.complaints.counts[kind] == 10 and words in feeling.node.complaints.recent(60.0)


def test_forces_without_joint_states_are_counted(feeling):
    feel(feeling, 0.4, (0.0, 0.0))
    feeling.advance(0.3, each=lambda _: wrench(feeling, (0.0, 0.0)))
    assert feeling.node.complaints.counts["touch_invalid"] >= 15
    assert "ahead of the last plane point" in feeling.node.complaints.recent(60.0)


def test_touch_narrows_the_belief_where_it_is_asked_for(bench):
    spreads = {}
    for touch in (False, True):
        made = bench(StateEstimator, "state_estimator", kind="particles", touch=touch, **BIMANUAL)
        for kind, topic in (
            (PoseWithCovarianceStamped, "object_pose"), (JointState, "joint_states"),
            (WrenchStamped, "external_wrench"),
        ):  # fmt: skip
            made.talk(kind, topic)
        made.listen(PoseArray, "object_belief")
        if not touch:  # nobody listens to external_wrench, which `connect` would wait for
            del made.publishers["external_wrench"]
        made.connect()
        point = np.array([0.39, 0.0, 0.3, -0.2])  # the left ball touches the can from behind
        follow = watched(made, point, camera=False)

        def each(t, made=made, follow=follow, touch=touch):
            follow(t)
            if t < 0.2:
                see(made, PLACE, age=0.0, std=0.02)
            elif touch:
                wrench(made, (-3.0, 0.0))

        made.advance(0.5, each=each)
        poses = read_belief(made.received["object_belief"][-1], FRAME)
        spreads[touch] = poses[:, 0].std()
        made.close()
    assert spreads[True] < 0.7 * spreads[False], spreads


def test_samples_of_kalman_filters_have_the_mean_and_spread_of_the_state():
    made = KalmanEstimator(PlanarKalmanConfig(), Bridging(0.1, 0.1), np.random.default_rng(0))
    full = np.diag([1e-4, 4e-4, 1e-2, 1.0, 1.0, 1.0])
    state = ObjectState(1.0, np.array([0.5, 0.1, 0.2]), np.zeros(3), full)
    samples = made.belief(state, 4000)
    assert samples.shape == (4000, 3)
    assert np.allclose(samples.mean(axis=0), state.pose, atol=6e-3)
    assert np.allclose(samples.std(axis=0), [0.01, 0.02, 0.1], rtol=0.05)


# Contact planner


@pytest.fixture
def contacts(bench):
    made = bench(ContactPlannerNode, "contact_planner", **ROBUST)
    for kind, topic in KNOWN:
        made.talk(kind, topic)
    made.listen(Odometry, "contact_plan")
    made.listen(MarkerArray, "contact_planner/markers")
    made.connect()
    return made


def test_both_tools_are_told_where_to_touch(contacts):
    q = ARMS.joints(START[None])[0]

    def inputs(_):
        contacts.send("joint_states", joints(contacts, q))
        contacts.send("object_belief", belief(contacts, std=0.01))

    contacts.advance(0.2, each=inputs)
    assert not contacts.received["contact_plan"] and "goal_pose" in contacts.node.report().message
    goal(contacts, 0.6, 0.0)
    contacts.advance(0.5, each=inputs)
    messages = contacts.received["contact_plan"]
    assert 16 <= len(messages) <= 24
    read = [read_effector_contact(m, SIMULATED, FRAME, EFFECTORS, TOOLS) for m in messages[-2:]]
    assert [plan.tool for plan in read] == list(TOOLS) and read[0].stamp == read[1].stamp
    left, right = (plan.mean for plan in read)
    assert left[1] > 0.02 and right[1] < -0.02 and max(left[0], right[0]) < PLACE[0]
    # Eq. (6.38): how exactly to touch, and how uncertain the object is.
    expected = RobustMpcConfig().planning.contact_std ** 2 + 0.01**2
    assert np.trace(read[0].covariance) / 2 == pytest.approx(expected, rel=0.15)
    assert messages[-1].twist.twist.linear.x > 0.05
    names = {marker.ns for m in contacts.received["contact_planner/markers"] for marker in m.markers}
    assert {"touch", "contact_prior", "push"} <= names
    info = contacts.helper.get_publishers_info_by_topic("contact_plan")[0].qos_profile
    assert info.durability == DurabilityPolicy.TRANSIENT_LOCAL
    contacts.advance(0.8, each=lambda _: contacts.send("joint_states", joints(contacts, q)))
    assert "no object_belief" in contacts.node.report().message
    contacts.advance(0.1, each=lambda _: contacts.send(
        "joint_states", joints(contacts, np.zeros(7), names=JOINT_NAMES)))  # fmt: skip
    assert "no joint 'left_fr3_joint1'" in contacts.node.report().message


# MPC planner


@pytest.fixture
def planner(bench):
    # Slow tools: within a test they do not reach an object that its beliefs leave standing.
    slow = {"robust.planning.speed": 0.12, "robust.planning.acceleration": 0.6}
    made = bench(MpcPlannerNode, "mpc_planner", **ROBUST, **slow)
    made.node.deadline = 60.0  # simulated time stands while it plans; a busy host must not change the plans
    for kind, topic in (
        (JointState, "joint_states"),
        (JointState, "desired_joint_states"),
        (PoseArray, "object_belief"),
        (Odometry, "contact_plan"),
        (PoseStamped, "goal_pose"),
    ):
        made.talk(kind, topic)
    made.listen(JointTrajectory, "joint_trajectory")
    made.listen(MarkerArray, "mpc_planner/markers")
    made.connect()
    made.q, made.running = ARMS.joints(START[None])[0], None
    return made


def drive(bench, *, known=True, q=None):
    """Arms that follow the last trajectory exactly, and a belief."""

    def each(t):
        if bench.received["joint_trajectory"]:
            bench.running = trajectory_from_message(bench.received["joint_trajectory"][-1])
        position, velocity = bench.q, np.zeros(14)
        if bench.running is not None:
            position, velocity, _ = bench.running.state(t)
        for topic in ("joint_states", "desired_joint_states"):
            bench.send(topic, joints(bench, position, velocity))
        if known:
            bench.send("object_belief", belief(bench))

    return each


def speed(bench):
    return np.abs(bench.running.state(bench.time)[1]).max()


def start_moving(bench):
    bench.advance(0.5, each=drive(bench))
    goal(bench)
    for _ in range(60):
        bench.advance(0.05, each=drive(bench))
        if bench.running is not None and speed(bench) > 0.05:
            return
    raise AssertionError(f"the arms do not move: {bench.node.last.message}")


def test_both_arms_are_planned_for_and_a_controller_could_follow(planner):
    planner.advance(0.5, each=drive(planner))
    goal(planner)
    planner.advance(1.1, each=drive(planner))
    assert planner.node.last.valid, planner.node.last.message
    messages = planner.received["joint_trajectory"]
    assert len(messages) >= 10
    previous = None
    for message in messages:
        trajectory = trajectory_from_message(message)
        assert list(message.joint_names) == list(NAMES)
        assert trajectory.violations(ARMS.robot.limits, relative_tolerance=1e-4) == []
        assert np.abs(message.points[-1].velocities).max() < 1e-7
        if previous is not None and trajectory.start_time < previous.end_time:
            at = max(trajectory.start_time, previous.start_time)
            assert np.abs(trajectory(at) - previous(at)).max() < 1e-3
        heights = ARMS.tool_heights(trajectory(np.linspace(trajectory.start_time, trajectory.end_time, 40)))
        assert np.abs(heights - ARMS.height).max() < 1e-3
        previous = trajectory
    values = planner.node.report().values
    assert values["deadline_misses"] == 0 and values["mode"] == "robust" and "age.object_belief_s" in values
    end = ARMS.tool(previous(previous.end_time))
    assert end[0] > START[0] + 0.02 and end[2] > START[2] + 0.02, "both balls go to the can"
    drawn = {m.ns: m for array in planner.received["mpc_planner/markers"] for m in array.markers}
    shown = {name for name, m in drawn.items() if m.action == 0}
    assert shown >= {"planned_tool_path", "predicted_object_path", "predicted_spread", "object", "goal"}
    assert {"robot", "robot_1"} <= shown
    tips = [drawn[name].points[-1] for name in ("robot", "robot_1")]
    assert all(tip.z == pytest.approx(ARMS.height, abs=2e-3) for tip in tips)


def test_the_belief_gets_friction_and_centre_that_no_message_carries(planner):
    planner.send("object_belief", belief(planner, count=400))
    planner.advance(0.05)
    known = planner.node.task.belief.latest.belief
    assert known.count == 400 and 0.0 <= known.friction.min() < 0.05 and 0.45 < known.friction.max() <= 0.5
    assert known.center.std() == pytest.approx(0.005, rel=0.15)


def broken(bench, position=np.nan):
    message = belief(bench)
    message.poses[3].position.x = position
    return message


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (lambda b: belief(b, count=0), "a belief of 0 poses"),
        (lambda b: belief(b, count=1), "a belief of 1 pose says"),
        (broken, "not finite"),
        (lambda b: belief(b, frame="map"), "frame 'map'"),
        (lambda b: belief(b, age=-2.0), "in the future"),
    ],
)
def test_a_bad_belief_is_refused_with_a_reason_and_harms_nothing(planner, message, reason):
    planner.advance(0.5, each=drive(planner))
    known = planner.node.task.belief.latest
    planner.send("object_belief", message(planner))
    planner.advance(0.02)
    assert reason in planner.node.complaints.recent(60.0)
    assert planner.node.complaints.counts["object_belief"] == 1 and planner.node.task.belief.latest is known
    goal(planner)
    planner.advance(0.5, each=drive(planner))
    assert planner.node.last.valid, planner.node.last.message


@pytest.mark.parametrize(
    ("sent", "reason"),
    [
        ({"place": np.array([0.8, 0.0, 0.0])}, "outside the workspace"),
        ({"std": 0.1}, "the object is lost"),
        ({"age": 0.45}, None),
        ({"age": 0.8}, "s old"),
    ],
)
def test_beliefs_that_nothing_can_be_done_with_stop_the_arms(planner, sent, reason):
    start_moving(planner)
    follow = drive(planner, known=False)

    def each(t):
        follow(t)
        planner.send("object_belief", belief(planner, **sent))

    planner.advance(1.0, each=each)
    if reason is None:
        assert planner.node.last.valid, planner.node.last.message
        return
    report = planner.node.report()
    assert report.level == 1 and reason in report.message
    assert speed(planner) < 1e-6
    planner.advance(0.5, each=drive(planner))
    assert planner.node.last.valid, planner.node.last.message


def test_arms_stop_while_the_estimator_is_dead_and_go_on_with_the_next_one(planner):
    start_moving(planner)
    planner.advance(1.2, each=drive(planner, known=False))
    assert speed(planner) < 1e-6 and "old" in planner.node.report().message
    planner.advance(0.6, each=drive(planner))
    assert planner.node.last.valid and speed(planner) > 0.0, planner.node.last.message


def plan(bench, shift=0.0, covariance=1e-4):
    mean = START + [0.05 + shift, 0.0, 0.05 + shift, 0.0]
    return contact_messages(
        RobustContactPlan(bench.time + 0.5 + shift, mean, covariance * np.eye(4), np.array([0.1, 0.0])),
        EFFECTORS, TOOLS, SIMULATED, FRAME,
    )  # fmt: skip


def test_contact_plans_are_used_when_they_are_whole_and_fresh(planner):
    used = []
    step = planner.node.planner.step
    planner.node.planner.step = lambda *a, **k: (used.append(a[5]), step(*a, **k))[1]
    planner.advance(0.1, each=drive(planner))
    left, right = plan(planner)
    planner.send("contact_plan", left)
    planner.advance(0.1, each=drive(planner))
    assert used[-1] is None, "half a plan is none"
    planner.send("contact_plan", right)
    planner.advance(0.1, each=drive(planner))
    planned = used[-1]
    assert np.allclose(planned.mean, START + [0.05, 0.0, 0.05, 0.0])
    assert np.allclose(planned.covariance, 1e-4 * np.eye(4))
    np.testing.assert_allclose(planned.place, PLACE[:2], atol=0.002)
    planner.send("contact_plan", plan(planner, shift=0.01)[0])
    planner.advance(0.1, each=drive(planner))
    assert used[-1] is None, "halves of two plans are none either"
    planner.send("contact_plan", plan(planner)[0])
    planner.advance(0.7, each=drive(planner))
    assert used[-1] is None


def unknown_tool(bench):
    message = plan(bench)[0]
    message.child_frame_id = "fr3_tool"
    return message


def not_a_number(bench):
    message = plan(bench)[0]
    message.pose.pose.position.y = np.nan
    return message


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (unknown_tool, "no end effector 'fr3_tool' (child_frame_id); this robot has 'left_fr3_tool'"),
        (not_a_number, "not finite"),
        (lambda b: plan(b, covariance=0.0)[0], "not positive definite"),
        (lambda b: plan(b, shift=60.0)[0], "in the future"),
    ],
)
def test_a_bad_contact_plan_is_refused_with_a_reason(planner, message, reason):
    planner.send("contact_plan", message(planner))
    planner.advance(0.05)
    assert reason in planner.node.complaints.recent(60.0)
    assert planner.node.task.contact.fresh(planner.time, 10.0) is None


def test_joint_states_of_one_arm_do_not_move_two(planner):
    planner.advance(0.3, each=lambda _: planner.send(
        "joint_states", joints(planner, np.zeros(7), names=JOINT_NAMES)))  # fmt: skip
    report = planner.node.report()
    assert report.level == 3 and "no joint 'left_fr3_joint1'" in report.message
    assert not planner.received["joint_trajectory"]


def test_a_goal_beyond_the_workspace_of_both_arms_is_refused(planner):
    goal(planner, 0.5, 0.0)
    planner.advance(0.05)
    known = planner.node.task.goal.target
    goal(planner, 0.5, 0.4)
    planner.advance(0.05)
    assert "y from -0.25 to 0.25 m; the previous goal stays" in planner.node.complaints.recent(60.0)
    goal(planner, 0.5, 0.0)
    planner.advance(0.05)
    assert planner.node.task.goal.target is known, "a repeated goal is not a new one"
    goal(planner, 0.55, 0.0)
    planner.advance(0.05)
    assert planner.node.task.goal.target is not known


def test_stop_brakes_both_arms_and_resume_goes_on(planner):
    start_moving(planner)
    client = planner.helper.create_client(SetBool, "mpc_planner/stop")
    answer = client.call_async(SetBool.Request(data=True))
    planner.advance(0.8, each=drive(planner))
    assert answer.result().success and planner.node.paused and speed(planner) < 1e-6
    before = len(planner.received["joint_trajectory"])
    planner.advance(0.2, each=drive(planner))
    assert len(planner.received["joint_trajectory"]) == before
    client.call_async(SetBool.Request(data=False))
    planner.advance(0.4, each=drive(planner))
    assert len(planner.received["joint_trajectory"]) > before


def test_a_restarted_planner_takes_over_arms_that_stand(bench, planner):
    start_moving(planner)
    planner.node.trigger_deactivate()
    planner.node.trigger_cleanup()
    planner.node.start()
    planner.node.deadline = 60.0
    planner.received["joint_trajectory"].clear()
    planner.advance(1.5, each=drive(planner))  # the last plan ends at rest
    goal(planner)
    planner.advance(1.0, each=drive(planner))
    assert planner.node.last.valid and speed(planner) > 0.0, planner.node.last.message


# Settings that do not fit together


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: MpcPlannerConfig(robot=BALLS), ("robot.kind = 'two_balls'", "robust_pushing")),
        (lambda: ContactPlannerNodeConfig(robot=HAND), ("robot.kind = 'hand'", "robust_pushing")),
        (
            lambda: MpcPlannerConfig(kind="robust_pushing", robot=BALLS, goal_orientation="use"),
            ("goal_orientation = 'use'", "kind = 'pushing'"),
        ),
        (
            lambda: MpcPlannerConfig(kind="robust_pushing", robot=BALLS, deadline=0.047, reserve=0.0),
            ("deadline = 0.047", "robust.lead = 0.05"),
        ),
        (lambda: MpcPlannerConfig(kind="robust_pushing"), ("robot.kind = 'rod'", "'two_balls'", "'pushing'")),
        (lambda: RobotConfig("three_balls"), ("'three_balls'", "'rod', 'hand', 'two_balls'")),
        (lambda: RobotConfig("two_balls", 1.0).plane(), ("robot.tool_height = 1", "two_balls")),
        (lambda: BeliefModelConfig(friction=(0.5, 0.1)), ("friction = [0.5, 0.1]",)),
        (lambda: StateEstimatorConfig(touch=True), ("touch = True", "kind = 'particles'")),
        (lambda: StateEstimatorConfig(kind="particles", belief_samples=1), ("belief_samples = 1",)),
        (lambda: StateEstimatorConfig(kind="unscented"), ("kind", "'kalman', 'particles'")),
    ],
)
def test_settings_that_do_not_fit_are_refused_by_name(make, words):
    with pytest.raises(ConfigurationError) as caught:
        make()
    assert all(word in str(caught.value) for word in words), caught.value


def test_an_object_too_small_for_two_tools_is_refused_by_name(bench):
    small = ModelConfig(object=ShapeConfig("disc", (0.04, 0.04)))
    with pytest.raises(ConfigurationError, match=r"model.object.size = \[0.04, 0.04\] m is too small"):
        contact_rule(RobotConfig("two_balls"), small, RobustPushingConfig())
    contact_rule(RobotConfig("rod"), small, RobustPushingConfig())
    with pytest.raises(ConfigurationError, match="too small"):
        bench(ContactPlannerNode, "contact_planner", **{**ROBUST, "model__object__size": [0.04, 0.04]})


def test_the_hand_brings_an_object_nearer_to_its_goal(bench):
    """The can moves as the nominal model says; with one flat side variance must be allowed to grow."""
    options = {"kind": "robust_pushing", "robot.kind": "hand", "robust.planning.largest_gain": 10.0}
    made = bench(MpcPlannerNode, "mpc_planner", **options, **CAN)
    made.node.deadline = 60.0
    for message, topic in KNOWN:
        made.talk(message, topic)
    made.listen(JointTrajectory, "joint_trajectory")
    made.connect()
    tools, known = HAND.plane(), made.node.task.planner.pusher
    point = np.array([0.36, 0.0, 0.5 * np.pi])
    q, made.running, can = tools.joints(point[None])[0], None, [PLACE, point]

    def each(t):
        if made.received["joint_trajectory"]:
            made.running = trajectory_from_message(made.received["joint_trajectory"][-1])
        position = q if made.running is None else made.running(t)
        velocity = None if made.running is None else made.running(t, 1)
        made.send("joint_states", joints(made, position, velocity, names=JOINT_NAMES))
        here = tools.tool(position)
        one = ObjectBelief(np.tile(can[0], (2, 1)))
        can[:] = known._quiet.simulate(one, np.stack([can[1], here]), known.rng).belief.mean, here
        made.send("object_belief", belief(made, place=can[0]))

    made.advance(0.5, each=each)
    goal(made, 0.56, 0.0)
    made.advance(4.0, each=each)
    assert np.hypot(*(can[0][:2] - [0.56, 0.0])) < np.hypot(*(PLACE[:2] - [0.56, 0.0])) - 0.03
