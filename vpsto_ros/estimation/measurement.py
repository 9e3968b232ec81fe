"""Measured poses of an object on the table, and what becomes of them in a filter."""

import dataclasses
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.estimation.object_state import wrap_angle
from vpsto_ros.exceptions import ConfigurationError

_FARTHEST = 1e3  # no object on a table is farther away [m]
_VAGUE = 1.0  # a position is measured better, or not at all [m]


@documented
@dataclasses.dataclass(frozen=True)
class MeasurementLimits:
    """Where and when an object can have been measured; all else is refused.

    Raises:
        ConfigurationError: a value is out of range; the message names what is allowed.
    """

    table_x: tuple[float, float] = option(
        (0.1, 1.0), "where on the table the object can be, x", unit="m", minimum=-10.0, maximum=10.0
    )
    table_y: tuple[float, float] = option(
        (-0.7, 0.7), "where on the table the object can be, y", unit="m", minimum=-10.0, maximum=10.0
    )
    max_age: float = option(
        1.0, "how late a measurement may be, and how long the past is kept", unit="s", minimum=0.01,
        maximum=5.0,
    )  # fmt: skip
    max_ahead: float = option(
        0.1, "how far a stamp may be ahead of the robot's last one", unit="s", minimum=0.0, maximum=10.0
    )

    def __post_init__(self) -> None:
        validate(self)
        for name in ("table_x", "table_y"):
            low, high = getattr(self, name)
            if low > high:
                raise ConfigurationError(f"MeasurementLimits.{name} = {(low, high)} is not a range")

    def objection(self, pose: NDArray, covariance: NDArray) -> str:
        """Why no object can have been measured at a pose (3,) with a covariance (3, 3), else empty."""
        (left, right), (front, back) = self.table_x, self.table_y
        x, y = pose[:2]
        if not (left <= x <= right and front <= y <= back):
            return f"the object at ({x:.3f}, {y:.3f}) m is outside the table"
        vague = np.diag(covariance)[:2].max() > _VAGUE**2
        return f"its standard deviation is above {_VAGUE} m: it tells nothing" if vague else ""


class Outcome(str):
    """What became of a measurement, with the reason in words.

    Compares as "accepted", "outlier", "stale", "reinitialized" or "invalid: <reason>".
    """

    kind: str
    reason: str

    def __new__(cls, kind: str, reason: str = "") -> "Outcome":
        """Build from the kind ("invalid" without the colon) and the reason."""
        outcome = super().__new__(cls, f"invalid: {reason}" if kind == "invalid" else kind)
        outcome.kind, outcome.reason = kind, reason
        return outcome


@dataclasses.dataclass(frozen=True)
class PoseMeasurement:
    """A stamped pose (x, y, yaw) with its covariance (3, 3)."""

    stamp: float
    pose: np.ndarray
    covariance: np.ndarray


def checked(stamp: float, pose: ArrayLike, covariance: ArrayLike) -> tuple[str, PoseMeasurement | None]:
    """The measurement as float64 arrays of its own, or what is wrong with it."""
    try:
        time, where = float(stamp), np.array(pose, dtype=float)
        noise = np.array(covariance, dtype=float)
    except (TypeError, ValueError) as error:
        return f"not numbers: {error}", None
    if where.shape != (3,) or noise.shape != (3, 3):
        return f"expected pose (3,) and covariance (3, 3), got {where.shape} and {noise.shape}", None
    if not (math.isfinite(time) and np.isfinite(where).all() and np.isfinite(noise).all()):
        return "stamp, pose or covariance is not finite", None
    if np.abs(where[:2]).max() > _FARTHEST:
        return f"position {where[:2]} is beyond {_FARTHEST:g} m", None
    where[2] = wrap_angle(where[2])
    if np.abs(noise - noise.T).max() > 1e-6 * np.abs(noise).max():
        return "covariance is not symmetric", None
    try:
        np.linalg.cholesky(noise)
    except np.linalg.LinAlgError:
        return "covariance is not positive definite", None
    return "", PoseMeasurement(time, where, 0.5 * (noise + noise.T))


def could_follow(
    first: PoseMeasurement,
    second: PoseMeasurement,
    max_speed: float,
    max_yaw_rate: float = math.inf,
    max_gap: float = math.inf,
) -> bool:
    """Whether an object no faster than these [m/s, rad/s] can have been at both, within max_gap [s]."""
    gap = second.stamp - first.stamp
    if not 0 < gap <= max_gap:
        return False
    step = second.pose - first.pose
    noise = first.covariance + second.covariance
    reach = max_speed * gap + 4.0 * math.sqrt(noise[0, 0] + noise[1, 1])
    turn = max_yaw_rate * gap + 4.0 * math.sqrt(noise[2, 2])
    return math.hypot(step[0], step[1]) <= reach and abs(float(wrap_angle(step[2]))) <= turn


def finite_array(values: object, *shapes: tuple[int, ...]) -> tuple[NDArray[np.float64], str]:
    """Values as an array of one of these shapes, and what is wrong with them."""
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        return np.empty(0), f"not numbers: {error}"
    if array.shape not in shapes:
        return array, f"expected shape {' or '.join(map(str, shapes))}, got {array.shape}"
    return array, "" if np.isfinite(array).all() else "not finite"
