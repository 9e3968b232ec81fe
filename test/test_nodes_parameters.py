"""Parameters from dataclasses, and the lifecycle: whatever is wrong is said once, clearly, by name."""

import dataclasses
import os
import random
import signal
import subprocess
import sys
import textwrap
import time

import pytest

pytest.importorskip("rclpy")

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(random.SystemRandom().randrange(1, 100))

import rclpy
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_msgs.msg import Float64

from vpsto_ros.configuration import option, validate
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.nodes.diagnostics import Cycles, Pulse
from vpsto_ros.nodes.lifecycle import ManagedNode, NodeConfig
from vpsto_ros.nodes.parameters import declare_parameters, read_parameters


@dataclasses.dataclass(frozen=True)
class FilterConfig:
    gate: float = option(9.0, "gate", unit="1", minimum=0.0, maximum=100.0)
    kind: str = option("kalman", "which filter", choices=("kalman", "particles"))

    def __post_init__(self):
        validate(self)


@dataclasses.dataclass(frozen=True)
class ExampleConfig(NodeConfig):
    rate: float = option(20.0, "planning rate", unit="Hz", minimum=1.0, maximum=50.0)
    samples: int = option(50, "samples", minimum=1)
    sides: tuple[float, float] = option((0.1, 0.12), "side lengths", unit="m", minimum=0.01, maximum=0.3)
    verbose: bool = option(False, "say more")
    low: float = option(0.0, "lower end")
    high: float = option(1.0, "upper end")
    filter: FilterConfig = dataclasses.field(default_factory=FilterConfig)

    def __post_init__(self):
        validate(self)
        if self.low > self.high:
            raise ConfigurationError(f"low = {self.low} is above high = {self.high}")


class ExampleNode(ManagedNode):
    default_config = ExampleConfig()

    def __init__(self, **arguments):
        self.resets = self.ticks = 0
        self.received = []
        self.stopped = False
        super().__init__("example", **arguments)

    def configure(self, config):
        self.config = config
        self.publisher = self.advertise(Float64, "out", 1)
        self.subscribe(Float64, "in", self.receive)
        self.every(0.01, self.tick)

    def receive(self, message):
        if message.data < 0.0:
            raise InvalidInputError(f"{message.data} is negative")
        self.received.append(message.data)

    def tick(self):
        self.now()
        self.ticks += 1
        self.publisher.publish(Float64(data=1.0))

    def stop(self):
        self.stopped = True

    def on_time_reset(self):
        self.resets += 1


@pytest.fixture(scope="module", autouse=True)
def ros():
    rclpy.init()
    yield
    rclpy.try_shutdown()


def make(**overrides):
    return ExampleNode(
        parameter_overrides=[Parameter(name.replace("__", "."), value=v) for name, v in overrides.items()]
    )


def configured(**overrides):
    node = make(**overrides)
    try:
        return read_parameters(node, node.default_config)
    finally:
        node.destroy_node()


def test_defaults_and_overrides_reach_the_dataclass():
    assert configured() == ExampleConfig()
    config = configured(
        rate=25, samples=3, sides=[1.0e-1, 2.0e-1], filter__gate=4.5, filter__kind="particles"
    )
    assert config.rate == 25.0 and isinstance(config.rate, float)
    assert config.samples == 3 and config.sides == (0.1, 0.2)
    assert config.filter == FilterConfig(4.5, "particles")


