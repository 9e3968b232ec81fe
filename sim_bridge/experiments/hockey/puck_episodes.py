"""Pucks that float, bounce and are hit in the air-hockey world, as seen by its camera."""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from sim_bridge.hockey import table
from sim_bridge.hockey.recordings import TABLE, joints_along, mallet_state, puck_state
from sim_bridge.hockey.scene import START_JOINTS
from sim_bridge.hockey.world import AirHockeyWorld
from sim_bridge.trajectory_follower import TrajectoryCommand, TrajectoryRejected
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.iiwa import JOINT_NAMES, iiwa14

KINDS = ("bounces", "hits")
DURATION = 2.0
MALLET_PERIOD = 0.01
"""The mallet is measured at 100 Hz, as joint states come."""
MALLET_STD = (3e-4, 5e-3)
"""How well: position [m], velocity [m/s]."""

_MOUTH = 0.01  # so near a goal an episode ends [m]
_DRAG = 0.5  # only to place pucks so that they meet the mallet [1/s]


@dataclasses.dataclass(frozen=True)
class Episode:
    """What happens; its randomness comes from kind and seed.

    Attributes:
        kind: "bounces": a puck that runs about; "hits": one that the mallet strikes.
        seed: of everything random.
    """

    kind: str
    seed: int


@dataclasses.dataclass(frozen=True, eq=False)
class Log:
    """An episode at 1 kHz, in the table's frame; it ends early when the puck comes to a goal.

    Attributes:
        times: [s], shape (T,).
        puck: true states (x, y, vx, vy), shape (T, 4) [m, m/s].
        mallet: true states of its centre, likewise.
        arrivals: when positions arrive [s], shape (F,).
        stamps: when they were taken [s], shape (F,).
        positions: what they say, shape (F, 2) [m].
        mallet_measured: (stamp, x, y, vx, vy), shape (M, 5).
        contacts: (begin, end) of contacts with "wall" and "mallet" [s], each (C, 2).
    """

    times: NDArray[np.float64]
    puck: NDArray[np.float64]
    mallet: NDArray[np.float64]
    arrivals: NDArray[np.float64]
    stamps: NDArray[np.float64]
    positions: NDArray[np.float64]
    mallet_measured: NDArray[np.float64]
    contacts: dict[str, NDArray[np.float64]]


def record(episode: Episode) -> Log:
    """Run an episode."""
    rng = np.random.default_rng([KINDS.index(episode.kind), episode.seed])
    world = AirHockeyWorld(seed=int(rng.integers(2**31)))
    if episode.kind == "hits":
        _begin_hit(world, rng)
    else:
        _begin_bounces(world, rng)
    rows, frames = [], []
    for _ in range(round(1e3 * DURATION)):
        rows.append([world.time, *puck_state(world), *mallet_state(world)])
        frames += [(world.time, f.stamp, *table.to_table(f.pose[:2])) for f in world.camera_frames()]
        world.step()
        if _at_a_goal(puck_state(world)):
            break
    return _log(world, np.array(rows), np.array(frames).reshape(-1, 4), rng)


def _log(world: AirHockeyWorld, rows: NDArray, frames: NDArray, rng: np.random.Generator) -> Log:
    times, puck, mallet = rows[:, 0], rows[:, 1:5], rows[:, 5:]
    measured = rows[:: round(1e3 * MALLET_PERIOD), [0, 5, 6, 7, 8]].copy()
    measured[:, 1:] += rng.normal(size=(len(measured), 4)) * np.repeat(MALLET_STD, 2)
    contacts = {
        name: np.array([
            (c.start, c.end) for c in world.contacts if (c.surface == "mallet") == (name == "mallet")
        ]).reshape(-1, 2)
        for name in ("wall", "mallet")
    }  # fmt: skip
    return Log(times, puck, mallet, frames[:, 0], frames[:, 1], frames[:, 2:], measured, contacts)


def _at_a_goal(puck: NDArray) -> bool:
    """Whether the puck enters a goal or meets a post, which the model of the puck does not know."""
    return bool(abs(puck[0]) > TABLE.reach[0] - _MOUTH and abs(puck[1]) < 0.5 * TABLE.goal_width + _MOUTH)


def _begin_bounces(world: AirHockeyWorld, rng: np.random.Generator) -> None:
    """A puck anywhere but near the mallet, at 0.8 to 2.5 m/s in any direction."""
    place = rng.uniform([-0.6, -0.45], [0.9, 0.45])
    angle, speed = rng.uniform(-math.pi, math.pi), rng.uniform(0.8, 2.5)
    world.reset((*table.to_base(place), 0.0), (speed * math.cos(angle), speed * math.sin(angle), 0.0))


def _begin_hit(world: AirHockeyWorld, rng: np.random.Generator) -> None:
    """The mallet runs along a line and meets a puck that rests or moves by up to 0.8 m/s."""
    start = table.to_table(iiwa14().forward(np.array(START_JOINTS))[0][:2])
    while True:
        angle, acceleration, speed = rng.uniform(-0.6, 0.6), rng.uniform(2.0, 5.0), rng.uniform(0.3, 1.0)
        way = np.array([math.cos(angle), math.sin(angle)])
        time = rng.uniform(0.6, 1.2) * speed / acceleration + 0.1
        command, run = strike(way, acceleration, speed, time + 0.05)
        aside = angle + rng.uniform(-0.6, 0.6)
        met = start + run(time) * way
        met += (TABLE.contact_distance - 0.003) * np.array([math.cos(aside), math.sin(aside)])
        velocity = rng.uniform(0.0, 0.8) * _direction(rng)
        # A puck that starts here is at the place of the hit in time, and has that velocity then.
        growth = math.exp(_DRAG * time)
        place = met - velocity * (growth - 1.0) / _DRAG
        try:
            world.reset((*table.to_base(place), 0.0), (*(growth * velocity), 0.0))
            world.follower.accept(command, world.time)
        except (InvalidInputError, TrajectoryRejected):  # off the table, or too fast for the arm
            continue
        return


def _direction(rng: np.random.Generator) -> NDArray[np.float64]:
    angle = rng.uniform(-math.pi, math.pi)
    return np.array([math.cos(angle), math.sin(angle)])


def strike(way: NDArray, acceleration: float, speed: float, braking: float):
    """The mallet along a line from the start posture: speeding up, going on evenly, braking.

    Args:
        way: direction (2,), of length 1.
        acceleration: of both [m/s²].
        speed: reached if there is time [m/s].
        braking: when it begins [s].

    Returns:
        the trajectory, and a function that says how far the mallet has come at a time [s] before braking.
    """
    robot, q, period = iiwa14(), np.array(START_JOINTS), 0.01
    s, v, gain = 0.0, 0.0, acceleration * period
    ways: list[float] = []
    speeds: list[float] = []
    while len(ways) * period < braking or v > 1e-9:
        s += 0.5 * period * v
        v = min(v + gain, speed) if len(ways) * period < braking else max(v - gain, 0.0)
        s += 0.5 * period * v
        ways.append(s)
        speeds.append(v)
    heading = np.array([*way, 0.0])
    points = robot.forward(q)[0] + np.outer(ways, heading)
    rows, rates = joints_along(robot, q, points, np.outer(speeds, heading))

    def run(time: float) -> float:
        rising = min(time, speed / acceleration)
        return 0.5 * acceleration * rising**2 + speed * (time - rising)

    times = period * np.arange(len(rows) + 1)
    return TrajectoryCommand(JOINT_NAMES, 0.0, times, np.vstack([q, rows]), np.vstack([0.0 * q, rates])), run
