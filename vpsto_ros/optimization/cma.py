"""Evolution strategies with covariance matrix adaptation, vectorised for small populations and short loops.

:class:`CmaEs` is CMA-ES with positive recombination weights and the default parameters of Hansen, "The CMA
Evolution Strategy: A Tutorial" (2016), and its separable variant with the learning rates of Ros and Hansen
(2008). External solutions are accepted as in Hansen, "Injecting external solutions into CMA-ES" (2011).
:class:`PycmaEs` is the same interface on the ``cma`` package, kept as a choice and as the reference in the
tests.
"""

import dataclasses
import functools
import math
from typing import Any, Protocol

import numpy as np

from vpsto_ros.exceptions import ConfigurationError, InvalidInputError

STRATEGIES = ("sep-cma", "cma", "pycma", "pycma-sep")
_SIGMA_RANGE = (1e-30, 1e30)
_LARGEST_CONDITION = 1e14
"""Of the covariance; beyond it the short axes are round-off (the same constant as in pycma)."""

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


@dataclasses.dataclass(frozen=True)
class StrategyParameters:
    """Hansen's default parameters for a dimension and a population size, in the symbols of the tutorial."""

    weights: np.ndarray
    mu_eff: float
    c_sigma: float
    d_sigma: float
    c_c: float
    c_1: float
    c_mu: float
    chi: float
    lazy_gap: float


@functools.lru_cache(maxsize=256)
def default_parameters(dimension: int, population: int, separable: bool) -> StrategyParameters:
    """Recombination weights and learning rates.

    Args:
        dimension: number of variables D.
        population: number of samples per iteration M.
        separable: scale c_1 and c_mu by (D + 2) / 3, because only D variances are learned.
    """
    n = dimension
    raw = math.log((population + 1) / 2) - np.log(np.arange(1, population // 2 + 1))
    weights = raw / raw.sum()
    weights.flags.writeable = False
    mu_eff = float(1.0 / np.square(weights).sum())
    c_sigma = (mu_eff + 2) / (n + mu_eff + 5)
    d_sigma = 1 + 2 * max(0.0, math.sqrt((mu_eff - 1) / (n + 1)) - 1) + c_sigma
    c_c = (4 + mu_eff / n) / (n + 4 + 2 * mu_eff / n)
    faster = (n + 2) / 3 if separable else 1.0
    c_1 = min(1.0, faster * 2 / ((n + 1.3) ** 2 + mu_eff))
    c_mu = min(1 - c_1, faster * 2 * (0.25 + mu_eff + 1 / mu_eff - 2) / ((n + 2) ** 2 + mu_eff))
    chi = math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
    # The eigenvectors change little within this many iterations; the same constant as in pycma.
    lazy_gap = 0.5 / (n * (c_1 + c_mu))
    return StrategyParameters(weights, mu_eff, c_sigma, d_sigma, c_c, c_1, c_mu, chi, lazy_gap)


class CmaEs:
    """CMA-ES (full covariance) or sep-CMA-ES (diagonal covariance), minimising.

    The samples of an iteration are x_i = m + sigma y_i with y_i ~ N(0, C). ``sigma`` may be changed between
    iterations.

    Args:
        dimension: number of variables D >= 1.
        population: samples per iteration M >= 4.
        rng: source of randomness.
        sigma: initial step size, > 0.
        mean: initial mean, shape (D,); zeros by default.
        separable: adapt the diagonal of C only.

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
    ) -> None:
        self._mean = _checked_mean(dimension, population, sigma, mean)
        self.sigma = float(sigma)
        self.separable = separable
        self.population = population
        self.iterations = 0
        self._rng = rng
        self._parameters = default_parameters(dimension, population, separable)
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
            costs: shape (M,). Non-finite costs rank last and never contribute; if none is finite nothing is
                learned. Nothing is learned either once the distribution :func:`has_collapsed`.
            injected: number of leading rows that did not come from :meth:`ask`. Their steps are shortened to
                a length the distribution could have drawn, so that a distant one cannot blow up the
                covariance.
        """
        self.iterations += 1
        order, weights, mu_eff = self._select(costs)
        if not weights.size or has_collapsed(self):
            return
        steps = (samples[order] - self._mean) / self.sigma
        if injected:
            self._shorten(steps, order < injected)
        step = weights @ steps
        self._mean = self._mean + self.sigma * step
        length, stalled = self._update_paths(step, mu_eff)
        self._update_covariance(steps, weights, stalled)
        p = self._parameters
        self.sigma *= math.exp(min(1.0, (p.c_sigma / p.d_sigma) * (length / p.chi - 1)))
        self.sigma = min(max(self.sigma, _SIGMA_RANGE[0]), _SIGMA_RANGE[1])

    def _select(self, costs: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Indices of the best samples, their weights and the effective number of them."""
        p = self._parameters
        finite = np.isfinite(costs)
        count = int(np.count_nonzero(finite))
        if count < costs.size:
            costs = np.where(finite, costs, np.inf)
        order = np.argsort(costs, kind="stable")[: p.weights.size]
        if count >= p.weights.size:
            return order, p.weights, p.mu_eff
        weights = p.weights[:count] / p.weights[:count].sum() if count else p.weights[:0]
        return order[:count], weights, 1.0 / float(weights @ weights) if count else 0.0

    def _shorten(self, steps: np.ndarray, rows: np.ndarray) -> None:
        n = self._mean.size
        longest = math.sqrt(n) + 2 * n / (n + 2)
        lengths = np.linalg.norm(self._whiten(steps[rows]), axis=1)
        steps[rows] *= np.minimum(1.0, longest / np.maximum(lengths, 1e-300))[:, None]

    def _whiten(self, steps: np.ndarray) -> np.ndarray:
        """C^{-1/2} y for steps in the last axis."""
        if self._basis is None:
            return steps / self._scales
        return ((steps @ self._basis) / self._scales) @ self._basis.T

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
        p = self._parameters
        kept = 1 - p.c_1 - p.c_mu + (p.c_1 * p.c_c * (2 - p.c_c) if stalled else 0.0)
        if self.separable:
            self._covariance = kept * self._covariance
            self._covariance += p.c_1 * self._path_c**2 + p.c_mu * (weights @ steps**2)
            np.maximum(self._covariance, self._covariance.max() / _LARGEST_CONDITION, out=self._covariance)
            self._scales = np.sqrt(self._covariance)
            return
        rank_mu = (steps.T * (p.c_mu * weights)) @ steps
        self._covariance = kept * self._covariance + rank_mu + (p.c_1 * self._path_c)[:, None] * self._path_c
        self._since_decomposition += 1
        if self._since_decomposition > p.lazy_gap:
            self._decompose()

    def _decompose(self) -> None:
        values, self._basis = np.linalg.eigh(self._covariance)
        # Round-off can push the smallest eigenvalue of an ill-conditioned matrix below zero.
        self._scales = np.sqrt(np.maximum(values, values[-1] / _LARGEST_CONDITION))
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
    ) -> None:
        import cma  # imported here because it takes more than a second and is optional

        start = _checked_mean(dimension, population, sigma, mean)
        options = {
            "popsize": population,
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
