"""What happens to target and object in a demo: jumps, knocks by hand, a drift. No ROS, no clock."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

REACHED_DISTANCE = 0.010
HOLD_TIME = 1.0
DRIFT_SPEED = 0.02
DRIFT_MEDIAN_DISTANCE = 0.025
NEAR_TOOL = 0.2
"""Tools farther away do not matter to the hand [m]."""
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
    """One part of a scenario and how it went.

    Attributes:
        name: what happens, in a few words.
        timeout: the longest it may take [s].
        begins: what happens when it begins: "jump" (of the target), "knock" (by hand), "drift" (of the
            target, to the end of the phase) or "rest" (nothing).
        goal: where the target jumps to (2,) [m]; None: somewhere.
        start: when it began [s], NaN before.
        end: when it ended [s], NaN before.
        reached: when the object had come within reach and stayed there long enough [s], NaN if it never did.
    """

    name: str
    timeout: float
    begins: str = "jump"
    goal: NDArray[np.float64] | None = None
    start: float = math.nan
    end: float = math.nan
    reached: float = math.nan

    @property
    def judged(self) -> bool:
        """Whether the object has to reach the target in it."""
        return self.begins != "drift"

    @property
    def time_to_reach(self) -> float:
        """From the start until the object was at the target and stayed [s]; NaN if it never was."""
        return self.reached - self.start


class Knock:
    """A hand that shoves the object: it holds a speed by a force, until the object has moved far enough.

    The force grows for as long as the object does not follow, so neither mass nor friction has to be known.
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
    """What happens to target and object, phase by phase.

    A phase ends as soon as the object has been at the target for a while, or at its timeout; a drift lasts
    until then.

    Attributes:
        rng: chooses targets and knocks.
        phases: in order.
        area: where targets are.
        knock_area: where knocks leave the object; where targets are if None.
        reached_distance: how near to the target counts as being there [m].
        hold_time: for how long [s].
        jump: how far from the object a target is at least that jumps somewhere [m].
    """

    rng: np.random.Generator
    phases: list[Phase]
    area: Area = field(default_factory=Area)
    reached_distance: float = REACHED_DISTANCE
    hold_time: float = HOLD_TIME
    jump: float = 0.15
    knock_area: Area | None = None

    def __post_init__(self) -> None:
        """Nothing has begun."""
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

    def step(self, now: float, box: NDArray[np.float64], tools: NDArray[np.float64]) -> Orders:
        """Advance to a time.

        Args:
            now: simulated time [s], never going back.
            box: position of the object (2,) [m].
            tools: positions of the pushing tools (E, 2) [m]; the hand shoves the object away from them.

        Returns:
            What to command now.
        """
        if self.index < 0:
            self._enter(0, now, box, tools)
        elapsed = now - self._now if math.isfinite(self._now) else 0.0
        self._now = now
        drifting = self.phase.begins == "drift"
        if drifting:
            self._drift(elapsed)
            self.drift_distances.append(float(np.linalg.norm(box - self._goal)))
        force = None if self._knock is None or self._knock.done else self._knock.force(now, box)
        self._watch(now, box, busy=force is not None)
        if not self.finished and self._over(now):
            self._enter(self.index + 1, now, box, tools)
        return Orders(self._goal.copy(), drifting, force)

    def _watch(self, now: float, box: NDArray[np.float64], *, busy: bool) -> None:
        """Note since when the object has been at the target."""
        if busy or np.linalg.norm(box - self._goal) > self.reached_distance:
            self._inside_since = math.nan
        elif math.isnan(self._inside_since):
            self._inside_since = now
        phase = self.phase
        if now - self._inside_since >= self.hold_time and math.isnan(phase.reached):
            phase.reached = self._inside_since

    def _over(self, now: float) -> bool:
        phase = self.phase
        timed_out = now - phase.start >= phase.timeout
        return timed_out or (phase.judged and math.isfinite(phase.reached))

    def _enter(self, index: int, now: float, box: NDArray[np.float64], tools: NDArray[np.float64]) -> None:
        if index > 0:
            self.phases[index - 1].end = now
        self.index = index
        self._inside_since, self._knock = math.nan, None
        if self.finished:
            return
        phase = self.phase
        phase.start = now
        if phase.begins == "jump":
            goal = phase.goal
            self._goal = self.area.sample(self.rng, box, self.jump) if goal is None else goal
        elif phase.begins == "knock":
            self._knock = self._aim(box, tools)
        elif phase.begins == "drift":
            self._drift_direction = -1.0 if self._goal[1] > 0.0 else 1.0

    def _aim(self, box: NDArray[np.float64], tools: NDArray[np.float64]) -> Knock:
        """A shove of 6 to 9 cm, away from the tools, that leaves the object where it can be brought back."""
        offsets = np.reshape(tools, (-1, 2)) - box
        away = math.atan2(*-offsets.mean(axis=0)[::-1])
        near = offsets[np.linalg.norm(offsets, axis=1) < NEAR_TOOL]
        area = self.area if self.knock_area is None else self.knock_area
        for spread in np.linspace(0.3, math.pi, 200):
            angle, distance = away + self.rng.uniform(-spread, spread), self.rng.uniform(0.06, 0.09)
            direction = np.array([math.cos(angle), math.sin(angle)])
            # Against a tool the hand would press until the object slips out, no matter where to.
            clear = bool((near @ direction <= 0.3 * np.linalg.norm(near, axis=1)).all())
            if clear and area.contains(box + distance * direction):
                break
        return Knock(direction, distance)

    def _drift(self, elapsed: float) -> None:
        """Sideways in front of the robot, turning back at the edge of the area."""
        if not self.area.y[0] < self._goal[1] + 0.005 * self._drift_direction < self.area.y[1]:
            self._drift_direction = -self._drift_direction
        self._goal = self._goal + np.array([0.0, self._drift_direction * DRIFT_SPEED * elapsed])
