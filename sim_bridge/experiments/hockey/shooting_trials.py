"""One shot of the experiment: the agent against the simulated world at 50 Hz, and what came of it."""

import dataclasses
import gc
import math
import time
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.hockey.shooting_players import player
from sim_bridge.experiments.hockey.shooting_starts import ShotTask, world_of
from sim_bridge.hockey.contact_log import MALLET, ONE_TOUCH, PuckContact
from sim_bridge.hockey.recordings import mallet_state, puck_state
from sim_bridge.hockey.world import AirHockeyWorld
from sim_bridge.trajectory_follower import TrajectoryCommand, TrajectoryRejected
from vpsto_ros.planning.hockey.agent import JointReferences, Observation, PuckSighting
from vpsto_ros.planning.hockey.shooting_config import Shot

STEPS = 20
"""Steps of the world, 1 ms each, in a cycle of the agent."""
WITHOUT_TOUCH, AFTER_TOUCH = 10.0, 4.0
"""How long a shot is waited for, and how long its goal [s]."""
AT_REST = 0.02
"""A puck that is slower has come to rest [m/s]."""
WATCHED = 1.5
"""Limits and rules are watched for so long after the touch at least: until the arm is on its way back [s]."""
GOAL = "goal"


class Player(Protocol):
    """What shoots."""

    def act(self, observation: Observation) -> JointReferences:
        """References until the next observation."""


@dataclasses.dataclass(frozen=True, eq=False)
class ShotResult:
    """What came of a shot.

    Attributes:
        task: which it was.
        end: "goal", or in words why there was none.
        goal_speed: of the puck on the goal line, NaN if it did not score [m/s].
        banks: rims touched between touch and goal, if it scored.
        shot: what was intended last before the touch, None if nothing was.
        mallet: true state of the mallet's centre at the touch, table frame, shape (4,); None without one.
        violations: control cycles beyond limits of the arm ("limits") and against each rule that was broken.
        refused: trajectories that the arm's driver refused.
        computing: processor time of each step of the agent [s], shape (K,).
        elapsed: the same by the clock, shape (K,).
        path: true states of the puck at each step, shape (P, 4), table frame.
        touched: index of the first of them after the touch; P without one.
    """

    task: ShotTask
    end: str
    goal_speed: float
    banks: int
    shot: Shot | None
    mallet: NDArray[np.float64] | None
    violations: dict[str, int]
    refused: int
    computing: NDArray[np.float64]
    elapsed: NDArray[np.float64]
    path: NDArray[np.float64]
    touched: int

    @property
    def scored(self) -> bool:
        """Whether the puck is in the far goal."""
        return self.end == GOAL

    @property
    def predicted(self) -> float:
        """Probability of scoring at the last commitment; NaN if there was none."""
        return self.shot.goal if self.shot is not None else math.nan

    @property
    def mallet_error(self) -> NDArray[np.float64]:
        """What the mallet was off at the touch, shape (3,), NaN without one.

        Along its intended motion and across it, left positive [m]; of its speed [m/s].
        """
        if self.shot is None or self.mallet is None:
            return np.full(3, np.nan)
        c, s = math.cos(self.shot.angle), math.sin(self.shot.angle)
        off = self.mallet - self.shot.mallet
        return np.array([c * off[0] + s * off[1], c * off[1] - s * off[0], c * off[2] + s * off[3]])


def trial(task: ShotTask) -> ShotResult:
    """A shot in a fresh world by a fresh player.

    What is there before it is kept from the garbage collector, as programs in real time do.
    """
    world, agent = world_of(task), player(task.name, task.seed)
    gc.collect()
    gc.freeze()
    try:
        return Trial(task, world, agent).run()
    finally:
        gc.unfreeze()


