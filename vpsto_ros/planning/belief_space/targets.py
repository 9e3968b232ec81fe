"""Where a belief shall be pushed: to a place, or along a path."""

import dataclasses
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.exceptions import InvalidInputError

WAY_POINTS = 16
"""Points that stand for the part of a path that lies ahead."""


class Target(Protocol):
    """Guides a plan horizon by horizon; `progress` is how much of it is done."""

    def advanced(self, progress: float, position: NDArray) -> float:
        """Progress [m] once the object's mean is at a position (2,)."""

    def way(self, progress: float) -> NDArray:
        """Where to push next: points (x, y) and what is left of the way from each, shape (L, 3) [m]."""

    def remaining(self, progress: float, position: NDArray) -> float:
        """Distance [m] that is left to push."""

    def reached(self, progress: float, belief: ObjectBelief) -> bool:
        """Whether the task is solved."""


@dataclasses.dataclass(frozen=True)
class GoalTarget:
    """Push the object to a place.

    Attributes:
        position: of the goal, shape (2,) [m].
        tolerance: largest distance of the belief's mean [m].
        largest_std: root of the belief's variance up to which the task counts as solved [m].
    """

    position: NDArray
    tolerance: float = 0.01
    largest_std: float = np.inf

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", _points("a goal", self.position, 1))

    def advanced(self, progress: float, position: NDArray) -> float:
        """A place knows no progress."""
        return 0.0

    def way(self, progress: float) -> NDArray:
        """The goal itself."""
        return np.array([[*self.position, 0.0]])

    def remaining(self, progress: float, position: NDArray) -> float:
        """Distance to the goal."""
        return float(np.hypot(*(position - self.position)))

    def reached(self, progress: float, belief: ObjectBelief) -> bool:
        """Whether the mean is within the tolerance, and the belief tight enough."""
        near = self.remaining(progress, belief.mean[:2]) <= self.tolerance
        return near and belief.variance <= self.largest_std**2


@dataclasses.dataclass(frozen=True)
class PathTarget:
    """Push the object along a path.

    Attributes:
        points: polyline, shape (V, 2) [m]; a closed path repeats its first point at the end.
        lookahead: distance along the path from the object to the point that guides it [m].
        tolerance: largest distance of the belief's mean from the end [m].
        largest_std: root of the belief's variance up to which the task counts as solved [m].
    """

    points: NDArray
    lookahead: float = 0.06
    tolerance: float = 0.01
    largest_std: float = np.inf

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", _points("a path", self.points, 2))
        if len(self.points) < 2 or not (np.diff(self._stations) > 0.0).all():
            raise InvalidInputError("a path needs two or more points, no two neighbours alike")
        if not self.lookahead > 0.0:
            raise InvalidInputError(f"lookahead must be positive, got {self.lookahead}")

    @classmethod
    def circle(
        cls, start: ArrayLike, center: ArrayLike, *, turns: float = 1.0, **options: float
    ) -> "PathTarget":
        """A circle about a centre from a start on, counter-clockwise for positive turns."""
        offset = np.asarray(start, dtype=float) - center
        angle = np.arctan2(offset[1], offset[0]) + 2.0 * np.pi * np.linspace(0.0, turns, 181)
        circle = np.hypot(*offset) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return cls(np.asarray(center) + circle, **options)

    @cached_property
    def _stations(self) -> NDArray:
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1))])

    @property
    def length(self) -> float:
        """Length of the path [m]."""
        return float(self._stations[-1])

    def _points_at(self, stations: NDArray) -> NDArray:
        """Points (S, 2) at distances from the beginning along the path."""
        return np.stack([np.interp(stations, self._stations, column) for column in self.points.T], axis=1)

    def advanced(self, progress: float, position: NDArray) -> float:
        """Station nearest to the position, among those from the last one to the look-ahead."""
        stations = np.linspace(progress, min(progress + 1.5 * self.lookahead, self.length), 100)
        offset = self._points_at(stations) - position
        return float(stations[np.argmin(np.einsum("si,si->s", offset, offset))])

    def way(self, progress: float) -> NDArray:
        """The part of the path that lies ahead."""
        stations = np.linspace(progress, min(progress + self.lookahead, self.length), WAY_POINTS)
        return np.column_stack([self._points_at(stations), stations[-1] - stations])

    def remaining(self, progress: float, position: NDArray) -> float:
        """What is left of the path, or the distance to its end if that is larger."""
        return max(self.length - progress, float(np.hypot(*(position - self.points[-1]))))

    def reached(self, progress: float, belief: ObjectBelief) -> bool:
        """Whether all but the tolerance is done, and the belief tight enough."""
        done = progress >= self.length - self.tolerance
        near = float(np.hypot(*(belief.mean[:2] - self.points[-1]))) <= self.tolerance
        return done and near and belief.variance <= self.largest_std**2

    def distances(self, positions: ArrayLike) -> NDArray[np.float64]:
        """Distance of positions (..., 2) from the path [m]."""
        points = np.asarray(positions, dtype=float)
        nearest = np.full(points.shape[:-1], np.inf)
        for begin, end in zip(self.points[:-1], self.points[1:], strict=True):
            way, offset = end - begin, points - begin
            share = np.clip((offset @ way) / (way @ way), 0.0, 1.0)
            square = ((offset - share[..., None] * way) ** 2).sum(axis=-1)
            np.minimum(nearest, square, out=nearest)
        return np.sqrt(nearest)


def _points(name: str, value: ArrayLike, dimensions: int) -> NDArray[np.float64]:
    points = np.asarray(value, dtype=float)
    if points.ndim != dimensions or points.shape[-1] != 2 or not np.isfinite(points).all():
        shape = "(2,)" if dimensions == 1 else "(V, 2)"
        raise InvalidInputError(f"{name} must be finite with shape {shape}, got {value!r}")
    return points
