"""The air-hockey table and the frames of its world.

Everything here is in the robot's base frame (x forward, z up; metres), as everywhere else in this package,
unless a name says table: the table frame has its origin at the centre of the playing surface and parallel
axes, with x towards the far goal.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

TABLE_ORIGIN = (1.51, 0.0, 0.1)
"""The table's centre, on the playing surface, in the base frame [m]."""
HALF_LENGTH = 0.974  # inner faces of the end rims, table frame [m]
HALF_WIDTH = 0.519  # inner faces of the side rims
GOAL_HALF_WIDTH = 0.125
POST_RADIUS = 0.005  # of the rounded corners of the goal's posts

PUCK_RADIUS = 0.03165
PUCK_HEIGHT = 0.02
PUCK_MASS = 0.01  # [kg]
PUCK_INERTIA = 5e-6  # about the vertical [kg m²]

MALLET_RADIUS = 0.04815
MALLET_HALF_HEIGHT = 0.03
MALLET_OFFSET = 0.0505  # from the universal joint down to the mallet's centre
MALLET_MASS = 0.283  # [kg]
MALLET_COM_OFFSET = 0.0683  # from the universal joint down to the mallet's centre of mass
MALLET_INERTIA = 0.005  # about its centre of mass, any axis [kg m²]; the hinges' gains damp it critically
UNIVERSAL_JOINT_HEIGHT = 0.1645  # of the universal joint during play, base frame [m]

_ORIGIN = np.array(TABLE_ORIGIN)


def to_table(points: ArrayLike) -> NDArray[np.float64]:
    """Points (..., 2) or (..., 3) [m] of the base frame in the table frame."""
    points = np.asarray(points, dtype=float)
    return points - _ORIGIN[: points.shape[-1]]


def to_base(points: ArrayLike) -> NDArray[np.float64]:
    """Points (..., 2) or (..., 3) [m] of the table frame in the base frame."""
    points = np.asarray(points, dtype=float)
    return points + _ORIGIN[: points.shape[-1]]


def goal_at(point: ArrayLike) -> str | None:
    """Which goal a point (2,) [m] of the base frame is in: "far", "near" (the robot's own) or None."""
    x, y = to_table(point)
    if abs(x) <= HALF_LENGTH or abs(y) >= GOAL_HALF_WIDTH:
        return None
    return "far" if x > 0.0 else "near"


def on_table(point: ArrayLike, margin: float = 0.0) -> bool:
    """Whether a point (2,) [m] of the base frame is inside the rims, at least a margin [m] away from them."""
    x, y = to_table(point)
    return bool(abs(x) <= HALF_LENGTH - margin and abs(y) <= HALF_WIDTH - margin)
