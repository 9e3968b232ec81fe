"""Where an object shall go in the plane of the table."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.estimation.object_state import wrap_angle
from vpsto_ros.exceptions import InvalidInputError


@dataclasses.dataclass(frozen=True)
class PlanarGoal:
    """A goal pose on the table, in the base frame.

    Attributes:
        position: goal of the object's origin, shape (2,) [m].
        yaw: goal orientation [rad], or None when any orientation will do.
    """

    position: NDArray
    yaw: float | None = None

    def __post_init__(self) -> None:
        position = np.asarray(self.position, dtype=float)
        if position.shape != (2,) or not np.isfinite(position).all():
            raise InvalidInputError(f"a goal needs a finite position of shape (2,), got {self.position!r}")
        if self.yaw is not None and not np.isfinite(self.yaw):
            raise InvalidInputError(f"a goal's yaw must be finite or None, got {self.yaw!r}")
        object.__setattr__(self, "position", position)

    def error(self, pose: NDArray, radius: float) -> NDArray:
        """Distance of object poses from the goal, sqrt(d^2 + radius^2 dyaw^2).

        Args:
            pose: object poses (x, y, yaw), shape (..., 3) [m, m, rad].
            radius: length that turns an angle into a distance [m]; unused without a goal orientation.

        Returns:
            Errors, shape (...) [m].
        """
        offset = pose[..., :2] - self.position
        squared = np.einsum("...i,...i->...", offset, offset)
        if self.yaw is not None:
            squared = squared + (radius * wrap_angle(pose[..., 2] - self.yaw)) ** 2
        return np.sqrt(squared)

    def distance(self, pose: NDArray) -> tuple[float, float]:
        """Distance [m] and angle [rad] of a pose (3,) from the goal; angle 0 without a goal orientation."""
        angle = 0.0 if self.yaw is None else abs(float(wrap_angle(pose[2] - self.yaw)))
        return float(np.hypot(*(pose[:2] - self.position))), angle
