"""Evolution strategies with covariance matrix adaptation, vectorised for small populations and short loops.

:class:`CmaEs` is active CMA-ES, that of Hansen, "The CMA Evolution Strategy: A Tutorial" (2016), which also
learns from the worse half of its samples, and its separable variant with the learning rates of Ros and Hansen
(2008). External solutions are accepted as in Hansen, "Injecting external solutions into CMA-ES" (2011).
:class:`PycmaEs` is the same interface on the ``cma`` package, kept as a choice and as the reference in the
tests.
"""

import math
from typing import Any, Protocol

import numpy as np

from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.optimization.cma_parameters import default_parameters

STRATEGIES = ("sep-cma", "cma", "pycma", "pycma-sep")
_SIGMA_RANGE = (1e-30, 1e30)
_LARGEST_CONDITION = 1e14
"""Of the covariance; beyond it the short axes are round-off (the same constant as in pycma)."""

_TINY = 1e-300
"""Keeps divisions by the length of a step defined."""

_RESOLUTION = 1e-12
"""Standard deviation, relative to max(1, |mean|), below which samples hardly differ any more."""


class Strategy(Protocol):
    """What the search needs of an evolution strategy."""

    sigma: float

    @property
    def mean(self) -> np.ndarray:
        """Mean of the search distribution, shape (D,)."""

    @property
    def covariance_diagonal(self) -> np.ndarray:
        """Variances of the search distribution divided by sigma^2, shape (D,)."""

    def ask(self) -> np.ndarray:
        """Draw a population, shape (M, D)."""

    def tell(self, samples: np.ndarray, costs: np.ndarray, injected: int = 0) -> None:
        """Learn from the costs (M,) of samples (M, D), of which the first `injected` came from elsewhere."""


def has_collapsed(strategy: Strategy) -> bool:
    """Whether samples no longer differ beyond round-off: there is nothing left to learn."""
    finest = _RESOLUTION * max(1.0, float(np.abs(strategy.mean).max()))
    return strategy.sigma**2 * float(strategy.covariance_diagonal.max()) < finest**2


