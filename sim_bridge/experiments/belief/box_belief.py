"""Pushing a box along a line: the one example whose belief has a closed form, eqs. (6.12)-(6.14)."""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError


@dataclasses.dataclass(frozen=True)
class BoxPush:
    """A hand comes from the left and stops at u; the box is known to be somewhere in an interval.

    Attributes:
        lower: left end of the interval [m].
        upper: right end [m].
        noise: alpha, by how much a pushed box may end beyond the hand: uniform in [0, alpha] [m].
    """

    lower: float = 0.0
    upper: float = 0.1
    noise: float = 0.02

    def __post_init__(self) -> None:
        finite = np.isfinite([self.lower, self.upper, self.noise]).all()
        if not finite or self.lower >= self.upper or self.noise < 0.0:
            raise InvalidInputError(
                f"a box needs an interval lower < upper and a noise >= 0, got {self.lower}, {self.upper} and "
                f"{self.noise}"
            )

    def contact(self, u: ArrayLike) -> NDArray[np.float64]:
        """Probability that a hand that stops at u has touched the box: E[eta]."""
        return self._positions(u) / (self.upper - self.lower)

    def mean(self, u: ArrayLike) -> NDArray[np.float64]:
        """Mean position after the push, of the mixture (6.14)."""
        touched, stop = self.contact(u), np.asarray(u, dtype=float)
        return touched * (stop + 0.5 * self.noise) + (1.0 - touched) * 0.5 * (stop + self.upper)

    def variance(self, u: ArrayLike) -> NDArray[np.float64]:
        """Variance after the push, of the mixture (6.14) [m^2]."""
        return self._mixture_variance(u, 0.5 * self.noise, self.noise**2 / 12.0)

    def predicted_variance(self, u: ArrayLike, *, centred: bool) -> NDArray[np.float64]:
        """The deterministic prediction (6.21), V_b[f] + E[eta] V_w, with exact V_b and E[eta].

        Args:
            u: where the hand stops [m].
            centred: whether the mean alpha / 2 of the noise belongs to the nominal model f, so that what is
                left has zero mean as (6.17) assumes. Without, f puts the box exactly at the hand, and the
                noise of (6.12) breaks the assumption.
        """
        nominal = self._mixture_variance(u, 0.5 * self.noise if centred else 0.0, 0.0)
        return nominal + self.contact(u) * self.noise**2 / 12.0

    def density(self, u: float, positions: ArrayLike) -> NDArray[np.float64]:
        """Density of the belief after the push [1/m]; a noise of zero has none."""
        if self.noise == 0.0:
            raise InvalidInputError("without noise a share of the belief is a point and has no density")
        x, touched = np.asarray(positions, dtype=float), float(self.contact(u))
        pushed = ((x >= u) & (x <= u + self.noise)) / self.noise
        rest = ((x > u) & (x <= self.upper)) / max(self.upper - u, 1e-300)
        return touched * pushed + (1.0 - touched) * rest

    def distribution(self, u: float, positions: ArrayLike) -> NDArray[np.float64]:
        """Probability that the box is at a position or left of it, after the push."""
        x, touched = np.asarray(positions, dtype=float), float(self.contact(u))
        pushed = np.clip((x - u) / self.noise, 0.0, 1.0) if self.noise > 0.0 else (x >= u).astype(float)
        rest = np.clip((x - u) / max(self.upper - u, 1e-300), 0.0, 1.0)
        return touched * pushed + (1.0 - touched) * rest

    def sample(self, u: float, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """Particles after the push, by the dynamics (6.12) alone, shape (count,)."""
        before = rng.uniform(self.lower, self.upper, count)
        return np.where(before > u, before, u + rng.uniform(0.0, self.noise, count))

    def _positions(self, u: ArrayLike) -> NDArray[np.float64]:
        way = np.asarray(u, dtype=float) - self.lower
        if not ((way >= 0.0) & (way <= self.upper - self.lower)).all():
            raise InvalidInputError(f"the hand must stop within [{self.lower}, {self.upper}], got {u!r}")
        return way

    def _mixture_variance(self, u: ArrayLike, shift: float, spread: float) -> NDArray[np.float64]:
        """Of boxes that the hand moves to u + shift with a variance, and those that it does not reach."""
        touched, free = self.contact(u), self.upper - np.asarray(u, dtype=float)
        between = (0.5 * free - shift) ** 2
        return touched * spread + (1.0 - touched) * (free**2 / 12.0 + touched * between)
