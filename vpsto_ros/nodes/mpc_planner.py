"""The node that moves the arms: joint states and a task's inputs in, joint_trajectory out, at 20 to 50 Hz."""

import math
import threading
import time
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from std_srvs.srv import SetBool
from visualization_msgs.msg import MarkerArray

from vpsto_ros.exceptions import ConfigurationError, VpstoError
from vpsto_ros.nodes import markers
from vpsto_ros.nodes.arm_link import ArmLink, LinkConfig
from vpsto_ros.nodes.diagnostics import ERROR, OK, STALE, WARN, Cycles, Diagnostics, Durations
from vpsto_ros.nodes.lifecycle import ManagedNode, latched, run
from vpsto_ros.nodes.mpc_planner_config import TRANSPORT, MpcPlannerConfig
from vpsto_ros.nodes.planning_task import PlanningTask, PushingTask
from vpsto_ros.nodes.robots import PUSHING, ROBUST_PUSHING, SHOOTING
from vpsto_ros.nodes.robust_pushing_task import RobustPushingTask
from vpsto_ros.nodes.strike_task import StrikeTask
from vpsto_ros.planning.running_reference import MpcStep

KINDS: dict[str, Callable[..., PlanningTask]] = {
    PUSHING: PushingTask, ROBUST_PUSHING: RobustPushingTask, SHOOTING: StrikeTask,
}  # fmt: skip


