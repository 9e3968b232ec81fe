"""Random cells for an arm that stands on a table, and random postures in them."""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.collision.arm import ArmCollision
from vpsto_ros.collision.arm_model import fr3_capsules
from vpsto_ros.collision.shapes import Box, Capsule, HalfSpace, Shape, Sphere, rotation_z

POSTURE_CLEARANCE = 0.02  # of start and goal [m]


@dataclasses.dataclass(frozen=True, eq=False)
class ReachTask:
    """From one posture to another in a cell.

    Attributes:
        obstacles: ten of them: the table, a shelf of three boards, two boxes, two pillars, a beam, a ball.
        start: joint positions, shape (7,) [rad].
        goal: joint positions, shape (7,) [rad].
    """

    obstacles: tuple[Shape, ...]
    start: NDArray[np.float64]
    goal: NDArray[np.float64]


def random_task(seed: int) -> ReachTask:
    """A cell, and two postures uniform over the joint ranges that keep 2 cm from everything.

    Nothing is done to make sure that a way between them exists. A cell with fewer than two such postures in
    20 000, which has not been seen yet, would be drawn again.
    """
    rng = np.random.default_rng([seed, 77])
    model = fr3_capsules()
    obstacles = random_cell(rng)
    checker = ArmCollision(model, obstacles, margin=POSTURE_CLEARANCE)
    postures = rng.uniform(model.lower, model.upper, (20_000, 7))
    free = postures[~checker.in_collision(postures)]
    if len(free) < 2:
        return random_task(seed + 1_000_000)
    return ReachTask(obstacles, free[0], free[1])


def random_cell(rng: np.random.Generator) -> tuple[Shape, ...]:
    """Ten obstacles in reach of the arm."""
    directions = math.pi * (2.0 * rng.permutation(7) / 7.0 + rng.uniform(-0.05, 0.05, 7))
    return (
        HalfSpace(np.array([0.0, 0.0, 1.0]), 0.0, "table"),
        *_shelf(directions[0], rng.uniform(0.5, 0.65), rng.uniform(0.3, 0.6)),
        _box("crate", directions[1], rng, (0.06, 0.06, 0.08), (0.15, 0.15, 0.25)),
        _box("tower", directions[2], rng, (0.04, 0.04, 0.2), (0.08, 0.08, 0.35)),
        _pillar("pillar", directions[3], rng),
        _pillar("post", directions[4], rng),
        _beam(directions[5], rng),
        _ball(directions[6], rng),
    )


def _place(direction: float, radius: float, height: float) -> NDArray[np.float64]:
    return np.array([radius * math.cos(direction), radius * math.sin(direction), height])


def _shelf(direction: float, radius: float, height: float) -> tuple[Box, ...]:
    """A board to reach in below and above, a back, and a side."""
    turn = rotation_z(direction)
    centre = _place(direction, radius, height)
    outward, sideways = turn[:, 0], turn[:, 1]
    return (
        Box(centre, np.array([0.12, 0.3, 0.01]), turn, "shelf board"),
        Box(centre + 0.13 * outward, np.array([0.01, 0.3, 0.2]), turn, "shelf back"),
        Box(centre + 0.31 * sideways, np.array([0.12, 0.01, 0.2]), turn, "shelf side"),
    )


def _box(name: str, direction: float, rng: np.random.Generator, least, most) -> Box:
    half = rng.uniform(least, most)
    radius = rng.uniform(0.35, 0.7) + 0.5 * math.hypot(half[0], half[1])
    return Box(_place(direction, radius, half[2]), half, rotation_z(rng.uniform(0.0, math.pi)), name)


def _pillar(name: str, direction: float, rng: np.random.Generator) -> Capsule:
    thickness = rng.uniform(0.02, 0.05)
    foot = _place(direction, rng.uniform(0.35, 0.7), 0.0)
    return Capsule(foot, foot + np.array([0.0, 0.0, rng.uniform(0.5, 1.2)]), thickness, name)


def _beam(direction: float, rng: np.random.Generator) -> Capsule:
    """A slanting rod across a direction, above the table."""
    centre = _place(direction, rng.uniform(0.4, 0.7), rng.uniform(0.4, 1.0))
    along = rng.normal(size=3) * [1.0, 1.0, 0.4]
    along -= (along @ _place(direction, 1.0, 0.0)) * _place(direction, 0.8, 0.0)
    half = 0.3 * along / np.linalg.norm(along)
    return Capsule(centre - half, centre + half, rng.uniform(0.015, 0.03), "beam")


def _ball(direction: float, rng: np.random.Generator) -> Sphere:
    radius = rng.uniform(0.06, 0.12)
    return Sphere(_place(direction, rng.uniform(0.4, 0.7), rng.uniform(0.3, 0.9)), radius, "ball")
