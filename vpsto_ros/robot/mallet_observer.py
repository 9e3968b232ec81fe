"""Where the mallet of the iiwa is, from the joints that are measured. Frame: the robot's base."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.iiwa_kinematics import chain, jacobian


class MalletObserver:
    """The mallet's centre below the universal joint, as measured joints say."""

    def __init__(self) -> None:
        self._points, self._axes, self._jacobian = np.empty((4, 3)), np.empty((7, 3)), np.empty((3, 6))

    def reset(self) -> None:
        """Forget what was measured."""

    def observe(self, stamp: float, position: ArrayLike, velocity: ArrayLike) -> NDArray[np.float64]:
        """Take in measured joints.

        Args:
            stamp: when they were measured [s].
            position: of the joints, shape (7,) [rad].
            velocity: of the joints, shape (7,) [rad/s].

        Returns:
            x, y, vx, vy of the mallet's centre, shape (4,) [m, m/s].

        Raises:
            InvalidInputError: a shape does not fit, or a number is not finite.
        """
        q, qd = np.asarray(position, dtype=float), np.asarray(velocity, dtype=float)
        if q.shape != (7,) or qd.shape != (7,) or not np.isfinite([stamp, *q, *qd]).all():
            raise InvalidInputError("joints must be a stamp, 7 positions and 7 velocities, all finite")
        chain(q, self._points, self._axes)
        jacobian(self._points, self._axes, self._jacobian)
        return np.concatenate([self._points[3, :2], (self._jacobian @ qd[:6])[:2]])
