"""The planners and plants of the experiments on robust pushing.

Planners know the geometry of object and tools and a rough place of the object. How it slides, what it weighs
and where its mass is are the plant's; the friction model only knows ranges of these.
"""

import dataclasses

import numpy as np

from sim_bridge.experiments.belief.models import CENTER_SHARE, MODELS
from sim_bridge.experiments.belief.planners import robot_pusher
from sim_bridge.object_plant import ObjectPlant
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.optimization.vpsto import VpstoConfig
from vpsto_ros.planning.belief_space.config import RobustPushingConfig
from vpsto_ros.planning.belief_space.problem import Reach
from vpsto_ros.planning.belief_space.receding_horizon import RobustPusher

BIMANUAL = RobustPushingConfig(jitter=0.004)
HAND = RobustPushingConfig(
    points=3, steps=60, particles=40, jitter=0.004, variance_weight=10.0, duration_weight=0.05,
    speed=0.15, acceleration=0.7, turn_speed=1.2,
    search=VpstoConfig(population=30, iterations=20, strategy="cma"),
)  # fmt: skip

STRAIGHT_HAND = dataclasses.replace(
    HAND, particles=20, contact_std=0.01, contact_yaw_std=0.01, smoothness_spread=0.02, duration_weight=0.0
)
"""The deterministic plan of the thesis is straight, the long side across. Left to itself the baseline swings
the hand, which moves the object faster than the hand's speed limit and loses it in the first push."""

CONFIGS = {"two_balls": (BIMANUAL, 16), "hand": (HAND, 20)}
"""The usual options, and steps H that are executed of a horizon, by the name of the robot."""


def pusher(
    robot: str, radius: float, model: str, rng: np.random.Generator, *, robust: bool = True,
    config: RobustPushingConfig | None = None, reach: Reach | None = None,
) -> RobustPusher:  # fmt: skip
    """A planner for a robot of the simulation, "two_balls" or "hand", and a disc.

    Args:
        robot: which one.
        radius: of the object [m].
        model: name of the model of the belief dynamics.
        rng: source of randomness.
        robust: False is the deterministic baseline.
        config: options instead of the usual ones for this robot.
        reach: where the tools may be, instead of wherever the robot reaches.
    """
    usual, executed = CONFIGS[robot]
    config = dataclasses.replace(config or usual, robust=robust)
    return robot_pusher(robot, radius, MODELS[model], config, rng, reach=reach, executed=executed)


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
