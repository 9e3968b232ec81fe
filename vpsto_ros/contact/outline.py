"""The visible outline of a union of convex primitives, as straight segments."""

import math

import numpy as np

# Segments per full disc; points on discs are put back on the circle where exactness matters.
DISC_SEGMENTS = 256
# Offset, relative to the size of the shape, that decides which side of an edge lies inside a neighbour.
OFFSET = 1e-7


def visible_segments(rows: np.ndarray) -> np.ndarray:
    """Parts of the primitives' edges that belong to the outline of their union.

    Args:
        rows: primitives (cx, cy, hx, hy, angle, radius), shape (P, 6).

    Returns:
        segments (x0, y0, x1, y1, nx, ny, primitive) in counter-clockwise order around their primitive, shape
        (S, 7).
    """
    offset = OFFSET * float(np.max(rows[:, 2:4].sum(1) + rows[:, 5]))
    found = []
    for i, row in enumerate(rows):
        corners, normals = primitive_polygon(row)
        for start, end, normal in zip(corners, np.roll(corners, -1, axis=0), normals, strict=True):
            hidden = _hidden_intervals(rows, i, start, end, normal * offset)
            for low, high in _complement(hidden):
                edge = end - start
                found.append([*(start + low * edge), *(start + high * edge), *normal, i])
    return np.array(found, dtype=float).reshape(-1, 7)


def primitive_polygon(row: np.ndarray, disc_segments: int = DISC_SEGMENTS) -> tuple[np.ndarray, np.ndarray]:
    """Corners counter-clockwise, (V, 2), and the outward normal of the edge after each, (V, 2)."""
    center, half, angle, radius = row[:2], row[2:4], row[4], row[5]
    if radius > 0.0:
        corner = 2 * math.pi * np.arange(disc_segments) / disc_segments
        middle = corner + math.pi / disc_segments
        points = center + radius * np.stack([np.cos(corner), np.sin(corner)], axis=1)
        return points, np.stack([np.cos(middle), np.sin(middle)], axis=1)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    signs = np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    normals = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    return center + (signs * half) @ turn.T, normals @ turn.T


def _hidden_intervals(rows, i, start, end, shift) -> list[tuple[float, float]]:
    """Parts of an edge, as parameters in [0, 1], that other primitives cover.

    What lies just outside the edge decides: an edge shared with an abutting neighbour is inside the union, a
    flush one is not. A flush edge is kept for the first primitive only.
    """
    hidden = []
    for j, row in enumerate(rows):
        if j != i:
            hidden.append(_inside(row, start + shift, end + shift))
            if j < i:
                hidden.append(_inside(row, start - shift, end - shift))
    return [interval for interval in hidden if interval[1] - interval[0] > 1e-9]


def _inside(row, start, end) -> tuple[float, float]:
    """Interval of the segment from start to end that lies in a primitive; (0, 0) if none does."""
    c, s = math.cos(row[4]), math.sin(row[4])
    turn = np.array([[c, s], [-s, c]])
    a, e = turn @ (start - row[:2]), turn @ (end - start)
    if row[5] > 0.0:
        qa, qb, qc = e @ e, a @ e, a @ a - row[5] ** 2
        root = qb * qb - qa * qc
        if root <= 0.0:
            return 0.0, 0.0
        low, high = (-qb - math.sqrt(root)) / qa, (-qb + math.sqrt(root)) / qa
    else:
        low, high = 0.0, 1.0
        for axis in range(2):
            if abs(e[axis]) < 1e-15:
                if abs(a[axis]) > row[2 + axis]:
                    return 0.0, 0.0
                continue
            t = sorted(((-row[2 + axis] - a[axis]) / e[axis], (row[2 + axis] - a[axis]) / e[axis]))
            low, high = max(low, t[0]), min(high, t[1])
    low, high = max(low, 0.0), min(high, 1.0)
    return (low, high) if high > low else (0.0, 0.0)


def _complement(intervals: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """What of [0, 1] remains outside the intervals."""
    rest, reached = [], 0.0
    for low, high in sorted(intervals):
        if low - reached > 1e-6:
            rest.append((reached, low))
        reached = max(reached, high)
    if 1.0 - reached > 1e-6:
        rest.append((reached, 1.0))
    return rest


def chain(segments: np.ndarray) -> np.ndarray:
    """Segments reordered so that each starts where the last one ended, loop after loop, shape (S, 7)."""
    remaining = list(range(len(segments)))
    order = [remaining.pop(0)]
    while remaining:
        gaps = np.linalg.norm(segments[remaining, :2] - segments[order[-1], 2:4], axis=1)
        order.append(remaining.pop(int(np.argmin(gaps))))
    return segments[order]


def column(row: np.ndarray, x: float) -> tuple[float, float] | None:
    """Interval of y in which the vertical line at x crosses a primitive."""
    if row[5] > 0.0:
        square = row[5] ** 2 - (x - row[0]) ** 2
        half = math.sqrt(max(square, 0.0))
        return (row[1] - half, row[1] + half) if square > 0.0 else None
    reach = 4.0 * (row[2] + row[3]) + abs(x - row[0])
    low, high = _inside(row, np.array([x, row[1] - reach]), np.array([x, row[1] + reach]))
    return (row[1] + (2 * low - 1) * reach, row[1] + (2 * high - 1) * reach) if high > low else None


def merge(intervals: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Union of intervals as disjoint intervals."""
    merged: list[tuple[float, float]] = []
    for low, high in sorted(intervals):
        if merged and low <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(high, merged[-1][1]))
        else:
            merged.append((low, high))
    return merged
