"""Compiled closed form of the arm in the vertical plane through the base axis, elbow up, tool upright."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

import vpsto_ros.robot.kinematics as fr3

# Link lengths of the planar arm: shoulder to elbow joint, elbow joint to wrist; the elbow is offset from
# both link axes.
UPPER_ARM = float(np.hypot(fr3.UPPER_ARM, fr3.ELBOW_OFFSET))
FOREARM = float(np.hypot(fr3.FOREARM, fr3.ELBOW_OFFSET))
_UPPER_TILT = float(np.arctan2(fr3.ELBOW_OFFSET, fr3.UPPER_ARM))
_FORE_TILT = float(np.arctan2(fr3.ELBOW_OFFSET, fr3.FOREARM))
STRAIGHT_ELBOW = -(_UPPER_TILT + _FORE_TILT)  # joint 4 where the planar arm is straight and singular [rad]


class RadialArm(NamedTuple):
    """Joints 2, 4 and 6 as functions of the tip's radius: values and derivatives, each of shape (K, 3)."""

    angle: NDArray[np.float64]
    first: NDArray[np.float64]
    second: NDArray[np.float64]


@njit(cache=True, nogil=True)
def _radial_arm(radius, wrist_height, out):
    """Fill out (3 orders, 3 joints) for one radius; returns False out of reach.

    Two-link arm with the tilts t1, t2 of the links against the vertical:
    rho = A sin t1 + B sin t2, h = A cos t1 + B cos t2.
    """
    A, B = UPPER_ARM, FOREARM
    rho = radius - fr3.WRIST_OFFSET
    cos_bend = (rho * rho + wrist_height * wrist_height - A * A - B * B) / (2.0 * A * B)
    if not -1.0 < cos_bend < 1.0:
        return False
    bend = np.arccos(cos_bend)
    sin_bend = np.sin(bend)
    t1 = np.arctan2(rho, wrist_height) - np.arctan2(B * sin_bend, A + B * cos_bend)
    t2 = t1 + bend
    s1, c1, s2, c2 = np.sin(t1), np.cos(t1), np.sin(t2), np.cos(t2)
    # First derivatives solve the two constraints differentiated by the radius; the second ones
    # differentiate those again.
    d1 = s2 / (A * sin_bend)
    d2 = -s1 / (B * sin_bend)
    shrink = cos_bend * (d2 - d1) / sin_bend
    dd1 = c2 * d2 / (A * sin_bend) - d1 * shrink
    dd2 = -c1 * d1 / (B * sin_bend) - d2 * shrink
    out[0, 0], out[1, 0], out[2, 0] = t1 - _UPPER_TILT, d1, dd1
    out[0, 1], out[1, 1], out[2, 1] = -(bend + _UPPER_TILT + _FORE_TILT), d1 - d2, dd1 - dd2
    out[0, 2], out[1, 2], out[2, 2] = t2 + _FORE_TILT, d2, dd2
    return True


@njit(cache=True, nogil=True)
def radial_arms(radii, wrist_height):
    """Orders 0-2 of joints 2, 4, 6, shape (K, 3, 3), and the index of the first radius out of reach or -1."""
    out = np.empty((radii.shape[0], 3, 3))
    for k in range(radii.shape[0]):
        if not _radial_arm(radii[k], wrist_height, out[k]):
            return out, k
    return out, -1


@njit(cache=True, nogil=True)
def plane_to_joints(points, velocities, accelerations, wrist_height, q7, orders):
    """Joint positions, velocities and accelerations of a motion in the plane; orders of them are filled.

    Returns the arrays and the index of the first point out of reach (-1: none).
    """
    count = points.shape[0]
    q, qd, qdd = np.zeros((count, 7)), np.zeros((count, 7)), np.zeros((count, 7))
    arm = np.empty((3, 3))
    for k in range(count):
        x, y = points[k, 0], points[k, 1]
        r = np.sqrt(x * x + y * y)
        if not _radial_arm(r, wrist_height, arm):
            return q, qd, qdd, k
        q[k, 0], q[k, 6] = np.arctan2(y, x), q7
        q[k, 1], q[k, 3], q[k, 5] = arm[0, 0], arm[0, 1], arm[0, 2]
        if orders < 2:
            continue
        vr = (x * velocities[k, 0] + y * velocities[k, 1]) / r
        w = (x * velocities[k, 1] - y * velocities[k, 0]) / (r * r)
        qd[k, 0] = w
        for j in range(3):
            qd[k, 2 * j + 1] = arm[1, j] * vr
        if orders < 3:
            continue
        ar = (x * accelerations[k, 0] + y * accelerations[k, 1]) / r + r * w * w
        at = (x * accelerations[k, 1] - y * accelerations[k, 0]) / r
        qdd[k, 0] = (at - 2.0 * vr * w) / r
        for j in range(3):
            qdd[k, 2 * j + 1] = arm[1, j] * ar + arm[2, j] * vr * vr
    return q, qd, qdd, -1
