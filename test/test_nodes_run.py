"""Running a node until a signal comes: what ends it cleanly and what is an error."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor

from sim_bridge.spinning import Spinning
from vpsto_ros.nodes import lifecycle
from vpsto_ros.nodes.lifecycle import ManagedNode
from vpsto_ros.nodes.mpc_planner import MpcPlannerNode
from vpsto_ros.nodes.stop_signals import NUMBERS, StopSignals

NODE = """
import sys, time
from std_msgs.msg import String
from vpsto_ros.nodes.lifecycle import ManagedNode, reliable, run

class Example(ManagedNode):
    def configure(self, config):
        say("configuring")
        time.sleep({configuring})
        self.subscribe(String, "talk", lambda message: None)
        self.talk = self.advertise(String, "talk", reliable(10))
        for _ in range(4):
            self.every(0.001, lambda: self.talk.publish(String(data="x" * 100)))
        self.every(0.2, lambda: say("tick"))
    def stop(self):
        say("stopping")
        time.sleep({stopping})
    def cleanup(self):
        say("cleaned up")

def say(words):
    print(words, flush=True)

sys.exit(run(Example, "example", ["example"]))
"""


@pytest.fixture
def start():
    """Starts a busy node in a process of its own: the handlers of signals are the process's."""
    started = []

    def make(configuring=0.0, stopping=0.0):
        environment = {**os.environ, "ROS_DOMAIN_ID": "88", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        code = NODE.format(configuring=configuring, stopping=stopping)
        process = subprocess.Popen(
            [sys.executable, "-c", code],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        started.append(process)
        return process

    yield make
    for process in started:
        process.kill()
        process.communicate()


def read_until(process, word):
    for line in process.stdout:
        if line.strip() == word:
            return
    raise AssertionError(f"the process never said {word!r}")


@pytest.mark.parametrize("number", NUMBERS)
def test_a_busy_node_is_brought_to_rest_and_cleaned_up_before_it_ends(start, number):
    process = start()
    read_until(process, "tick")
    process.send_signal(number)
    rest, _ = process.communicate(timeout=30.0)
    said = [line for line in rest.splitlines() if line != "tick"]
    assert process.returncode == 0
    assert said == ["stopping", "cleaned up"]


def test_a_signal_while_a_node_is_configured_ends_it_at_once(start):
    process = start(configuring=60.0)
    read_until(process, "configuring")
    process.send_signal(signal.SIGINT)
    rest, _ = process.communicate(timeout=30.0)
    assert process.returncode == 0 and "Traceback" not in rest


@pytest.mark.parametrize("second", NUMBERS)
def test_a_second_signal_ends_a_node_that_takes_its_time(start, second):
    process = start(stopping=60.0)
    read_until(process, "tick")
    process.send_signal(signal.SIGINT)
    read_until(process, "stopping")
    process.send_signal(second)
    process.communicate(timeout=30.0)
    assert process.returncode == -second


@pytest.mark.parametrize("number", NUMBERS)
def test_the_first_signal_interrupts_unless_a_loop_looks_for_it(number):
    before = [signal.getsignal(each) for each in NUMBERS]
    with StopSignals() as signals, pytest.raises(KeyboardInterrupt):
        signal.raise_signal(number)
    assert signals.requested
    with StopSignals() as signals:
        signals.wait_for_loop()
        assert not signals.requested
        signal.raise_signal(number)
        assert signals.requested
        assert [signal.getsignal(each) for each in NUMBERS] == [signal.SIG_DFL, signal.SIG_DFL]
    assert [signal.getsignal(each) for each in NUMBERS] == before


def test_signals_stay_as_they_are_outside_the_main_thread():
    before = [signal.getsignal(each) for each in NUMBERS]
    seen = []

    def work():
        with StopSignals():
            seen.extend(signal.getsignal(each) for each in NUMBERS)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == before


class Broken:
    """A node that is never spun; `spin` stands for what happens while it runs."""

    def __init__(self, name):
        self.name = name

    def destroy_node(self):
        """Nothing to give back."""


def test_errors_are_not_swallowed(monkeypatch):
    def spin(node, signals):
        raise RuntimeError("a real fault")

    monkeypatch.setattr(lifecycle, "_spin", spin)
    with pytest.raises(RuntimeError, match="a real fault"):
        lifecycle.run(Broken, "broken", ["broken"])
    assert not rclpy.ok()


def test_a_thread_that_spins_hands_over_what_a_callback_raised():
    rclpy.init()
    try:
        node, executor = ManagedNode("spun"), SingleThreadedExecutor()
        executor.add_node(node)

        def fail():
            raise RuntimeError("in a callback")

        node.create_timer(0.01, fail)
        with Spinning(executor) as callbacks:
            deadline = time.monotonic() + 10.0
            while callbacks.alive and time.monotonic() < deadline:
                time.sleep(0.01)
        assert str(callbacks.failure) == "in a callback"
        executor.shutdown()
        node.destroy_node()
    finally:
        rclpy.try_shutdown()


def test_help_needs_no_ros_context(capsys):
    assert lifecycle.run(MpcPlannerNode, "mpc_planner", ["mpc_planner", "--help"]) == 0
    assert "robust.planning.speed" in capsys.readouterr().out and not rclpy.ok()
