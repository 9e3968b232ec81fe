"""Which of the plans that were sent the controller really follows."""

import collections
import dataclasses

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.planning.pushing import MpcStep
from vpsto_ros.trajectory import Trajectory

POSITION_MATCH = 1e-3
"""The controller follows a plan if its reference is nearer than this [rad]."""
VELOCITY_MATCH = 1e-2
"""And its velocity nearer than this [rad/s]."""


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
