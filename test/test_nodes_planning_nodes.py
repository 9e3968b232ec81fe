"""State estimator, contact planner and MPC planner: what they publish, refuse and survive."""

import sys
import threading
import time

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from node_bench import Bench
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.nodes.contact_planner import ContactPlannerNode
from vpsto_ros.nodes.conversions import (
    SIMULATED,
    contact_message,
    goal_message,
    observation_message,
    read_contact,
    read_state,
    state_message,
)
from vpsto_ros.nodes.joint_conversions import joint_state_message, trajectory_from_message
from vpsto_ros.nodes.mpc_planner import MpcPlannerNode
from vpsto_ros.nodes.mpc_planner_config import TRANSPORT, MpcPlannerConfig
from vpsto_ros.nodes.scene import TableConfig
from vpsto_ros.nodes.sent_plans import JointSample, runs_on, stop_from
from vpsto_ros.nodes.state_estimator import StateEstimator
from vpsto_ros.planning.contact import ContactPlan
from vpsto_ros.planning.goal import PlanarGoal
from vpsto_ros.robot.inverse_kinematics import TableMap
from vpsto_ros.robot.kinematics import JOINT_NAMES, fr3_pusher

FRAME = "fr3_link0"
COVARIANCE = np.diag([4e-6, 4e-6, 3e-4])


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


# State estimator


@pytest.fixture
def estimator(bench):
    made = bench(StateEstimator, "state_estimator")
    made.talk(PoseWithCovarianceStamped, "object_pose")
    made.listen(Odometry, "object_state")
    made.listen(PoseArray, "object_belief")
    made.connect()
    return made


def see(bench, pose, age=0.04, frame=FRAME, covariance=COVARIANCE):
    bench.send(
        "object_pose", observation_message(np.asarray(pose, float), covariance, bench.stamp(-age), frame)
    )


def states(bench):
    return [read_state(message, SIMULATED, FRAME) for message in bench.received["object_state"]]


def test_the_estimate_follows_the_camera_and_carries_its_stamp(estimator):
    pose = np.array([0.5, 0.1, 0.3])
    estimator.advance(1.0, each=lambda t: see(estimator, pose) if round(t * 100) % 2 == 0 else None)
    got = states(estimator)
    assert 40 <= len(got) <= 60
    assert np.allclose(got[-1].pose, pose, atol=1e-3) and np.allclose(got[-1].twist, 0.0, atol=1e-2)
    assert got[-1].stamp == pytest.approx(estimator.time - 0.04, abs=0.021)
    belief = estimator.received["object_belief"][-1]
    assert len(belief.poses) == 50 and belief.header.frame_id == FRAME
    assert estimator.node.report().level == 0


def test_silence_is_bridged_for_a_while_and_then_reported(estimator):
    estimator.advance(0.3, each=lambda _: see(estimator, (0.5, 0.0, 0.0)))
    last_frame = estimator.time - 0.04
    estimator.advance(0.3)
    got = states(estimator)[-1]
    assert last_frame < got.stamp <= last_frame + 0.3
    while_seen = [state for state in states(estimator) if state.stamp <= last_frame + 1e-6]
    assert got.covariance[0, 0] > 1.5 * while_seen[-1].covariance[0, 0]
    estimator.advance(0.4)
    before = len(estimator.received["object_state"])
    estimator.advance(0.3)
    assert len(estimator.received["object_state"]) == before
    report = estimator.node.report()
    assert report.level == 3 and "silent" in report.message
    estimator.advance(0.2, each=lambda _: see(estimator, (0.5, 0.0, 0.0)))
    assert len(estimator.received["object_state"]) > before and estimator.node.report().level != 3


def zero_quaternion(bench):
    message = observation_message(np.array([0.5, 0.0, 0.0]), COVARIANCE, bench.stamp(), FRAME)
    message.pose.pose.orientation.w = 0.0
    bench.send("object_pose", message)


