"""One trajectory through key positions, and the one that brakes from any velocity."""

import dataclasses
import numbers

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InfeasibleError, InvalidInputError
from vpsto_ros.trajectory.basis import OptimalBasis
from vpsto_ros.trajectory.timing import MINIMUM_DURATION, Limits, minimal_duration
from vpsto_ros.trajectory.trajectory import Trajectory


def synthesize(
    basis: OptimalBasis,
    key_positions: ArrayLike,
    start_velocity: ArrayLike,
    end_velocity: ArrayLike,
    limits: Limits,
    *,
    duration: float | None = None,
    start_time: float = 0.0,
) -> Trajectory:
    """The minimal-effort trajectory through the key positions (eqs. 3.13-3.17), as fast as the limits allow.

    Args:
        basis: optimal basis with N via-points.
        key_positions: (N + 2, n) from q_0 to q_T [rad or m].
        start_velocity: q̇_0 (n,) [1/s].
        end_velocity: q̇_T (n,) [1/s].
        limits: velocity and acceleration limits, kept at every instant; position limits are not looked at.
        duration: duration [s] instead of the minimal one.
        start_time: time [s] of the first key position.

    Raises:
        InvalidInputError: if shapes do not fit or an entry is not finite.
        InfeasibleError: if a boundary velocity is beyond its limit, or a given duration is too short.
    """
    keys = np.array(key_positions, dtype=np.float64)
    if keys.ndim != 2:
        raise InvalidInputError(f"key positions must have shape (N + 2, n), got {keys.shape}")
    start_velocity, end_velocity = np.ravel(start_velocity), np.ravel(end_velocity)
    shortest = minimal_duration(basis, keys, start_velocity, end_velocity, limits)
    if not np.isfinite(shortest):
        raise InfeasibleError(_beyond_limit(start_velocity, end_velocity, limits))
    if duration is not None and not (np.isfinite(duration) and duration > 0.0):
        raise InvalidInputError(f"duration must be positive and finite, got {duration}")
    if not isinstance(start_time, numbers.Real) or not np.isfinite(start_time):
        raise InvalidInputError(f"start_time must be a finite number, got {start_time!r}")
    total = shortest if duration is None else float(duration)
    ends = np.array([start_velocity, end_velocity], dtype=np.float64)
    by_keys, by_velocity = basis.knot_slopes[:, :-2], basis.knot_slopes[:, -2:]
    velocities = by_keys @ (keys - keys[0]) / total + by_velocity @ ends
    trajectory = Trajectory.from_points(start_time + total * basis.knots, keys, velocities)
    if total < shortest:
        # A shorter, isolated duration can be feasible, so the limits decide.
        broken = trajectory.violations(dataclasses.replace(limits, lower=None, upper=None))
        if broken:
            raise InfeasibleError(
                f"duration {total:.6g} s is too short ({'; '.join(broken)}); "
                f"every duration from {shortest:.6g} s on works"
            )
    return trajectory


def braking_trajectory(
    position: ArrayLike, velocity: ArrayLike, limits: Limits, *, start_time: float = 0.0
) -> Trajectory:
    """Come to rest with constant deceleration, on a straight line, as fast as the acceleration limits allow.

    The treatment of a start velocity beyond its limit, for which :func:`synthesize` finds no trajectory:
    every speed falls linearly to zero within T = max_i |v_i| / a_i, so what exceeds its limit at the start
    only shrinks. Position limits are not looked at: the way to rest is |v_i| T / 2, and there is no shorter
    one for the joint that sets T.

    Args:
        position: (n,) position at the start [rad or m].
        velocity: (n,) velocity at the start, of any size [1/s].
        limits: acceleration limits to brake with.
        start_time: time of the start [s].

    Raises:
        InvalidInputError: if shapes do not fit or an entry is not finite.
    """
    q, v = np.array(position, dtype=np.float64), np.array(velocity, dtype=np.float64)
    if q.shape != (limits.dof,) or v.shape != (limits.dof,):
        raise InvalidInputError(
            f"position and velocity must have shape ({limits.dof},), got {q.shape} and {v.shape}"
        )
    if not (np.isfinite(q).all() and np.isfinite(v).all()):
        raise InvalidInputError("position and velocity must be finite")
    duration = max(MINIMUM_DURATION, float(np.max(np.abs(v) / limits.acceleration)))
    coefficients = np.zeros((1, 6, limits.dof))
    coefficients[0, :3] = q, v, -v / (2.0 * duration)
    return Trajectory(np.array([start_time, start_time + duration]), coefficients)


def _beyond_limit(start_velocity: ArrayLike, end_velocity: ArrayLike, limits: Limits) -> str:
    speeds: NDArray = np.maximum(np.abs(start_velocity), np.abs(end_velocity))
    joint = int(np.argmax(speeds / limits.velocity))
    return (
        f"boundary speed {speeds[joint]:.6g} of joint {joint + 1} is beyond its limit "
        f"{limits.velocity[joint]:.6g}: "
        "no duration keeps the limits; slow down first with braking_trajectory"
    )
