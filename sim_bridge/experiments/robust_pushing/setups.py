"""The robots, objects, plans and plants of the experiments on robust pushing.

Planners know the geometry of object and tools and a rough place of the object. How it slides, what it weighs
and where its mass is are the plant's; the friction model only knows ranges of these.
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.object_plant import ObjectPlant
from sim_bridge.robots import KINDS
from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.optimization.vpsto import VpstoConfig
from vpsto_ros.planning.belief_space.config import RobustPushingConfig
from vpsto_ros.planning.belief_space.contacts import ContactRule, CrossingRule
from vpsto_ros.planning.belief_space.problem import Reach
from vpsto_ros.planning.belief_space.receding_horizon import RobustPusher
from vpsto_ros.planning.belief_space.spaces import PlaneSpace
from vpsto_ros.robot.tip_kinematics import BALL_RADIUS, HAND_HALF_SIZE

FRICTION = (0.0, 0.6)
"""What planners believe of the friction between tools and object."""
CENTER_SHARE = 0.1
"""Standard deviation of the centre of friction that planners believe in, as a share of the radius."""

DYNAMICS: dict[str, dict[str, Any]] = {
    # The thesis's: frictionless contacts, 1 mm of noise per step in contact.
    "thesis": {"friction": False, "step_variance": 1e-6, "way_variance": 0.0},
    # Particles carry friction and a centre of friction; a push of 10 cm spreads by 3 mm in addition.
    "friction": {"friction": True, "step_variance": 0.0, "way_variance": 1e-4},
}
"""Options of :class:`BeliefDynamics` by the name of the model."""

BIMANUAL = RobustPushingConfig(jitter=0.004, executed=16)
HAND = RobustPushingConfig(
    points=3, steps=60, executed=20, jitter=0.004, duration_weight=0.05, speed=0.15, acceleration=0.7,
    turn_speed=1.2, search=VpstoConfig(population=30, iterations=20, strategy="cma"),
)  # fmt: skip

STRAIGHT_HAND = dataclasses.replace(
    HAND, contact_std=0.01, contact_yaw_std=0.01, smoothness_spread=0.02, duration_weight=0.0
)
"""The deterministic plan of the thesis is straight, the long side across. Left to itself the baseline swings
the hand, which moves the object faster than the hand's speed limit and loses it in the first push."""


def bimanual_effectors() -> EndEffectors:
    """The two balls."""
    return EndEffectors.discs(BALL_RADIUS, 2)


def hand_effectors() -> EndEffectors:
    """The hand, its long side along x at yaw 0."""
    return EndEffectors.rectangle(2.0 * HAND_HALF_SIZE[0], 2.0 * HAND_HALF_SIZE[1])


def dynamics(radius: float, effectors: EndEffectors, model: str) -> BeliefDynamics:
    """Belief dynamics of a disc under a named model."""
    return BeliefDynamics(PlanarShape.disc(radius), effectors, **DYNAMICS[model])


def belief(place: NDArray, std: float, radius: float, count: int, rng: np.random.Generator) -> ObjectBelief:
    """What is believed of a disc that was put near a place (2,)."""
    return ObjectBelief.gaussian(
        np.append(place, 0.0), std, count, rng, friction=FRICTION, center_std=CENTER_SHARE * radius
    )


def pusher(
    robot: str, radius: float, model: str, rng: np.random.Generator, *, robust: bool = True,
    config: RobustPushingConfig | None = None, reach: Reach | None = None,
) -> RobustPusher:  # fmt: skip
    """A planner for a robot of the simulation, "two_balls" or "hand", and a disc.

    Args:
        robot: which one.
        radius: of the object [m].
        model: of the belief dynamics.
        rng: source of randomness.
        robust: False is the deterministic baseline.
        config: options instead of the usual ones for this robot.
        reach: where the tools may be, instead of wherever the robot reaches.
    """
    two = robot == "two_balls"
    effectors = bimanual_effectors() if two else hand_effectors()
    config = dataclasses.replace(config or (BIMANUAL if two else HAND), robust=robust)
    kind = KINDS[robot]
    plane = kind.plane(kind.load(), PLANE_HEIGHT[robot])
    rule = ContactRule(
        effectors, PlanarShape.disc(radius), config.contact_angle, config.contact_advance,
        CrossingRule() if two else None,
    )  # fmt: skip
    return RobustPusher(
        config, dynamics(radius, effectors, model), PlaneSpace(effectors, config), rule, rng,
        reach=reach or plane.contains,
    )  # fmt: skip


PLANE_HEIGHT = {"two_balls": 0.035, "hand": 0.05}
"""Height of the tools above the table [m]."""


def random_plant(
    radius: float, rng: np.random.Generator, *, off_centre: float = CENTER_SHARE, height: float = 0.12
) -> ObjectPlant:
    """A disc of 0.1 to 1 kg; friction 0.2 to 0.6 with tools and table; mass off its centre.

    Args:
        radius: [m].
        rng: source of randomness.
        off_centre: largest distance of the mass from the centre, as a share of the radius.
        height: [m].
    """
    angle, share = rng.uniform(-np.pi, np.pi), off_centre * np.sqrt(rng.uniform())
    com = share * radius * np.array([np.cos(angle), np.sin(angle)])
    return ObjectPlant(
        shape=PlanarShape.disc(radius), height=height, mass=float(rng.uniform(0.1, 1.0)),
        table_friction=float(rng.uniform(0.2, 0.6)), tool_friction=float(rng.uniform(0.2, 0.6)),
        com_offset=(float(com[0]), float(com[1])), support=str(rng.choice(["corners", "spread"])),
    )  # fmt: skip
