"""Two balls on two arms push a disc of 5 cm along a circle (6.6.3): what experiments and bench share."""

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.belief.models import Model, disc_belief
from sim_bridge.experiments.belief.planners import robot_pusher, tool_plane
from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.planning.belief_space.config import RobustPushingConfig
from vpsto_ros.planning.belief_space.receding_horizon import RobustPusher
from vpsto_ros.planning.belief_space.targets import PathTarget
from vpsto_ros.robot.kinds import TOOL_KINDS
from vpsto_ros.robot.tool_plane import ToolPlane

RADIUS, STD = 0.05, 0.007
OBJECT, CENTRE = (0.42, 0.0), (0.52, 0.0)
BALLS = TOOL_KINDS["two_balls"].effectors
START = np.array([0.34, 0.10, 0.34, -0.10])
TARGET = PathTarget.circle(OBJECT, CENTRE)


def arms() -> ToolPlane:
    """Both arms; loading their model takes a moment."""
    return tool_plane("two_balls")


def belief(count: int, rng: np.random.Generator) -> ObjectBelief:
    """Where the disc may be before the first push."""
    return disc_belief(OBJECT, STD, RADIUS, count, rng)


def pusher(
    config: RobustPushingConfig, model: Model, *, joints: bool, rng: np.random.Generator
) -> RobustPusher:
    """The planner, in the plane of the balls (4 coordinates) or in the 14 joints."""
    return robot_pusher("two_balls", RADIUS, model, config, rng, joints=joints)


def start(joints: bool, point: NDArray = START) -> NDArray:
    """Where the arms are in the search space when the balls are at plane coordinates (4,)."""
    return arms().joints(point[None])[0] if joints else point
