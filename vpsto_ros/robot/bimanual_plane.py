"""Two balls on two arms in the plane above the table."""

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.kinematics import TIP_NAMES, Robot
from vpsto_ros.robot.tip_kinematics import (
    BALL_BASES,
    BALL_DROP,
    BALL_TIPS,
    BASE_SIDE,
    CRANK,
    bimanual_tips,
    tip_motion,
)
from vpsto_ros.robot.tool_plane import Motion, check_geometry, motion_rows, plane_rows
from vpsto_ros.robot.upright_arm import UprightArm

# What keeps the arms apart, found by scanning the model; see BimanualPlane.arms_apart.
LEAST_DISTANCE = 0.065  # between the centres of the balls [m]
CROSSED_OFFSET = 0.05  # along x, where the left ball is to the right (-y) of the right one [m]
LARGEST_CROSSING = 0.12  # how far the left ball may be to the right of the right one [m]

WORKSPACE = ((0.31, 0.70), (-0.31, 0.31))
"""Ranges of x and y [m] in which each ball can be wherever the other one is, at the usual height."""


class BimanualPlane:
    """The plane of two balls on two arms: (x_left, y_left, x_right, y_right), see :class:`ToolPlane`.

    Reach says nothing about the arms' keeping clear of each other: that is :meth:`arms_apart`.

    Attributes:
        robot: both arms; joints of the left one come first.
        dof: number of plane coordinates.
        height: height of the balls' centres above the table [m].
        radius_range: distances of each flange from its base axis within the joint limits [m].
    """

    dof = 4
    # From a ball to the flange of its arm, in the frame of that arm's base.
    _shift = np.array([(0.0, CRANK - BASE_SIDE), (0.0, BASE_SIDE - CRANK)])

    def __init__(self, robot: Robot, height: float = 0.035, *, margin: float = 0.02):
        """Fix the plane.

        Args:
            robot: the two arms, such as :func:`vpsto_ros.robot.kinematics.fr3_bimanual`.
            height: height of the balls' centres above the table [m].
            margin: distance kept from the joint position limits [rad].

        Raises:
            InvalidInputError: the arms have another geometry, or cannot hold the tools at this height.
        """
        self.robot, self.height = robot, float(height)
        lower, upper = robot.position_range
        if len(lower) != 14:
            raise InvalidInputError(f"BimanualPlane needs two arms with 14 joints, got {len(lower)}")
        self._arms = [
            UprightArm(
                lower[part], upper[part], self.height, BALL_DROP, margin=margin, name=f"the {side} tool"
            )
            for side, part in (("left", slice(0, 7)), ("right", slice(7, 14)))
        ]
        self.radius_range = self._arms[0].radius_range
        # The crank keeps its direction, so that joint 7 turns as far as joint 1.
        self._bounds = np.array([[*arm.radius_range, *arm.shared_range([0, 6])] for arm in self._arms])
        probe = np.array([0.5, 0.1, 0.52, -0.12])
        q = self.joints(probe[None])[0]
        reached = np.concatenate([robot.forward(q, tip)[0] for tip in TIP_NAMES])
        check_geometry("BimanualPlane", reached, [*probe[:2], self.height, *probe[2:], self.height])

    def joints(self, points: ArrayLike) -> NDArray[np.float64]:
        """Joint positions (K, 14) [rad] that put the balls at (x_l, y_l, x_r, y_r), shape (K, 4) [m].

        Raises:
            InvalidInputError: points has another shape.
            InfeasibleError: a ball is out of reach; joint limits are checked by :meth:`contains`, not here.
        """
        points = plane_rows(points, 4, "points")
        return self._motion(points, points, points, 1)[0]

    def joint_motion(self, points: ArrayLike, velocities: ArrayLike, accelerations: ArrayLike) -> Motion:
        """Joint positions, velocities and accelerations, each (K, 14), of a motion in the plane.

        Args:
            points: (x_l, y_l, x_r, y_r) [m], shape (K, 4).
            velocities: their rates [m/s], shape (K, 4).
            accelerations: the rates of these [m/s²], shape (K, 4).

        Raises:
            InvalidInputError: a wrong shape.
            InfeasibleError: a ball is out of reach.
        """
        return self._motion(*motion_rows(points, velocities, accelerations, 4), 3)

    def _motion(self, points, velocities, accelerations, orders) -> Motion:
        parts = []
        for k, arm in enumerate(self._arms):
            flange = points[:, 2 * k : 2 * k + 2] + self._shift[k]
            rates = [np.ascontiguousarray(v[:, 2 * k : 2 * k + 2]) for v in (velocities, accelerations)]
            motion = arm.motion(flange, *rates, orders=orders)
            for joints in motion:
                joints[:, 6] = joints[:, 0]  # the crank keeps its direction
            parts.append(motion)
        q, qd, qdd = (np.concatenate(pair, axis=1) for pair in zip(*parts, strict=True))
        return q, qd, qdd

    def contains(self, points: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether both balls, (..., 4), are within joint limits and in reach, margin [m] from its ends."""
        points = np.asarray(points, dtype=float)
        inside = np.empty(points.shape[:-1], dtype=bool)
        rows = np.ascontiguousarray(points).reshape(-1, 4)
        _within_reach(rows, self._shift, self._bounds, margin, inside.reshape(-1))
        return inside[()]

    def arms_apart(self, points: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether no part of one arm is within 5 mm of the other, for (x_l, y_l, x_r, y_r), shape (..., 4).

        A sufficient rule about the balls alone, for :data:`WORKSPACE`: they are not too close; where the left
        one is to the right of the right one, the cranks need room to pass each other along x; and beyond a
        certain crossing the wrists would meet.

        Args:
            points: plane points [m].
            margin: by how much to keep inside the rule [m].
        """
        points = np.asarray(points, dtype=float)
        ahead, aside = points[..., 0] - points[..., 2], points[..., 1] - points[..., 3]
        distant = np.hypot(ahead, aside) >= LEAST_DISTANCE + margin
        passing = (aside >= 0.0) | (np.abs(ahead) >= CROSSED_OFFSET + margin)
        return distant & passing & (aside >= margin - LARGEST_CROSSING)

    def tool(self, q: ArrayLike) -> NDArray[np.float64]:
        """(x_l, y_l, x_r, y_r) [m] of the balls, shape (..., 4), for joint positions (..., 14) [rad]."""
        return self.tips(q)[..., :2].reshape(*np.shape(q)[:-1], 4)

    def tool_velocity(self, q: ArrayLike, qd: ArrayLike) -> NDArray[np.float64]:
        """Rates (..., 4) [m/s] of the balls for joint positions and velocities (..., 14)."""
        return self.tip_velocities(q, qd)[..., :2].reshape(*np.shape(q)[:-1], 4)

    def tips(self, q: ArrayLike) -> NDArray[np.float64]:
        """Centres (..., 2, 3) [m] of the balls for joint positions (..., 14) [rad]."""
        return bimanual_tips(q)

    def tip_velocities(self, q: ArrayLike, qd: ArrayLike) -> NDArray[np.float64]:
        """Velocities (..., 2, 3) [m/s] of the balls for joint positions and velocities (..., 14)."""
        return tip_motion(BALL_BASES, BALL_TIPS, q, qd)[1]

    def tool_heights(self, q: ArrayLike) -> NDArray[np.float64]:
        """Heights (..., 2) [m] of the balls' centres above the table for joint positions (..., 14) [rad]."""
        return self.tips(q)[..., 2]


@njit(cache=True, nogil=True)
def _within_reach(points, shift, bounds, margin, inside):
    """Whether both balls are within reach and joint limits.

    Args:
        points: (x_l, y_l, x_r, y_r), shape (K, 4) [m].
        shift: from a ball to the flange of its arm, in the frame of that arm's base, shape (2, 2) [m].
        bounds: least and greatest radius and direction of each flange, shape (2, 4) [m, m, rad, rad].
        margin: kept from the ends of the radii [m].
        inside: output, shape (K,).
    """
    for i in range(points.shape[0]):
        good = True
        for k in range(2):
            x, y = points[i, 2 * k] + shift[k, 0], points[i, 2 * k + 1] + shift[k, 1]
            square = x * x + y * y
            near, far = bounds[k, 0] + margin, bounds[k, 1] - margin
            good = good and near * near <= square and square <= far * far
            # No angle is needed in front of the base where all of the front is allowed.
            front = x > 0.0 and bounds[k, 2] <= -0.5 * math.pi and bounds[k, 3] >= 0.5 * math.pi
            if good and not front:
                pan = math.atan2(y, x)
                good = bounds[k, 2] <= pan and pan <= bounds[k, 3]
        inside[i] = good
