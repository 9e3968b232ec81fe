"""The planners with the task shooting: shots from a puck's state, strikes from a contact plan."""

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy")

import rclpy
from nav_msgs.msg import Odometry
from node_bench import Bench
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import Marker, MarkerArray

from sim_bridge.hockey.table import TABLE_ORIGIN
from vpsto_ros.contact.puck import SHIPPED, PuckModel
from vpsto_ros.estimation.puck_filter import PuckState
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.nodes.contact_planner import ContactPlannerNode
from vpsto_ros.nodes.contact_planner_config import ContactPlannerNodeConfig
from vpsto_ros.nodes.conversions import (
    SIMULATED,
    contact_message,
    read_contact,
    state_message,
    withdrawal_message,
)
from vpsto_ros.nodes.joint_conversions import joint_state_message, read_trajectory
from vpsto_ros.nodes.mpc_planner import MpcPlannerNode
from vpsto_ros.nodes.mpc_planner_config import MpcPlannerConfig
from vpsto_ros.nodes.table_frame import HockeyTableConfig, PlayingSurfaceConfig
from vpsto_ros.planning.contact import ContactPlan
from vpsto_ros.planning.hockey.shooting_config import SETTINGS, ShootingConfig, Shot
from vpsto_ros.planning.hockey.shot_preview import preview
from vpsto_ros.planning.hockey.strikes import StrikeTable
from vpsto_ros.robot.iiwa import JOINT_NAMES, iiwa14
from vpsto_ros.trajectory import Trajectory

ROOT = Path(__file__).resolve().parents[1]
FRAME = "iiwa_link_0"
HOME = np.array([0.0, -0.196, 0.0, -1.844, 0.0, 0.970, 0.0])
TABLE = HockeyTableConfig()
MODEL = PuckModel.load(SHIPPED)


@pytest.fixture(scope="module", autouse=True)
def ros():
    rclpy.init()
    yield
    rclpy.try_shutdown()


@pytest.fixture
def bench():
    made = []

    def make(*arguments, **overrides):
        made.append(Bench(*arguments, base_frame=FRAME, kind="shooting", rate=50.0, **overrides))
        return made[-1]

    yield make
    for each in made:
        each.close()


# Contact planner


@pytest.fixture
def shooter(bench):
    made = bench(ContactPlannerNode, "contact_planner", input_timeout=0.1)
    made.talk(Odometry, "object_state")
    made.talk(Odometry, "refused_contact")
    made.talk(JointState, "joint_states")
    made.listen(Odometry, "contact_plan")
    made.listen(MarkerArray, "contact_planner/markers")
    made.connect()
    return made


def arm(bench, q=HOME, qd=None):
    qd = np.zeros(7) if qd is None else qd
    bench.send("joint_states", joint_state_message(JOINT_NAMES, q, qd, np.zeros(7), bench.stamp(), FRAME))


def puck(bench, place=(-0.5, 0.0)):
    state = TABLE.object_state(PuckState(bench.time, np.array([*place, 0.0, 0.0]), 1e-7 * np.eye(4), 0, ""))
    bench.send("object_state", state_message(state, SIMULATED, FRAME))


def known(bench, place=(-0.5, 0.0)):
    def each(_t):
        arm(bench)
        puck(bench, place)

    return each


def plans(bench):
    got = bench.received["contact_plan"]
    return [read_contact(message, SIMULATED, FRAME) for message in got if message.child_frame_id]


def test_a_resting_puck_is_shot_at_the_goal_at_one_time(shooter):
    shooter.advance(0.5, each=known(shooter))
    got = plans(shooter)
    assert len(got) > 10 and shooter.received["contact_plan"][-1].child_frame_id == "mallet"
    times = [plan.stamp for plan in got]
    assert np.ptp(times[3:]) < 0.06 and times[-1] > shooter.time
    last = got[-1]
    speed = np.linalg.norm(last.velocity)
    behind = last.position + MODEL.table.contact_distance * last.velocity / speed
    np.testing.assert_allclose(behind, TABLE.to_base([-0.5, 0.0]), atol=2e-3)
    assert 0.5 < speed < 2.5 and last.velocity[0] > 0.0
    assert np.linalg.eigvalsh(last.covariance).min() > 0.0
    report = shooter.node.report()
    assert report.level == 0 and "% to score" in report.message


