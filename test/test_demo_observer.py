"""The demo's own node: what it publishes, what it takes for a plan, and that its failure ends the demo."""

import os
import random
import sys
import time

import numpy as np
import pytest

pytest.importorskip("rclpy")

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(random.SystemRandom().randrange(1, 100))

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.serialization import serialize_message
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from sim_bridge.demo.bimanual_push import DEMO as BIMANUAL_PUSH
from sim_bridge.demo.observer import NodeThread, Observer, moves
from sim_bridge.demo.processes import ProcessGroup
from sim_bridge.demo.push_box import DEMO as PUSH_BOX
from sim_bridge.demo.push_box import box_scenario
from sim_bridge.demo.pushing import GOAL_REPEAT, PushingScript
from sim_bridge.demo.running import _trouble, _watch
from sim_bridge.demo.scenario import Orders
from sim_bridge.demo.verdict import Outcome, give_up, verdict
from sim_bridge.scene import Scene
from vpsto_ros.exceptions import VpstoError
from vpsto_ros.nodes.diagnostics import Durations


class NoBag:
    def add_topic(self, *_):
        pass

    def write(self, *_):
        pass


class Sent(list):
    publish = list.append


@pytest.fixture
def observer():
    rclpy.init()
    node = Observer(NoBag(), PushingScript(box_scenario(np.random.default_rng(0)), Scene().plane()))
    yield node
    node.destroy_node()
    rclpy.try_shutdown()


def plan(*positions):
    return JointTrajectory(points=[JointTrajectoryPoint(positions=[p] * 7) for p in positions])


def test_a_goal_that_stands_is_repeated(observer, monkeypatch):
    sent = Sent()
    script = observer._script
    monkeypatch.setattr(script, "_goals", sent)
    goal = np.array([0.5, 0.1])
    for now in np.arange(0.0, 5.0, 0.02):
        script.carry_out(Orders(goal), now)
    assert 5 <= len(sent) <= 5.0 / GOAL_REPEAT + 1
    assert {(m.pose.position.x, m.pose.position.y) for m in sent} == {(0.5, 0.1)}
    script.carry_out(Orders(np.array([0.6, 0.0])), 5.0)
    assert sent[-1].pose.position.x == 0.6, "a jump does not wait"


def test_a_plan_at_rest_is_no_first_plan(observer):
    receive = observer._receiver("/joint_trajectory")
    receive(serialize_message(plan(0.1, 0.2)))
    assert observer.first_plan is None, "there was no target yet"
    observer._script.goal = np.array([0.5, 0.1])
    for resting in (plan(), plan(0.1), plan(0.1, 0.1, 0.1)):
        receive(serialize_message(resting))
    assert observer.first_plan is None
    receive(serialize_message(plan(0.1, 0.1, 0.15, 0.1)))
    assert observer.first_plan == pytest.approx(time.monotonic(), abs=5.0)
    assert moves(plan(0.1, 0.15, 0.1))


def test_the_last_reports_are_known(observer):
    message = DiagnosticArray(status=[DiagnosticStatus(name="mpc_planner")])
    message.header.stamp.sec = 7
    observer._receiver("/diagnostics")(serialize_message(message))
    assert observer.reported_since("mpc_planner", 7.0)
    assert not observer.reported_since("mpc_planner", 7.1)
    assert not observer.reported_since("franka_driver", 0.0)


def test_a_planner_is_informed_once_it_has_heard_of_everything_but_the_goal(observer):
    def report(**ages):
        pairs = [KeyValue(key=f"age.{topic}_s", value=age) for topic, age in ages.items()]
        message = DiagnosticArray(status=[DiagnosticStatus(name="mpc_planner", values=pairs)])
        observer._receiver("/diagnostics")(serialize_message(message))
        return observer.informed("mpc_planner")

    assert not report()
    assert not report(joint_states="0.010", object_belief="inf", contact_plan="inf")
    assert report(joint_states="0.010", object_belief="0.030", contact_plan="inf")


def test_a_failing_callback_ends_the_watch_with_its_error(observer, tmp_path):
    def fail():
        raise OSError("no space left on device")

    observer.create_timer(0.01, fail)
    began = time.monotonic()
    with NodeThread(observer) as spinning, ProcessGroup(tmp_path, {}) as processes:
        arguments = (observer._script, lambda _: None, time.monotonic() + 60.0)
        with pytest.raises(VpstoError, match=r"own node failed: OSError: no space left") as caught:
            _watch(observer, spinning, processes, *arguments)
    assert isinstance(caught.value.__cause__, OSError)
    assert time.monotonic() - began < 30.0


def test_a_node_that_dies_before_the_first_step_gives_a_verdict(tmp_path, capsys):
    outcome = Outcome(PushingScript(box_scenario(np.random.default_rng(0)), Scene().plane()))
    with ProcessGroup(tmp_path / "logs", {}) as processes:
        processes.start("mpc_planner", [sys.executable, "-c", "print('no licence'); raise SystemExit(3)"])
        while not processes.ended():
            time.sleep(0.01)
        ended = processes.ended()
        processes.stop()
    outcome.trouble += _trouble(processes, ended)
    assert give_up(tmp_path, 0, outcome) == 1
    text = capsys.readouterr().out
    assert text.startswith("FAILED: mpc_planner ended during the run with status 3") and "no licence" in text
    assert '"success": false' in (tmp_path / "summary.json").read_text()


def test_the_verdict_says_when_the_first_plan_came():
    good = {
        "success": True,
        "failures": [],
        "phases": [{"name": "target 1", "judged": True, "time_to_reach_s": 3.0}],
        "reached_distance_m": 0.015,
        "drift": {"median_distance_m": 0.01},
        "final_error_m": 0.002,
        "mpc": {"deadline_misses": 1.0, "cycles": 900.0, "rate_hz": 19.98},
        "time_to_first_plan_s": 2.34,
    }
    for demo in (PUSH_BOX, BIMANUAL_PUSH):
        assert "the first plan that moves came 2.3 s after the start" in verdict(demo, good)
        assert "within 3.0 s" in verdict(demo, good) and "at 20.0 plans per second" in verdict(demo, good)
    assert "within 15 mm" in verdict(BIMANUAL_PUSH, good)
    bad = {**good, "success": False, "failures": ["x"]}
    assert verdict(PUSH_BOX, bad).startswith("FAILED: x; the first plan that moves came 2.3 s")
    assert "no plan that moves came" in verdict(PUSH_BOX, {**bad, "time_to_first_plan_s": float("nan")})


def test_percentiles_of_a_node_cover_the_longest_usual_scenario():
    durations = Durations()
    for seconds in [0.02] * 2000 + [0.001] * 2500:  # 90 s at 50 Hz
        durations.add(seconds)
    assert durations.milliseconds("compute")["compute_p99_ms"] == "20.000"