def raised(bench, height=0.0, tilt=0.0):
    message = observation_message(np.array([0.5, 0.0, 0.0]), COVARIANCE, bench.stamp(), FRAME)
    message.pose.pose.position.z = height
    message.pose.pose.orientation.x, message.pose.pose.orientation.w = np.sin(tilt / 2), np.cos(tilt / 2)
    bench.send("object_pose", message)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (lambda b: see(b, (np.nan, 0.0, 0.0)), "not finite"),
        (lambda b: see(b, (0.5, 0.0, 0.0), frame="map"), "frame 'map'"),
        (lambda b: see(b, (3.0, 0.0, 0.0)), "off the table"),
        (lambda b: see(b, (0.5, 0.0, 0.0), age=-5.0), "in the future"),
        (lambda b: see(b, (0.5, 0.0, 0.0), age=5.0), "s old"),
        (lambda b: see(b, (0.5, 0.0, 0.0), covariance=-COVARIANCE), "not positive definite"),
        (zero_quaternion, "quaternion is zero"),
        (lambda b: raised(b, height=0.5), "above the table"),
        (lambda b: raised(b, tilt=0.8), "tilted"),
    ],
)
def test_bad_frames_are_refused_with_a_reason_and_harm_nothing(estimator, bad, reason):
    estimator.advance(0.2, each=lambda _: see(estimator, (0.5, 0.0, 0.0)))
    for _ in range(5):
        bad(estimator)
        estimator.advance(0.02)
    assert reason in estimator.node.complaints.recent()
    report = estimator.node.report()
    assert report.level == 1 and reason in report.message and report.values["rejected.object_pose"] == "5"
    estimator.advance(0.2, each=lambda _: see(estimator, (0.5, 0.0, 0.0)))
    assert np.allclose(states(estimator)[-1].pose, (0.5, 0.0, 0.0), atol=2e-3)


def test_a_teleported_object_is_followed_after_a_few_frames(estimator):
    estimator.advance(0.3, each=lambda _: see(estimator, (0.5, 0.0, 0.0)))
    see(estimator, (0.6, 0.2, 1.0))
    estimator.advance(0.02)
    assert np.allclose(states(estimator)[-1].pose, (0.5, 0.0, 0.0), atol=5e-3)
    estimator.advance(0.1, each=lambda _: see(estimator, (0.6, 0.2, 1.0)))
    assert np.allclose(states(estimator)[-1].pose, (0.6, 0.2, 1.0), atol=5e-3)


def test_a_restarted_simulation_starts_the_filter_afresh(estimator):
    estimator.advance(0.5, each=lambda _: see(estimator, (0.5, 0.0, 0.0)))
    estimator.time = 0.0
    estimator.advance(0.3, each=lambda t: see(estimator, (0.4, 0.1, 0.0)) if t > 0.05 else None)
    assert estimator.node.complaints.counts["clock_reset"] == 1
    assert np.allclose(states(estimator)[-1].pose, (0.4, 0.1, 0.0), atol=2e-3)


# Contact planner


def joint_message(bench, q, velocity=None, names=JOINT_NAMES):
    velocity = np.zeros(len(q)) if velocity is None else velocity
    return joint_state_message(names, q, velocity, np.zeros(len(q)), bench.stamp(), FRAME)


def object_message(bench, pose=(0.5, 0.0, 0.0), age=0.04):
    state = ObjectState(bench.time - age, np.array(pose), np.zeros(3), np.diag([1e-6] * 6))
    return state_message(state, SIMULATED, FRAME)


def not_a_number(message):
    message.pose.pose.position.x = np.nan
    return message


def standing(point=(0.38, -0.2)):
    return TableMap(fr3_pusher(), 0.02).joints([point])[0]


