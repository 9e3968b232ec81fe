"""Where the mallet of the iiwa is, from the joints that are measured. Frame: the robot's base."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.iiwa_kinematics import chain, jacobian
from vpsto_ros.robot.mallet_tilt import MalletTilt
from vpsto_ros.trajectory import Trajectory

LONGEST_GAP = 0.1
"""Between two measurements; after a longer one the mallet is taken to hang vertically [s].

So it is when time goes back by more: the clock was set back.
"""
_SHORTEST_GAP = 1e-6


class MalletObserver:
    """The mallet's centre: below the universal joint, and aside as it swings on it.

    Nothing measures the swing. It is what the motion of the joints makes it (:class:`MalletTilt`), which
    between two measurements is a cubic through both.
    """

    def __init__(self, tilt: MalletTilt | None = None) -> None:
        """Begin with a mallet that hangs vertically; the default mechanics if `tilt` is None."""
        self._tilt = tilt or MalletTilt()
        self._points, self._axes, self._jacobian = np.empty((4, 3)), np.empty((7, 3)), np.empty((3, 6))
        self.reset()

    def reset(self) -> None:
        """Forget what was measured; the mallet hangs vertically."""
        self._last: tuple[float, NDArray, NDArray] | None = None
        self._swing = np.zeros(4)

    def observe(self, stamp: float, position: ArrayLike, velocity: ArrayLike) -> NDArray[np.float64]:
        """Take in measured joints.

        Args:
            stamp: when they were measured [s]; one that is a little older than the last changes nothing.
            position: of the joints, shape (7,) [rad].
            velocity: of the joints, shape (7,) [rad/s].

        Returns:
            x, y, vx, vy of the mallet's centre, shape (4,) [m, m/s].

        Raises:
            InvalidInputError: a shape does not fit, or a number is not finite.
        """
        q, qd = np.array(position, dtype=float), np.array(velocity, dtype=float)
        if q.shape != (7,) or qd.shape != (7,) or not np.isfinite([stamp, *q, *qd]).all():
            raise InvalidInputError("joints must be a stamp, 7 positions and 7 velocities, all finite")
        self._follow(stamp, q, qd)
        chain(q, self._points, self._axes)
        jacobian(self._points, self._axes, self._jacobian)
        aside, drift = self._tilt.displacement(self._swing)
        return np.concatenate([self._points[3, :2] + aside, (self._jacobian @ qd[:6])[:2] + drift])

    def _follow(self, stamp: float, q: NDArray, qd: NDArray) -> None:
        """Let the mallet swing on since the last measurement."""
        if self._last is None or abs(stamp - self._last[0]) > LONGEST_GAP:
            self._swing = np.zeros(4)
        elif stamp - self._last[0] < _SHORTEST_GAP:
            return
        else:
            begin, before, rates = self._last
            rows, speeds = np.stack([before, q]), np.stack([rates, qd])
            motion = Trajectory.from_points(np.array([begin, stamp]), rows, speeds)
            self._swing = self._tilt.along(motion, stamp, begin, self._swing)
        self._last = (stamp, q, qd)
