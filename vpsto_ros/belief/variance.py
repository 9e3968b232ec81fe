"""The variance gain of pushes and what it costs, eqs. (6.25)-(6.33), compiled."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vpsto_ros.exceptions import InvalidInputError

GAIN_TOLERANCE = 1e-6
"""A gain of one counts as one within round-off: pushing with a flat side keeps the variance exactly."""
VIOLATION_WEIGHT = 1e3
"""lambda_c of eq. (6.33) for plans that let the variance grow."""


def predicted_variance(variance: NDArray, contact: NDArray, perturbation: float) -> NDArray[np.float64]:
    """One-step predictions of the variance, eq. (6.28).

    Args:
        variance: of the nominal belief at steps 0..K, shape (..., K + 1) [m^2].
        contact: share of particles in contact in each step, shape (..., K).
        perturbation: V_w, variance of the perturbation [m^2].

    Returns:
        shape (..., K).

    Raises:
        InvalidInputError: V_w is not positive and finite.
    """
    require_perturbation(perturbation)
    return variance[..., 1:] + contact * perturbation


def variance_gain(variance: NDArray, contact: NDArray, perturbation: float) -> NDArray[np.float64]:
    """Variance gains gamma, eq. (6.29), with V_{k+1} of (6.28) as numerator; arguments as above."""
    predicted = predicted_variance(variance, contact, perturbation)
    return predicted / (variance[..., :-1] + perturbation)


def require_perturbation(perturbation: float) -> None:
    """Raise InvalidInputError unless V_w is positive: the gain of a gathered belief is undefined without."""
    if not (math.isfinite(perturbation) and perturbation > 0.0):
        raise InvalidInputError(
            f"the variance of the perturbation V_w must be positive and finite, got {perturbation}"
        )


@njit(cache=True, nogil=True, error_model="numpy")
def robustness_costs(variance, contact, perturbation, cost, worst, largest=1.0):
    """Eq. (6.32) with (6.33), and the largest gain, of B candidates.

    Deviation: the exponents are divided by the number of steps K instead of K - 1, which is 0 for K = 1.

    Args:
        variance: nominal variances, shape (B, K + 1).
        contact: shares in contact, shape (B, K).
        perturbation: V_w.
        cost: output, shape (B,).
        worst: output, largest gain, shape (B,).
        largest: gain that a plan may have, 1 in eq. (6.33).
    """
    steps = contact.shape[1]
    for b in range(contact.shape[0]):
        total, most = 0.0, 0.0
        for k in range(steps):
            gain = (variance[b, k + 1] + contact[b, k] * perturbation) / (variance[b, k] + perturbation)
            total += 1.0 - gain
            most = max(most, gain)
        weight = 1.0 if most <= largest + GAIN_TOLERANCE else VIOLATION_WEIGHT
        cost[b], worst[b] = weight * np.exp(-total / steps), most
