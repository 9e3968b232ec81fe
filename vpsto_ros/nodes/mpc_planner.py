"""The node that moves the arm: joint, object and contact states in, joint_trajectory out, at 20 to 50 Hz."""

import math
import threading
import time
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.exceptions import ConfigurationError, VpstoError
from vpsto_ros.nodes import markers
from vpsto_ros.nodes.conversions import read_contact, read_state
from vpsto_ros.nodes.diagnostics import ERROR, OK, STALE, WARN, Cycles, Diagnostics, Durations, Rate
from vpsto_ros.nodes.joint_conversions import read_joint_state, trajectory_message
from vpsto_ros.nodes.lifecycle import ManagedNode, latched, reliable, run
from vpsto_ros.nodes.mpc_planner_config import TRANSPORT, MpcPlannerConfig
from vpsto_ros.nodes.scene import goal_on_table
from vpsto_ros.nodes.sent_plans import AT_REST, JointSample, SentPlans, follows, runs_on, stop_from
from vpsto_ros.planning.contact import ContactPlan
from vpsto_ros.planning.goal import PlanarGoal
from vpsto_ros.planning.pushing import PushingMpc
from vpsto_ros.planning.running_reference import MpcStep
from vpsto_ros.robot.kinematics import fr3_pusher

STOP_PATIENCE = 1.0
"""How long a node that is deactivated waits for the arm to stop [s of wall time]."""
CONTACT_AHEAD = 10.0
"""A contact plan says when the tool can be there; no way takes it longer [s]."""


