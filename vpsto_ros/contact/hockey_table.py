"""Geometry of an air-hockey table, its puck and its mallet."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import ConfigurationError


@documented
@dataclasses.dataclass(frozen=True)
class HockeyTable:
    """Geometry of table, puck and mallet."""

    half_length: float = option(0.974, "from the centre to an end rim", unit="m", minimum=0.1, maximum=10.0)
    half_width: float = option(0.519, "from the centre to a side rim", unit="m", minimum=0.1, maximum=10.0)
    goal_width: float = option(0.25, "width of a goal's opening", unit="m", minimum=0.01, maximum=2.0)
    puck_radius: float = option(0.03165, "radius of the puck", unit="m", minimum=1e-3, maximum=0.2)
    mallet_radius: float = option(0.04815, "radius of the mallet", unit="m", minimum=1e-3, maximum=0.2)
    post_radius: float = option(0.005, "of the goals' rounded posts", unit="m", minimum=0.0, maximum=0.1)

    def __post_init__(self) -> None:
        validate(self)
        if self.goal_width <= 2.0 * self.puck_radius:
            raise ConfigurationError(
                f"HockeyTable.goal_width = {self.goal_width} m lets no puck of radius {self.puck_radius} m "
                "pass"
            )

    @property
    def reach(self) -> NDArray[np.float64]:
        """How far from the centre the puck's centre gets, in x and in y, shape (2,) [m]."""
        return np.array([self.half_length, self.half_width]) - self.puck_radius

    @property
    def opening(self) -> float:
        """How far from the middle of a goal a puck may pass that goes straight and touches no post [m]."""
        return 0.5 * self.goal_width - self.puck_radius

    @property
    def contact_distance(self) -> float:
        """Between the centres of puck and mallet when they touch [m]."""
        return self.puck_radius + self.mallet_radius