def test_the_contact_planner_touches_behind_the_object(bench):
    made = bench(ContactPlannerNode, "contact_planner")
    for kind, topic in ((JointState, "joint_states"), (Odometry, "object_state"), (PoseStamped, "goal_pose")):
        made.talk(kind, topic)
    made.listen(Odometry, "contact_plan")
    made.connect()
    q = standing()

    def inputs(_):
        made.send("joint_states", joint_message(made, q))
        made.send("object_state", object_message(made))

    made.advance(0.2, each=inputs)
    assert not made.received["contact_plan"] and "goal_pose" in made.node.report().message
    made.send("goal_pose", goal_message(PlanarGoal(np.array([0.6, 0.0])), made.stamp(), FRAME))
    made.advance(0.5, each=inputs)
    plans = [read_contact(message, SIMULATED, FRAME) for message in made.received["contact_plan"]]
    assert 8 <= len(plans) <= 12
    assert plans[-1].position[0] < 0.45 and plans[-1].velocity[0] > 0.1
    assert plans[-1].stamp > made.time - 0.1
    assert made.received["contact_plan"][-1].child_frame_id == "fr3_tool"
    made.advance(1.0)
    assert "no joint_states" in made.node.report().message
    info = made.helper.get_publishers_info_by_topic("contact_plan")[0].qos_profile
    assert (info.reliability, info.durability) == (
        ReliabilityPolicy.RELIABLE,
        DurabilityPolicy.TRANSIENT_LOCAL,
    )


# MPC planner


@pytest.fixture
def planner(bench):
    made = bench(MpcPlannerNode, "mpc_planner")
    made.node.deadline = 60.0  # simulated time stands while it plans; a busy host must not change the plans
    for kind, topic in (
        (JointState, "joint_states"),
        (JointState, "desired_joint_states"),
        (Odometry, "object_state"),
        (Odometry, "contact_plan"),
        (PoseStamped, "goal_pose"),
    ):
        made.talk(kind, topic)
    made.listen(JointTrajectory, "joint_trajectory")
    made.connect()
    made.q, made.running = standing(), None
    return made


def drive(bench, *, joints=True, seen=True, desired=False):
    """An arm that follows the last trajectory exactly."""

    def each(t):
        if bench.received["joint_trajectory"]:
            bench.running = trajectory_from_message(bench.received["joint_trajectory"][-1])
        q, qd = bench.q, np.zeros(7)
        if bench.running is not None:
            q, qd, _ = bench.running.state(t)
        if joints:
            bench.send("joint_states", joint_message(bench, q, velocity=qd))
        if desired:
            bench.send("desired_joint_states", joint_message(bench, q, velocity=qd))
        if seen:
            bench.send("object_state", object_message(bench))

    return each


def give_goal(bench, x=0.56, y=0.05):
    bench.send("goal_pose", goal_message(PlanarGoal(np.array([x, y])), bench.stamp(), FRAME))


def test_plans_are_published_and_a_controller_could_follow_them(planner):
    planner.advance(0.4, each=drive(planner))
    give_goal(planner)
    planner.advance(1.5, each=drive(planner))
    assert planner.node.last.valid, planner.node.last.message
    messages = planner.received["joint_trajectory"]
    assert len(messages) >= 15
    limits = fr3_pusher().limits
    previous = None
    for message in messages:
        trajectory = trajectory_from_message(message)
        assert list(message.joint_names) == list(JOINT_NAMES) and message.header.frame_id == FRAME
        assert trajectory.violations(limits, relative_tolerance=1e-4) == []
        assert np.abs(message.points[-1].velocities).max() < 1e-7
        if previous is not None and trajectory.start_time < previous.end_time:
            at = max(trajectory.start_time, previous.start_time)
            assert np.abs(trajectory(at) - previous(at)).max() < 1e-3
        previous = trajectory
    values = planner.node.report().values
    assert values["deadline_misses"] == 0 and float(values["compute_p99_ms"]) > 0.0
    moved = trajectory_from_message(messages[-1])
    assert np.abs(moved(moved.end_time) - planner.q).max() > 0.05


