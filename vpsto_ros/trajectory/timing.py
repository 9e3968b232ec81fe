"""Minimal duration in closed form, and the synthesis of many trajectories at once (section 3.2.1)."""

import dataclasses
import functools

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory.basis import OptimalBasis, hermite_weights, locate
from vpsto_ros.trajectory.kernels import MINIMUM_DURATION, durations_kernel, synthesis_kernel

__all__ = ["MINIMUM_DURATION", "Limits", "TrajectoryBatch", "minimal_duration", "synthesize_batch"]

POSITION_TOLERANCE = 1e-9
"""Excess over a position limit, relative to max(1, |limit|), that still counts as being on the limit."""


@dataclasses.dataclass(frozen=True, eq=False)
class Limits:
    """Symmetric velocity and acceleration limits, and the position range, of n degrees of freedom.

    Symmetric because only then a duration exists for every pair of boundary velocities within the limits: the
    element-wise bound (3.20) does not hold, only |q̇| <= max(|q̇_0|, |q̇_T|) does (see
    :func:`minimal_duration`).

    Args:
        velocity: (n,) largest |q̇| [rad/s or m/s], positive; infinite where there is no limit.
        acceleration: (n,) largest |q̈| [rad/s^2 or m/s^2], positive; infinite where there is no limit.
        lower: (n,) smallest position [rad or m], or None.
        upper: (n,) largest position [rad or m], or None.

    Raises:
        InvalidInputError: if shapes differ, a limit is not positive, or lower is not below upper.
    """

    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    lower: NDArray[np.float64] | None = None
    upper: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        for name in ("velocity", "acceleration", "lower", "upper"):
            value = getattr(self, name)
            if value is None and name in ("lower", "upper"):
                continue
            array = np.array(value, dtype=np.float64)
            if array.ndim != 1 or array.size == 0 or array.size != np.size(self.velocity):
                raise InvalidInputError(
                    f"limits: {name} must have one entry per degree of freedom, got {value!r}"
                )
            if np.any(np.isnan(array)):
                raise InvalidInputError(f"limits: {name} must not be NaN, got {value!r}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if np.any(self.velocity <= 0.0) or np.any(self.acceleration <= 0.0):
            raise InvalidInputError("limits: velocity and acceleration limits must be positive")
        if self.lower is not None and self.upper is not None and np.any(self.lower >= self.upper):
            raise InvalidInputError("limits: every lower position limit must be below the upper one")

    @property
    def dof(self) -> int:
        """Number n of degrees of freedom."""
        return self.velocity.size

    @functools.cached_property
    def position_range(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Smallest and largest position (n,) that count as within the limits; infinite without a limit.

        They are 1e-9 max(1, |limit|) wider than the limits, because round-off of a motion that ends on a
        limit is no violation; :meth:`vpsto_ros.trajectory.Trajectory.violations` allows the same.
        """
        unlimited = np.full(self.dof, np.inf)
        lower = -unlimited if self.lower is None else self.lower
        upper = unlimited if self.upper is None else self.upper
        slack = [POSITION_TOLERANCE * np.maximum(1.0, np.abs(limit)) for limit in (lower, upper)]
        return lower - slack[0], upper + slack[1]


@dataclasses.dataclass(frozen=True, eq=False)
class TrajectoryBatch:
    """B trajectories of minimal duration, sampled at K equally spaced phases from 0 to 1.

    Attributes:
        duration: (B,) minimal durations [s]; inf marks a row whose boundary velocities exceed the limits.
        position: (B, K, n); a row of infinite duration stands still at its first key position.
        velocity: (B, K, n) time derivatives, or None if not asked for.
        acceleration: (B, K, n), or None if not asked for.
        key_positions: (B, N + 2, n) what the trajectories pass through.
        knots: (N + 2,) phases of the key positions, from 0 to 1.
        knot_slopes: (B, N + 2, n) q'(s_i) with respect to phase, zero in a row of infinite duration. Between
            two knots q is the cubic with these values and slopes at its ends, so that with the duration the
            whole trajectory is known, not just its samples.
    """

    duration: NDArray[np.float64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64] | None
    acceleration: NDArray[np.float64] | None
    key_positions: NDArray[np.float64]
    knots: NDArray[np.float64]
    knot_slopes: NDArray[np.float64]

    def positions_at(self, phases: NDArray[np.float64], rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Positions (R, K', n) of some rows (R,) at other phases (K',) in [0, 1]."""
        segment = np.clip(np.searchsorted(self.knots, phases, side="right") - 1, 0, self.knots.size - 2)
        h = np.diff(self.knots)[segment]
        u = (phases - self.knots[segment]) / h
        left, right, out, back = (weight[:, None] for weight in hermite_weights(u, h, 0))
        keys, slopes = self.key_positions[rows], self.knot_slopes[rows]
        position = left * keys[:, segment] + right * keys[:, segment + 1]
        return position + out * slopes[:, segment] + back * slopes[:, segment + 1]

    def largest_slope(self) -> NDArray[np.float64]:
        """A bound (B,) on |q'(s)| of every degree of freedom, from the control points of the parabolas."""
        chord = np.diff(self.key_positions, axis=1) / np.diff(self.knots)[:, None]
        middle = 3.0 * chord - self.knot_slopes[:, :-1] - self.knot_slopes[:, 1:]
        return np.maximum(np.abs(middle).max(axis=(1, 2)), np.abs(self.knot_slopes).max(axis=(1, 2)))


def minimal_duration(
    basis: OptimalBasis,
    key_positions: ArrayLike,
    start_velocity: ArrayLike,
    end_velocity: ArrayLike,
    limits: Limits,
) -> NDArray[np.float64] | float:
    """The smallest duration above which every longer one is feasible (eqs. 3.16-3.26), in closed form.

    Velocity, at every instant: on a segment q̇(s; T) = alpha(s) / T + beta(s) with two quadratics, alpha from
    the key positions and beta from the boundary velocities. The limit ±v holds for all T >= sup_s ±alpha / (v
    ∓ beta) (eq. 3.21 with its sign corrected); the stationary points of that ratio solve a quadratic, so no
    grid of phases is needed. |beta| <= max(|q̇_0|, |q̇_T|) holds for every choice of phases: the slopes at
    inner knots are at most half of that by diagonal dominance, and between knots |(1-u)(1-3u)| + |u(3u-2)| <=
    1. Hence v ∓ beta > 0 inside, and 0/0 arises only where a boundary velocity is on the limit; its limit
    value is a ratio of slopes.

    Acceleration: q̈ = A / T^2 + B / T is linear in phase between knots, so the knots suffice; the largest
        root of each quadratic is taken (eq. 3.24 with w_q̇ in the linear term). Shorter isolated feasible
        durations can exist; they are passed over, as in the thesis, so that stretching a result never breaks
        a limit.

    Args:
        basis: optimal basis with N via-points.
        key_positions: (B, N + 2, n) or (N + 2, n), from q_0 to q_T.
        start_velocity: q̇_0 (n,) or (B, n) [1/s].
        end_velocity: q̇_T (n,) or (B, n) [1/s].
        limits: velocity and acceleration limits; position limits play no part here.

    Returns:
        (B,) durations, or one float for (N + 2, n) input [s]; inf where a boundary velocity exceeds its limit
        (by more than 1e-9 relative); at least MINIMUM_DURATION, which is what standing still takes.

    Raises:
        InvalidInputError: if shapes do not fit or an entry is not finite.
    """
    keys, start, end = _prepare(basis, key_positions, start_velocity, end_velocity, limits)
    duration = durations_kernel(
        basis.knots, basis.knot_slopes, keys, start, end, limits.velocity, limits.acceleration
    )
    return float(duration[0]) if np.ndim(key_positions) == 2 else duration


def synthesize_batch(
    basis: OptimalBasis,
    key_positions: ArrayLike,
    start_velocity: ArrayLike,
    end_velocity: ArrayLike,
    limits: Limits,
    samples: int,
    *,
    derivatives: bool = True,
) -> TrajectoryBatch:
    """Minimal durations and sampled trajectories (eqs. 3.13-3.15) of a batch of key positions.

    Args:
        basis: optimal basis with N via-points.
        key_positions: (B, N + 2, n) or (N + 2, n), which counts as B = 1.
        start_velocity: q̇_0 (n,) or (B, n).
        end_velocity: q̇_T (n,) or (B, n).
        limits: velocity and acceleration limits.
        samples: number K >= 2 of equally spaced phases, 0 and 1 included.
        derivatives: whether velocities and accelerations are computed too.

    Raises:
        InvalidInputError: if shapes do not fit, an entry is not finite or samples < 2.
    """
    keys, start, end = _prepare(basis, key_positions, start_velocity, end_velocity, limits)
    segment, u = _sample_grid(basis, samples)
    duration, slopes, samples_of = synthesis_kernel(
        basis.knots,
        basis.knot_slopes,
        keys,
        start,
        end,
        limits.velocity,
        limits.acceleration,
        segment,
        u,
        derivatives,
    )
    velocity, acceleration = (samples_of[1], samples_of[2]) if derivatives else (None, None)
    return TrajectoryBatch(duration, samples_of[0], velocity, acceleration, keys, basis.knots, slopes)


@functools.lru_cache(maxsize=64)
def _sample_grid(basis: OptimalBasis, samples: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    if samples < 2:
        raise InvalidInputError(f"samples must be at least 2, got {samples}")
    segment, u = locate(basis, np.linspace(0.0, 1.0, samples))
    segment.setflags(write=False)
    u.setflags(write=False)
    return segment, u


@njit(cache=True, nogil=True)
def _all_finite(values):
    total = 0.0
    for value in values.flat:
        total += value - value
    return total == 0.0


def _prepare(
    basis: OptimalBasis,
    key_positions: ArrayLike,
    start_velocity: ArrayLike,
    end_velocity: ArrayLike,
    limits: Limits,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Own, contiguous arrays: keys (B, N + 2, n) and boundary velocities (B, n)."""
    keys = np.array(key_positions, dtype=np.float64, order="C")
    if keys.ndim == 2:
        keys = keys[None]
    expected = (basis.n_via + 2, limits.dof)
    if keys.ndim != 3 or keys.shape[1:] != expected:
        raise InvalidInputError(
            f"key positions must have shape (B, {expected[0]}, {expected[1]}) for {basis.n_via} via-points "
            f"and {limits.dof} degrees of freedom, got {np.shape(key_positions)}"
        )
    if not _all_finite(keys):
        raise InvalidInputError("key positions must be finite")
    return keys, _boundary("start", start_velocity, keys), _boundary("end", end_velocity, keys)


def _boundary(name: str, velocity: ArrayLike, keys: NDArray[np.float64]) -> NDArray[np.float64]:
    given = np.asarray(velocity, dtype=np.float64)
    rows = np.empty((keys.shape[0], keys.shape[2]))
    if given.shape != rows.shape and given.shape != rows.shape[1:]:
        raise InvalidInputError(
            f"{name} velocity must have shape {rows.shape[1:]} or {rows.shape}, got {given.shape}"
        )
    rows[:] = given
    if not _all_finite(rows):
        raise InvalidInputError(f"{name} velocity must be finite")
    return rows
