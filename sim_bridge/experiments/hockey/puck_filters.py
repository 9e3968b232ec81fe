"""The piecewise filter and constant-velocity ones on the same episodes, as if in real time."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.hockey.puck_episodes import Episode, Log, record
from vpsto_ros.contact.puck import PuckModel
from vpsto_ros.estimation.puck_filter import PuckFilter, PuckFilterConfig

PIECEWISE, AT_ONCE = "piecewise", "piecewise_at_once"
"""The filter as it is, and with contacts that are over at once, as the thesis has them."""
BOUNCE, HIT, OTHERWISE, IGNORED = 0, 1, 2, -1
"""When: soon after the last bounce or hit; otherwise; during contacts and at the very beginning."""
AFTER = 0.1
"""So long after a contact its effect counts [s]."""

_TICK = 0.005  # estimates are judged at 200 Hz [s]
_BEGINNING = 0.15  # until the filters have seen enough [s]


@dataclasses.dataclass(frozen=True, eq=False)
class Comparison:
    """What the filters were off in an episode.

    Attributes:
        episode: which.
        errors: of the velocity at each instant, by filter, shape (K,) [m/s].
        phase: what had happened at each instant, shape (K,).
        since: since the end of the last contact, shape (K,) [s].
        innovations: normalised innovations squared of the piecewise filter, shape (F,).
        refused: positions that it refused.
    """

    episode: Episode
    errors: dict[str, NDArray[np.float64]]
    phase: NDArray[np.int64]
    since: NDArray[np.float64]
    innovations: NDArray[np.float64]
    refused: int


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """An episode and what the filters know.

    Attributes:
        episode: which.
        model: of the puck.
        config: of the piecewise filter.
        noises: of the constant-velocity filters by name, see :class:`ConstantVelocity`.
    """

    episode: Episode
    model: PuckModel
    config: PuckFilterConfig
    noises: dict[str, float]

    @property
    def seed(self) -> int:
        """Of the episode."""
        return self.episode.seed


class ConstantVelocity:
    """The textbook Kalman filter: constant velocity with white-noise acceleration."""

    def __init__(self, noise: float, position_std: float) -> None:
        """Begin without a puck.

        Args:
            noise: change of the velocity after a second, standard deviation [m/s per sqrt(s)].
            position_std: of measured positions [m].
        """
        self._density, self._variance = noise**2, position_std**2
        self._stamp = 0.0
        self._mean: NDArray[np.float64] | None = None  # (2, 2): position and velocity, of x and of y
        self._covariance = np.diag([position_std**2, 2.5**2])  # the same for x and y

    def update(self, stamp: float, position: NDArray) -> None:
        """Take in a position (2,), whatever it is."""
        if self._mean is None:
            self._stamp, self._mean = stamp, np.array([position, [0.0, 0.0]])
            return
        h = stamp - self._stamp
        f = np.array([[1.0, h], [0.0, 1.0]])
        noise = self._density * np.array([[h**3 / 3.0, h**2 / 2.0], [h**2 / 2.0, h]])
        mean, p = f @ self._mean, f @ self._covariance @ f.T + noise
        gain = p[:, 0] / (p[0, 0] + self._variance)
        self._mean = mean + np.outer(gain, position - mean[0])
        self._covariance, self._stamp = p - np.outer(gain, p[0]), stamp

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Shape (2,) [m/s], now and ever after; NaN before the first position."""
        return np.full(2, np.nan) if self._mean is None else self._mean[1].copy()


def compare(task: Task) -> Comparison:
    """Run all filters on an episode."""
    log = record(task.episode)
    ticks, truth = log.times[:: round(1e3 * _TICK)], log.puck[:: round(1e3 * _TICK), 2:]
    velocities, innovations, refused = piecewise_velocities(log, ticks, task)
    brief = dataclasses.replace(task.config, wall_contact=(0.0, 0.0), mallet_contact=(0.0, 0.0))
    at_once, _, _ = piecewise_velocities(log, ticks, dataclasses.replace(task, config=brief))
    tracks = {PIECEWISE: velocities, AT_ONCE: at_once} | {
        name: constant_velocities(log, ticks, noise, task.config.position_std)
        for name, noise in task.noises.items()
    }
    errors = {name: np.linalg.norm(track - truth, axis=1) for name, track in tracks.items()}
    phase, since = phases(log, ticks)
    return Comparison(task.episode, errors, phase, since, innovations, refused)


def piecewise_velocities(
    log: Log, ticks: NDArray, task: Task
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Velocities (K, 2) that the filter gives at each tick, its innovations (F,), positions refused."""
    estimator = PuckFilter(task.model, task.config)
    found, distances, refused = np.full((len(ticks), 2), np.nan), [], 0
    frame = mallet = 0
    for k, now in enumerate(ticks):
        while mallet < len(log.mallet_measured) and log.mallet_measured[mallet, 0] <= now + 1e-9:
            stamp, *state = log.mallet_measured[mallet]
            estimator.observe_mallet(stamp, state[:2], state[2:])
            mallet += 1
        while frame < len(log.arrivals) and log.arrivals[frame] <= now + 1e-9:
            outcome = estimator.update(log.stamps[frame], log.positions[frame])
            refused += outcome != "accepted"
            distances.append(np.nan if estimator.distance is None else estimator.distance)
            frame += 1
        state_now = estimator.state(now)
        if state_now is not None:
            found[k] = state_now.mean[2:]
    known = np.array(distances)
    return found, known[np.isfinite(known)], refused


def constant_velocities(
    log: Log, ticks: NDArray, noise: float, position_std: float
) -> NDArray[np.float64]:
    """Velocities (K, 2) that a constant-velocity filter gives at each tick."""
    estimator, found, frame = ConstantVelocity(noise, position_std), np.empty((len(ticks), 2)), 0
    for k, now in enumerate(ticks):
        while frame < len(log.arrivals) and log.arrivals[frame] <= now + 1e-9:
            estimator.update(log.stamps[frame], log.positions[frame])
            frame += 1
        found[k] = estimator.velocity
    return found


def phases(log: Log, ticks: NDArray) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """What had happened at each tick, and since when (K,) [s]."""
    phase, since = np.full(len(ticks), OTHERWISE), np.full(len(ticks), np.inf)
    for code, name in ((BOUNCE, "wall"), (HIT, "mallet")):
        for begin, end in log.contacts[name]:
            newer = (ticks >= end) & (ticks - end < since)
            since[newer] = ticks[newer] - end
            phase[newer] = np.where(since[newer] < AFTER, code, OTHERWISE)
            phase[(ticks >= begin) & (ticks < end)] = IGNORED
    for begin, end in np.concatenate(list(log.contacts.values())):
        phase[(ticks >= begin) & (ticks < end)] = IGNORED
    phase[ticks - log.times[0] < _BEGINNING] = IGNORED
    return phase, since
