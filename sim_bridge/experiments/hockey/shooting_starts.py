"""Where the pucks of the shooting experiment begin, and the worlds in which they do; table frame."""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from sim_bridge.hockey import table
from sim_bridge.hockey.mallet import MalletConfig
from sim_bridge.hockey.scene import AirHockeyScene
from sim_bridge.hockey.world import AirHockeyWorld

GRID_X, GRID_Y = np.linspace(-0.65, -0.25, 5), np.linspace(-0.30, 0.30, 5)
"""Places in front of the robot [m]; seeds go through them in turn."""
JITTER = 0.02
"""Around these, in x and in y [m]."""
DRIFT = 0.1
"""Largest speed of pucks on the grid [m/s]."""
PASS_X, PASS_Y = (-0.2, 0.2), (-0.3, 0.3)
"""Where moving pucks come from [m]."""
PASS_SPEED, PASS_ANGLE = (0.2, 0.5), math.radians(60.0)
"""How fast they are [m/s], and how far their direction is from straight at the robot."""
SPREAD = {
    "drag": 0.2, "rim_damping": 0.15, "mallet_damping": 0.1, "joint_friction": 0.3, "joint_damping": 0.3,
    "hinge_stiffness": 0.1, "hinge_damping": 0.1,
}  # fmt: skip
"""By which share of their values in the planner's world the parameters of others differ at most.

The hinges are those of the mallet; for its swing the planner takes their gains to be the nominal ones.
"""


@dataclasses.dataclass(frozen=True)
class ShotTask:
    """A shot to be done.

    Attributes:
        name: of the player.
        seed: of all that is random.
        nominal: whether the world is the one that the planner's models are learned from.
    """

    name: str
    seed: int
    nominal: bool = False


def start(task: ShotTask) -> NDArray[np.float64]:
    """State (x, y, vx, vy) of the puck at the start, shape (4,) [m, m/s].

    The same for all players on the grid; moving pucks are drawn apart.
    """
    rng = np.random.default_rng([task.seed, 0])
    if task.name == "moving":
        place = np.array([rng.uniform(*PASS_X), rng.uniform(*PASS_Y)])
        angle, speed = math.pi + rng.uniform(-PASS_ANGLE, PASS_ANGLE), rng.uniform(*PASS_SPEED)
    else:
        row, column = divmod(task.seed % (len(GRID_X) * len(GRID_Y)), len(GRID_Y))
        place = np.array([GRID_X[row], GRID_Y[column]]) + rng.uniform(-JITTER, JITTER, 2)
        angle, speed = rng.uniform(-math.pi, math.pi), rng.uniform(0.0, DRIFT)
    return np.array([*place, speed * math.cos(angle), speed * math.sin(angle)])


def plant(task: ShotTask) -> tuple[AirHockeyScene, MalletConfig]:
    """The world's parameters, which no planner is told."""
    scene, mallet, rng = AirHockeyScene(), MalletConfig(), np.random.default_rng([task.seed, 1])
    if task.nominal:
        return scene, mallet
    factors = {name: 1.0 + share * rng.uniform(-1.0, 1.0) for name, share in SPREAD.items()}
    stiffness = factors.pop("hinge_stiffness") * mallet.stiffness
    damping = factors.pop("hinge_damping") * mallet.damping
    other = dataclasses.replace(scene, **{name: getattr(scene, name) * f for name, f in factors.items()})
    return other, MalletConfig(stiffness=stiffness, damping=damping)


def world_of(task: ShotTask) -> AirHockeyWorld:
    """A fresh world with the puck at its start, the arm at home."""
    (scene, mallet), puck = plant(task), start(task)
    world = AirHockeyWorld(scene, seed=task.seed, mallet=mallet)
    world.reset((*table.to_base(puck[:2]), 0.0), (*puck[2:], 0.0))
    return world
