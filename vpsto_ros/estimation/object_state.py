"""The state of a planar object as the planners see it."""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.exceptions import InvalidInputError


def wrap_angle(angle: NDArray | float) -> NDArray | float:
    """The same angles in (-pi, pi] [rad], a number or an array; those already there are not changed."""
    turns = np.ceil((np.asarray(angle) - math.pi) / (2.0 * math.pi))
    # Rounding counts a turn for the number next to -pi, which would end up beyond pi.
    return np.minimum(angle - 2.0 * math.pi * turns, math.pi)


@dataclasses.dataclass(frozen=True)
class ObjectState:
    """Pose and twist of an object on the table, in the base frame.

    Attributes:
        stamp: time the state belongs to [s].
        pose: x, y [m] and yaw [rad] in (-pi, pi], shape (3,).
        twist: their time derivatives in the base frame [m/s, rad/s], shape (3,).
        covariance: of pose and twist together, shape (6, 6).

    Raises:
        InvalidInputError: wrong shape or not finite.
    """

    stamp: float
    pose: np.ndarray
    twist: np.ndarray
    covariance: np.ndarray

    def __post_init__(self) -> None:
        shapes = (self.pose.shape, self.twist.shape, self.covariance.shape)
        if shapes != ((3,), (3,), (6, 6)):
            raise InvalidInputError(f"expected pose (3,), twist (3,) and covariance (6, 6), got {shapes}")
        total = self.stamp + self.pose.sum() + self.twist.sum() + self.covariance.sum()
        if not np.isfinite(total):
            raise InvalidInputError("stamp, pose, twist and covariance must be finite")
