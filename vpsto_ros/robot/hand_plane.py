"""A hand with a yaw in the plane above the table."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.robot.kinematics import FLANGE_OFFSET, Robot
from vpsto_ros.robot.tip_kinematics import HAND_DROP, tip_motion, tip_positions
from vpsto_ros.robot.tool_plane import Motion, check_geometry, motion_rows, plane_rows
from vpsto_ros.robot.upright_arm import UprightArm


class HandPlane:
    """The plane of a block-shaped hand: (x, y, yaw) of its centre, see :class:`ToolPlane`.

    At yaw 0 the long side lies along x. The yaw is not wrapped: it ranges from joint 1 less 3 rad to joint 1
    plus 3 rad, within which the hand turns without a jump.

    Attributes:
        robot: the arm.
        dof: number of plane coordinates.
        height: height of the hand's centre above the table [m].
        radius_range: distances of the centre from the base axis within the joint limits [m].
    """

    dof = 3
    _base = np.zeros((1, 3))
    _centre = np.array([(0.0, 0.0, FLANGE_OFFSET + HAND_DROP)])
    _ahead = np.array([(0.1, 0.0, FLANGE_OFFSET + HAND_DROP)])  # another point on the hand's x axis

    def __init__(self, robot: Robot, height: float = 0.05, *, margin: float = 0.02):
        """Fix the plane.

        Args:
            robot: the arm with the hand, such as :func:`vpsto_ros.robot.kinematics.fr3_hand_pusher`.
            height: height of the hand's centre above the table [m].
            margin: distance kept from the joint position limits [rad].

        Raises:
            InvalidInputError: the arm has another geometry, or cannot hold the hand at this height.
        """
        self.robot, self.height = robot, float(height)
        self._arm = UprightArm(
            *robot.position_range, self.height, HAND_DROP, margin=margin, name="the upright hand"
        )
        self.radius_range = self._arm.radius_range
        probe = np.array([0.5 * sum(self.radius_range), 0.05, 0.3])
        position, frame = robot.forward(self.joints(probe[None])[0])
        heading = np.arctan2(frame[1, 0], frame[0, 0])
        check_geometry("HandPlane", np.append(position, heading), [*probe[:2], self.height, probe[2]])

    def joints(self, points: ArrayLike) -> NDArray[np.float64]:
        """Joint positions (K, 7) [rad] that put the hand at (x, y, yaw), shape (K, 3) [m, rad].

        Raises:
            InvalidInputError: points has another shape.
            InfeasibleError: a point is out of reach; joint limits are checked by :meth:`contains`, not here.
        """
        points = plane_rows(points, 3, "points")
        return self._motion(points, points, points, 1)[0]

    def joint_motion(self, points: ArrayLike, velocities: ArrayLike, accelerations: ArrayLike) -> Motion:
        """Joint positions, velocities and accelerations, each (K, 7), of a motion in the plane.

        Args:
            points: (x, y, yaw) [m, rad], shape (K, 3).
            velocities: their rates, shape (K, 3).
            accelerations: the rates of these, shape (K, 3).

        Raises:
            InvalidInputError: a wrong shape.
            InfeasibleError: a point is out of reach.
        """
        return self._motion(*motion_rows(points, velocities, accelerations, 3), 3)

    def _motion(self, points, velocities, accelerations, orders) -> Motion:
        rows = [np.ascontiguousarray(values[:, :2]) for values in (points, velocities, accelerations)]
        motion = self._arm.motion(*rows, orders=orders)
        for joints, plane in list(zip(motion, (points, velocities, accelerations), strict=True))[:orders]:
            joints[:, 6] = joints[:, 0] - plane[:, 2]  # the flange points down: it turns by q1 - q7
        return motion

    def contains(self, points: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether (x, y, yaw), shape (..., 3), within joint limits and in reach, margin [m] from its ends."""
        points = np.asarray(points, dtype=float)
        pan = np.arctan2(points[..., 1], points[..., 0])
        turns = self._arm.within([0, 6], np.stack([pan, pan - points[..., 2]], axis=-1))
        return self._arm.reaches(points[..., :2], margin) & turns

    def tool(self, q: ArrayLike) -> NDArray[np.float64]:
        """(x, y, yaw) [m, rad] of the hand, shape (..., 3), for joint positions (..., 7) [rad].

        The yaw is the heading of the hand's x axis, on the turn nearest to that of joints 1 and 7.
        """
        q = np.asarray(q, dtype=float)
        centre = self.tips(q)[..., 0, :]
        ahead = tip_positions(self._base, self._ahead, q)[..., 0, :] - centre
        turn = q[..., 0] - q[..., 6]
        off = np.arctan2(ahead[..., 1], ahead[..., 0]) - turn
        yaw = turn + (off + np.pi) % (2.0 * np.pi) - np.pi
        return np.concatenate([centre[..., :2], yaw[..., None]], axis=-1)

    def tool_velocity(self, q: ArrayLike, qd: ArrayLike) -> NDArray[np.float64]:
        """Rates of (x, y, yaw) [m/s, rad/s], shape (..., 3), for joint positions and velocities (..., 7)."""
        centre, velocity = tip_motion(self._base, self._centre, q, qd)
        end, end_velocity = tip_motion(self._base, self._ahead, q, qd)
        ahead, swing = (end - centre)[..., 0, :2], (end_velocity - velocity)[..., 0, :2]
        rate = ahead[..., 0] * swing[..., 1] - ahead[..., 1] * swing[..., 0]
        rate = rate / (ahead**2).sum(axis=-1)
        return np.concatenate([velocity[..., 0, :2], rate[..., None]], axis=-1)

    def tips(self, q: ArrayLike) -> NDArray[np.float64]:
        """Position (..., 1, 3) [m] of the hand's centre for joint positions (..., 7) [rad]."""
        return tip_positions(self._base, self._centre, q)

    def tip_velocities(self, q: ArrayLike, qd: ArrayLike) -> NDArray[np.float64]:
        """Velocity (..., 1, 3) [m/s] of the hand's centre for joint positions and velocities (..., 7)."""
        return tip_motion(self._base, self._centre, q, qd)[1]

    def tool_heights(self, q: ArrayLike) -> NDArray[np.float64]:
        """Height (..., 1) [m] of the hand's centre above the table for joint positions (..., 7) [rad]."""
        return self.tips(q)[..., 2]
