"""The robots that push a disc, and their planners: what experiments without and with a simulator share."""

import functools

import numpy as np

from sim_bridge.experiments.belief.models import Model
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.planning.belief_space.config import RobustPushingConfig
from vpsto_ros.planning.belief_space.contacts import ContactRule
from vpsto_ros.planning.belief_space.problem import Reach
from vpsto_ros.planning.belief_space.receding_horizon import EXECUTED, RobustPusher
from vpsto_ros.planning.belief_space.spaces import JointSpace, PlaneSpace, SearchSpace
from vpsto_ros.robot.kinds import TOOL_KINDS
from vpsto_ros.robot.tool_plane import ToolPlane


@functools.cache
def tool_plane(robot: str) -> ToolPlane:
    """The plane of a robot's tools, at their usual height; loading its model takes a moment."""
    kind = TOOL_KINDS[robot]
    return kind.plane(kind.load(), kind.height)


def contact_rule(robot: str, radius: float, config: RobustPushingConfig) -> ContactRule:
    """Where the tools of a robot touch a disc of a radius [m]; two arms do not cross."""
    kind = TOOL_KINDS[robot]
    return ContactRule.of(config, kind.effectors, PlanarShape.disc(radius), two_arms=kind.two_arms)


def robot_pusher(
    robot: str, radius: float, model: Model, config: RobustPushingConfig, rng: np.random.Generator, *,
    joints: bool = False, reach: Reach | None = None, executed: int = EXECUTED,
) -> RobustPusher:  # fmt: skip
    """A planner for a robot and a disc.

    Args:
        robot: "two_balls" or "hand".
        radius: of the disc [m].
        model: of the belief dynamics.
        config: options of the planner.
        rng: source of randomness.
        joints: whether to search in the joints instead of the plane of the tools.
        reach: where the tools may be, instead of wherever the robot reaches.
        executed: steps of a horizon after which a plan is continued anew.
    """
    plane, effectors = tool_plane(robot), TOOL_KINDS[robot].effectors
    space: SearchSpace = JointSpace(plane) if joints else PlaneSpace(effectors, config)
    return RobustPusher(
        config, model.dynamics(radius, effectors), space, contact_rule(robot, radius, config), rng,
        reach=reach or plane.contains, executed=executed,
    )  # fmt: skip
