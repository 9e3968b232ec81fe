"""Compiled forward kinematics of tools that are not on the axis of joint 7: two balls on cranks, a hand.

Planners ask for thousands of postures at a time, and then sines and cosines are what costs: they are taken
for all joints at once by a kernel without branches, which the compiler turns into vector instructions.
"""

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.kinematics import FLANGE_OFFSET, dh_table

BASE_SIDE = 0.22  # the bases of the two arms are at y = +- this [m]
BALL_RADIUS = 0.03
BALL_DROP = 0.2  # from the flange down to the centre of the ball [m]
CRANK = 0.15  # from the flange aside to the centre of the ball, towards the other arm [m]
HAND_DROP = 0.15  # from the flange down to the centre of the hand [m]
HAND_HALF_SIZE = (0.1, 0.03)  # of the hand, seen from above, along x and y of the tool [m]

BALL_BASES = np.array([(0.0, BASE_SIDE, 0.0), (0.0, -BASE_SIDE, 0.0)])
# In the frame of link 7, whose y axis points to -y of the base when joint 7 equals joint 1.
BALL_TIPS = np.array([(0.0, CRANK, FLANGE_OFFSET + BALL_DROP), (0.0, -CRANK, FLANGE_OFFSET + BALL_DROP)])

_DH = dh_table()

# pi/2 in three parts that add up to 118 bits (fdlibm): subtracting multiples of them from an angle is exact
# enough for all angles that a joint can take.
_HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)


@njit(cache=True, nogil=True, error_model="numpy")
def sines_and_cosines(angle, sine, cosine):
    """Fill sine and cosine, each (N,), of angles (N,) [rad] up to some thousands, to 4e-16."""
    for i in range(angle.shape[0]):
        turns = np.rint(angle[i] * (2.0 / np.pi))
        r = ((angle[i] - turns * _HALF_PI[0]) - turns * _HALF_PI[1]) - turns * _HALF_PI[2]
        z = r * r
        # The polynomials of fdlibm on [-pi/4, pi/4].
        s = -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10
        s = -1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 + z * s)
        s = r + r * z * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * s))
        c = 2.08757232129817482790e-09 - z * 1.13596475577881948265e-11
        c = 2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + z * c)
        c = 4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * c)
        c = 1.0 - 0.5 * z + z * z * c
        # Which quarter turn: an odd one swaps the two, and signs follow; written as arithmetic, not branches.
        quarter = turns - 4.0 * np.floor(0.25 * turns)
        half = np.floor(0.5 * quarter)
        odd = quarter - 2.0 * half
        sine[i] = (1.0 - 2.0 * half) * (s + odd * (c - s))
        cosine[i] = (1.0 - 2.0 * abs(odd - half)) * (c + odd * (s - c))


@njit(cache=True, nogil=True)
def tips_motion(dh, bases, tips, q, qd, position, velocity):
    """Positions and, if the array is not empty, velocities of the tips of A arms, shapes (B, A, 3).

    Each tip is handed from frame to frame, from link 7 down to the base, without rotation matrices.

    Args:
        dh: modified DH table of each arm, shape (7, 4).
        bases: positions of the bases, axes as those of the world, shape (A, 3) [m].
        tips: in the frames of the last links, shape (A, 3) [m].
        q: joint positions, arm after arm, contiguous, shape (B, 7 A) [rad].
        qd: joint velocities, shape (B, 7 A); not read without velocity.
        position: filled.
        velocity: filled unless empty.
    """
    sine, cosine = np.empty(q.shape), np.empty(q.shape)
    sines_and_cosines(q.reshape(q.size), sine.reshape(q.size), cosine.reshape(q.size))
    moving = velocity.shape[0] > 0
    for b in range(q.shape[0]):
        for arm in range(bases.shape[0]):
            x, y, z = tips[arm, 0], tips[arm, 1], tips[arm, 2]
            u, v, w = 0.0, 0.0, 0.0
            for i in range(6, -1, -1):
                j = 7 * arm + i
                c, s = cosine[b, j], sine[b, j]
                x, y = c * x - s * y, s * x + c * y
                ca, sa = dh[i, 2], dh[i, 3]
                if moving:
                    u, v = c * u - s * v - qd[b, j] * y, s * u + c * v + qd[b, j] * x
                    v, w = ca * v - sa * w, sa * v + ca * w
                x, z = x + dh[i, 0], z + dh[i, 1]
                y, z = ca * y - sa * z, sa * y + ca * z
            position[b, arm, 0], position[b, arm, 1] = x + bases[arm, 0], y + bases[arm, 1]
            position[b, arm, 2] = z + bases[arm, 2]
            if moving:
                velocity[b, arm, 0], velocity[b, arm, 1], velocity[b, arm, 2] = u, v, w


def tip_positions(bases: NDArray, tips: NDArray, q: ArrayLike) -> NDArray[np.float64]:
    """Positions (..., A, 3) [m] of the tips of A arms for joint positions (..., 7 A) [rad].

    Args:
        bases: positions of the bases [m], shape (A, 3).
        tips: in the frames of the last links [m], shape (A, 3).
        q: joint positions, arm after arm.

    Raises:
        InvalidInputError: q has another number of columns.
    """
    rows = _joint_rows(q, 7 * len(bases), "q")
    position = np.empty((len(rows), len(bases), 3))
    tips_motion(_DH, bases, tips, rows, rows, position, np.empty((0, len(bases), 3)))
    return position.reshape(*np.shape(q)[:-1], len(bases), 3)


def tip_motion(
    bases: NDArray, tips: NDArray, q: ArrayLike, qd: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions [m] and velocities [m/s] of the tips, each (..., A, 3); see :func:`tip_positions`.

    Raises:
        InvalidInputError: q or qd has another number of columns, or their shapes differ.
    """
    rows, rates = _joint_rows(q, 7 * len(bases), "q"), _joint_rows(qd, 7 * len(bases), "qd")
    if np.shape(q) != np.shape(qd):
        raise InvalidInputError(f"q and qd must have equal shapes, got {np.shape(q)} and {np.shape(qd)}")
    position = np.empty((len(rows), len(bases), 3))
    velocity = np.empty_like(position)
    tips_motion(_DH, bases, tips, rows, rates, position, velocity)
    shape = (*np.shape(q)[:-1], len(bases), 3)
    return position.reshape(shape), velocity.reshape(shape)


def bimanual_tips(q: ArrayLike) -> NDArray[np.float64]:
    """Centres (..., 2, 3) [m] of the left and the right ball for joint positions (..., 14) [rad].

    Raises:
        InvalidInputError: q has not 14 columns.
    """
    return tip_positions(BALL_BASES, BALL_TIPS, q)


def _joint_rows(values: ArrayLike, columns: int, name: str) -> NDArray[np.float64]:
    rows = np.ascontiguousarray(values, dtype=float)
    if rows.ndim < 1 or rows.shape[-1] != columns:
        raise InvalidInputError(f"{name} must have shape (..., {columns}), got {rows.shape}")
    return rows.reshape(-1, columns)
