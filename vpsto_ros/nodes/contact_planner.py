"""The node that says where to touch the object next: object_state and goal_pose in, contact_plan out."""

import dataclasses
import math
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from visualization_msgs.msg import MarkerArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.nodes import markers
from vpsto_ros.nodes.conversions import contact_message, read_state
from vpsto_ros.nodes.diagnostics import OK, STALE, Diagnostics, Durations, Rate, Report
from vpsto_ros.nodes.joint_conversions import read_joint_state
from vpsto_ros.nodes.lifecycle import ManagedNode, NodeConfig, latched, run
from vpsto_ros.nodes.scene import ModelConfig, goal_on_table
from vpsto_ros.planning.contact import ContactPlan, ContactPlannerConfig, PushContactPlanner
from vpsto_ros.planning.goal import PlanarGoal
from vpsto_ros.planning.workspace import Workspace
from vpsto_ros.robot.kinematics import JOINT_NAMES, forward_kinematics_batch


@documented
@dataclasses.dataclass(frozen=True)
class ContactPlannerNodeConfig(NodeConfig):
    """Parameters of the contact planner."""

    rate: float = option(20.0, "planning rate", unit="Hz", minimum=0.5, maximum=100.0)
    marker_rate: float = option(10.0, "rate of ~/markers", unit="Hz", minimum=0.1, maximum=50.0)
    goal_orientation: str = option("ignore", "whether the yaw of goal_pose counts", choices=("ignore", "use"))
    tool_frame: str = option("fr3_tool", "child_frame_id of contact_plan: what shall touch")
    input_timeout: float = option(
        0.5, "planning pauses when joint or object states are older", unit="s", minimum=0.02, maximum=10.0
    )
    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    workspace: Workspace = dataclasses.field(default_factory=Workspace)
    planner: ContactPlannerConfig = dataclasses.field(default_factory=ContactPlannerConfig)

    def __post_init__(self) -> None:
        validate(self)


class ContactPlannerNode(ManagedNode):
    """Plans where to touch, whenever tool, object and goal are known."""

    default_config = ContactPlannerNodeConfig()

    def configure(self, config: ContactPlannerNodeConfig) -> None:
        """Set up planner, topics and timer."""
        self.config = config
        self.planner = PushContactPlanner(config.planner, config.model.model())
        self.goal: PlanarGoal | None = None
        self.on_time_reset()
        self._compute, self._rate, self._status = Durations(), Rate(), Report(STALE, "waiting")
        self._warm_up()
        self._publisher = self.advertise(Odometry, "contact_plan", latched())
        self._marker_publisher = self.advertise(MarkerArray, "~/markers", latched())
        self.subscribe(JointState, "joint_states", self._receive_joints)
        self.subscribe(Odometry, "object_state", self._receive_object)
        self.subscribe(PoseStamped, "goal_pose", self._receive_goal)
        self.every(1.0 / config.rate, self.plan)
        self.every(1.0 / config.marker_rate, self._publish_markers)
        self.diagnostics = Diagnostics(self, self.report)

    def on_time_reset(self) -> None:
        """Forget what carries a time; the goal stays."""
        self.tool: NDArray | None = None
        self.tool_stamp = -math.inf
        self.object: ObjectState | None = None
        self.last: ContactPlan | None = None

    def cleanup(self) -> None:
        """Stop reporting."""
        self.diagnostics.destroy()

    def plan(self) -> None:
        """Plan and publish once, if everything is known and fresh."""
        now = self.now()
        missing = self._missing(now)
        if missing:
            self._status = Report(STALE, missing)
            return
        with self._compute.measured():
            plan = self.planner.plan(now, self.tool, self.object, self.goal)
        message = contact_message(plan, self.time_base, self.config.base_frame, self.config.tool_frame)
        self._publisher.publish(message)
        self.last = plan
        self._rate.tick()
        self._status = Report()

    def figures(self) -> dict[str, Any]:
        """Rate and compute time."""
        return {"rate_hz": f"{self._rate.take():.2f}", **self._compute.milliseconds("compute")}

    def health(self) -> tuple[int, str]:
        """Whether it plans."""
        status = self._status
        return super().health() if status.level == OK else (status.level, status.message)

    def _missing(self, now: float) -> str:
        """What keeps the node from planning, empty if nothing does."""
        limit = self.config.input_timeout
        if self.tool is None or now - self.tool_stamp > limit:
            return f"no joint_states within {limit} s"
        if self.object is None or now - self.object.stamp > limit:
            return f"no object_state within {limit} s"
        return "no goal_pose yet" if self.goal is None else ""

    def _publish_markers(self) -> None:
        if self.last is None:
            return
        make, plan = markers.MarkerFactory(self.config.base_frame, self.get_clock().now().to_msg()), self.last
        drawn = [
            make.spheres("touch", plan.position[None], markers.PLAN, 0.012),
            make.line("push", plan.position + 0.2 * np.outer((0.0, 1.0), plan.velocity), markers.PLAN),
        ]
        self._marker_publisher.publish(MarkerArray(markers=drawn))

    def _receive_joints(self, message: JointState) -> None:
        stamp = self.seconds(message.header.stamp)
        position, _ = read_joint_state(message, JOINT_NAMES)
        self.tool = forward_kinematics_batch(position[None])[0, :2]
        self.tool_stamp = stamp

    def _receive_object(self, message: Odometry) -> None:
        self.seconds(message.header.stamp)
        self.object = read_state(message, self.time_base, self.config.base_frame)

    def _receive_goal(self, message: PoseStamped) -> None:
        config = self.config
        self.goal = goal_on_table(message, config.base_frame, config.goal_orientation, config.workspace)

    def _warm_up(self) -> None:
        """Compile whatever the first plan would compile."""
        state = ObjectState(0.0, np.array([0.5, 0.0, 0.0]), np.zeros(3), np.eye(6))
        forward_kinematics_batch(np.zeros((1, 7)))
        self.planner.plan(0.0, np.array([0.4, -0.2]), state, PlanarGoal(np.array([0.55, 0.1])))


def main(args: list[str] | None = None) -> int:
    """Run the contact planner; see :func:`vpsto_ros.nodes.lifecycle.run`."""
    return run(ContactPlannerNode, "contact_planner", args)
