"""What the contact planner plans for: one tool and an estimated object, or several and a belief over it."""

from typing import Protocol

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from visualization_msgs.msg import Marker

from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.nodes import markers
from vpsto_ros.nodes.contact_conversions import contact_messages
from vpsto_ros.nodes.contact_planner_config import ContactPlannerNodeConfig
from vpsto_ros.nodes.conversions import contact_message, read_state
from vpsto_ros.nodes.inputs import BeliefInput, GoalInput, TargetInput
from vpsto_ros.nodes.lifecycle import ManagedNode
from vpsto_ros.nodes.robots import BeliefModelConfig, contact_rule
from vpsto_ros.planning.belief_space.contact_plan import RobustContactPlan, RobustContactPlanner
from vpsto_ros.planning.belief_space.targets import GoalTarget
from vpsto_ros.planning.contact import ContactPlan, PushContactPlanner
from vpsto_ros.planning.goal import PlanarGoal


class ContactTask(Protocol):
    """Inputs of one kind of contact planner, and its plans as messages."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the robot's joints."""

    @property
    def surface(self) -> float:
        """Height of the table, on which is drawn, base frame [m]."""

    def forget(self) -> None:
        """Forget what carries a time; the goal stays."""

    def missing(self, now: float, limit: float) -> str:
        """What keeps it from planning, empty if nothing does; inputs older than a limit [s] do not count."""

    def plan(self, now: float, joints: NDArray) -> list[Odometry]:
        """Where each end effector shall touch, given the robot's joint positions (n,) [rad]."""

    def withdraw(self) -> list[Odometry]:
        """What takes the last plan back when no other can be made; nothing where it stays right."""

    def status(self) -> str:
        """What the last plan is, in words; empty where there is nothing to say."""

    def markers(self, make: markers.MarkerFactory) -> list[Marker]:
        """The last plan, empty before the first."""


class OnTable:
    """What tasks with tools above a table at the robot's foot share."""

    surface = 0.0

    def __init__(self, config: ContactPlannerNodeConfig) -> None:
        """Find the tools."""
        self._tools = config.robot.plane()

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the robot's joints."""
        return self._tools.robot.joint_names

    def withdraw(self) -> list[Odometry]:
        """Nothing: pushing on at the place of the last plan does no harm."""
        return []

    def status(self) -> str:
        """Nothing to say."""
        return ""


class PushingContacts(OnTable):
    """The rod and an object of which object_state says where it is."""

    def __init__(self, node: ManagedNode, config: ContactPlannerNodeConfig) -> None:
        """Set up the planner and listen."""
        super().__init__(config)
        self._node, self._config = node, config
        self.planner = PushContactPlanner(config.planner, config.model.model())
        self._warm_up()
        with_yaw, space = config.goal_orientation == "use", config.workspace
        self.goal = GoalInput(
            node, config.base_frame, space.object_x, space.object_y, orientation=with_yaw
        )
        self.forget()
        node.subscribe(Odometry, "object_state", self._receive_object)

    def forget(self) -> None:
        """Forget object and plan."""
        self.object: ObjectState | None = None
        self._last: ContactPlan | None = None

    def missing(self, now: float, limit: float) -> str:
        """What keeps it from planning."""
        if self.object is None or now - self.object.stamp > limit:
            return f"no object_state within {limit} s"
        return "no goal_pose yet" if self.goal.latest is None else ""

    def plan(self, now: float, joints: NDArray) -> list[Odometry]:
        """Where the rod shall touch."""
        tool = self._tools.tool(joints)
        self._last = plan = self.planner.plan(now, tool, self.object, self.goal.latest)
        frame, tool_frame = self._config.base_frame, self._config.tool_frame
        return [contact_message(plan, self._node.time_base, frame, tool_frame)]

    def markers(self, make: markers.MarkerFactory) -> list[Marker]:
        """The place and the direction of the push."""
        plan = self._last
        if plan is None:
            return []
        return [
            make.spheres("touch", plan.position[None], markers.PLAN, 0.012),
            make.line("push", plan.position + 0.2 * np.outer((0.0, 1.0), plan.velocity), markers.PLAN),
        ]

    def _receive_object(self, message: Odometry) -> None:
        self._node.seconds(message.header.stamp)
        self.object = read_state(message, self._node.time_base, self._config.base_frame)

    def _warm_up(self) -> None:
        """Compile whatever the first plan would compile."""
        state = ObjectState(0.0, np.array([0.5, 0.0, 0.0]), np.zeros(3), np.eye(6))
        self.planner.plan(0.0, np.array([0.4, -0.2]), state, PlanarGoal(np.array([0.55, 0.1])))


class RobustPushingContacts(OnTable):
    """All tools of a robot and hypotheses about an object, eq. (6.38)."""

    def __init__(self, node: ManagedNode, config: ContactPlannerNodeConfig) -> None:
        """Set up the planner and listen."""
        super().__init__(config)
        self._node, self._config = node, config
        planning, robust, frame = config.robust.planning, config.robust, config.base_frame
        rule = contact_rule(config.robot, config.model, planning)
        self.planner, self._effectors = RobustContactPlanner(planning, rule), rule.effectors
        self._warm_up()
        self.goal = TargetInput(node, frame, robust.workspace_x, robust.workspace_y)
        # Only places matter here, not how hypotheses differ in friction.
        unknown = BeliefModelConfig(friction=(0.0, 0.0), center_std=0.0)
        self.belief = BeliefInput(node, frame, unknown, np.random.default_rng(0))
        self.forget()

    def forget(self) -> None:
        """Forget belief and plan."""
        self.belief.forget()
        self._last: RobustContactPlan | None = None

    def missing(self, now: float, limit: float) -> str:
        """What keeps it from planning."""
        if now - self.belief.stamp > limit:
            return f"no object_belief within {limit} s"
        return "no goal_pose yet" if self.goal.latest is None else ""

    def plan(self, now: float, joints: NDArray) -> list[Odometry]:
        """Where each end effector shall touch."""
        tool = self._tools.tool(joints)
        known, target = self.belief.latest, self.goal.target
        assert known is not None and target is not None, "`missing` says so"
        self._last = plan = self.planner.plan(now, tool, known.belief, target)
        tool_frames, frame = self._config.robot.tools.frames, self._config.base_frame
        return contact_messages(plan, self._effectors, tool_frames, self._node.time_base, frame)

    def markers(self, make: markers.MarkerFactory) -> list[Marker]:
        """The places with the ellipses of one standard deviation, and the direction of the push."""
        plan = self._last
        if plan is None:
            return []
        places = self._effectors.poses(plan.mean)[:, :2]
        columns = [slice(c, c + 2) for c in self._effectors.columns]
        covariances = np.array([plan.covariance[c, c] for c in columns])
        middle = places.mean(axis=0)
        return [
            make.spheres("touch", places, markers.CONTACT, 0.012),
            make.ellipses("contact_prior", places, covariances, markers.CONTACT),
            make.line("push", middle + 0.6 * np.outer((0.0, 1.0), plan.velocity), markers.CONTACT),
        ]

    def _warm_up(self) -> None:
        belief = ObjectBelief(np.array([[0.5, 0.0, 0.0], [0.5, 0.01, 0.0]]))
        target = GoalTarget(np.array([0.55, 0.1]))
        self.planner.plan(0.0, np.zeros(self._effectors.dof), belief, target)
