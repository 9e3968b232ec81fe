"""What is expected of a shot, to be looked at: the way of the puck and how uncertain it is.

Frame: the table's, origin in its centre, x towards the goal that is shot at.
"""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.contact.puck import PuckModel
from vpsto_ros.estimation.puck_filter import PuckState
from vpsto_ros.planning.hockey.shooting_config import ShootingConfig, Shot

_NUDGE = np.array([1e-5, 1e-5, 1e-4, 1e-4])  # of a state, to see what it changes [m, m/s]


@dataclasses.dataclass(frozen=True, eq=False)
class ShotPreview:
    """States of the puck to come.

    Attributes:
        times: of the states, increasing, shape (K,) [s].
        mean: x, y, vx, vy, shape (K, 4) [m, m/s].
        covariance: of these, shape (K, 4, 4).
        touch: index of the first state after the touch; K without a shot.
    """

    times: NDArray[np.float64]
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    touch: int


def preview(
    model: PuckModel, config: ShootingConfig, puck: PuckState, shot: Shot | None, *, step: float = 0.05,
    longest: float = 2.0,
) -> ShotPreview:  # fmt: skip
    """The puck from its estimate to the touch, and from there to the goal line.

    Args:
        model: of the puck.
        config: how well the mallet is placed.
        puck: estimate.
        shot: None to look at the puck alone.
        step: between two states [s].
        longest: time after the touch, or after the estimate without a shot [s].
    """
    ahead = longest if shot is None else max(shot.time - puck.stamp, 0.0)
    before = np.linspace(0.0, ahead, max(math.ceil(ahead / step), 1) + 1)
    mean, covariance = model.predict(puck.mean, puck.covariance, before)
    if shot is None:
        kept = _on_table(model, mean)
        return ShotPreview(puck.stamp + before[kept], mean[kept], covariance[kept], int(kept.sum()))
    start, spread = _hit(model, config, mean[-1], covariance[-1], shot)
    after = np.arange(0.0, longest, step)
    onward, spreads = model.predict(start, spread, after)
    kept = _on_table(model, onward)
    return ShotPreview(
        np.concatenate([puck.stamp + before, puck.stamp + ahead + after[kept]]),
        np.concatenate([mean, onward[kept]]), np.concatenate([covariance, spreads[kept]]), len(before),
    )  # fmt: skip


def _on_table(model: PuckModel, states: NDArray) -> NDArray[np.bool_]:
    """Which states (K, 4) on a way (K,) are on the table, and the first one behind a goal line."""
    behind = np.abs(states[:, 0]) > model.table.half_length
    return np.cumsum(np.cumsum(behind)) <= 1


def _hit(
    model: PuckModel, config: ShootingConfig, puck: NDArray, covariance: NDArray, shot: Shot
) -> tuple[NDArray, NDArray]:
    """State (4,) after the touch and its covariance, that of the puck carried along to first order."""
    direction = np.array([math.cos(shot.angle), math.sin(shot.angle)])
    across = np.array([-direction[1], direction[0]])
    mallet = np.concatenate([puck[:2] - shot.contact_distance * direction, shot.speed * direction])
    nudges = np.concatenate([np.zeros((1, 4)), np.diag(_NUDGE), -np.diag(_NUDGE)])
    means, spreads = model.hit(puck + nudges, np.tile(mallet, (9, 1)))
    slope = (means[1:5] - means[5:]).T / (2.0 * _NUDGE)
    known = covariance.copy()
    known[:2, :2] += config.aim_std**2 * np.outer(across, across)  # the mallet is off as if the puck were
    return means[0], spreads[0] + slope @ known @ slope.T
