"""What the model of the puck, and how long contacts last, are learned from: steps cut from episodes.

A step with a contact begins just before it and ends after it, so that none sees half of a contact. The mallet
is taken as it was measured: its noise is part of what the filter does not know about a hit.
"""

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.hockey.puck_episodes import Episode, Log, record
from sim_bridge.hockey.recordings import TABLE
from vpsto_ros.contact.puck import PuckModel
from vpsto_ros.contact.puck_learning import PuckRecording, learn
from vpsto_ros.estimation.puck_filter import PuckFilterConfig
from vpsto_ros.estimation.puck_motion import MalletTrack, hit_time

PERIOD = 0.025
"""Of a step [s]; contacts with the mallet last about 18.5 ms."""
_STEPS = round(1e3 * PERIOD)
_LEAST_LEAVING = 0.15  # slower, how long a contact lasted cannot be told [m/s]


def cut(episode: Episode) -> list[PuckRecording]:
    """Recordings of one step each, of every contact that stands alone, and of floating."""
    log, rng = record(episode), np.random.default_rng(episode.seed)
    contacts = np.concatenate([log.contacts["wall"], log.contacts["mallet"]])
    found = []
    for k, (begin, end) in enumerate(contacts):
        others = np.delete(contacts, k, axis=0)
        first = _index(log, begin) - 1 - int(rng.integers(max(1, _STEPS - 2 - round(1e3 * (end - begin)))))
        if _inside(log, first) and _untouched(log, others, first):
            found.append(_step(log, first))
    for first in range(0, len(log.times) - _STEPS, 4 * _STEPS):
        if _untouched(log, contacts, first):
            found.append(_step(log, first))
    return found


def fit(recordings: list[PuckRecording]) -> tuple[PuckModel, PuckFilterConfig]:
    """The model, and the options of the filter with how long contacts were."""
    wall, mallet = _contact_times(recordings, False), _contact_times(recordings, True)
    config = PuckFilterConfig(wall_contact=_timing(wall), mallet_contact=_timing(mallet))
    return learn(recordings, TABLE), config


def _timing(times: NDArray) -> tuple[float, float]:
    """Median, and the standard deviation of the middle two thirds: grazing contacts are not to count."""
    low, middle, high = np.quantile(times, [0.16, 0.5, 0.84])
    return max(float(middle), 0.0), float(0.5 * (high - low))


def _index(log: Log, time: float) -> int:
    return round(1e3 * (time - log.times[0]))


def _inside(log: Log, first: int) -> bool:
    return first >= 0 and first + _STEPS < len(log.times)


def _untouched(log: Log, contacts: NDArray, first: int) -> bool:
    """Whether a step has none of these contacts (C, 2)."""
    begin, end = log.times[first] - 1e-3, log.times[first + _STEPS] + 1e-3
    return not ((contacts[:, 0] < end) & (contacts[:, 1] > begin)).any()


def _step(log: Log, first: int) -> PuckRecording:
    chosen = slice(first, first + _STEPS + 1, _STEPS)
    track = MalletTrack(kept=10.0, extrapolation=0.02)
    for stamp, *state in log.mallet_measured:
        track.append(stamp, np.array(state))
    states = [track.at(time) for time in log.times[chosen]]
    mallet = np.array([np.full(4, np.nan) if state is None else state for state in states])
    return PuckRecording(PERIOD, log.puck[chosen], mallet)


def _contact_times(recordings: list[PuckRecording], mallets: bool) -> NDArray[np.float64]:
    """How long the puck stayed with a wall or the mallet [s], by where it is at the end of the step."""
    found = []
    for recording in recordings:
        met = _met_mallet(recording) if mallets else _met_wall(recording)
        if met is None:
            continue
        time, normal, surface = met
        before, after = recording.puck
        leaving = normal @ (after[2:] - surface)
        if leaving < _LEAST_LEAVING:
            continue
        touch = before[:2] + time * before[2:]
        rest = recording.period - time
        late = normal @ (touch + rest * after[2:] - after[:2])
        found.append(late / leaving)
    return np.array(found)


def _met_wall(recording: PuckRecording) -> tuple[float, NDArray, NDArray] | None:
    """When a wall was met, its normal and its velocity; None if none was, or more than one."""
    before, after = recording.puck
    end = before[:2] + recording.period * before[2:]
    beyond = np.flatnonzero((np.abs(end) > TABLE.reach) & (before[2:] * after[2:] < 0.0))
    if len(beyond) != 1 or _met_mallet(recording) is not None:
        return None
    axis, normal = beyond[0], np.zeros(2)
    side = np.sign(end[axis])
    normal[axis] = -side
    return float((side * TABLE.reach[axis] - before[axis]) / before[2 + axis]), normal, np.zeros(2)


def _met_mallet(recording: PuckRecording) -> tuple[float, NDArray, NDArray] | None:
    """When the mallet was met, the normal from it and its velocity; None if it was not."""
    relative = recording.puck[0] - recording.mallet[0]
    time = hit_time(relative, TABLE.contact_distance)
    if time > recording.period:
        return None
    normal = relative[:2] + time * relative[2:]
    return time, normal / np.linalg.norm(normal), recording.mallet[0, 2:]
