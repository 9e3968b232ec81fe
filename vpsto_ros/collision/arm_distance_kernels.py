"""Compiled signed distances of an arm made of capsules: of every pair, the nearest one, and the overlaps.

Pairs are numbered through: first those with planes, then boxes, capsules, and the arm with itself.
"""

import numpy as np
from numba import njit

from vpsto_ros.collision.arm_kernels import place, sines, workspace
from vpsto_ros.collision.distance import (
    capsule_box_distance,
    capsule_capsule_distance,
    capsule_plane_distance,
)


@njit(cache=True, nogil=True, error_model="numpy")
def pair_count(arm, cell):
    """Number of all pairs."""
    obstacles = cell.plane_pairs.shape[0] + cell.box_pairs.shape[0] + cell.capsule_pairs.shape[0]
    return obstacles + arm.pairs.shape[0]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _beyond(w, v, limit):
    """Whether two centres are farther apart than a limit."""
    x, y, z = w[6] - v[0], w[7] - v[1], w[8] - v[2]
    return limit > 0.0 and x * x + y * y + z * z > limit * limit


@njit(cache=True, nogil=True, error_model="numpy")
def pair_distance(arm, cell, world, n, cutoff):
    """Signed distance of pair n [m]; infinite if balls around the two already show that it exceeds cutoff."""
    planes = cell.plane_pairs.shape[0]
    if n < planes:
        k = cell.plane_pairs[n, 0]
        return capsule_plane_distance(world[k], arm.radius[k], cell.planes[cell.plane_pairs[n, 1]])
    n -= planes
    boxes = cell.box_pairs.shape[0]
    if n < boxes:
        k, i = cell.box_pairs[n, 0], cell.box_pairs[n, 1]
        outer = arm.radius[k] + arm.half_length[k] + cell.box_bound[i]
        if _beyond(world[k], cell.boxes[i], outer + cutoff):
            return np.inf
        return capsule_box_distance(world[k], arm.radius[k], cell.boxes[i])
    n -= boxes
    capsules = cell.capsule_pairs.shape[0]
    if n < capsules:
        k, i = cell.capsule_pairs[n, 0], cell.capsule_pairs[n, 1]
        v = cell.capsules[i]
        outer = arm.radius[k] + arm.half_length[k] + v[9] + v[10]
        if _beyond(world[k], v[6:9], outer + cutoff):
            return np.inf
        return capsule_capsule_distance(world[k], v, arm.radius[k] + v[9])
    n -= capsules
    k, i = arm.pairs[n, 0], arm.pairs[n, 1]
    radii = arm.radius[k] + arm.radius[i]
    if _beyond(world[k], world[i, 6:9], radii + arm.half_length[k] + arm.half_length[i] + cutoff):
        return np.inf
    return capsule_capsule_distance(world[k], world[i], radii)


@njit(cache=True, nogil=True, error_model="numpy")
def nearest(arm, cell, q, distance, pair):
    """Fill the least signed distance (M,) over all pairs and its pair (M,), -1 if there is none."""
    sine, cosine, world = workspace(arm)
    for m in range(q.shape[0]):
        sines(q[m], sine[0], cosine[0])
        place(arm, sine[0], cosine[0], world)
        best, which = np.inf, -1
        for n in range(pair_count(arm, cell)):
            value = pair_distance(arm, cell, world, n, best)
            if value < best:
                best, which = value, n
        distance[m], pair[m] = best, which


@njit(cache=True, nogil=True, error_model="numpy")
def every_pair(arm, cell, q, distance):
    """Fill the signed distances (M, pairs)."""
    sine, cosine, world = workspace(arm)
    for m in range(q.shape[0]):
        sines(q[m], sine[0], cosine[0])
        place(arm, sine[0], cosine[0], world)
        for n in range(distance.shape[1]):
            distance[m, n] = pair_distance(arm, cell, world, n, np.inf)


@njit(cache=True, nogil=True, error_model="numpy")
def overlap(arm, cell, world, margin):
    """By how much the pairs that are closer than a margin are too close, summed [m]."""
    total = 0.0
    for n in range(pair_count(arm, cell)):
        total += max(margin - pair_distance(arm, cell, world, n, margin), 0.0)
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def self_distance_range(arm, q):
    """Least and greatest signed distance (S,), (S,) of every self-collision pair over postures q (M, 7)."""
    least, greatest = np.full(arm.pairs.shape[0], np.inf), np.full(arm.pairs.shape[0], -np.inf)
    sine, cosine, world = workspace(arm)
    for m in range(q.shape[0]):
        sines(q[m], sine[0], cosine[0])
        place(arm, sine[0], cosine[0], world)
        for n in range(arm.pairs.shape[0]):
            k, i = arm.pairs[n, 0], arm.pairs[n, 1]
            distance = capsule_capsule_distance(world[k], world[i], arm.radius[k] + arm.radius[i])
            least[n], greatest[n] = min(least[n], distance), max(greatest[n], distance)
    return least, greatest
