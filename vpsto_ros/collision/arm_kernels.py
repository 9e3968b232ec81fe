"""Compiled checks of an arm made of capsules: where they are, whether they touch anything, how far they are.

Capsules are sorted by link; a placed capsule is a row (start, direction, centre). Pairs that can never meet
are not in the lists, see :mod:`vpsto_ros.collision.arm_model`.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vpsto_ros.collision.distance import into_frame, segment_box_squared, segment_segment_squared

ROW = 9  # numbers of a placed capsule
CHUNK = 128  # postures whose sines are computed in one go; they stay in the first cache
# A quarter turn in two parts; the first has so few digits that its multiples are exact.
_QUARTER_HIGH = float(np.float32(math.pi / 2))
_QUARTER_LOW = math.pi / 2 - _QUARTER_HIGH
_FAR = 100.0  # [rad]


class ArmArrays(NamedTuple):
    """The moving geometry.

    Attributes:
        dh: modified DH rows (a, d, cos alpha, sin alpha) of the links 1..7, shape (7, 4).
        first: index of the first capsule of every link from 0 to 7, and the number of capsules, shape (9,).
        local: start and direction of every capsule in the frame of its link, shape (C, 6) [m].
        radius: shape (C,) [m].
        half_length: of the segments, shape (C,) [m].
        swing: largest distance of a segment's points from the axis of a joint, zero where the joint does
            not move the capsule, shape (C, 7) [m].
        link: link of every capsule, shape (C,).
        pairs: self-collision pairs, the first with the lower link, shape (S, 2).
    """

    dh: NDArray[np.float64]
    first: NDArray[np.int64]
    local: NDArray[np.float64]
    radius: NDArray[np.float64]
    half_length: NDArray[np.float64]
    swing: NDArray[np.float64]
    link: NDArray[np.int64]
    pairs: NDArray[np.int64]


class CellArrays(NamedTuple):
    """The obstacles, and which capsule may meet which of them.

    Attributes:
        boxes: centre, rotation row by row, half sizes, shape (.., 15).
        box_bound: radius of the enclosing ball, shape (..,).
        capsules: start, direction, radius, half the length of the segment, 1 / length² (0 for a ball),
            shape (.., 9).
        planes: normal and offset, shape (.., 4).
        box_pairs, capsule_pairs, plane_pairs: (capsule of the arm, obstacle), shape (.., 2).
    """

    boxes: NDArray[np.float64]
    box_bound: NDArray[np.float64]
    capsules: NDArray[np.float64]
    planes: NDArray[np.float64]
    box_pairs: NDArray[np.int64]
    capsule_pairs: NDArray[np.int64]
    plane_pairs: NDArray[np.int64]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _put(local, world, k, X, Y, Z, p):
    """Capsule k of a link with axes X, Y, Z and origin p."""
    for i in range(3):
        start = X[i] * local[k, 0] + Y[i] * local[k, 1] + Z[i] * local[k, 2] + p[i]
        along = X[i] * local[k, 3] + Y[i] * local[k, 4] + Z[i] * local[k, 5]
        world[k, i], world[k, 3 + i], world[k, 6 + i] = start, along, start + 0.5 * along


@njit(cache=True, nogil=True, error_model="numpy")
def sines(angles, sine, cosine):
    """Fill sines and cosines of angles (N,) [rad], exact to 5e-16.

    Without branches, so that the loop runs on vector registers, in a fifth of the time of the C library:
    quarter turns are taken off, and the Taylor series does the rest within 45 degrees. Far beyond all joints,
    where the multiples of a quarter turn are no longer exact, the C library does it all.
    """
    beyond = 0
    for i in range(angles.shape[0]):
        beyond += not abs(angles[i]) <= _FAR
    if beyond:
        for i in range(angles.shape[0]):
            sine[i], cosine[i] = math.sin(angles[i]), math.cos(angles[i])
        return
    for i in range(angles.shape[0]):
        quarter = np.floor(angles[i] * (2.0 / math.pi) + 0.5)
        x = (angles[i] - quarter * _QUARTER_HIGH) - quarter * _QUARTER_LOW
        z = x * x
        s = x + x * z * (
            -1 / 6 + z * (1 / 120 + z * (-1 / 5040 + z * (1 / 362880 + z * (-1 / 39916800 + z * (
                1 / 6227020800 - z / 1307674368000)))))
        )  # fmt: skip
        c = 1.0 - 0.5 * z + z * z * (
            1 / 24 + z * (-1 / 720 + z * (1 / 40320 + z * (-1 / 3628800 + z * (1 / 479001600 + z * (
                -1 / 87178291200 + z / 20922789888000)))))
        )  # fmt: skip
        turned = quarter - 4.0 * np.floor(0.25 * quarter)
        odd = turned == 1.0 or turned == 3.0
        sine[i] = (c if odd else s) * (-1.0 if turned >= 2.0 else 1.0)
        cosine[i] = (s if odd else c) * (-1.0 if turned == 1.0 or turned == 2.0 else 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def place(arm, sine, cosine, world):
    """Fill world (C, 9) with the capsules at a posture given by the joints' sines and cosines (7,)."""
    X, Y, Z, p = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
    for k in range(arm.first[0], arm.first[1]):
        _put(arm.local, world, k, X, Y, Z, p)
    for i in range(7):
        a, d, ca, sa = arm.dh[i, 0], arm.dh[i, 1], arm.dh[i, 2], arm.dh[i, 3]
        c, s = cosine[i], sine[i]
        V = (ca * Y[0] + sa * Z[0], ca * Y[1] + sa * Z[1], ca * Y[2] + sa * Z[2])
        Z = (ca * Z[0] - sa * Y[0], ca * Z[1] - sa * Y[1], ca * Z[2] - sa * Y[2])
        p = (p[0] + a * X[0] + d * Z[0], p[1] + a * X[1] + d * Z[1], p[2] + a * X[2] + d * Z[2])
        U = (c * X[0] + s * V[0], c * X[1] + s * V[1], c * X[2] + s * V[2])
        Y = (c * V[0] - s * X[0], c * V[1] - s * X[1], c * V[2] - s * X[2])
        X = U
        for k in range(arm.first[i + 1], arm.first[i + 2]):
            _put(arm.local, world, k, X, Y, Z, p)


