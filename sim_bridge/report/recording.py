"""A run as arrays: what the bag holds of joints, object, target, plans and diagnostics."""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.report.bag import read_messages
from sim_bridge.report.overlay import MARKERS, Overlay, overlays_of

FloatArray = NDArray[np.float64]

JOINT_STATES = "/joint_states"
JOINT_TRAJECTORY = "/joint_trajectory"
GROUND_TRUTH = "/franka_driver/ground_truth/object"
GOAL_POSE = "/goal_pose"
OBJECT_STATE = "/object_state"
DIAGNOSTICS = "/diagnostics"
STALE_DRAWING = 1.0
"""What a node drew is shown no longer [s]; it draws several times a second."""


@dataclass(frozen=True)
class PoseSeries:
    """Planar poses over time.

    Attributes:
        time: [s], shape (K,), increasing.
        pose: x, y [m] and yaw [rad] in the base frame, shape (K, 3).
    """

    time: FloatArray
    pose: FloatArray

    def at(self, time: FloatArray) -> FloatArray:
        """Poses (M, 3) at other times (M,): interpolated, the yaw the short way round."""
        yaw = np.unwrap(self.pose[:, 2])
        columns = [np.interp(time, self.time, values) for values in (self.pose[:, 0], self.pose[:, 1], yaw)]
        return np.stack(columns, axis=-1)

    def held(self, time: FloatArray) -> FloatArray:
        """The latest pose (M, 3) at other times (M,), for a target that jumps; NaN before the first."""
        if not len(self.time):
            return np.full((len(time), 3), np.nan)
        index = np.searchsorted(self.time, time, side="right") - 1
        return np.where((index >= 0)[:, None], self.pose[np.maximum(index, 0)], np.nan)


@dataclass(frozen=True)
class JointSeries:
    """Joint states over time (K,) [s]: position [rad], velocity [rad/s] and effort [Nm], each (K, n)."""

    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    effort: FloatArray


@dataclass(frozen=True)
class Command:
    """A joint trajectory as it was published.

    Attributes:
        received: [s].
        time: of its points [s], (P,).
        position: [rad], (P, n); velocity [rad/s] and acceleration [rad/s^2] alike, None when not given.
    """

    received: float
    time: FloatArray
    position: FloatArray
    velocity: FloatArray | None
    acceleration: FloatArray | None


@dataclass(frozen=True)
class Status:
    """One node's diagnostics: their stamp [s], level 0 to 3 (ok, warning, error, stale), message, values."""

    time: float
    level: int
    message: str
    values: dict[str, str]

    def number(self, key: str) -> float:
        """A value as a number; NaN when it is missing or is none."""
        try:
            return float(self.values.get(key, "nan"))
        except ValueError:
            return math.nan


@dataclass(frozen=True)
class Drawing:
    """What a node drew from a time on [s]."""

    time: float
    overlays: tuple[Overlay, ...]


@dataclass(frozen=True)
class Recording:
    """Everything about a run that figures, replay and summary are made from."""

    joints: JointSeries
    object: PoseSeries
    goal: PoseSeries
    estimate: PoseSeries
    commands: list[Command] = field(default_factory=list)
    diagnostics: dict[str, list[Status]] = field(default_factory=dict)
    drawn: dict[str, list[Drawing]] = field(default_factory=dict)

    @classmethod
    def from_bag(cls, folder: Path, height: float = 0.0) -> Recording:
        """Read a bag written by the demo.

        Args:
            folder: of the bag.
            height: of the object, above which its belief is drawn [m].
        """
        reader = _Reader(height)
        for topic, seconds, message in read_messages(folder, reader.handlers):
            reader.handlers[topic](seconds, message)
        return reader.recording()

    def overlays(self, time: float) -> tuple[Overlay, ...]:
        """What all nodes had drawn at a time [s]."""
        found: list[Overlay] = []
        for drawings in self.drawn.values():
            index = bisect.bisect_right(drawings, time, key=lambda drawing: drawing.time) - 1
            if index >= 0 and time - drawings[index].time < STALE_DRAWING:
                found += drawings[index].overlays
        return tuple(found)

    def distance(self) -> tuple[FloatArray, FloatArray]:
        """Times (K,) [s] since there is a target, and the object's distances from it (K,) [m]."""
        goal = self.goal.held(self.object.time)
        distance = np.linalg.norm(self.object.pose[:, :2] - goal[:, :2], axis=1)
        known = np.isfinite(distance)
        return self.object.time[known], distance[known]

    def duration(self, start: float) -> float:
        """How long joints and object were recorded from a time [s] on; 0 when one is missing."""
        ends = [series.time[-1] for series in (self.joints, self.object) if len(series.time)]
        return max(float(min(ends) - start), 0.0) if len(ends) == 2 and math.isfinite(start) else 0.0


