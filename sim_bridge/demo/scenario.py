"""What happens to target and box in the pushing demo: jumps, one knock by hand, a drift. No ROS, no clock."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

REACHED_DISTANCE = 0.010
HOLD_TIME = 1.0
DRIFT_SPEED = 0.02
DRIFT_MEDIAN_DISTANCE = 0.025
LONGEST_STEP = 0.04
"""How far the hand's force may grow without seeing what it does [s]."""


@dataclass(frozen=True)
class Area:
    """The part of the table where targets are, well inside the planner's default workspace for objects.

    Attributes:
        x: range in x [m], base frame.
        y: range in y [m].
    """

    x: tuple[float, float] = (0.44, 0.60)
    y: tuple[float, float] = (-0.25, 0.25)

    def contains(self, point: NDArray[np.float64]) -> bool:
        """Whether a point (2,) [m] lies in the area."""
        return bool(self.x[0] <= point[0] <= self.x[1] and self.y[0] <= point[1] <= self.y[1])

    def sample(
        self, rng: np.random.Generator, away_from: NDArray[np.float64], distance: float
    ) -> NDArray[np.float64]:
        """A random point (2,) that keeps a distance [m] from another one."""
        while True:
            point = np.array([rng.uniform(*self.x), rng.uniform(*self.y)])
            if np.linalg.norm(point - away_from) >= distance:
                return point


@dataclass
class Phase:
    """One part of the scenario and how it went.

    Attributes:
        name: what happens, in a few words.
        timeout: the longest it may take [s].
        start: when it began [s], NaN before.
        end: when it ended [s], NaN before.
        reached: when the box had come within reach and stayed there long enough [s], NaN if it never did.
    """

    name: str
    timeout: float
    start: float = math.nan
    end: float = math.nan
    reached: float = math.nan

    @property
    def time_to_reach(self) -> float:
        """From the start of the phase until the box was at the target and stayed [s]; NaN if it never was."""
        return self.reached - self.start


