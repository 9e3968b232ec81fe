"""The filters that are compared, fed with what an episode has measured."""

import dataclasses
import functools
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.estimation.episodes import CAN_RADIUS, FORCE_NOISE, Episode, Log, record
from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.estimation.particle_filter import ObjectParticleFilter
from vpsto_ros.estimation.particle_filter_config import ParticleFilterConfig
from vpsto_ros.estimation.planar_kalman import PlanarKalman
from vpsto_ros.robot.tip_kinematics import BALL_RADIUS

DYNAMICS = BeliefDynamics(
    PlanarShape.disc(CAN_RADIUS), EndEffectors.discs(BALL_RADIUS, 2), friction=True, step_variance=0.0,
    way_variance=2e-5,
)  # fmt: skip
VARIANTS = {
    "touch": "particles, force on each ball",
    "touch_sum": "particles, sum of the forces",
    "particles": "particles, no forces",
    "kalman": "Kalman filters, robot unknown",
}
_CHI2 = 5.991  # 95 % of two degrees of freedom


@dataclasses.dataclass(frozen=True)
class Track:
    """How well one filter did.

    Attributes:
        error: distance of the estimate from the can at every time, NaN before the first pose, shape (K,) [m].
        inside: whether the can was within the filter's 95 % ellipse, shape (K,).
        states: kinds of status that occurred, with how many steps each took.
    """

    error: NDArray[np.float64]
    inside: NDArray[np.bool_]
    states: dict[str, int]


@dataclasses.dataclass(frozen=True)
class Comparison:
    """All filters on the same episode.

    Attributes:
        episode: which.
        times: [s], shape (K,).
        dropouts: shape (D, 2) [s].
        touched: first contact [s].
        tracks: by variant.
    """

    episode: Episode
    times: NDArray[np.float64]
    dropouts: NDArray[np.float64]
    touched: float
    tracks: dict[str, Track]


def compare(episode: Episode) -> Comparison:
    """Run an episode, and every filter on what was measured."""
    log = record(episode)
    tracks = {variant: _run(variant, episode, log) for variant in VARIANTS}
    return Comparison(episode, log.times, log.dropouts, log.touched, tracks)


def _run(variant: str, episode: Episode, log: Log) -> Track:
    if variant == "kalman":
        kalman = PlanarKalman()
        return _follow(log, kalman.update, lambda k: kalman.predict(float(log.times[k])), lambda now: "")
    tracker = ObjectParticleFilter(
        ParticleFilterConfig(), DYNAMICS, np.random.default_rng([episode.seed, 29])
    )
    step = functools.partial(_particle_step, tracker, log, variant)
    return _follow(log, tracker.update, step, lambda now: tracker.status(now).kind)


def _particle_step(tracker: ObjectParticleFilter, log: Log, variant: str, k: int) -> ObjectState | None:
    now = float(log.times[k])
    tracker.predict(now, log.points[k])
    if k % 2 == 0 and variant != "particles":
        force = 0.5 * (log.forces[k] + log.forces[max(k - 1, 0)])
        if variant == "touch":
            tracker.touch(now, force, FORCE_NOISE / math.sqrt(2.0))
        else:
            tracker.touch(now, force.sum(axis=0), FORCE_NOISE)
    return tracker.state(now)


def _follow(
    log: Log,
    update: Callable[..., object],
    step: Callable[[int], ObjectState | None],
    status: Callable[[float], str],
) -> Track:
    """Pictures that have arrived go in before each step is judged."""
    error, inside = np.full(len(log.times), np.nan), np.zeros(len(log.times), dtype=bool)
    waiting, states = list(log.pictures), dict[str, int]()
    for k, now in enumerate(log.times):
        state = step(k)
        while waiting and waiting[0].arrival <= now:
            picture = waiting.pop(0)
            update(picture.stamp, picture.pose, picture.covariance)
        kind = status(float(now))
        states[kind] = states.get(kind, 0) + 1
        if state is not None:
            off = state.pose[:2] - log.truth[k, :2]
            error[k] = np.hypot(*off)
            inside[k] = off @ np.linalg.solve(state.covariance[:2, :2], off) <= _CHI2
    return Track(error, inside, states)
