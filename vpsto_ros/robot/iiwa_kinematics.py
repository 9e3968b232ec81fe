"""Compiled kinematics of the iiwa with its rod: shoulder, elbow and wrist are spheres in a row.

What planners ask for thousands of times per replan: the universal joint at the end of the rod, how it moves
with the joints, and how high elbow and wrist are. Frame: the robot's base.
"""

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError

SHOULDER = 0.36  # from the base to the axis of joint 2 [m]
UPPER_ARM, FOREARM = 0.42, 0.40
ROD = 0.666  # from the axis of joint 6 to the universal joint, along the axis of joint 7
_LINKS = np.array([SHOULDER, UPPER_ARM, FOREARM, ROD])
# Joints turn in turn about the z axis of their link and, bending it, about its y axis; with these signs the
# angles are those of the standard Denavit-Hartenberg table, alpha = (-90, 90, 90, -90, -90, 90, 0) degrees.
_BENDS = np.array([1.0, -1.0, 1.0])


@njit(cache=True, nogil=True, error_model="numpy")
def chain(q, points, axes):
    """Joints' axes and the points they pass through, of one posture.

    Args:
        q: joint positions (7,) [rad].
        points: output, shoulder, elbow, wrist and universal joint, shape (4, 3) [m].
        axes: output, unit vectors along the joints' axes, shape (7, 3).
    """
    # Columns of the link's frame: x and z; y is along the joint that bends.
    xx, xy, xz = 1.0, 0.0, 0.0
    yx, yy, yz = 0.0, 1.0, 0.0
    zx, zy, zz = 0.0, 0.0, 1.0
    px, py, pz = 0.0, 0.0, SHOULDER
    points[0, 0], points[0, 1], points[0, 2] = px, py, pz
    for k in range(3):
        axes[2 * k, 0], axes[2 * k, 1], axes[2 * k, 2] = zx, zy, zz
        c, s = np.cos(q[2 * k]), np.sin(q[2 * k])
        xx, yx = c * xx + s * yx, c * yx - s * xx
        xy, yy = c * xy + s * yy, c * yy - s * xy
        xz, yz = c * xz + s * yz, c * yz - s * xz
        sign = _BENDS[k]
        axes[2 * k + 1, 0], axes[2 * k + 1, 1], axes[2 * k + 1, 2] = sign * yx, sign * yy, sign * yz
        c, s = np.cos(q[2 * k + 1]), sign * np.sin(q[2 * k + 1])
        zx, xx = c * zx + s * xx, c * xx - s * zx
        zy, xy = c * zy + s * xy, c * xy - s * zy
        zz, xz = c * zz + s * xz, c * xz - s * zz
        length = _LINKS[k + 1]
        px, py, pz = px + length * zx, py + length * zy, pz + length * zz
        points[k + 1, 0], points[k + 1, 1], points[k + 1, 2] = px, py, pz
    axes[6, 0], axes[6, 1], axes[6, 2] = zx, zy, zz


@njit(cache=True, nogil=True, error_model="numpy")
def jacobian(points, axes, out):
    """Jacobian (3, 6) of the universal joint; joint 7 turns about the rod and moves nothing."""
    for j in range(6):
        origin = j // 2  # shoulder, elbow or wrist, whichever the axis passes through last
        rx = points[3, 0] - points[origin, 0]
        ry = points[3, 1] - points[origin, 1]
        rz = points[3, 2] - points[origin, 2]
        out[0, j] = axes[j, 1] * rz - axes[j, 2] * ry
        out[1, j] = axes[j, 2] * rx - axes[j, 0] * rz
        out[2, j] = axes[j, 0] * ry - axes[j, 1] * rx


@njit(cache=True, nogil=True, error_model="numpy")
def add_least_motion(jac, ex, ey, ez, q):
    """Add to q (7,) the least joint motion that moves the universal joint by (ex, ey, ez), to first order."""
    a, b, c, d, e, f = 1e-9, 0.0, 0.0, 1e-9, 0.0, 1e-9  # J J' and a trace of damping
    for j in range(6):
        a += jac[0, j] * jac[0, j]
        b += jac[0, j] * jac[1, j]
        c += jac[0, j] * jac[2, j]
        d += jac[1, j] * jac[1, j]
        e += jac[1, j] * jac[2, j]
        f += jac[2, j] * jac[2, j]
    m00, m01, m02 = d * f - e * e, c * e - b * f, b * e - c * d
    m11, m12, m22 = a * f - c * c, b * c - a * e, a * d - b * b
    scale = 1.0 / (a * m00 + b * m01 + c * m02)
    lx = scale * (m00 * ex + m01 * ey + m02 * ez)
    ly = scale * (m01 * ex + m11 * ey + m12 * ez)
    lz = scale * (m02 * ex + m12 * ey + m22 * ez)
    for j in range(6):
        q[j] += jac[0, j] * lx + jac[1, j] * ly + jac[2, j] * lz


@njit(cache=True, nogil=True, error_model="numpy")
def move_to(q, x, y, z, points, axes, jac):
    """Move q (7,) to where the universal joint is at (x, y, z); whether that was reached.

    Points, axes and Jacobian are those of the result.
    """
    for _ in range(8):
        chain(q, points, axes)
        jacobian(points, axes, jac)
        ex, ey, ez = x - points[3, 0], y - points[3, 1], z - points[3, 2]
        if abs(ex) + abs(ey) + abs(ez) < 1e-10:
            return True
        add_least_motion(jac, ex, ey, ez, q)
    chain(q, points, axes)
    jacobian(points, axes, jac)
    return abs(x - points[3, 0]) + abs(y - points[3, 1]) + abs(z - points[3, 2]) < 1e-7


@njit(cache=True, nogil=True, error_model="numpy")
def move_to_height(q, z, points, axes, jac):
    """Move q (7,) by two Newton steps towards where the universal joint is at height z."""
    for _ in range(2):
        chain(q, points, axes)
        jacobian(points, axes, jac)
        square = 1e-9
        for j in range(6):
            square += jac[2, j] * jac[2, j]
        gain = (z - points[3, 2]) / square
        for j in range(6):
            q[j] += gain * jac[2, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _rows(q, points):
    one, axes = np.empty((4, 3)), np.empty((7, 3))
    for b in range(q.shape[0]):
        chain(q[b], one, axes)
        points[b] = one


def arm_points(q: ArrayLike) -> NDArray[np.float64]:
    """Shoulder, elbow, wrist and universal joint for joint positions (B, 7), shape (B, 4, 3) [m].

    Raises:
        InvalidInputError: q has another shape.
    """
    rows = np.ascontiguousarray(q, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != 7:
        raise InvalidInputError(f"q must have shape (B, 7), got {rows.shape}")
    points = np.empty((len(rows), 4, 3))
    _rows(rows, points)
    return points
