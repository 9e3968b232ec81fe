"""Planar shapes: unions of rectangles and discs, their outline, area integrals and distances.

Lengths in metres, angles in radians. A shape lives in its own object frame; the frame's origin is the point
whose world position an object pose (x, y, yaw) gives.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vpsto_ros.contact import outline
from vpsto_ros.contact.narrow_phase import signed_distances
from vpsto_ros.exceptions import InvalidInputError


@dataclass(frozen=True)
class Rectangle:
    """Rectangle with a centre, half sizes along its own axes and the angle of these axes."""

    center: tuple[float, float] = (0.0, 0.0)
    half_size: tuple[float, float] = (0.05, 0.05)
    angle: float = 0.0

    def __post_init__(self) -> None:
        """Check and normalise the fields."""
        _set_pair(self, "center")
        _set_pair(self, "half_size")
        object.__setattr__(self, "angle", float(self.angle))
        if not math.isfinite(self.angle) or min(self.half_size) <= 0.0:
            raise InvalidInputError(f"a rectangle needs positive half sizes and a finite angle, got {self}")

    @property
    def row(self) -> tuple[float, ...]:
        """(cx, cy, hx, hy, angle, radius) with radius 0."""
        return (*self.center, *self.half_size, self.angle, 0.0)


@dataclass(frozen=True)
class Disc:
    """Disc with a centre and a radius."""

    center: tuple[float, float] = (0.0, 0.0)
    radius: float = 0.05

    def __post_init__(self) -> None:
        """Check and normalise the fields."""
        _set_pair(self, "center")
        object.__setattr__(self, "radius", float(self.radius))
        if not math.isfinite(self.radius) or self.radius <= 0.0:
            raise InvalidInputError(f"a disc needs a positive radius, got {self}")

    @property
    def row(self) -> tuple[float, ...]:
        """(cx, cy, hx, hy, angle, radius) with zero half sizes and angle."""
        return (*self.center, 0.0, 0.0, 0.0, self.radius)


def _set_pair(owner, name: str) -> None:
    value = np.asarray(getattr(owner, name), dtype=float)
    if value.shape != (2,) or not np.all(np.isfinite(value)):
        raise InvalidInputError(f"{type(owner).__name__}.{name} must be two finite numbers, got {value}")
    object.__setattr__(owner, name, (float(value[0]), float(value[1])))


@dataclass(frozen=True)
class PlanarShape:
    """Union of rectangles and discs, which may overlap or abut.

    Args:
        primitives: one or more :class:`Rectangle` and :class:`Disc`, in the object frame.
    """

    primitives: tuple[Rectangle | Disc, ...]

    def __post_init__(self) -> None:
        """Check the primitives."""
        object.__setattr__(self, "primitives", tuple(self.primitives))
        if not self.primitives or not all(isinstance(p, (Rectangle, Disc)) for p in self.primitives):
            raise InvalidInputError(f"a shape needs one or more Rectangle or Disc, got {self.primitives!r}")

    @classmethod
    def box(cls, length: float = 0.12, width: float = 0.12) -> "PlanarShape":
        """Rectangle of length (along x) times width, origin at its centre."""
        return cls((Rectangle(half_size=(length / 2, width / 2)),))

    @classmethod
    def disc(cls, radius: float) -> "PlanarShape":
        """Disc with its origin at the centre."""
        return cls((Disc(radius=radius),))

    @classmethod
    def tee(
        cls, bar_length: float = 0.12, bar_width: float = 0.04, stem_length: float | None = None
    ) -> "PlanarShape":
        """T of two bars with the stem towards -y; origin at the centre of area.

        Args:
            bar_length: length of the bar along x [m].
            bar_width: width of the bar and of the stem [m].
            stem_length: visible length of the stem [m]; that of the bar if None.
        """
        stem_length = bar_length if stem_length is None else stem_length
        bar = Rectangle((0.0, bar_width / 2), (bar_length / 2, bar_width / 2))
        stem = Rectangle((0.0, -stem_length / 2), (bar_width / 2, stem_length / 2))
        return cls((bar, stem)).recentred()

    @classmethod
    def ell(cls, length: float = 0.12, width: float = 0.04, height: float | None = None) -> "PlanarShape":
        """L of two bars with outer edges `length` along x, `height` along y; origin at the centre of area."""
        height = length if height is None else height
        if min(length, height) <= width:
            raise InvalidInputError(
                f"an L needs length and height above its width {width}, got {length}, {height}"
            )
        upright = Rectangle((width / 2, height / 2), (width / 2, height / 2))
        foot = Rectangle(((length + width) / 2, width / 2), ((length - width) / 2, width / 2))
        return cls((upright, foot)).recentred()

    def recentred(self) -> "PlanarShape":
        """The same shape with the origin of its frame at its centre of area."""
        x, y = self.centroid()
        moved = []
        for p in self.primitives:
            center = (p.center[0] - x, p.center[1] - y)
            moved.append(
                Disc(center, p.radius) if isinstance(p, Disc) else Rectangle(center, p.half_size, p.angle)
            )
        return PlanarShape(tuple(moved))

    def as_array(self) -> np.ndarray:
        """Primitives as rows (cx, cy, hx, hy, angle, radius), shape (P, 6); radius 0 marks a rectangle."""
        return np.array([p.row for p in self.primitives])

    @cached_property
    def kernel_rows(self) -> np.ndarray:
        """Primitives as compiled kernels take them: (cx, cy, hx, hy, cos, sin, radius), shape (P, 7)."""
        rows = self.as_array()
        packed = np.column_stack([rows[:, :4], np.cos(rows[:, 4]), np.sin(rows[:, 4]), rows[:, 5]])
        return np.ascontiguousarray(packed)

    @cached_property
    def outline_segments(self) -> np.ndarray:
        """Visible outline as segments (x0, y0, x1, y1, nx, ny, primitive) in running order, shape (S, 7).

        Discs are polygons here.
        """
        return outline.chain(outline.visible_segments(self.as_array()))

    def area(self) -> float:
        """Area of the union [m^2]."""
        return self._integrate(lambda x, low, high: high - low)

    def centroid(self) -> np.ndarray:
        """Centre of area [m], shape (2,)."""
        x = self._integrate(lambda x, low, high: x * (high - low))
        y = self._integrate(lambda x, low, high: (high**2 - low**2) / 2)
        return np.array([x, y]) / self.area()

    @cached_property
    def polar_radius(self) -> float:
        """Polar radius of gyration about the centre of area [m]: root of the second moment per area."""
        second = self._integrate(lambda x, low, high: x**2 * (high - low) + (high**3 - low**3) / 3)
        return math.sqrt(second / self.area() - float(np.sum(self.centroid() ** 2)))

    @cached_property
    def bounding_radius(self) -> float:
        """Radius of the circle about the origin of the frame that holds the shape [m]."""
        rows = self.as_array()
        corners = [outline.primitive_polygon(row)[0] for row in rows if row[5] == 0.0]
        reach = [float(np.max(np.linalg.norm(c, axis=1))) for c in corners]
        reach += [float(np.hypot(row[0], row[1]) + row[5]) for row in rows if row[5] > 0.0]
        return max(reach)

    def mean_distance(self, point=(0.0, 0.0)) -> float:
        """Mean distance [m] of the area to a point of the object frame: the arm of evenly spread friction."""
        px, py = _checked("point", point, (2,))

        def antiderivative(x, y):
            r = np.hypot(x, y)
            return (y * r + x * x * np.arcsinh(y / np.maximum(np.abs(x), 1e-300))) / 2

        total = self._integrate(
            lambda x, low, high: antiderivative(x - px, high - py) - antiderivative(x - px, low - py)
        )
        return total / self.area()

    def _integrate(self, column) -> float:
        """Integral over the union, from the integrals `column(x, low, high)` over vertical lines."""
        nodes, weights = self._scan_lines
        total = 0.0
        for x, weight, intervals in zip(nodes, weights, self._scan_intervals, strict=True):
            for low, high in intervals:
                total += weight * column(x, low, high)
        return float(total)

    @cached_property
    def _scan_lines(self) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Legendre nodes and weights between the abscissae where the outline has a corner."""
        segments = self.outline_segments
        rows = self.as_array()
        keep = rows[segments[:, 6].astype(int), 5] == 0.0
        cuts = [segments[keep, 0], segments[keep, 2], rows[:, 0] - rows[:, 5], rows[:, 0] + rows[:, 5]]
        breaks = np.unique(np.round(np.concatenate(cuts), 12))
        unit, weight = np.polynomial.legendre.leggauss(24)
        middle, half = (breaks[1:] + breaks[:-1]) / 2, (breaks[1:] - breaks[:-1]) / 2
        nodes = middle[:, None] + half[:, None] * unit
        return nodes.ravel(), (half[:, None] * weight).ravel()

    @cached_property
    def _scan_intervals(self) -> list[list[tuple[float, float]]]:
        """For every scan line, the disjoint intervals of y inside the union."""
        rows = self.as_array()
        return [
            outline.merge([span for row in rows if (span := outline.column(row, x))])
            for x in self._scan_lines[0]
        ]

    def boundary(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Evenly spaced points on the outline of the union, in running order; inner edges are left out.

        Args:
            n: number of points, at least 1.

        Returns:
            points (n, 2) [m] and outward unit normals (n, 2), object frame.
        """
        if n < 1:
            raise InvalidInputError(f"n must be at least 1, got {n}")
        segments = self.outline_segments
        lengths = np.linalg.norm(segments[:, 2:4] - segments[:, :2], axis=1)
        ends = np.cumsum(lengths)
        along = (np.arange(n) + 0.5) / n * ends[-1]
        index = np.minimum(np.searchsorted(ends, along), len(ends) - 1)
        part = ((along - ends[index] + lengths[index]) / lengths[index])[:, None]
        chosen = segments[index]
        points = (1 - part) * chosen[:, :2] + part * chosen[:, 2:4]
        normals = chosen[:, 4:6].copy()
        rows = self.as_array()[chosen[:, 6].astype(int)]
        round_ = rows[:, 5] > 0.0
        radial = points[round_] - rows[round_, :2]
        normals[round_] = radial / np.linalg.norm(radial, axis=1, keepdims=True)
        points[round_] = rows[round_, :2] + rows[round_, 5:6] * normals[round_]
        return points, normals

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance of points to the union, negative inside.

        Args:
            points: object frame [m], shape (K, 2).

        Returns:
            distances [m], shape (K,); inside unions with discs, arcs are taken as polygons (error below 1e-4
            of the radius).
        """
        points = np.ascontiguousarray(_checked("points", points, (None, 2)))
        distances = np.empty(len(points))
        signed_distances(self.kernel_rows, self.outline_segments, points, distances)
        return distances

    def transform(self, pose: np.ndarray) -> list[np.ndarray]:
        """World polygons for drawing, one per primitive.

        Args:
            pose: object pose (x, y, yaw).

        Returns:
            corners counter-clockwise, shape (V, 2) each; discs have 64.
        """
        x, y, yaw = _checked("pose", pose, (3,))
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        return [np.array([x, y]) + outline.primitive_polygon(row, 64)[0] @ turn.T for row in self.as_array()]


def _checked(name: str, value, shape: tuple[int | None, ...]) -> np.ndarray:
    """The value as a finite float array of the given shape."""
    array = np.asarray(value, dtype=float)
    fits = array.ndim == len(shape) and all(
        want in (None, has) for want, has in zip(shape, array.shape, strict=True)
    )
    if not fits or not np.all(np.isfinite(array)):
        raise InvalidInputError(f"{name} must be finite with shape {shape}, got shape {array.shape}: {array}")
    return array
