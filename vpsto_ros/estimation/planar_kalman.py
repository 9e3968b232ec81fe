"""The filter between the camera and the pushing planner: pose and twist of an object on the table.

A box on a table rests, is pushed at an even speed, or is being accelerated: by the tool, or by a hand that
knocks it away. One process noise cannot serve all three, so the filter runs one Kalman filter for each, in x,
y and yaw, and lets them interact (:mod:`vpsto_ros.estimation.motion_modes`). The moving modes have constant
velocity with white-noise acceleration.
"""

import dataclasses
import math

import numpy as np

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.estimation.measurement import Outcome, PoseMeasurement, checked, could_follow
from vpsto_ros.estimation.motion_modes import ModeBelief, MotionModes
from vpsto_ros.estimation.object_state import ObjectState, wrap_angle
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError


@documented
@dataclasses.dataclass(frozen=True)
class PlanarKalmanConfig:
    """Options of the filter. Noise densities are standard deviations after one second.

    Raises:
        ConfigurationError: a value is out of range; the message names what is allowed.
    """

    rest_drift: tuple[float, float] = option(
        (5e-4, 2e-3),
        "random walk of a resting object, linear and angular",
        unit="m, rad per sqrt(s)",
        minimum=1e-6,
    )
    steady_noise: tuple[float, float] = option(
        (0.1, 1.0), "change of velocity while pushed evenly", unit="m/s, rad/s per sqrt(s)", minimum=1e-6
    )
    manoeuvre_noise: tuple[float, float] = option(
        (0.8, 8.0), "change of velocity while accelerated", unit="m/s, rad/s per sqrt(s)", minimum=1e-6
    )
    dwell: tuple[float, float, float] = option(
        (0.5, 2.0, 0.15), "mean time at rest, steady and accelerated", unit="s", minimum=1e-3
    )
    gate: float = option(
        30.0, "squared Mahalanobis distance beyond which a pose is an outlier", minimum=1.0, maximum=1e6
    )
    confirmations: int = option(
        3,
        "consecutive outliers that agree with each other and move the filter to them",
        minimum=1,
        maximum=100,
    )
    max_speed: float = option(
        1.0, "speed up to which outliers agree", unit="m/s", minimum=1e-3, maximum=100.0
    )
    max_yaw_rate: float = option(
        12.0, "yaw rate up to which outliers agree", unit="rad/s", minimum=1e-3, maximum=1000.0
    )
    max_gap: float = option(
        0.4,
        "longest time without a pose after which the past counts; a stamp so much older is refused",
        unit="s",
        minimum=0.01,
        maximum=60.0,
    )
    max_jump: float = option(
        2.0,
        "a stamp that is so much later than the last one is refused until others agree",
        unit="s",
        minimum=0.01,
        maximum=1e6,
    )
    max_extrapolation: float = option(
        0.2, "longest time for which a prediction goes on moving", unit="s", minimum=0.0, maximum=60.0
    )

    def __post_init__(self) -> None:
        validate(self)
        if self.max_jump < self.max_gap:
            raise ConfigurationError(
                f"max_jump = {self.max_jump} must not be smaller than max_gap = {self.max_gap}"
            )


