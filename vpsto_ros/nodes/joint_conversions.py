"""Between ROS messages about joints (trajectories, joint states) and the library's value types."""

import array
import dataclasses
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Duration, Time
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.nodes.conversions import SIMULATED, TimeBase, require_finite
from vpsto_ros.trajectory import Trajectory

ACCELERATION_JUMP = 1e-6
"""Difference between the accelerations before and after a knot that counts as a jump [rad/s^2]."""
SHORTEST_LEAD_IN = 1e-3
"""A first segment shorter than this is left out: the controller is on it or past it anyway [s]."""
SHORTEST_SEGMENT = 1e-6
"""Knots closer than this are merged: to the nanosecond of a message they could coincide [s]."""
_NANOSECONDS = 1_000_000_000


def trajectory_message(
    trajectory: Trajectory, joint_names: Sequence[str], time_base: TimeBase = SIMULATED, frame: str = ""
) -> JointTrajectory:
    """A trajectory as a stock joint_trajectory_controller takes it.

    Each knot becomes a point with position, velocity and acceleration. Where the acceleration jumps,
    `accelerations` stays empty: the controller then interpolates the two segments beside it by cubics, which
    is what they are, and so follows the trajectory exactly.

    Args:
        trajectory: what to send, in seconds of the time base.
        joint_names: names of its joints, in order.
        time_base: what its times are counted from.
        frame: frame_id of the header.

    Raises:
        InvalidInputError: the names do not fit, or a segment of degree 4 or 5 ends in an acceleration jump:
            no message could make the controller follow it.
    """
    if len(joint_names) != trajectory.dof:
        raise InvalidInputError(f"{len(joint_names)} joint names for a trajectory of {trajectory.dof} joints")
    jumps = _acceleration_jumps(trajectory)
    kept = _knots_to_send(trajectory.times)
    nanoseconds = np.round(trajectory.times[kept] * 1e9).astype(np.int64)
    # Rounded up, where the arm rests: a controller refuses a last point that still moves.
    nanoseconds[-1] = np.ceil(trajectory.end_time * 1e9)
    # Sampled at the times as the message carries them: moving a knot by half a nanosecond without its
    # position and velocity would change the acceleration that a controller deduces.
    times = np.clip(nanoseconds * 1e-9, trajectory.start_time, trajectory.end_time)
    velocities = trajectory(times, 1)
    velocities[-1] = np.where(np.abs(velocities[-1]) < 1e-9, 0.0, velocities[-1])
    message = JointTrajectory(joint_names=list(joint_names))
    message.header = Header(stamp=time_base.stamp(1e-9 * int(nanoseconds[0])), frame_id=frame)
    rows = zip(
        (nanoseconds - nanoseconds[0]).tolist(),
        jumps[kept],
        trajectory(times),
        velocities,
        trajectory(times, 2),
        strict=True,
    )
    message.points = [_point(*row) for row in rows]
    return message


def _knots_to_send(times: NDArray) -> NDArray[np.intp]:
    """Indices of the knots (at least the last two) that become points."""
    first = 1 if len(times) > 2 and times[1] - times[0] < SHORTEST_LEAD_IN else 0
    kept = [len(times) - 1]
    for index in range(len(times) - 2, first - 1, -1):
        if times[kept[-1]] - times[index] >= SHORTEST_SEGMENT:
            kept.append(index)
    return np.array(kept[::-1])


def _point(
    offset: int, jump: bool, position: NDArray, velocity: NDArray, acceleration: NDArray
) -> JointTrajectoryPoint:
    point = JointTrajectoryPoint()
    # Assigning an array.array skips the element-wise type checks of the generated setters.
    point.positions = array.array("d", position.tobytes())
    point.velocities = array.array("d", velocity.tobytes())
    if not jump:
        point.accelerations = array.array("d", acceleration.tobytes())
    duration = point.time_from_start
    duration.sec, duration.nanosec = divmod(offset, _NANOSECONDS)
    return point


def _acceleration_jumps(trajectory: Trajectory) -> NDArray[np.bool_]:
    """Which knots (S+1,) join segments of different acceleration."""
    length = np.diff(trajectory.times)[:, None]
    c2, c3, c4, c5 = (trajectory.coefficients[:, k] for k in range(2, 6))
    right = 2.0 * c2
    left = right + length * (6.0 * c3 + length * (12.0 * c4 + length * 20.0 * c5))
    jumps = np.zeros(len(trajectory.times), dtype=bool)
    jumps[1:-1] = np.abs(right[1:] - left[:-1]).max(axis=1) > ACCELERATION_JUMP
    quintic = (np.abs(c4) * length**4 + np.abs(c5) * length**5).max(axis=1) > 1e-12
    if (quintic & (jumps[:-1] | jumps[1:])).any():
        raise InvalidInputError(
            "a segment of degree 4 or 5 ends in an acceleration jump; only cubics can be sent there"
        )
    return jumps


