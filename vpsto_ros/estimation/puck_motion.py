"""How the belief about a puck moves on: floating, off walls and off the mallet, each met at its time.

The learned modes are those of :class:`vpsto_ros.contact.puck.PuckModel`; contacts are not over at once, and
during one the puck stays with what it touches. The model's delay of hits, which stands for the same, is
therefore left out. Frame: the table's, origin in its centre.
"""

import bisect
import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.contact import puck_modes
from vpsto_ros.contact.puck import PuckModel

_TINY = 1e-9  # shorter times are none [s]
_NEAR_STEP = 0.005  # for so long the mallet is taken to move evenly when the puck is near it [s]
_MOST_CONTACTS = 16  # in one prediction; a puck that is squeezed has no end of them


@dataclasses.dataclass(frozen=True)
class ContactTiming:
    """How long contacts last.

    Attributes:
        duration: mean [s].
        std: standard deviation [s].
    """

    duration: float
    std: float


@dataclasses.dataclass(frozen=True, eq=False)
class Touch:
    """A contact under way.

    Attributes:
        surface: "wall" or "mallet".
        begun, ends: when it began and is expected to end [s].
        normal: from what is touched to the puck, shape (2,).
        velocity: of what is touched, along the normal, and half of what the contact takes from the puck's
            tangential velocity, which changes on the way: shape (2,) [m/s].
        depth: how far the puck dents it at most [m].
        scatter: standard deviation of the position along the normal at the end [m].
    """

    surface: str
    begun: float
    ends: float
    normal: NDArray[np.float64]
    velocity: NDArray[np.float64]
    depth: float
    scatter: float

    def dent(self, stamp: float) -> NDArray[np.float64]:
        """Where the puck is besides where it touched first, half a swing of a spring, shape (2,) [m]."""
        phase = (stamp - self.begun) / (self.ends - self.begun)
        return -self.depth * math.sin(math.pi * min(max(phase, 0.0), 1.0)) * self.normal


@dataclasses.dataclass(frozen=True, eq=False)
class PuckBelief:
    """A Gaussian over (x, y, vx, vy).

    Attributes:
        stamp: when [s].
        mean: shape (4,) [m, m/s]; in a contact, the velocity is the one after it.
        covariance: shape (4, 4).
        touch: the contact under way, if any.
        contacts: walls and mallets met since the filter began.
    """

    stamp: float
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    touch: Touch | None = None
    contacts: int = 0


class MalletTrack:
    """Measured states of the mallet, interpolated."""

    def __init__(self, kept: float, extrapolation: float, longest_gap: float = 0.1) -> None:
        """Begin without any.

        Args:
            kept: for how long they are kept [s].
            extrapolation: how long the mallet is taken to move on evenly after the last one [s].
            longest_gap: between two of them; in a longer one the mallet is nowhere [s].
        """
        self._kept, self._extrapolation, self._longest_gap = kept, extrapolation, longest_gap
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._stamps: list[float] = []
        self._states: list[NDArray[np.float64]] = []

    @property
    def last(self) -> float:
        """Stamp of the last one [s], -inf before the first."""
        return self._stamps[-1] if self._stamps else -math.inf

    def append(self, stamp: float, state: NDArray[np.float64]) -> None:
        """Take in a state (4,), later than the last one."""
        self._stamps.append(stamp)
        self._states.append(state)
        if self._stamps[0] < stamp - 2.0 * self._kept:
            first = bisect.bisect_left(self._stamps, stamp - self._kept)
            del self._stamps[:first], self._states[:first]

    def at(self, stamp: float) -> NDArray[np.float64] | None:
        """State (4,) at a time, None where it is not known."""
        k = bisect.bisect_right(self._stamps, stamp)
        if k == 0:
            return None
        before, state = self._stamps[k - 1], self._states[k - 1]
        gap = stamp - before
        if k == len(self._stamps):
            return _evenly(state, gap) if gap <= self._extrapolation else None
        step = self._stamps[k] - before
        return None if step > self._longest_gap else _cubic(state, self._states[k], step, gap / step)