class CmaEs:
    """CMA-ES (full covariance) or sep-CMA-ES (diagonal covariance), minimising.

    The samples of an iteration are x_i = m + sigma y_i with y_i ~ N(0, C). ``sigma`` may be changed between
    iterations.

    The full strategy is the one of the ``cma`` package with its default options and needs as many iterations.
    The separable strategy updates C alike, eq. (47) of the tutorial on the diagonal. The package multiplies
    the variances by exponentials instead, with other learning rates and without normalising bad steps:
    another rule, compared with which this one needs 0 to 8 % fewer iterations on separable functions of 6 and
    10 variables and 5 to 12 % fewer on those of 28.

    Args:
        dimension: number of variables D >= 1.
        population: samples per iteration M >= 4.
        rng: source of randomness.
        sigma: initial step size, > 0.
        mean: initial mean, shape (D,); zeros by default.
        separable: adapt the diagonal of C only.
        active: learn from the worse half of the samples, too: their directions lose variance.

    Raises:
        InvalidInputError: a size or the step size is out of range, or the mean has the wrong shape or is not
            finite.
    """

    def __init__(
        self,
        dimension: int,
        population: int,
        rng: np.random.Generator,
        *,
        sigma: float = 1.0,
        mean: np.ndarray | None = None,
        separable: bool = False,
        active: bool = True,
    ) -> None:
        self._mean = _checked_mean(dimension, population, sigma, mean)
        self.sigma = float(sigma)
        self.separable = separable
        self.population = population
        self.iterations = 0
        self._rng = rng
        self._parameters = default_parameters(dimension, population, separable, active)
        self._path_sigma = np.zeros(dimension)
        self._path_c = np.zeros(dimension)
        self._scales = np.ones(dimension)
        self._covariance = np.ones(dimension) if separable else np.eye(dimension)
        self._basis: np.ndarray | None = None  # eigenvectors; None stands for the identity
        self._since_decomposition = 0

    @property
    def mean(self) -> np.ndarray:
        """Mean of the search distribution, shape (D,)."""
        return self._mean

    @property
    def covariance_diagonal(self) -> np.ndarray:
        """Diagonal of C, shape (D,); the variances of the samples are sigma^2 times this."""
        return self._covariance if self.separable else np.diagonal(self._covariance)

    def ask(self) -> np.ndarray:
        """Draw a population, shape (M, D)."""
        steps = self._rng.standard_normal((self.population, self._mean.size)) * self._scales
        if self._basis is not None:
            steps = steps @ self._basis.T
        return self._mean + self.sigma * steps

    def tell(self, samples: np.ndarray, costs: np.ndarray, injected: int = 0) -> None:
        """Update the distribution from the ranks of the costs.

        Args:
            samples: what was evaluated, shape (M, D): the result of :meth:`ask`, in which the first rows may
                have been replaced by solutions from elsewhere.
            costs: shape (M,). Non-finite costs rank last and never contribute, not even as bad samples; if
                none is finite nothing is learned. Nothing is learned either once the distribution
                :func:`has_collapsed`.
            injected: number of leading rows that did not come from :meth:`ask`. Their steps are shortened to
                a length the distribution could have drawn, so that a distant one cannot blow up the
                covariance. They count as good samples only: a bad one says nothing about the distribution.
        """
        self.iterations += 1
        finite = np.isfinite(costs)
        if not finite.all():
            samples, costs, injected = samples[finite], costs[finite], int(finite[:injected].sum())
        if not costs.size or has_collapsed(self):
            return
        p = self._parameters
        order = costs.argsort(kind="stable")
        steps = samples[order]
        steps -= self._mean
        steps /= self.sigma
        weights, mu_eff = self._weights(costs.size)
        if injected:
            external = order < injected
            self._shorten(steps, external)
            weights = np.where(external, np.maximum(weights, 0.0), weights)
        step = weights[: p.mu] @ steps[: p.mu]
        self._mean = self._mean + self.sigma * step
        length, stalled = self._update_paths(step, mu_eff)
        self._update_covariance(steps, weights, stalled)
        self.sigma *= math.exp(min(1.0, (p.c_sigma / p.d_sigma) * (length / p.chi - 1)))
        self.sigma = min(max(self.sigma, _SIGMA_RANGE[0]), _SIGMA_RANGE[1])

    def _weights(self, count: int) -> tuple[np.ndarray, float]:
        """Weights of the ranks when there are so many samples, and the effective number of good ones."""
        p = self._parameters
        if count >= p.mu:
            return p.weights[:count], p.mu_eff
        weights = p.weights[:count] / p.weights[:count].sum()
        return weights, 1.0 / float(weights @ weights)

    def _shorten(self, steps: np.ndarray, rows: np.ndarray) -> None:
        n = self._mean.size
        longest = math.sqrt(n) + 2 * n / (n + 2)
        lengths = np.sqrt(self._squared_lengths(steps[rows]))
        steps[rows] *= np.minimum(1.0, longest / np.maximum(lengths, _TINY))[:, None]

    def _whiten(self, steps: np.ndarray) -> np.ndarray:
        """C^{-1/2} y for steps in the last axis."""
        if self._basis is None:
            return steps / self._scales
        return ((steps @ self._basis) / self._scales) @ self._basis.T

    def _squared_lengths(self, steps: np.ndarray) -> np.ndarray:
        """||C^{-1/2} y||^2 of every row."""
        if self._basis is None:
            return (steps * steps) @ (1.0 / self._scales**2)
        white = steps @ self._basis
        white *= white
        return white @ (1.0 / self._scales**2)

    def _update_paths(self, step: np.ndarray, mu_eff: float) -> tuple[float, bool]:
        p = self._parameters
        c = p.c_sigma
        self._path_sigma = (1 - c) * self._path_sigma + math.sqrt(c * (2 - c) * mu_eff) * self._whiten(step)
        length = math.sqrt(float(self._path_sigma @ self._path_sigma))
        expected = math.sqrt(1 - (1 - c) ** (2 * self.iterations)) * p.chi
        # A long path means that the step size is far too small; the shape would only follow the drift.
        stalled = length >= (1.4 + 2 / (self._mean.size + 1)) * expected
        self._path_c = (1 - p.c_c) * self._path_c
        if not stalled:
            self._path_c += math.sqrt(p.c_c * (2 - p.c_c) * mu_eff) * step
        return length, stalled

    def _update_covariance(self, steps: np.ndarray, weights: np.ndarray, stalled: bool) -> None:
        """Eq. (47) of the tutorial. Bad steps are scaled to the Mahalanobis length sqrt(n), eq. (46)."""
        p, n = self._parameters, self._mean.size
        rates = p.c_mu * weights
        kept = 1 - p.c_1 - float(np.add.reduce(rates))
        if stalled:
            kept += p.c_1 * p.c_c * (2 - p.c_c)
        if self.separable:
            squares = steps * steps
            rates[p.mu :] *= n / (squares[p.mu :] @ (1.0 / self._covariance) + _TINY)
            self._covariance = kept * self._covariance + p.c_1 * self._path_c**2 + rates @ squares
            np.maximum(self._covariance, self._covariance.max() / _LARGEST_CONDITION, out=self._covariance)
            self._scales = np.sqrt(self._covariance)
            return
        rates[p.mu :] *= n / (self._squared_lengths(steps[p.mu :]) + _TINY)
        rank_mu = (steps.T * rates) @ steps
        self._covariance = kept * self._covariance + rank_mu + (p.c_1 * self._path_c)[:, None] * self._path_c
        self._since_decomposition += 1
        if self._since_decomposition > p.lazy_gap:
            self._decompose()

    def _decompose(self) -> None:
        values, basis = np.linalg.eigh(self._covariance)
        smallest = values[-1] / _LARGEST_CONDITION
        if values[0] < smallest:
            # Round-off can push the smallest eigenvalue of an ill-conditioned matrix below zero.
            values = np.maximum(values, smallest)
            self._covariance = (basis * values) @ basis.T
        self._basis, self._scales = basis, np.sqrt(values)
        self._since_decomposition = 0