def test_missing_inputs_are_named(planner):
    planner.advance(0.2)
    assert "no joint_states" in planner.node.report().message and not planner.received["joint_trajectory"]
    planner.advance(0.4, each=drive(planner, seen=False))
    assert "no goal" in planner.node.report().message
    give_goal(planner)
    planner.advance(0.3, each=drive(planner, seen=False))
    assert "no object state" in planner.node.report().message
    for message in planner.received["joint_trajectory"]:
        trajectory = trajectory_from_message(message)
        assert np.allclose(trajectory(trajectory.end_time), planner.q, atol=1e-6)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (
            lambda b: ("goal_pose", goal_message(PlanarGoal(np.array([2.0, 0.0])), b.stamp(), FRAME)),
            "out of reach",
        ),
        (
            lambda b: ("goal_pose", goal_message(PlanarGoal(np.array([0.5, 0.0])), b.stamp(), "map")),
            "frame 'map'",
        ),
        (lambda b: ("goal_pose", PoseStamped(header=object_message(b).header)), ""),
        (
            lambda b: (
                "joint_states",
                joint_message(b, np.zeros(7), names=[f"panda_joint{i}" for i in range(7)]),
            ),
            "fr3_joint1",
        ),
        (lambda b: ("joint_states", joint_message(b, np.full(7, np.nan))), "not finite"),
        (lambda b: ("object_state", not_a_number(object_message(b))), "not finite"),
        (lambda b: ("contact_plan", Odometry(header=object_message(b).header)), "positive definite"),
    ],
)
def test_bad_messages_are_refused_and_planning_goes_on(planner, message, reason):
    planner.advance(0.4, each=drive(planner))
    give_goal(planner)
    planner.advance(0.1, each=drive(planner))
    goal = planner.node.task.goal.latest
    topic, content = message(planner)
    if topic == "goal_pose" and not reason:
        content.pose.orientation.w, reason = 0.0, "quaternion is zero"
    planner.send(topic, content)
    planner.advance(0.1, each=drive(planner))
    assert planner.node.complaints.counts[topic] == 1 and reason in planner.node.complaints.recent(60.0)
    before = len(planner.received["joint_trajectory"])
    planner.advance(0.3, each=drive(planner))
    assert len(planner.received["joint_trajectory"]) > before and planner.node.task.goal.latest is goal


def test_the_arm_stops_when_the_camera_is_silent_and_goes_on_when_it_returns(planner):
    planner.advance(0.4, each=drive(planner))
    give_goal(planner)
    planner.advance(0.8, each=drive(planner))
    assert planner.node.last.valid, planner.node.last.message
    planner.advance(1.2, each=drive(planner, seen=False))
    report = planner.node.report()
    assert "old" in report.message and report.level == 1
    assert np.abs(planner.running.state(planner.time)[1]).max() < 1e-6
    planner.advance(0.5, each=drive(planner))
    assert planner.node.last.valid, planner.node.last.message


def test_nothing_is_published_while_joint_states_are_silent(planner):
    planner.advance(0.4, each=drive(planner))
    give_goal(planner)
    planner.advance(0.3, each=drive(planner))
    planner.advance(0.3, each=drive(planner, joints=False))
    before = len(planner.received["joint_trajectory"])
    planner.advance(0.3, each=drive(planner, joints=False))
    assert len(planner.received["joint_trajectory"]) == before
    assert "no joint_states within" in planner.node.report().message
    planner.advance(0.3, each=drive(planner))
    assert len(planner.received["joint_trajectory"]) > before, planner.node.last.message


def test_a_plan_that_the_controller_refused_is_not_planned_on(planner):
    planner.advance(0.4, each=drive(planner, desired=True))
    give_goal(planner)
    planner.advance(0.8, each=drive(planner, desired=True))
    running = planner.running
    follow = drive(planner)

    def deaf(t):
        """A controller that takes no message any more but goes on with what it has."""
        planner.received["joint_trajectory"].clear()
        planner.running = running
        follow(t)
        q, qd, _ = running.state(t)
        planner.send("desired_joint_states", joint_message(planner, q, velocity=qd))

    planner.advance(0.3, each=deaf)
    assert planner.node.complaints.counts["plan_refused"] >= 1
    planner.advance(
        0.05, each=lambda t: planner.send("joint_states", joint_message(planner, *running.state(t)[:2]))
    )
    last = trajectory_from_message(planner.received["joint_trajectory"][-1])
    at = max(last.start_time, planner.time - 0.05)
    assert np.abs(last(at) - running(at)).max() < 2e-3


