"""Polynomial segments between points that carry positions, velocities and accelerations."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory.polynomials import SIZE

_ROUND_OFF = 32.0 * np.finfo(np.float64).eps


def hermite_coefficients(
    times: NDArray[np.float64],
    positions: ArrayLike,
    velocities: ArrayLike | None = None,
    accelerations: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """Coefficients (P - 1, 6, n) in local time: linear, cubic or quintic, whatever the points determine.

    Args:
        times: (P,) strictly increasing [s].
        positions: (P, n).
        velocities: (P, n), or None for linear segments.
        accelerations: (P, n), rows of NaN where there are none, or None.

    Raises:
        InvalidInputError: if shapes do not fit, times do not increase or accelerations come without
            velocities.
    """
    q = _matrix("positions", positions, times.size)
    if times.size < 2 or not np.all(np.diff(times) > 0.0):
        raise InvalidInputError("times of the points must increase strictly, and there must be at least two")
    h = np.diff(times)[:, None]
    c = np.zeros((times.size - 1, SIZE, q.shape[1]))
    chord = np.diff(q, axis=0) / h
    c[:, 0] = q[:-1]
    if velocities is None:
        if accelerations is not None:
            raise InvalidInputError("points with accelerations need velocities too")
        c[:, 1] = chord
        return c
    v = _matrix("velocities", velocities, times.size, q.shape[1])
    c[:, 1] = v[:-1]
    c[:, 2] = (3.0 * chord - 2.0 * v[:-1] - v[1:]) / h
    c[:, 3] = (v[:-1] + v[1:] - 2.0 * chord) / h**2
    if accelerations is not None:
        _raise_to_quintic(
            c, h, q, v, _matrix("accelerations", accelerations, times.size, q.shape[1], missing=True)
        )
    return c


def _raise_to_quintic(c: NDArray, h: NDArray, q: NDArray, v: NDArray, a: NDArray) -> None:
    """Bring the cubics c (S, 6, n) to accelerations a (S + 1, n) in place, where both ends have them.

    Written as a correction of the cubic: e_0 and e_1, the accelerations still missing at the two ends, enter
    as h^2 / 2 (e_0 u^2 (1 - u)^3 + e_1 u^3 (1 - u)^2). What is missing only by round-off is no quintic.
    """
    given = np.isfinite(a).all(axis=1)
    quintic = (given[:-1] & given[1:])[:, None]
    a = np.where(given[:, None], a, 0.0)
    e0, e1 = a[:-1] - 2.0 * c[:, 2], a[1:] - 2.0 * c[:, 2] - 6.0 * c[:, 3] * h
    reach = np.maximum(np.abs(q[:-1]), np.abs(q[1:])) / h**2 + np.maximum(np.abs(v[:-1]), np.abs(v[1:])) / h
    noise = _ROUND_OFF * (reach + np.abs(a[:-1]) + np.abs(a[1:]))
    cubic = quintic & (np.abs(e0) <= noise) & (np.abs(e1) <= noise)
    # The accelerations determine such a cubic better than differences of positions over h^2 do.
    c[:, 2] = np.where(cubic, a[:-1] / 2.0, c[:, 2])
    c[:, 3] = np.where(cubic, np.diff(a, axis=0) / (6.0 * h), c[:, 3])
    e0, e1 = (np.where(quintic & ~cubic, e, 0.0) for e in (e0, e1))
    c[:, 2] += e0 / 2.0
    c[:, 3] += (e1 - 3.0 * e0) / (2.0 * h)
    c[:, 4] = (3.0 * e0 - 2.0 * e1) / (2.0 * h**2)
    c[:, 5] = (e1 - e0) / (2.0 * h**3)


def _matrix(
    name: str, values: ArrayLike, rows: int, columns: int | None = None, *, missing: bool = False
) -> NDArray[np.float64]:
    matrix = np.asarray(values, dtype=np.float64)
    if matrix.ndim != 2 or matrix.shape[0] != rows or (columns is not None and matrix.shape[1] != columns):
        raise InvalidInputError(
            f"{name} must have shape ({rows}, {'n' if columns is None else columns}), got {matrix.shape}"
        )
    if not (np.isfinite(matrix) | (missing & np.isnan(matrix))).all():
        raise InvalidInputError(f"{name} must be finite")
    return matrix
