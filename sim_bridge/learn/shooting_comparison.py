"""What the energy-based policy and direct search make of the same puck."""

import dataclasses
import time

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.planning.hockey.shooting_config import Shot
from vpsto_ros.planning.hockey.shooting_policy import PolicySamples, ShootingPolicy
from vpsto_ros.planning.hockey.shooting_search import ShotSearch, Strokes

STEPS = 25
"""Of Algorithm 2, from uniform samples."""


@dataclasses.dataclass(frozen=True, eq=False)
class Comparison:
    """Both for one state of the puck at the touch.

    Attributes:
        state: shape (4,).
        direct: the best shot of direct search, None if none keeps the constraints.
        policy: the shot at the policy's angle, None if the arm cannot make it or it misses the goal line.
        ratio: objective of the policy's over that of direct search: 0 if it breaks a constraint, NaN if
            direct search finds no shot.
        direct_s: duration of the search [s].
        inference_s: durations of the steps of Algorithm 2, shape (STEPS,) [s].
    """

    state: NDArray[np.float64]
    direct: Shot | None
    policy: Shot | None
    ratio: float
    direct_s: float
    inference_s: NDArray[np.float64]


def compare(
    search: ShotSearch, policy: ShootingPolicy, state: NDArray, covariance: NDArray, rng: np.random.Generator
) -> Comparison:
    """Ask both for a shot.

    Args:
        search: of a setting.
        policy: of the same.
        state: of the puck at the touch, shape (4,).
        covariance: of it, shape (4, 4).
        rng: for the policy's samples.
    """
    began = time.perf_counter()
    direct = search.best(0.0, state, covariance)
    direct_s = time.perf_counter() - began
    angle, inference_s = 0.0, np.empty(STEPS)
    samples: PolicySamples | None = None
    for step in range(STEPS):
        began = time.perf_counter()
        angle, samples = policy.infer(state, samples, rng)
        inference_s[step] = time.perf_counter() - began
    if direct is not None and not search.taken(direct):
        direct = None
    found = shot_at(search, state, covariance, angle)
    kept = found is not None and search.taken(found)
    value = found.value if found is not None and kept else 0.0
    ratio = value / direct.value if direct is not None else np.nan
    return Comparison(state, direct, found, ratio, direct_s, inference_s)


def shot_at(search: ShotSearch, state: NDArray, covariance: NDArray, angle: float) -> Shot | None:
    """The shot at an angle with the largest speed, None if there is none or it misses the goal line."""
    angles = np.array([angle])
    speeds = search.speeds(state[None, :2], angles)
    if not speeds[0] > 0.0:
        return None
    strokes = Strokes(np.zeros(1), state[None], covariance[None], angles, speeds)
    shot = search.shot(strokes, search.outlook(strokes), 0)
    return shot if np.isfinite(shot.goal_speed) else None
