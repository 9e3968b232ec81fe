"""The piecewise-linear Kalman filter of a puck (5.2.3): floating, off walls and off the mallet.

The mode is detected between two measurements, from the estimated state and the motion of the mallet, and
every contact is resolved at its time (:mod:`vpsto_ros.estimation.puck_motion`). Frame: the table's, origin in
its centre, x towards the goal that is shot at.
"""

import dataclasses
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.contact.puck import PuckModel
from vpsto_ros.estimation.measurement import Outcome, finite_array
from vpsto_ros.estimation.particle_filter_config import FilterStatus
from vpsto_ros.estimation.puck_motion import ContactTiming, MalletTrack, PuckBelief, PuckMotion
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError

_DENT_SHARE = 0.3  # of the depth that is expected of a dent: how well it is known
_LEAST_STD = 1e-6  # no position is measured better [m]
_GOAL_DEPTH = 0.2  # a puck that is seen in a goal is no farther behind its line [m]


@documented
@dataclasses.dataclass(frozen=True)
class PuckFilterConfig:
    """Options of the filter.

    Raises:
        ConfigurationError: a value is out of range; the message names what is allowed.
    """

    position_std: float = option(
        5e-7**0.5, "standard deviation of measured positions that come without one", unit="m", minimum=1e-6,
        maximum=0.1,
    )  # fmt: skip
    velocity_std: float = option(
        0.02, "likewise of measured velocities", unit="m/s", minimum=1e-6, maximum=10.0
    )
    gate: float = option(
        25.0, "squared Mahalanobis distance beyond which a position is an outlier", minimum=1.0, maximum=1e6
    )
    confirmations: int = option(
        3, "consecutive outliers that agree with each other and restart the filter", minimum=1, maximum=100
    )
    max_speed: float = option(
        5.0, "speed up to which outliers agree; half of it is what a new puck may have", unit="m/s",
        minimum=1e-3, maximum=100.0,
    )  # fmt: skip
    max_gap: float = option(
        0.5, "time unseen after which the puck is lost and the next position starts anew; a stamp that is so"
        " much older than the last one is refused", unit="s", minimum=0.01, maximum=60.0,
    )  # fmt: skip
    max_jump: float = option(
        5.0, "a stamp so much later than the last one is refused until others agree", unit="s", minimum=0.01,
        maximum=1e6,
    )  # fmt: skip
    margin: float = option(
        0.02, "how far beyond the rims a puck can be measured", unit="m", minimum=0.0, maximum=1.0
    )
    max_prediction: float = option(
        5.0, "how far ahead of the last position states are predicted", unit="s", minimum=0.0, maximum=60.0
    )
    wall_contact: tuple[float, float] = option(
        (0.002, 0.0001), "how long contacts with walls last, mean and standard deviation; 0 is at once",
        unit="s", minimum=0.0, maximum=0.1,
    )  # fmt: skip
    mallet_contact: tuple[float, float] = option(
        (0.0185, 0.001), "and likewise with the mallet", unit="s", minimum=0.0, maximum=0.1
    )
    mallet_extrapolation: float = option(
        0.05, "how long the mallet is taken to move on evenly after its last state", unit="s", minimum=0.0,
        maximum=1.0,
    )  # fmt: skip

    def __post_init__(self) -> None:
        validate(self)
        if self.max_jump < self.max_gap:
            raise ConfigurationError(
                f"max_jump = {self.max_jump} must not be smaller than max_gap = {self.max_gap}"
            )


@dataclasses.dataclass(frozen=True)
class PuckState:
    """An estimate.

    Attributes:
        stamp: when [s].
        mean: x, y, vx, vy, table frame, shape (4,) [m, m/s]; in a contact, the velocity is the one after it.
        covariance: symmetric positive definite, shape (4, 4).
        contacts: walls and mallets met since the filter began.
        touching: "wall" or "mallet" while a contact is expected to last, else empty.
    """

    stamp: float
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    contacts: int
    touching: str


@dataclasses.dataclass(frozen=True)
class _Sighting:
    stamp: float
    position: NDArray[np.float64]
    noise: NDArray[np.float64]


