"""Polygons as obstacles: what makes one usable, and the rows that the kernels take."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError

_SMALLEST = 1e-9
"""Edges and heights below this [m] are degenerate."""


def checked_polygon(corners: ArrayLike, name: str) -> NDArray[np.float64]:
    """The corners (V, 2) of a simple polygon, read-only.

    Args:
        corners: in order around the polygon, in either sense, the first one not repeated at the end [m].
        name: of the polygon, for error messages.

    Raises:
        InvalidInputError: fewer than three corners, not finite, an edge without length, no area, or edges
            that touch or cross; the message says where.
    """
    try:
        polygon = np.array(corners, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{name}: corners must be numbers of shape (V, 2)") from error
    if polygon.ndim != 2 or polygon.shape[1] != 2 or len(polygon) < 3:
        raise InvalidInputError(f"{name} must have at least 3 corners of shape (V, 2), got {polygon.shape}")
    if not np.isfinite(polygon).all():
        raise InvalidInputError(f"{name}: the corners must be finite, got {polygon.tolist()}")
    lengths = np.linalg.norm(np.roll(polygon, -1, axis=0) - polygon, axis=1)
    if lengths.min() < _SMALLEST:
        i = int(lengths.argmin())
        raise InvalidInputError(
            f"{name}: corner {i + 1} and the next one are the same point {polygon[i].tolist()}"
        )
    if np.linalg.svd(polygon - polygon.mean(axis=0), compute_uv=False)[1] < _SMALLEST:
        raise InvalidInputError(f"{name} has no area: all its corners are on one line")
    _refuse_touching_edges(polygon, name)
    polygon.setflags(write=False)
    return polygon


def _refuse_touching_edges(polygon: NDArray, name: str) -> None:
    size = len(polygon)
    ends = np.roll(polygon, -1, axis=0)
    for i in range(size):
        for j in range(i + 1, size):
            if j == i + 1 or (i == 0 and j == size - 1):
                touching = _folds_back(polygon, j if j == i + 1 else 0)
            else:
                touching = _touch(polygon[i], ends[i], polygon[j], ends[j])
            if touching:
                raise InvalidInputError(f"{name} intersects itself: its edges {i + 1} and {j + 1} meet")


def _folds_back(polygon: NDArray, corner: int) -> bool:
    """Whether the edges before and after a corner lie on each other."""
    before = polygon[corner] - polygon[corner - 1]
    after = polygon[(corner + 1) % len(polygon)] - polygon[corner]
    sine = _cross(before, after) / (np.hypot(*before) * np.hypot(*after))
    return bool(abs(sine) < _SMALLEST and before @ after < 0.0)


def _touch(a: NDArray, b: NDArray, c: NDArray, d: NDArray) -> bool:
    """Whether two segments have a point in common."""
    sides = [_cross(b - a, c - a), _cross(b - a, d - a), _cross(d - c, a - c), _cross(d - c, b - c)]
    if sides[0] * sides[1] < 0.0 and sides[2] * sides[3] < 0.0:
        return True
    pairs = ((a, b, c), (a, b, d), (c, d, a), (c, d, b))
    return any(_distance(*pair) < _SMALLEST for pair in pairs)


def _distance(a: NDArray, b: NDArray, point: NDArray) -> float:
    """Distance of a point to the segment from a to b."""
    along = np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return float(np.linalg.norm(a + along * (b - a) - point))


def _cross(a: NDArray, b: NDArray) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def edge_rows(polygons: Sequence[NDArray]) -> NDArray[np.float64]:
    """Edges of polygons as rows x, y, direction (2), normal (2), length; shape (E, 7)."""
    rows = [np.empty((0, 7))]
    for polygon in polygons:
        step = np.roll(polygon, -1, axis=0) - polygon
        length = np.hypot(step[:, 0], step[:, 1])
        x, y = step.T / length
        rows.append(np.column_stack([polygon, x, y, -y, x, length]))
    return np.concatenate(rows)


def bands(polygon: NDArray, radius: float) -> list[NDArray[np.float64]]:
    """The rectangles that reach `radius` to both sides of the edges of a polygon, corners (4, 2) each."""
    result = []
    for start, end in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        x, y = (end - start) / np.linalg.norm(end - start)
        aside = radius * np.array([-y, x])
        result.append(np.array([start - aside, end - aside, end + aside, start + aside]))
    return result