def test_what_is_expected_is_drawn(shooter):
    shooter.advance(0.5, each=known(shooter, (-0.5, 0.2)))
    drawn = {m.ns: m for m in shooter.received["contact_planner/markers"][-1].markers}
    assert {"puck_path", "shot_path", "shot_spread", "touch", "stroke", "shot"} == set(drawn)
    way = np.array([(p.x, p.y, p.z) for p in drawn["shot_path"].points])
    np.testing.assert_allclose(way[0, :2], TABLE.to_base([-0.5, 0.2]), atol=0.08)
    assert way[-1, 0] > TABLE.x + MODEL.table.half_length and abs(way[-1, 1]) < 0.125
    np.testing.assert_allclose(way[:, 2], TABLE.surface, atol=0.01)
    assert "to score" in drawn["shot"].text and len(drawn["shot_spread"].points) > 40


@pytest.mark.parametrize("loss", ["out of reach", "gone"])
def test_what_was_expected_of_a_shot_vanishes_with_it(shooter, loss):
    shooter.advance(0.4, each=known(shooter))
    assert shooter.node.task.planner.committed is not None
    without = known(shooter, (0.5, 0.0)) if loss == "out of reach" else lambda _: arm(shooter)
    shooter.advance(0.4, each=without)
    last = {m.ns: m for m in shooter.received["contact_planner/markers"][-1].markers}
    gone = {"shot_path", "shot_spread", "touch", "stroke"} | ({"puck_path"} if loss == "gone" else set())
    assert {name for name, marker in last.items() if marker.action == Marker.DELETE} == gone
    assert "no " in last["shot"].text


def test_a_contact_is_as_sure_as_the_puck_will_be(shooter):
    shooter.advance(0.5, each=known(shooter))
    message, task = shooter.received["contact_plan"][-1], shooter.node.task
    seen = preview(MODEL, task.planner.config, task.puck, task.planner.committed)
    sent = read_contact(message, SIMULATED, FRAME).covariance
    expected = seen.covariance[seen.touch - 1][:2, :2] + 1e-8 * np.eye(2)
    np.testing.assert_allclose(sent, expected, rtol=0.05, atol=1e-12)


def test_a_refused_shot_is_dropped_and_another_is_sought(shooter):
    shooter.advance(0.4, each=known(shooter))
    chosen = shooter.node.task.planner.committed
    message = shooter.received["contact_plan"][-1]
    message.header.stamp = SIMULATED.stamp(chosen.time + 0.5)
    shooter.send("refused_contact", message)  # another one's
    shooter.advance(0.02, each=known(shooter))
    assert shooter.node.task.planner.committed.time == pytest.approx(chosen.time)
    message.header.stamp = SIMULATED.stamp(chosen.time)
    elsewhere = copy.deepcopy(message)
    elsewhere.pose.pose.position.y += 0.1
    shooter.send("refused_contact", elsewhere)  # at the same time, but not this one
    shooter.spin(0.05)
    assert shooter.node.task.planner.committed is not None
    shooter.send("refused_contact", message)
    shooter.spin(0.05)
    assert shooter.node.complaints.counts["refused_contact"] == 1
    assert shooter.node.task.planner.committed is None
    shooter.advance(0.6, each=known(shooter))
    assert shooter.node.task.planner.committed is not None


def test_nothing_is_planned_without_puck_or_arm_and_a_far_puck_is_left_alone(shooter):
    shooter.advance(0.3, each=lambda _: puck(shooter))
    assert "no joint_states" in shooter.node.report().message
    shooter.advance(0.3, each=lambda _: arm(shooter))
    assert "no object_state" in shooter.node.report().message
    shooter.received["contact_plan"].clear()
    shooter.advance(0.5, each=known(shooter, (0.5, 0.0)))
    assert not plans(shooter) and shooter.node.report().message.startswith("no shot: ")