class MpcPlannerNode(ManagedNode):
    """Runs a planner against the clock and publishes what is ready in time.

    Inputs are stored as they come, by the task that the parameter `kind` names; the planning timer takes the
    latest. It has a callback group and a lock of its own, so that the node also works in a multi-threaded
    executor; a single-threaded one makes it faster. The service ``~/stop`` (std_srvs/SetBool) brakes the arm
    and pauses planning with true, and resumes with false.
    """

    default_config = MpcPlannerConfig()

    def configure(self, config: MpcPlannerConfig) -> None:
        """Set up the planner, compile its kernels, then topics and timers."""
        self.config = config
        self._lock = threading.Lock()  # guards the planner, which the timer, ~/stop and transitions use
        self.deadline = config.deadline_in_force
        self.task = self._make_task(config)
        self.planner = self.task.planner
        link = LinkConfig(config.lead, config.joint_tolerance, config.joint_timeout, config.base_frame)
        self.arm = ArmLink(self, self.planner, link)
        self.paused = False
        self._compute, self._cycles = Durations(), Cycles(1.0 / config.rate)
        self.deadline_misses = 0
        self.on_time_reset()
        self._marker_publisher = self.advertise(MarkerArray, "~/markers", latched())
        self.serve(SetBool, "~/stop", self._stop_requested)
        self.every(1.0 / config.rate, self.plan, MutuallyExclusiveCallbackGroup())
        self.every(1.0 / config.marker_rate, self._publish_markers)
        self.diagnostics = Diagnostics(self, self.report)

    def _make_task(self, config: MpcPlannerConfig) -> PlanningTask:
        try:
            return KINDS[config.kind](self, config)
        except ModuleNotFoundError as error:
            set_to = [f"{name}.strategy = '{search.strategy}'" for name, search in config.searches.items()]
            raise ConfigurationError(
                f"{' or '.join(set_to)} needs the Python package '{error.name}'; install it, or choose a "
                "strategy of this package, such as 'sep-cma'"
            ) from error

    def cleanup(self) -> None:
        """Stop reporting."""
        self.diagnostics.destroy()

    def on_time_reset(self) -> None:
        """Forget what carries a time; the goal stays."""
        self.arm.forget()
        self.task.forget()
        self._cycles.pause()
        self.last: MpcStep = MpcStep(None, "wait", False, "no joint_states yet")
        # Whoever asked for the time may not hold the planner's lock; the next cycle does.
        self._restart = True

    def stop(self) -> None:
        """Brake the arm and see to it that it stops, as far as the controller says what it does."""
        with self._lock:
            self.arm.brake(self.now())
            self.arm.await_stop()

    def plan(self) -> None:
        """Plan once and publish the result if it is ready in time."""
        begin = time.perf_counter()
        with self._lock:
            try:
                self._cycle(begin)
            except Exception as error:
                self._brake_after(error)
                raise  # counted, logged and shown by the caller, which goes on

    def _cycle(self, begin: float) -> None:
        now = self.now()
        if self._restart:
            self._restart = False
            self.planner.reset()
        if not self.active:
            return
        if self.paused or not self._ready(now):
            self._cycles.pause()
            if self.paused:
                self.arm.keep_stopped(now)
            return
        tried = self.task.pending(now)
        self.deadline_misses += self._cycles.begin(now, tried)
        self.arm.check_reference()
        step = self._step(now, begin)
        if step is None:
            return
        took = time.perf_counter() - begin
        if step.iterations > 0:
            self._compute.add(took)
        # Node time as well: a simulation that runs faster than planned for needs its plans earlier.
        if took > self.deadline or self.clock_seconds() > now + self.config.lead - TRANSPORT:
            self.deadline_misses += tried
            self.complaints.add("deadline", f"a plan was ready after {1e3 * took:.1f} ms, too late; dropped")
            return
        self._announce(step)
        self.last = step
        self.arm.execute(step)

    def figures(self) -> dict[str, Any]:
        """Rates, compute times, the plan and the ages of the inputs."""
        step = self.last
        return {
            "rate_hz": f"{self.arm.rate.take():.2f}",
            "cycles": self._cycles.count,
            "skipped_cycles": self._cycles.skipped,
            "deadline_misses": self.deadline_misses,
            "deadline_ms": f"{1e3 * self.deadline:.1f}",
            **self._compute.milliseconds("compute"),
            "mode": "paused" if self.paused else step.mode,
            "valid": step.valid,
            "cost": f"{step.cost:.3f}",
            "iterations": step.iterations,
            **self._ages(self.now()),
        }

    def health(self) -> tuple[int, str]:
        """Whether it plans."""
        step = self.last
        if self.paused:
            return WARN, "stopped by ~/stop; call it with false to resume"
        trouble = self.complaints.recent()
        if self.arm.joints is None:
            return STALE, f"{step.message}; {trouble}" if trouble else step.message
        if step.mode == "wait":
            return STALE, step.message
        if step.mode == "brake":
            return ERROR if step.message.startswith("plan refused") else WARN, step.message
        said = f"{step.message}; {step.warning}" if step.warning else step.message
        return (WARN, trouble or said) if trouble or step.warning else (OK, said)

    def _ages(self, now: float) -> dict[str, str]:
        joints = self.arm.joints
        stamps = {"joint_states": joints.stamp if joints else -math.inf, **self.task.stamps()}
        return {f"age.{name}_s": f"{now - stamp:.3f}" for name, stamp in stamps.items()}

    def _ready(self, now: float) -> bool:
        """Whether the arm's state is known; without it nothing can be published that it could follow."""
        joints = self.arm.joints
        if joints is not None and abs(now - joints.stamp) <= self.config.joint_timeout:
            return True
        age = "none came yet" if joints is None else f"the last is {now - joints.stamp:.2f} s old"
        message = f"no joint_states within {self.config.joint_timeout} s ({age}); not planning"
        if joints is not None:
            self.complaints.add("joint_states_age", message)
        self.last = MpcStep(None, "wait", False, message)
        self.planner.forget_plan()
        return False

    def _step(self, now: float, begin: float) -> MpcStep | None:
        joints = self.arm.joints
        # Where the arm is now rather than when it was measured, or a late message would look like a lost arm.
        position = joints.position + joints.velocity * max(now - joints.stamp, 0.0)
        deadline = begin + max(self.deadline - self.config.reserve, 0.0)
        try:
            return self.task.step(now, position, joints.velocity, deadline)
        except VpstoError as error:
            # A state from which the planner finds no way: what was published last ends in a stop.
            self.complaints.add("planning", f"planning failed: {error}")
            self.last = MpcStep(None, "wait", False, str(error))
            return None

    def _announce(self, step: MpcStep) -> None:
        """Say once when planning begins to fail or works again."""
        if step.mode == "brake" and self.last.mode != "brake":
            self.complaints.add("brake", f"stopping the arm: {step.message}")
        elif self.last.mode == "brake" and step.mode != "brake":
            self.get_logger().info(f"going on: {step.message}")

    def _brake_after(self, error: Exception) -> None:
        """Stop an arm whose planning failed unexpectedly; if that fails too, its last plan ends in a stop."""
        self.last = MpcStep(None, "wait", False, f"internal error: {error}")
        try:
            now = self.now()
            if not self.arm.resting(now):
                self.arm.brake(now)
        except Exception as second:
            self.complaints.add("stop", f"braking failed as well: {second}")

    def _stop_requested(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        with self._lock:
            if request.data and not self.paused:
                self.arm.brake(self.now())
            self.paused = request.data
        response.success = True
        response.message = "stopped; call again with false to resume" if request.data else "planning"
        self.get_logger().info(f"~/stop: {response.message}")
        return response

    def _publish_markers(self) -> None:
        stamp = self.get_clock().now().to_msg()
        make = markers.MarkerFactory(self.config.base_frame, stamp, self.task.surface)
        step, joints = self.last, self.arm.joints
        drawn = [
            make.paths("planned_tool_path", step.tool_path, markers.PLAN),
            make.line("predicted_object_path", step.object_path[:, :2], markers.PREDICTION),
            make.text("status", f"{step.mode}: {step.message}", (0.5, 0.0, 0.6)),
            *self.task.markers(make, step),
        ]
        if joints is not None:
            drawn += self.task.robot_markers(make, joints.position)
        self._marker_publisher.publish(MarkerArray(markers=drawn))


def main(args: list[str] | None = None) -> int:
    """Run the planner; see :func:`vpsto_ros.nodes.lifecycle.run`."""
    return run(MpcPlannerNode, "mpc_planner", args)
