"""The simulated robot as a ROS 2 node: what a driver, its controller and a camera offer on a real one.

The physics run in the main thread by simulated time; a second thread executes callbacks, which only put
requests into a queue that the physics take between two slices. So nothing ever happens in the middle of a
step, and no step is lost.
"""

import math
import queue
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.executors import Executor
from rclpy.lifecycle import TransitionCallbackReturn
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from sim_bridge import driver_messages as messages
from sim_bridge.driver_cell import DriverCell
from sim_bridge.driver_config import AIR_HOCKEY, PUSHING, FrankaDriverConfig
from sim_bridge.hockey.cell import AirHockeyCell
from sim_bridge.pacing import Pacer, Ticker
from sim_bridge.pushing_cell import PushingCell
from sim_bridge.spinning import Spinning
from sim_bridge.trajectory_follower import TrajectoryCommand, TrajectoryRejected
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.nodes.conversions import SIMULATED
from vpsto_ros.nodes.diagnostics import ERROR, OK, Diagnostics, Pulse
from vpsto_ros.nodes.joint_conversions import read_trajectory
from vpsto_ros.nodes.lifecycle import ManagedNode, best_effort, latched, reliable, run
from vpsto_ros.nodes.stop_signals import StopSignals

SLICE = 0.005
"""Simulated time between two looks at the queue [s]."""


CELLS: dict[str, Callable[..., DriverCell]] = {PUSHING: PushingCell, AIR_HOCKEY: AirHockeyCell}