@pytest.mark.parametrize("loss", ["puck away", "puck silent", "arm silent"])
def test_a_shot_that_is_dropped_is_called_off_once(shooter, loss):
    shooter.advance(0.4, each=known(shooter))
    assert shooter.received["contact_plan"][-1].child_frame_id == "mallet"
    after = {
        "puck away": known(shooter, (0.5, 0.0)),
        "puck silent": lambda _: arm(shooter),
        "arm silent": lambda _: puck(shooter),
    }[loss]
    shooter.advance(0.4, each=after)
    told = [message.child_frame_id for message in shooter.received["contact_plan"]]
    first = told.index("")
    assert set(told[:first]) == {"mallet"} and told[first:] == [""]
    assert shooter.received["contact_plan"][-1].header.frame_id == FRAME
    assert shooter.node.task.planner.committed is None


@pytest.mark.parametrize(("setting", "weights"), [("aggressive", (0.0, 1.0)), ("own", (3.0, 0.5))])
def test_settings_choose_the_objective(bench, setting, weights):
    own = {"shooting__objective__lambda1": 3.0, "shooting__objective__lambda2": 0.5}
    made = bench(ContactPlannerNode, "contact_planner", setting=setting, **(own if setting == "own" else {}))
    objective = made.node.task.planner.config.objective
    assert (objective.lambda1, objective.lambda2) == weights


def test_a_trained_policy_gives_the_angles_if_asked_to(bench):
    made = bench(ContactPlannerNode, "contact_planner", policy=True)
    for kind, topic in ((Odometry, "object_state"), (JointState, "joint_states")):
        made.talk(kind, topic)
    made.listen(Odometry, "contact_plan")
    made.connect()
    made.advance(1.5, each=known(made))
    assert plans(made), made.node.report().message
    assert plans(made)[-1].velocity[0] > 0.0
    with pytest.raises(ConfigurationError, match="conservative"):
        ContactPlannerNodeConfig(kind="shooting", setting="own", policy=True)


# Preview


def test_a_preview_agrees_with_samples_of_the_model():
    rng = np.random.default_rng(1)
    state = PuckState(0.0, np.array([-0.5, 0.05, 0.02, 0.0]), np.diag([1e-7, 1e-7, 1e-5, 1e-5]), 0, "")
    puck, apart = MODEL.predict(state.mean, state.covariance, [0.5])[0][0], MODEL.table.contact_distance
    shot = Shot(0.5, puck, -0.05, 1.0, 0.9, 1.2, 0, 0.9, apart)
    config = ShootingConfig(aim_std=0.0)
    seen = preview(MODEL, config, state, shot, step=0.02)
    assert seen.times[seen.touch] == pytest.approx(0.5) and seen.mean[-1, 0] > MODEL.table.half_length
    assert np.linalg.eigvalsh(seen.covariance).min() > 0.0
    index = seen.touch + 20  # 0.4 s after the touch
    starts = rng.multivariate_normal(seen.mean[seen.touch - 1], seen.covariance[seen.touch - 1], 4000)
    direction = np.array([np.cos(shot.angle), np.sin(shot.angle)])
    place = seen.mean[seen.touch - 1, :2] - MODEL.table.contact_distance * direction
    mallets = np.tile(np.concatenate([place, shot.speed * direction]), (len(starts), 1))
    means, spreads = MODEL.hit(starts, mallets)
    after = means + np.einsum("bij,bj->bi", np.linalg.cholesky(spreads + 1e-15 * np.eye(4)),
                              rng.standard_normal((len(starts), 4)))  # fmt: skip
    ends = MODEL.simulate(after, 20, rng)[:, -1]
    assert MODEL.period == pytest.approx(0.02)
    np.testing.assert_allclose(ends[:, :2].mean(axis=0), seen.mean[index, :2], atol=4e-3)
    stds, expected = ends[:, :2].std(axis=0), np.sqrt(np.diag(seen.covariance[index])[:2])
    np.testing.assert_allclose(stds, expected, rtol=0.15)


def test_a_puck_alone_is_previewed_for_as_long_as_asked():
    state = PuckState(1.0, np.array([0.0, 0.0, 0.3, 0.0]), 1e-6 * np.eye(4), 0, "")
    seen = preview(MODEL, ShootingConfig(), state, None, longest=1.0)
    assert seen.touch == len(seen.times) and seen.times[-1] == pytest.approx(2.0)
    assert np.all(np.diff(seen.mean[:, 0]) > 0.0)


