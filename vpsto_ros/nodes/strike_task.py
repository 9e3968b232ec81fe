"""Strikes as a task of the node that moves the arm: contact_plan of the mallet in place of an object."""

import dataclasses

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from visualization_msgs.msg import Marker

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.nodes import markers
from vpsto_ros.nodes.conversions import read_contact, require_frame
from vpsto_ros.nodes.inputs import CONTACT_AHEAD
from vpsto_ros.nodes.lifecycle import ManagedNode, reliable
from vpsto_ros.nodes.mpc_planner_config import MpcPlannerConfig
from vpsto_ros.nodes.table_frame import MALLET
from vpsto_ros.planning.hockey.strike_mpc import StrikeMpc
from vpsto_ros.planning.hockey.strikes import StrikeTable
from vpsto_ros.planning.hockey.touch import MalletContact
from vpsto_ros.planning.running_reference import MpcStep
from vpsto_ros.planning.stitching import extended
from vpsto_ros.robot.iiwa_kinematics import arm_points

_SHORTEST = 0.2  # trajectories last at least so long [s]
_LATE = 0.2  # a contact that was due longer ago was meant for another clock [s]


class StrikeTask:
    """The mallet of an iiwa strikes where, when and as fast as contact_plan says, and waits at home else.

    A contact_plan of no frame (its child_frame_id is empty) calls off what was told before. A contact that no
    motion leads to goes back on the topic refused_contact, as it came.
    """

    def __init__(self, node: ManagedNode, config: MpcPlannerConfig) -> None:
        """Set up the planner and listen."""
        strikes = StrikeTable.load()
        self._node, self._config, self._table = node, config, config.hockey.table(strikes)
        self.planner = StrikeMpc(strikes, config.strike, seed=config.seed)
        self.planner.warm_up()
        self.forget()
        self._refusals = node.advertise(Odometry, "refused_contact", reliable(5))
        node.subscribe(Odometry, "contact_plan", self._receive)

    @property
    def surface(self) -> float:
        """Height of the table [m]."""
        return self._table.surface

    def forget(self) -> None:
        """Forget the contact."""
        self.contact: MalletContact | None = None
        self._received, self._message = -np.inf, None

    def pending(self, now: float) -> bool:
        """Always: waiting at home is planned, too."""
        return True

    def step(self, now: float, position: NDArray, velocity: NDArray, deadline: float) -> MpcStep:
        """Plan once; the search has a fixed number of iterations, which fits a cycle."""
        fresh = now - self._received <= self._config.contact_timeout_in_force
        contact = self.contact if fresh else None
        step = self.planner.step(now, position, velocity, contact)
        if contact is not None and step.refused:
            self._refusals.publish(self._message)
        if step.trajectory is None:
            return step
        # A controller refuses what has ended when it comes; the rest of a motion may be as short as that.
        return dataclasses.replace(step, trajectory=extended(step.trajectory, now + _SHORTEST))

    def stamps(self) -> dict[str, float]:
        """When the last contact came."""
        return {"contact_plan": self._received}

    def robot_markers(self, make: markers.MarkerFactory, position: NDArray) -> list[Marker]:
        """The arm at joint positions (7,) [rad]."""
        points = np.vstack([np.zeros(3), arm_points(position[None])[0]])
        return [make.line("robot", points, markers.ROBOT, 0.04)]

    def markers(self, make: markers.MarkerFactory, step: MpcStep) -> list[Marker]:
        """Nothing besides the planned path of the mallet's joint."""
        return []

    def _receive(self, message: Odometry) -> None:
        if not message.child_frame_id:
            require_frame(message.header, self._config.base_frame)
            self.forget()
            return
        if message.child_frame_id != MALLET:
            raise InvalidInputError(
                f"child_frame_id '{message.child_frame_id}'; expected '{MALLET}', or an empty one to call a "
                "shot off"
            )
        due = self._node.seconds(message.header.stamp, CONTACT_AHEAD)
        if due < self._node.clock_seconds() - _LATE:
            raise InvalidInputError("the contact is over")
        plan = read_contact(message, self._node.time_base, self._config.base_frame)
        mallet = np.concatenate([self._table.to_table(plan.position), plan.velocity])
        self.contact = MalletContact(plan.stamp, mallet)
        self._received, self._message = self._node.clock_seconds(), message