@njit(cache=True, nogil=True, error_model="numpy")
def workspace(arm):
    """Room for the sines and cosines (CHUNK, 7) of some postures, and for the placed capsules (C, 9)."""
    return np.empty((CHUNK, 7)), np.empty((CHUNK, 7)), np.empty((arm.local.shape[0], ROW))


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _box_hit(w, reach, half_length, box, bound):
    """Whether a placed capsule of radius `reach` meets a box: balls, then the centre, then the segment."""
    x, y, z = w[6] - box[0], w[7] - box[1], w[8] - box[2]
    near = reach + half_length + bound
    if x * x + y * y + z * z > near * near:
        return False
    x, y, z = into_frame(box, x, y, z)
    ex, ey, ez = max(abs(x) - box[12], 0.0), max(abs(y) - box[13], 0.0), max(abs(z) - box[14], 0.0)
    squared = ex * ex + ey * ey + ez * ez
    if squared > (reach + half_length) ** 2:
        return False
    if squared < reach * reach:
        return True
    dx, dy, dz = into_frame(box, w[3], w[4], w[5])
    if max(abs(x) - 0.5 * abs(dx) - box[12], abs(y) - 0.5 * abs(dy) - box[13],
           abs(z) - 0.5 * abs(dz) - box[14]) > reach:  # fmt: skip
        return False
    x, y, z = x - 0.5 * dx, y - 0.5 * dy, z - 0.5 * dz
    return segment_box_squared(x, y, z, dx, dy, dz, box[12], box[13], box[14]) < reach * reach


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _segments_within(v, w, reach):
    """Whether the segments of two rows (start, direction, ..) are closer than reach."""
    squared = segment_segment_squared(
        v[0], v[1], v[2], v[3], v[4], v[5], w[0], w[1], w[2], w[3], w[4], w[5]
    )  # fmt: skip
    return squared < reach * reach


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _self_hit(v, w, reach, half_lengths):
    """Whether two placed capsules are closer than reach: balls, then the segments."""
    x, y, z = w[6] - v[6], w[7] - v[7], w[8] - v[8]
    near = reach + half_lengths
    return x * x + y * y + z * z < near * near and _segments_within(v, w, reach)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _capsule_hit(w, reach, half_length, v):
    """Whether a placed capsule meets an obstacle: its ball against the segment, then the segments.

    An obstacle may be long, so that a ball around it would say little.
    """
    x, y, z = w[6] - v[0], w[7] - v[1], w[8] - v[2]
    t = min(1.0, max(0.0, (x * v[3] + y * v[4] + z * v[5]) * v[8]))
    x, y, z = x - t * v[3], y - t * v[4], z - t * v[5]
    squared, near = x * x + y * y + z * z, reach + v[6]
    if squared > (near + half_length) ** 2:
        return False
    return squared < near * near or _segments_within(v, w, near)


@njit(cache=True, nogil=True, error_model="numpy")
def touches(arm, cell, world, reach, pair_reach):
    """Whether any pair is closer than allowed.

    Args:
        arm: the arm.
        cell: its surroundings.
        world: placed capsules (C, 9).
        reach: radius of every capsule against obstacles, shape (C,).
        pair_reach: smallest distance of the segments of every self-collision pair, shape (S,).
    """
    for n in range(cell.plane_pairs.shape[0]):
        k, plane = cell.plane_pairs[n, 0], cell.planes[cell.plane_pairs[n, 1]]
        w = world[k]
        height = plane[0] * w[6] + plane[1] * w[7] + plane[2] * w[8] - plane[3]
        if height - 0.5 * abs(plane[0] * w[3] + plane[1] * w[4] + plane[2] * w[5]) < reach[k]:
            return True
    for n in range(cell.box_pairs.shape[0]):
        k, i = cell.box_pairs[n, 0], cell.box_pairs[n, 1]
        if _box_hit(world[k], reach[k], arm.half_length[k], cell.boxes[i], cell.box_bound[i]):
            return True
    for n in range(cell.capsule_pairs.shape[0]):
        k, i = cell.capsule_pairs[n, 0], cell.capsule_pairs[n, 1]
        if _capsule_hit(world[k], reach[k], arm.half_length[k], cell.capsules[i]):
            return True
    for n in range(arm.pairs.shape[0]):
        k, i = arm.pairs[n, 0], arm.pairs[n, 1]
        if _self_hit(world[k], world[i], pair_reach[n], arm.half_length[k] + arm.half_length[i]):
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def check(arm, cell, q, reach, pair_reach, hit):
    """Fill hit (M,) for the postures q (M, 7): whether any pair is closer than :func:`touches` allows."""
    sine, cosine, world = workspace(arm)
    for begin in range(0, q.shape[0], CHUNK):
        rows = q[begin : begin + CHUNK]
        sines(rows.reshape(-1), sine.reshape(-1), cosine.reshape(-1))
        for m in range(rows.shape[0]):
            place(arm, sine[m], cosine[m], world)
            hit[begin + m] = touches(arm, cell, world, reach, pair_reach)


@njit(cache=True, nogil=True)
def all_finite(values):
    """Whether no entry of an array is infinite or nan."""
    total = 0.0
    for value in values.flat:
        total += value - value
    return total == 0.0