def test_a_puck_that_leaves_is_previewed_as_far_as_the_goal():
    state = PuckState(1.0, np.array([0.5, 0.0, 2.0, 0.0]), 1e-6 * np.eye(4), 0, "")
    seen = preview(MODEL, ShootingConfig(), state, None)
    assert seen.touch == len(seen.times) == len(seen.mean) < 20
    assert (seen.mean[:-1, 0] <= MODEL.table.half_length).all()
    assert MODEL.table.half_length < seen.mean[-1, 0] < MODEL.table.half_length + 0.15


# MPC


@pytest.fixture
def striker(bench):
    made = bench(MpcPlannerNode, "mpc_planner", contact_timeout=0.1, deadline=0.018, strike__lead=0.05)
    made.node.deadline = 10.0  # whatever the host is busy with
    made.talk(Odometry, "contact_plan")
    made.talk(JointState, "joint_states")
    made.listen(JointTrajectory, "joint_trajectory")
    made.listen(Odometry, "refused_contact")
    made.connect()
    return made


def contact(bench, due, place=(-0.58, 0.0), velocity=(0.9, 0.0)):
    plan = ContactPlan(due, TABLE.to_base(place), np.array(velocity), 1e-6 * np.eye(2))
    return contact_message(plan, SIMULATED, FRAME, "mallet")


def last_trajectory(bench):
    points = read_trajectory(bench.received["joint_trajectory"][-1], SIMULATED)
    return Trajectory.from_points(
        points.stamp + points.time_from_start, points.positions, points.velocities, points.accelerations
    )


def follow(bench):
    """An arm that is exactly where the last trajectory wants it."""
    reference = bench.node.planner.reference
    if reference is None:
        arm(bench)
        return
    q, qd, _ = reference.state(min(max(bench.time, reference.start_time), reference.end_time))
    arm(bench, q, qd)


def told(bench, due, **changes):
    def each(_t):
        follow(bench)
        bench.send("contact_plan", contact(bench, due, **changes))

    return each


def test_the_arm_waits_at_home(striker):
    striker.advance(0.3, each=lambda _: arm(striker))
    trajectory = last_trajectory(striker)
    np.testing.assert_allclose(trajectory(trajectory.end_time), HOME, atol=1e-3)
    assert striker.node.last.mode == "hold" and not striker.received["refused_contact"]


def test_the_mallet_is_where_it_should_be_when_it_should(striker):
    striker.advance(0.1, each=lambda _: arm(striker))
    due = striker.time + 1.6
    striker.advance(0.3, each=told(striker, due))
    trajectory = last_trajectory(striker)
    robot = iiwa14()
    q, qd, _ = trajectory.state(due)
    joint, speed = robot.forward(q)[0], robot.jacobian(q)[:2] @ qd
    # The joint leads a mallet that swings on it: centimetres and some tenths of a metre per second at most.
    np.testing.assert_allclose(joint[:2], TABLE.to_base([-0.58, 0.0]), atol=0.015)
    np.testing.assert_allclose(speed, [0.9, 0.0], atol=0.25)
    np.testing.assert_allclose(trajectory(trajectory.end_time), HOME, atol=1e-3)
    assert not trajectory.violations(robot.limits, relative_tolerance=1e-4)


def test_a_shot_that_is_not_told_any_more_is_called_off(striker):
    striker.advance(0.1, each=lambda _: arm(striker))
    due = striker.time + 1.6
    striker.advance(0.2, each=told(striker, due))
    assert striker.node.planner.contact is not None
    striker.advance(0.2, each=lambda _: follow(striker))
    assert striker.node.planner.contact is None
    trajectory = last_trajectory(striker)
    assert np.abs(trajectory(min(due, trajectory.end_time), 1)).max() < 0.2


def test_a_shot_that_is_called_off_is_dropped_within_two_cycles(striker):
    striker.advance(0.1, each=lambda _: arm(striker))
    striker.advance(0.2, each=told(striker, striker.time + 1.6))
    assert striker.node.planner.contact is not None
    striker.send("contact_plan", withdrawal_message(striker.stamp(), FRAME))
    striker.advance(0.04, each=lambda _: follow(striker))
    assert striker.node.planner.contact is None and striker.node.task.contact is None
    assert not striker.received["refused_contact"]


