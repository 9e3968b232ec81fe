"""Linear-Gaussian models learned from pairs of inputs and outputs, eqs. (5.4) and (5.5)."""

import dataclasses
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError


@dataclasses.dataclass(frozen=True, eq=False)
class LinearGaussian:
    """Outputs y ~ N(Theta xi + theta, Sigma) of inputs xi.

    Attributes:
        matrix: Theta, shape (m, n).
        offset: theta, shape (m,).
        covariance: Sigma, symmetric positive definite, shape (m, m).

    Raises:
        InvalidInputError: the shapes do not fit, a number is not finite, or the covariance is not positive
            definite.
    """

    matrix: NDArray[np.float64]
    offset: NDArray[np.float64]
    covariance: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name in ("matrix", "offset", "covariance"):
            array = np.array(getattr(self, name), dtype=float)
            if not np.isfinite(array).all():
                raise InvalidInputError(f"the {name} of a linear-Gaussian model must be finite")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        shapes = tuple(a.shape for a in (self.matrix, self.offset, self.covariance))
        m = self.offset.size
        if self.matrix.ndim != 2 or shapes != (self.matrix.shape, (m,), (m, m)) or len(self.matrix) != m:
            raise InvalidInputError(
                f"expected a matrix (m, n), an offset (m,) and a covariance (m, m), got {shapes}"
            )
        if not np.allclose(self.covariance, self.covariance.T, rtol=1e-9, atol=1e-15):
            raise InvalidInputError("the covariance of a linear-Gaussian model must be symmetric")
        if np.linalg.eigvalsh(self.covariance)[0] <= 0.0:
            raise InvalidInputError("the covariance of a linear-Gaussian model must be positive definite")

    @classmethod
    def fit(cls, outputs: ArrayLike, inputs: ArrayLike, *, least_std: float = 1e-6) -> "LinearGaussian":
        """Condition the Gaussian that fits pairs of outputs and inputs best.

        Args:
            outputs: y, shape (N, m).
            inputs: xi, shape (N, n).
            least_std: standard deviation that is added to every output: data without any scatter would give
                a covariance of zero.

        Raises:
            InvalidInputError: the shapes do not fit, there are not more samples than unknowns, or the inputs
                do not vary in all directions.
        """
        y, xi = np.asarray(outputs, dtype=float), np.asarray(inputs, dtype=float)
        shapes = (y.shape, xi.shape)
        paired = y.ndim == xi.ndim == 2 and len(y) == len(xi)
        if not (paired and np.isfinite(y).all() and np.isfinite(xi).all()):
            raise InvalidInputError(f"expected finite outputs (N, m) and inputs (N, n), got {shapes}")
        unknowns = xi.shape[1] + 1
        if len(y) <= unknowns + y.shape[1]:
            raise InvalidInputError(f"{len(y)} samples are too few for {unknowns} unknowns per output")
        y_mean, xi_mean = y.mean(axis=0), xi.mean(axis=0)
        y_off, xi_off = y - y_mean, xi - xi_mean
        if np.linalg.matrix_rank(xi_off, tol=1e-9 * math.sqrt(len(xi))) < xi.shape[1]:
            raise InvalidInputError("the inputs do not vary in all directions; the model is not determined")
        matrix = np.linalg.lstsq(xi_off, y_off, rcond=None)[0].T
        residual = y_off - xi_off @ matrix.T
        # Deviation: divided by the degrees of freedom that are left, so that few samples are not overrated.
        covariance = residual.T @ residual / (len(y) - unknowns) + least_std**2 * np.eye(y.shape[1])
        return cls(matrix, y_mean - matrix @ xi_mean, covariance)

    def mean(self, inputs: ArrayLike) -> NDArray[np.float64]:
        """Expected outputs (..., m) of inputs (..., n)."""
        return np.asarray(inputs, dtype=float) @ self.matrix.T + self.offset

    def sample(self, inputs: ArrayLike, rng: np.random.Generator) -> NDArray[np.float64]:
        """Random outputs (..., m) of inputs (..., n)."""
        mean = self.mean(inputs)
        return mean + rng.standard_normal(mean.shape) @ np.linalg.cholesky(self.covariance).T

    def distances(self, outputs: ArrayLike, inputs: ArrayLike) -> NDArray[np.float64]:
        """Squared Mahalanobis distances (...,) of outputs (..., m) from those expected of inputs (..., n)."""
        off = np.asarray(outputs, dtype=float) - self.mean(inputs)
        return np.einsum("...i,ij,...j->...", off, np.linalg.inv(self.covariance), off)

    def widened(self, factor: float) -> "LinearGaussian":
        """The same with `factor` times the standard deviations.

        Raises:
            InvalidInputError: the factor is not positive.
        """
        if not (math.isfinite(factor) and factor > 0.0):
            raise InvalidInputError(f"a factor of standard deviations must be positive, got {factor}")
        return dataclasses.replace(self, covariance=factor**2 * self.covariance)

    def as_dict(self) -> dict[str, list]:
        """Lists of numbers, for a file."""
        return {
            "matrix": self.matrix.tolist(), "offset": self.offset.tolist(),
            "covariance": self.covariance.tolist(),
        }  # fmt: skip
