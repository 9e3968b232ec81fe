"""All nodes as processes of their own: they push, survive a killed planner and a restarted driver."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("mujoco")

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(random.SystemRandom().randrange(1, 100))

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState

from vpsto_ros.nodes.conversions import SIMULATED, goal_message
from vpsto_ros.planning.goal import PlanarGoal

ROOT = Path(__file__).resolve().parents[1]
MODULES = {
    "franka_driver": "sim_bridge.franka_driver",
    "state_estimator": "vpsto_ros.nodes.state_estimator",
    "contact_planner": "vpsto_ros.nodes.contact_planner",
    "mpc_planner": "vpsto_ros.nodes.mpc_planner",
}
PATIENCE = 120.0
"""Wall time for anything to happen on a host that is very busy [s]."""
MOVING, RESTING = 0.1, 0.02
"""Joint speeds [rad/s]."""


class System:
    """The processes, and an observer of their topics. No figure of it depends on how fast the host is."""

    def __init__(self, folder, parameters=None):
        self.folder, self.processes = folder, {}
        self.parameters = [] if parameters is None else ["--params-file", str(parameters)]
        self.node = rclpy.create_node("observer")
        self.executor = rclpy.executors.SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.joints = self.object = None
        self.status = {}
        listen = self.node.create_subscription
        listen(JointState, "joint_states", lambda m: setattr(self, "joints", m), qos_profile_sensor_data)
        truth = "franka_driver/ground_truth/object"
        listen(Odometry, truth, lambda m: setattr(self, "object", m), qos_profile_sensor_data)
        listen(DiagnosticArray, "/diagnostics", self._take_status, 20)
        self.goals = self.node.create_publisher(PoseStamped, "goal_pose", 1)

    def _take_status(self, message):
        for status in message.status:
            level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
            values = {pair.key: pair.value for pair in status.values}
            self.status[status.name] = (level, status.message, values)

    def start(self, name):
        code = f"import sys; from {MODULES[name]} import main; sys.exit(main())"
        simulated = [] if name == "franka_driver" else ["-p", "use_sim_time:=true"]
        # A driver that is slowed down leaves a busy host the time to plan; deadlines are in node time.
        pace = ["-p", "franka_driver:real_time_factor:=0.5"] if name == "franka_driver" else []
        command = [sys.executable, "-c", code, "--ros-args", *self.parameters, *simulated, *pace]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
        with open(self.folder / f"{name}.log", "ab") as log:
            self.processes[name] = subprocess.Popen(
                command, stdout=log, stderr=log, cwd=ROOT, env=environment, start_new_session=True
            )

    def end(self, name, number):
        process = self.processes.pop(name)
        process.send_signal(number)
        process.wait(timeout=30.0)
        self.status.pop(name, None)

    def wait(self, until, what, patience=PATIENCE):
        end = time.monotonic() + patience
        while not until():
            self.executor.spin_once(timeout_sec=0.05)
            for name, process in self.processes.items():
                assert process.poll() is None, f"{name} ended: {self.log(name)}"
            assert time.monotonic() < end, f"{what}: not within {patience} s; {self.state()}"

    def push(self, goal, until, what):
        """Send a goal, again and again as an operator would, until something happens."""
        sent = [-np.inf]

        def done():
            if time.monotonic() - sent[0] > 1.0:
                sent[0] = time.monotonic()
                self.goals.publish(
                    goal_message(PlanarGoal(np.array(goal)), SIMULATED.stamp(0.0), "fr3_link0")
                )
            return until()

        self.wait(done, what)

    @property
    def time(self):
        return SIMULATED.seconds(self.joints.header.stamp) if self.joints else -1.0

    def speed(self):
        return np.abs(self.joints.velocity).max() if self.joints else 0.0

    def position(self):
        point = self.object.pose.pose.position
        return np.array([point.x, point.y])

    def ready(self, *names):
        """Whether nodes report, and none of an internal error or broken limits."""
        return all(name in self.status and self.status[name][0] != 2 for name in names)

    def state(self):
        logs = "\n".join(f"{name}: {self.log(name)}" for name in MODULES)
        shown = {name: (level, message) for name, (level, message, _) in self.status.items()}
        return f"{shown}, speed {self.speed():.3f} at {self.time:.2f} s\n{logs}"

    def log(self, name, count=1500):
        path = self.folder / f"{name}.log"
        return path.read_text(errors="replace")[-count:] if path.exists() else ""

    def close(self):
        for process in self.processes.values():
            process.kill()
        for process in self.processes.values():
            process.wait()
        self.executor.shutdown()
        self.node.destroy_node()


@pytest.fixture
def system(tmp_path, request):
    rclpy.init()
    made = System(tmp_path, getattr(request, "param", None))
    try:
        yield made
    finally:
        made.close()
        rclpy.try_shutdown()


def assert_limits_were_kept(system):
    values = system.status["franka_driver"][2]
    assert values["limit_violations"] == "0", values


def fresh_driver_status(system):
    system.status.pop("franka_driver", None)
    system.wait(lambda: system.ready("franka_driver"), "a report of the driver")


def test_pushing_survives_a_killed_planner_and_a_restarted_driver(system):
    for name in MODULES:
        system.start(name)
    system.wait(lambda: system.ready(*MODULES) and system.object is not None, "all nodes report")

    goal = (0.62, 0.12)
    start = system.position()
    toward = np.array(goal) - start

    def progress():
        return (system.position() - start) @ toward / np.linalg.norm(toward)

    system.push(goal, lambda: progress() > 0.03, "the box moves toward its goal")
    system.wait(lambda: system.speed() > MOVING, "the arm moves")

    system.end("mpc_planner", signal.SIGKILL)
    killed = system.time
    system.wait(lambda: system.time > killed + 3.0, "three seconds pass")
    assert system.speed() < RESTING, "plans end in a stop, so the arm rests without its planner"
    fresh_driver_status(system)
    assert system.status["franka_driver"][0] == 0, system.status["franka_driver"]
    assert_limits_were_kept(system)

    system.start("mpc_planner")
    other = (0.5, -0.12)  # elsewhere, in case that the box had arrived before the planner was killed
    system.push(other, lambda: system.speed() > MOVING, "the arm moves again")

    system.end("franka_driver", signal.SIGINT)
    system.joints = system.object = None
    for name in ("state_estimator", "contact_planner", "mpc_planner"):
        system.wait(lambda name=name: system.status[name][0] == 3, f"{name} notices that the driver is gone")
    system.start("franka_driver")
    system.wait(lambda: system.ready(*MODULES) and system.object is not None, "the driver is back")
    start = system.position()
    toward = np.array(goal) - start
    system.push(goal, lambda: progress() > 0.03, "the box moves again")
    fresh_driver_status(system)
    assert_limits_were_kept(system)


@pytest.mark.parametrize("system", [ROOT / "config" / "bimanual_push.yaml"], indirect=True)
def test_two_arms_push_by_a_belief_and_stop_while_nobody_has_one(system):
    for name in MODULES:
        system.start(name)
    system.wait(lambda: system.ready(*MODULES) and system.object is not None, "all nodes report")
    assert len(system.joints.name) == 14

    goal = np.array([0.5, 0.0])
    start = np.linalg.norm(system.position() - goal)
    system.push(goal, lambda: np.linalg.norm(system.position() - goal) < start - 0.03, "the can moves")

    system.end("state_estimator", signal.SIGKILL)
    killed = system.time
    system.wait(lambda: system.time > killed + 3.0, "three seconds pass")
    assert system.speed() < RESTING, "without a belief the arms rest"
    system.wait(lambda: system.status["mpc_planner"][0] == 1, "the planner says so")
    assert "belief over the object is" in system.status["mpc_planner"][1]

    system.start("state_estimator")
    system.push(goal, lambda: np.linalg.norm(system.position() - goal) < 0.03, "the can is at its goal")
    fresh_driver_status(system)
    assert_limits_were_kept(system)
    values = system.status["franka_driver"][2]
    assert all(values[f"contact.{kind}.steps"] == "0" for kind in ("arms", "table", "object")), values
