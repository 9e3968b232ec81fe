"""Predicting pucks of recorded episodes from true states, and where they really went."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_bridge.hockey import table
from sim_bridge.hockey.contact_log import MALLET, PuckContact
from sim_bridge.hockey.recordings import TABLE, Episode
from vpsto_ros.contact.puck import PuckModel

HORIZONS = (0.1, 0.2, 0.5)  # [s]
KINDS = ("floating", "wall", "hit", "hit_wall")
"""Nothing met; a wall; from the mallet's touch on; the same, and then a wall."""

_EVERY = 10  # samples between predictions of a puck that floats
_DENT = 3e-3  # how deep pucks may push into a rim [m]
_MARGIN = 2e-3  # a puck that comes to a wall within so long is not taken to float [s]
_LEAD = 1  # whole steps from the start of a prediction to the bounce


Way = tuple[float, NDArray[np.float64], NDArray[np.float64]]
"""Weight, mean and covariance of a Gaussian in a mixture."""
_DRAWN = 4000  # samples of a mixture
_LEAST_WEIGHT = 0.01  # of a way that is followed on its own


@dataclasses.dataclass(frozen=True, eq=False)
class Prediction:
    """Gaussians for where a puck is after a horizon, and where it was; table frame.

    Attributes:
        kind: one of KINDS.
        horizon: nominal, one of HORIZONS [s].
        start: place of the puck at the beginning, shape (2,) [m].
        mean: expected place, shape (2,) [m].
        covariance: of the place, shape (2, 2) [m²].
        truth: shape (2,) [m].
        ways: (weight, mean, covariance) of the mixture that these are of, one for each way of bouncing; none:
            it is this one Gaussian.
    """

    kind: str
    horizon: float
    start: NDArray[np.float64]
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    truth: NDArray[np.float64]
    ways: tuple[Way, ...] = ()

    @property
    def error(self) -> float:
        """Distance between expected and true place [m]."""
        return float(np.linalg.norm(self.truth - self.mean))

    @property
    def distance(self) -> float:
        """Squared Mahalanobis distance, which decides about ellipses.

        Of a mixture, the one that has as much of a Gaussian's mass nearer as the mixture has where it is
        denser: what is the ellipse of a probability for a Gaussian is for it the densest region.
        """
        if len(self.ways) < 2:
            off = self.truth - self.mean
            return float(off @ np.linalg.solve(self.covariance, off))
        rng = np.random.default_rng(0)
        weights = np.array([weight for weight, _, _ in self.ways])
        counts = np.maximum(np.round(_DRAWN * weights).astype(int), 1)
        drawn = [
            rng.multivariate_normal(mean, covariance, count)
            for (_, mean, covariance), count in zip(self.ways, counts, strict=True)
        ]
        denser = _density(self.ways, np.vstack(drawn)) > _density(self.ways, self.truth[None])[0]
        share = min(float(np.repeat(weights / counts, counts) @ denser), 1.0 - 0.5 / _DRAWN)
        return -2.0 * float(np.log1p(-share))


def predictions(episode: Episode, model: PuckModel) -> list[Prediction]:
    """All predictions of an episode: while floating, from before each bounce, and from each touch.

    Those in which the puck comes into the mouth of a goal do not count: there a shot is over.
    """
    found = []
    for horizon in HORIZONS:
        for sample in range(0, len(episode.recording.puck), _EVERY):
            found.append(_from_sample(episode, model, sample, horizon, "floating"))
        for contact in episode.contacts:
            if contact.surface == MALLET:
                found.append(_from_touch(episode, model, contact, horizon))
            else:
                sample = int((contact.start - episode.start) / model.period) - _LEAD
                found.append(_from_sample(episode, model, sample, horizon, "wall"))
    return [prediction for prediction in found if prediction is not None]


