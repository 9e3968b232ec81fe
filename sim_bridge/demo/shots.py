"""What happens in the air-hockey demo: pucks are brought one after the other, and each is to be shot once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.hockey.contact_log import ONE_TOUCH
from vpsto_ros.exceptions import ConfigurationError

if TYPE_CHECKING:
    from rclpy.task import Future

    from sim_bridge.demo.observer import Observer

SHOTS = 10
GOAL, MISSED, OWN_GOAL, NO_SHOT = "goal", "missed", "own goal", "no shot"
FLIGHT = 5.0
"""A puck that has not come to the goal so long after the touch has missed [s]."""
REST = 0.3
"""Between the end of a shot and the next puck, once the arm rests [s]."""
AT_REST = 0.02
"""Joints that are slower rest [rad/s]."""
_LEAST_PATIENCE = 2.5  # time for a puck, the least in which the arm can shoot [s]
ASK_AGAIN = 0.2
"""So long after a puck could not be put down the next is tried [s]."""


@dataclass
class Shot:
    """How one puck was shot.

    Attributes:
        start: when it was put down [s].
        place: where (2,) [m], NaN until it was seen there.
        chance: of scoring, as the planner said last before the touch; NaN before it said anything.
        touched: when the mallet had hit it for the first time [s], NaN before.
        speed: that it had when the mallet had hit it last [m/s].
        end: when it was over [s], NaN before.
        outcome: "goal", "missed", "own goal" or "no shot"; empty before the end.
        goal_speed: at the goal line [m/s].
    """

    start: float
    place: NDArray[np.float64]
    chance: float = math.nan
    touched: float = math.nan
    speed: float = math.nan
    end: float = math.nan
    outcome: str = ""
    goal_speed: float = math.nan


class ShootingScript:
    """Brings pucks, and says what became of them.

    A puck counts once: a touch that comes so late that it is another shot makes it a miss.

    Attributes:
        shots: so far, the present one included.
    """

    def __init__(self, duration: float, count: int = SHOTS) -> None:
        """Prepare for a number of pucks, which share a time [s] evenly.

        Raises:
            ConfigurationError: there is too little time to shoot a puck.
        """
        if duration / count < _LEAST_PATIENCE:
            raise ConfigurationError(
                f"{count} pucks need a duration of {_LEAST_PATIENCE * count:g} s at least, got {duration:g} s"
            )
        self.count, self._patience = count, duration / count
        self.shots: list[Shot] = []
        self._start = self._end = math.nan
        self._asked: Future | None = None
        self._free = -math.inf  # no puck is brought before [s]
        self._told = 0

    def connect(self, observer: Observer) -> None:
        """Listen to touches, goals and chances, and get ready to ask for pucks."""
        from std_srvs.srv import Trigger

        from sim_bridge.demo.observer import GOAL_PROBABILITY, GOALS, TOUCHES

        self._observer, self._request = observer, Trigger.Request()
        self._hand = observer.create_client(Trigger, "/franka_driver/new_puck")
        observer.listen(GOALS, self._see_goal)
        observer.listen(TOUCHES, self._see_touch)
        observer.listen(GOAL_PROBABILITY, self._hear_chance)

    @property
    def start(self) -> float:
        """When the first puck was put down [s]."""
        return self._start

    @property
    def end(self) -> float:
        """When the last shot was over [s]."""
        return self._end

    @property
    def finished(self) -> bool:
        """Whether all shots are over."""
        return math.isfinite(self._end)

    @property
    def progress(self) -> float:
        """Share of the shots that are over."""
        return sum(bool(shot.outcome) for shot in self.shots) / self.count

    @property
    def present(self) -> Shot | None:
        """The shot that is not over."""
        return self.shots[-1] if self.shots and not self.shots[-1].outcome else None

    def ready(self) -> bool:
        """Whether the hand that brings pucks is there."""
        return bool(self._hand.service_is_ready())

    def asked(self) -> bool:
        """Whether there was a puck to shoot."""
        return bool(self.shots)

    def act(self, now: float) -> None:
        """Bring a puck when the arm rests, and give up on one that takes too long."""
        shot = self.present
        if shot is not None:
            self._look_at(shot, now)
            touched = math.isfinite(shot.touched)
            if now - (shot.touched if touched else shot.start) > (FLIGHT if touched else self._patience):
                self._finish(shot, now, MISSED if touched else NO_SHOT)
        elif len(self.shots) < self.count:
            self._bring(now)

    def _bring(self, now: float) -> None:
        """Ask for a puck, or take note that it is there."""
        if self._asked is not None:
            if not self._asked.done():
                return
            answer, self._asked = self._asked.result(), None
            if answer.success:
                self._begin(now)
            else:
                self._free = now + ASK_AGAIN
        elif now >= self._free and self._rests():
            self._asked = self._hand.call_async(self._request)

    def _begin(self, now: float) -> None:
        self.shots.append(Shot(now, np.full(2, np.nan)))
        if len(self.shots) == 1:
            self._start = now

    def _look_at(self, shot: Shot, now: float) -> None:
        """Note where the puck is as soon as there is a look at it that is later than the hand's answer."""
        pose = self._observer.object_pose()
        if np.isnan(shot.place).any() and now > shot.start and pose is not None:
            shot.place = pose[:2]

    def _rests(self) -> bool:
        velocity = self._observer.joint_velocity()
        return velocity is not None and bool(np.abs(velocity).max() < AT_REST)

    def _finish(self, shot: Shot, now: float, outcome: str) -> None:
        shot.end, shot.outcome, self._free = now, outcome, now + REST
        if len(self.shots) == self.count:
            self._end = now

    def _hear_chance(self, message: Any) -> None:
        if self.present is not None and math.isnan(self.present.touched):
            self.present.chance = float(message.data)

    def _see_touch(self, message: Any) -> None:
        shot, when = self.present, _seconds(message)
        if shot is None or when < shot.start:
            return
        if math.isnan(shot.touched):
            shot.touched = when
        if when > shot.touched + ONE_TOUCH:
            self._finish(shot, when, MISSED)
        else:
            shot.speed = _speed(message)

    def _see_goal(self, message: Any) -> None:
        shot, when = self.present, _seconds(message)
        if shot is None or when < shot.start:
            return
        if message.child_frame_id != "far":
            self._finish(shot, when, OWN_GOAL)
            return
        shot.goal_speed = _speed(message)
        self._finish(shot, when, GOAL if math.isfinite(shot.touched) else MISSED)

    def label(self) -> str:
        """Which shot it is, and its chance."""
        shot = self.present
        chance = "" if shot is None or math.isnan(shot.chance) else f", {100 * shot.chance:.0f} % to score"
        return f"shot {min(len(self.shots), self.count):2d} of {self.count}{chance}"

    def news(self) -> list[str]:
        """A sentence about every shot that is over."""
        over = [shot for shot in self.shots if shot.outcome]
        fresh, self._told = over[self._told :], len(over)
        first = len(over) - len(fresh) + 1
        return [f"  shot {number:2d}  {sentence(shot)}" for number, shot in enumerate(fresh, first)]


def sentence(shot: Shot) -> str:
    """How a shot went, in words."""
    chance = "the chance was not told" if math.isnan(shot.chance) else f"predicted {100 * shot.chance:.0f} %"
    if shot.outcome == GOAL:
        took = shot.end - shot.start
        return f"GOAL at {shot.goal_speed:.1f} m/s, {took:.1f} s after the puck came ({chance})"
    if shot.outcome == NO_SHOT:
        return "was not shot in time"
    return f"{shot.outcome} ({chance})"


def _seconds(message: Any) -> float:
    stamp = message.header.stamp
    return stamp.sec + 1e-9 * stamp.nanosec


def _speed(message: Any) -> float:
    velocity = message.twist.twist.linear
    return math.hypot(velocity.x, velocity.y)
