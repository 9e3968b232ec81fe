"""The air-hockey demo without its nodes: what counts as a goal, how a run is judged, what is drawn."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from sim_bridge.demo import air_hockey
from sim_bridge.demo.air_hockey import DEMO, rule_violations, shot_figures
from sim_bridge.demo.settings import Settings, _parameters, configured
from sim_bridge.demo.shots import FLIGHT, GOAL, MISSED, NO_SHOT, OWN_GOAL, ShootingScript, Shot
from sim_bridge.demo.verdict import verdict
from sim_bridge.hockey.rules import KINDS
from sim_bridge.report.recording import JointSeries, PoseSeries, Recording, Status
from sim_bridge.report.summary import RunFacts
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.nodes.contact_planner_config import ContactPlannerNodeConfig
from vpsto_ros.nodes.mpc_planner_config import MpcPlannerConfig
from vpsto_ros.nodes.state_estimator_config import StateEstimatorConfig


class Future:
    """An answer that comes at once."""

    def __init__(self, success):
        self.answer = SimpleNamespace(success=success, message="")

    def done(self):
        return True

    def result(self):
        return self.answer


class Hand:
    """Counts requests for pucks; refuses the first so many."""

    def __init__(self, refusals=0):
        self.asked, self.refusals = 0, refusals

    def call_async(self, _request):
        self.asked += 1
        return Future(self.asked > self.refusals)

    def service_is_ready(self):
        return True


class Node:
    """What the script needs of the observer."""

    def __init__(self, hand):
        self.hand, self.listeners, self.speed = hand, {}, 0.0
        self.pose = np.array([1.0, 0.1, 0.0])

    def create_client(self, _kind, _name):
        return self.hand

    def listen(self, topic, callback):
        self.listeners[topic.rsplit("/", 1)[-1]] = callback

    def joint_velocity(self):
        return np.full(7, self.speed)

    def object_pose(self):
        return self.pose


def event(time, end="far", speed=1.5):
    whole = math.floor(time)
    stamp = SimpleNamespace(sec=whole, nanosec=round(1e9 * (time - whole)))
    twist = SimpleNamespace(linear=SimpleNamespace(x=speed, y=0.0))
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp), child_frame_id=end, twist=SimpleNamespace(twist=twist)
    )


@pytest.fixture
def played():
    """A script for three pucks of 9 s, and the node that it acts through."""

    def make(refusals=0, count=3):
        script, node = ShootingScript(9.0 * count, count), Node(Hand(refusals))
        script.connect(node)
        return script, node

    return make


def act(script, start, end, step=0.02):
    for now in np.arange(start, end, step):
        script.act(float(now))


def test_a_puck_that_is_hit_once_and_comes_to_the_far_goal_scores(played):
    script, node = played()
    act(script, 0.0, 1.0)
    assert node.hand.asked == 1 and script.start == pytest.approx(0.02)
    node.listeners["goal_probability"](SimpleNamespace(data=0.8))
    node.listeners["goal_probability"](SimpleNamespace(data=0.9))
    node.listeners["touches"](event(2.0, speed=1.4))
    node.listeners["goal_probability"](SimpleNamespace(data=0.1))  # of the next shot
    node.listeners["goals"](event(3.0, speed=1.2))
    shot = script.shots[0]
    assert (shot.outcome, shot.chance, shot.speed, shot.goal_speed) == (GOAL, 0.9, 1.4, 1.2)
    assert shot.end == pytest.approx(3.0)
    assert script.news() == ["  shot  1  GOAL at 1.2 m/s, 3.0 s after the puck came (predicted 90 %)"]
    assert script.news() == []
    act(script, 3.0, 4.0)
    assert node.hand.asked == 2 and len(script.shots) == 2


@pytest.mark.parametrize(
    ("events", "outcome"),
    [
        ([("touches", event(2.0)), ("goals", event(3.0, "near"))], OWN_GOAL),
        ([("touches", event(2.0)), ("touches", event(2.6))], MISSED),
        ([("touches", event(2.0)), ("touches", event(2.2)), ("goals", event(3.0))], GOAL),  # the mallet drags
        ([("goals", event(3.0))], MISSED),  # it went in by itself
        ([("goals", event(0.0)), ("touches", event(2.0)), ("goals", event(3.0))], GOAL),  # of an older puck
    ],
)
def test_what_does_not_count(played, events, outcome):
    script, node = played()
    act(script, 0.1, 1.0)
    for topic, message in events:
        node.listeners[topic](message)
    assert script.shots[0].outcome == outcome


def test_a_pucks_place_is_seen_after_it_was_put_there(played):
    script, node = played()
    node.pose = np.array([2.5, 0.0, 0.0])  # of the puck before, in the goal
    act(script, 0.0, 0.03)
    assert len(script.shots) == 1 and np.isnan(script.shots[0].place).all()
    node.pose = np.array([1.1, -0.2, 0.3])
    script.act(0.04)
    node.pose = np.array([1.2, -0.2, 0.3])
    script.act(0.06)
    np.testing.assert_array_equal(script.shots[0].place, [1.1, -0.2])


def test_patience_ends(played):
    script, node = played(count=2)
    act(script, 0.0, 9.2)
    assert script.shots[0].outcome == NO_SHOT
    act(script, 9.2, 10.0)
    node.listeners["touches"](event(11.0))
    act(script, 10.0, 11.0 + FLIGHT + 0.1)
    assert script.shots[1].outcome == MISSED and script.finished
    assert script.end == pytest.approx(11.0 + FLIGHT, abs=0.05) and script.progress == 1.0


def test_no_puck_is_brought_while_the_arm_moves_and_refused_ones_are_asked_for_again(played):
    script, node = played(refusals=2)
    node.speed = 0.3
    act(script, 0.0, 1.0)
    assert node.hand.asked == 0 and not script.asked()
    node.speed = 0.0
    act(script, 1.0, 2.0)
    assert node.hand.asked == 3 and len(script.shots) == 1 and script.asked()


SHOTS = [
    Shot(float(k), np.array([1.0, 0.1]), 0.9, k + 0.5, 1.5, k + 1.0, GOAL if k < 9 else MISSED, 1.4)
    for k in range(10)
]


def status(**changes):
    values = {f"rule.{kind}.instants": "0" for kind in KINDS}
    values |= {"limit_violations": "0", "limit.torque.instants": "0"}
    return Status(10.0, 0, "ok", values | changes)


def recording(driver):
    time = np.linspace(0.0, 10.0, 501)
    still = np.zeros((501, 7))
    way = np.column_stack([1.0 + 0.1 * time, 0.01 * time, 0.0 * time])
    values = {"deadline_misses": "2", "skipped_cycles": "0", "cycles": "500"}
    values |= {f"compute_{key}_ms": "5" for key in ("p50", "p99", "max")}
    planner = Status(10.0, 0, "ok", {**values, "deadline_ms": "18"})
    empty = PoseSeries(np.empty(0), np.empty((0, 3)))
    return Recording(
        JointSeries(time, still, still, still), PoseSeries(time, way), empty, empty, [],
        {"franka_driver": [driver], "mpc_planner": [planner]},
    )  # fmt: skip


FACTS = RunFacts(seed=3, first_plan=1.5, elapsed=10.0, trouble=[], planner_rate=50.0)


def summary_of(shots=SHOTS, driver=None, facts=FACTS):
    script = ShootingScript(90.0)
    script.shots, script._start, script._end = list(shots), 0.0, 10.0
    return DEMO.summarize(recording(driver or status()), script, None, facts)


def test_a_good_run_is_a_success_and_says_what_it_achieved():
    summary = summary_of()
    assert summary["success"], summary["failures"]
    assert summary["scored"] == 9 and summary["predicted"] == pytest.approx(9.0)
    text = verdict(DEMO, summary)
    assert text.startswith("SUCCESS: 9 of 10 pucks ended in the goal, predicted were 9.0, at 1.4 m/s")
    headings = [heading for heading, _ in DEMO.tables(summary)]
    assert headings == ["What was measured", "What happened"]
    assert len(DEMO.tables(summary)[1][1]) == 11


def test_each_shortcoming_fails_the_run():
    few = [dataclasses.replace(shot, outcome=MISSED) if k < 2 else shot for k, shot in enumerate(SHOTS)]
    silent = status()
    silent.values.pop("rule.near.instants")
    for changes, word in [
        ({"shots": few}, "7 of 10 pucks"),
        ({"driver": status(**{"rule.side.instants": "4"})}, "the rule 'side' was broken for 4 ms"),
        ({"driver": silent}, "did not say whether the rules"),
        ({"driver": status(limit_violations="2", **{"limit.torque.instants": "2"})}, "driver_torque"),
        ({"facts": dataclasses.replace(FACTS, planner_rate=60.0)}, "plans per simulated second"),
        ({"facts": dataclasses.replace(FACTS, trouble=["mpc_planner exited with status 1"])}, "status 1"),
    ]:
        found = summary_of(**changes)["failures"]
        assert len(found) == 1 and word in found[0]


def test_figures_do_without_goals_and_chances():
    lost = [dataclasses.replace(shot, outcome=NO_SHOT, chance=math.nan) for shot in SHOTS]
    figures = shot_figures(lost, 10)
    assert figures["scored"] == 0 and figures["predicted"] == 0.0 and math.isnan(figures["goal_speed_m_s"])
    assert rule_violations([]) is None and rule_violations([status()]) == dict.fromkeys(KINDS, 0)


def test_charts_are_drawn(tmp_path):
    summary = summary_of()
    charts = DEMO.charts(tmp_path, recording(status()), summary, None)
    assert all(path.stat().st_size > 5000 and caption for path, caption in charts)


def test_the_file_fits_the_nodes_and_they_agree():
    settings = Settings.load("air_hockey", seed=3, real_time_factor=0.5)
    assert settings.driver.world == "air_hockey" and settings.planner_rate == 50.0
    content = air_hockey_parameters(settings)
    estimator, contact, planner = (
        configured(default, content[name])
        for name, default in (
            ("state_estimator", StateEstimatorConfig()),
            ("contact_planner", ContactPlannerNodeConfig()),
            ("mpc_planner", MpcPlannerConfig()),
        )
    )
    assert estimator.kind == "puck" and contact.kind == planner.kind == "shooting"
    assert estimator.hockey.surface == contact.hockey.surface == planner.hockey.surface
    assert {estimator.base_frame, contact.base_frame, planner.base_frame} == {"iiwa_link_0"}
    world = settings.driver.simulation()
    assert world.surface == estimator.surface
    low, high = settings.driver.hockey.pucks.x
    assert estimator.table.x[0] < low < high < estimator.table.x[1]
    assert DEMO.stage(settings).build().body("puck").id > 0 and air_hockey.run is not None


def air_hockey_parameters(settings):
    import yaml

    content = yaml.safe_load(settings.file.read_text())
    names = ("state_estimator", "contact_planner", "mpc_planner")
    return {name: _parameters(content, name) for name in names}


def test_too_little_time_for_all_pucks_is_refused():
    with pytest.raises(ConfigurationError, match="at least"):
        ShootingScript(1.0)
