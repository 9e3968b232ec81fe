"""Discs that move through the cluttered plane, and what a planner sees of them.

A disc moves in a straight line and is reflected where it meets the border of its region. The planner measures
where the discs are and how fast they move, with noise; it knows neither regions nor turns.

What would make a collision unavoidable is excluded when discs are drawn (:func:`random_discs`): a disc that
covers the start as the run begins, or the goal at any time, is drawn again; the region ends short of the bay
left of the obstacle L, in which a disc could shut in the robot at its start; and no disc is faster than half
the robot's limit per axis, so that a robot that gives way in time can.
"""

import dataclasses
import itertools
import math

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.clutter.world import CLUTTER, GOAL
from vpsto_ros.collision.planar import PlanarWorld, Stay
from vpsto_ros.collision.planar_discs import MovingDisc
from vpsto_ros.trajectory import Trajectory

REGION = np.array([[0.17, 0.0], [0.5, 0.5]])
"""Where discs move: lowest and highest x and y [m]."""

COUNTS, RADII, SPEEDS = (2, 5), (0.02, 0.035), (0.02, 0.05)
"""Number of discs, their radii [m] and speeds [m/s]: least and greatest."""

START_CLEARANCE, GOAL_CLEARANCE = 0.04, 0.03
"""Least distance of a disc's rim from the start as the run begins, and from the goal at any time [m]."""

POSITION_NOISE, VELOCITY_NOISE = 0.0005, 0.002
"""Standard deviations of what the planner measures, per axis [m] and [m/s]."""


@dataclasses.dataclass(frozen=True, eq=False)
class BouncingDisc:
    """A disc in straight motion, reflected at the borders of a box.

    Attributes:
        centre: position at time 0, shape (2,) [m].
        velocity: at time 0, shape (2,) [m/s].
        radius: [m].
        lower: least coordinates of the centre, shape (2,) [m].
        upper: greatest coordinates of the centre, shape (2,) [m].
    """

    centre: NDArray
    velocity: NDArray
    radius: float
    lower: NDArray
    upper: NDArray

    def state(self, time: float) -> tuple[NDArray, NDArray]:
        """Position and velocity at a time [s], each (2,)."""
        size = self.upper - self.lower
        way = (self.centre - self.lower + time * self.velocity) % (2.0 * size)
        back = way > size
        position = self.lower + np.where(back, 2.0 * size - way, way)
        return position, np.where(back, -self.velocity, self.velocity)

    def turns(self, end: float) -> NDArray:
        """Times of all reflections before `end` [s]."""
        found = []
        for axis in np.flatnonzero(self.velocity):
            speed, size = self.velocity[axis], self.upper[axis] - self.lower[axis]
            ahead = (self.upper if speed > 0.0 else self.lower)[axis] - self.centre[axis]
            first = ahead / speed
            found.append(np.arange(first, end, size / abs(speed)))
        return np.sort(np.concatenate(found)) if found else np.zeros(0)


def random_discs(rng: np.random.Generator, start: NDArray, end: float) -> tuple[BouncingDisc, ...]:
    """Discs for one run that lasts until `end` [s] at most; see the module for what is excluded."""
    count = int(rng.integers(COUNTS[0], COUNTS[1] + 1))
    discs: list[BouncingDisc] = []
    while len(discs) < count:
        radius, speed, bearing = rng.uniform(*RADII), rng.uniform(*SPEEDS), rng.uniform(-np.pi, np.pi)
        lower, upper = REGION[0] + radius, REGION[1] - radius
        velocity = speed * np.array([math.cos(bearing), math.sin(bearing)])
        disc = BouncingDisc(rng.uniform(lower, upper), velocity, radius, lower, upper)
        path = np.array([disc.state(time)[0] for time in np.arange(0.0, end, 0.05)])
        covers_goal = np.hypot(*(path - GOAL).T).min() < radius + GOAL_CLEARANCE
        if not covers_goal and np.hypot(*(disc.centre - start)) >= radius + START_CLEARANCE:
            discs.append(disc)
    return tuple(discs)


def measured(discs: tuple[BouncingDisc, ...], time: float, rng: np.random.Generator) -> list[MovingDisc]:
    """What the planner sees at a time [s]; the clocks of the discs start then."""
    seen = []
    for disc in discs:
        position, velocity = disc.state(time)
        noise = rng.standard_normal((2, 2))
        seen.append(
            MovingDisc(
                position + POSITION_NOISE * noise[0], disc.radius, velocity + VELOCITY_NOISE * noise[1]
            )
        )
    return seen


def stays(discs: tuple[BouncingDisc, ...], motion: Trajectory) -> list[Stay]:
    """When a motion is inside an obstacle, exact at every instant: between their turns discs go straight."""
    first, last = motion.start_time, motion.end_time
    turns = np.unique(np.concatenate([np.zeros(0), *(disc.turns(last) for disc in discs)]))
    found = []
    for begin, end in itertools.pairwise([first, *turns[(turns > first) & (turns < last)], last]):
        found += _world_between(discs, begin, end).stays(motion.clipped(begin, end))
    return found


def _world_between(discs: tuple[BouncingDisc, ...], begin: float, end: float) -> PlanarWorld:
    """The world while no disc turns; its clock is that of the run."""
    middle = 0.5 * (begin + end)
    straight = []
    for disc in discs:
        position, velocity = disc.state(middle)
        straight.append(MovingDisc(position, disc.radius, velocity))
    return CLUTTER.with_discs(tuple(straight)).at(-middle)
