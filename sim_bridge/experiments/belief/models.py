"""The two belief models that experiments compare, and what is believed of the disc they push."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import PlanarShape

FRICTION_RANGE = (0.0, 0.6)
"""What is believed of the friction between tools and disc unless an experiment says otherwise."""
CENTER_SHARE = 0.1
"""Standard deviation of the centre of friction that is believed in, as a share of the radius."""


@dataclasses.dataclass(frozen=True)
class Model:
    """How contact is modelled.

    Attributes:
        name: short.
        title: for tables and figures.
        friction: whether the friction and the centre of friction of the particles act.
        step_variance: variance of the perturbation per step in contact [m^2].
        way_variance: variance of the perturbation per metre that the object is pushed [m].
    """

    name: str
    title: str
    friction: bool
    step_variance: float
    way_variance: float

    def dynamics(self, radius: float, effectors: EndEffectors) -> BeliefDynamics:
        """Of a disc among end effectors."""
        return BeliefDynamics(
            PlanarShape.disc(radius), effectors, friction=self.friction,
            step_variance=self.step_variance, way_variance=self.way_variance,
        )  # fmt: skip


THESIS = Model("thesis", "frictionless, noise per step (thesis)", False, 1e-6, 0.0)
"""Frictionless contacts, 1 mm of noise per step in contact."""
FRICTION = Model("friction", "particles carry friction, noise per way", True, 0.0, 1e-4)
"""Particles carry friction and a centre of friction; a push of 10 cm spreads by 3 mm in addition."""
MODELS = {model.name: model for model in (THESIS, FRICTION)}


def disc_belief(
    center: ArrayLike, std: ArrayLike, radius: float, count: int, rng: np.random.Generator, *,
    friction: tuple[float, float] = FRICTION_RANGE,
) -> ObjectBelief:  # fmt: skip
    """A Gaussian belief over a disc; both models get the same one, the frictionless one ignores the friction.

    Args:
        center: mean position (2,) [m].
        std: one for x and y, or one for each [m].
        radius: of the disc [m].
        count: number of particles.
        rng: source of randomness.
        friction: range of the friction between tools and disc.
    """
    pose, spread = [*np.asarray(center, dtype=float), 0.0], [*np.broadcast_to(std, 2), 0.0]
    center_std = CENTER_SHARE * radius
    return ObjectBelief.gaussian(pose, spread, count, rng, friction=friction, center_std=center_std)


def mean_interval(values: Sequence[float] | NDArray, seed: int = 0) -> tuple[float, float]:
    """Bootstrapped 95 % confidence interval of a mean over runs."""
    sample, rng = np.asarray(values, dtype=float), np.random.default_rng(seed)
    means = sample[rng.integers(0, len(sample), (2000, len(sample)))].mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def mean_text(values: Sequence[float] | NDArray, scale: float = 1.0, form: str = ".3f") -> str:
    """Mean and interval for a table."""
    low, high = mean_interval(values)
    return f"{scale * np.mean(values):{form}} ({scale * low:{form}}-{scale * high:{form}})"
