"""Inverse kinematics: the tool plane in closed form, and damped least squares for any pose of the tip.

On the table the rod stands upright with its tip at a fixed height and the elbow stays in the vertical plane
through the base axis (q3 = q5 = 0). What is left is a planar arm with two links: joint positions are then
exact, smooth functions of the tip's position (x, y), and so are their derivatives. Planners can search in
the plane and hand out joint trajectories.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InfeasibleError, InvalidInputError
from vpsto_ros.robot.kinematics import TOOL_LENGTH, Robot, forward_kinematics_batch, tip_velocity_batch
from vpsto_ros.robot.radial_arm import RadialArm
from vpsto_ros.robot.upright_arm import UprightArm


class TableMap:
    """The plane of the rod above the table, a :class:`vpsto_ros.robot.tool_plane.ToolPlane` for (x, y).

    Attributes:
        robot: the arm.
        dof: number of plane coordinates.
        height: height of the tip above the table [m].
        radius_range: (r_min, r_max) [m], distances of the tip from the base axis for which the joint
            position limits hold and the elbow stays clear of the singular, straight arm.
    """

    dof = 2

    def __init__(
        self, robot: Robot, height: float = 0.02, *, tool_yaw: float = np.pi / 4, margin: float = 0.02
    ):
        """Fix the plane.

        Args:
            robot: the arm; its position, velocity and acceleration limits are used. It must have the FR3's
                geometry.
            height: height of the tip above the table [m].
            tool_yaw: constant position of joint 7 [rad]; the rod is round, so that any value does.
            margin: distance kept from the joint position limits [rad].

        Raises:
            InvalidInputError: the arm has another geometry, or no radius is within its limits at this height.
        """
        self.height = float(height)
        self.robot = robot
        self._tool_yaw = float(tool_yaw)
        lower, upper = robot.position_range
        self._arm = UprightArm(lower, upper, self.height, TOOL_LENGTH, margin=margin)
        if not lower[6] <= self._tool_yaw <= upper[6]:
            raise InvalidInputError(f"tool_yaw = {tool_yaw} rad is beyond the limits of joint 7")
        self.radius_range = self._arm.radius_range
        probe = np.array([0.5 * sum(self.radius_range), 0.0])
        if np.abs(robot.forward(self.joints(probe[None])[0])[0] - [*probe, self.height]).max() > 1e-9:
            raise InvalidInputError(
                "TableMap knows the geometry of the FR3 with the pushing rod only; this robot differs"
            )

    def radial(self, radii: ArrayLike) -> RadialArm:
        """Joints 2, 4 and 6 [rad] and their derivatives by the radius [rad/m, rad/m²] for radii (K,) [m].

        Raises:
            InfeasibleError: a radius is out of reach.
        """
        return self._arm.radial(radii)

    def contains(self, points: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether plane points (..., 2) [m] lie in radius_range, at least margin [m] from its ends."""
        return self._arm.reaches(points, margin)

    def joints(self, points: ArrayLike) -> NDArray[np.float64]:
        """Joint positions (K, 7) [rad] that put the tip at plane points (K, 2) [m].

        Raises:
            InvalidInputError: points has another shape.
            InfeasibleError: a point is out of reach; joint limits are checked by :meth:`contains`, not here.
        """
        points = _rows(points, "points")
        return self._motion(points, points, points, 1)[0]

    def joint_motion(
        self, points: ArrayLike, velocities: ArrayLike, accelerations: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Joint positions, velocities and accelerations, each (K, 7), of a motion in the plane.

        Args:
            points: tip positions [m], shape (K, 2).
            velocities: tip velocities [m/s], shape (K, 2).
            accelerations: tip accelerations [m/s²], shape (K, 2).

        Raises:
            InvalidInputError: a wrong shape.
            InfeasibleError: a point is out of reach.
        """
        rows = _rows(points, "points"), _rows(velocities, "velocities"), _rows(accelerations, "accelerations")
        return self._motion(*rows, 3)

    def joint_velocity(self, point: ArrayLike, velocity: ArrayLike) -> NDArray[np.float64]:
        """Joint velocities (7,) or (K, 7) [rad/s] of a tip at point (2,) or (K, 2) [m] with a velocity."""
        single = np.ndim(point) == 1
        rows, rates = _rows(np.atleast_2d(point), "point"), _rows(np.atleast_2d(velocity), "velocity")
        qd = self._motion(rows, rates, rates, 2)[1]
        return qd[0] if single else qd

    def jacobian(self, points: ArrayLike) -> NDArray[np.float64]:
        """Derivatives (K, 7, 2) [rad/m] of :meth:`joints` by the plane points (K, 2) [m]."""
        points = _rows(points, "points")
        columns = [self._motion(points, np.tile(axis, (len(points), 1)), points, 2)[1] for axis in np.eye(2)]
        return np.stack(columns, axis=-1)

    def tool(self, q: ArrayLike) -> NDArray[np.float64]:
        """Plane points (..., 2) [m] of the tip for joint positions (..., 7) [rad], upright or not."""
        return self.tips(q)[..., 0, :2]

    def tool_velocity(self, q: ArrayLike, qd: ArrayLike) -> NDArray[np.float64]:
        """Velocities (..., 2) [m/s] of the tip in the plane for joint positions and velocities (..., 7)."""
        return self.tip_velocities(q, qd)[..., 0, :2]

    def tips(self, q: ArrayLike) -> NDArray[np.float64]:
        """Positions (..., 1, 3) [m] of the tip in the base frame for joint positions (..., 7) [rad]."""
        q = np.asarray(q, dtype=float)
        return forward_kinematics_batch(q.reshape(-1, 7)).reshape(*q.shape[:-1], 1, 3)

    def tip_velocities(self, q: ArrayLike, qd: ArrayLike) -> NDArray[np.float64]:
        """Velocities (..., 1, 3) [m/s] of the tip for joint positions and velocities (..., 7)."""
        q, qd = np.asarray(q, dtype=float), np.asarray(qd, dtype=float)
        velocity = tip_velocity_batch(q.reshape(-1, 7), qd.reshape(-1, 7))
        return velocity.reshape(*q.shape[:-1], 1, 3)

    def tool_heights(self, q: ArrayLike) -> NDArray[np.float64]:
        """Heights (..., 1) [m] of the tip above the table for joint positions (..., 7) [rad]."""
        return self.tips(q)[..., 2]

    def _motion(self, points, velocities, accelerations, orders):
        if not points.shape == velocities.shape == accelerations.shape:
            raise InvalidInputError("points, velocities and accelerations must have equal shapes")
        return self._arm.motion(points, velocities, accelerations, orders=orders, tool_yaw=self._tool_yaw)


def _rows(values: ArrayLike, name: str) -> NDArray[np.float64]:
    rows = np.ascontiguousarray(values, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != 2:
        raise InvalidInputError(f"{name} must have shape (K, 2), got {rows.shape}")
    return rows


def solve(
    robot: Robot,
    position: ArrayLike,
    rotation: ArrayLike | None,
    q_seed: ArrayLike,
    *,
    tolerance: float = 1e-8,
    iterations: int = 200,
) -> NDArray[np.float64]:
    """Joint positions for a pose of the tip by damped least squares, within the joint position limits.

    The damping falls with the error and rises when a step did not help, so that steps are short near
    singular postures and Newton's elsewhere. Every iterate is clipped to the limits. It is a local method:
    other seeds may succeed where one fails.

    Args:
        robot: the arm.
        position: tip position [m], shape (3,).
        rotation: rotation matrix of the tip, shape (3, 3), or None to leave the orientation free.
        q_seed: where to start [rad], shape (n,).
        tolerance: largest accepted error [m, rad].
        iterations: steps to try at most.

    Raises:
        InvalidInputError: a wrong shape.
        InfeasibleError: no posture was found.
    """
    position, q = np.asarray(position, dtype=float), np.array(q_seed, dtype=float)
    if position.shape != (3,) or q.shape != (robot.dof,):
        raise InvalidInputError(
            f"need position (3,) and q_seed ({robot.dof},), got {position.shape} and {q.shape}"
        )
    if rotation is not None and np.shape(rotation) != (3, 3):
        raise InvalidInputError(f"rotation must have shape (3, 3), got {np.shape(rotation)}")
    lower, upper = robot.position_range
    q = np.clip(q, lower, upper)
    error, boost = _pose_error(robot, q, position, rotation), 1.0
    for _ in range(iterations):
        if np.abs(error).max() < tolerance:
            return q
        jacobian = robot.jacobian(q)[: len(error)]
        damping = boost * 1e-3 * min(1.0, float(error @ error)) + 1e-12
        step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping * np.eye(len(error)), error)
        trial = np.clip(q + step * min(1.0, 0.5 / np.abs(step).max()), lower, upper)
        trial_error = _pose_error(robot, trial, position, rotation)
        if trial_error @ trial_error < error @ error:
            q, error, boost = trial, trial_error, max(0.1 * boost, 1e-3)
        else:
            boost *= 10.0
    where = np.array2string(position, precision=3)
    raise InfeasibleError(
        f"no posture within the joint limits reaches the tip pose at {where} m: an error of "
        f"{np.abs(error).max():.2g} is left; try another seed"
    )


def _pose_error(
    robot: Robot, q: NDArray, position: NDArray, rotation: ArrayLike | None
) -> NDArray[np.float64]:
    """Position error and, if an orientation is given, the rotation vector that remains; axes of the base."""
    reached, frame = robot.forward(q)
    if rotation is None:
        return position - reached
    return np.concatenate([position - reached, _rotation_vector(np.asarray(rotation, dtype=float) @ frame.T)])


def _rotation_vector(matrix: NDArray) -> NDArray[np.float64]:
    import pinocchio

    return pinocchio.log3(matrix)
