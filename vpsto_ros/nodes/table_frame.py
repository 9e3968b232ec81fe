"""Where an air-hockey table stands: between the robot's base frame, in messages, and the table's."""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.estimation.puck_filter import PuckState
from vpsto_ros.planning.hockey.shooting_config import Strikes

MALLET = "mallet"
"""Frame of the mallet's centre, with the axes of the base frame: child_frame_id of contact_plan."""
UNKNOWN_YAW = np.pi**2 / 3.0
"""Variance of the yaw of a puck, which nobody estimates: any is as likely [rad²]."""
UNKNOWN_SPIN = 1e4
"""Variance of its yaw rate, likewise [rad²/s²]."""


@documented
@dataclasses.dataclass(frozen=True)
class HockeyTableConfig:
    """Where the centre of the playing surface is; its axes are those of the base frame."""

    x: float = option(1.51, "centre of the table, base frame", unit="m", minimum=-5.0, maximum=5.0)
    y: float = option(0.0, "likewise", unit="m", minimum=-5.0, maximum=5.0)
    surface: float = option(
        0.1, "height of the playing surface, base frame", unit="m", minimum=-2.0, maximum=2.0
    )

    def __post_init__(self) -> None:
        validate(self)

    @property
    def origin(self) -> NDArray[np.float64]:
        """The table's centre in the base frame, shape (2,) [m]."""
        return np.array([self.x, self.y])

    def to_table(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 2) [m] of the base frame in the table frame."""
        return np.asarray(points, dtype=float) - self.origin

    def to_base(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 2) [m] of the table frame in the base frame."""
        return np.asarray(points, dtype=float) + self.origin

    def object_state(self, puck: PuckState) -> ObjectState:
        """A puck as messages speak of objects, in the base frame; its yaw is not known."""
        covariance = np.zeros((6, 6))
        columns = np.array([0, 1, 3, 4])
        covariance[np.ix_(columns, columns)] = puck.covariance
        covariance[2, 2], covariance[5, 5] = UNKNOWN_YAW, UNKNOWN_SPIN
        pose, twist = np.zeros(3), np.zeros(3)
        pose[:2], twist[:2] = self.to_base(puck.mean[:2]), puck.mean[2:]
        return ObjectState(puck.stamp, pose, twist, covariance)

    def puck_state(self, state: ObjectState) -> PuckState:
        """A puck as planners take it, in the table frame; what it touches is not known, nor do they ask."""
        columns = np.array([0, 1, 3, 4])
        mean = np.concatenate([self.to_table(state.pose[:2]), state.twist[:2]])
        return PuckState(state.stamp, mean, state.covariance[np.ix_(columns, columns)], 0, "")


@documented
@dataclasses.dataclass(frozen=True)
class PlayingSurfaceConfig:
    """How high the table is, for nodes whose strikes say where else it stands."""

    surface: float = option(
        0.1, "height of the playing surface, base frame", unit="m", minimum=-2.0, maximum=2.0
    )

    def __post_init__(self) -> None:
        validate(self)

    def table(self, strikes: Strikes) -> HockeyTableConfig:
        """The table that strikes are for."""
        x, y = map(float, strikes.center)
        return HockeyTableConfig(x, y, self.surface)
