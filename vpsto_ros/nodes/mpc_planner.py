"""The node that moves the arm: joint, object and contact states in, joint_trajectory out, at 20 to 50 Hz."""

import dataclasses
import math
import threading
import time

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from vpsto_ros.configuration import option, validate
from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.exceptions import VpstoError
from vpsto_ros.nodes import markers
from vpsto_ros.nodes.conversions import read_contact, read_state
from vpsto_ros.nodes.diagnostics import ERROR, OK, STALE, WARN, Diagnostics, Durations, Rate, Report
from vpsto_ros.nodes.joint_conversions import read_joint_state, trajectory_message
from vpsto_ros.nodes.lifecycle import ManagedNode, NodeConfig, latched, reliable, run
from vpsto_ros.nodes.scene import ModelConfig, goal_on_table
from vpsto_ros.nodes.sent_plans import JointSample, SentPlans, follows
from vpsto_ros.planning.contact import ContactPlan
from vpsto_ros.planning.goal import PlanarGoal
from vpsto_ros.planning.pushing import MpcStep, PushingMpc, PushingMpcConfig
from vpsto_ros.robot.kinematics import fr3_pusher

TRANSPORT = 0.004
"""What is left at least for the way from here to the controller [s]."""


@dataclasses.dataclass(frozen=True)
class MpcPlannerConfig(NodeConfig):
    """Parameters of the planner."""

    rate: float = option(20.0, "planning rate", unit="Hz", minimum=1.0, maximum=50.0)
    deadline: float = option(
        0.035,
        "a plan not ready so long after the start of its cycle is dropped",
        unit="s",
        minimum=0.002,
        maximum=1.0,
    )
    reserve: float = option(
        0.006,
        "part of the deadline that is kept for what follows the search",
        unit="s",
        minimum=0.0,
        maximum=0.5,
    )
    joint_timeout: float = option(
        0.1, "nothing is published when joint_states are older", unit="s", minimum=0.02, maximum=10.0
    )
    contact_timeout: float = option(
        0.5, "a contact_plan received longer ago is not used", unit="s", minimum=0.02, maximum=10.0
    )
    goal_orientation: str = option("ignore", "whether the yaw of goal_pose counts", choices=("ignore", "use"))
    marker_rate: float = option(10.0, "rate of ~/markers", unit="Hz", minimum=0.1, maximum=50.0)
    seed: int = option(0, "seed of the search", minimum=0)
    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    planner: PushingMpcConfig = dataclasses.field(default_factory=PushingMpcConfig)

    def __post_init__(self) -> None:
        validate(self)


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
        self.planner = PushingMpc(
            config.planner, config.model.model(), self.robot, np.random.default_rng(config.seed)
        )
        self.planner.warm_up()
        self.goal: PlanarGoal | None = None
        self.paused = False
        self._compute, self._rate, self._cycles = Durations(), self._node_time_rate(), 0
        self.deadline_misses = 0
        self.on_time_reset()
        self._publisher = self.advertise(JointTrajectory, "joint_trajectory", reliable(1))
        self._marker_publisher = self.advertise(MarkerArray, "~/markers", latched())
        self.subscribe(JointState, "joint_states", self._receive_joints)
        self.subscribe(JointState, "desired_joint_states", self._receive_desired)
        self.subscribe(Odometry, "object_state", self._receive_object)
        self.subscribe(Odometry, "contact_plan", self._receive_contact)
        self.subscribe(PoseStamped, "goal_pose", self._receive_goal)
        self.serve(SetBool, "~/stop", self._stop_requested)
        self.every(1.0 / config.rate, self.plan, MutuallyExclusiveCallbackGroup())
        self.every(1.0 / config.marker_rate, self._publish_markers)
        self.diagnostics = Diagnostics(self, self.report)

    def cleanup(self) -> None:
        """Stop reporting."""
        self.diagnostics.destroy()

    def on_time_reset(self) -> None:
        """Forget what carries a time; the goal stays."""
        self.joints: JointSample | None = None
        self.desired: JointSample | None = None
        self._sent = SentPlans()
        self.object: ObjectState | None = None
        self.contact: tuple[float, ContactPlan] | None = None
        self.last: MpcStep = MpcStep(None, "wait", False, "no joint_states yet")
        self._rate = self._node_time_rate()
        # Whoever asked for the time may not hold the planner's lock; the next cycle does.
        self._restart = True

    def stop(self) -> None:
        """Brake the arm."""
        with self._lock:
            self._brake()

    def plan(self) -> None:
        """Plan once and publish the result if it is ready in time."""
        begin = time.perf_counter()
        with self._lock:
            now = self.now()
            if self._restart:
                self._restart = False
                self.planner.reset()
            if self.paused or not self.active or not self._ready(now):
                return
            self._check_reference()
            step = self._step(now, begin)
            if step is None:
                return
            took = time.perf_counter() - begin
            self._cycles += 1
            if step.iterations > 0:
                self._compute.add(took)
            # Node time as well: a simulation that runs faster than planned for needs its plans earlier.
            if took > self.config.deadline or self._now() > now + self.config.planner.lead - TRANSPORT:
                self.deadline_misses += 1
                self.complaints.add(
                    "deadline", f"a plan was ready after {1e3 * took:.1f} ms, too late; dropped"
                )
                return
            self._execute(step)

    def report(self) -> Report:
        """The present diagnostics."""
        now, step = self.now(), self.last
        values = {
            "rate_hz": f"{self._rate.take():.2f}",
            "cycles": self._cycles,
            "deadline_misses": self.deadline_misses,
            **self._compute.milliseconds("compute"),
            "mode": "paused" if self.paused else step.mode,
            "valid": step.valid,
            "cost": f"{step.cost:.3f}",
            "iterations": step.iterations,
            **self._ages(now),
            **self.complaints.values(),
        }
        level, message = self._health(step)
        return Report(level, message, values)

    def _health(self, step: MpcStep) -> tuple[int, str]:
        if not self.active:
            return OK, "inactive"
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
        self.planner.online.accept(None)
        return False

    def _step(self, now: float, begin: float) -> MpcStep | None:
        config, joints = self.config, self.joints
        # Where the arm is now rather than when it was measured, or a late message would look like a lost arm.
        position = joints.position + joints.velocity * max(now - joints.stamp, 0.0)
        contact = self.contact
        fresh = contact is not None and now - contact[0] <= config.contact_timeout
        deadline = begin + max(config.deadline - config.reserve, 0.0)
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

    def _brake(self) -> None:
        """Send the quickest stop that the arm can still join when the message arrives."""
        if self.joints is None:
            return
        trajectory = self.planner.stop(self.now() + self.config.planner.lead)
        if trajectory is not None:
            self._send(MpcStep(trajectory, "brake", False, "stopped"))

    def _stop_requested(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        with self._lock:
            if request.data and not self.paused:
                self._brake()
            self.paused = request.data
        response.success = True
        response.message = "stopped; call again with false to resume" if request.data else "planning"
        self.get_logger().info(f"~/stop: {response.message}")
        return response

    def _receive_joints(self, message: JointState) -> None:
        position, velocity = read_joint_state(message, self.robot.joint_names)
        self.joints = JointSample(self.time_base.seconds(message.header.stamp), position, velocity)

    def _receive_desired(self, message: JointState) -> None:
        position, velocity = read_joint_state(message, self.robot.joint_names)
        self.desired = JointSample(self.time_base.seconds(message.header.stamp), position, velocity)

    def _receive_object(self, message: Odometry) -> None:
        self.object = read_state(message, self.time_base, self.config.base_frame)

    def _receive_contact(self, message: Odometry) -> None:
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
    return run(lambda: MpcPlannerNode("mpc_planner"), args)