class Trial:
    """The loop of a shot, and what is seen of it."""

    def __init__(self, task: ShotTask, world: AirHockeyWorld, agent: Player) -> None:
        """Begin now, in a world in which the puck has just been put down."""
        self.task, self.world, self.agent = task, world, agent
        self._began = world.time
        self._touch = math.inf  # when the mallet touched the puck first
        self._mallet: NDArray[np.float64] | None = None  # its state then
        self._crossed = False  # whether the puck has been on the other half after the touch
        self._again = False
        self._shot: Shot | None = None  # the last one before the touch
        self._refused, self._touched = 0, 0
        self._computing: list[float] = []
        self._elapsed: list[float] = []
        self._path = [puck_state(world)]

    def run(self) -> ShotResult:
        """Shoot until the shot has ended, and watch the arm a while longer."""
        end = ""
        while not end:
            end = self._cycle()
        goal, path, touched = self.world.goal, np.array(self._path), self._touched
        contacts = self.world.contacts
        while self.world.time < self._touch + WATCHED < math.inf:
            self._cycle()
        scored = goal if end == GOAL else None
        return ShotResult(
            self.task, end,
            goal_speed=float(np.hypot(*scored.velocity)) if scored is not None else math.nan,
            banks=banks(contacts, self._touch, scored.time) if scored is not None else 0,
            shot=self._shot, mallet=self._mallet, violations=self._violations(), refused=self._refused,
            computing=np.array(self._computing), elapsed=np.array(self._elapsed), path=path,
            touched=touched or len(path),
        )  # fmt: skip

    def _cycle(self) -> str:
        """A step of the agent and what the world makes of it; why the shot has ended, empty if it has not."""
        world = self.world
        frames = world.camera_frames()
        sightings = tuple(PuckSighting(frame.stamp, frame.pose[:2]) for frame in frames)
        observation = Observation(world.time, world.joint_position, world.joint_velocity, sightings)
        elapsed, computing = time.perf_counter(), time.process_time()
        references = self.agent.act(observation)
        self._computing.append(time.process_time() - computing)
        self._elapsed.append(time.perf_counter() - elapsed)
        if references.shot is not None and self._touch == math.inf:
            self._shot = references.shot
        self._follow(references)
        end = ""
        for _ in range(STEPS):
            world.step()
            self._watch_touches()
            end = end or self._ended()
        self._path.append(puck_state(world))
        if self._touch < math.inf and not self._touched:
            self._touched = len(self._path) - 1
        return end

    def _follow(self, references: JointReferences) -> None:
        trajectory, world = references.step.trajectory, self.world
        if trajectory is None:
            return
        try:
            world.follower.accept(TrajectoryCommand.of(trajectory, world.robot.joint_names), world.time)
        except TrajectoryRejected:
            self._refused += 1

    def _watch_touches(self) -> None:
        if MALLET not in self.world.touching:
            return
        if self._touch == math.inf:
            self._touch, self._mallet = self.world.time, mallet_state(self.world)
        elif self.world.time > self._touch + ONE_TOUCH:
            self._again = True

    def _ended(self) -> str:
        """Why the shot has ended, empty if it has not."""
        world = self.world
        now, puck, touched = world.time, puck_state(world), self._touch < math.inf
        self._crossed |= touched and puck[0] > 0.0
        checks = {
            GOAL: touched and world.goal is not None and world.goal.end == "far",
            "a goal without a touch": not touched and world.goal is not None and world.goal.end == "far",
            "the robot's own goal": world.goal is not None and world.goal.end == "near",
            "struck twice": self._again,
            "missed, and came back": self._crossed and puck[0] < 0.0,
            "came to rest": touched and now > self._touch + ONE_TOUCH and np.hypot(*puck[2:]) < AT_REST,
            "no goal in time": now > self._touch + AFTER_TOUCH,
            "never touched": not touched and now > self._began + WITHOUT_TOUCH,
        }
        return next((end for end, there in checks.items() if there), "")

    def _violations(self) -> dict[str, int]:
        broken = {"limits": self.world.limits.violations, **self.world.rules.report().violations}
        return {kind: count for kind, count in broken.items() if count}


def banks(contacts: list[PuckContact], touch: float, goal: float) -> int:
    """Rims that the puck touched between two times [s]."""
    return sum(c.surface != MALLET and touch <= c.start < goal for c in contacts)
