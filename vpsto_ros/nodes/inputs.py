"""Inputs that several nodes share: each subscribes to a topic, checks what comes and keeps the latest."""

import math

import numpy as np
from geometry_msgs.msg import PoseArray, PoseStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray

from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.nodes.contact_conversions import EffectorContact, gather_contacts, read_effector_contact
from vpsto_ros.nodes.conversions import read_belief, read_goal
from vpsto_ros.nodes.lifecycle import ManagedNode
from vpsto_ros.nodes.robots import BeliefModelConfig
from vpsto_ros.planning.belief_space.mpc import PlannedContact, StampedBelief
from vpsto_ros.planning.belief_space.targets import GoalTarget
from vpsto_ros.planning.goal import PlanarGoal

CONTACT_AHEAD = 10.0
"""A contact plan says when the tool can be there; no way takes it longer [s]."""


class GoalInput:
    """The latest goal on goal_pose that lies where the object may go.

    Attributes:
        latest: None before the first; the same instance for as long as the goal is the same, so that a
            planner can tell a new goal from a repeated one.
    """

    def __init__(
        self,
        node: ManagedNode,
        frame: str,
        x: tuple[float, float],
        y: tuple[float, float],
        *,
        orientation: bool = False,
    ) -> None:
        """Listen.

        Args:
            node: that listens.
            frame: the base frame.
            x: where the object may go [m].
            y: likewise.
            orientation: whether the yaw of a goal counts.
        """
        self._frame, self._x, self._y, self._orientation = frame, x, y, orientation
        self.latest: PlanarGoal | None = None
        node.subscribe(PoseStamped, "goal_pose", self.receive)

    def receive(self, message: PoseStamped) -> None:
        """Take a goal.

        Raises:
            InvalidInputError: wrong frame, broken numbers, or a goal off the table or out of reach.
        """
        goal = read_goal(message, self._frame, orientation=self._orientation)
        x, y = goal.position
        if not (self._x[0] <= x <= self._x[1] and self._y[0] <= y <= self._y[1]):
            raise InvalidInputError(
                f"the goal ({x:.3f}, {y:.3f}) m is out of reach or off the table; allowed are "
                f"x from {self._x[0]} to {self._x[1]} and y from {self._y[0]} to {self._y[1]} m; the "
                "previous goal stays"
            )
        last = self.latest
        if last is None or goal.yaw != last.yaw or not np.array_equal(goal.position, last.position):
            self.latest = goal


class TargetInput(GoalInput):
    """The same as a target of robust pushing."""

    def __init__(self, node: ManagedNode, frame: str, x: tuple[float, float], y: tuple[float, float]) -> None:
        """Listen; see :class:`GoalInput`."""
        super().__init__(node, frame, x, y)
        self._made: tuple[PlanarGoal, GoalTarget] | None = None

    @property
    def target(self) -> GoalTarget | None:
        """The target, the same instance for as long as the goal is the same."""
        goal = self.latest
        if goal is None:
            return None
        if self._made is None or self._made[0] is not goal:
            self._made = (goal, GoalTarget(goal.position))
        return self._made[1]


class BeliefInput:
    """The latest hypotheses on object_belief.

    A message says where the object may be. Its friction and its centre of friction, which pushing depends on
    as well, have no place in it and are drawn when it comes.

    Attributes:
        latest: None before the first.
    """

    def __init__(
        self, node: ManagedNode, frame: str, model: BeliefModelConfig, rng: np.random.Generator
    ) -> None:
        """Listen."""
        self._node, self._frame, self._model, self._rng = node, frame, model, rng
        self.forget()
        node.subscribe(PoseArray, "object_belief", self.receive)

    def forget(self) -> None:
        """Forget the belief."""
        self.latest: StampedBelief | None = None

    @property
    def stamp(self) -> float:
        """When the latest belief is of [s], -inf without one."""
        return -math.inf if self.latest is None else self.latest.stamp

    def receive(self, message: PoseArray) -> None:
        """Take hypotheses.

        Raises:
            InvalidInputError: wrong frame, broken numbers, fewer than two poses, or a stamp in the future.
        """
        stamp = self._node.seconds(message.header.stamp)
        poses = read_belief(message, self._frame)
        if len(poses) < 2:
            raise InvalidInputError(
                f"a belief of {len(poses)} pose{'' if len(poses) == 1 else 's'} says nothing about what is "
                "uncertain; send two or more (belief_samples of state_estimator)"
            )
        self.latest = StampedBelief(stamp, ObjectBelief(poses, *self._model.draw(len(poses), self._rng)))


class ContactInput:
    """Where end effectors shall touch: the latest contact_plan of each, used if all are of one plan.

    Attributes:
        received: when the latest came [s], -inf before the first.
    """

    def __init__(
        self, node: ManagedNode, frame: str, effectors: EndEffectors, tool_frames: tuple[str, ...],
        belief: BeliefInput,
    ) -> None:  # fmt: skip
        """Listen; `belief` says where the object was when a plan came."""
        self._node, self._frame, self._effectors, self._tool_frames = node, frame, effectors, tool_frames
        self._belief = belief
        self.forget()
        node.subscribe(Odometry, "contact_plan", self.receive)

    def forget(self) -> None:
        """Forget all plans."""
        self.received = -math.inf
        self._plans: dict[str, EffectorContact] = {}
        self._place: NDArray | None = None

    def receive(self, message: Odometry) -> None:
        """Take the plan of one end effector.

        Raises:
            InvalidInputError: wrong frame, an end effector that the robot does not have, broken numbers, a
                covariance that is none, or a stamp in the far future.
        """
        self._node.seconds(message.header.stamp, CONTACT_AHEAD)
        plan = read_effector_contact(
            message, self._node.time_base, self._frame, self._effectors, self._tool_frames
        )
        self._plans[plan.tool] = plan
        known = self._belief.latest
        self._place = None if known is None else known.belief.mean[:2]
        self.received = self._node.clock_seconds()

    def fresh(self, now: float, timeout: float) -> PlannedContact | None:
        """The contact of all end effectors; None if one is missing or all are old."""
        if now - self.received > timeout or self._place is None:
            return None
        gathered = gather_contacts(self._plans, self._effectors, self._tool_frames)
        return None if gathered is None else PlannedContact(*gathered, self._place)
