"""The state estimator with the filter of a puck: what it makes of camera and joints, and what it refuses."""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy")

import rclpy
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from node_bench import Bench
from sensor_msgs.msg import JointState

from vpsto_ros.contact.puck import SHIPPED, PuckModel
from vpsto_ros.estimation.puck_filter import PuckFilterConfig, PuckState
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.nodes.conversions import SIMULATED, observation_message, read_belief, read_state
from vpsto_ros.nodes.joint_conversions import joint_state_message
from vpsto_ros.nodes.mpc_planner_config import MpcPlannerConfig
from vpsto_ros.nodes.puck_estimator import puck_model
from vpsto_ros.nodes.state_estimator import StateEstimator
from vpsto_ros.nodes.state_estimator_config import StateEstimatorConfig
from vpsto_ros.nodes.table_frame import UNKNOWN_YAW, HockeyTableConfig
from vpsto_ros.robot.iiwa import JOINT_NAMES, iiwa14

ROOT = Path(__file__).resolve().parents[1]
FRAME = "iiwa_link_0"
HOME = np.array([0.0, -0.196, 0.0, -1.844, 0.0, 0.970, 0.0])
NOISE = 5e-7 * np.eye(3) + np.diag([0.0, 0.0, 4e-4])
TABLE = {"table__x": [0.4, 2.7], "table__y": [-0.6, 0.6], "table__height": 0.15}
DRAG = 0.5


@pytest.fixture(scope="module", autouse=True)
def ros():
    rclpy.init()
    yield
    rclpy.try_shutdown()


@pytest.fixture
def estimator():
    made = Bench(StateEstimator, "state_estimator", kind="puck", base_frame=FRAME, **TABLE)
    made.talk(PoseWithCovarianceStamped, "object_pose")
    made.talk(JointState, "joint_states")
    made.listen(Odometry, "object_state")
    made.listen(PoseArray, "object_belief")
    made.connect()
    yield made
    made.close()


def see(bench, place, age=0.01, frame=FRAME, height=0.1, noise=NOISE):
    pose = np.append(place, 0.3)
    bench.send("object_pose", observation_message(pose, noise, bench.stamp(-age), frame, height))


def measure(bench, q=HOME, qd=None, names=JOINT_NAMES):
    qd = np.zeros(7) if qd is None else qd
    bench.send("joint_states", joint_state_message(names, q, qd, np.zeros(7), bench.stamp(), FRAME))


def states(bench):
    return [read_state(message, SIMULATED, FRAME) for message in bench.received["object_state"]]


def sliding(start, velocity, time):
    """Where a puck is that its drag slows down, (2,) [m]."""
    return np.asarray(start) + np.asarray(velocity) * (1.0 - math.exp(-DRAG * time)) / DRAG


def test_a_sliding_puck_is_predicted_to_the_present_at_its_rate(estimator):
    start, velocity, rng = np.array([0.9, -0.2]), np.array([0.4, 0.15]), np.random.default_rng(1)

    def each(t):
        measure(estimator)
        see(estimator, sliding(start, velocity, t - 0.01) + 7e-4 * rng.standard_normal(2))

    estimator.advance(1.0, each=each)
    got = states(estimator)
    assert 45 <= len(got) <= 52, "not with every frame, but at 50 Hz"
    last = got[-1]
    assert last.stamp == pytest.approx(estimator.time, abs=0.021)
    np.testing.assert_allclose(last.pose[:2], sliding(start, velocity, last.stamp), atol=2e-3)
    np.testing.assert_allclose(last.twist[:2], velocity * math.exp(-DRAG * last.stamp), atol=0.03)
    assert 0.0 < last.covariance[0, 0] < 1e-5 and 0.0 < last.covariance[3, 3] < 1e-3
    assert last.covariance[2, 2] == pytest.approx(UNKNOWN_YAW)
    assert estimator.received["object_state"][-1].pose.pose.position.z == pytest.approx(0.1)
    samples = read_belief(estimator.received["object_belief"][-1], FRAME)
    np.testing.assert_allclose(samples[:, :2].mean(axis=0), last.pose[:2], atol=0.02)
    report = estimator.node.report()
    assert report.level == 0 and report.values["filter"] == "tracking"
    assert report.values["contacts"] == 0


def spread_without_a_covariance(std):
    """Standard deviation [m] after a second frame that gives no covariance."""
    bench = Bench(StateEstimator, "state_estimator", kind="puck", base_frame=FRAME,
                  puck__position_std=std, **TABLE)  # fmt: skip
    bench.talk(PoseWithCovarianceStamped, "object_pose")
    bench.listen(Odometry, "object_state")
    bench.connect()
    bench.advance(0.02, each=lambda _: see(bench, (1.0, 0.0), age=0.0, noise=np.zeros((3, 3))))
    bench.advance(0.1)
    known = bench.node.estimator._filter.state(bench.node.estimator.frame_stamp)
    bench.close()
    return math.sqrt(known.covariance[0, 0])


@pytest.mark.parametrize("std", [0.0007, 0.02])
def test_frames_without_a_covariance_are_as_good_as_the_filters_options_say(std):
    assert 0.5 * std < spread_without_a_covariance(std) < 1.01 * std


def test_options_that_would_change_nothing_are_refused():
    with pytest.raises(ConfigurationError, match=r"puck\.velocity_std"):
        StateEstimatorConfig(kind="puck", puck=PuckFilterConfig(velocity_std=0.1))
    with pytest.raises(ConfigurationError, match=r"puck\.position_std"):
        StateEstimatorConfig(kind="puck", position_std=0.001)


