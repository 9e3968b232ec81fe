"""Compiled kernels of a planar world: where a path is inside an obstacle, exactly.

A piece of a path is a polynomial of degree d in 0 <= u <= 1, given by its control points (d + 1, 2). It is
cut where it crosses the line of an edge within that edge, the circle of a disc or a wall; between two cuts it
is inside or outside all along, which the middle tells. A piece whose control points stay clear of an
obstacle's box is not looked at.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from vpsto_ros.collision.planar_kernels import TOUCH, in_polygon, wall_clearance
from vpsto_ros.collision.planar_roots import DEPTH, roots, value_and_slope

SHORTEST = 1e-12
"""Share of a piece below which a stay inside an obstacle is round-off at a corner."""


class Workspace(NamedTuple):
    """Memory for :func:`occupied`, made once per call from Python by :func:`workspace`."""

    path: np.ndarray
    form: np.ndarray
    work: np.ndarray
    cuts: np.ndarray
    stack: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy")
def most_edges(world):
    """Edges of the polygon with most of them, at least 4."""
    largest = 4
    for p in range(world.boxes.shape[0]):
        largest = max(largest, world.first[p + 1] - world.first[p])
    return largest


@njit(cache=True, nogil=True, error_model="numpy")
def workspace(largest, degree):
    """Memory for pieces of a degree and obstacles of so many edges; 4 edges are enough for discs."""
    return Workspace(
        np.empty((2, degree + 1)),
        np.empty(2 * degree + 1),
        np.empty(2 * degree + 1),
        np.empty(largest * (degree + 2) + 2 * degree + 2),
        np.empty((DEPTH, 2 * degree + 4)),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def set_path(control, degree, disc, start, end, path):
    """Control points (2, d + 1), relative to the disc if there is one; returns their box."""
    x0, y0, x1, y1 = np.inf, np.inf, -np.inf, -np.inf
    for k in range(degree + 1):
        x, y = control[k, 0], control[k, 1]
        if disc.size:
            t = start + (end - start) * k / degree
            x -= disc[0] + t * disc[2]
            y -= disc[1] + t * disc[3]
        path[0, k], path[1, k] = x, y
        x0, y0, x1, y1 = min(x0, x), min(y0, y), max(x1, x), max(y1, y)
    return x0, y0, x1, y1


@njit(cache=True, nogil=True, error_model="numpy")
def _polygon_cuts(world, p, degree, hull, space):
    """Cuts of the piece with the edges of polygon p."""
    count = 1
    for e in range(world.first[p], world.first[p + 1]):
        ax, ay, dx, dy, nx, ny, length = world.edges[e]
        bx, by = ax + length * dx, ay + length * dy
        if max(ax, bx) < hull[0] or min(ax, bx) > hull[2] or max(ay, by) < hull[1] or min(ay, by) > hull[3]:
            continue
        for k in range(degree + 1):
            space.form[k] = nx * (space.path[0, k] - ax) + ny * (space.path[1, k] - ay)
        before = count
        count = roots(space.form, degree, 0.1 * TOUCH, space.stack, space.cuts, count)
        kept = before
        for c in range(before, count):
            x, _ = value_and_slope(space.path[0], degree, space.cuts[c], space.work)
            y, _ = value_and_slope(space.path[1], degree, space.cuts[c], space.work)
            # Beside the edge there is nothing to cross; a cut too many at a corner does no harm.
            if -1e-9 <= (x - ax) * dx + (y - ay) * dy <= length + 1e-9:
                space.cuts[kept] = space.cuts[c]
                kept += 1
        count = kept
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def disc_cuts(first, last, degree, space, count):
    """Cuts of the piece, relative to the centre, with a circle: |q|^2 = r^2, a polynomial of degree 2 d.

    The radius goes from `first` to `last` at a constant rate along the piece.
    """
    form, path = space.form, space.path
    form[: 2 * degree + 1] = 0.0
    over_i = 1.0  # binomial coefficients (degree over i) and (degree over j)
    for i in range(degree + 1):
        radius_i, over_j = first + (last - first) * i / degree, 1.0
        for j in range(degree + 1):
            radius_j = first + (last - first) * j / degree
            square = path[0, i] * path[0, j] + path[1, i] * path[1, j] - radius_i * radius_j
            form[i + j] += over_i * over_j * square
            over_j *= (degree - j) / (j + 1.0)
        over_i *= (degree - i) / (i + 1.0)
    over = 2.0 * max(first, last)  # near the circle, values become distances
    for k in range(2 * degree + 1):
        form[k] /= over
        over *= (2 * degree - k) / (k + 1.0)
    return roots(form, 2 * degree, 0.1 * TOUCH, space.stack, space.cuts, count)


@njit(cache=True, nogil=True, error_model="numpy")
def _wall_cuts(world, degree, space):
    count = 1
    for w in range(4):
        if math.isinf(world.walls[w]):
            continue
        for k in range(degree + 1):
            space.form[k] = space.path[w % 2, k] - world.walls[w]
        count = roots(space.form, degree, 0.1 * TOUCH, space.stack, space.cuts, count)
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _is_inside(world, o, x, y):
    polygons, discs = world.boxes.shape[0], world.discs.shape[0]
    if o < polygons:
        return in_polygon(world, o, x, y)
    if o < polygons + discs:
        return math.hypot(x, y) < world.discs[o - polygons, 4] - TOUCH
    return wall_clearance(world, x, y) < -TOUCH


@njit(cache=True, nogil=True, error_model="numpy")
def _out_of_reach(world, o, hull):
    """Whether a piece in this box cannot enter obstacle o; never said of a disc, which may move."""
    polygons = world.boxes.shape[0]
    if o < polygons:
        box = world.boxes[o]
        return hull[0] >= box[2] or hull[1] >= box[3] or hull[2] <= box[0] or hull[3] <= box[1]
    if o < polygons + world.discs.shape[0]:
        return False
    low_x, low_y, high_x, high_y = world.walls
    return hull[0] >= low_x and hull[1] >= low_y and hull[2] <= high_x and hull[3] <= high_y


@njit(cache=True, nogil=True, error_model="numpy")
def _cuts(world, o, control, degree, start, end, space):
    """Cuts of a piece with obstacle o in cuts[1:count], and whether it can be inside at all (count > 0)."""
    polygons, discs, none = world.boxes.shape[0], world.discs.shape[0], world.walls[:0]
    disc = world.discs[o - polygons] if polygons <= o < polygons + discs else none
    hull = set_path(control, degree, disc, start, end, space.path)
    if disc.size:
        radius = disc[4]
        if max(hull[0], hull[1], -hull[2], -hull[3]) >= radius:
            return 0
        return disc_cuts(radius, radius, degree, space, 1)
    if _out_of_reach(world, o, hull):
        return 0
    if o < polygons:
        return _polygon_cuts(world, o, degree, hull, space)
    return _wall_cuts(world, degree, space)


@njit(cache=True, nogil=True, error_model="numpy")
def occupied(world, o, control, degree, start, end, space):
    """Where a piece of a path is inside obstacle o, as pairs of u in `space.cuts`, in order.

    Args:
        world: :class:`PackedWorld`. Its obstacles count polygons first, then discs, then all walls as one.
        o: which of them.
        control: control points (degree + 1, 2) [m].
        degree: of the piece.
        start: time of its beginning [s], on the clock of the discs.
        end: time of its end [s].
        space: :class:`Workspace` for this degree or a higher one.

    Returns:
        The number of pairs.
    """
    count = _cuts(world, o, control, degree, start, end, space)
    if count == 0:
        return 0
    cuts = space.cuts
    cuts[0] = 0.0
    count = min(count, cuts.size - 1)
    cuts[1:count].sort()
    cuts[count] = 1.0
    pairs = 0
    open_end = False
    for c in range(count):
        low, high = cuts[c], cuts[c + 1]
        if high - low <= SHORTEST:
            continue
        x, _ = value_and_slope(space.path[0], degree, 0.5 * (low + high), space.work)
        y, _ = value_and_slope(space.path[1], degree, 0.5 * (low + high), space.work)
        if not _is_inside(world, o, x, y):
            open_end = False
        elif open_end:
            cuts[2 * pairs - 1] = high
        else:
            cuts[2 * pairs], cuts[2 * pairs + 1] = low, high
            pairs += 1
            open_end = True
    return pairs


@njit(cache=True, nogil=True, error_model="numpy")
def hermite_piece(knots, keys, slopes, b, i, control):
    """Write the control points (4, 2) of segment i of batch row b; slopes are by phase."""
    third = (knots[i + 1] - knots[i]) / 3.0
    for j in range(2):
        control[0, j], control[3, j] = keys[b, i, j], keys[b, i + 1, j]
        control[1, j] = keys[b, i, j] + third * slopes[b, i, j]
        control[2, j] = keys[b, i + 1, j] - third * slopes[b, i + 1, j]


@njit(cache=True, nogil=True, error_model="numpy")
def times_in_collision(world, knots, keys, slopes, durations, start_time):
    """Time (B,) [s] that cubic Hermite segments spend inside obstacles, summed over the obstacles.

    Args:
        world: :class:`PackedWorld`.
        knots: phases (N + 2,).
        keys: key positions (B, N + 2, 2) [m].
        slopes: q' at the knots (B, N + 2, 2) [m].
        durations: (B,) [s]. What is not finite in a row gives it an infinite time.
        start_time: of phase zero [s], on the clock of the discs.
    """
    total = np.zeros(len(keys))
    space = workspace(most_edges(world), 3)
    control = np.empty((4, 2))
    obstacles = world.boxes.shape[0] + world.discs.shape[0] + 1
    for b in range(len(keys)):
        for i in range(knots.size - 1):
            h = knots[i + 1] - knots[i]
            hermite_piece(knots, keys, slopes, b, i, control)
            start, end = start_time + durations[b] * knots[i], start_time + durations[b] * knots[i + 1]
            if not math.isfinite(start + end + control.sum()):
                total[b] = np.inf
                break
            hull = set_path(control, 3, world.walls[:0], start, end, space.path)
            for o in range(obstacles):
                if _out_of_reach(world, o, hull):
                    continue
                for pair in range(occupied(world, o, control, 3, start, end, space)):
                    total[b] += h * durations[b] * (space.cuts[2 * pair + 1] - space.cuts[2 * pair])
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def stays(world, controls, times):
    """When a path is inside which obstacle: rows obstacle, from, until [s], joined over pieces, in no order.

    Args:
        world: :class:`PackedWorld`.
        controls: control points (S, d + 1, 2) of S pieces [m].
        times: their ends (S + 1,) [s].
    """
    degree = controls.shape[1] - 1
    space = workspace(most_edges(world), degree)
    rows: list[tuple[int, float, float]] = []
    for o in range(world.boxes.shape[0] + world.discs.shape[0] + 1):
        for s in range(len(controls)):
            start, end = times[s], times[s + 1]
            for pair in range(occupied(world, o, controls[s], degree, start, end, space)):
                low = start + (end - start) * space.cuts[2 * pair]
                high = start + (end - start) * space.cuts[2 * pair + 1]
                if len(rows) and rows[-1][0] == o and rows[-1][2] >= low:
                    rows[-1] = (o, rows[-1][1], high)
                else:
                    rows.append((o, low, high))
    return rows
