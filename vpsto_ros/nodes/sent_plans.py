"""Which of the plans that were sent the controller really follows."""

import collections
import dataclasses

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.planning.running_reference import AT_REST as MEASURED_REST
from vpsto_ros.planning.running_reference import MpcStep
from vpsto_ros.planning.stitching import extended
from vpsto_ros.trajectory import Limits, Trajectory, braking_trajectory

POSITION_MATCH = 1e-3
"""The controller follows a plan if its reference is nearer than this [rad]."""
VELOCITY_MATCH = 1e-2
"""And its velocity nearer than this [rad/s]."""
AT_REST = 1e-3
"""A controller's reference slower than this rests [rad/s]."""
SETTLING = 0.3
"""So long after its reference an arm may still move [s]."""


@dataclasses.dataclass(frozen=True)
class JointSample:
    """Positions [rad] and velocities [rad/s] of the joints at a time [s].

    Attributes:
        stamp: the time.
        position: shape (n,).
        velocity: shape (n,).
    """

    stamp: float
    position: NDArray
    velocity: NDArray


class SentPlans:
    """The plans sent lately, to find out which of them the controller really follows.

    A careful controller refuses what comes too late; planning on from that would never fit again. Where the
    controller publishes its reference (``desired_joint_states``), that says which plan runs.
    """

    def __init__(self, length: int = 12) -> None:
        self._steps: collections.deque[MpcStep] = collections.deque(maxlen=length)

    def __bool__(self) -> bool:
        """Whether anything was sent."""
        return bool(self._steps)

    def add(self, step: MpcStep) -> None:
        """Remember a plan that was sent."""
        self._steps.append(step)

    def running(self, desired: JointSample) -> MpcStep | None:
        """The latest plan that leads through a reference state, None if none does."""
        for step in reversed(self._steps):
            if follows(step.trajectory, desired):
                return step
        return None


def follows(trajectory: Trajectory, desired: JointSample) -> bool:
    """Whether a trajectory passes through a reference state at its time."""
    if desired.stamp < trajectory.start_time:
        return False
    position, velocity, _ = trajectory.state(desired.stamp)
    position_error = np.abs(position - desired.position).max()
    return bool(
        position_error < POSITION_MATCH and np.abs(velocity - desired.velocity).max() < VELOCITY_MATCH
    )


def runs_on(stop: Trajectory | None, sample: JointSample, tolerance: float | None) -> bool:
    """Whether an arm moves on although it was sent a trajectory that stops it.

    Args:
        stop: that trajectory, preceded by what ran before; None if nothing is known to run.
        sample: what the controller follows, or what was measured.
        tolerance: how far a measured joint may be from its reference [rad]; None for a controller's word.
    """
    speed = np.abs(sample.velocity).max()
    if tolerance is None:
        if stop is not None and sample.stamp < stop.start_time:
            return False
        return bool(speed > AT_REST and (stop is None or not follows(stop, sample)))
    if speed <= MEASURED_REST or (stop is not None and sample.stamp < stop.start_time):
        return False
    if stop is None or sample.stamp > stop.end_time + SETTLING:
        return True
    return bool(np.abs(stop(sample.stamp) - sample.position).max() > tolerance)


def stop_from(sample: JointSample, limits: Limits, at: float) -> Trajectory:
    """The quickest stop, beginning at a time [s], of an arm of whose motion only a sample is known."""
    position = sample.position + sample.velocity * (at - sample.stamp)
    return extended(braking_trajectory(position, sample.velocity, limits, start_time=at), at + 0.5)
