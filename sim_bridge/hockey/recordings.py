"""Recorded episodes of the air-hockey world to learn from: pucks that run free, and pucks that are struck.

Everything recorded is in the table frame, and true: no camera is between.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_bridge.hockey import table
from sim_bridge.hockey.contact_log import PuckContact
from sim_bridge.hockey.scene import START_JOINTS, AirHockeyScene
from sim_bridge.hockey.world import AirHockeyWorld
from sim_bridge.trajectory_follower import TrajectoryCommand
from vpsto_ros.contact.puck import HockeyTable
from vpsto_ros.contact.puck_learning import PuckRecording
from vpsto_ros.exceptions import InfeasibleError, InvalidInputError
from vpsto_ros.robot.inverse_kinematics import solve
from vpsto_ros.robot.kinematics import Robot

TABLE = HockeyTable(
    table.HALF_LENGTH, table.HALF_WIDTH, 2 * table.GOAL_HALF_WIDTH, table.PUCK_RADIUS, table.MALLET_RADIUS
)
"""What a planner may know of the table."""
PERIOD = 0.02
STEPS = 50
CONTACT_TIME = 0.021
"""Longest time that mallet and puck stay in touch [s]; a third longer than a hit at rest takes."""
KINDS = ("free", "struck")

_ASIDE = (1.4, *START_JOINTS[1:])  # holds the mallet beside the table [rad]
_STRIKES = 40  # tries to find a strike within the limits
_LINGER = 100  # steps of the world that the end of a last contact is waited for
_KNOTS = 0.02  # between the points of a strike [s]


@dataclasses.dataclass(frozen=True)
class Strike:
    """A straight motion of the mallet from rest to rest, with a puck in its way; table frame.

    Attributes:
        place: of the puck's centre when it is touched, shape (2,) [m].
        angle: direction of the mallet's motion, from +x [rad].
        speed: greatest speed of the mallet [m/s].
        length: of the whole motion [m].
        phase: part of the motion's duration after which the puck is touched.
        aside: how far the puck's centre is beside the mallet's line, left positive [m].
        puck_velocity: before, shape (2,) [m/s].
    """

    place: NDArray[np.float64]
    angle: float
    speed: float
    length: float
    phase: float
    aside: float
    puck_velocity: NDArray[np.float64]

    @classmethod
    def draw(cls, rng: np.random.Generator) -> "Strike":
        """One on the robot's half of the table, more often near the puck's middle, as who shoots hits it."""
        return cls(
            place=rng.uniform((-0.65, -0.35), (-0.2, 0.35)), angle=rng.uniform(-1.2, 1.2),
            speed=rng.uniform(0.3, 1.4), length=rng.uniform(0.15, 0.35), phase=rng.uniform(0.4, 0.65),
            aside=rng.uniform(-0.05, 0.05) * rng.random(), puck_velocity=rng.normal(0.0, 0.2, 2),
        )  # fmt: skip

    @property
    def duration(self) -> float:
        """Of the motion [s]; a quintic's greatest speed is 15/8 of its mean."""
        return 1.875 * self.length / self.speed

    @property
    def direction(self) -> NDArray[np.float64]:
        """Unit vector (2,) of the mallet's motion."""
        return np.array([math.cos(self.angle), math.sin(self.angle)])

    def motion(self, times: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Places and velocities (K, 2) of the mallet at times (K,) [s] after its start."""
        s = np.clip(times / self.duration, 0.0, 1.0)[:, None]
        way = self.length * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        rate = self.length * 30.0 * (s * (1.0 - s)) ** 2 / self.duration
        return self._start + way * self.direction, rate * self.direction

    def puck_start(self) -> NDArray[np.float64]:
        """Where the puck is when the mallet starts, shape (2,) [m]."""
        return self.place - self.phase * self.duration * self.puck_velocity

    @property
    def _start(self) -> NDArray[np.float64]:
        left = np.array([-self.direction[1], self.direction[0]])
        ahead = math.sqrt(TABLE.contact_distance**2 - self.aside**2)
        touching = self.place - ahead * self.direction - self.aside * left
        s = self.phase
        return touching - self.length * s**3 * (10.0 - 15.0 * s + 6.0 * s**2) * self.direction


@dataclasses.dataclass(frozen=True, eq=False)
class Episode:
    """What one episode showed.

    Attributes:
        kind: "free" or "struck".
        recording: true states of the puck and of the mallet's centre, table frame.
        tilt: of the mallet towards x and towards y, shape (T, 2) [rad].
        start: of the episode on the clock of its contacts [s].
        contacts: what the puck touched, in the base frame.
    """

    kind: str
    recording: PuckRecording
    tilt: NDArray[np.float64]
    start: float
    contacts: tuple[PuckContact, ...]


class Recorder:
    """Records episodes in one world, each from its own seed."""

    def __init__(self, scene: AirHockeyScene | None = None):
        """Build the world."""
        self.world = AirHockeyWorld(scene)

    def episode(self, kind: str, seed: Sequence[int], steps: int = STEPS) -> Episode:
        """One episode.

        Args:
            kind: "free": a fast puck, the arm stands aside; "struck": the mallet strikes it.
            seed: of everything random, numbers from 0 up.
            steps: samples after the first.

        Raises:
            InvalidInputError: there is no such kind, or there is not a single step.
            InfeasibleError: no strike was found that keeps the arm's limits.
        """
        if kind not in KINDS or steps < 1:
            raise InvalidInputError(f"expected a kind of {KINDS} and steps >= 1, got {kind!r} and {steps}")
        rng = np.random.default_rng([*seed, KINDS.index(kind)])
        if kind == "free":
            self._throw(rng)
            return self._record(kind, steps)
        for _ in range(_STRIKES):
            before = self.world.limits.violations
            if self._strike(rng):
                episode = self._record(kind, steps)
                # With the first and third axis in line (joint 2 near 0) the stiff arm may begin to shake.
                if self.world.limits.violations == before:
                    return episode
        raise InfeasibleError(f"none of {_STRIKES} random strikes is within the arm's limits")

    def _throw(self, rng: np.random.Generator) -> None:
        """A fast puck anywhere."""
        place = rng.uniform((-0.92, -0.47), (0.92, 0.47))
        angle, speed = rng.uniform(-math.pi, math.pi), rng.uniform(0.4, 2.5)
        velocity = speed * math.cos(angle), speed * math.sin(angle), 0.0
        self.world.reset((*table.to_base(place), 0.0), velocity, joints=_ASIDE)

    def _strike(self, rng: np.random.Generator) -> bool:
        """Begin a random strike; whether the arm can do it."""
        strike = Strike.draw(rng)
        try:
            command = strike_command(strike, self.world.robot)
            pose, velocity = (*table.to_base(strike.puck_start()), 0.0), (*strike.puck_velocity, 0.0)
            self.world.reset(pose, velocity, joints=np.asarray(command.positions)[0])
            self.world.follower.accept(command, self.world.time)
        except (InfeasibleError, InvalidInputError):
            return False  # out of reach, refused by the follower, or the puck would not be on the table
        return True

    def _record(self, kind: str, steps: int) -> Episode:
        world, start = self.world, self.world.time
        pucks, mallets, tilts = [], [], []
        for step in range(steps + 1):
            if step:
                world.advance(PERIOD)
            pucks.append(puck_state(world))
            mallets.append(mallet_state(world))
            tilts.append(world.mallet_state().tilt)
        for _ in range(_LINGER):  # a contact is known when it has ended
            if not world.touching:
                break
            world.step()
        recording = PuckRecording(PERIOD, np.array(pucks), np.array(mallets))
        return Episode(kind, recording, np.array(tilts), start, tuple(world.contacts))


def puck_state(world: AirHockeyWorld) -> NDArray[np.float64]:
    """True (x, y, vx, vy) of the puck in the table frame [m, m/s]."""
    return np.concatenate([table.to_table(world.puck_pose()[:2]), world.puck_twist()[:2]])


def mallet_state(world: AirHockeyWorld) -> NDArray[np.float64]:
    """The same of the mallet's centre."""
    state = world.mallet_state()
    return np.concatenate([table.to_table(state.position[:2]), state.velocity[:2]])


def kind_of(index: int) -> str:
    """Kinds take turns: half of the episodes are free, half struck."""
    return KINDS[index % len(KINDS)]


def strike_command(strike: Strike, robot: Robot) -> TrajectoryCommand:
    """The arm's motion for a strike, at the height of the start posture and with the least joint motion.

    Raises:
        InfeasibleError: a place is out of reach.
    """
    height = robot.forward(START_JOINTS)[0][2]
    count = max(8, math.ceil(strike.duration / _KNOTS)) + 1
    times = np.linspace(0.0, strike.duration, count)
    places, rates = strike.motion(times)
    places = table.to_base(places)
    q = solve(robot, [*places[0], height], None, START_JOINTS)
    points = np.column_stack([places, np.full(count, height)])
    rows, speeds = joints_along(robot, q, points, np.column_stack([rates, np.zeros(count)]))
    return TrajectoryCommand(robot.joint_names, 0.0, times, rows, speeds)


def joints_along(
    robot: Robot, q: NDArray, points: NDArray, rates: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Joint positions and velocities, each (K, n), that lead the tip through points with the least motion.

    Args:
        robot: the arm.
        q: joint positions near the first point, shape (n,) [rad].
        points: of the tip, base frame, close to each other, shape (K, 3) [m].
        rates: its velocities there, shape (K, 3) [m/s].
    """
    rows, speeds = [], []
    for point, rate in zip(points, rates, strict=True):
        for _ in range(3):
            q = q + np.linalg.pinv(robot.jacobian(q)[:3]) @ (point - robot.forward(q)[0])
        rows.append(q)
        speeds.append(np.linalg.pinv(robot.jacobian(q)[:3]) @ rate)
    return np.array(rows), np.array(speeds)