@dataclasses.dataclass(frozen=True)
class TrajectoryPoints:
    """The contents of a JointTrajectory message with P points and n joints.

    Attributes:
        joint_names: the names it gives.
        stamp: its start in seconds of the time base, or 0 for "now" [s].
        time_from_start: shape (P,) [s].
        positions: shape (P, n) [rad].
        velocities: shape (P, n) [rad/s], None if no point has any.
        accelerations: shape (P, n) [rad/s^2], NaN rows where a point has none, None if no point has any.
    """

    joint_names: tuple[str, ...]
    stamp: float
    time_from_start: NDArray
    positions: NDArray
    velocities: NDArray | None
    accelerations: NDArray | None


def read_trajectory(message: JointTrajectory, time_base: TimeBase = SIMULATED) -> TrajectoryPoints:
    """The contents of a message, in arrays.

    Raises:
        InvalidInputError: it has no points, or a point does not have one entry per joint name.
    """
    points, names = message.points, tuple(message.joint_names)
    if not points:
        raise InvalidInputError("the trajectory has no points")
    positions = _column(points, "positions", len(names), required=True)
    if positions is None:
        raise InvalidInputError("the trajectory names no joints")
    now = message.header.stamp.sec == 0 and message.header.stamp.nanosec == 0
    return TrajectoryPoints(
        joint_names=names,
        stamp=0.0 if now else time_base.seconds(message.header.stamp),
        time_from_start=np.array([_duration(point.time_from_start) for point in points]),
        positions=positions,
        velocities=_column(points, "velocities", len(names), partial=False),
        accelerations=_column(points, "accelerations", len(names)),
    )


def trajectory_from_message(message: JointTrajectory, time_base: TimeBase = SIMULATED) -> Trajectory:
    """The trajectory that a controller interpolates from a message.

    Raises:
        InvalidInputError: the message is malformed.
    """
    points = read_trajectory(message, time_base)
    times = points.stamp + points.time_from_start
    return Trajectory.from_points(times, points.positions, points.velocities, points.accelerations)


def _duration(duration: Duration) -> float:
    return duration.sec + 1e-9 * duration.nanosec


def _column(
    points: Sequence[JointTrajectoryPoint],
    name: str,
    count: int,
    *,
    required: bool = False,
    partial: bool = True,
) -> NDArray | None:
    rows = [getattr(point, name) for point in points]
    given = [len(row) for row in rows]
    for index, length in enumerate(given):
        if length != count and (length or required or (not partial and any(given))):
            raise InvalidInputError(f"point {index} has {length} {name} for {count} joint names")
    if not any(given):
        return None
    table = np.full((len(points), count), np.nan)
    for index, row in enumerate(rows):
        if row:
            table[index] = row
    return table


def joint_state_message(
    names: Sequence[str], position: NDArray, velocity: NDArray, effort: NDArray, stamp: Time, frame: str
) -> JointState:
    """Joint positions [rad], velocities [rad/s] and torques [Nm], each of shape (n,), as a message."""
    message = JointState(name=list(names))
    message.header = Header(stamp=stamp, frame_id=frame)
    message.position = array.array("d", np.asarray(position, dtype=float).tobytes())
    message.velocity = array.array("d", np.asarray(velocity, dtype=float).tobytes())
    message.effort = array.array("d", np.asarray(effort, dtype=float).tobytes())
    return message


def read_joint_state(message: JointState, names: Sequence[str]) -> tuple[NDArray, NDArray]:
    """Positions and velocities of the named joints, in that order; further joints (a gripper) may be there.

    Returns:
        positions (n,) [rad] and velocities (n,) [rad/s].

    Raises:
        InvalidInputError: a joint is missing, arrays have the wrong length, a number is not finite.
    """
    index = {name: i for i, name in enumerate(message.name)}
    missing = [name for name in names if name not in index]
    if missing:
        available = ", ".join(message.name) or "none"
        raise InvalidInputError(f"no joint {', '.join(map(repr, missing))}; available: {available}")
    columns = []
    for field in ("position", "velocity"):
        values = getattr(message, field)
        if len(values) != len(message.name):
            raise InvalidInputError(f"{len(values)} entries of {field} for {len(message.name)} joint names")
        columns.append(np.array([values[index[name]] for name in names]))
    require_finite("joint state", *columns)
    return columns[0], columns[1]
