"""The way from a planner to an arm's controller: what was sent, what runs of it, and how it is stopped."""

import dataclasses
import time

import numpy as np
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from vpsto_ros.nodes.diagnostics import Rate
from vpsto_ros.nodes.joint_conversions import read_joint_state, trajectory_message
from vpsto_ros.nodes.lifecycle import ManagedNode, reliable
from vpsto_ros.nodes.sent_plans import AT_REST, JointSample, SentPlans, follows, runs_on, stop_from
from vpsto_ros.planning.running_reference import MpcStep, ReferencePlanner

STOP_PATIENCE = 1.0
"""How long a node that is deactivated waits for the arm to stop [s of wall time]."""


@dataclasses.dataclass(frozen=True)
class LinkConfig:
    """How an arm is spoken to.

    Attributes:
        lead: time between the start of planning and the moment a plan takes over [s].
        joint_tolerance: how far a joint may be from its reference [rad].
        joint_timeout: joint states older than this say nothing [s].
        frame: frame_id of trajectories.
    """

    lead: float
    joint_tolerance: float
    joint_timeout: float
    frame: str


class ArmLink:
    """Sends a planner's motions to a controller, and keeps the planner to what the controller really follows.

    Attributes:
        joints: measured joint state, None before the first.
        rate: how often something was sent.
    """

    def __init__(self, node: ManagedNode, planner: ReferencePlanner, config: LinkConfig) -> None:
        """Open the topics."""
        self._node, self._planner, self._config = node, planner, config
        self._names = planner.robot.joint_names
        self.forget()
        self._publisher = node.advertise(JointTrajectory, "joint_trajectory", reliable(1))
        node.subscribe(JointState, "joint_states", self._receive_joints)
        self._desired_input = node.subscribe(JointState, "desired_joint_states", self._receive_desired)

    def forget(self) -> None:
        """Forget what carries a time."""
        self.joints: JointSample | None = None
        self._desired: JointSample | None = None
        self._reported: JointSample | None = None  # the last one of desired; that is used up
        self._sent = SentPlans()
        self.rate = Rate(lambda: 1e-9 * self._node.get_clock().now().nanoseconds)

    def execute(self, step: MpcStep) -> None:
        """Send a step's trajectory, if it has one, and plan on from it."""
        if step.trajectory is not None:
            self._send(step)
            self._planner.accept(step)

    def check_reference(self) -> None:
        """Plan on from what the controller follows, if it says so and that is not the plan sent last."""
        desired, reference = self._desired, self._planner.reference
        self._desired = None
        if desired is None or reference is None or desired.stamp < reference.start_time:
            return
        if follows(reference, desired):
            return
        running = self._sent.running(desired)
        if running is None:
            self._complain("foreign_motion", "the controller follows a motion that is not this planner's")
            self._planner.reset()
        else:
            self._complain("plan_refused", "the controller did not take the last plan; going on without it")
            self._planner.accept(running)

    def brake(self, now: float) -> None:
        """Send the quickest stop that the arm can still join when the message arrives."""
        if self.joints is None:
            return
        self.check_reference()
        trajectory = self._planner.stop(now + self._config.lead)
        if trajectory is not None:
            self._send(MpcStep(trajectory, "brake", False, "stopped"))

    def resting(self, now: float) -> bool:
        """Whether nothing moves, or will have moved when a plan of now would take over."""
        reference = self._planner.reference
        return reference is None or bool(np.abs(reference(now + self._config.lead, 1)).max() < 1e-6)

    def keep_stopped(self, now: float) -> None:
        """Stop an arm again that moves on: the message that should have stopped it was lost or came late."""
        config, desired = self._config, self._reported
        told = desired is not None and abs(now - desired.stamp) <= config.joint_timeout
        sample = desired if told else self.joints
        if sample is None or abs(now - sample.stamp) > config.joint_timeout:
            return
        if not runs_on(self._planner.reference, sample, None if told else config.joint_tolerance):
            return
        self._complain("stop_lost", "the arm moves on although it was told to stop; braking again")
        self._desired = desired if told else None
        self.check_reference()
        if told and self._planner.reference is not None:
            self.brake(now)
            return
        # Nobody knows which motion that is: stop it from where it will be, later if only measured.
        at = now + config.lead * (1.0 if told else 4.0)
        self.execute(MpcStep(stop_from(sample, self._planner.robot.limits, at), "brake", False, "stopped"))

    def await_stop(self) -> None:
        """Stop the arm again and again until the controller's reference rests, if it says what that is.

        No callback runs meanwhile: what the controller says is taken by hand, and its stamps tell the time.
        A controller that is gone, as when everything is being stopped, is not waited for.
        """
        if self._reported is None or not self._sent:
            return
        give_up = time.monotonic() + STOP_PATIENCE
        while time.monotonic() < give_up:
            time.sleep(0.02)
            if not self._node.count_publishers(self._desired_input.topic_name):
                return
            with self._desired_input.handle:
                taken = self._desired_input.handle.take_message(JointState, False)
            if taken is None:
                continue
            self._receive_desired(taken[0])
            if np.abs(self._reported.velocity).max() < AT_REST:
                return
            self.keep_stopped(self._reported.stamp)
        self._complain("stop", f"the arm was told to stop; {STOP_PATIENCE:g} s later it was not seen to")

    def _send(self, step: MpcStep) -> None:
        time_base, frame = self._node.time_base, self._config.frame
        message = trajectory_message(step.trajectory, self._names, time_base, frame)
        self._sent.add(step)
        self._publisher.publish(message)
        self.rate.tick()

    def _complain(self, kind: str, message: str) -> None:
        self._node.complaints.add(kind, message)

    def _receive_joints(self, message: JointState) -> None:
        position, velocity = read_joint_state(message, self._names)
        self.joints = JointSample(self._node.seconds(message.header.stamp), position, velocity)

    def _receive_desired(self, message: JointState) -> None:
        position, velocity = read_joint_state(message, self._names)
        self._desired = JointSample(self._node.time_base.seconds(message.header.stamp), position, velocity)
        self._reported = self._desired
