"""Motions joined and cut: at rest, extended, what is left of one, and one as candidates are measured."""

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory import MINIMUM_DURATION, Trajectory, TrajectoryBatch


def resting(position: NDArray, start: float, end: float) -> Trajectory:
    """A trajectory that stays at one position from `start` to `end` [s]."""
    return Trajectory.from_points(
        np.array([start, end]), np.stack([position] * 2), np.zeros((2, len(position)))
    )


def extended(trajectory: Trajectory, end: float) -> Trajectory:
    """The trajectory, resting at its last position until `end` if it is over earlier."""
    if trajectory.end_time >= end - 1e-9:
        return trajectory
    last = trajectory(trajectory.end_time)
    return trajectory.followed_by(resting(last, trajectory.end_time, end))


def remainder(trajectory: Trajectory, start: float) -> Trajectory:
    """What is left of a motion from `start` [s] on; when it is over, a moment at its last position."""
    if abs(start - trajectory.start_time) < 1e-9:  # a knot there would leave a sliver that stands still
        return trajectory
    if start < trajectory.end_time - 1e-9:
        return trajectory.clipped(start, trajectory.end_time)
    return resting(trajectory(trajectory.end_time), start, start + MINIMUM_DURATION)


def as_batch(trajectory: Trajectory, samples: int) -> TrajectoryBatch:
    """One trajectory as a batch of one, so that cost terms can look at a motion that no candidate stands for.

    Args:
        trajectory: piecewise cubic; knots may be anywhere.
        samples: number K of equally spaced phases.

    Raises:
        InvalidInputError: the trajectory is not piecewise cubic.
    """
    if trajectory.coefficients[:, 4:].any():
        raise InvalidInputError("only a piecewise cubic trajectory can be written as a batch")
    start, duration = trajectory.start_time, trajectory.duration
    times = start + np.linspace(0.0, duration, samples)
    knots = (trajectory.times - start) / duration
    return TrajectoryBatch(
        np.array([duration]), trajectory(times)[None], trajectory(times, 1)[None], trajectory(times, 2)[None],
        trajectory(trajectory.times)[None], knots, duration * trajectory(trajectory.times, 1)[None],
    )  # fmt: skip
