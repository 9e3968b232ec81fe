"""Linear-Gaussian models learned from pairs of inputs and outputs, eqs. (5.4) and (5.5)."""

import dataclasses
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError

_GROWTHS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.94, 0.97, 0.98, 0.99, 0.995)
"""Shares of the scatter that may grow, among which a fit chooses; less than all: some always stays."""


@dataclasses.dataclass(frozen=True, eq=False)
class LinearGaussian:
    """Outputs y ~ N(Theta xi + theta, Sigma(s)) of inputs xi.

    Deviation: the thesis's Sigma is constant. Here a share of it may grow with the square of a speed of
    approach s, Sigma(s) = (1 - growth + growth s^2) Sigma: impacts scatter in proportion to their speed.

    Attributes:
        matrix: Theta, shape (m, n).
        offset: theta, shape (m,).
        covariance: Sigma, at s = 1, symmetric positive definite, shape (m, m).
        growth: share of Sigma that grows, from 0 to less than 1.
        approach: what s is of the inputs, s = approach xi, shape (n,); of no matter while nothing grows.

    Raises:
        InvalidInputError: the shapes do not fit, a number is not finite, the covariance is not positive
            definite, or the share that grows is out of range.
    """

    matrix: NDArray[np.float64]
    offset: NDArray[np.float64]
    covariance: NDArray[np.float64]
    growth: float = 0.0
    approach: NDArray[np.float64] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.approach is None:
            object.__setattr__(self, "approach", np.zeros(np.shape(self.matrix)[-1:]))
        for name in ("matrix", "offset", "covariance", "approach"):
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
        if self.approach.shape != self.matrix.shape[1:]:
            raise InvalidInputError(
                f"expected an approach {self.matrix.shape[1:]}, got {self.approach.shape}"
            )
        if not 0.0 <= self.growth < 1.0:
            raise InvalidInputError(f"the share that grows must be from 0 to less than 1, got {self.growth}")
        if not np.allclose(self.covariance, self.covariance.T, rtol=1e-9, atol=1e-15):
            raise InvalidInputError("the covariance of a linear-Gaussian model must be symmetric")
        if np.linalg.eigvalsh(self.covariance)[0] <= 0.0:
            raise InvalidInputError("the covariance of a linear-Gaussian model must be positive definite")

    @classmethod
    def fit(
        cls,
        outputs: ArrayLike,
        inputs: ArrayLike,
        *,
        least_std: float = 1e-6,
        approach: ArrayLike | None = None,
        weights: ArrayLike | None = None,
    ) -> "LinearGaussian":
        """Condition the Gaussian that fits pairs of outputs and inputs best.

        Args:
            outputs: y, shape (N, m).
            inputs: xi, shape (N, n).
            least_std: standard deviation that is added to every output: data without any scatter would give
                a covariance of zero.
            approach: of the speed that the scatter may grow with, shape (n,); how much it does is what makes
                the data likeliest. None: it does not grow.
            weights: of the samples, from 0 to 1, shape (N,); all 1 if None.

        Raises:
            InvalidInputError: the shapes do not fit, there are not more samples than unknowns, or the inputs
                do not vary in all directions.
        """
        y, xi = np.asarray(outputs, dtype=float), np.asarray(inputs, dtype=float)
        shapes = (y.shape, xi.shape)
        paired = y.ndim == xi.ndim == 2 and len(y) == len(xi)
        if not (paired and np.isfinite(y).all() and np.isfinite(xi).all()):
            raise InvalidInputError(f"expected finite outputs (N, m) and inputs (N, n), got {shapes}")
        w = np.ones(len(y)) if weights is None else np.asarray(weights, dtype=float)
        unknowns, number = xi.shape[1] + 1, float(w.sum())
        if number <= unknowns + y.shape[1]:
            raise InvalidInputError(f"{number:.4g} samples are too few for {unknowns} unknowns per output")
        if approach is None:
            return cls._fit(y, xi, w, least_std, 0.0, None)
        row = np.asarray(approach, dtype=float)
        fits = [cls._fit(y, xi, w, least_std, growth, row) for growth in _GROWTHS]
        return max(fits, key=lambda model: float(w @ model.log_densities(y, xi)))

    @classmethod
    def _fit(
        cls, y: NDArray, xi: NDArray, w: NDArray, least_std: float, growth: float, approach: NDArray | None
    ) -> "LinearGaussian":
        """Weighted least squares, which (5.5) is for samples that scatter unevenly."""
        scale = 1.0 if approach is None else 1.0 - growth + growth * (xi @ approach) ** 2
        c = w / scale
        y_mean, xi_mean = c @ y / c.sum(), c @ xi / c.sum()
        root = np.sqrt(c)[:, None]
        y_off, xi_off = root * (y - y_mean), root * (xi - xi_mean)
        if np.linalg.matrix_rank(xi_off, tol=1e-9 * math.sqrt(len(xi))) < xi.shape[1]:
            raise InvalidInputError("the inputs do not vary in all directions; the model is not determined")
        matrix = np.linalg.lstsq(xi_off, y_off, rcond=None)[0].T
        residual = y_off - xi_off @ matrix.T
        # Deviation: divided by the degrees of freedom that are left, so that few samples are not overrated.
        freedom = w.sum() - xi.shape[1] - 1
        covariance = residual.T @ residual / freedom + least_std**2 * np.eye(y.shape[1])
        row = np.zeros(xi.shape[1]) if approach is None else approach
        return cls(matrix, y_mean - matrix @ xi_mean, covariance, growth, row)

    def mean(self, inputs: ArrayLike) -> NDArray[np.float64]:
        """Expected outputs (..., m) of inputs (..., n)."""
        return np.asarray(inputs, dtype=float) @ self.matrix.T + self.offset

    def scales(self, inputs: ArrayLike) -> NDArray[np.float64]:
        """By what Sigma is multiplied at inputs (..., n), shape (...)."""
        speed = np.asarray(inputs, dtype=float) @ self.approach
        return 1.0 - self.growth + self.growth * speed**2

    def sample(self, inputs: ArrayLike, rng: np.random.Generator) -> NDArray[np.float64]:
        """Random outputs (..., m) of inputs (..., n)."""
        mean, scale = self.mean(inputs), self.scales(inputs)
        noise = rng.standard_normal(mean.shape) @ np.linalg.cholesky(self.covariance).T
        return mean + np.sqrt(scale)[..., None] * noise

    def distances(self, outputs: ArrayLike, inputs: ArrayLike) -> NDArray[np.float64]:
        """Squared Mahalanobis distances (...,) of outputs (..., m) from those expected of inputs (..., n)."""
        off = np.asarray(outputs, dtype=float) - self.mean(inputs)
        squared = np.einsum("...i,ij,...j->...", off, np.linalg.inv(self.covariance), off)
        return squared / self.scales(inputs)

    def log_densities(self, outputs: ArrayLike, inputs: ArrayLike) -> NDArray[np.float64]:
        """Logarithms of the densities (...,) of outputs (..., m) at inputs (..., n)."""
        m = self.offset.size
        volume = float(np.linalg.slogdet(2.0 * math.pi * self.covariance)[1])
        volumes = volume + m * np.log(self.scales(inputs))
        return -0.5 * (self.distances(outputs, inputs) + volumes)

    def widened(self, factor: float) -> "LinearGaussian":
        """The same with `factor` times the standard deviations.

        Raises:
            InvalidInputError: the factor is not positive.
        """
        if not (math.isfinite(factor) and factor > 0.0):
            raise InvalidInputError(f"a factor of standard deviations must be positive, got {factor}")
        return dataclasses.replace(self, covariance=factor**2 * self.covariance)

    def as_dict(self) -> dict[str, list | float]:
        """Numbers and lists of them, for a file."""
        return {
            "matrix": self.matrix.tolist(), "offset": self.offset.tolist(),
            "covariance": self.covariance.tolist(), "growth": self.growth,
            "approach": self.approach.tolist(),
        }  # fmt: skip