class PycmaEs:
    """The same interface on the ``cma`` package (5 to 20 times slower per iteration).

    Raises:
        InvalidInputError: as :class:`CmaEs`.
    """

    def __init__(
        self,
        dimension: int,
        population: int,
        rng: np.random.Generator,
        *,
        sigma: float = 1.0,
        mean: np.ndarray | None = None,
        separable: bool = False,
        active: bool = True,
    ) -> None:
        import cma  # imported here because it takes more than a second and is optional

        start = _checked_mean(dimension, population, sigma, mean)
        options = {
            "popsize": population,
            "CMA_active": active,
            "CMA_diagonal": separable,
            "randn": lambda *shape: rng.standard_normal(shape),
            "seed": math.nan,  # do not touch NumPy's global generator
            "verbose": -9,
        }
        if dimension == 1:
            raise InvalidInputError(
                "the cma package needs at least 2 variables; use strategy 'cma' or 'sep-cma'"
            )
        self._strategy = cma.CMAEvolutionStrategy(start, float(sigma), options)
        self.population = population

    @property
    def sigma(self) -> float:
        """Step size."""
        return float(self._strategy.sigma)

    @sigma.setter
    def sigma(self, value: float) -> None:
        self._strategy.sigma = value

    @property
    def mean(self) -> np.ndarray:
        """Mean of the search distribution, shape (D,)."""
        return np.asarray(self._strategy.mean)

    @property
    def covariance_diagonal(self) -> np.ndarray:
        """Variances of the search distribution divided by sigma^2, shape (D,)."""
        return np.square(np.asarray(self._strategy.sigma_vec.scaling)) * self._strategy.sm.variances

    def ask(self) -> np.ndarray:
        """Draw a population, shape (M, D)."""
        return np.array(self._strategy.ask())

    def tell(self, samples: np.ndarray, costs: np.ndarray, injected: int = 0) -> None:
        """As :meth:`CmaEs.tell`; non-finite costs rank last."""
        finite = np.isfinite(costs)
        if not finite.any():
            return
        worst = costs[finite].max() + 1.0
        ranked = np.where(finite, costs, worst)
        self._strategy.tell(list(samples), ranked.tolist(), check_points=list(range(injected)))


def make_strategy(
    name: str, dimension: int, population: int, rng: np.random.Generator, **options: Any
) -> Strategy:
    """Build a strategy by name.

    Args:
        name: one of :data:`STRATEGIES`.
        dimension: number of variables.
        population: samples per iteration.
        rng: source of randomness.
        **options: ``sigma`` and ``mean``, see :class:`CmaEs`.

    Raises:
        ConfigurationError: unknown name.
    """
    if name not in STRATEGIES:
        raise ConfigurationError(f"no strategy {name!r}; available: {', '.join(STRATEGIES)}")
    strategy = PycmaEs if name.startswith("pycma") else CmaEs
    return strategy(dimension, population, rng, separable="sep" in name, **options)


def _checked_mean(dimension: int, population: int, sigma: float, mean: np.ndarray | None) -> np.ndarray:
    if dimension < 1 or population < 4:
        raise InvalidInputError(
            f"expected dimension >= 1 and population >= 4, got {dimension} and {population}"
        )
    if not (math.isfinite(sigma) and sigma > 0):
        raise InvalidInputError(f"the step size sigma must be finite and positive, got {sigma!r}")
    if mean is None:
        return np.zeros(dimension)
    start = np.array(mean, dtype=float)
    if start.shape != (dimension,) or not np.isfinite(start).all():
        raise InvalidInputError(f"mean must be finite with shape ({dimension},), got {mean!r}")
    return start
