"""Exact distances between a segment and the cores of the shapes, compiled.

A capsule is a segment with a radius. Inflating a convex body by r lowers its signed distance by exactly r,
so every pair of shapes comes down to a segment against a core: another segment (spheres are segments without
length), a box, or a plane. The signed distance of two overlapping cores is minus the length of the shortest
translation that separates them; for two segments that is zero, however they cross.
"""

import math

import numpy as np
from numba import njit

_TOUCHING = 1e-10  # a distance of the cores below this is an overlap [m]
_PARALLEL = 1e-12


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def segment_segment_squared(px, py, pz, dx, dy, dz, qx, qy, qz, ex, ey, ez):
    """Squared distance of the segments p + s d and q + t e with s and t from 0 to 1.

    The interior solution of the linear system, then each parameter clamped given the other: exact, as the
    squared distance is convex in (s, t).
    """
    rx, ry, rz = px - qx, py - qy, pz - qz
    a = dx * dx + dy * dy + dz * dz
    e = ex * ex + ey * ey + ez * ez
    c = dx * rx + dy * ry + dz * rz
    f = ex * rx + ey * ry + ez * rz
    b = dx * ex + dy * ey + dz * ez
    denominator = a * e - b * b
    s = 0.0
    if denominator > _PARALLEL * a * e:
        s = min(1.0, max(0.0, (b * f - c * e) / denominator))
    t = (b * s + f) / e if e > 0.0 else 0.0
    if t < 0.0 or t > 1.0 or e == 0.0:
        t = min(1.0, max(0.0, t))
        s = min(1.0, max(0.0, (b * t - c) / a)) if a > 0.0 else 0.0
    x, y, z = rx + s * dx - t * ex, ry + s * dy - t * ey, rz + s * dz - t * ez
    return x * x + y * y + z * z


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _excess(p, h):
    """By how much a coordinate p is beyond the range from -h to h, with its sign."""
    return p - h if p > h else (p + h if p < -h else 0.0)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _slope(t, px, py, pz, dx, dy, dz, hx, hy, hz):
    """Half the derivative of the squared distance between the point p + t d and the box."""
    x, y, z = _excess(px + t * dx, hx), _excess(py + t * dy, hy), _excess(pz + t * dz, hz)
    return x * dx + y * dy + z * dz


@njit(cache=True, nogil=True, error_model="numpy")
def segment_box_squared(px, py, pz, dx, dy, dz, hx, hy, hz):
    """Squared distance of the segment p + t d from the box of half sizes h around the origin; 0 if they meet.

    The squared distance is convex in t and quadratic between the up to six parameters at which the segment
    passes a plane of the box. Those close in on the interval that holds the minimum; there its slope is
    linear, so that the minimum follows without iteration.
    """
    low, high = 0.0, 1.0
    slope_low = _slope(0.0, px, py, pz, dx, dy, dz, hx, hy, hz)
    if slope_low >= 0.0:
        t = 0.0
    else:
        slope_high = _slope(1.0, px, py, pz, dx, dy, dz, hx, hy, hz)
        if slope_high <= 0.0:
            t = 1.0
        else:
            for p, d, h in ((px, dx, hx), (py, dy, hy), (pz, dz, hz)):
                for side in (-h, h):
                    u = (side - p) / d  # infinite or nan where d is zero, and then passed over
                    if low < u < high:
                        slope = _slope(u, px, py, pz, dx, dy, dz, hx, hy, hz)
                        if slope < 0.0:
                            low, slope_low = u, slope
                        else:
                            high, slope_high = u, slope
            rise = slope_high - slope_low
            t = low - (high - low) * slope_low / rise if rise > 0.0 else low
    x, y, z = _excess(px + t * dx, hx), _excess(py + t * dy, hy), _excess(pz + t * dz, hz)
    return x * x + y * y + z * z


@njit(cache=True, nogil=True, error_model="numpy")
def segment_box_depth(px, py, pz, dx, dy, dz, hx, hy, hz):
    """Length of the shortest translation that takes a segment out of a box that it meets.

    Box and segment together sweep a polytope whose faces have the directions of the box's edges or are
    perpendicular to the segment and one edge; the nearest of those faces counts.
    """
    mx, my, mz = px + 0.5 * dx, py + 0.5 * dy, pz + 0.5 * dz
    depth = min(hx + 0.5 * abs(dx) - abs(mx), hy + 0.5 * abs(dy) - abs(my), hz + 0.5 * abs(dz) - abs(mz))
    size = dx * dx + dy * dy + dz * dz
    for d1, d2, h1, h2, m1, m2 in (
        (dy, dz, hy, hz, my, mz), (dz, dx, hz, hx, mz, mx), (dx, dy, hx, hy, mx, my),
    ):  # fmt: skip
        across = d1 * d1 + d2 * d2
        if across > _PARALLEL * size:
            gap = h1 * abs(d2) + h2 * abs(d1) - abs(m1 * d2 - m2 * d1)
            depth = min(depth, gap / math.sqrt(across))
    return max(depth, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def segment_box(px, py, pz, dx, dy, dz, hx, hy, hz):
    """Signed distance of a segment from a box around the origin; minus the depth if they meet."""
    distance = math.sqrt(segment_box_squared(px, py, pz, dx, dy, dz, hx, hy, hz))
    if distance > _TOUCHING:
        return distance
    return -segment_box_depth(px, py, pz, dx, dy, dz, hx, hy, hz)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def into_frame(box, x, y, z):
    """A direction in the axes of a box whose rotation matrix is box[3:12], row by row."""
    return (
        box[3] * x + box[6] * y + box[9] * z,
        box[4] * x + box[7] * y + box[10] * z,
        box[5] * x + box[8] * y + box[11] * z,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def capsule_box_distance(segment, radius, box):
    """Signed distance of a capsule with segment (start, direction) from a box (centre, rotation, h)."""
    px, py, pz = into_frame(box, segment[0] - box[0], segment[1] - box[1], segment[2] - box[2])
    dx, dy, dz = into_frame(box, segment[3], segment[4], segment[5])
    return segment_box(px, py, pz, dx, dy, dz, box[12], box[13], box[14]) - radius


@njit(cache=True, nogil=True, error_model="numpy")
def capsule_capsule_distance(first, second, radii):
    """Signed distance of two capsules given as (start, direction) (6,), with the sum of their radii."""
    squared = segment_segment_squared(
        first[0], first[1], first[2], first[3], first[4], first[5],
        second[0], second[1], second[2], second[3], second[4], second[5],
    )  # fmt: skip
    return math.sqrt(squared) - radii


@njit(cache=True, nogil=True, error_model="numpy")
def capsule_plane_distance(segment, radius, plane):
    """Signed distance of a capsule from the half-space normal · p <= offset, plane = (normal, offset)."""
    start = plane[0] * segment[0] + plane[1] * segment[1] + plane[2] * segment[2]
    along = plane[0] * segment[3] + plane[1] * segment[4] + plane[2] * segment[5]
    return start + min(along, 0.0) - plane[3] - radius


def box_row(centre, rotation, half_size) -> np.ndarray:
    """The numbers of a box as :func:`capsule_box_distance` wants them, shape (15,)."""
    return np.concatenate([centre, np.ravel(rotation), half_size])