class PuckMotion:
    """Moves beliefs on by the learned model."""

    def __init__(
        self, model: PuckModel, wall: ContactTiming, mallet: ContactTiming, track: MalletTrack
    ) -> None:
        """Bind model, timing of contacts and the motion of the mallet."""
        self._model, self._rows, self._track = model, model.kernel_rows, track
        self._timing = {"wall": wall, "mallet": mallet}

    def advance(self, belief: PuckBelief, stamp: float, *, stops: bool = False) -> PuckBelief:
        """The belief at a later time [s].

        Args:
            belief: to move on.
            stamp: until when [s]; before that of the belief, nothing happens.
            stops: a puck that has passed a goal line stays where it is instead of going on behind it.
        """
        first = belief.contacts
        while stamp - belief.stamp > _TINY and not (stops and self.left(belief)):
            if belief.touch is not None:
                belief = self._touching(belief, belief.touch, stamp)
            else:
                belief = self._free(belief, stamp, belief.contacts - first < _MOST_CONTACTS)
        return dataclasses.replace(belief, stamp=max(stamp, belief.stamp))

    def left(self, belief: PuckBelief) -> bool:
        """Whether the puck has passed a goal line."""
        return bool(abs(belief.mean[0]) > self._model.table.half_length)

    def _free(self, belief: PuckBelief, stamp: float, meets: bool) -> PuckBelief:
        """To the next contact, but at most a step."""
        mallet = self._track.at(belief.stamp) if meets else None
        duration = min(stamp - belief.stamp, self._model.period)
        if mallet is not None and self._near(belief.mean, mallet, duration):
            duration = min(duration, _NEAR_STEP)
        x, y, vx, vy = belief.mean
        wall, axis, side = puck_modes.next_wall(self._rows, x, y, vx, vy, duration)
        hit = math.inf if mallet is None else hit_time(
            belief.mean - mallet, self._model.table.contact_distance
        )  # fmt: skip
        if hit <= wall:
            return self._hit(self._moved(belief, hit) if hit > 0.0 else belief)
        if axis >= 0 and meets:
            return self._bounce(belief, wall, axis, side)
        return self._moved(belief, duration)

    def _near(self, puck: NDArray, mallet: NDArray, duration: float) -> bool:
        """Whether they could meet in a duration, with 2 cm to spare."""
        apart = math.hypot(*(puck - mallet)[:2]) - self._model.table.contact_distance
        return apart < duration * math.hypot(*(puck - mallet)[2:]) + 0.02

    def _moved(self, belief: PuckBelief, duration: float) -> PuckBelief:
        mean, covariance = belief.mean.copy(), belief.covariance.copy()
        puck_modes.step(self._rows, duration / self._model.period, mean, covariance)
        return PuckBelief(belief.stamp + duration, mean, covariance, None, belief.contacts)

    def _bounce(self, belief: PuckBelief, time: float, axis: int, side: float) -> PuckBelief:
        """Meet a wall after a time; the model shifts that time by what the state is off."""
        met = self._moved(belief, time * (1.0 + 1e-12) + 1e-12)
        normal = np.zeros(2)
        normal[axis] = -side
        return self._begin("wall", met, belief.mean[2:], normal, np.zeros(2))

    def _hit(self, belief: PuckBelief) -> PuckBelief:
        """Be hit by the mallet now, (5.3), as the mean is; other states are hit otherwise, to first order."""
        mallet = self._track.at(belief.stamp)
        if mallet is None:  # it was seen to come, but is not known at that time
            return belief
        normal = _unit(belief.mean[:2] - mallet[:2])
        mean, covariance = belief.mean.copy(), belief.covariance.copy()
        puck_modes.hits(self._rows, 0.0, mallet[None], mean[None], covariance[None])
        met = dataclasses.replace(belief, mean=mean, covariance=covariance)
        return self._begin("mallet", met, belief.mean[2:], normal, self._mean_velocity(belief.stamp, mallet))

    def _mean_velocity(self, stamp: float, mallet: NDArray) -> NDArray[np.float64]:
        """Of the mallet in a contact that begins now, shape (2,), as far as its motion is known."""
        duration = self._timing["mallet"].duration
        later = self._track.at(stamp + duration) if duration > 0.0 else None
        return mallet[2:] if later is None else (later[:2] - mallet[:2]) / duration

    def _begin(
        self, surface: str, met: PuckBelief, before: NDArray, normal: NDArray, velocity: NDArray
    ) -> PuckBelief:
        """A contact that has just been met, with the velocity after it; it leaves what it touches.

        Args:
            surface: what is met.
            met: the belief with the velocity after the contact.
            before: velocity of the puck before it (2,).
            normal: of the contact (2,).
            velocity: of what is met (2,).
        """
        leaving = float(normal @ (met.mean[2:] - velocity))
        closing, apart = max(float(normal @ (velocity - before)), 0.0), max(leaving, 0.0)
        mean, timing = met.mean.copy(), self._timing[surface]
        if leaving < 0.0:
            mean[2:] -= leaving * normal
        touch = None
        if timing.duration > 0.0:
            change = 0.5 * (before - mean[2:])
            carried = (normal @ velocity) * normal + change - (normal @ change) * normal
            # A spring that gives back a share e of the speed is dented by about sqrt(e) v T / pi.
            depth = math.sqrt(closing * apart) * timing.duration / math.pi
            ends = met.stamp + timing.duration
            touch = Touch(surface, met.stamp, ends, normal, carried, depth, timing.std * apart)
        return PuckBelief(met.stamp, mean, met.covariance, touch, met.contacts + 1)

    def _touching(self, belief: PuckBelief, touch: Touch, stamp: float) -> PuckBelief:
        """Stay with what is touched along the normal, and slide along the tangent."""
        until = min(stamp, touch.ends)
        duration, ended = until - belief.stamp, until >= touch.ends
        tangential = np.eye(2) - np.outer(touch.normal, touch.normal)
        a, mean = np.eye(4), belief.mean.copy()
        a[:2, 2:] = duration * tangential
        mean[:2] += duration * (tangential @ mean[2:] + touch.velocity)
        spread = a @ belief.covariance @ a.T
        if ended:
            spread[:2, :2] += touch.scatter**2 * np.outer(touch.normal, touch.normal)
        spread = 0.5 * (spread + spread.T)
        return PuckBelief(until, mean, spread, None if ended else touch, belief.contacts)


