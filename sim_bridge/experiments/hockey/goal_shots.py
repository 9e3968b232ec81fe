"""Shots of the simulated arm at the far goal: what the puck model expects of them, and what became of them.

The model aims, so that goals of every probability occur by way of no wall and of some: of a fan of shooting
angles, the one is struck whose probability is nearest to one that is drawn. The arm strikes as well as it
can; the mallet swings, so that the touch is another than was meant. What counts is predicted twice: from the
true states at the touch, and from such as a planner has, off by an error whose covariance is known. Table
frame.
"""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from sim_bridge.hockey import table
from sim_bridge.hockey.contact_log import MALLET, PuckContact
from sim_bridge.hockey.recordings import TABLE, Strike, puck_state, strike_command
from sim_bridge.hockey.world import AirHockeyWorld
from vpsto_ros.contact.puck import PuckModel, ShotOutlook
from vpsto_ros.exceptions import InfeasibleError, InvalidInputError

LONGEST = 5.0
"""So long after the touch a puck may take to the goal line [s]."""
LATEST = 3.0
"""Later ones are not aimed for: whether a puck that creeps comes in time is no question of where [s]."""
ANGLES = np.linspace(-1.25, 1.25, 251)
"""Shooting angles among which the model chooses [rad]."""

SPREAD = np.diag([1e-3, 1e-3, 0.01, 0.01]) ** 2
"""What a planner does not know of the puck beside the mallet at their touch: 1 mm and 10 mm/s."""

_WANTED = (0.1, 1.05)  # probabilities that are aimed at; safer and less safe shots come by themselves
_SLOWEST = 0.02  # slower pucks have stopped [m/s]
_TICK = 0.01  # between two looks at the puck [s]


@dataclasses.dataclass(frozen=True, eq=False)
class Shot:
    """One shot.

    Attributes:
        puck: true state of the puck when the mallet touched it, shape (4,) [m, m/s].
        mallet: and of the mallet's centre, shape (4,).
        predicted: probability of a goal, from a state that is off by an error of covariance SPREAD.
        banks: walls that the model then expects on the way.
        predicted_truly: probability from the true state.
        banks_truly: and walls.
        scored: whether the puck went into the far goal when it first came there.
    """

    puck: NDArray[np.float64]
    mallet: NDArray[np.float64]
    predicted: float
    banks: int
    predicted_truly: float
    banks_truly: int
    scored: bool


def shoot(world: AirHockeyWorld, model: PuckModel, rng: np.random.Generator) -> Shot | None:
    """Aim and strike; None if the arm cannot strike so, misses, breaks its limits or touches the puck twice.

    Args:
        world: any.
        model: aims and predicts.
        rng: of place, speed and aim.
    """
    strike = aim(model, rng)
    before = world.limits.violations
    if strike is None or not _begin(world, strike):
        return None
    _watch(world, strike)
    hits = [contact for contact in world.contacts if contact.surface == MALLET]
    if len(hits) != 1 or world.limits.violations > before:
        return None
    puck, mallet = states_at(hits[0])
    seen = rng.multivariate_normal(puck, SPREAD)
    expected = model.shots(seen, SPREAD, mallet[None], longest=LONGEST)
    truly = model.shots(puck, np.zeros((4, 4)), mallet[None], longest=LONGEST)
    return Shot(
        puck, mallet, float(expected.goal[0]), int(expected.banks[0]), float(truly.goal[0]),
        int(truly.banks[0]), world.goal is not None and world.goal.end == "far",
    )  # fmt: skip


def aim(model: PuckModel, rng: np.random.Generator) -> Strike | None:
    """A strike, half of them direct, half by way of walls; None if there is no such way from there."""
    place, speed = rng.uniform((-0.65, -0.35), (-0.2, 0.35)), rng.uniform(0.6, 1.4)
    velocity, length, phase = rng.normal(0.0, 0.1, 2), rng.uniform(0.2, 0.35), rng.uniform(0.4, 0.6)
    direct, wanted = bool(rng.random() < 0.5), rng.uniform(*_WANTED)
    outlook = fan(model, np.append(place, velocity), speed)
    # The angle that is taken is one of those nearest to what is wanted, not always the same side's.
    fits = np.flatnonzero((outlook.time <= LATEST) & ((outlook.banks == 0) == direct))
    if len(fits) == 0:
        return None
    gaps = np.abs(outlook.goal[fits] - wanted) + 0.03 * rng.random(len(fits))
    angle = float(ANGLES[fits[int(np.argmin(gaps))]])
    return Strike(place, angle, speed, length, phase, 0.0, velocity)


def fan(model: PuckModel, puck: NDArray, speed: float) -> ShotOutlook:
    """Outlooks of central shots at all angles with one speed [m/s]."""
    directions = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
    mallets = np.hstack([puck[:2] - TABLE.contact_distance * directions, speed * directions])
    return model.shots(puck, SPREAD, mallets, longest=LONGEST)


def states_at(contact: PuckContact) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Puck and mallet, each (x, y, vx, vy), when they touched."""
    assert contact.mallet is not None
    puck = np.array([*table.to_table(contact.pose[:2]), *contact.velocity_before[:2]])
    mallet = contact.mallet
    return puck, np.array([*table.to_table(mallet.position[:2]), *mallet.velocity[:2]])


def _begin(world: AirHockeyWorld, strike: Strike) -> bool:
    """Whether the arm can do it."""
    try:
        command = strike_command(strike, world.robot)
        pose, velocity = (*table.to_base(strike.puck_start()), 0.0), (*strike.puck_velocity, 0.0)
        world.reset(pose, velocity, joints=np.asarray(command.positions)[0])
        world.follower.accept(command, world.time)
    except (InfeasibleError, InvalidInputError):
        return False
    return True


def _watch(world: AirHockeyWorld, strike: Strike) -> None:
    """Go on until the shot is over: a goal, back from the far end, stopped, or too late."""
    latest = world.time + strike.duration + LONGEST
    while world.goal is None and world.time < latest:
        world.advance(_TICK)
        contacts = world.contacts
        hits = sum(contact.surface == MALLET for contact in contacts)
        x, _, vx, vy = puck_state(world)
        if hits == 0:
            if world.time > latest - LONGEST + 0.2:
                return  # missed
            continue
        came = any(contact.surface == "far" for contact in contacts)
        if hits > 1 or (came and vx < 0.0 and x < TABLE.reach[0]) or math.hypot(vx, vy) < _SLOWEST:
            return