class PuckFilter:
    """Estimates position and velocity of a puck from stamped positions, and predicts both.

    Feed every measured position to :meth:`update` in the order of their stamps, and the mallet's states to
    :meth:`observe_mallet`, those up to the stamp of a position before it; ask :meth:`state` for the state at
    any later time. Nothing that a camera or a robot delivers raises: the outcome says what was wrong with it,
    and the estimate is left as it was.

    Attributes:
        model: the learned dynamics.
        config: options.
        distance: squared Mahalanobis distance of the last position that was compared with its prediction, or
            None.
    """

    def __init__(self, model: PuckModel, config: PuckFilterConfig | None = None) -> None:
        """Begin without a puck."""
        self.model, self.config = model, config or PuckFilterConfig()
        self._mallet = MalletTrack(self.config.max_gap + 1.0, self.config.mallet_extrapolation)
        wall, mallet = ContactTiming(*self.config.wall_contact), ContactTiming(*self.config.mallet_contact)
        self._motion = PuckMotion(model, wall, mallet, self._mallet)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._mallet.clear()
        self._belief: PuckBelief | None = None
        self._pending: list[_Sighting] = []
        self.distance: float | None = None

    def warm_up(self) -> None:
        """Compile whatever estimates use: let an imaginary puck rest, be hit and bounce; then forget it."""
        reach = self.model.table.contact_distance
        for stamp in 0.01 * np.arange(12):
            self.observe_mallet(float(stamp), np.array([-reach - 0.01, 0.0]), np.array([0.5, 0.0]))
            self.update(float(stamp), np.array([-0.2 * stamp, 0.0]))
        self.state(1.0)
        self.reset()

    def update(self, stamp: float, position: ArrayLike, covariance: ArrayLike | None = None) -> Outcome:
        """Take in a measured position.

        Args:
            stamp: when it was measured [s].
            position: x, y in the table's frame, shape (2,) [m].
            covariance: of the position, shape (2, 2); that of the configuration if None.

        Returns:
            "accepted"; "outlier" (too unlikely; ignored unless the following ones agree with it);
            "reinitialized" (the estimate now starts from this and the preceding outliers, or from this
            position after a long gap); "stale" (not newer than what is known) or "invalid: reason". The
            attribute ``reason`` explains.
        """
        self.distance = None
        noise = self.config.position_std**2 * np.eye(2) if covariance is None else covariance
        sighting, defect = _checked(stamp, position, noise)
        defect = defect or self._objection(sighting.position)
        if defect:
            return Outcome("invalid", defect)
        if self._belief is None:
            self._restart([sighting])
            return Outcome("accepted", "first position")
        return self._place(self._belief, sighting)

    def observe_velocity(self, velocity: ArrayLike, covariance: ArrayLike | None = None) -> Outcome:
        """Take in a velocity that was measured together with the last accepted position.

        Args:
            velocity: vx, vy in the table's frame, shape (2,) [m/s].
            covariance: of it, shape (2, 2); that of the configuration if None.

        Returns:
            "accepted"; "outlier" (too unlikely, or while a contact lasts, which changes it); "stale" (no
            position is known) or "invalid: reason".
        """
        noise = self.config.velocity_std**2 * np.eye(2) if covariance is None else covariance
        sighting, defect = _checked(0.0, velocity, noise, "velocity")
        if defect:
            return Outcome("invalid", defect)
        if self._belief is None:
            return Outcome("stale", "no position is known")
        if self._belief.touch is not None:
            return Outcome("outlier", "a contact is under way")
        corrected, distance = _corrected(self._belief, sighting, first=2)
        if not distance <= self.config.gate:
            return Outcome("outlier", f"squared Mahalanobis distance {distance:.3g} > {self.config.gate:g}")
        self._belief = corrected
        return Outcome("accepted")

    def observe_mallet(self, stamp: float, position: ArrayLike, velocity: ArrayLike) -> Outcome:
        """Take in a state of the mallet.

        Args:
            stamp: when it was measured [s].
            position: x, y of its centre in the table's frame, shape (2,) [m].
            velocity: likewise [m/s].

        Returns:
            "accepted"; "stale" (not newer than the last one) or "invalid: reason".
        """
        state, defect = finite_array([stamp, *_entries(position), *_entries(velocity)], (5,))
        if defect:
            return Outcome("invalid", f"time, position (2,) and velocity (2,) of the mallet: {defect}")
        if np.abs(state[3:]).max() > 2.0 * self.config.max_speed:
            return Outcome("invalid", f"a mallet at {np.abs(state[3:]).max():.3g} m/s")
        ahead = state[0] - self._mallet.last
        if -self.config.max_gap < ahead <= 0.0:
            return Outcome("stale", f"stamp is {-ahead:.4g} s older than the last one")
        if ahead <= 0.0:  # a clock that was set back
            self._mallet.clear()
        self._mallet.append(float(state[0]), state[1:])
        return Outcome("accepted")

    def state(self, time: float) -> PuckState | None:
        """State at a time [s], through walls and mallet, without changing the filter; None before the first.

        A time before the last accepted position gives the state at that position. A puck that passes a goal
        line stays there. The mallet is taken to move on evenly for a moment, and then to be nowhere.

        Raises:
            InvalidInputError: the time is not finite.
        """
        if not math.isfinite(time):
            raise InvalidInputError(f"cannot predict to time {time!r}")
        belief = self._belief
        if belief is None:
            return None
        latest = belief.stamp + self.config.max_prediction
        belief = self._motion.advance(belief, min(time, latest), stops=True)
        touching = belief.touch.surface if belief.touch is not None else ""
        mean, covariance = belief.mean.copy(), belief.covariance.copy()
        return PuckState(belief.stamp, mean, covariance, belief.contacts, touching)

    def status(self, time: float) -> FilterStatus:
        """How the filter is doing at a time [s]."""
        if self._belief is None:
            return FilterStatus("uninitialised", "no puck has been seen yet")
        if self._motion.left(self._belief):
            end = "far" if self._belief.mean[0] > 0.0 else "near"
            return FilterStatus("lost", f"the puck has left the table through the {end} goal")
        unseen = time - self._belief.stamp
        if not unseen <= self.config.max_gap:
            return FilterStatus("lost", f"not seen for {unseen:.2g} s")
        if self._pending:
            return FilterStatus("recovering", f"{len(self._pending)} positions contradict the estimate")
        if time - self._mallet.last > self.config.mallet_extrapolation:
            return FilterStatus("tracking", "the state of the mallet is not known; hits will not be foreseen")
        return FilterStatus("tracking", "")

    def _objection(self, position: NDArray) -> str:
        """Why no puck can be at a position (2,), else empty."""
        table, margin = self.model.table, self.config.margin
        beyond = np.abs(position) - table.reach
        in_goal = abs(position[0]) <= table.half_length + _GOAL_DEPTH and beyond[1] < 0.0 and (
            abs(position[1]) <= 0.5 * table.goal_width
        )  # fmt: skip
        if in_goal or beyond.max() <= margin:
            return ""
        return f"the puck at ({position[0]:.3f}, {position[1]:.3f}) m is outside the table"

    def _place(self, belief: PuckBelief, sighting: _Sighting) -> Outcome:
        """Sort a position by its stamp."""
        gap = sighting.stamp - belief.stamp
        if not -self.config.max_gap <= gap <= self.config.max_jump:
            return self._pend(sighting, "invalid", f"stamp jumps by {gap:.3g} s")
        if gap <= 0.0:
            return Outcome("stale", f"stamp is {-gap:.4g} s older than the last accepted one")
        if gap > self.config.max_gap:
            self._restart([sighting])
            return Outcome("reinitialized", f"first position after {gap:.3g} s")
        predicted = self._motion.advance(belief, sighting.stamp)
        if not np.diag(predicted.covariance)[2:].max() < (4.0 * self.config.max_speed) ** 2:
            self._restart([sighting])
            return Outcome("reinitialized", "contacts have left nothing known of the velocity")
        corrected, self.distance = _corrected(predicted, sighting)
        if not self.distance <= self.config.gate:
            reason = f"squared Mahalanobis distance {self.distance:.3g} > {self.config.gate:g}"
            return self._pend(sighting, "outlier", reason)
        self._belief, self._pending = corrected, []
        return Outcome("accepted")

    def _pend(self, sighting: _Sighting, kind: str, reason: str) -> Outcome:
        """Keep what was refused; enough of it in agreement means that the filter is wrong, not the camera."""
        if self._pending and not self._agree(self._pending[-1], sighting):
            self._pending = []
        self._pending.append(sighting)
        count = len(self._pending)
        if count < self.config.confirmations:
            return Outcome(kind, reason)
        self._restart(self._pending)
        return Outcome("reinitialized", f"{count} consecutive outliers agree")

    def _agree(self, first: _Sighting, second: _Sighting) -> bool:
        gap = second.stamp - first.stamp
        noise = math.sqrt(float(np.trace(first.noise + second.noise)))
        apart = math.hypot(*(second.position - first.position))
        return 0.0 < gap <= self.config.max_gap and apart <= self.config.max_speed * gap + 4.0 * noise

    def _restart(self, sightings: list[_Sighting]) -> None:
        """Begin at the first of some positions and replay the others, which tell the velocity."""
        first = sightings[0]
        covariance = np.zeros((4, 4))
        covariance[:2, :2] = first.noise
        covariance[2:, 2:] = (0.5 * self.config.max_speed) ** 2 * np.eye(2)
        contacts = self._belief.contacts if self._belief is not None else 0
        belief = PuckBelief(first.stamp, np.append(first.position, [0.0, 0.0]), covariance, None, contacts)
        for sighting in sightings[1:]:
            belief, _ = _corrected(self._motion.advance(belief, sighting.stamp), sighting)
        self._belief, self._pending = belief, []


