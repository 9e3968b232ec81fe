"""Air hockey behind the simulated driver: goals, pucks that are brought back, the rules of play."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from sim_bridge.driver_config import FrankaDriverConfig
from sim_bridge.hockey import messages
from sim_bridge.hockey.contact_log import MALLET
from sim_bridge.hockey.rules import KINDS
from sim_bridge.hockey.world import AirHockeyWorld, Goal
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.nodes.lifecycle import best_effort, reliable

if TYPE_CHECKING:
    from sim_bridge.franka_driver import FrankaDriver

AT_REST = 1e-3
"""An arm whose reference is slower rests [rad/s]."""
_DRAWS = 100  # of places for a puck until one is free


class AirHockeyCell:
    """An iiwa 14 with a mallet, its table, and pucks that a hand puts where they are shot from."""

    hardware = "simulated iiwa 14"

    def __init__(self, node: "FrankaDriver", config: FrankaDriverConfig) -> None:
        """Build the world and open its own topics and services."""
        self._warm_up(config)
        self._node, self._config = node, config
        self.world: AirHockeyWorld = config.air_hockey()
        self._rng = np.random.default_rng([config.seed, 1])  # another stream than the camera's
        self._pucks = 0
        self._goals = {"far": 0, "near": 0}
        self._announced: Goal | None = None
        self._touches = 0  # of the mallet, since the puck was put down
        self._mallet_publisher = node.advertise(Odometry, "~/ground_truth/mallet", best_effort(1))
        self._goal_publisher = node.advertise(Odometry, "~/goals", reliable(10))
        self._touch_publisher = node.advertise(Odometry, "~/touches", reliable(10))
        node.serve(Trigger, "~/new_puck", self._new_puck_requested)

    @staticmethod
    def _warm_up(config: FrankaDriverConfig) -> None:
        """Compile what only this world uses."""
        config.air_hockey().advance(0.01)

    def before_slice(self, duration: float) -> None:
        """Nothing acts besides the arm."""

    def after_slice(self) -> None:
        """Announce the end of a touch of the mallet, and a goal."""
        touches = [contact for contact in self.world.contacts if contact.surface == MALLET]
        for contact in touches[self._touches :]:
            self._touch_publisher.publish(messages.touch_event(contact, self._config.base_frame))
        self._touches = len(touches)
        goal = self.world.goal
        if goal is not None and goal is not self._announced:
            self._announced = goal
            self._goals[goal.end] += 1
            self._goal_publisher.publish(messages.goal_event(goal, self._config.base_frame))

    def publish_reports(self) -> None:
        """Where the mallet really is."""
        self._mallet_publisher.publish(messages.true_mallet(self.world, self._config.base_frame))

    def markers(self) -> MarkerArray:
        """Arm, mallet, puck and table."""
        return messages.scene_markers(self.world, self._config.base_frame)

    def figures(self) -> dict[str, Any]:
        """Pucks, goals and rules."""
        rules = self.world.rules.report()
        values: dict[str, Any] = {"pucks": self._pucks}
        values |= {f"goals.{end}": count for end, count in self._goals.items()}
        values["rule_violations"] = sum(rules.violations.values())
        for kind in KINDS:
            record = getattr(rules, kind)
            values[f"rule.{kind}.instants"] = record.instants
            values[f"rule.{kind}.worst"] = f"{record.worst:.4f}"
        return values

    def trouble(self) -> str:
        """Which rules were broken."""
        broken = self.world.rules.report().violations
        counts = ", ".join(f"{kind} in {count}" for kind, count in broken.items())
        return f"rules were broken ({counts} cycles)" if broken else ""

    def reset(self) -> str:
        """Put a puck somewhere, and the arm back unless it moves: a hand that brings a puck moves no arm."""
        world = self.world
        moves = np.abs(world.follower.reference(world.time)[1]).max() > AT_REST
        self._put_puck(world.place_puck if moves else world.reset)
        arm = "moves, and goes on" if moves else "is back where it started"
        return f"a new puck is on the table, the arm {arm}; time goes on"

    def _put_puck(self, put: Callable[[NDArray, NDArray], None]) -> str:
        """Put a puck where none is in the way, at random.

        Args:
            put: puts it at a pose (x, y, yaw) with a velocity, or raises and changes nothing.

        Raises:
            InvalidInputError: the mallet is everywhere where pucks are put.
        """
        for _ in range(_DRAWS):
            pose, velocity = self._config.hockey.pucks.draw(self._rng)
            try:
                put(pose, velocity)
            except InvalidInputError as error:
                refused = error
                continue
            self._pucks, self._touches = self._pucks + 1, 0
            return f"a puck is at ({pose[0]:.3f}, {pose[1]:.3f}) m"
        raise refused

    def _new_puck_requested(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._node.answer(lambda: self._put_puck(self.world.place_puck), response)