def test_estimator_and_planner_know_one_mallet():
    parameters = yaml.safe_load((ROOT / "config" / "air_hockey.yaml").read_text())
    estimator = parameters["state_estimator"]["ros__parameters"].get("mallet", {})
    planner = parameters["mpc_planner"]["ros__parameters"].get("strike", {}).get("tilt", {})
    assert estimator == planner
    assert StateEstimatorConfig().mallet == MpcPlannerConfig().strike.tilt


def test_the_mallet_swings_as_the_parameters_say():
    places = []
    for damping in (0.31, 0.0):
        bench = Bench(StateEstimator, "state_estimator", kind="puck", base_frame=FRAME,
                      mallet__damping=damping)  # fmt: skip
        bench.node.estimator.move(0.0, HOME, np.zeros(7))
        qd = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.3, 0.0])
        for k in range(1, 6):
            bench.node.estimator.move(0.01 * k, HOME + 0.01 * k * qd, qd)
        places.append(bench.node.estimator._mallet.observe(0.05, HOME + 0.05 * qd, qd))
        bench.close()
    assert np.abs(places[0][:2] - places[1][:2]).max() > 1e-4


def test_a_bounce_is_foreseen_while_the_camera_is_silent(estimator):
    start, velocity = np.array([1.2, 0.35]), np.array([0.3, 0.9])

    def each(t):
        measure(estimator)
        if t < 0.12:
            see(estimator, sliding(start, velocity, t - 0.01))

    estimator.advance(0.3, each=each)
    last = states(estimator)[-1]
    assert last.twist[1] < -0.4 < 0.2 < last.twist[0]
    assert last.pose[1] < 0.519 - 0.03165


def test_a_hit_is_foreseen_from_the_joints(estimator):
    robot, speed = iiwa14(), np.array([0.6, 0.0, 0.0])
    q, dt = HOME.copy(), 0.01
    puck = np.array([0.65 + 0.0798 + 0.12, 0.0])

    def each(t):
        nonlocal q
        qd = np.linalg.pinv(robot.jacobian(q)[:3]) @ speed
        measure(estimator, q, qd)
        q = q + dt * qd
        if t < 0.17:
            see(estimator, puck)

    estimator.advance(0.27, each=each)
    speeds = [state.twist[0] for state in states(estimator)]
    assert max(abs(value) for value in speeds[:6]) < 0.1 and speeds[-1] > 0.6
    report = estimator.node.report()
    assert report.level in (0, 1)


def test_silence_ends_the_state_and_is_named(estimator):
    estimator.advance(0.2, each=lambda t: see(estimator, (1.0, 0.0)))
    estimator.advance(0.6)
    before = len(estimator.received["object_state"])
    estimator.advance(0.2)
    assert len(estimator.received["object_state"]) == before
    report = estimator.node.report()
    assert report.level == 3 and "silent" in report.message


def test_a_missing_arm_is_a_warning_and_no_more(estimator):
    estimator.advance(0.3, each=lambda t: see(estimator, (1.0, 0.0)))
    report = estimator.node.report()
    assert "mallet is not known" in report.values["filter"] and len(states(estimator)) > 10


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (lambda b: see(b, (np.nan, 0.0)), "not finite"),
        (lambda b: see(b, (1.0, 0.0), frame="fr3_link0"), "frame 'fr3_link0'"),
        (lambda b: see(b, (3.5, 0.0)), "off the table"),
        (lambda b: see(b, (2.65, 0.4)), "outside the table"),
        (lambda b: see(b, (1.0, 0.0), height=0.4), "above the table"),
        (lambda b: see(b, (1.4, 0.3), age=0.005), "Mahalanobis"),
        (lambda b: measure(b, names=tuple(f"fr3_joint{i}" for i in range(1, 8))), "iiwa_joint_1"),
        (lambda b: measure(b, qd=np.full(7, np.nan)), "joint_states"),
    ],
)
def test_bad_input_is_refused_with_a_reason_and_harms_nothing(estimator, bad, reason):
    def each(_t):
        measure(estimator)
        see(estimator, (1.0, 0.0))

    estimator.advance(0.2, each=each)
    bad(estimator)
    estimator.advance(0.02)
    assert reason in estimator.node.complaints.recent()
    estimator.advance(0.1, each=each)
    np.testing.assert_allclose(states(estimator)[-1].pose[:2], [1.0, 0.0], atol=3e-3)


def test_states_travel_between_table_and_base():
    table, rng = HockeyTableConfig(), np.random.default_rng(3)
    a = rng.standard_normal((4, 4))
    puck = PuckState(2.0, np.array([-0.3, 0.1, 0.5, -0.2]), a @ a.T, 1, "")
    state = table.object_state(puck)
    np.testing.assert_allclose(state.pose[:2], [1.21, 0.1])
    back = table.puck_state(state)
    np.testing.assert_allclose(back.mean, puck.mean)
    np.testing.assert_allclose(back.covariance, puck.covariance)
    assert np.linalg.eigvalsh(state.covariance).min() > 0.0


def test_the_shipped_model_is_the_default_and_others_are_read(tmp_path):
    np.testing.assert_array_equal(puck_model("").kernel_rows, PuckModel.load(SHIPPED).kernel_rows)
    PuckModel.load(SHIPPED).save(tmp_path / "other.json")
    np.testing.assert_array_equal(
        puck_model(str(tmp_path / "other.json")).kernel_rows, puck_model("").kernel_rows
    )
    with pytest.raises(ConfigurationError, match="no puck model"):
        puck_model(str(tmp_path / "none.json"))
    assert StateEstimatorConfig(kind="puck").surface == 0.1 and StateEstimatorConfig().surface == 0.0