class MpcPlannerNode(ManagedNode):
    """Runs the pushing planner against the clock and publishes what is ready in time.

    Inputs are stored as they come; the planning timer takes the latest. It has a callback group and a lock of
    its own, so that the node also works in a multi-threaded executor; a single-threaded one makes it faster.
    The service ``~/stop`` (std_srvs/SetBool) brakes the arm and pauses planning with true, and resumes with
    false.
    """

    default_config = MpcPlannerConfig()

    def configure(self, config: MpcPlannerConfig) -> None:
        """Set up the planner, compile its kernels, then topics and timers."""
        self.config = config
        self.robot = fr3_pusher()
        self._lock = threading.Lock()  # guards the planner, which the timer, ~/stop and transitions use
        self.deadline = config.deadline_in_force
        self.planner = self._make_planner(config)
        self.goal: PlanarGoal | None = None
        self.paused = False
        self._compute, self._rate = Durations(), self._node_time_rate()
        self._cycles = Cycles(1.0 / config.rate)
        self.deadline_misses = 0
        self.on_time_reset()
        self._publisher = self.advertise(JointTrajectory, "joint_trajectory", reliable(1))
        self._marker_publisher = self.advertise(MarkerArray, "~/markers", latched())
        self.subscribe(JointState, "joint_states", self._receive_joints)
        self._desired_input = self.subscribe(JointState, "desired_joint_states", self._receive_desired)
        self.subscribe(Odometry, "object_state", self._receive_object)
        self.subscribe(Odometry, "contact_plan", self._receive_contact)
        self.subscribe(PoseStamped, "goal_pose", self._receive_goal)
        self.serve(SetBool, "~/stop", self._stop_requested)
        self.every(1.0 / config.rate, self.plan, MutuallyExclusiveCallbackGroup())
        self.every(1.0 / config.marker_rate, self._publish_markers)
        self.diagnostics = Diagnostics(self, self.report)

    def _make_planner(self, config: MpcPlannerConfig) -> PushingMpc:
        rng = np.random.default_rng(config.seed)
        planner = PushingMpc(config.planner, config.model.model(), self.robot, rng)
        try:
            planner.warm_up()
        except ModuleNotFoundError as error:
            strategy = config.planner.online.search.strategy
            raise ConfigurationError(
                f"planner.online.search.strategy = '{strategy}' needs the Python "
                f"package '{error.name}'; install it, or choose a strategy of this package, such as 'sep-cma'"
            ) from error
        return planner

    def cleanup(self) -> None:
        """Stop reporting."""
        self.diagnostics.destroy()

    def on_time_reset(self) -> None:
        """Forget what carries a time; the goal stays."""
        self.joints: JointSample | None = None
        self.desired: JointSample | None = None
        self._reported: JointSample | None = None  # the last one of desired; that is used up
        self._sent = SentPlans()
        self._cycles.pause()
        self.object: ObjectState | None = None
        self.contact: tuple[float, ContactPlan] | None = None
        self.last: MpcStep = MpcStep(None, "wait", False, "no joint_states yet")
        self._rate = self._node_time_rate()
        # Whoever asked for the time may not hold the planner's lock; the next cycle does.
        self._restart = True

    def stop(self) -> None:
        """Brake the arm and see to it that it stops, as far as the controller says what it does."""
        with self._lock:
            self._brake(self.now())
            if self._reported is not None and self._sent:
                self._await_stop()

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
                self._keep_stopped(now)
            return
        tried = self.goal is not None and self._object_is_fresh(now)
        self.deadline_misses += self._cycles.begin(now, tried)
        self._check_reference()
        step = self._step(now, begin)
        if step is None:
            return
        took = time.perf_counter() - begin
        if step.iterations > 0:
            self._compute.add(took)
        # Node time as well: a simulation that runs faster than planned for needs its plans earlier.
        if took > self.deadline or self._now() > now + self.config.planner.lead - TRANSPORT:
            self.deadline_misses += tried
            self.complaints.add("deadline", f"a plan was ready after {1e3 * took:.1f} ms, too late; dropped")
            return
        self._execute(step)

    def _object_is_fresh(self, now: float) -> bool:
        return self.object is not None and now - self.object.stamp <= self.config.planner.object_timeout

    def figures(self) -> dict[str, Any]:
        """Rates, compute times, the plan and the ages of the inputs."""
        step = self.last
        return {
            "rate_hz": f"{self._rate.take():.2f}",
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
        if self.joints is None or step.mode == "wait":
            return STALE, step.message
        trouble = self.complaints.recent()
        if step.mode == "brake":
            return ERROR if step.message.startswith("plan refused") else WARN, step.message
        return (WARN, trouble) if trouble else (OK, step.message)

    def _ages(self, now: float) -> dict[str, str]:
        stamps = {
            "joint_states": self.joints.stamp if self.joints else -math.inf,
            "object_state": self.object.stamp if self.object else -math.inf,
            "contact_plan": self.contact[0] if self.contact else -math.inf,
        }
        return {f"age.{name}_s": f"{now - stamp:.3f}" for name, stamp in stamps.items()}

    def _ready(self, now: float) -> bool:
        """Whether the arm's state is known; without it nothing can be published that it could follow."""
        joints = self.joints
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
        config, joints = self.config, self.joints
        # Where the arm is now rather than when it was measured, or a late message would look like a lost arm.
        position = joints.position + joints.velocity * max(now - joints.stamp, 0.0)
        contact = self.contact
        fresh = contact is not None and now - contact[0] <= config.contact_timeout
        deadline = begin + max(self.deadline - config.reserve, 0.0)
        inputs = (now, position, joints.velocity, self.object, self.goal, contact[1] if fresh else None)
        try:
            return self.planner.step(*inputs, deadline=deadline)
        except VpstoError as error:
            # A state from which the planner finds no way: what was published last ends in a stop.
            self.complaints.add("planning", f"planning failed: {error}")
            self.last = MpcStep(None, "wait", False, str(error))
            return None

    def _execute(self, step: MpcStep) -> None:
        self._announce(step)
        self.last = step
        if step.trajectory is not None:
            self._send(step)
            self.planner.accept(step)

    def _check_reference(self) -> None:
        """Plan on from what the controller follows, if it says so and that is not the plan sent last."""
        desired, reference = self.desired, self.planner.reference
        self.desired = None
        if desired is None or reference is None or desired.stamp < reference.start_time:
            return
        if follows(reference, desired):
            return
        running = self._sent.running(desired)
        if running is None:
            self.complaints.add(
                "foreign_motion", "the controller follows a motion that is not this planner's"
            )
            self.planner.reset()
        else:
            self.complaints.add(
                "plan_refused", "the controller did not take the last plan; going on without it"
            )
            self.planner.accept(running)

    def _send(self, step: MpcStep) -> None:
        names, frame = self.robot.joint_names, self.config.base_frame
        message = trajectory_message(step.trajectory, names, self.time_base, frame)
        self._sent.add(step)
        self._publisher.publish(message)
        self._rate.tick()

    def _announce(self, step: MpcStep) -> None:
        """Say once when planning begins to fail or works again."""
        if step.mode == "brake" and self.last.mode != "brake":
            self.complaints.add("brake", f"stopping the arm: {step.message}")
        elif self.last.mode == "brake" and step.mode != "brake":
            self.get_logger().info(f"going on: {step.message}")

    def _brake(self, now: float) -> None:
        """Send the quickest stop that the arm can still join when the message arrives."""
        if self.joints is None:
            return
        self._check_reference()
        trajectory = self.planner.stop(now + self.config.planner.lead)
        if trajectory is not None:
            self._send(MpcStep(trajectory, "brake", False, "stopped"))

    def _brake_after(self, error: Exception) -> None:
        """Stop an arm whose planning failed unexpectedly; if that fails too, its last plan ends in a stop."""
        self.last = MpcStep(None, "wait", False, f"internal error: {error}")
        try:
            now = self.now()
            if self.planner.reference is not None and not self._resting(now):
                self._brake(now)
        except Exception as second:
            self.complaints.add("stop", f"braking failed as well: {second}")

    def _resting(self, now: float) -> bool:
        return bool(np.abs(self.planner.reference(now + self.config.planner.lead, 1)).max() < 1e-6)

    def _keep_stopped(self, now: float) -> None:
        """Stop an arm again that moves on: the message that should have stopped it was lost or came late."""
        config, desired, joints = self.config, self._reported, self.joints
        told = desired is not None and abs(now - desired.stamp) <= config.joint_timeout
        sample = desired if told else joints
        if sample is None or abs(now - sample.stamp) > config.joint_timeout:
            return
        tolerance = None if told else config.planner.joint_tolerance
        if not runs_on(self.planner.reference, sample, tolerance):
            return
        self.complaints.add("stop_lost", "the arm moves on although it was told to stop; braking again")
        self.desired = desired if told else None
        self._check_reference()
        if told and self.planner.reference is not None:
            self._brake(now)
            return
        # Nobody knows which motion that is: stop it from where it will be, later if only measured.
        at = now + config.planner.lead * (1.0 if told else 4.0)
        step = MpcStep(stop_from(sample, self.robot.limits, at), "brake", False, "stopped")
        self._send(step)
        self.planner.accept(step)

    def _await_stop(self) -> None:
        """Stop the arm again and again until the controller's reference rests.

        No callback runs meanwhile: what the controller says is taken by hand, and its stamps tell the time.
        """
        give_up = time.monotonic() + STOP_PATIENCE
        while time.monotonic() < give_up:
            time.sleep(0.02)
            with self._desired_input.handle:
                taken = self._desired_input.handle.take_message(JointState, False)
            if taken is None:
                continue
            self._receive_desired(taken[0])
            if np.abs(self._reported.velocity).max() < AT_REST:
                return
            self._keep_stopped(self._reported.stamp)
        self.complaints.add("stop", f"the arm was told to stop; {STOP_PATIENCE:g} s later it was not seen to")

    def _stop_requested(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        with self._lock:
            if request.data and not self.paused:
                self._brake(self.now())
            self.paused = request.data
        response.success = True
        response.message = "stopped; call again with false to resume" if request.data else "planning"
        self.get_logger().info(f"~/stop: {response.message}")
        return response

    def _receive_joints(self, message: JointState) -> None:
        position, velocity = read_joint_state(message, self.robot.joint_names)
        self.joints = JointSample(self.seconds(message.header.stamp), position, velocity)

    def _receive_desired(self, message: JointState) -> None:
        position, velocity = read_joint_state(message, self.robot.joint_names)
        self.desired = JointSample(self.time_base.seconds(message.header.stamp), position, velocity)
        self._reported = self.desired

    def _receive_object(self, message: Odometry) -> None:
        self.seconds(message.header.stamp)
        self.object = read_state(message, self.time_base, self.config.base_frame)

    def _receive_contact(self, message: Odometry) -> None:
        self.seconds(message.header.stamp, CONTACT_AHEAD)
        plan = read_contact(message, self.time_base, self.config.base_frame)
        self.contact = (self._now(), plan)

    def _receive_goal(self, message: PoseStamped) -> None:
        config = self.config
        self.goal = goal_on_table(
            message, config.base_frame, config.goal_orientation, config.planner.workspace
        )

    def _publish_markers(self) -> None:
        make = markers.MarkerFactory(self.config.base_frame, self.get_clock().now().to_msg())
        step, shape = self.last, self.planner.model.shape
        drawn = [
            make.line("planned_tool_path", step.tool_path, markers.PLAN),
            make.line("predicted_object_path", step.object_path[:, :2], markers.PREDICTION),
            make.shape("object", shape, None if self.object is None else self.object.pose, markers.ESTIMATE),
            make.text("status", f"{step.mode}: {step.message}", (0.5, 0.0, 0.6)),
        ]
        if self.goal is not None:
            pose = np.append(self.goal.position, self.goal.yaw or 0.0)
            drawn.append(make.shape("goal", shape, pose, markers.GOAL))
        if self.joints is not None:
            drawn.append(make.line("robot", markers.arm_points(self.joints.position), markers.ROBOT, 0.03))
        self._marker_publisher.publish(MarkerArray(markers=drawn))

    def _now(self) -> float:
        return self.time_base.seconds(self.get_clock().now().to_msg())

    def _node_time_rate(self) -> Rate:
        return Rate(lambda: 1e-9 * self.get_clock().now().nanoseconds)


def main(args: list[str] | None = None) -> int:
    """Run the planner; see :func:`vpsto_ros.nodes.lifecycle.run`."""
    return run(MpcPlannerNode, "mpc_planner", args)
