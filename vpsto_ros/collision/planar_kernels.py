"""Compiled kernels of a planar world: which points are inside an obstacle, and how far from it."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

TOUCH = 1e-12
"""Depth [m] up to which an obstacle counts as touched: what round-off cannot tell from outside."""


class PackedWorld(NamedTuple):
    """A world as the kernels take it.

    Attributes:
        edges: (E, 7) rows x, y, direction (2), outward or inward normal (2), length [m]; polygon by polygon.
        first: (P + 1,) the row where each polygon begins, and E.
        boxes: (P, 4) bounding boxes: lowest x, y, highest x, y.
        discs: (D, 5) rows x, y, velocity (2), radius.
        walls: (4,) lowest x, y, highest x, y of free space; may be infinite.
    """

    edges: np.ndarray
    first: np.ndarray
    boxes: np.ndarray
    discs: np.ndarray
    walls: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy")
def in_polygon(world, p, x, y):
    """Whether a point is deeper than TOUCH in polygon p: even-odd rule, then the distance to its edges."""
    odd = False
    for e in range(world.first[p], world.first[p + 1]):
        following = world.first[p] if e + 1 == world.first[p + 1] else e + 1
        ay, by = world.edges[e, 1], world.edges[following, 1]
        if (ay > y) != (by > y):
            odd ^= (world.edges[e, 2] * (y - ay) > world.edges[e, 3] * (x - world.edges[e, 0])) == (by > ay)
    return odd and _edge_distance(world, p, x, y) > TOUCH


@njit(cache=True, nogil=True, error_model="numpy")
def _edge_distance(world, p, x, y):
    """Distance [m] of a point to the outline of polygon p."""
    nearest = np.inf
    for e in range(world.first[p], world.first[p + 1]):
        dx, dy = x - world.edges[e, 0], y - world.edges[e, 1]
        along = dx * world.edges[e, 2] + dy * world.edges[e, 3]
        along = min(max(along, 0.0), world.edges[e, 6])
        nearest = min(nearest, math.hypot(dx - along * world.edges[e, 2], dy - along * world.edges[e, 3]))
    return nearest


@njit(cache=True, nogil=True, error_model="numpy")
def wall_clearance(world, x, y):
    """Distance [m] to the walls, negative beyond them."""
    low_x, low_y, high_x, high_y = world.walls
    out_x, out_y = max(low_x - x, x - high_x), max(low_y - y, y - high_y)
    if out_x > 0.0 and out_y > 0.0:
        return -math.hypot(out_x, out_y)
    return -max(out_x, out_y)


@njit(cache=True, nogil=True, error_model="numpy")
def clearances(world, points, times):
    """Signed distance (K,) [m] of points (K, 2) at times (K,) to the nearest obstacle; -inf for NaN."""
    distance = np.empty(len(points))
    for k in range(len(points)):
        x, y = points[k]
        nearest = wall_clearance(world, x, y)
        for p in range(world.boxes.shape[0]):
            depth = _edge_distance(world, p, x, y)
            nearest = min(nearest, -depth if in_polygon(world, p, x, y) else depth)
        for disc in world.discs:
            dx, dy = x - disc[0] - times[k] * disc[2], y - disc[1] - times[k] * disc[3]
            nearest = min(nearest, math.hypot(dx, dy) - disc[4])
        distance[k] = -np.inf if math.isnan(x + y + times[k]) else nearest
    return distance


@njit(cache=True, nogil=True, error_model="numpy")
def inside_any(world, points, times):
    """Which of the points (K, 2) are inside an obstacle or beyond the walls at their times (K,); NaN is."""
    hit = np.empty(len(points), dtype=np.bool_)
    for k in range(len(points)):
        x, y = points[k]
        found = wall_clearance(world, x, y) < -TOUCH or math.isnan(x + y + times[k])
        for disc in world.discs:
            dx, dy = x - disc[0] - times[k] * disc[2], y - disc[1] - times[k] * disc[3]
            found |= math.hypot(dx, dy) < disc[4] - TOUCH
        for p in range(world.boxes.shape[0]):
            box = world.boxes[p]
            if not found and box[0] < x < box[2] and box[1] < y < box[3]:
                found = in_polygon(world, p, x, y)
        hit[k] = found
    return hit
