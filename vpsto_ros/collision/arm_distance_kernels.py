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
def _beyond(w, x, y, z, limit):
    """Whether the centre of a placed capsule is farther from a point than a limit."""
    x, y, z = w[6] - x, w[7] - y, w[8] - z
    return limit > 0.0 and x * x + y * y + z * z > limit * limit


@njit(cache=True, nogil=True, error_model="numpy")
def pair_distances(arm, cell, world, cutoff, falling, out):
    """Fill the signed distances (pairs,) [m] of placed capsules.

    Where balls around the two already show that a distance exceeds the cutoff, it is infinite. If the cutoff
    is falling it follows the least distance so far.
    """
    n = 0
    for m in range(cell.plane_pairs.shape[0]):
        k = cell.plane_pairs[m, 0]
        out[n] = capsule_plane_distance(world[k], arm.radius[k], cell.planes[cell.plane_pairs[m, 1]])
        cutoff = min(cutoff, out[n]) if falling else cutoff
        n += 1
    for m in range(cell.box_pairs.shape[0]):
        k, i = cell.box_pairs[m, 0], cell.box_pairs[m, 1]
        w, box = world[k], cell.boxes[i]
        outer = arm.radius[k] + arm.half_length[k] + cell.box_bound[i]
        out[n] = np.inf
        if not _beyond(w, box[0], box[1], box[2], outer + cutoff):
            out[n] = capsule_box_distance(w, arm.radius[k], box)
        cutoff = min(cutoff, out[n]) if falling else cutoff
        n += 1
    for m in range(cell.capsule_pairs.shape[0]):
        k, i = cell.capsule_pairs[m, 0], cell.capsule_pairs[m, 1]
        w, v = world[k], cell.capsules[i]
        outer = arm.radius[k] + arm.half_length[k] + v[6] + v[7]
        out[n] = np.inf
        if not _beyond(w, v[0] + 0.5 * v[3], v[1] + 0.5 * v[4], v[2] + 0.5 * v[5], outer + cutoff):
            out[n] = capsule_capsule_distance(w, v, arm.radius[k] + v[6])
        cutoff = min(cutoff, out[n]) if falling else cutoff
        n += 1
    for m in range(arm.pairs.shape[0]):
        k, i = arm.pairs[m, 0], arm.pairs[m, 1]
        w, v = world[k], world[i]
        radii = arm.radius[k] + arm.radius[i]
        out[n] = np.inf
        if not _beyond(w, v[6], v[7], v[8], radii + arm.half_length[k] + arm.half_length[i] + cutoff):
            out[n] = capsule_capsule_distance(w, v, radii)
        cutoff = min(cutoff, out[n]) if falling else cutoff
        n += 1


@njit(cache=True, nogil=True, error_model="numpy")
def nearest(arm, cell, q, distance):
    """Fill the least signed distance (M,) over all pairs, infinite if there is none."""
    sine, cosine, world = workspace(arm)
    out = np.empty(pair_count(arm, cell))
    for m in range(q.shape[0]):
        sines(q[m], sine[0], cosine[0])
        place(arm, sine[0], cosine[0], world)
        pair_distances(arm, cell, world, np.inf, True, out)
        distance[m] = out.min() if out.size else np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def every_pair(arm, cell, q, distance):
    """Fill the signed distances (M, pairs)."""
    sine, cosine, world = workspace(arm)
    for m in range(q.shape[0]):
        sines(q[m], sine[0], cosine[0])
        place(arm, sine[0], cosine[0], world)
        pair_distances(arm, cell, world, np.inf, False, distance[m])


@njit(cache=True, nogil=True, error_model="numpy")
def overlap(arm, cell, world, margin, out):
    """By how much the pairs that are closer than a margin are too close, summed [m]; out (pairs,) is room."""
    pair_distances(arm, cell, world, margin, False, out)
    total = 0.0
    for distance in out:
        total += max(margin - distance, 0.0)
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
