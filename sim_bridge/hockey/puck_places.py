"""Where pucks are put for a shot: at random on the part of the table that the robot shoots from."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import ConfigurationError


@documented
@dataclass(frozen=True)
class PuckPlaces:
    """Where pucks begin, and how they drift.

    Raises:
        ConfigurationError: a value is out of range, or a range has no beginning.
    """

    x: tuple[float, float] = option(
        (0.85, 1.2), "range of places in x, base frame", unit="m", minimum=0.57, maximum=2.45
    )
    y: tuple[float, float] = option((-0.35, 0.35), "range in y", unit="m", minimum=-0.487, maximum=0.487)
    drift: float = option(0.1, "largest speed, in any direction", unit="m/s", minimum=0.0, maximum=2.0)

    def __post_init__(self) -> None:
        """Check the ranges."""
        validate(self)
        for name in ("x", "y"):
            low, high = getattr(self, name)
            if low > high:
                raise ConfigurationError(f"{name} = [{low}, {high}]: the first must not be above the second")

    def draw(self, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """A pose (x, y, yaw) [m, rad] and a velocity (vx, vy, yaw rate) [m/s, rad/s], each (3,)."""
        pose = np.array([rng.uniform(*self.x), rng.uniform(*self.y), rng.uniform(-np.pi, np.pi)])
        direction, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, self.drift)
        return pose, np.array([speed * np.cos(direction), speed * np.sin(direction), 0.0])
