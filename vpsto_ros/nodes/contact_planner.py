"""The node that says where to touch the object next: object and goal_pose in, contact_plan out."""

import math
from collections.abc import Callable
from typing import Any

from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from visualization_msgs.msg import MarkerArray

from vpsto_ros.nodes import markers
from vpsto_ros.nodes.contact_planner_config import ContactPlannerNodeConfig
from vpsto_ros.nodes.contact_tasks import ContactTask, PushingContacts, RobustPushingContacts
from vpsto_ros.nodes.diagnostics import OK, STALE, Diagnostics, Durations, Rate, Report
from vpsto_ros.nodes.joint_conversions import read_joint_state
from vpsto_ros.nodes.lifecycle import ManagedNode, latched, run
from vpsto_ros.nodes.robots import PUSHING, ROBUST_PUSHING, SHOOTING
from vpsto_ros.nodes.shooting_task import ShootingContacts

KINDS: dict[str, Callable[..., ContactTask]] = {
    PUSHING: PushingContacts, ROBUST_PUSHING: RobustPushingContacts, SHOOTING: ShootingContacts,
}  # fmt: skip


class ContactPlannerNode(ManagedNode):
    """Plans where to touch, whenever the robot, the object and, where there is one, the goal are known."""

    default_config = ContactPlannerNodeConfig()

    def configure(self, config: ContactPlannerNodeConfig) -> None:
        """Set up planner, topics and timer."""
        self.config = config
        self.task = KINDS[config.kind](self, config)
        self.on_time_reset()
        self._compute, self._rate, self._status = Durations(), Rate(), Report(STALE, "waiting")
        # Every end effector's last plan reaches those who join later.
        count = len(config.robot.tools.frames)
        self._publisher = self.advertise(Odometry, "contact_plan", latched(count))
        self._marker_publisher = self.advertise(MarkerArray, "~/markers", latched())
        self.subscribe(JointState, "joint_states", self._receive_joints)
        self.every(1.0 / config.rate, self.plan)
        self.every(1.0 / config.marker_rate, self._publish_markers)
        self.diagnostics = Diagnostics(self, self.report)

    def on_time_reset(self) -> None:
        """Forget what carries a time; the goal stays."""
        self.joints: NDArray | None = None
        self.joint_stamp = -math.inf
        self.task.forget()

    def cleanup(self) -> None:
        """Stop reporting."""
        self.diagnostics.destroy()

    def plan(self) -> None:
        """Plan and publish once, if everything is known and fresh."""
        now = self.now()
        missing = self._missing(now)
        if missing:
            self._status = Report(STALE, missing)
            for message in self.task.withdraw():
                self._publisher.publish(message)
            return
        with self._compute.measured():
            messages = self.task.plan(now, self.joints)
        for message in messages:
            self._publisher.publish(message)
        self._rate.tick()
        self._status = Report(OK, self.task.status() or "ok")

    def figures(self) -> dict[str, Any]:
        """Rate and compute time."""
        return {"rate_hz": f"{self._rate.take():.2f}", **self._compute.milliseconds("compute")}

    def health(self) -> tuple[int, str]:
        """Whether it plans."""
        status = self._status
        if status.level == OK:
            level, message = super().health()
            return (level, status.message) if level == OK else (level, message)
        trouble = self.complaints.recent()
        return status.level, f"{status.message}; {trouble}" if trouble else status.message

    def _missing(self, now: float) -> str:
        """What keeps the node from planning, empty if nothing does."""
        limit = self.config.input_timeout
        if self.joints is None or now - self.joint_stamp > limit:
            return f"no joint_states within {limit} s"
        return self.task.missing(now, limit)

    def _publish_markers(self) -> None:
        stamp = self.get_clock().now().to_msg()
        make = markers.MarkerFactory(self.config.base_frame, stamp, self.task.surface)
        drawn = self.task.markers(make)
        if drawn:
            self._marker_publisher.publish(MarkerArray(markers=drawn))

    def _receive_joints(self, message: JointState) -> None:
        stamp = self.seconds(message.header.stamp)
        self.joints, _ = read_joint_state(message, self.task.joint_names)
        self.joint_stamp = stamp


def main(args: list[str] | None = None) -> int:
    """Run the contact planner; see :func:`vpsto_ros.nodes.lifecycle.run`."""
    return run(ContactPlannerNode, "contact_planner", args)
