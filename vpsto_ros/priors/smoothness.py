"""The Gaussian smoothness prior over via-points, eq. (4.7)-(4.15)."""

from typing import TYPE_CHECKING

import numpy as np

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.priors.gaussian import SeparablePrior, solve

if TYPE_CHECKING:
    from vpsto_ros.trajectory.basis import OptimalBasis

__all__ = ["smoothness_prior"]


def smoothness_prior(
    basis: "OptimalBasis",
    start: np.ndarray,
    start_velocity: np.ndarray,
    end: np.ndarray | None,
    end_velocity: np.ndarray,
    duration: float,
    *,
    weights: np.ndarray | None = None,
    scale: float = 1.0,
    spread: float | None = None,
) -> SeparablePrior:
    """Eq. (4.15): the Gaussian over via-points that favours low acceleration, given the boundary conditions.

    Its density is exp(-J_s / scale^2) with J_s = 1/2 int q''(s)^T R q''(s) ds over phase and R =
    diag(weights), the integral being exact. Two deviations from the text: the conditional mean is -R_via^{-1}
    R_via,bc w_bc, with the minus sign that conditioning gives; and without ``end`` the final position is one
    more variable (the last point), its velocity given.

    Args:
        basis: optimal basis with N via-points.
        start: start position, shape (n,).
        start_velocity: shape (n,), per second.
        end: final position, shape (n,), or None if it is free.
        end_velocity: shape (n,), per second.
        duration: guess of the movement duration in seconds, because the boundary slopes of eq. (4.2) are q' =
            T qdot and T is known only after the via-points; the duration of the direct trajectory is a good
            guess. It moves the mean only when a boundary velocity is not zero.
        weights: diagonal of R, shape (n,), positive; ones by default. A larger weight means less variation.
        scale: factor on the standard deviations.
        spread: if given, overrides ``scale`` such that the marginal standard deviations of all the
            coordinates average to this value, in the unit of the positions.

    Returns:
        Prior over the N via-points (P = N), or over the via-points and the final position (P = N + 1). P = 0
        is an empty prior.

    Raises:
        InvalidInputError: an argument has the wrong shape, is not finite or not positive.
    """
    n_via = basis.n_via
    n = np.size(start)
    boundary = _boundary(n, start, start_velocity, end, end_velocity, duration)
    smoothing = _positive("weights", np.ones(n) if weights is None else weights, n)
    _positive("scale or spread", scale if spread is None else spread)
    # Columns of the Gramian: q_0, q_1 .. q_N, q_T, q'_0, q'_T.
    free = np.arange(1, n_via + 1 if end is not None else n_via + 2)
    fixed = np.setdiff1d(np.arange(n_via + 4), free)
    gramian = basis.gramian()
    per_dof = gramian[np.ix_(free, free)]
    mean = -solve(per_dof, gramian[np.ix_(free, fixed)] @ boundary)
    # R_via = per_dof (x) diag(weights) / scale^2; the product is never formed.
    prior = SeparablePrior(mean, per_dof, scale * smoothing**-0.5)
    if spread is None or not free.size:
        return prior
    deviations = np.sqrt(np.diag(prior.point_covariance))
    return SeparablePrior(mean, per_dof, prior.scales * (spread / (deviations.mean() * prior.scales.mean())))


def _boundary(
    n: int,
    start: np.ndarray,
    start_velocity: np.ndarray,
    end: np.ndarray | None,
    end_velocity: np.ndarray,
    duration: float,
) -> np.ndarray:
    """w_bc as rows q_0, (q_T,) q'_0, q'_T, shape (3 or 4, n)."""
    duration = float(_positive("duration", duration))
    named = {"start": start, "end": end, "start_velocity": start_velocity, "end_velocity": end_velocity}
    rows = []
    for name, value in named.items():
        if value is None and name == "end":
            continue
        row = np.asarray(value, dtype=float)
        if row.shape != (n,) or not np.isfinite(row).all():
            raise InvalidInputError(f"{name} must be finite with shape ({n},), got {value!r}")
        rows.append(row * duration if name.endswith("velocity") else row)
    return np.array(rows)


def _positive(name: str, value: np.ndarray | float, size: int | None = None) -> np.ndarray:
    array = np.asarray(value, dtype=float)
    if (
        array.shape != (() if size is None else (size,))
        or not np.isfinite(array).all()
        or not (array > 0).all()
    ):
        shape = "a number" if size is None else f"shape ({size},)"
        raise InvalidInputError(f"{name} must be {shape}, finite and positive; got {value!r}")
    return array
