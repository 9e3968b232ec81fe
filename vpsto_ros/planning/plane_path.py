"""From whole motions of tools in the plane, however long, to joint trajectories within limits.

Open-loop pushing plans a motion once and plays it: its joint trajectory starts and ends where the plane's
does. (What replans from wherever the arm is uses :class:`vpsto_ros.planning.table_path.TablePath`.)
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.exceptions import InfeasibleError, InvalidInputError
from vpsto_ros.robot.tool_plane import ToolPlane
from vpsto_ros.trajectory import Limits, Trajectory

_STEP = 1e-6  # steps of the plane's position or velocity above this are refused [m, m/s]
_ACCELERATION_STEP = 1e-6  # relative to the largest acceleration; above it segments are cubics
_CHECKS = 4  # heights are checked at this many instants between two knots


@dataclasses.dataclass(frozen=True)
class FollowedPlane:
    """A motion in the plane as the joints do it.

    Attributes:
        trajectory: joint positions [rad] over time, n degrees of freedom.
        stretch: how much longer than the plane's motion it takes; 1 unless the joints' limits slow it down.
        height_deviation: largest distance of a tool from its height [m].
    """

    trajectory: Trajectory
    stretch: float
    height_deviation: float


def follow_plane(
    plane: Trajectory,
    tool_plane: ToolPlane,
    *,
    spacing: float = 0.02,
    height_tolerance: float = 0.001,
    cubic: bool = False,
) -> FollowedPlane:
    """The joint trajectory of a motion in the plane, exact at knots that are at most `spacing` apart.

    The plane's own knots are among them. Where the plane's acceleration is continuous, segments are quintics
    with the exact accelerations, else cubics. If velocity or acceleration limits of the joints are exceeded,
    the whole motion is slowed down by the factor that is needed; a motion that does not start at rest then
    starts slower, too.

    Args:
        plane: motion of the tools, m degrees of freedom.
        tool_plane: maps it to joints.
        spacing: longest time between knots [s].
        height_tolerance: largest allowed distance of a tool from its height [m].
        cubic: segments are cubics in any case. What replans on the move joins motions where the acceleration
            jumps, and across a jump a message can carry nothing but cubics.

    Raises:
        InvalidInputError: the trajectory has another number of coordinates or steps, or spacing is not
            positive.
        InfeasibleError: the motion leaves the reachable plane or the joints' position limits, or a tool
            leaves its height.
    """
    _check_plane(plane, tool_plane, spacing)
    times = _knots(plane.times, spacing)
    points = plane(times)
    inside = tool_plane.contains(points)
    if not inside.all():
        k = int(np.flatnonzero(~inside)[0])
        raise InfeasibleError(
            f"at {times[k]:.2f} s the tool at {np.round(points[k], 3).tolist()} is out of reach or beyond "
            "the joint limits"
        )
    q, qd, qdd = tool_plane.joint_motion(points, plane(times, 1), plane(times, 2))
    smooth = not cubic and _acceleration_is_continuous(plane)
    trajectory = Trajectory.from_points(times, q, qd, qdd if smooth else None)
    stretch = _stretch(trajectory, tool_plane.robot.limits)
    if stretch > 1.0:
        trajectory = _slowed(trajectory, stretch)
    broken = trajectory.violations(tool_plane.robot.limits)
    if broken:
        raise InfeasibleError("joint limits do not hold: " + "; ".join(broken))
    return FollowedPlane(trajectory, stretch, _height_deviation(trajectory, tool_plane, height_tolerance))


def _check_plane(plane: Trajectory, tool_plane: ToolPlane, spacing: float) -> None:
    if plane.dof != tool_plane.dof:
        raise InvalidInputError(
            f"the motion has {plane.dof} coordinates, the plane of the tools has {tool_plane.dof}"
        )
    if not spacing > 0.0:
        raise InvalidInputError(f"spacing must be positive, got {spacing}")
    for name, jump in zip(("position", "velocity"), plane.jumps(), strict=True):
        if jump.max() > _STEP:
            raise InvalidInputError(f"the motion steps in {name} by {jump.max():.3g}; no arm can follow")


def _knots(times: NDArray, spacing: float) -> NDArray[np.float64]:
    """The given times and as many evenly spaced ones between two of them as needed."""
    counts = np.maximum(np.ceil(np.diff(times) / spacing - 1e-9), 1).astype(int)
    segment = np.repeat(np.arange(len(counts)), counts)
    step = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    knots = times[segment] + step / counts[segment] * np.diff(times)[segment]
    return np.append(knots, times[-1])


def _acceleration_is_continuous(plane: Trajectory) -> bool:
    length = np.diff(plane.times)[:-1, None]
    c2, c3, c4, c5 = (plane.coefficients[:-1, k] for k in range(2, 6))
    before = 2.0 * c2 + length * (6.0 * c3 + length * (12.0 * c4 + length * 20.0 * c5))
    after = 2.0 * plane.coefficients[1:, 2]
    largest = max(float(np.abs(bound).max()) for bound in plane.extrema(2))
    return bool(np.abs(after - before).max(initial=0.0) <= _ACCELERATION_STEP * largest)


def _stretch(trajectory: Trajectory, limits: Limits) -> float:
    """By how much to lengthen the motion so that velocities and accelerations are within limits."""
    velocity, acceleration = (np.abs(trajectory.extrema(order)).max(axis=0) for order in (1, 2))
    needed = max(
        float((velocity / limits.velocity).max()), float(np.sqrt(acceleration / limits.acceleration).max())
    )
    return needed * (1.0 + 1e-9) if needed > 1.0 else 1.0


def _slowed(trajectory: Trajectory, factor: float) -> Trajectory:
    """The same path, slower by a factor, from the same start time."""
    times = trajectory.start_time + factor * (trajectory.times - trajectory.start_time)
    powers = factor ** -np.arange(trajectory.coefficients.shape[1], dtype=float)
    return Trajectory(times, trajectory.coefficients * powers[:, None])


def _height_deviation(trajectory: Trajectory, tool_plane: ToolPlane, tolerance: float) -> float:
    share = (np.arange(_CHECKS) + 0.5) / _CHECKS
    times = (trajectory.times[:-1, None] + share * np.diff(trajectory.times)[:, None]).ravel()
    heights = tool_plane.tool_heights(trajectory(times))
    worst = float(np.abs(heights - tool_plane.height).max())
    if worst > tolerance:
        raise InfeasibleError(
            f"a tool would leave its height by {1e3 * worst:.2f} mm (allowed {1e3 * tolerance:g} mm); use "
            "a smaller spacing"
        )
    return worst