def test_parameters_are_described():
    node = make(rate=30.0)
    descriptor = node.describe_parameter("rate")
    assert descriptor.description == "planning rate [Hz]"
    assert (descriptor.floating_point_range[0].from_value, descriptor.floating_point_range[0].to_value) == (
        1.0,
        50.0,
    )
    assert node.describe_parameter("samples").integer_range[0].from_value == 1
    assert "'kalman', 'particles'" in node.describe_parameter("filter.kind").additional_constraints
    node.destroy_node()


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        ({"rat": 20.0}, ["no parameter 'rat'", "did you mean rate"]),
        ({"gate": 3.0}, ["no parameter 'gate'", "filter.gate"]),
        ({"filter__gat": 3.0}, ["no parameter 'filter.gat'", "filter.gate"]),
        ({"zzz": 3.0}, ["no parameter 'zzz'", "known parameters", "rate", "filter.kind"]),
        ({"rate": "fast"}, ["'rate' = 'fast' (str)", "float from 1.0 to 50.0 Hz"]),
        ({"rate": 60.0}, ["'rate' = 60.0", "1.0 to 50.0 Hz"]),
        ({"rate": True}, ["'rate' = True (bool)"]),
        ({"rate": float("nan")}, ["'rate' = nan"]),
        ({"samples": 2.5}, ["'samples' = 2.5 (float)", "int from 1 to"]),
        ({"samples": 0}, ["'samples' = 0"]),
        ({"verbose": 1}, ["'verbose' = 1 (int)", "bool"]),
        ({"sides": [0.1]}, ["'sides' = [0.1] (1 values)", "2 numbers"]),
        ({"sides": [0.1, 0.5]}, ["'sides' = [0.1, 0.5]", "0.01 to 0.3 m"]),
        ({"sides": 0.1}, ["'sides' = 0.1 (float)"]),
        ({"filter__kind": "magic"}, ["'filter.kind' = 'magic'", "one of 'kalman', 'particles'"]),
    ],
)
def test_wrong_parameters_are_named(overrides, parts):
    with pytest.raises(ConfigurationError) as caught:
        make(**overrides)
    for part in parts:
        assert part in str(caught.value)


def test_checks_across_fields_fail_the_configure_transition_and_can_be_repaired():
    node = make(low=2.0)
    assert node.trigger_configure() == rclpy.lifecycle.TransitionCallbackReturn.FAILURE
    assert "low = 2.0 is above high = 1.0" in str(node.failure)
    assert node.set_parameters([Parameter("low", value=0.5)])[0].successful
    node.start()
    assert node.config.low == 0.5
    node.destroy_node()


def test_parameters_are_read_only_once_configured():
    node = make()
    refused = node.set_parameters([Parameter("rate", value=1000.0)])[0]
    assert not refused.successful
    assert not node.set_parameters([Parameter("filter.kind", value="magic")])[0].successful
    node.start()
    refused = node.set_parameters([Parameter("rate", value=30.0)])[0]
    assert not refused.successful and "clean it up" in refused.reason and "rate" in refused.reason
    node.trigger_deactivate()
    node.trigger_cleanup()
    assert node.set_parameters([Parameter("rate", value=30.0)])[0].successful
    node.start()
    assert node.config.rate == 30.0
    node.destroy_node()
    assert SetParameters is not None


def spin(node, until, timeout=5.0):
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(node)
    end = time.monotonic() + timeout
    while not until() and time.monotonic() < end:
        executor.spin_once(timeout_sec=0.05)
    executor.remove_node(node)
    return until()


def test_timers_and_topics_follow_the_lifecycle():
    node = make()
    helper = node.create_publisher(Float64, "in", 5)
    published = []
    node.create_subscription(Float64, "out", published.append, 5)
    node.trigger_configure()
    assert not spin(node, lambda: node.ticks > 0, timeout=0.1)
    node.trigger_activate()
    assert spin(node, lambda: node.ticks > 3 and published)

    def hear():
        helper.publish(Float64(data=1.0))
        return node.received

    assert spin(node, hear)
    node.trigger_deactivate()
    assert node.stopped
    ticks, heard = node.ticks, len(node.received)
    assert not spin(node, lambda: hear() and (node.ticks > ticks or len(node.received) > heard), timeout=0.2)
    node.trigger_activate()
    assert spin(node, lambda: node.ticks > ticks)
    node.trigger_deactivate()
    node.trigger_cleanup()
    node.start()
    assert spin(node, lambda: len(node.received) > heard or not hear())
    node.destroy_node()


def test_refused_messages_are_counted_and_bugs_surface():
    node = make()
    helper = node.create_publisher(Float64, "in", 5)
    node.start()

    def bad():
        helper.publish(Float64(data=-1.0))
        return node.complaints.counts["in"]

    assert spin(node, bad)
    assert "in refused: -1.0 is negative" in node.complaints.recent()
    node.received = None  # what a bug looks like

    def bug():
        helper.publish(Float64(data=1.0))
        return node.faults >= 3

    assert spin(node, bug), "the node lives on"
    report = node.report()
    assert report.level == 2 and "AttributeError" in report.message
    assert report.values["internal_errors"] == node.faults and len(node._faults_logged) == 1
    node.destroy_node()


