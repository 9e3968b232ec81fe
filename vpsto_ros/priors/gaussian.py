"""Gaussians over key points: dense, and with the structure that equal basis functions for all joints give."""

import functools
import math

import numpy as np
from numba import njit

from vpsto_ros.exceptions import InvalidInputError


class GaussianPrior:
    """A Gaussian over P key points of n degrees of freedom, stacked point by point into D = P n numbers.

    Args:
        mean: shape (D,).
        precision: inverse covariance, shape (D, D), symmetric and positive definite.
        dof: number of degrees of freedom n of a point.

    Raises:
        InvalidInputError: shapes do not fit or a number is not finite; a precision that is not positive
            definite is found when the covariance is first needed.
    """

    def __init__(self, mean: np.ndarray, precision: np.ndarray, dof: int) -> None:
        size = mean.size
        if mean.shape != (size,) or precision.shape != (size, size) or dof < 1 or size % dof:
            raise InvalidInputError(
                f"expected mean (D,), precision (D, D) and D a multiple of dof; got {mean.shape}, "
                f"{precision.shape} and dof = {dof}"
            )
        if not (np.isfinite(mean).all() and np.isfinite(precision).all()):
            raise InvalidInputError("mean and precision of a Gaussian prior must be finite")
        self.mean, self.dof = mean, dof
        self._precision = precision

    @property
    def precision(self) -> np.ndarray:
        """Inverse covariance, shape (D, D)."""
        return self._precision

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
        return inverse(self.precision)

    @functools.cached_property
    def cholesky(self) -> np.ndarray:
        """Lower Cholesky factor L of the covariance, shape (D, D): the map of eq. (4.4)."""
        return cholesky(self.covariance)

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
        """Product of Gaussian densities, renormalised; always dense.

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
        if precision.shape != (self.dimension, self.dimension) or information.shape != self.mean.shape:
            raise InvalidInputError(
                f"expected a factor over {self.dimension} variables, got {precision.shape}"
            )
        total = self.precision + precision
        mean = self.mean + solve(total, information - precision @ self.mean)
        return GaussianPrior(mean, total, self.dof)


class SeparablePrior(GaussianPrior):
    """A Gaussian in which the degrees of freedom are independent and alike up to a scale.

    Its covariance is the Kronecker product of one matrix (P, P) over the points and a diagonal one (n, n)
    over the degrees of freedom. Only these two are stored, and points and latent variables are converted with
    them: the cost is linear in n. The dense matrices are built if somebody asks for them, as :meth:`times`
    does.

    Args:
        mean: mean points, shape (P, n).
        point_precision: inverse covariance over the points of a degree of freedom, shape (P, P), symmetric
            and positive definite.
        scales: factors on the standard deviations of every degree of freedom, shape (n,), positive.

    Raises:
        InvalidInputError: shapes do not fit, a number is not finite, or the precision is not positive
            definite.
    """

    def __init__(self, mean: np.ndarray, point_precision: np.ndarray, scales: np.ndarray) -> None:
        points, dof = mean.shape
        if point_precision.shape != (points, points) or scales.shape != (dof,) or not (scales > 0.0).all():
            raise InvalidInputError(
                f"expected a precision ({points}, {points}) and {dof} positive scales for a mean of shape "
                f"{mean.shape}; got {point_precision.shape} and {scales!r}"
            )
        if not all(np.isfinite(array).all() for array in (mean, point_precision, scales)):
            raise InvalidInputError("mean, precision and scales of a Gaussian prior must be finite")
        self.mean, self.dof, self.scales = mean.ravel(), dof, scales
        self.point_precision = point_precision
        self.point_covariance = inverse(point_precision)
        self.point_cholesky = cholesky(self.point_covariance)

    @functools.cached_property
    def precision(self) -> np.ndarray:
        """Inverse covariance, shape (D, D)."""
        return np.kron(self.point_precision, np.diag(self.scales**-2))

    @functools.cached_property
    def covariance(self) -> np.ndarray:
        """Covariance, shape (D, D)."""
        return np.kron(self.point_covariance, np.diag(self.scales**2))

    @functools.cached_property
    def cholesky(self) -> np.ndarray:
        """Lower Cholesky factor of the covariance, shape (D, D)."""
        return np.kron(self.point_cholesky, np.diag(self.scales))

    def to_points(self, latent: np.ndarray) -> np.ndarray:
        """As :meth:`GaussianPrior.to_points`, linear in the degrees of freedom."""
        rows = self._rows(latent, latent.shape[:-1])
        points = np.empty_like(rows)
        _separable_points(rows, self.point_cholesky, self.scales, self.mean_points, points)
        return points.reshape(*latent.shape[:-1], self.n_points, self.dof)

    def to_latent(self, points: np.ndarray) -> np.ndarray:
        """As :meth:`GaussianPrior.to_latent`, linear in the degrees of freedom."""
        rows = self._rows(points, points.shape[:-2])
        latent = np.empty_like(rows)
        _separable_latent(rows, self.point_cholesky, self.scales, self.mean_points, latent)
        return latent.reshape(*points.shape[:-2], self.dimension)

    def _rows(self, values: np.ndarray, batch: tuple[int, ...]) -> np.ndarray:
        """Contiguous, shape (B, P, n); B = 1 for a batch of no axis."""
        rows = np.ascontiguousarray(values, dtype=float)
        return rows.reshape(math.prod(batch), self.n_points, self.dof)


@njit(cache=True, nogil=True)
def _separable_points(latent, lower, scales, mean, points):
    """Points (B, P, n) = mean + (lower @ latent) * scales."""
    for b in range(latent.shape[0]):
        for i in range(mean.shape[0]):
            for j in range(mean.shape[1]):
                total = 0.0
                for k in range(i + 1):
                    total += lower[i, k] * latent[b, k, j]
                points[b, i, j] = mean[i, j] + scales[j] * total


@njit(cache=True, nogil=True)
def _separable_latent(points, lower, scales, mean, latent):
    """The inverse of :func:`_separable_points`, by forward substitution."""
    for b in range(points.shape[0]):
        for i in range(mean.shape[0]):
            for j in range(mean.shape[1]):
                total = (points[b, i, j] - mean[i, j]) / scales[j]
                for k in range(i):
                    total -= lower[i, k] * latent[b, k, j]
                latent[b, i, j] = total / lower[i, i]


def solve(matrix: np.ndarray, rhs: np.ndarray) -> np.ndarray:
    """matrix^-1 rhs.

    Raises:
        InvalidInputError: the matrix is singular.
    """
    try:
        return np.linalg.solve(matrix, rhs)
    except np.linalg.LinAlgError as error:
        raise InvalidInputError("the precision of the Gaussian is singular") from error


def inverse(matrix: np.ndarray) -> np.ndarray:
    """The symmetric inverse of a symmetric matrix."""
    found = solve(matrix, np.eye(len(matrix)))
    return 0.5 * (found + found.T)


def cholesky(covariance: np.ndarray) -> np.ndarray:
    """Lower Cholesky factor.

    Raises:
        InvalidInputError: the matrix is not positive definite.
    """
    try:
        return np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as error:
        raise InvalidInputError("the precision of the Gaussian is not positive definite") from error
