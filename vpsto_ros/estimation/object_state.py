"""The state of a planar object as the planners see it."""

import dataclasses

import numpy as np

from vpsto_ros.exceptions import InvalidInputError


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