class FrankaDriver(ManagedNode):
    """Steps the simulation in real time and speaks for it."""

    default_config = FrankaDriverConfig()
    standstill = "the simulation has not been advanced"

    def __init__(self, name: str, **arguments: Any) -> None:
        """See :class:`ManagedNode`."""
        # Between a slice of the physics and a transition: what one uses, the other destroys.
        self._stepping = threading.RLock()
        self._transition_waits = threading.Event()
        super().__init__(name, **arguments)

    def configure(self, config: FrankaDriverConfig) -> None:
        """Build the simulation, warm it up, open the topics."""
        self.config = config
        _compile(config)
        self._requests: queue.SimpleQueue[tuple[Callable[[], Any], Future]] = queue.SimpleQueue()
        self._open_topics()
        self.cell = CELLS[config.world](self, config)
        self.simulation = self.cell.world
        self.pacer = Pacer(config.real_time_factor)
        self.paused = False
        self._earliest = -math.inf
        self._accepted = 0
        self._advanced = Pulse()
        self._measured = (time.perf_counter(), 0.0)
        self._tickers = {
            self._publish_joints: Ticker(config.joint_state_rate),
            self._publish_reports: Ticker(config.report_rate),
            self._publish_markers: Ticker(config.marker_rate),
        }
        self._clock_ticker = Ticker(config.clock_rate)
        self.diagnostics = Diagnostics(self, self.report, hardware=self.cell.hardware, stamp=self.stamp)

    def _open_topics(self) -> None:
        self._clock_publisher = self.advertise(Clock, "/clock", best_effort(1))
        self._joint_publisher = self.advertise(JointState, "joint_states", reliable(10))
        self._desired_publisher = self.advertise(JointState, "desired_joint_states", reliable(5))
        self._camera_publisher = self.advertise(PoseWithCovarianceStamped, "object_pose", reliable(5))
        self._object_publisher = self.advertise(Odometry, "~/ground_truth/object", best_effort(1))
        self._marker_publisher = self.advertise(MarkerArray, "~/markers", latched())
        self._commands = self.subscribe(JointTrajectory, "joint_trajectory", self._receive_trajectory)
        self.serve(Trigger, "~/reset", self._reset_requested)
        self.serve(SetBool, "~/pause", self._pause_requested)

    def cleanup(self) -> None:
        """Stop reporting."""
        self.diagnostics.destroy()

    def stamp(self) -> Time:
        """The present simulated time as a message."""
        return SIMULATED.stamp(self.simulation.time)

    def spin(self, executor: Executor, signals: StopSignals) -> None:
        """Step the simulation while another thread executes callbacks."""
        # A callback in Python may hold the interpreter for this long; the default is the length of a slice.
        sys.setswitchinterval(1e-3)
        with Spinning(executor) as callbacks:
            self._run(callbacks, signals)
        if callbacks.failure is not None:
            raise callbacks.failure

    def _run(self, callbacks: Spinning, signals: StopSignals) -> None:
        """Advance whenever the node is active, for as long as callbacks are executed."""
        running = False
        while not signals.requested and callbacks.alive:
            if not (self.active and self.configured):
                running = False
                time.sleep(0.02)
                continue
            if not running:
                self.pacer.start(self.simulation.time)
                running = True
            if self._transition_waits.is_set():
                time.sleep(0.001)  # a lock alone would let this thread have it again and again
                continue
            self.advance()

    def advance(self) -> None:
        """One slice: requests, physics, messages, and a wait until its time has come."""
        with self._stepping:
            if not (self.active and self.configured):
                return
            self._advanced.beat()
            self._serve_requests()
            if self.paused:
                self._clock_publisher.publish(Clock(clock=self.stamp()))
                self.pacer.start(self.simulation.time)
                pause, due = 0.02, None
            else:
                self.cell.before_slice(SLICE)
                self.simulation.advance(SLICE)
                self.cell.after_slice()
                self._publish()
                pause, due = 0.0, self.simulation.time
        if due is None:
            time.sleep(pause)
        else:
            self.pacer.wait(due)

    def _transition(self, *arguments: Any) -> TransitionCallbackReturn:
        """A transition happens between two slices, never within one."""
        self._transition_waits.set()
        try:
            with self._stepping:
                return super()._transition(*arguments)
        finally:
            self._transition_waits.clear()

    def silence(self) -> float:
        """How long ago the simulation was advanced, or was found paused [s of wall time]."""
        return self._advanced.silence

    def _serve_requests(self) -> None:
        while True:
            try:
                action, result = self._requests.get_nowait()
            except queue.Empty:
                return
            try:
                result.set_result(action())
            except InvalidInputError as error:
                result.set_exception(error)

    def _publish(self) -> None:
        now = self.simulation.time
        if self._clock_ticker.due(now):
            self._clock_publisher.publish(Clock(clock=self.stamp()))
        base = self.config.base_frame
        for seen in self.simulation.camera_frames():
            self._camera_publisher.publish(messages.seen_object(self.simulation, seen, base))
        for publish, ticker in self._tickers.items():
            if ticker.due(now):
                publish()

    def _publish_joints(self) -> None:
        self._joint_publisher.publish(messages.measured_joints(self.simulation, self.config.base_frame))

    def _publish_reports(self) -> None:
        frame = self.config.base_frame
        self._desired_publisher.publish(messages.desired_joints(self.simulation, frame))
        self._object_publisher.publish(messages.true_object(self.simulation, frame))
        self.cell.publish_reports()

    def _publish_markers(self) -> None:
        self._marker_publisher.publish(self.cell.markers())

    def ask(self, action: Callable[[], Any]) -> Future:
        """Let the main thread do something between two slices."""
        result: Future = Future()
        self._requests.put((action, result))
        return result

    def _receive_trajectory(self, message: JointTrajectory) -> None:
        try:
            points = read_trajectory(message, SIMULATED)
        except InvalidInputError as error:
            self.complaints.add("joint_trajectory.shape", f"trajectory refused (shape): {error}")
            return
        command = TrajectoryCommand(**vars(points))
        self.ask(lambda: self._accept(command)).add_done_callback(self._complain)

    def _check_publishers(self) -> None:
        count = self.count_publishers(self._commands.topic_name)
        if count > 1:
            self.complaints.add(
                "second_planner",
                f"{count} publishers on {self._commands.topic_name}: only one planner may command the arm; "
                "what does not continue the running trajectory is refused",
            )

    def _accept(self, command: TrajectoryCommand) -> None:
        now = self.simulation.time
        start = command.stamp or now
        if start < self._earliest - 1e-6:
            raise TrajectoryRejected(
                "order",
                f"its stamp {start:.3f} s is before the last trajectory began or was taken, at "
                f"{self._earliest:.3f} s; it came late, or from a second planner",
            )
        self.simulation.follower.accept(command, now)
        # One that begins in the future must not shut out what is sent before it begins.
        self._earliest = min(start, now)
        self._accepted += 1

    def _complain(self, result: Future) -> None:
        error = result.exception()
        if isinstance(error, TrajectoryRejected):
            self.complaints.add(f"joint_trajectory.{error.rule}", str(error))
        elif error is not None:
            self.complaints.add("joint_trajectory", str(error))

    def _reset_requested(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self.answer(self._reset, response)

    def answer(self, action: Callable[[], str], response: Any) -> Any:
        """Let the main thread act, and answer with what it says."""
        try:
            response.message = self.ask(action).result(timeout=5.0)
            response.success = True
        except FutureTimeout:
            response.success, response.message = False, "the simulation does not run; nothing happened"
        except InvalidInputError as error:
            response.success, response.message = False, str(error)
        return response

    def _reset(self) -> str:
        words = self.cell.reset()
        self._earliest = -math.inf
        return words

    def _pause_requested(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        return self.answer(lambda: self._pause(request.data), response)

    def _pause(self, paused: bool) -> str:
        self.paused = paused
        return "paused" if paused else "running"

    def figures(self) -> dict[str, Any]:
        """How time passes, what was accepted, and how the limits were kept."""
        self._check_publishers()
        return {
            "real_time_factor": f"{self._real_time_factor():.3f}",
            "behind_s": f"{self.pacer.behind(self.simulation.time):.3f}",
            "delayed_s": f"{self.pacer.delayed:.3f}",
            "trajectories_accepted": self._accepted,
            **messages.figures(self.simulation),
            **self.cell.figures(),
        }

    def health(self) -> tuple[int, str]:
        """Whether limits were kept, and nothing was refused lately."""
        violations = self.simulation.limits.violations
        if violations:
            return ERROR, f"limits were broken at {violations} instants"
        trouble = self.cell.trouble()
        if trouble:
            return ERROR, trouble
        level, message = super().health()
        return (level, message) if level != OK else (OK, "paused" if self.paused else "running")

    def _real_time_factor(self) -> float:
        """Simulated per real time since the last report."""
        wall, simulated = self._measured
        self._measured = (time.perf_counter(), self.simulation.time)
        return (self._measured[1] - simulated) / max(self._measured[0] - wall, 1e-9)


def _compile(config: FrankaDriverConfig) -> None:
    """Run a throw-away simulation, so that everything is compiled before time begins."""
    simulation = config.simulation()
    names, q = simulation.robot.joint_names, simulation.joint_position
    still = np.tile(q, (2, 1))
    command = TrajectoryCommand(names, 0.0, np.array([0.0, 0.1]), still, np.zeros_like(still))
    simulation.follower.accept(command, 0.0)
    simulation.advance(0.1)


def main(args: list[str] | None = None) -> int:
    """Run the simulated driver; see :func:`vpsto_ros.nodes.lifecycle.run`."""
    return run(FrankaDriver, "franka_driver", args)
