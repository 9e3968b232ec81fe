"""Pushing behind the simulated driver: what tools feel, a hand that pushes the object, what arms touch."""

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from visualization_msgs.msg import MarkerArray

from sim_bridge import driver_messages as messages
from sim_bridge.driver_config import FrankaDriverConfig
from sim_bridge.simulation import Simulation
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.nodes.conversions import require_finite, require_frame
from vpsto_ros.nodes.lifecycle import best_effort, reliable

if TYPE_CHECKING:
    from sim_bridge.franka_driver import FrankaDriver

_LARGEST_FORCE, _LARGEST_TORQUE = 200.0, 20.0  # of a hand [N, Nm]


class PushingCell:
    """A robot with tools and an object on a table."""

    hardware = "simulated FR3"

    def __init__(self, node: "FrankaDriver", config: FrankaDriverConfig) -> None:
        """Build the world and open its own topics."""
        self._warm_up(config)
        self._node, self._config = node, config
        self.world: Simulation = config.pushing()
        self._hand: tuple[float, NDArray] | None = None
        self._wrench_publisher = node.advertise(WrenchStamped, "external_wrench", reliable(5))
        self._tool_publisher = node.advertise(Odometry, "~/ground_truth/tool", best_effort(1))
        node.subscribe(WrenchStamped, "disturbance", self._receive_disturbance)

    @staticmethod
    def _warm_up(config: FrankaDriverConfig) -> None:
        """Compile what only this world uses."""
        world = config.pushing()
        world.advance(0.01)
        world.tool_velocity()
        world.tool_contact_force()

    def before_slice(self, duration: float) -> None:
        """Push while the last message on disturbance acts."""
        if self._hand is None:
            return
        end, wrench = self._hand
        if self.world.time < end - 1e-9:
            self.world.push_object(wrench[:3], wrench[3:], duration)
        else:
            self._hand = None

    def after_slice(self) -> None:
        """Nothing happens that is to be said at once."""

    def publish_reports(self) -> None:
        """What the tools feel, and where they really are."""
        frame = self._config.base_frame
        self._wrench_publisher.publish(messages.external_wrench(self.world, frame))
        for message in messages.true_tools(self.world, frame):
            self._tool_publisher.publish(message)

    def markers(self) -> MarkerArray:
        """Arms, tools, object and cubes."""
        return messages.scene_markers(self.world, self._config.base_frame)

    def figures(self) -> dict[str, Any]:
        """How the tools kept their height, and what arms touched."""
        contacts = dataclasses.asdict(self.world.robot_contacts)
        return {
            "tool_height_deviation_mm": f"{1e3 * self.world.tool_height_deviation:.3f}",
            **{f"contact.{name}.steps": count for name, count in contacts.items()},
        }

    def trouble(self) -> str:
        """Nothing beyond limits."""
        return ""

    def reset(self) -> str:
        """Put object and arm back."""
        self.world.reset()
        self._hand = None
        return "object and arm are back where they started; time goes on"

    def _receive_disturbance(self, message: WrenchStamped) -> None:
        require_frame(message.header, self._config.base_frame)
        force, torque = message.wrench.force, message.wrench.torque
        wrench = np.array([force.x, force.y, force.z, torque.x, torque.y, torque.z])
        require_finite("wrench", wrench)
        if np.linalg.norm(wrench[:3]) > _LARGEST_FORCE or np.linalg.norm(wrench[3:]) > _LARGEST_TORQUE:
            raise InvalidInputError("the wrench is beyond what a hand does: at most 200 N and 20 Nm")
        self._node.ask(lambda: self._take_hand(wrench))

    def _take_hand(self, wrench: NDArray) -> None:
        self._hand = (self.world.time + self._config.disturbance_hold, wrench)
