"""Two kinds of one impact: a mixture of two linear-Gaussian models, fitted by expectation and maximisation.

Kinds are told apart by the first output, the velocity along the normal: by how lively they are.

Deviation from 5.2.2, where every sample has one mode: which kind a bounce is of cannot be told beforehand,
but data with a narrow core and a long tail are those of two kinds and not of one wide Gaussian.
"""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.contact.linear_gaussian import LinearGaussian
from vpsto_ros.exceptions import InvalidInputError

_ITERATIONS = 200
_SETTLED = 1e-4  # gain of the log-likelihood after which nothing more is expected
_RARE = 0.15  # share with which the search for the rarer kind begins
_LEAST = 15.0  # samples of the rarer kind; fewer tell nothing about how they scatter


@dataclasses.dataclass(frozen=True, eq=False)
class TwoKinds:
    """A mixture of the usual and, with a probability, a rarer kind.

    Attributes:
        usual: the more frequent one.
        rare: the other; None when the data do not ask for it.
        share: probability of the rarer kind, 0 without one.
    """

    usual: LinearGaussian
    rare: LinearGaussian | None = None
    share: float = 0.0

    def log_parts(self, outputs: NDArray, inputs: NDArray) -> NDArray[np.float64]:
        """Logarithms of the weighted densities of the first output (N, m) by both kinds, shape (2, N)."""
        usual = _first(self.usual).log_densities(outputs[:, :1], inputs)
        if self.rare is None:
            return np.stack([usual, np.full(len(usual), -np.inf)])
        rare = _first(self.rare).log_densities(outputs[:, :1], inputs)
        return np.stack([math.log1p(-self.share) + usual, math.log(self.share) + rare])

    def log_likelihood(self, outputs: NDArray, inputs: NDArray) -> float:
        """Of the first outputs of all samples together."""
        return float(np.logaddexp.reduce(self.log_parts(outputs, inputs), axis=0).sum())

    def distances(self, outputs: NDArray, inputs: NDArray) -> NDArray[np.float64]:
        """Squared Mahalanobis distances (N,) of outputs (N, m), each from the kind that it likely is of."""
        usual = self.usual.distances(outputs, inputs)
        if self.rare is None:
            return usual
        parts = self.log_parts(outputs, inputs)
        return np.where(parts[0] >= parts[1], usual, self.rare.distances(outputs, inputs))


def fit_two_kinds(
    outputs: NDArray, inputs: NDArray, approach: NDArray, *, least_std: float, copies: int = 1
) -> TwoKinds:
    """The mixture that makes samples likeliest, or one kind if the second does not pay for its parameters.

    Args:
        outputs: y, shape (N, m).
        inputs: xi, shape (N, n).
        approach: speeds that the scatter may grow with, shape (f, n).
        least_std: of every output, as for :meth:`LinearGaussian.fit`.
        copies: how often each sample is among the N, mirrored say.

    Raises:
        InvalidInputError: there are too few samples for one kind.
    """
    single = TwoKinds(LinearGaussian.fit(outputs, inputs, least_std=least_std, approach=approach))
    parameters = inputs.shape[1] + 3 + len(approach)  # another row, offset, variance and growth, a share
    needed = copies * 0.5 * parameters * math.log(len(outputs) / copies)  # Schwarz's criterion
    best, reached = single, single.log_likelihood(outputs, inputs) + needed
    off = (outputs - single.usual.mean(inputs))[:, 0] / np.sqrt(single.usual.scales(inputs)[:, 0])
    for side in (1.0, -1.0):
        start = side * off > np.quantile(side * off, 1.0 - _RARE)
        try:
            found = _improved(outputs, inputs, approach, start.astype(float), least_std)
        except InvalidInputError:
            continue  # one of the kinds has no samples left
        enough = found.share * len(outputs) / copies >= _LEAST
        likelihood = found.log_likelihood(outputs, inputs)
        if enough and likelihood > reached:
            best, reached = found, likelihood
    return best


def _improved(
    outputs: NDArray, inputs: NDArray, approach: NDArray, rare: NDArray, least_std: float
) -> TwoKinds:
    """From probabilities (N,) that samples are of the rarer kind to the mixture that agrees with them."""
    before = -math.inf
    for _ in range(_ITERATIONS):
        usual, other = (
            LinearGaussian.fit(outputs, inputs, least_std=least_std, approach=approach, weights=weights)
            for weights in (1.0 - rare, rare)
        )
        found = TwoKinds(usual, other, float(np.clip(rare.mean(), 1e-6, 1.0 - 1e-6)))
        parts = found.log_parts(outputs, inputs)
        total = np.logaddexp(parts[0], parts[1])
        rare, reached = np.exp(parts[1] - total), float(total.sum())
        if reached - before < _SETTLED * max(1.0, abs(before) * 1e-3):
            break
        before = reached
    assert found.rare is not None
    return found if found.share <= 0.5 else TwoKinds(found.rare, found.usual, 1.0 - found.share)


def _first(model: LinearGaussian) -> LinearGaussian:
    """Of the first output alone."""
    return LinearGaussian(
        model.matrix[:1], model.offset[:1], model.covariance[:1, :1], model.growth[:1], model.approach
    )
