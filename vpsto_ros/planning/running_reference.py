"""What every planner that replans while the arm moves needs: the reference that the arm follows.

A new plan takes over a moment after planning began; until then the arm goes on with the old one, and the
published trajectory begins with what is left of it.
"""

import abc
import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InfeasibleError, VpstoError
from vpsto_ros.planning.stitching import extended, resting
from vpsto_ros.robot.kinematics import Robot
from vpsto_ros.trajectory import Trajectory, braking_trajectory

AT_REST = 0.02
"""Joint speed below which the arm counts as standing [rad/s]."""
_OFFSET_GAIN = 0.3  # of the low-pass of the tools' offset, per cycle


@dataclasses.dataclass(frozen=True)
class MpcStep:
    """Outcome of one planning step.

    Attributes:
        trajectory: joint trajectory in absolute time, to replace what is being executed, or None when there
            is nothing to execute. It begins
            with what is left of the running one until the new plan takes over and ends at rest.
        mode: "explore", "warm_start", "stop" (no via-points), "robust", "deterministic" (what robust pushing
            plans), "hold" (goal reached), "follow" (what runs goes on), "return" (on the way home),
            "brake" (no valid plan), "enter" (on the way into the plane), "wait" (not ready).
        valid: whether it is a plan that works, as opposed to a safe stop.
        message: what happened, in words, for people.
        cost: cost of the plan [s], inf without one.
        tool_path: planned plane coordinates of the tools, shape (K, 2) [m]; (K, 4) for two.
        object_path: predicted object poses, shape (K, 3).
        iterations: iterations of the search.
        plane: solution in the plane, for the next warm start.
        ready_at: nothing is planned before this time [s].
        warning: what works less well than it should, in words, if anything.
        refused: whether what was asked for cannot be done, so that something else should be asked for.
        spread: standard deviation of the predicted object position, shape (K,) [m], if it was predicted.
    """

    trajectory: Trajectory | None
    mode: str
    valid: bool
    message: str
    cost: float = np.inf
    tool_path: NDArray = dataclasses.field(default_factory=lambda: np.zeros((0, 2)))
    object_path: NDArray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    iterations: int = 0
    plane: Trajectory | None = None
    ready_at: float = -np.inf
    spread: NDArray = dataclasses.field(default_factory=lambda: np.zeros(0))
    warning: str = ""
    refused: bool = False


class ReferencePlanner(abc.ABC):
    """Keeps the reference that is being followed, joins new motions to it, and stops it.

    Attributes:
        robot: the arm.
        reference: what is being followed, None before anything is.
        ready_at: nothing is planned before this time [s].
        tool_offset: where the tools are relative to their reference in plane coordinates, low-passed, (m,).
    """

    def __init__(self, robot: Robot, dof: int, lead: float, joint_tolerance: float, memory: float) -> None:
        """Nothing is being followed yet.

        Args:
            robot: the arm.
            dof: number of plane coordinates m.
            lead: time between the start of planning and the moment a plan takes over [s].
            joint_tolerance: how far a joint may be from its reference [rad].
            memory: how far back the reference is kept [s].
        """
        self.robot = robot
        self._dof = dof
        self._lead, self._joint_tolerance, self._memory = lead, joint_tolerance, memory
        self.reference: Trajectory | None = None
        self.ready_at = -np.inf
        self.tool_offset = np.zeros(dof)

    @abc.abstractmethod
    def _tool(self, q: ArrayLike) -> NDArray[np.float64]:
        """Plane coordinates (..., m) of the tools for joint positions (..., n)."""

    @abc.abstractmethod
    def _brake(self, takeover: float, position: NDArray, velocity: NDArray) -> Trajectory:
        """From a joint state on: to rest in the plane, at constant deceleration.

        Raises:
            InfeasibleError: the joints cannot follow.
        """

    def reset(self) -> None:
        """Forget everything about the running motion, as after a restart of the robot's driver."""
        self.reference = None
        self.ready_at = -np.inf
        self.tool_offset = np.zeros(self._dof)
        self.forget_plan()

    @abc.abstractmethod
    def forget_plan(self) -> None:
        """Do not warm-start from the last plan."""

    def accept(self, step: MpcStep) -> None:
        """Take note that a step's trajectory is being executed."""
        if step.trajectory is not None:
            self.reference = self._with_past(step.trajectory)
            self.ready_at = step.ready_at

    def stop(self, now: float) -> Trajectory | None:
        """The quickest stop within the joint limits, to be executed at once; None if nothing moves."""
        if self.reference is None:
            return None
        position, velocity, _ = self.reference.state(now)
        self.forget_plan()
        brake = extended(braking_trajectory(position, velocity, self.robot.limits, start_time=now), now + 0.5)
        self.reference = self._with_past(brake)
        return brake

    @property
    def _running(self) -> Trajectory:
        """The reference that is being followed, once there is one."""
        if self.reference is None:
            raise VpstoError("the planner has not taken over an arm yet")
        return self.reference

    def _lost(self, now: float, joint_position: NDArray) -> bool:
        """Whether the arm is not where the running reference says."""
        if self.reference is None:
            return True
        return bool(np.abs(self.reference(now) - joint_position).max() > self._joint_tolerance)

    def _reference_moves(self, now: float) -> bool:
        return self.reference is not None and np.abs(self.reference(now + self._lead, 1)).max() > 1e-6

    def _observe_offset(self, now: float, joint_position: NDArray) -> NDArray:
        """Offset of the tools from their reference, (m,), noted low-passed: under load arms lag a little."""
        offset = self._tool(joint_position) - self._tool(self._running(now))
        self.tool_offset = self.tool_offset + _OFFSET_GAIN * (offset - self.tool_offset)
        return offset

    def _stop(self, now: float, mode: str, message: str, *, valid: bool = False) -> MpcStep:
        """Come to rest: in the plane, or as fast as the joints can where that is infeasible."""
        takeover = now + self._lead
        position, velocity, _ = self._running.state(takeover)
        if np.abs(velocity).max() < 1e-6:
            joints = resting(position, takeover, takeover + 0.5)
        else:
            try:
                joints = self._brake(takeover, position, velocity)
            except InfeasibleError:
                joints = braking_trajectory(position, velocity, self.robot.limits, start_time=takeover)
        return MpcStep(self._joined(now, joints), mode, valid, message)

    def _with_past(self, trajectory: Trajectory) -> Trajectory:
        """A trajectory preceded by what was executed before it, as far back as an object state may date."""
        if self.reference is None or self.reference.start_time >= trajectory.start_time:
            return trajectory
        begin = max(self.reference.start_time, trajectory.start_time - self._memory)
        past = extended(self.reference, trajectory.start_time).clipped(begin, trajectory.start_time)
        return past.followed_by(trajectory)

    def _joined(self, now: float, joints: Trajectory) -> Trajectory:
        """The running reference until the new motion takes over, then the new motion."""
        running = extended(self._running, joints.start_time)
        begin = max(now, running.start_time)
        if joints.start_time - begin < 1e-6:
            return joints
        return running.clipped(begin, joints.start_time).followed_by(joints)