def test_contacts_age_fast_where_they_are_told_in_every_cycle():
    assert MpcPlannerConfig(kind="shooting", rate=50.0).contact_timeout_in_force == 0.1
    assert MpcPlannerConfig().contact_timeout_in_force == 0.5
    assert MpcPlannerConfig(contact_timeout=0.3).contact_timeout_in_force == 0.3


def test_an_impossible_contact_is_sent_back(striker):
    striker.advance(0.1, each=lambda _: arm(striker))
    due = striker.time + 1.0
    striker.advance(0.1, each=told(striker, due, place=(0.3, 0.0)))
    back = striker.received["refused_contact"]
    assert back and SIMULATED.seconds(back[-1].header.stamp) == pytest.approx(due)
    assert back[-1].pose.pose.position.x == pytest.approx(TABLE.x + 0.3)
    assert striker.received["joint_trajectory"], "the arm is held meanwhile"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda m: setattr(m.header, "frame_id", "fr3_link0"), "frame 'fr3_link0'"),
        (lambda m: setattr(m, "child_frame_id", "fr3_tool"), "child_frame_id 'fr3_tool'"),
        (lambda m: setattr(m.pose.pose.position, "x", float("nan")), "finite"),
        (lambda m: setattr(m.twist.twist.linear, "x", 0.0), "moves"),
        (lambda m: setattr(m.header, "stamp", SIMULATED.stamp(0.0)), "over"),
        (lambda m: setattr(m.header, "stamp", SIMULATED.stamp(100.0)), "in the future"),
    ],
)
def test_broken_contacts_are_refused_with_a_reason(striker, change, reason):
    striker.advance(0.4, each=lambda _: arm(striker))
    message = contact(striker, striker.time + 1.0)
    change(message)
    striker.send("contact_plan", message)
    striker.advance(0.04, each=lambda _: arm(striker))
    assert reason in striker.node.complaints.recent() and striker.node.task.contact is None


def test_nodes_and_driver_know_one_table():
    nodes = yaml.safe_load((ROOT / "config" / "air_hockey.yaml").read_text())
    own = {name: values["ros__parameters"].get("hockey", {}) for name, values in nodes.items()}
    strikes = StrikeTable.load()
    tables = [
        HockeyTableConfig(**own["state_estimator"]),
        PlayingSurfaceConfig(**own.get("contact_planner", {})).table(strikes),
        PlayingSurfaceConfig(**own.get("mpc_planner", {})).table(strikes),
    ]
    for table in tables:
        np.testing.assert_allclose([*table.origin, table.surface], TABLE_ORIGIN, atol=1e-9)


def test_the_planners_are_where_their_strikes_are(bench, monkeypatch):
    strikes = StrikeTable.load()
    moved = dataclasses.replace(strikes, rules=dataclasses.replace(strikes.rules, table_x=1.53, table_y=0.01))
    monkeypatch.setattr(StrikeTable, "load", lambda *_: moved)
    made = bench(ContactPlannerNode, "contact_planner")
    for kind, topic in ((Odometry, "object_state"), (JointState, "joint_states")):
        made.talk(kind, topic)
    made.listen(Odometry, "contact_plan")
    made.connect()
    made.advance(0.5, each=known(made))
    last = plans(made)[-1]
    behind = last.position + MODEL.table.contact_distance * last.velocity / np.linalg.norm(last.velocity)
    np.testing.assert_allclose(behind, TABLE.to_base([-0.5, 0.0]), atol=2e-3)
    planner = made.node.task.planner
    np.testing.assert_allclose(planner.committed.puck[:2], [-0.52, -0.01], atol=2e-3)


def test_the_kind_decides_whose_lead_counts():
    config = MpcPlannerConfig(kind="shooting", rate=50.0)
    assert config.lead == config.strike.lead
    assert set(config.searches) == {"strike.approach.search", "strike.home.search"}
    with pytest.raises(ConfigurationError, match=r"strike.lead"):
        MpcPlannerConfig(kind="shooting", rate=50.0, deadline=0.0195)


def test_an_objective_beside_a_setting_is_refused():
    own = dataclasses.replace(SETTINGS["balanced"], beta=0.9)
    with pytest.raises(ConfigurationError, match="objective"):
        ContactPlannerNodeConfig(kind="shooting", shooting=ShootingConfig(objective=own))
    assert ContactPlannerNodeConfig(kind="shooting", setting="own", shooting=ShootingConfig(objective=own))
