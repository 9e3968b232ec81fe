"""The camera that sees the object: noisy, late, and now and then without a result."""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import InvalidInputError

_ROUNDING = 1e-9  # instants are multiples of the simulation's step only up to this [s]


@documented
@dataclass(frozen=True)
class CameraConfig:
    """How well the camera sees."""

    rate: float = option(50.0, "frames per second", unit="Hz", minimum=0.1, maximum=1000.0)
    latency: float = option(0.04, "from exposure to the result", unit="s", minimum=0.0, maximum=2.0)
    position_std: float = option(0.002, "standard deviation of x and y", unit="m", minimum=0.0, maximum=1.0)
    yaw_std: float = option(
        0.017453292519943295, "standard deviation of the yaw", unit="rad", minimum=0.0, maximum=3.0
    )
    dropout: float = option(0.05, "share of frames without a result", minimum=0.0, maximum=1.0)

    def __post_init__(self) -> None:
        """Check the ranges."""
        validate(self)


@dataclass(frozen=True)
class CameraFrame:
    """One result.

    Attributes:
        stamp: when the picture was taken [s].
        pose: measured (x, y, yaw) [m, rad], shape (3,), yaw in (-pi, pi].
        covariance: of the pose [m², m rad, rad²], shape (3, 3).
    """

    stamp: float
    pose: NDArray[np.float64]
    covariance: NDArray[np.float64]


class Camera:
    """Takes pictures at a fixed rate and hands the results out after the latency."""

    def __init__(self, config: CameraConfig, rng: np.random.Generator, *, start: float = 0.0):
        """Begin at `start` [s] with the first picture."""
        self.config = config
        self._rng = rng
        self._start = float(start)
        self._index = 0
        self._pending: deque[CameraFrame] = deque()
        stds = np.array([config.position_std, config.position_std, config.yaw_std])
        self._stds = stds
        # A covariance of zero would tell an estimator to divide by it.
        self._covariance = np.diag(np.maximum(stds, 1e-6) ** 2)
        self._covariance.setflags(write=False)

    @property
    def next_capture(self) -> float:
        """When the next picture is due [s]."""
        return self._start + self._index / self.config.rate - _ROUNDING

    def capture(self, t: float, pose: ArrayLike, *, visible: bool = True) -> bool:
        """Take a picture of the true pose (x, y, yaw) at time t [s] if one is due; says whether one was.

        Args:
            t: time.
            pose: of the object, shape (3,).
            visible: whether it is in the picture; else there is no result.

        Raises:
            InvalidInputError: the pose has another shape.
        """
        if t < self.next_capture:
            return False
        pose = np.asarray(pose, dtype=float)
        if pose.shape != (3,):
            raise InvalidInputError(f"pose must be (x, y, yaw), got shape {pose.shape}")
        missed = int((t + _ROUNDING - self._start) * self.config.rate) + 1
        self._index = max(self._index + 1, missed)
        # Noise and drop-outs are drawn for every picture, so that runs which differ in one of them stay
        # comparable.
        noise, lost = self._rng.standard_normal(3), self._rng.random() < self.config.dropout
        if visible and not lost:
            measured = pose + self._stds * noise
            measured[2] = np.pi - (np.pi - measured[2]) % (2.0 * np.pi)
            self._pending.append(CameraFrame(float(t), measured, self._covariance))
        return True

    def poll(self, t: float) -> list[CameraFrame]:
        """Results that have become available by time t [s] and were not handed out before, oldest first."""
        ready = []
        while self._pending and self._pending[0].stamp + self.config.latency <= t + _ROUNDING:
            ready.append(self._pending.popleft())
        return ready

    def clear(self) -> None:
        """Forget pictures whose results are still under way."""
        self._pending.clear()