def test_stop_brakes_and_resume_goes_on(planner):
    client = planner.helper.create_client(SetBool, "mpc_planner/stop")
    planner.advance(0.4, each=drive(planner))
    give_goal(planner)
    planner.advance(0.8, each=drive(planner))
    answer = client.call_async(SetBool.Request(data=True))
    planner.advance(0.8, each=drive(planner))
    assert answer.result().success and planner.node.paused
    assert np.abs(planner.running.state(planner.time)[1]).max() < 1e-6
    before = len(planner.received["joint_trajectory"])
    planner.advance(0.2, each=drive(planner))
    assert len(planner.received["joint_trajectory"]) == before and "~/stop" in planner.node.report().message
    client.call_async(SetBool.Request(data=False))
    planner.advance(0.4, each=drive(planner))
    assert len(planner.received["joint_trajectory"]) > before


def test_late_plans_are_dropped_and_counted(bench):
    made = bench(MpcPlannerNode, "mpc_planner", deadline=0.002, reserve=0.0)
    for kind, topic in ((JointState, "joint_states"), (Odometry, "object_state"), (PoseStamped, "goal_pose")):
        made.talk(kind, topic)
    made.listen(JointTrajectory, "joint_trajectory")
    made.connect()
    made.q, made.running = standing(), None
    step = made.node.planner.step

    def slow(*arguments, **options):
        time.sleep(0.004)
        return step(*arguments, **options)

    made.node.planner.step = slow
    give_goal(made)
    made.advance(0.5, each=drive(made))
    assert made.node.deadline_misses >= 5 and not made.received["joint_trajectory"]
    assert "too late" in made.node.complaints.recent()


def test_a_restarted_driver_is_taken_over_again(planner):
    planner.advance(0.4, each=drive(planner))
    give_goal(planner)
    planner.advance(0.6, each=drive(planner))
    planner.time, planner.running = 0.0, None
    planner.received["joint_trajectory"].clear()
    planner.advance(1.2, each=drive(planner))
    assert planner.node.complaints.counts["clock_reset"] == 1
    assert planner.received["joint_trajectory"] and planner.node.last.valid, planner.node.last.message


def test_a_stale_contact_plan_is_not_used(planner):
    plan = ContactPlan(0.3, np.array([0.42, 0.0]), np.array([0.3, 0.0]), 1e-4 * np.eye(2))
    used = []
    step = planner.node.planner.step
    planner.node.planner.step = lambda *a, **k: (used.append(a[5]), step(*a, **k))[1]
    planner.send("contact_plan", contact_message(plan, SIMULATED, FRAME, "fr3_tool"))
    planner.advance(0.3, each=drive(planner))
    assert used[-1] is not None
    planner.advance(0.6, each=drive(planner))
    assert used[-1] is None


# What a dead sender, a lost message or a bug must not do


def test_a_message_from_the_future_is_refused(planner):
    ahead = [
        ("joint_states", lambda: joint_message(planner, planner.q)),
        ("object_state", lambda: object_message(planner, age=0.0)),
    ]
    for topic, make in ahead:
        message = make()
        message.header.stamp = planner.stamp(2.0)
        planner.send(topic, message)
    plan = ContactPlan(planner.time + 60.0, np.array([0.42, 0.0]), np.array([0.3, 0.0]), 1e-4 * np.eye(2))
    planner.send("contact_plan", contact_message(plan, SIMULATED, FRAME, "fr3_tool"))
    planner.advance(0.05)
    for topic in ("joint_states", "object_state", "contact_plan"):
        assert planner.node.complaints.counts[topic] == 1, topic
    assert "in the future" in planner.node.complaints.recent(60.0)
    assert planner.node.arm.joints is None and planner.node.task.object is None
    assert planner.node.task.contact is None


def test_a_contact_planner_refuses_the_future_too(bench):
    made = bench(ContactPlannerNode, "contact_planner")
    made.talk(JointState, "joint_states")
    made.talk(Odometry, "object_state")
    made.connect()
    for topic, message in (
        ("joint_states", joint_message(made, standing())),
        ("object_state", object_message(made)),
    ):
        message.header.stamp = made.stamp(2.0)
        made.send(topic, message)
    made.advance(0.05)
    assert made.node.complaints.counts["joint_states"] == made.node.complaints.counts["object_state"] == 1
    assert made.node.joints is None and made.node.task.object is None