def test_a_pulse_is_measured_by_its_own_clock():
    now = [0.0]
    pulse = Pulse(lambda: now[0])
    pulse.see(7)
    now[0] = 3.0
    pulse.see(7)
    assert pulse.silence == 3.0
    pulse.see(8)
    assert pulse.silence == 0.0


def test_cycles_count_what_was_skipped():
    cycles = Cycles(0.05)
    assert [cycles.begin(t) for t in (0.0, 0.05, 0.1, 0.175)] == [0, 0, 0, 0]  # half a period late is jitter
    assert [cycles.begin(t) for t in (0.275, 0.475)] == [1, 3]
    assert cycles.begin(9.0, at_work=False) == cycles.begin(9.5) == 0
    assert (cycles.count, cycles.skipped) == (7, 4)


def test_bugs_in_transitions_are_not_swallowed():
    class Broken(ExampleNode):
        def configure(self, config):
            raise ZeroDivisionError("a bug")

    node = Broken()
    with pytest.raises(ZeroDivisionError):
        node.start()
    node.destroy_node()


def test_a_clock_that_goes_backwards_is_noticed():
    from rosgraph_msgs.msg import Clock

    node = make(use_sim_time=True)
    clock = node.create_publisher(Clock, "/clock", 10)
    node.start()
    message = Clock()

    def advance():
        message.clock.nanosec += 10_000_000
        clock.publish(message)
        return node.ticks >= 5

    assert spin(node, advance)
    assert node.resets == 0
    before = node.ticks
    message.clock.nanosec = 0
    assert spin(node, lambda: advance() and node.ticks > before + 5)
    assert node.resets == 1
    assert "clock went backwards" in node.complaints.recent(60.0)
    assert NodeConfig is not None and declare_parameters is not None
    node.destroy_node()


PROGRAM = textwrap.dedent(
    """
    import dataclasses, sys
    from vpsto_ros.configuration import option
    from vpsto_ros.nodes.lifecycle import ManagedNode, NodeConfig, run

    @dataclasses.dataclass(frozen=True)
    class Config(NodeConfig):
        rate: float = option(20.0, "rate", unit="Hz", minimum=1.0, maximum=50.0)

    class Node(ManagedNode):
        default_config = Config()
        def configure(self, config):
            self.every(0.02, self.tick)
        def tick(self):
            print("tick", flush=True)

    sys.exit(run(Node, "example"))
    """
)


def start(tmp_path, *arguments):
    script = tmp_path / "node.py"
    script.write_text(PROGRAM)
    command = [sys.executable, str(script), *arguments]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, **pipes, env={**os.environ, "PYTHONPATH": os.getcwd()})


def test_a_wrong_parameter_file_ends_the_process_with_one_clear_line(tmp_path):
    file = tmp_path / "bad.yaml"
    file.write_text("example:\n  ros__parameters:\n    rate: 60\n")
    process = start(tmp_path, "--ros-args", "--params-file", str(file))
    out, error = process.communicate(timeout=30)
    lines = [line for line in (out + error).splitlines() if line.strip()]
    assert process.returncode == 2
    assert (
        len(lines) == 1
        and "parameter 'rate' = 60 (int) is not allowed; expected float from 1.0 to 50.0 Hz" in lines[0]
    )


def test_unknown_arguments_and_unreadable_files_end_with_status_2(tmp_path):
    for arguments, part in (
        (("--rate", "3"), "unknown arguments --rate 3"),
        (("--ros-args", "--params-file", "no.yaml"), "no.yaml"),
    ):
        process = start(tmp_path, *arguments)
        out, error = process.communicate(timeout=30)
        assert process.returncode == 2
        assert part in out + error and "Traceback" not in out + error


def test_help_lists_every_parameter_with_its_range(tmp_path):
    process = start(tmp_path, "--help")
    out, _ = process.communicate(timeout=30)
    assert process.returncode == 0
    assert "usage: example --ros-args" in out
    assert "  rate (default " in out
    assert "float from 1.0 to 50.0 Hz" in out


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_the_process_cleanly(tmp_path, stop):
    process = start(tmp_path)
    assert process.stdout.readline() == "tick\n"
    process.send_signal(stop)
    out, error = process.communicate(timeout=30)
    assert process.returncode == 0
    assert "Traceback" not in out + error
