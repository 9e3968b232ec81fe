"""What an arm that plays air hockey has to keep, and where it waits."""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.robot.kinematics import Robot
from vpsto_ros.trajectory import Limits


@documented
@dataclasses.dataclass(frozen=True)
class PlayRules:
    """Rules of play and the margins that planners keep to them.

    Raises:
        ConfigurationError: a value is out of range; the message names what is allowed.
    """

    home: tuple[float, ...] = option(
        (0.0, -0.196, 0.0, -1.844, 0.0, 0.970, 0.0), "joint positions in which the arm waits", unit="rad",
        minimum=-3.1, maximum=3.1,
    )  # fmt: skip
    table_x: float = option(1.51, "the table's centre in the base frame", unit="m", minimum=0.5, maximum=5.0)
    table_y: float = option(0.0, "likewise", unit="m", minimum=-2.0, maximum=2.0)
    height: float = option(
        0.1645, "of the mallet's universal joint during play, base frame", unit="m", minimum=0.0, maximum=1.0
    )
    height_tolerance: float = option(
        0.014, "largest distance from it that is planned; the rules allow 0.02", unit="m", minimum=1e-3,
        maximum=0.1,
    )  # fmt: skip
    least_x: float = option(
        0.594, "least x of the universal joint that is planned, base frame; the rules allow 0.584", unit="m",
        minimum=0.0, maximum=2.0,
    )  # fmt: skip
    most_y: float = option(
        0.462, "largest |y| of the universal joint that is planned; the rules allow 0.47085", unit="m",
        minimum=0.05, maximum=2.0,
    )  # fmt: skip
    clearance: float = option(
        0.28, "least height of elbow and wrist that is planned, base frame; the rules allow 0.25", unit="m",
        minimum=0.0, maximum=1.0,
    )  # fmt: skip
    rod_tilt: float = option(
        1.05, "largest angle between rod and vertical", unit="rad", minimum=0.1, maximum=1.5
    )
    position_share: float = option(
        0.94, "share of the joints' position limits that is planned; the rules allow 0.95", minimum=0.1,
        maximum=1.0,
    )  # fmt: skip
    velocity_share: float = option(
        0.92, "share of the joints' velocity limits that is planned; the rules allow 0.95, and weakly damped"
        " joints overshoot", minimum=0.1, maximum=1.0,
    )  # fmt: skip
    acceleration_share: float = option(
        0.98, "share of the joints' acceleration limits that is planned", minimum=0.1, maximum=1.0
    )

    def __post_init__(self) -> None:
        validate(self)

    @property
    def table(self) -> NDArray[np.float64]:
        """The table's centre in the base frame, shape (2,) [m]."""
        return np.array([self.table_x, self.table_y])

    def limits(self, robot: Robot) -> Limits:
        """The limits that are planned with."""
        full = robot.limits
        lower, upper = robot.position_range
        middle, half = 0.5 * (lower + upper), 0.5 * self.position_share * (upper - lower)
        return Limits(
            self.velocity_share * full.velocity, self.acceleration_share * full.acceleration,
            middle - half, middle + half,
        )  # fmt: skip

    def kernel_row(self) -> NDArray[np.float64]:
        """Places that are allowed, as :mod:`vpsto_ros.planning.hockey.motion_kernels` takes them, (6,)."""
        return np.array([
            self.height, self.height_tolerance, self.least_x, self.most_y, self.clearance,
            math.cos(self.rod_tilt),
        ])  # fmt: skip