@pytest.mark.parametrize(
    ("node_class", "name"),
    [
        (StateEstimator, "state_estimator"),
        (ContactPlannerNode, "contact_planner"),
        (MpcPlannerNode, "mpc_planner"),
    ],
)
def test_a_clock_that_stands_still_shows_as_stale(bench, node_class, name):
    made = bench(node_class, name)
    made.connect()
    made.listen(DiagnosticArray, "/diagnostics")
    made.advance(0.3)
    assert "time stands still" not in made.node.report().message
    made.spin(2.4)  # wall time only: the driver died
    report = made.node.report()
    assert report.level == 3 and "time stands still" in report.message
    own = [s for m in made.received["/diagnostics"] for s in m.status if s.name == name]
    assert own and "time stands still" in own[-1].message, "diagnostics come by a steady clock"
    made.advance(0.3)
    assert "time stands still" not in made.node.report().message


def arm(bench, *, deaf):
    """A controller that takes a trajectory unless deaf() says that it is lost, and says what it follows."""
    seen = [0]

    def each(t):
        new = bench.received["joint_trajectory"][seen[0] :]
        seen[0] += len(new)
        for message in new:
            if not deaf():
                bench.running = trajectory_from_message(message)
        q, qd = bench.q, np.zeros(7)
        if bench.running is not None:
            q, qd, _ = bench.running.state(t)
        bench.send("joint_states", joint_message(bench, q, velocity=qd))
        if bench.says:
            bench.send("desired_joint_states", joint_message(bench, q, velocity=qd))
        bench.send("object_state", object_message(bench))

    return each


def speed(bench):
    return np.abs(bench.running.state(bench.time)[1]).max()


def start_moving(bench, follow):
    bench.advance(0.4, each=follow)
    give_goal(bench)
    for _ in range(100):
        bench.advance(0.05, each=follow)
        if bench.running is not None and speed(bench) > 0.3 and bench.running.end_time > bench.time + 0.5:
            return
    raise AssertionError(f"the arm does not move: {bench.node.last.message}")


@pytest.mark.parametrize("says", [True, False])
def test_a_lost_stop_is_sent_again_until_the_arm_rests(planner, says):
    lost = {"left": 0}
    planner.says = says

    def deaf():
        lost["left"] -= 1
        return lost["left"] >= 0

    follow = arm(planner, deaf=deaf)
    start_moving(planner, follow)
    lost["left"] = 2
    client = planner.helper.create_client(SetBool, "mpc_planner/stop")
    answer = client.call_async(SetBool.Request(data=True))
    end_of_plan = planner.running.end_time
    planner.advance(0.5 if says else 0.9, each=follow)
    assert answer.result().success and planner.node.paused
    assert planner.node.complaints.counts["stop_lost"] >= 1
    assert speed(planner) < 1e-6
    if says:
        assert planner.time < end_of_plan, "it stopped before the lost plan would have ended anyway"
    before = len(planner.received["joint_trajectory"])
    planner.advance(0.3, each=follow)
    assert len(planner.received["joint_trajectory"]) == before


def test_a_bug_in_the_planner_stops_the_arm_and_shows_as_an_error(planner):
    planner.says = True
    follow = arm(planner, deaf=lambda: False)
    start_moving(planner, follow)
    step = planner.node.planner.step

    def broken(*_, **__):
        raise IndexError("index 7 is out of bounds")

    planner.node.planner.step = broken
    planner.advance(0.5, each=follow)
    assert speed(planner) < 1e-6
    report = planner.node.report()
    assert report.level == 2 and "IndexError" in report.message and report.values["internal_errors"] >= 5
    planner.node.planner.step = step
    planner.advance(0.8, each=follow)
    assert planner.node.last.valid, planner.node.last.message


def test_skipped_cycles_are_counted_as_missed(planner):
    planner.advance(0.4, each=drive(planner))
    assert planner.node.report().values["cycles"] == 0, "without a goal nothing was tried"
    give_goal(planner)
    planner.advance(0.5, each=drive(planner))
    values = planner.node.report().values
    assert 8 <= values["cycles"] <= 11 and values["skipped_cycles"] == values["deadline_misses"] == 0
    planner.advance(0.36, each=drive(planner), step=0.09)
    values = planner.node.report().values
    assert values["skipped_cycles"] == values["deadline_misses"] >= 3


