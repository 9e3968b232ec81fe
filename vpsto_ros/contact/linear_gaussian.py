"""Linear-Gaussian models learned from pairs of inputs and outputs, eqs. (5.4) and (5.5)."""

import dataclasses
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError

_LEAST_CONSTANT = 5e-3  # share of the scatter that stays however slow an approach is
_SCORINGS = 12  # how often scatter and weights are fitted in turn

@dataclasses.dataclass(frozen=True, eq=False)
class LinearGaussian:
    """Outputs y ~ N(Theta xi + theta, Sigma(xi)) of inputs xi.

    Deviation: the thesis's Sigma is constant. Here shares of each output's variance may grow with the square
    of speeds s = S xi, Sigma(xi) = D Sigma D with D_ii^2 = 1 - sum_j g_ij + sum_j g_ij s_j^2: impacts scatter
    in proportion to their speed.

    Attributes:
        matrix: Theta, shape (m, n).
        offset: theta, shape (m,).
        covariance: Sigma, at speeds of 1, symmetric positive definite, shape (m, m).
        growth: g, shares of the variances that grow, from 0, their sums less than 1, shape (m, f).
        approach: S, speeds of approach as rows of the inputs, shape (f, n).

    Raises:
        InvalidInputError: the shapes do not fit, a number is not finite, the covariance is not positive
            definite, or a share that grows is out of range.
    """

    matrix: NDArray[np.float64]
    offset: NDArray[np.float64]
    covariance: NDArray[np.float64]
    growth: NDArray[np.float64] = None  # type: ignore[assignment]
    approach: NDArray[np.float64] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        rows, columns = np.shape(self.matrix)[:1], np.shape(self.matrix)[-1:]
        if self.approach is None or np.size(self.approach) == 0:
            object.__setattr__(self, "approach", np.zeros((0, *columns)))
        if self.growth is None or np.size(self.growth) == 0:
            object.__setattr__(self, "growth", np.zeros((*rows, len(self.approach))))
        for name in ("matrix", "offset", "covariance", "growth", "approach"):
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
        f = len(self.approach)
        if self.approach.shape != (f, *columns) or self.growth.shape != (m, f):
            raise InvalidInputError(
                f"expected growth (m, f) and approach (f, n), got {self.growth.shape}, {self.approach.shape}"
            )
        if not ((self.growth >= 0.0).all() and (self.growth.sum(axis=1) < 1.0).all()):
            raise InvalidInputError(
                f"shares that grow must be from 0, and their sums less than 1, got {self.growth.tolist()}"
            )
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
            approach: speeds that the scatter may grow with, shape (f, n); how much it does is what makes the
                data likeliest, which decides how much each sample weighs. None: it does not grow.
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
        rows = np.zeros((0, xi.shape[1])) if approach is None else np.asarray(approach, dtype=float)
        squares = np.column_stack([np.ones(len(y)), (xi @ rows.T) ** 2])
        scales, shares, residual = np.ones_like(y), np.zeros((y.shape[1], len(rows))), y
        for scoring in range(_SCORINGS + 1 if len(rows) else 1):
            if scoring:
                shares, scales = _growth(residual, w, squares, scales)
            columns = [_least_squares(y[:, i], xi, w / scales[:, i]) for i in range(y.shape[1])]
            matrix, offset = np.array([row for row, _ in columns]), np.array([shift for _, shift in columns])
            residual = y - xi @ matrix.T - offset
        # Deviation: divided by the degrees of freedom that are left, so that few samples are not overrated.
        even = residual / np.sqrt(scales)
        covariance = (even * w[:, None]).T @ even / (number - unknowns)
        return cls(matrix, offset, covariance + least_std**2 * np.eye(y.shape[1]), shares, rows)

    def mean(self, inputs: ArrayLike) -> NDArray[np.float64]:
        """Expected outputs (..., m) of inputs (..., n)."""
        return np.asarray(inputs, dtype=float) @ self.matrix.T + self.offset

    def scales(self, inputs: ArrayLike) -> NDArray[np.float64]:
        """By what the variance of each output is multiplied at inputs (..., n), shape (..., m)."""
        speeds = np.asarray(inputs, dtype=float) @ self.approach.T
        return 1.0 - self.growth.sum(axis=1) + speeds**2 @ self.growth.T

    def sample(self, inputs: ArrayLike, rng: np.random.Generator) -> NDArray[np.float64]:
        """Random outputs (..., m) of inputs (..., n)."""
        mean = self.mean(inputs)
        noise = rng.standard_normal(mean.shape) @ np.linalg.cholesky(self.covariance).T
        return mean + np.sqrt(self.scales(inputs)) * noise

    def distances(self, outputs: ArrayLike, inputs: ArrayLike) -> NDArray[np.float64]:
        """Squared Mahalanobis distances (...,) of outputs (..., m) from those expected of inputs (..., n)."""
        off = (np.asarray(outputs, dtype=float) - self.mean(inputs)) / np.sqrt(self.scales(inputs))
        return np.einsum("...i,ij,...j->...", off, np.linalg.inv(self.covariance), off)

    def log_densities(self, outputs: ArrayLike, inputs: ArrayLike) -> NDArray[np.float64]:
        """Logarithms of the densities (...,) of outputs (..., m) at inputs (..., n)."""
        volume = float(np.linalg.slogdet(2.0 * math.pi * self.covariance)[1])
        volumes = volume + np.log(self.scales(inputs)).sum(axis=-1)
        return -0.5 * (self.distances(outputs, inputs) + volumes)

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
            "covariance": self.covariance.tolist(), "growth": self.growth.tolist(),
            "approach": self.approach.tolist(),
        }  # fmt: skip


def _least_squares(y: NDArray, xi: NDArray, weights: NDArray) -> tuple[NDArray[np.float64], float]:
    """Row (n,) and offset of one output (N,) from inputs (N, n) and weights (N,): (5.5) if they are even."""
    total = weights.sum()
    y_mean, xi_mean = float(weights @ y / total), weights @ xi / total
    root = np.sqrt(weights)
    inputs = root[:, None] * (xi - xi_mean)
    if np.linalg.matrix_rank(inputs, tol=1e-9 * math.sqrt(len(xi))) < xi.shape[1]:
        raise InvalidInputError("the inputs do not vary in all directions; the model is not determined")
    row = np.linalg.lstsq(inputs, root * (y - y_mean), rcond=None)[0]
    return row, y_mean - float(row @ xi_mean)


def _growth(
    residual: NDArray, weights: NDArray, squares: NDArray, scales: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shares (m, f) that grow, and scales (N, m) with them: one step of Fisher's scoring from scales.

    Args:
        residual: of the outputs (N, m).
        weights: of the samples (N,).
        squares: 1 and the squared speeds (N, 1 + f).
        scales: by which residuals have been weighed so far (N, m).
    """
    from scipy.optimize import nnls  # here, because it takes most of a second

    shares, found = [], []
    for r, scale in zip(residual.T, scales.T, strict=True):
        variance = max(float(weights @ (r**2 / scale) / weights.sum()), 1e-300)
        root = np.sqrt(weights) / scale
        parts = nnls(root[:, None] * squares, root * r**2 / variance)[0]
        parts[0] = max(parts[0], _LEAST_CONSTANT * parts.sum(), 1e-12)
        parts /= parts.sum()
        shares.append(parts[1:])
        found.append(squares @ parts)
    return np.array(shares), np.stack(found, axis=1)
