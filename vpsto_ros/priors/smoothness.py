"""The Gaussian smoothness prior over via-points, eq. (4.7)-(4.15)."""

import dataclasses
import functools
from typing import TYPE_CHECKING

import numpy as np

from vpsto_ros.exceptions import InvalidInputError

if TYPE_CHECKING:
    from vpsto_ros.trajectory.basis import OptimalBasis


@dataclasses.dataclass(frozen=True)
class GaussianPrior:
    """A Gaussian over P key points of n degrees of freedom, stacked point by point into D = P n numbers.

    Attributes:
        mean: shape (D,).
        precision: inverse covariance, shape (D, D), symmetric and positive definite.
        dof: number of degrees of freedom n of a point.

    Raises:
        InvalidInputError: shapes do not fit or a number is not finite; a precision that is not positive
            definite is found when the covariance is first needed.
    """

    mean: np.ndarray
    precision: np.ndarray
    dof: int

    def __post_init__(self) -> None:
        size = self.mean.size
        if (
            self.mean.shape != (size,)
            or self.precision.shape != (size, size)
            or self.dof < 1
            or size % self.dof
        ):
            raise InvalidInputError(
                f"expected mean (D,), precision (D, D) and D a multiple of dof; got {self.mean.shape}, "
                f"{self.precision.shape} and dof = {self.dof}"
            )
        if not (np.isfinite(self.mean).all() and np.isfinite(self.precision).all()):
            raise InvalidInputError("mean and precision of a Gaussian prior must be finite")

    @property
    def dimension(self) -> int:
        """Number of variables D."""
        return self.mean.size

    @property
    def n_points(self) -> int:
        """Number of key points P."""
        return self.mean.size // self.dof

    @property
    def mean_points(self) -> np.ndarray:
        """The mean as points, shape (P, n)."""
        return self.mean.reshape(self.n_points, self.dof)

    @functools.cached_property
    def covariance(self) -> np.ndarray:
        """Covariance, shape (D, D)."""
        return _inverse(self.precision)

    @functools.cached_property
    def cholesky(self) -> np.ndarray:
        """Lower Cholesky factor L of the covariance, shape (D, D): the map of eq. (4.4)."""
        return _cholesky(self.covariance)

    @functools.cached_property
    def _whitening(self) -> np.ndarray:
        return np.linalg.inv(self.cholesky)

    def to_points(self, latent: np.ndarray) -> np.ndarray:
        """Eq. (4.4): points for latent variables.

        Args:
            latent: shape (B, D), or (D,).

        Returns:
            shape (B, P, n), or (P, n).
        """
        flat = latent @ self.cholesky.T + self.mean
        return flat.reshape(*flat.shape[:-1], self.n_points, self.dof)

    def to_latent(self, points: np.ndarray) -> np.ndarray:
        """Inverse of :meth:`to_points`; shape (B, P, n) to (B, D), or (P, n) to (D,)."""
        flat = points.reshape(*points.shape[:-2], self.dimension)
        return (flat - self.mean) @ self._whitening.T

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw sets of points, shape (count, P, n)."""
        return self.to_points(rng.standard_normal((count, self.dimension)))

    def times(
        self, other: "GaussianPrior | np.ndarray", information: np.ndarray | None = None
    ) -> "GaussianPrior":
        """Product of Gaussian densities, renormalised.

        Args:
            other: another prior, or the precision (D, D) of a factor, which may be singular: it is added,
                never inverted.
            information: precision times mean of that factor, shape (D,); not with a prior. See
                :func:`vpsto_ros.priors.contact.contact_factor`, which returns both.
        """
        if isinstance(other, GaussianPrior):
            precision, information = other.precision, other.precision @ other.mean
        elif information is None:
            raise InvalidInputError("a factor needs its precision and its information vector")
        else:
            precision = other
        if precision.shape != self.precision.shape or information.shape != self.mean.shape:
            raise InvalidInputError(
                f"expected a factor over {self.dimension} variables, got {precision.shape}"
            )
        total = self.precision + precision
        mean = self.mean + _solve(total, information - precision @ self.mean)
        return GaussianPrior(mean, total, self.dof)


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
) -> GaussianPrior:
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
    mean = -_solve(per_dof, gramian[np.ix_(free, fixed)] @ boundary)
    # R_via = per_dof (x) diag(weights) / scale^2: everything is computed on the small factor.
    covariance = _inverse(per_dof)
    if spread is not None and free.size:
        scale = spread / float(np.mean(np.outer(np.sqrt(np.diag(covariance)), smoothing**-0.5)))
    prior = GaussianPrior(mean.ravel(), np.kron(per_dof, np.diag(smoothing / scale**2)), n)
    prior.__dict__["covariance"] = np.kron(covariance, np.diag(scale**2 / smoothing))
    prior.__dict__["cholesky"] = np.kron(_cholesky(covariance), np.diag(scale * smoothing**-0.5))
    return prior


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


def _solve(matrix: np.ndarray, rhs: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.solve(matrix, rhs)
    except np.linalg.LinAlgError as error:
        raise InvalidInputError("the precision of the Gaussian is singular") from error


def _inverse(matrix: np.ndarray) -> np.ndarray:
    inverse = _solve(matrix, np.eye(len(matrix)))
    return 0.5 * (inverse + inverse.T)


def _cholesky(covariance: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as error:
        raise InvalidInputError("the precision of the Gaussian is not positive definite") from error
