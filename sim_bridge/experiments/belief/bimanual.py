"""Two balls on two arms push a disc of 5 cm along a circle (6.6.3): what experiments and bench share."""

import functools

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.belief.models import Model, disc_belief
from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.planning.belief_space.config import RobustPushingConfig
from vpsto_ros.planning.belief_space.contacts import ContactRule, CrossingRule
from vpsto_ros.planning.belief_space.receding_horizon import RobustPusher
from vpsto_ros.planning.belief_space.spaces import JointSpace, PlaneSpace, SearchSpace
from vpsto_ros.planning.belief_space.targets import PathTarget
from vpsto_ros.robot.bimanual_plane import BimanualPlane
from vpsto_ros.robot.kinematics import fr3_bimanual

RADIUS, BALL_RADIUS, STD = 0.05, 0.03, 0.007
OBJECT, CENTRE = (0.42, 0.0), (0.52, 0.0)
BALLS = EndEffectors.discs(BALL_RADIUS, 2)
START = np.array([0.34, 0.10, 0.34, -0.10])
TARGET = PathTarget.circle(OBJECT, CENTRE)


@functools.cache
def arms() -> BimanualPlane:
    """Both arms; loading their model takes a moment."""
    return BimanualPlane(fr3_bimanual())


def belief(count: int, rng: np.random.Generator) -> ObjectBelief:
    """Where the disc may be before the first push."""
    return disc_belief(OBJECT, STD, RADIUS, count, rng)


def pusher(
    config: RobustPushingConfig, model: Model, *, joints: bool, rng: np.random.Generator
) -> RobustPusher:
    """The planner, in the plane of the balls (4 coordinates) or in the 14 joints."""
    plane = arms()
    space: SearchSpace = JointSpace(plane, config) if joints else PlaneSpace(BALLS, config)
    rule = ContactRule(
        BALLS, PlanarShape.disc(RADIUS), config.contact_angle, config.contact_advance, CrossingRule()
    )
    return RobustPusher(config, model.dynamics(RADIUS, BALLS), space, rule, rng, reach=plane.contains)


def start(joints: bool, point: NDArray = START) -> NDArray:
    """Where the arms are in the search space when the balls are at plane coordinates (4,)."""
    return arms().joints(point[None])[0] if joints else point
