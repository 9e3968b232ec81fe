"""What a robot touches with: any number of discs and rectangles in the plane, moved independently."""

import dataclasses
import math
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.contact.geometry import Disc, PlanarShape, Rectangle
from vpsto_ros.contact.multi_tool import tool_gaps
from vpsto_ros.exceptions import InvalidInputError


@dataclasses.dataclass(frozen=True)
class EndEffectors:
    """The end effectors of a robot and how its plane coordinates place them.

    Plane coordinates are those of all end effectors one after the other: (x, y) of a disc, (x, y, yaw) of
    a rectangle, in the base frame [m, rad].

    Args:
        shapes: one or more :class:`Disc` and :class:`Rectangle`, each centred in its own frame.

    Raises:
        InvalidInputError: there are none, or one is not centred and aligned.
    """

    shapes: tuple[Disc | Rectangle, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "shapes", tuple(self.shapes))
        if not self.shapes or not all(isinstance(s, (Disc, Rectangle)) for s in self.shapes):
            raise InvalidInputError(
                f"end effectors must be one or more Disc or Rectangle, got {self.shapes!r}"
            )
        for shape in self.shapes:
            if shape.center != (0.0, 0.0) or (isinstance(shape, Rectangle) and shape.angle != 0.0):
                raise InvalidInputError(
                    f"an end effector must be centred and aligned in its frame, got {shape}"
                )

    @classmethod
    def discs(cls, radius: float, count: int = 1) -> "EndEffectors":
        """Equal discs."""
        return cls((Disc(radius=radius),) * count)

    @classmethod
    def rectangle(cls, length: float, width: float) -> "EndEffectors":
        """One rectangle: length along its x, width along its y [m]."""
        return cls((Rectangle(half_size=(length / 2, width / 2)),))

    @property
    def count(self) -> int:
        """Number of end effectors E."""
        return len(self.shapes)

    @cached_property
    def columns(self) -> tuple[int, ...]:
        """Column of the plane coordinates at which each end effector begins."""
        sizes = [2 if isinstance(shape, Disc) else 3 for shape in self.shapes]
        return tuple(int(c) for c in np.concatenate([[0], np.cumsum(sizes)[:-1]]))

    @cached_property
    def dof(self) -> int:
        """Number of plane coordinates m."""
        return sum(2 if isinstance(shape, Disc) else 3 for shape in self.shapes)

    @cached_property
    def rows(self) -> NDArray[np.float64]:
        """For kernels: (hx, hy, radius, bounding radius, column, turns), shape (E, 6)."""
        rows = []
        for shape, column in zip(self.shapes, self.columns, strict=True):
            if isinstance(shape, Disc):
                rows.append((0.0, 0.0, shape.radius, shape.radius, column, 0.0))
            else:
                hx, hy = shape.half_size
                rows.append((hx, hy, 0.0, math.hypot(hx, hy), column, 1.0))
        return np.array(rows)

    def poses(self, points: NDArray) -> NDArray[np.float64]:
        """Poses (x, y, yaw) of the end effectors for plane coordinates (..., m), shape (..., E, 3)."""
        points = np.asarray(points, dtype=float)
        if points.shape[-1:] != (self.dof,):
            raise InvalidInputError(
                f"plane coordinates must have shape (..., {self.dof}), got {points.shape}"
            )
        poses = np.zeros((*points.shape[:-1], self.count, 3))
        for e, (shape, column) in enumerate(zip(self.shapes, self.columns, strict=True)):
            size = 2 if isinstance(shape, Disc) else 3
            poses[..., e, :size] = points[..., column : column + size]
        return poses

    def gaps(self, shape: PlanarShape, pose: NDArray, point: NDArray) -> NDArray[np.float64]:
        """Signed distances (E,) [m] between an object of this shape at a pose (3,) and the end effectors.

        Exact for discs; between rectangles a lower bound where corners face each other.

        Raises:
            InvalidInputError: pose or plane coordinates (m,) have another shape.
        """
        pose, point = np.asarray(pose, dtype=float), np.asarray(point, dtype=float)
        if pose.shape != (3,):
            raise InvalidInputError(f"pose must have shape (3,), got {pose.shape}")
        if point.shape != (self.dof,):
            raise InvalidInputError(f"plane coordinates must have shape ({self.dof},), got {point.shape}")
        gaps = np.empty(self.count)
        tool_gaps(shape.kernel_rows, shape.outline_segments, self.rows, pose, point, gaps)
        return gaps
