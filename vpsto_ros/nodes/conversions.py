"""Between ROS messages and the library's value types.

Whatever arrives is checked here, once: shapes, finite numbers, frames, quaternions. SI units on both sides.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseArray, PoseStamped, PoseWithCovarianceStamped, Quaternion
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from std_msgs.msg import Header

from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.planning.contact import ContactPlan
from vpsto_ros.planning.goal import PlanarGoal

QUATERNION_TOLERANCE = 1e-2
"""How far the norm of a quaternion may be from 1."""
_NANOSECONDS = 1_000_000_000
# Rows and columns of x, y and yaw in the 6 x 6 covariance of (x, y, z, roll, pitch, yaw).
_PLANAR = np.array([0, 1, 5])


@dataclasses.dataclass(frozen=True)
class TimeBase:
    """Seconds in a double, counted from a whole second so that they stay precise.

    Unix time in a double resolves 0.2 microseconds only, too coarse for joining trajectories to 1e-9 s;
    counted from the start of a node it resolves picoseconds.

    Attributes:
        origin: the whole second that is called 0 [s]; 0 with simulated time.
    """

    origin: int = 0

    def seconds(self, stamp: Time) -> float:
        """A stamp in seconds since the origin [s]."""
        return (stamp.sec - self.origin) + 1e-9 * stamp.nanosec

    def stamp(self, seconds: float) -> Time:
        """The stamp of a time in seconds since the origin, to the nearest nanosecond."""
        total = round(seconds * 1e9) + self.origin * _NANOSECONDS
        return Time(sec=total // _NANOSECONDS, nanosec=total % _NANOSECONDS)


SIMULATED = TimeBase()
"""The time base of simulated time."""


@dataclasses.dataclass(frozen=True)
class PoseReading:
    """A pose, split into its part in the table plane and the rest.

    Attributes:
        pose: (x, y, yaw), shape (3,) [m, m, rad].
        height: z [m].
        tilt: angle between the object's z axis and the vertical [rad].
    """

    pose: NDArray
    height: float
    tilt: float


def planar_pose(pose: NDArray, height: float = 0.0) -> Pose:
    """The message of a planar pose (x, y, yaw), shape (3,)."""
    message = Pose()
    message.position.x, message.position.y, message.position.z = float(pose[0]), float(pose[1]), float(height)
    message.orientation.z, message.orientation.w = float(np.sin(0.5 * pose[2])), float(np.cos(0.5 * pose[2]))
    return message


def read_pose(pose: Pose) -> PoseReading:
    """A pose in the plane, with its height and tilt.

    Raises:
        InvalidInputError: a number is not finite, or the quaternion is zero or far from a unit quaternion.
    """
    position = np.array([pose.position.x, pose.position.y, pose.position.z])
    x, y, z, w = _unit_quaternion(pose.orientation)
    require_finite("position", position)
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    tilt = np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))
    return PoseReading(np.array([position[0], position[1], yaw]), float(position[2]), float(tilt))


def _unit_quaternion(quaternion: Quaternion) -> NDArray:
    values = np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w])
    require_finite("quaternion", values)
    norm = float(np.linalg.norm(values))
    if norm < 1e-6:
        raise InvalidInputError("the quaternion is zero; no rotation is (x, y, z, w) = (0, 0, 0, 1)")
    if abs(norm - 1.0) > QUATERNION_TOLERANCE:
        raise InvalidInputError(f"the quaternion has norm {norm:.4g}; a rotation has norm 1")
    return values / norm


def require_frame(header: Header, frame: str) -> None:
    """Raise InvalidInputError unless a header names the expected frame."""
    if header.frame_id.lstrip("/") != frame:
        raise InvalidInputError(
            f"frame '{header.frame_id}'; expected '{frame}' (transform it before sending)"
        )


def read_goal(message: PoseStamped, frame: str, *, orientation: bool) -> PlanarGoal:
    """A goal pose; its yaw is dropped unless `orientation`.

    Raises:
        InvalidInputError: wrong frame, broken quaternion or non-finite numbers.
    """
    require_frame(message.header, frame)
    pose = read_pose(message.pose).pose
    return PlanarGoal(pose[:2], float(pose[2]) if orientation else None)


def goal_message(goal: PlanarGoal, stamp: Time, frame: str) -> PoseStamped:
    """A goal as a message; without a goal orientation yaw is 0."""
    yaw = 0.0 if goal.yaw is None else goal.yaw
    return PoseStamped(
        header=Header(stamp=stamp, frame_id=frame), pose=planar_pose(np.append(goal.position, yaw))
    )


def observation_message(
    pose: NDArray, covariance: NDArray, stamp: Time, frame: str, height: float = 0.0
) -> PoseWithCovarianceStamped:
    """A measured planar pose (3,) at a height [m] and its covariance (3, 3) over (x, y, yaw)."""
    message = PoseWithCovarianceStamped(header=Header(stamp=stamp, frame_id=frame))
    message.pose.pose = planar_pose(pose, height)
    message.pose.covariance = spread_covariance(covariance)
    return message


def read_observation(message: PoseWithCovarianceStamped, frame: str) -> tuple[PoseReading, NDArray | None]:
    """A measured pose and its covariance (3, 3) over (x, y, yaw), None where the message leaves it at zero.

    Raises:
        InvalidInputError: wrong frame, broken quaternion, non-finite numbers or a covariance that is none.
    """
    require_frame(message.header, frame)
    covariance = read_planar_covariance(message.pose.covariance)
    if not covariance.any():
        return read_pose(message.pose.pose), None
    if not np.allclose(covariance, covariance.T) or np.linalg.eigvalsh(covariance).min() <= 0.0:
        raise InvalidInputError("the covariance of x, y, yaw is not positive definite (all zeros: unknown)")
    return read_pose(message.pose.pose), covariance


# Object states


def state_message(
    state: ObjectState, time_base: TimeBase, frame: str, child_frame: str = "object", *, height: float = 0.0
) -> Odometry:
    """The state of an object as odometry: its pose in the base frame, its twist in its own, as nav_msgs says.

    The pose is at a height [m]. How pose and twist are correlated has no place in the message and is lost.
    """
    message = Odometry(
        header=Header(stamp=time_base.stamp(state.stamp), frame_id=frame), child_frame_id=child_frame
    )
    into = _rotation(-state.pose[2])
    twist = into @ state.twist
    message.pose.pose = planar_pose(state.pose, height)
    message.pose.covariance = spread_covariance(state.covariance[:3, :3])
    message.twist.twist.linear.x, message.twist.twist.linear.y = float(twist[0]), float(twist[1])
    message.twist.twist.angular.z = float(twist[2])
    message.twist.covariance = spread_covariance(into @ state.covariance[3:, 3:] @ into.T)
    return message


def read_state(message: Odometry, time_base: TimeBase, frame: str) -> ObjectState:
    """The state of an object from odometry, its twist turned into the base frame.

    Raises:
        InvalidInputError: wrong frame, broken quaternion or non-finite numbers.
    """
    require_frame(message.header, frame)
    pose = read_pose(message.pose.pose).pose
    velocity = message.twist.twist
    out = _rotation(pose[2])
    twist = np.array([velocity.linear.x, velocity.linear.y, velocity.angular.z])
    require_finite("twist", twist)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = read_planar_covariance(message.pose.covariance)
    covariance[3:, 3:] = out @ read_planar_covariance(message.twist.covariance) @ out.T
    return ObjectState(time_base.seconds(message.header.stamp), pose, out @ twist, covariance)


def belief_message(poses: NDArray, stamp: Time, frame: str) -> PoseArray:
    """Equally likely planar poses (M, 3) of an object."""
    message = PoseArray(header=Header(stamp=stamp, frame_id=frame))
    message.poses = [planar_pose(pose) for pose in poses]
    return message


def read_belief(message: PoseArray, frame: str) -> NDArray:
    """Samples of planar poses, shape (M, 3).

    Raises:
        InvalidInputError: wrong frame, broken quaternion or non-finite numbers.
    """
    require_frame(message.header, frame)
    pairs = [(pose.position, pose.orientation) for pose in message.poses]
    rows = [(p.x, p.y, p.z, q.x, q.y, q.z, q.w) for p, q in pairs]
    x, y, z, i, j, k, w = np.array(rows).reshape(-1, 7).T
    norm = np.sqrt(i * i + j * j + k * k + w * w)
    fine = np.isfinite(x + y + z) & (np.abs(norm - 1.0) <= QUATERNION_TOLERANCE)
    for index in np.flatnonzero(~fine):
        read_pose(message.poses[index])  # says what is wrong
    yaw = np.arctan2(2.0 * (w * k + i * j), w * w + i * i - j * j - k * k)
    return np.stack([x, y, yaw], axis=1)


# Contact plans


def contact_message(plan: ContactPlan, time_base: TimeBase, frame: str, tool_frame: str) -> Odometry:
    """A contact plan as odometry of the tool (axes as the base): where, how fast and when to touch."""
    message = Odometry(
        header=Header(stamp=time_base.stamp(plan.stamp), frame_id=frame), child_frame_id=tool_frame
    )
    message.pose.pose = planar_pose(np.append(plan.position, 0.0))
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = plan.covariance
    message.pose.covariance = spread_covariance(covariance)
    message.twist.twist.linear.x, message.twist.twist.linear.y = map(float, plan.velocity)
    return message


def withdrawal_message(stamp: Time, frame: str) -> Odometry:
    """In place of a contact plan: no tool is to touch anything, and what was asked for before is off."""
    return Odometry(header=Header(stamp=stamp, frame_id=frame))


def read_contact(message: Odometry, time_base: TimeBase, frame: str) -> ContactPlan:
    """A contact plan.

    Raises:
        InvalidInputError: wrong frame, non-finite numbers or a covariance that is not positive definite.
    """
    require_frame(message.header, frame)
    position = message.pose.pose.position
    velocity = message.twist.twist.linear
    covariance = read_planar_covariance(message.pose.covariance)[:2, :2]
    stamp = time_base.seconds(message.header.stamp)
    require_finite("contact plan", covariance)
    return ContactPlan(
        stamp, np.array([position.x, position.y]), np.array([velocity.x, velocity.y]), covariance
    )


def _rotation(angle: float) -> NDArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def spread_covariance(covariance: NDArray) -> NDArray:
    """A (3, 3) covariance over (x, y, yaw) as the 36 entries of a message."""
    full = np.zeros((6, 6))
    full[np.ix_(_PLANAR, _PLANAR)] = covariance
    return full.ravel()


def read_planar_covariance(covariance: Sequence[float]) -> NDArray:
    """The (3, 3) covariance over (x, y, yaw) in the 36 entries of a message.

    Raises:
        InvalidInputError: a number is not finite.
    """
    full = np.asarray(covariance, dtype=float).reshape(6, 6)[np.ix_(_PLANAR, _PLANAR)]
    require_finite("covariance", full)
    return full


def require_finite(what: str, *arrays: NDArray) -> None:
    """Raise InvalidInputError if an entry is NaN or infinite."""
    for values in arrays:
        if not np.isfinite(values).all():
            raise InvalidInputError(f"the {what} has a number that is not finite: {values.tolist()}")
