"""What the node that moves the arm asks of a task: its inputs from topics, a planning step, what to draw."""

from typing import Protocol

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from visualization_msgs.msg import Marker

from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.nodes import markers
from vpsto_ros.nodes.conversions import read_contact, read_state
from vpsto_ros.nodes.inputs import CONTACT_AHEAD, GoalInput
from vpsto_ros.nodes.lifecycle import ManagedNode
from vpsto_ros.nodes.mpc_planner_config import MpcPlannerConfig
from vpsto_ros.planning.contact import ContactPlan
from vpsto_ros.planning.pushing import PushingMpc
from vpsto_ros.planning.running_reference import MpcStep, ReferencePlanner
from vpsto_ros.robot.kinematics import fr3_pusher
from vpsto_ros.robot.tool_plane import ToolPlane


class PlanningTask(Protocol):
    """Inputs of one kind of planner. They are stored as they come; a step takes the latest."""

    @property
    def planner(self) -> ReferencePlanner:
        """What plans; its kernels are compiled."""

    @property
    def surface(self) -> float:
        """Height of the table, on which is drawn, base frame [m]."""

    def forget(self) -> None:
        """Forget what carries a time; the goal stays."""

    def pending(self, now: float) -> bool:
        """Whether there is something to plan: a goal, and fresh knowledge of the object."""

    def step(self, now: float, position: NDArray, velocity: NDArray, deadline: float) -> MpcStep:
        """Plan once, see for example :meth:`PushingMpc.step`."""

    def stamps(self) -> dict[str, float]:
        """When the latest input of each topic is of, -inf without one [s]."""

    def robot_markers(self, make: markers.MarkerFactory, position: NDArray) -> list[Marker]:
        """The robot at joint positions (n,) [rad]."""

    def markers(self, make: markers.MarkerFactory, step: MpcStep) -> list[Marker]:
        """What to draw besides plan, robot and status."""


class OnTable:
    """What tasks with tools above a table at the robot's foot share.

    Attributes:
        tools: their plane.
    """

    surface = 0.0
    tools: ToolPlane

    def robot_markers(self, make: markers.MarkerFactory, position: NDArray) -> list[Marker]:
        """The arms at joint positions (n,) [rad]."""
        return make.robot(self.tools, position)


class PushingTask(OnTable):
    """The rod pushes an object of which object_state says where it is to goal_pose."""

    def __init__(self, node: ManagedNode, config: MpcPlannerConfig) -> None:
        """Set up the planner and listen."""
        self._node, self._config = node, config
        rng = np.random.default_rng(config.seed)
        self.planner = PushingMpc(config.planner, config.model.model(), fr3_pusher(), rng)
        self.planner.warm_up()
        self.tools = self.planner.table_map
        space = config.planner.workspace
        with_yaw = config.goal_orientation == "use"
        self.goal = GoalInput(
            node, config.base_frame, space.object_x, space.object_y, orientation=with_yaw
        )
        self.forget()
        node.subscribe(Odometry, "object_state", self._receive_object)
        node.subscribe(Odometry, "contact_plan", self._receive_contact)

    def forget(self) -> None:
        """Forget what carries a time; the goal stays."""
        self.object: ObjectState | None = None
        self.contact: tuple[float, ContactPlan] | None = None

    def pending(self, now: float) -> bool:
        """Whether there is a goal and a fresh state of the object."""
        timeout, known = self._config.planner.object_timeout, self.object
        return self.goal.latest is not None and known is not None and now - known.stamp <= timeout

    def step(self, now: float, position: NDArray, velocity: NDArray, deadline: float) -> MpcStep:
        """Plan once."""
        contact = self.contact
        fresh = contact is not None and now - contact[0] <= self._config.contact_timeout_in_force
        inputs = (now, position, velocity, self.object, self.goal.latest, contact[1] if fresh else None)
        return self.planner.step(*inputs, deadline=deadline)

    def stamps(self) -> dict[str, float]:
        """When the inputs are of."""
        return {
            "object_state": self.object.stamp if self.object else -np.inf,
            "contact_plan": self.contact[0] if self.contact else -np.inf,
        }

    def markers(self, make: markers.MarkerFactory, step: MpcStep) -> list[Marker]:
        """The object as it is estimated, and its goal."""
        shape, known, goal = self.planner.model.shape, self.object, self.goal.latest
        drawn = [make.shape("object", shape, None if known is None else known.pose, markers.ESTIMATE)]
        if goal is not None:
            drawn.append(make.shape("goal", shape, np.append(goal.position, goal.yaw or 0.0), markers.GOAL))
        return drawn

    def _receive_object(self, message: Odometry) -> None:
        self._node.seconds(message.header.stamp)
        self.object = read_state(message, self._node.time_base, self._config.base_frame)

    def _receive_contact(self, message: Odometry) -> None:
        self._node.seconds(message.header.stamp, CONTACT_AHEAD)
        plan = read_contact(message, self._node.time_base, self._config.base_frame)
        self.contact = (self._node.clock_seconds(), plan)
