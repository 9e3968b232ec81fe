"""The trajectory that everything else evaluates: piecewise polynomials in time, with exact extrema."""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory.interpolation import hermite_coefficients
from vpsto_ros.trajectory.polynomials import (
    SIZE,
    evaluate_many,
    evaluate_one,
    evaluate_state,
    extrema_kernel,
    shifted_origin,
)
from vpsto_ros.trajectory.timing import Limits

_JOIN_TOLERANCE = 1e-9
_QUANTITIES = ("position", "velocity", "acceleration")


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """Piecewise polynomial of degree <= 5 in time for n degrees of freedom; immutable.

    Before its start and after its end the boundary position is held and derivatives are zero. Times are plain
    seconds: count them from the start of a run, since doubles resolve only 2e-7 s at the size of Unix time,
        which shifts the ends of segments by that much.

    Args:
        times: (S + 1,) strictly increasing knots [s].
        coefficients: (S, 6, n) coefficients of c_0 + c_1 tau + .. + c_5 tau^5 with tau = t - times[i].

    Raises:
        InvalidInputError: if shapes do not fit, entries are not finite or times do not increase strictly.
    """

    times: NDArray[np.float64]
    coefficients: NDArray[np.float64]

    def __post_init__(self) -> None:
        times, coefficients = _frozen(self.times), _frozen(self.coefficients)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "coefficients", coefficients)
        if times.ndim != 1 or times.size < 2:
            raise InvalidInputError(f"times must hold at least two knots, got shape {times.shape}")
        if (
            coefficients.ndim != 3
            or coefficients.shape[:2] != (times.size - 1, SIZE)
            or coefficients.shape[2] == 0
        ):
            raise InvalidInputError(
                f"coefficients must have shape ({times.size - 1}, {SIZE}, n) for {times.size} knots, "
                f"got {coefficients.shape}"
            )
        if not (np.isfinite(times).all() and np.isfinite(coefficients).all()):
            raise InvalidInputError("times and coefficients must be finite")
        if not (times[1:] > times[:-1]).all():
            raise InvalidInputError("times must increase strictly")

    def __repr__(self) -> str:
        """In a line; the coefficients of an arm's motion fill a screen."""
        span = f"{self.start_time:g} s to {self.end_time:g} s"
        return f"Trajectory({self.dof} degrees of freedom, {span}, {self.times.size - 1} segments)"

    @classmethod
    def from_points(
        cls,
        times: ArrayLike,
        positions: ArrayLike,
        velocities: ArrayLike | None = None,
        accelerations: ArrayLike | None = None,
    ) -> "Trajectory":
        """Interpolate points as a joint_trajectory_controller does.

        Quintic on segments whose both ends have accelerations, cubic Hermite on the others, linear if no
        velocities are given at all. Where the accelerations are those of the cubic to round-off, the cubic
        comes out exactly.

        Args:
            times: (P,) strictly increasing [s], P >= 2.
            positions: (P, n).
            velocities: (P, n) or None.
            accelerations: (P, n) or None; a row of NaN stands for a point without accelerations.

        Raises:
            InvalidInputError: if shapes do not fit, or accelerations come without velocities.
        """
        times = np.array(times, dtype=np.float64)
        return cls(times, hermite_coefficients(times, positions, velocities, accelerations))

    @property
    def start_time(self) -> float:
        """First instant [s]."""
        return float(self.times[0])

    @property
    def end_time(self) -> float:
        """Last instant [s]."""
        return float(self.times[-1])

    @property
    def duration(self) -> float:
        """Length in time [s]."""
        return float(self.times[-1] - self.times[0])

    @property
    def dof(self) -> int:
        """Number n of degrees of freedom."""
        return self.coefficients.shape[2]

    def __call__(self, t: float | ArrayLike, order: int = 0) -> NDArray[np.float64]:
        """Position (order 0) or its time derivative of order 1 to 5.

        Args:
            t: one time [s] or (K,) times.
            order: derivative; right-continuous at the knots, at the end from the left.

        Returns:
            (n,) for one time, (K, n) for several.

        Raises:
            InvalidInputError: if a time is NaN, has more than one axis, or the order is outside 0..5.
        """
        if order not in (0, 1, 2, 3, 4, 5):
            raise InvalidInputError(f"order must be from 0 to 5, got {order}")
        if isinstance(t, float | int) or np.ndim(t) == 0:
            return evaluate_one(self.times, self.coefficients, _checked_time(t), order)
        ts = np.array(t, dtype=np.float64)
        if ts.ndim != 1 or np.isnan(ts).any():
            raise InvalidInputError("times to evaluate must be a vector without NaN")
        return evaluate_many(self.times, self.coefficients, ts, order)

    def state(self, t: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Position, velocity and acceleration, each (n,), at one time; made for control loops."""
        position, velocity, acceleration = evaluate_state(self.times, self.coefficients, _checked_time(t))
        return position, velocity, acceleration

    def knots(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Position, velocity and acceleration (S + 1, n) at the knots; the last from the left."""
        return self(self.times, 0), self(self.times, 1), self(self.times, 2)

    def extrema(self, order: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Least and greatest value (n,) of a derivative over all instants, exact to round-off.

        Order 0 is position, 1 velocity, 2 acceleration.

        Raises:
            InvalidInputError: if the order is not 0, 1 or 2.
        """
        if order not in (0, 1, 2):
            raise InvalidInputError(f"order must be 0, 1 or 2, got {order}")
        lower, upper = extrema_kernel(self.times, self.coefficients, order)
        return lower, upper

    def jumps(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Largest discontinuity (n,) of position and of velocity at the inner knots.

        :meth:`violations` looks at the pieces between the knots; a step from one piece to the next shows
        here.
        """
        after = self.knots()
        size = np.diff(self.times)[:, None]
        c = self.coefficients
        position, velocity = np.zeros_like(size * c[:, 0]), np.zeros_like(size * c[:, 0])
        for k in range(SIZE - 1, -1, -1):
            velocity = velocity * size + position
            position = position * size + c[:, k]
        steps = (np.abs(after[0][1:-1] - position[:-1]), np.abs(after[1][1:-1] - velocity[:-1]))
        return steps[0].max(axis=0, initial=0.0), steps[1].max(axis=0, initial=0.0)

    def violations(self, limits: Limits, relative_tolerance: float = 1e-9) -> list[str]:
        """Which limits are exceeded at any instant, in words, such as "velocity of joint 3: 2.7 > 2.62".

        Joints count from 1. The tolerance is relative to the limit, for positions to max(1, |limit|).

        Raises:
            InvalidInputError: if the limits are for another number of degrees of freedom.
        """
        if limits.dof != self.dof:
            raise InvalidInputError(
                f"limits are for {limits.dof} degrees of freedom, the trajectory has {self.dof}"
            )
        found: list[str] = []
        ranges = (
            (limits.lower, limits.upper),
            (-limits.velocity, limits.velocity),
            (
                -limits.acceleration,
                limits.acceleration,
            ),
        )
        for order, (least, most) in enumerate(ranges):
            if least is None and most is None:
                continue
            lower, upper = self.extrema(order)
            found += _excesses(_QUANTITIES[order], lower, least, relative_tolerance, order == 0, below=True)
            found += _excesses(_QUANTITIES[order], upper, most, relative_tolerance, order == 0, below=False)
        return found

    def clipped(self, start: float, end: float) -> "Trajectory":
        """The same motion from start to end [s]; beyond the original, the boundary position is held.

        Raises:
            InvalidInputError: if start is not before end.
        """
        if not start < end:
            raise InvalidInputError(f"clipping needs start < end, got {start} and {end}")
        times, pieces = [float(start)], []
        # A knot at the very start or end, but for round-off, would leave a sliver of 1e-16 s.
        sliver = min(_JOIN_TOLERANCE, 0.25 * (end - start))
        inner = self.times[(self.times > start + sliver) & (self.times < end - sliver)]
        for stop in (*inner, end):
            begin = times[-1]
            times.append(float(stop))
            pieces.append(self._piece(begin, stop))
        return Trajectory(np.array(times), np.array(pieces))

    def _piece(self, begin: float, stop: float) -> NDArray[np.float64]:
        """Coefficients (6, n) from begin to stop, which no knot separates but for round-off."""
        middle = 0.5 * (begin + stop)
        if middle <= self.times[0] or middle >= self.times[-1]:
            piece = np.zeros((SIZE, self.dof))
            piece[0] = self(begin)
            return piece
        segment = int(np.searchsorted(self.times, middle, side="right")) - 1
        return shifted_origin(self.coefficients[segment], begin - self.times[segment])

    def followed_by(self, other: "Trajectory") -> "Trajectory":
        """This trajectory, then the other one, which must start where this one ends in time (within 1e-9 s).

        Steps in position or velocity at the join are kept; see :meth:`jumps`.

        Raises:
            InvalidInputError: if the times do not join or the degrees of freedom differ.
        """
        if other.dof != self.dof:
            raise InvalidInputError(
                f"cannot join trajectories of {self.dof} and {other.dof} degrees of freedom"
            )
        if abs(other.start_time - self.end_time) > _JOIN_TOLERANCE:
            raise InvalidInputError(
                f"the second trajectory starts at {other.start_time:.9f} s, the first ends at "
                f"{self.end_time:.9f} s; shift or clip one of them so that they join"
            )
        return Trajectory(
            np.concatenate([self.times, other.times[1:]]),
            np.concatenate([self.coefficients, other.coefficients]),
        )

    def shifted(self, dt: float) -> "Trajectory":
        """The same motion, dt seconds later."""
        return Trajectory(self.times + dt, self.coefficients)


def _checked_time(t: Any) -> float:
    t = float(t)
    if t != t:
        raise InvalidInputError("the time to evaluate must not be NaN")
    return t


def _frozen(values: ArrayLike) -> NDArray[np.float64]:
    """A read-only C-contiguous array, copied unless it is one already: no caller can change it later."""
    array = np.asarray(values)
    if array.flags.writeable or not array.flags.c_contiguous or array.dtype != np.float64:
        array = np.array(values, dtype=np.float64, order="C")
        array.setflags(write=False)
    return array


def _excesses(
    quantity: str, values: NDArray, limit: NDArray | None, tolerance: float, absolute: bool, *, below: bool
) -> list[str]:
    if limit is None:
        return []
    scale = np.maximum(np.abs(limit), 1.0) if absolute else np.abs(limit)
    excess = limit - values if below else values - limit
    sign = "<" if below else ">"
    return [
        f"{quantity} of joint {j + 1}: {values[j]:.9g} {sign} {limit[j]:.9g}"
        for j in np.flatnonzero(excess > tolerance * scale)
    ]
