"""What planners in the plane need from a robot: plane coordinates of its tools to joints and back.

There are a rod (x, y), :class:`vpsto_ros.robot.inverse_kinematics.TableMap`; a hand (x, y, yaw),
:class:`vpsto_ros.robot.hand_plane.HandPlane`; and two balls (x_left, y_left, x_right, y_right),
:class:`vpsto_ros.robot.bimanual_plane.BimanualPlane`.
"""

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.kinematics import Robot

Motion = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


class ToolPlane(Protocol):
    """Plane coordinates of one or more upright tools at a fixed height, and the joints behind them.

    Attributes:
        robot: the arm or arms.
        dof: number m of plane coordinates.
        height: height of the tools' tips above the table [m].
        radius_range: distances of each flange from its base axis within the joint limits [m].
    """

    robot: Robot
    dof: int
    height: float
    radius_range: tuple[float, float]

    def joints(self, points: ArrayLike) -> NDArray[np.float64]:
        """Joint positions (K, n) [rad] for plane points (K, m); InfeasibleError out of reach."""

    def joint_motion(self, points: ArrayLike, velocities: ArrayLike, accelerations: ArrayLike) -> Motion:
        """Joint positions, velocities, accelerations, each (K, n), of a motion given as three (K, m)."""

    def tool(self, q: ArrayLike) -> NDArray[np.float64]:
        """Plane points (..., m) of joint positions (..., n) [rad], upright or not."""

    def tool_velocity(self, q: ArrayLike, qd: ArrayLike) -> NDArray[np.float64]:
        """Plane velocities (..., m) for joint positions and velocities (..., n)."""

    def contains(self, points: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether plane points (..., m) are within joint limits and in reach, margin [m] from its ends."""

    def tips(self, q: ArrayLike) -> NDArray[np.float64]:
        """Positions (..., tools, 3) [m] of the tips for joint positions (..., n) [rad]."""

    def tip_velocities(self, q: ArrayLike, qd: ArrayLike) -> NDArray[np.float64]:
        """Velocities (..., tools, 3) [m/s] of the tips for joint positions and velocities (..., n)."""

    def tool_heights(self, q: ArrayLike) -> NDArray[np.float64]:
        """Heights (..., tools) [m] of the tips above the table for joint positions (..., n) [rad]."""


def check_geometry(plane: str, reached: ArrayLike, expected: ArrayLike) -> None:
    """Raise InvalidInputError unless a robot's tools are where a plane's closed form puts them."""
    if np.abs(np.subtract(reached, expected)).max() > 1e-9:
        raise InvalidInputError(f"{plane} knows the FR3 with its own tool only; this robot differs")


def plane_rows(values: ArrayLike, columns: int, name: str) -> NDArray[np.float64]:
    """Contiguous rows (K, columns).

    Raises:
        InvalidInputError: values has another shape.
    """
    rows = np.ascontiguousarray(values, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != columns:
        raise InvalidInputError(f"{name} must have shape (K, {columns}), got {rows.shape}")
    return rows


def motion_rows(points: ArrayLike, velocities: ArrayLike, accelerations: ArrayLike, columns: int) -> Motion:
    """Contiguous rows (K, columns) of all three.

    Raises:
        InvalidInputError: a wrong shape, or shapes that differ.
    """
    rows = (
        plane_rows(points, columns, "points"),
        plane_rows(velocities, columns, "velocities"),
        plane_rows(accelerations, columns, "accelerations"),
    )
    if not rows[0].shape == rows[1].shape == rows[2].shape:
        raise InvalidInputError("points, velocities and accelerations must have equal shapes")
    return rows
