"""A demo's own ROS node: records every topic, and acts out what the demo's script says."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import GetState
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from sim_bridge.demo.script import Script
from sim_bridge.report.bag import BagRecorder
from sim_bridge.report.overlay import MARKERS, Overlay, overlays_of
from sim_bridge.report.recording import GOAL_POSE, GROUND_TRUTH, JOINT_STATES, JOINT_TRAJECTORY, planar
from sim_bridge.spinning import Spinning
from vpsto_ros.exceptions import VpstoError

CLOCK, DIAGNOSTICS = "/clock", "/diagnostics"
GOALS, TOUCHES = "/franka_driver/goals", "/franka_driver/touches"
GOAL_PROBABILITY = "/contact_planner/goal_probability"
MOVING = 1e-3
"""A plan that moves no joint farther is no motion [rad]."""
LATCHED = {
    "/contact_plan": Odometry,
    "/franka_driver/markers": MarkerArray,
    "/state_estimator/markers": MarkerArray,
    "/contact_planner/markers": MarkerArray,
    "/mpc_planner/markers": MarkerArray,
}
TOPICS = {
    CLOCK: Clock,
    JOINT_STATES: JointState,
    JOINT_TRAJECTORY: JointTrajectory,
    GROUND_TRUTH: Odometry,
    "/franka_driver/ground_truth/tool": Odometry,
    GOAL_POSE: PoseStamped,
    "/object_pose": PoseWithCovarianceStamped,
    "/object_state": Odometry,
    "/object_belief": PoseArray,
    "/external_wrench": WrenchStamped,
    "/disturbance": WrenchStamped,
    "/refused_contact": Odometry,
    "/franka_driver/ground_truth/mallet": Odometry,
    GOALS: Odometry,
    TOUCHES: Odometry,
    GOAL_PROBABILITY: Float64,
    DIAGNOSTICS: DiagnosticArray,
    **LATCHED,
}


class Observer(Node):
    """Listens to everything without interpreting more than it must, and acts out a script.

    Messages stay serialised on their way into the bag; only what the script or a viewer needs is decoded.
    """

    def __init__(self, bag: BagRecorder, script: Script) -> None:
        """Subscribe to all topics.

        Args:
            bag: gets every message.
            script: acted out once :meth:`begin` was called.
        """
        super().__init__("demo")
        self._bag, self._script = bag, script
        self._latest: dict[str, bytes] = {}
        self._running = False
        self.simulated_time = 0.0
        self.first_plan: float | None = None
        self._reported: dict[str, float] = {}
        self._informed: set[str] = set()
        self._listeners: dict[str, Callable[[Any], None]] = {}
        script.connect(self)
        for topic, kind in TOPICS.items():
            bag.add_topic(topic, f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}")
            self.create_subscription(kind, topic, self._receiver(topic), _quality(topic), raw=True)

    def begin(self) -> None:
        """Start the script with the next message about the object."""
        self._running = True

    def listen(self, topic: str, callback: Callable[[Any], None]) -> None:
        """Call back with every message of one of the topics, while the script runs."""
        self._listeners[topic] = callback

    def latest(self, topic: str) -> Any:
        """The newest message of a topic, or None."""
        data = self._latest.get(topic)
        return None if data is None else deserialize_message(data, TOPICS[topic])

    def joints(self) -> NDArray[np.float64] | None:
        """The newest joint positions (n,) [rad], or None."""
        message = self.latest(JOINT_STATES)
        return None if message is None else np.array(message.position)

    def joint_velocity(self) -> NDArray[np.float64] | None:
        """The newest joint velocities (n,) [rad/s], or None."""
        message = self.latest(JOINT_STATES)
        return None if message is None else np.array(message.velocity)

    def object_pose(self) -> NDArray[np.float64] | None:
        """The newest true pose of the object: x, y [m] and yaw [rad], or None."""
        message = self.latest(GROUND_TRUTH)
        return None if message is None else np.array(planar(message.pose.pose))

    def overlays(self, height: float) -> tuple[Overlay, ...]:
        """What the nodes drew last; height is the object's [m]."""
        found: list[Overlay] = []
        for topic, wanted in MARKERS.items():
            message = self.latest(topic)
            found += overlays_of(message.markers, wanted, height) if message is not None else ()
        return tuple(found)

    def _receiver(self, topic: str) -> Callable[[bytes], None]:
        def receive(data: bytes) -> None:
            if topic == CLOCK:
                # A 4-byte header, seconds and nanoseconds: cheaper than building a message.
                seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
                self.simulated_time = seconds + 1e-9 * nanoseconds
            self._latest[topic] = data
            self._bag.write(topic, self.simulated_time, data)
            if topic == JOINT_TRAJECTORY and self.first_plan is None and self._script.asked():
                now = time.monotonic()
                if moves(deserialize_message(data, JointTrajectory)):
                    self.first_plan = now
            if topic == DIAGNOSTICS:
                self._note_report(deserialize_message(data, DiagnosticArray))
            if self._running and topic in self._listeners:
                self._listeners[topic](deserialize_message(data, TOPICS[topic]))
            if topic == GROUND_TRUTH and self._running:
                self._act()

        return receive

    def reported_since(self, name: str, seconds: float) -> bool:
        """Whether a node has published diagnostics at or after a simulated time [s]."""
        return self._reported.get(name, -math.inf) >= seconds

    def informed(self, name: str) -> bool:
        """Whether a node has said that it has got all of its inputs but the goal and what follows from it."""
        return name in self._informed

    def _note_report(self, message: DiagnosticArray) -> None:
        stamp = message.header.stamp
        for status in message.status:
            self._reported[status.name] = stamp.sec + 1e-9 * stamp.nanosec
            ages = {pair.key: pair.value for pair in status.values if pair.key.startswith("age.")}
            ages.pop("age.contact_plan_s", None)  # comes after the first goal only
            if ages and "inf" not in ages.values():
                self._informed.add(status.name)

    def _act(self) -> None:
        stamp = self.latest(GROUND_TRUTH).header.stamp
        if not self._script.finished:
            self._script.act(stamp.sec + 1e-9 * stamp.nanosec)