class PlanarKalman:
    """Estimates an object's planar pose and twist from stamped poses.

    Feed every pose to :meth:`update`, in the order of arrival; ask :meth:`predict` for the state at any later
    time. The filter never raises on what a camera delivers: the outcome says what was wrong, and the estimate
    is left as it was.
    """

    def __init__(self, config: PlanarKalmanConfig | None = None) -> None:
        self.config = config or PlanarKalmanConfig()
        self._modes = _motion_modes(self.config)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._belief: ModeBelief | None = None
        self._stamp = -math.inf
        self._pending: list[PoseMeasurement] = []

    @property
    def state(self) -> ObjectState | None:
        """Estimate at the stamp of the last accepted pose, None before the first."""
        return None if self._belief is None else _object_state(self._stamp, self._belief)

    def predict(self, stamp: float) -> ObjectState | None:
        """State at `stamp` [s], None before the first pose.

        A stamp before the last accepted pose gives the state at that pose. Beyond ``max_extrapolation`` the
        object is taken to stand where it would be then, with a covariance that goes on growing.

        Raises:
            InvalidInputError: the stamp is not finite.
        """
        if not math.isfinite(stamp):
            raise InvalidInputError(f"cannot predict to stamp {stamp!r}")
        if self._belief is None or stamp <= self._stamp:
            return self.state
        gap, longest = stamp - self._stamp, self.config.max_extrapolation
        belief = self._belief.propagated(self._modes, min(gap, longest), gap).unwound()
        if gap > longest:
            belief.mean[:, 3:] = 0.0
        return _object_state(stamp, belief)

    def update(self, stamp: float, pose: np.ndarray, covariance: np.ndarray) -> Outcome:
        """Take in a measured pose.

        Args:
            stamp: when it was measured [s].
            pose: x, y [m] and yaw [rad] in the base frame, shape (3,).
            covariance: of the pose, shape (3, 3).

        Returns:
            "accepted"; "outlier" (too unlikely; ignored unless the following ones agree with it);
            "reinitialized" (the estimate now starts from this and the preceding outliers, or from this pose
            after a long gap); "stale" (not newer than what is known) or "invalid: reason". The attribute
            ``reason`` explains.
        """
        defect, measurement = checked(stamp, pose, covariance)
        if measurement is None:
            return Outcome("invalid", defect)
        if self._belief is None:
            self._restart([measurement])
            return Outcome("accepted", "first pose")
        gap = measurement.stamp - self._stamp
        if not -self.config.max_gap <= gap <= self.config.max_jump:
            return self._pend(measurement, "invalid", f"stamp jumps by {gap:.3g} s")
        if gap <= 0:
            return Outcome("stale", f"stamp is {-gap:.4g} s older than the last accepted one")
        if gap > self.config.max_gap:
            self._restart([measurement])
            return Outcome("reinitialized", f"first pose after {gap:.3g} s")
        return self._correct(self._belief, measurement, gap)

    def _correct(self, belief: ModeBelief, measurement: PoseMeasurement, gap: float) -> Outcome:
        predicted = belief.mixed(self._modes, gap).propagated(self._modes, gap)
        innovation = predicted.innovation(measurement.pose, measurement.covariance)
        distance = float(innovation.distance.min())
        if not distance <= self.config.gate:
            reason = f"squared Mahalanobis distance {distance:.3g} > {self.config.gate:g}"
            return self._pend(measurement, "outlier", reason)
        self._belief = predicted.updated(innovation, measurement.covariance)
        self._stamp = measurement.stamp
        self._pending.clear()
        return Outcome("accepted")

    def _pend(self, measurement: PoseMeasurement, kind: str, reason: str) -> Outcome:
        """Keep what was refused; enough of it in agreement means that the filter is wrong, not the camera."""
        if self._pending and not self._agree(self._pending[-1], measurement):
            self._pending.clear()
        self._pending.append(measurement)
        if len(self._pending) < self.config.confirmations:
            return Outcome(kind, reason)
        count = len(self._pending)
        self._restart(self._pending)
        return Outcome("reinitialized", f"{count} consecutive outliers agree")

    def _agree(self, first: PoseMeasurement, second: PoseMeasurement) -> bool:
        config = self.config
        return could_follow(first, second, config.max_speed, config.max_yaw_rate, config.max_gap)

    def _restart(self, measurements: list[PoseMeasurement]) -> None:
        """Begin at the first measurement and replay the others, so that the twist is known as well."""
        first = measurements[0]
        count = len(self._modes.dwell)
        unknown = np.array([self.config.max_speed / 2] * 2 + [self.config.max_yaw_rate / 2]) ** 2
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = first.covariance
        covariance[3:, 3:] = np.diag(unknown)
        mean = np.tile(np.append(first.pose, np.zeros(3)), (count, 1))
        belief = ModeBelief(np.full(count, 1.0 / count), mean, np.tile(covariance, (count, 1, 1)))
        stamp = first.stamp
        for measurement in measurements[1:]:
            gap = measurement.stamp - stamp
            predicted = belief.mixed(self._modes, gap).propagated(self._modes, gap)
            innovation = predicted.innovation(measurement.pose, measurement.covariance)
            belief, stamp = predicted.updated(innovation, measurement.covariance), measurement.stamp
        self._belief, self._stamp, self._pending = belief.unwound(), stamp, []


def _motion_modes(config: PlanarKalmanConfig) -> MotionModes:
    def planar(noise: tuple[float, float]) -> list[float]:
        return [noise[0], noise[0], noise[1]]

    # A resting object has no velocity; the small one allowed keeps the covariance positive definite.
    still = [(0.002, 0.002, 0.01)]
    return MotionModes(
        keeps_velocity=np.array([0.0, 1.0, 1.0]),
        position_noise=np.array([planar(config.rest_drift), [0.0] * 3, [0.0] * 3]),
        velocity_noise=np.array([*still, planar(config.steady_noise), planar(config.manoeuvre_noise)]),
        dwell=np.array(config.dwell),
    )


def _object_state(stamp: float, belief: ModeBelief) -> ObjectState:
    mean, covariance = belief.moments()
    mean[2] = wrap_angle(mean[2])
    return ObjectState(stamp, mean[:3], mean[3:], covariance)