class Knock:
    """A hand that shoves the box: it holds a speed by a force, until the box has moved far enough.

    The force grows for as long as the box does not follow, so neither mass nor friction has to be known.
    """

    def __init__(
        self, direction: NDArray[np.float64], distance: float, speed: float = 0.25, force_limit: float = 8.0
    ):
        """Describe the shove.

        Args:
            direction: where to, (2,), any length.
            distance: how far [m].
            speed: of the hand [m/s].
            force_limit: the strongest force [N]. A stronger one could throw the box off the table when a busy
                machine answers late.
        """
        self.direction = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
        self.distance, self.speed, self.force_limit = distance, speed, force_limit
        self.done = False
        self._start: NDArray[np.float64] | None = None
        self._last: tuple[float, float] | None = None
        self._integral = 0.0

    def force(self, now: float, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """The force (2,) [N] at a time [s] when the box is at a position (2,) [m]; zero once it is over."""
        if self._start is None:
            self._start = np.array(position, dtype=float)
        travelled = float((position - self._start) @ self.direction)
        last_time, last_travelled = self._last or (now, travelled)
        elapsed = now - last_time
        velocity = (travelled - last_travelled) / elapsed if elapsed > 0.0 else 0.0
        self._last = (now, travelled)
        # What the box still slides while the last command is under way and friction stops it.
        self.done = self.done or travelled + 0.04 * max(velocity, 0.0) >= self.distance
        if self.done:
            return np.zeros(2)
        missing = self.speed - velocity
        self._integral = min(self._integral + 80.0 * missing * min(elapsed, LONGEST_STEP), self.force_limit)
        return float(np.clip(10.0 * missing + self._integral, 0.0, self.force_limit)) * self.direction


@dataclass(frozen=True)
class Orders:
    """What the scenario wants now.

    Attributes:
        goal: the target's position (2,) [m].
        goal_moves: whether the target is drifting, so that it should be published again and again.
        force: the hand's force on the box (2,) [N]; None when there is no hand.
    """

    goal: NDArray[np.float64]
    goal_moves: bool = False
    force: NDArray[np.float64] | None = None


@dataclass
class Scenario:
    """Three jumps of the target with one knock in between, a drift, and a standing target at the end.

    A jump ends as soon as the box has been within 10 mm of the target for one second, or at its timeout.

    Attributes:
        rng: chooses the targets and the knock.
        duration: the longest the scenario may take [s].
        drift_time: how long the target drifts [s], but at most a fifth of the duration.
        area: where targets are.
    """

    rng: np.random.Generator
    duration: float = 90.0
    drift_time: float = 12.0
    area: Area = field(default_factory=Area)

    def __post_init__(self) -> None:
        """Lay out the phases."""
        drift = min(self.drift_time, 0.2 * self.duration)
        jump = (self.duration - drift) / 5.0
        limits = {
            "target 1": jump,
            "target 2": jump,
            "knock": jump,
            "target 3": jump,
            "drift": drift,
            "rest": jump,
        }
        self.phases = [Phase(name, timeout) for name, timeout in limits.items()]
        self.index = -1
        self.drift_distances: list[float] = []
        self._goal = np.zeros(2)
        self._inside_since = math.nan
        self._knock: Knock | None = None
        self._drift_direction = 1.0
        self._now = math.nan

    @property
    def phase(self) -> Phase:
        """The present phase (the first one before the start, the last one after the end)."""
        return self.phases[min(max(self.index, 0), len(self.phases) - 1)]

    @property
    def finished(self) -> bool:
        """Whether every phase is over."""
        return self.index >= len(self.phases)

    @property
    def progress(self) -> float:
        """Share of the phases that are over, between 0 and 1."""
        return max(self.index, 0) / len(self.phases)

    def step(self, now: float, box: NDArray[np.float64], tool: NDArray[np.float64]) -> Orders:
        """Advance to a time.

        Args:
            now: simulated time [s], never going back.
            box: position of the box (2,) [m].
            tool: position of the pushing tool (2,) [m]; the hand shoves the box away from it.

        Returns:
            What to command now.
        """
        if self.index < 0:
            self._enter(0, now, box, tool)
        elapsed = now - self._now if math.isfinite(self._now) else 0.0
        self._now = now
        name = self.phase.name
        if name == "drift":
            self._drift(elapsed)
            self.drift_distances.append(float(np.linalg.norm(box - self._goal)))
        force = (
            self._knock.force(now, box) if name == "knock" and self._knock and not self._knock.done else None
        )
        self._watch(now, box, busy=force is not None)
        if not self.finished and self._over(now):
            self._enter(self.index + 1, now, box, tool)
        return Orders(self._goal.copy(), name == "drift", force)

    def _watch(self, now: float, box: NDArray[np.float64], *, busy: bool) -> None:
        """Note since when the box has been at the target."""
        if busy or np.linalg.norm(box - self._goal) > REACHED_DISTANCE:
            self._inside_since = math.nan
        elif math.isnan(self._inside_since):
            self._inside_since = now
        phase = self.phase
        if now - self._inside_since >= HOLD_TIME and math.isnan(phase.reached):
            phase.reached = self._inside_since

    def _over(self, now: float) -> bool:
        phase = self.phase
        timed_out = now - phase.start >= phase.timeout
        return timed_out or (phase.name != "drift" and math.isfinite(phase.reached))

    def _enter(self, index: int, now: float, box: NDArray[np.float64], tool: NDArray[np.float64]) -> None:
        if index > 0:
            self.phases[index - 1].end = now
        self.index = index
        self._inside_since = math.nan
        if self.finished:
            return
        self.phase.start = now
        if self.phase.name.startswith("target"):
            self._goal = self.area.sample(self.rng, box, distance=0.15)
        elif self.phase.name == "knock":
            self._knock = self._aim(box, tool)
        elif self.phase.name == "drift":
            self._drift_direction = -1.0 if self._goal[1] > 0.0 else 1.0

    def _aim(self, box: NDArray[np.float64], tool: NDArray[np.float64]) -> Knock:
        """A shove of 5 to 10 cm, away from the tool, that leaves the box among the targets."""
        away = math.atan2(box[1] - tool[1], box[0] - tool[0])
        for spread in np.linspace(0.3, math.pi, 200):
            angle, distance = away + self.rng.uniform(-spread, spread), self.rng.uniform(0.06, 0.09)
            direction = np.array([math.cos(angle), math.sin(angle)])
            if self.area.contains(box + distance * direction):
                break
        return Knock(direction, distance)

    def _drift(self, elapsed: float) -> None:
        """Sideways in front of the robot, turning back at the edge of the area."""
        if not self.area.y[0] < self._goal[1] + 0.005 * self._drift_direction < self.area.y[1]:
            self._drift_direction = -self._drift_direction
        self._goal = self._goal + np.array([0.0, self._drift_direction * DRIFT_SPEED * elapsed])