def moves(message: JointTrajectory) -> bool:
    """Whether a trajectory leads anywhere; a planner without a way sends one that rests."""
    if len(message.points) < 2:
        return False
    return bool(np.ptp([point.positions for point in message.points], axis=0).max() > MOVING)


class Activity:
    """Watches over the lifecycle states of the nodes."""

    def __init__(self, node: Node, names: tuple[str, ...]) -> None:
        """Prepare to ask these nodes."""
        self._clients = {name: node.create_client(GetState, f"/{name}/get_state") for name in names}
        self._asked: dict[str, Any] = {}
        self.waiting = set(names)

    def poll(self) -> bool:
        """Ask those that were not active yet.

        Returns:
            Whether all are active.
        """
        for name in sorted(self.waiting):
            future = self._asked.get(name)
            if future is not None and future.done():
                if future.result().current_state.id == State.PRIMARY_STATE_ACTIVE:
                    self.waiting.discard(name)
                self._asked.pop(name)
            elif future is None and self._clients[name].service_is_ready():
                self._asked[name] = self._clients[name].call_async(GetState.Request())
        return not self.waiting


class NodeThread(Spinning):
    """Runs a node's callbacks in a thread while a block is executed."""

    def __init__(self, node: Node) -> None:
        """Prepare to spin this node."""
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        super().__init__(executor)

    def check(self) -> None:
        """Whoever waits for what the callbacks do has to ask this again and again.

        Raises:
            VpstoError: a callback failed, so that none is executed any more.
        """
        if self.failure is not None:
            kind = type(self.failure).__name__
            raise VpstoError(f"the demo's own node failed: {kind}: {self.failure}") from self.failure

    def __exit__(self, *arguments: Any) -> None:
        super().__exit__(*arguments)
        self._executor.shutdown(timeout_sec=5.0)


def _quality(topic: str) -> QoSProfile:
    # A best-effort subscriber hears every publisher; what is latched must be asked for as such.
    if topic in LATCHED:
        return QoSProfile(
            depth=10, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
        )
    return QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


def message_stamp(seconds: float) -> Any:
    """A simulated time [s] as a message."""
    from builtin_interfaces.msg import Time

    whole = math.floor(seconds)
    return Time(sec=whole, nanosec=min(round((seconds - whole) * 1e9), 999_999_999))