class _Reader:
    """Collects messages by topic."""

    def __init__(self, height: float) -> None:
        self._height = height
        self.drawn: dict[str, list[Drawing]] = {}
        self.joints: list[tuple[float, Any]] = []
        self.poses: dict[str, list[tuple[float, float, float, float]]] = {}
        self.commands: list[Command] = []
        self.diagnostics: dict[str, list[Status]] = {}
        self.handlers: dict[str, Callable[[float, Any], None]] = {
            JOINT_STATES: self._joint_state,
            JOINT_TRAJECTORY: self._command,
            GROUND_TRUTH: self._odometry(GROUND_TRUTH),
            OBJECT_STATE: self._odometry(OBJECT_STATE),
            GOAL_POSE: self._goal,
            DIAGNOSTICS: self._diagnostic,
            **{topic: self._drawing(topic) for topic in MARKERS},
        }

    def recording(self) -> Recording:
        """What has been read."""
        time = np.array([stamp for stamp, _ in self.joints])
        columns = [
            np.array([getattr(message, name) for _, message in self.joints], dtype=float)
            for name in ("position", "velocity", "effort")
        ]
        return Recording(
            JointSeries(time, *columns),
            self._series(GROUND_TRUTH),
            self._series(GOAL_POSE),
            self._series(OBJECT_STATE),
            self.commands,
            self.diagnostics,
            self.drawn,
        )

    def _series(self, topic: str) -> PoseSeries:
        rows = np.array(sorted(self.poses.get(topic, []))).reshape(-1, 4)
        return PoseSeries(rows[:, 0], rows[:, 1:])

    def _joint_state(self, _seconds: float, message: Any) -> None:
        stamp = _stamp(message)
        if not self.joints or stamp > self.joints[-1][0]:
            self.joints.append((stamp, message))

    def _odometry(self, topic: str) -> Callable[[float, Any], None]:
        def receive(_seconds: float, message: Any) -> None:
            self.poses.setdefault(topic, []).append((_stamp(message), *planar(message.pose.pose)))

        return receive

    def _goal(self, seconds: float, message: Any) -> None:
        # By the time of arrival: the stamp of a goal that somebody clicks may come from another clock.
        self.poses.setdefault(GOAL_POSE, []).append((seconds, *planar(message.pose)))

    def _command(self, seconds: float, message: Any) -> None:
        start = _stamp(message) or seconds
        points = message.points
        time = np.array([start + p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in points])
        parts = [_stacked(points, name) for name in ("velocities", "accelerations")]
        self.commands.append(Command(seconds, time, np.array([p.positions for p in points]), *parts))

    def _drawing(self, topic: str) -> Callable[[float, Any], None]:
        def receive(seconds: float, message: Any) -> None:
            overlays = overlays_of(message.markers, MARKERS[topic], self._height)
            self.drawn.setdefault(topic, []).append(Drawing(seconds, overlays))

        return receive

    def _diagnostic(self, seconds: float, message: Any) -> None:
        # By the time of the report: a recorder on a busy machine may read it late.
        reported = _stamp(message) or seconds
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            entry = Status(reported, int(status.level), status.message, values)
            self.diagnostics.setdefault(status.name, []).append(entry)


def planar(pose: Any) -> tuple[float, float, float]:
    """x, y [m] and yaw [rad] of a geometry_msgs/Pose."""
    q = pose.orientation
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
    return pose.position.x, pose.position.y, yaw


def _stamp(message: Any) -> float:
    stamp = message.header.stamp
    return stamp.sec + 1e-9 * stamp.nanosec


def _stacked(points: Any, name: str) -> FloatArray | None:
    rows = [getattr(point, name) for point in points]
    if not rows or not all(len(row) for row in rows):
        return None
    return np.array(rows, dtype=float)