def _from_sample(
    episode: Episode, model: PuckModel, sample: int, horizon: float, kind: str
) -> Prediction | None:
    """From a true state; None if the puck meets something else than its kind says, or comes into a goal."""
    end = sample + round(horizon / model.period)
    over = episode.start + end * model.period + _MARGIN
    met = _met(episode, episode.start + sample * model.period, over)
    puck = episode.recording.puck
    if sample < 0 or not _seen(episode, end) or MALLET in met or bool(met) != (kind == "wall"):
        return None
    start = (1.0, puck[sample].copy(), np.zeros((4, 4)))
    ways = rolled(model, start, [model.period] * (end - sample))
    return Prediction(kind, horizon, puck[sample, :2], *merged(ways), puck[end, :2], ways)


def _from_touch(
    episode: Episode, model: PuckModel, contact: PuckContact, horizon: float
) -> Prediction | None:
    """From the true states of puck and mallet at their touch to the first sample after the horizon."""
    assert contact.mallet is not None
    time = contact.start - episode.start
    first = int(np.floor(time / model.period)) + 1
    end = int(np.ceil((time + horizon) / model.period - 1e-9))
    met = _met(episode, contact.start, episode.start + end * model.period, contact)
    if not _seen(episode, end) or MALLET in met:
        return None
    start = np.array([*table.to_table(contact.pose[:2]), *contact.velocity_before[:2]])
    mallet = np.array([*table.to_table(contact.mallet.position[:2]), *contact.mallet.velocity[:2]])
    means, covariances = model.hit(start[None], mallet[None])
    durations = [first * model.period - time] + [model.period] * (end - first)
    ways = rolled(model, (1.0, means[0], covariances[0]), durations)
    truth = episode.recording.puck[end, :2]
    return Prediction("hit_wall" if met else "hit", horizon, start[:2], *merged(ways), truth, ways)


def rolled(model: PuckModel, start: Way, durations: Sequence[float]) -> tuple[Way, ...]:
    """Ways (weight, place, covariance of the place) after steps, from a state and its covariance."""
    ways = [start]
    for duration in durations:
        after: list[Way] = []
        for weight, mean, covariance in ways:
            parts = model.split_step(mean, covariance, duration)
            if len(parts) > 1 and weight * min(share for share, _, _ in parts) < _LEAST_WEIGHT:
                parts = [(1.0, *model.step(mean, covariance, duration))]
            after += [(weight * share, state, spread) for share, state, spread in parts]
        ways = after
    return tuple((weight, mean[:2], covariance[:2, :2]) for weight, mean, covariance in ways)


def merged(ways: Sequence[Way]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and covariance of a mixture."""
    mean = np.sum([weight * way for weight, way, _ in ways], axis=0)
    spreads = [
        weight * (covariance + np.outer(way - mean, way - mean)) for weight, way, covariance in ways
    ]
    return mean, np.sum(spreads, axis=0)


def _density(ways: Sequence[Way], places: NDArray) -> NDArray[np.float64]:
    """Of a mixture at places (N, 2)."""
    total = np.zeros(len(places))
    for weight, mean, covariance in ways:
        off = places - mean
        squared = np.einsum("ni,ij,nj->n", off, np.linalg.inv(covariance), off)
        total += weight * np.exp(-0.5 * squared) / np.sqrt(np.linalg.det(covariance))
    return total


def _met(episode: Episode, begin: float, end: float, apart_from: PuckContact | None = None) -> set[str]:
    """Surfaces touched between two times [s], other than in one contact."""
    others = [contact for contact in episode.contacts if contact is not apart_from]
    return {contact.surface for contact in others if contact.start <= end and contact.end >= begin}


def _seen(episode: Episode, end: int) -> bool:
    """Whether the episode lasts that long and the puck is in no goal's mouth until then."""
    puck = episode.recording.puck[: end + 1]
    inside = np.abs(puck[:, 0]) < TABLE.reach[0] + _DENT
    return end < len(episode.recording.puck) and bool(inside.all())