def _corrected(belief: PuckBelief, sighting: _Sighting, first: int = 0) -> tuple[PuckBelief, float]:
    """The belief after a measured position, and how far off that was (squared Mahalanobis distance).

    With `first` = 2 it is a velocity that was measured.
    """
    seen = slice(first, first + 2)
    expected, noise = belief.mean[seen], sighting.noise
    if belief.touch is not None:
        dent = belief.touch.dent(belief.stamp)
        share = _DENT_SHARE * belief.touch.depth * belief.touch.normal
        expected, noise = expected + dent, noise + np.outer(share, share)
    innovation = sighting.position - expected
    inverse = np.linalg.inv(belief.covariance[seen, seen] + noise)
    gain = belief.covariance[:, seen] @ inverse
    # Joseph's form stays positive definite whatever the rounding.
    a = np.eye(4)
    a[:, seen] -= gain
    spread = a @ belief.covariance @ a.T + gain @ noise @ gain.T
    mean = belief.mean + gain @ innovation
    corrected = dataclasses.replace(belief, mean=mean, covariance=0.5 * (spread + spread.T))
    return corrected, float(innovation @ inverse @ innovation)


def _checked(
    stamp: object, measured: object, covariance: object, name: str = "position"
) -> tuple[_Sighting, str]:
    """A measured position or velocity as numbers, and what is wrong with it."""
    time, first = finite_array(stamp, ())
    where, second = finite_array(measured, (2,))
    noise, third = finite_array(covariance, (2, 2))
    defects = zip(("stamp", name, "covariance"), (first, second, third), strict=True)
    defect = "; ".join(f"{part}: {text}" for part, text in defects if text)
    if not defect:
        skew = abs(noise[0, 1] - noise[1, 0]) > 1e-6 * np.abs(noise).max()
        if skew or np.linalg.eigvalsh(noise)[0] < (1.0 - 1e-6) * _LEAST_STD**2:
            unit = "m" if name == "position" else "m/s"
            defect = f"covariance: not symmetric positive definite with at least {_LEAST_STD:g} {unit}"
    return _Sighting(float(time) if time.shape == () else math.nan, where, noise), defect


def _entries(values: object) -> list:
    """The entries of something that should be a vector (2,); too many or few are found out later."""
    array, defect = finite_array(values, (2,))
    return [math.nan] * 2 if defect else array.tolist()