def test_a_teleport_shows_in_the_diagnostics(estimator):
    estimator.advance(0.3, each=lambda _: see(estimator, (0.5, 0.0, 0.0)))
    assert estimator.node.report().values["reinitialized"] == 0
    estimator.advance(0.2, each=lambda _: see(estimator, (0.6, 0.2, 1.0)))
    assert estimator.node.report().values["reinitialized"] == 1


# Settings that do not fit together


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"deadline": 0.047}, ("deadline = 0.047", "planner.lead = 0.05")),
        ({"deadline": 0.035, "rate": 50.0}, ("deadline = 0.035", "rate = 50")),
        ({"deadline": 0.02, "reserve": 0.02}, ("deadline = 0.02", "reserve = 0.02")),
    ],
)
def test_settings_that_can_never_work_are_refused(changes, names):
    with pytest.raises(ConfigurationError) as caught:
        MpcPlannerConfig(**changes)
    assert all(name in str(caught.value) for name in names), caught.value


@pytest.mark.parametrize("rate", [1.0, 10.0, 20.0, 50.0])
def test_the_automatic_deadline_fits_every_rate(rate):
    config = MpcPlannerConfig(rate=rate)
    assert config.reserve < config.deadline_in_force <= min(1.0 / rate, config.planner.lead - TRANSPORT)
    assert config.deadline_in_force >= 0.016


@pytest.mark.parametrize("name", ["x", "y"])
def test_a_reversed_range_of_the_table_is_refused(name):
    with pytest.raises(ConfigurationError, match=rf"{name} = \[0.5, -0.5\]"):
        TableConfig(**{name: (0.5, -0.5)})


def test_a_missing_package_is_named(bench, monkeypatch):
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(ConfigurationError, match=r"pycma.*'cma'"):
        bench(MpcPlannerNode, "mpc_planner", planner__online__search__strategy="pycma")


def test_a_stop_is_stopped_from_what_is_known():
    q = standing()
    sample = JointSample(1.0, q, np.full(7, 0.5))
    stop = stop_from(sample, fr3_pusher().limits, 1.05)
    assert not runs_on(stop, JointSample(1.05, *stop.state(1.05)[:2]), None)
    assert runs_on(stop, JointSample(1.2, q + 0.1, np.full(7, 0.5)), None)
    assert runs_on(stop, JointSample(1.2, q + 0.1, np.full(7, 0.5)), 0.03)
    assert not runs_on(stop, JointSample(1.2, q + 0.1, np.zeros(7)), None)
    assert stop.violations(fr3_pusher().limits) == []
    assert np.allclose(stop(stop.end_time, 1), 0.0)


def test_a_deactivated_planner_sees_to_it_that_the_arm_stops(planner):
    planner.says = True
    start_moving(planner, arm(planner, deaf=lambda: False))
    other = rclpy.create_node("controller")
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(other)
    inbox, ended = [], threading.Event()
    other.create_subscription(JointTrajectory, "joint_trajectory", inbox.append, 10)
    desired = other.create_publisher(JointState, "desired_joint_states", 10)
    while not (desired.get_subscription_count() and other.count_publishers("joint_trajectory")):
        time.sleep(0.01)

    def controller():
        """Runs on while the planner's process is busy with its transition, and loses the first message."""
        while not ended.is_set():
            planner.time += 0.01
            executor.spin_once(timeout_sec=0.01)
            if len(inbox) > 1:
                planner.running = trajectory_from_message(inbox[-1])
            q, qd, _ = planner.running.state(planner.time)
            desired.publish(joint_message(planner, q, velocity=qd))

    thread = threading.Thread(target=controller)
    thread.start()
    try:
        planner.node.trigger_deactivate()
    finally:
        ended.set()
        thread.join()
        executor.shutdown()
        other.destroy_node()
    assert not planner.node.active and len(inbox) >= 2
    assert speed(planner) < 2e-3 and not planner.node.complaints.counts["stop"]
