"""Running a node until a signal comes: what ends it cleanly and what is an error."""

import threading

import pytest
import rclpy

from vpsto_ros.nodes import lifecycle
from vpsto_ros.nodes.mpc_planner import MpcPlannerNode


class Broken:
    """A node that is never spun; `spin` stands for what happens while it runs."""

    def __init__(self, name):
        self.name = name

    def destroy_node(self):
        """Nothing to give back."""


def run(monkeypatch, spin):
    monkeypatch.setattr(lifecycle, "_spin", lambda node: spin())
    try:
        return lifecycle.run(Broken, "broken", ["broken"])
    finally:
        rclpy.try_shutdown()


def test_an_error_just_before_a_signal_ends_the_context_is_a_clean_end(monkeypatch):
    def spin():
        threading.Timer(0.1, rclpy.try_shutdown).start()
        raise RuntimeError("Unable to convert call argument '0' to Python object")

    assert run(monkeypatch, spin) == 0


def test_an_error_that_an_interrupt_caused_is_a_clean_end(monkeypatch):
    def spin():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as interrupt:
            raise RuntimeError("in the middle of something") from interrupt

    assert run(monkeypatch, spin) == 0


def test_other_errors_are_not_swallowed(monkeypatch):
    def spin():
        raise RuntimeError("a real fault")

    with pytest.raises(RuntimeError, match="a real fault"):
        run(monkeypatch, spin)


def test_help_needs_no_ros_context(capsys):
    assert lifecycle.run(MpcPlannerNode, "mpc_planner", ["mpc_planner", "--help"]) == 0
    assert "robust.planning.speed" in capsys.readouterr().out and not rclpy.ok()
