"""Default parameters of CMA-ES and sep-CMA-ES: recombination weights and learning rates.

They are those of Hansen, "The CMA Evolution Strategy: A Tutorial" (2016), Table 1, with the learning rates of
Ros and Hansen (2008) for the separable variant. The one exception is c_sigma, whose denominator ends in + 3
as in the ``cma`` package (4.5) instead of + 5: with the tutorial's value the full strategy needs up to 3 %
more iterations than the package on ill-conditioned functions. All other constants of the full strategy are
equal, too, except for d_sigma of populations that are large for the dimension (24 in 14 dimensions, where the
default would be 11): there the package damps the step size more than the tutorial does, and takes longer.
"""

import dataclasses
import functools
import math

import numpy as np


@dataclasses.dataclass(frozen=True)
class StrategyParameters:
    """Parameters for a dimension D and a population size M, in the symbols of the tutorial.

    ``weights`` (M,) are ordered by rank: the first ``mu`` are positive and sum to one, the others are
    negative or zero and only used for the covariance. ``chi`` is the expected length of a standard normal
    vector, ``lazy_gap`` the number of updates of C after which its eigenvectors are computed anew.
    """

    weights: np.ndarray
    mu: int
    mu_eff: float
    c_sigma: float
    d_sigma: float
    c_c: float
    c_1: float
    c_mu: float
    chi: float
    lazy_gap: float


@functools.lru_cache(maxsize=256)
def default_parameters(
    dimension: int, population: int, separable: bool, active: bool = True
) -> StrategyParameters:
    """Recombination weights and learning rates.

    Args:
        dimension: number of variables D >= 1.
        population: number of samples per iteration M >= 4.
        separable: scale c_1 and c_mu by (D + 2) / 3, because only D variances are learned.
        active: give the worse half negative weights; without, they are zero.
    """
    n, mu = dimension, population // 2
    raw = math.log((population + 1) / 2) - np.log(np.arange(1, population + 1))
    weights = np.zeros(population)
    weights[:mu] = raw[:mu] / raw[:mu].sum()
    mu_eff = float(1.0 / np.square(weights).sum())
    c_sigma = min(0.5, (mu_eff + 2) / (n + mu_eff + 3))
    d_sigma = 1 + 2 * max(0.0, math.sqrt((mu_eff - 1) / (n + 1)) - 1) + c_sigma
    c_c = (4 + mu_eff / n) / (n + 4 + 2 * mu_eff / n)
    faster = (n + 2) / 3 if separable else 1.0
    c_1 = min(1.0, faster * 2 / ((n + 1.3) ** 2 + mu_eff))
    c_mu = min(1 - c_1, faster * 2 * (0.25 + mu_eff + 1 / mu_eff - 2) / ((n + 2) ** 2 + mu_eff))
    if active:
        weights[mu:] = _negative_weights(raw[mu:], n, mu_eff, c_1, c_mu)
    weights.flags.writeable = False
    chi = math.sqrt(2) * math.exp(math.lgamma((n + 1) / 2) - math.lgamma(n / 2))
    # The eigenvectors change little within this many updates, and C stays positive definite: they take less
    # than the share (lazy_gap + 1) n (c_1 + c_mu) <= 1 of it away in any direction.
    lazy_gap = 0.5 / (n * (c_1 + c_mu))
    return StrategyParameters(weights, mu, mu_eff, c_sigma, d_sigma, c_c, c_1, c_mu, chi, lazy_gap)


def _negative_weights(raw: np.ndarray, n: int, mu_eff: float, c_1: float, c_mu: float) -> np.ndarray:
    """Weights of the worse half from its raw weights, eqs. (50) to (53) of the tutorial."""
    shares = raw / -raw.sum()
    mu_eff_minus = 1.0 / float(shares @ shares)
    alpha_mu = 1 + c_1 / c_mu  # nothing is forgotten: c_1 + c_mu sum w = 0
    alpha_mu_eff = 1 + 2 * mu_eff_minus / (mu_eff + 2)  # no more than so many bad samples can tell
    alpha_posdef = (1 - c_1 - c_mu) / (n * c_mu)  # C stays positive definite if ||C^(-1/2) y||^2 <= n
    return min(alpha_mu, alpha_mu_eff, alpha_posdef) * shares
