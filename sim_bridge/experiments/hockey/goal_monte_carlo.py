"""The probability of a goal (5.10) against many trajectories of the stochastic model itself.

Rollouts of Gaussians are exact while the model is linear. Where walls are met at their time, and by way of
which side of a corner, is not; so the gap grows with the number of walls.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.hockey.goal_shots import ANGLES, LATEST, LONGEST, SPREAD
from sim_bridge.hockey.recordings import TABLE
from vpsto_ros.contact.puck import PuckModel

BANKS = (0, 1, 2)
SHOTS = 40
"""Of each number of banks."""
SAMPLES = 4000
"""Trajectories per shot; also N_G of (5.11)."""

_SOME = (0.1, 0.9)  # probabilities that are compared; at both ends any model agrees


@dataclasses.dataclass(frozen=True)
class Agreement:
    """Probabilities of one shot.

    Attributes:
        banks: walls on the likeliest way.
        mass: exact mass of the Gaussians.
        sampled: (5.11), N_G samples of these.
        simulated: share of the model's own trajectories that score.
    """

    banks: int
    mass: float
    sampled: float
    simulated: float


def compare(model: PuckModel, rng: np.random.Generator) -> list[Agreement]:
    """Shots from random places by way of 0, 1 and 2 walls, SHOTS of each as far as there are any."""
    found: list[Agreement] = []
    counts = dict.fromkeys(BANKS, 0)
    for _ in range(20 * SHOTS):
        if min(counts.values()) >= SHOTS:
            break
        puck, mallets = _fan(rng)
        outlook = model.shots(puck, SPREAD, mallets, longest=LONGEST)
        for banks in BANKS:
            some = (outlook.banks == banks) & (outlook.goal > _SOME[0]) & (outlook.goal < _SOME[1])
            some &= outlook.time <= LATEST
            if counts[banks] >= SHOTS or not some.any():
                continue
            mallet = mallets[rng.choice(np.flatnonzero(some))]
            counts[banks] += 1
            found.append(_one(model, puck, mallet, rng))
    return found


def largest_gap(found: list[Agreement]) -> float:
    """Between the mass and trajectories: the mean over shots of its size, for the worst number of banks."""
    return max(row["mean_gap"] for row in summarise(found).values())


def summarise(found: list[Agreement]) -> dict[str, dict[str, float]]:
    """By number of banks: shots, mean and largest gap of the mass, the bias, and the mean gap of (5.11)."""
    rows = {}
    for banks in BANKS:
        chosen = [each for each in found if each.banks == banks]
        if not chosen:
            continue
        gaps = np.array([each.mass - each.simulated for each in chosen])
        sampled = np.array([each.sampled - each.simulated for each in chosen])
        rows[str(banks)] = {
            "shots": len(chosen), "mean_gap": float(np.abs(gaps).mean()), "bias": float(gaps.mean()),
            "worst_gap": float(np.abs(gaps).max()), "sampled_mean_gap": float(np.abs(sampled).mean()),
        }  # fmt: skip
    return rows


def _fan(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    puck = np.array([*rng.uniform((-0.65, -0.35), (-0.2, 0.35)), *rng.normal(0.0, 0.1, 2)])
    directions = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
    speed = rng.uniform(0.8, 1.8)
    return puck, np.hstack([puck[:2] - TABLE.contact_distance * directions, speed * directions])


def _one(model: PuckModel, puck: NDArray, mallet: NDArray, rng: np.random.Generator) -> Agreement:
    exact = model.shots(puck, SPREAD, mallet[None], longest=LONGEST)
    sampled = model.shots(puck, SPREAD, mallet[None], longest=LONGEST, samples=SAMPLES, rng=rng)
    simulated = float(score(model, _after_hits(model, puck, mallet, rng), rng).mean())
    return Agreement(int(exact.banks[0]), float(exact.goal[0]), float(sampled.goal[0]), simulated)


def _after_hits(
    model: PuckModel, puck: NDArray, mallet: NDArray, rng: np.random.Generator
) -> NDArray[np.float64]:
    """States (SAMPLES, 4), as of one time, after hits of pucks that are a bit off, each met at its own."""
    pucks = rng.multivariate_normal(puck, SPREAD, SAMPLES)
    relative = pucks - mallet
    along = np.einsum("ij,ij->i", relative[:, :2], relative[:, 2:])
    square = (relative[:, 2:] ** 2).sum(axis=1)
    apart = (relative[:, :2] ** 2).sum(axis=1) - TABLE.contact_distance**2
    root = along**2 - square * apart
    times = np.where(root > 0.0, (-along - np.sqrt(np.maximum(root, 0.0))) / square, 0.0)[:, None]
    pucks[:, :2] += times * pucks[:, 2:]
    mallets = np.tile(mallet, (SAMPLES, 1))
    mallets[:, :2] += times * mallet[2:]
    mean, covariance = model.hit(pucks, mallets)
    roots = np.linalg.cholesky(covariance[:, 2:, 2:])
    noise = np.einsum("bij,bj->bi", roots, rng.standard_normal((SAMPLES, 2)))
    after = mean + np.hstack([-model.hit_delay * noise, noise])
    after[:, :2] -= times * after[:, 2:]
    return after


def score(model: PuckModel, states: NDArray, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which trajectories from states (S, 4) come into the goal when they first come to its line."""
    paths = model.simulate(states, round(LONGEST / model.period), rng)[:, :-1]
    x, y, vx, vy = np.moveaxis(paths, -1, 0)
    reach = model.table.reach
    with np.errstate(divide="ignore", invalid="ignore"):
        time = (reach[0] - x) / vx
        there = (vx > 0.0) & (x + model.period * vx >= reach[0])
        side = there & (np.abs(y + time * vy) > reach[1])  # a side wall comes first
    arrived = there & ~side
    first = np.argmax(arrived, axis=1)
    rows = np.arange(len(states))
    slopes = vy[rows, first] / np.where(arrived[rows, first], vx[rows, first], 1.0)
    place = y[rows, first] + np.where(arrived.any(axis=1), time[rows, first], 0.0) * vy[rows, first]
    low, high = np.transpose([model.goal_window(slope) for slope in slopes])
    return arrived.any(axis=1) & (low <= place) & (place <= high)