def hit_time(relative: NDArray, distance: float) -> float:
    """When centres come within a distance of each other, from the relative state (4,); inf if never [s]."""
    x, y, vx, vy = relative.tolist()
    b, c, square = x * vx + y * vy, x * x + y * y - distance**2, vx * vx + vy * vy
    apart = math.hypot(x, y)
    if apart < 1e-6 or -b < puck_modes.LEAST_CLOSING * apart:
        return math.inf
    if c <= 0.0:
        return 0.0
    root = b * b - square * c
    # The slower root of the quadratic cancels; this form does not.
    return c / (-b + math.sqrt(root)) if root > 0.0 else math.inf


def _unit(vector: NDArray) -> NDArray[np.float64]:
    return vector / math.hypot(*vector)


def _evenly(state: NDArray, time: float) -> NDArray[np.float64]:
    return np.concatenate([state[:2] + time * state[2:], state[2:]])


def _cubic(first: NDArray, second: NDArray, step: float, s: float) -> NDArray[np.float64]:
    """State at a share s of a step [s]: Hermite's cubic.

    The velocity is the one measured, interpolated: the rate of the cubic would be noisier than either end.
    """
    change = second[:2] - first[:2]
    start, end = step * first[2:], step * second[2:]
    two, three = 3.0 * change - 2.0 * start - end, start + end - 2.0 * change
    position = first[:2] + s * (start + s * (two + s * three))
    return np.concatenate([position, (1.0 - s) * first[2:] + s * second[2:]])
