"""Learning the puck model from recordings (5.2.2): which mode every step was, and a Gaussian fit for each."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.contact.linear_gaussian import LinearGaussian
from vpsto_ros.contact.puck import HockeyTable, PuckModel, contact_frames
from vpsto_ros.exceptions import InvalidInputError

FLOATING, WALL, MALLET, UNCLEAR = 0, 1, 2, -1
"""Modes of a step; unclear: more than one contact, a goal, or too near a contact to be sure of none."""

_MARGIN = 2e-3  # how near a contact a step without one must not come [m]


@dataclasses.dataclass(frozen=True, eq=False)
class PuckRecording:
    """States of puck and mallet at a fixed period, in the table's frame.

    Attributes:
        period: between two samples [s].
        puck: x, y, vx, vy, shape (T, 4) [m, m/s].
        mallet: likewise; NaN while there is none.

    Raises:
        InvalidInputError: the shapes do not fit, a puck's state is not finite, or the period is not positive.
    """

    period: float
    puck: NDArray[np.float64]
    mallet: NDArray[np.float64]

    def __post_init__(self) -> None:
        shape = np.shape(self.puck)
        if len(shape) != 2 or shape[1] != 4 or shape[0] < 2 or np.shape(self.mallet) != shape:
            raise InvalidInputError(
                f"a recording needs puck and mallet (T, 4) with T >= 2, got {shape} and {np.shape(self.mallet)}"
            )
        if not np.isfinite(self.puck).all() or not self.period > 0.0:
            raise InvalidInputError("a recording needs finite states of the puck and a positive period")


def label(recording: PuckRecording, table: HockeyTable) -> NDArray[np.int64]:
    """The mode of each of the T - 1 steps, from geometry alone: what straight motion would have met."""
    puck, mallet, period = recording.puck[:-1], recording.mallet[:-1], recording.period
    end = puck[:, :2] + period * puck[:, 2:]
    wall, near_wall = _walls(puck, end, recording.puck[1:], table)
    hit, near_mallet = _hits(puck, mallet, period, table)
    modes = np.full(len(puck), UNCLEAR)
    modes[~near_wall & ~near_mallet] = FLOATING
    modes[(wall == 1) & ~near_mallet] = WALL
    modes[hit & ~near_wall] = MALLET
    gone = np.abs(recording.puck[:, 0]) > table.reach[0] + _MARGIN
    modes[gone[:-1] | gone[1:]] = UNCLEAR
    return modes


def learn(recordings: Sequence[PuckRecording], table: HockeyTable) -> PuckModel:
    """Fit the three modes.

    Bounces and hits count twice, as they were and mirrored across the normal: neither side is special.

    Raises:
        InvalidInputError: there is no recording, periods differ, or a mode was seen too rarely.
    """
    periods = {recording.period for recording in recordings}
    if len(periods) != 1:
        raise InvalidInputError(f"recordings must have one period, got {sorted(periods)}")
    labels = [label(recording, table) for recording in recordings]
    pairs = {mode: _pairs(recordings, labels, mode, table) for mode in (FLOATING, WALL, MALLET)}
    names = {FLOATING: "floating", WALL: "wall", MALLET: "mallet"}
    fits = {}
    for mode, (outputs, inputs) in pairs.items():
        try:
            fits[names[mode]] = LinearGaussian.fit(outputs, inputs, least_std=1e-4)
        except InvalidInputError as error:
            raise InvalidInputError(
                f"the {names[mode]} mode cannot be learned from {len(outputs)} steps: {error}"
            ) from None
    return PuckModel(table, periods.pop(), **fits)


def _walls(
    puck: NDArray, end: NDArray, after: NDArray, table: HockeyTable
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """How many walls straight motion would have met in each step, and where one was near."""
    beyond = np.abs(end) - table.reach
    outward = np.sign(puck[:, 2:]) == np.sign(end)
    opening = np.abs(end[:, 1]) < 0.5 * table.goal_width
    beyond[opening, 0] = np.where(np.abs(end[opening, 0]) > table.reach[0] - 0.1, 0.0, -1.0)
    turned = np.sign(after[:, 2:]) != np.sign(puck[:, 2:])
    met = (beyond > _MARGIN) & outward & turned
    met[opening, 0] = False
    near = (beyond > -_MARGIN) | turned & (beyond > -0.1)
    return met.sum(axis=1), near.any(axis=1)


def _hits(
    puck: NDArray, mallet: NDArray, period: float, table: HockeyTable
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """In which steps straight motion of both would have met, and where it would have come near."""
    there = np.isfinite(mallet).all(axis=1)
    offset = np.where(there[:, None], puck[:, :2] - mallet[:, :2], 10.0)
    speed = np.where(there[:, None], puck[:, 2:] - mallet[:, 2:], 0.0)
    square = np.einsum("ti,ti->t", speed, speed)
    time = np.clip(-np.einsum("ti,ti->t", offset, speed) / np.maximum(square, 1e-12), 0.0, period)
    nearest = np.linalg.norm(offset + time[:, None] * speed, axis=1) - table.contact_distance
    apart = np.linalg.norm(offset, axis=1) - table.contact_distance
    closing = np.einsum("ti,ti->t", offset, speed) < 0.0
    return (nearest < -_MARGIN) & (apart > -_MARGIN) & closing, nearest < _MARGIN


def _pairs(
    recordings: Sequence[PuckRecording], labels: Sequence[NDArray], mode: int, table: HockeyTable
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Outputs (N, 2) and inputs (N, 2 or 4) of the steps of a mode."""
    rows = [np.flatnonzero(modes == mode) for modes in labels]
    before = np.vstack([r.puck[k] for r, k in zip(recordings, rows, strict=True)])
    after = np.vstack([r.puck[k + 1] for r, k in zip(recordings, rows, strict=True)])[:, 2:]
    mallet = np.vstack([r.mallet[k] for r, k in zip(recordings, rows, strict=True)])
    if mode == FLOATING or not len(before):
        return after, before[:, 2:]
    normals = (
        _wall_normals(before, recordings[0].period, table) if mode == WALL
        else _contact_normals(before, mallet, recordings[0].period, table)
    )  # fmt: skip
    frames = contact_frames(normals)
    velocities = [before[:, 2:]] + ([mallet[:, 2:]] if mode == MALLET else [])
    inputs = np.concatenate([np.einsum("bij,bi->bj", frames, v) for v in velocities], axis=1)
    outputs = np.einsum("bij,bi->bj", frames, after)
    mirror = np.tile([1.0, -1.0], len(velocities))
    return np.vstack([outputs, outputs * [1.0, -1.0]]), np.vstack([inputs, inputs * mirror])


def _wall_normals(before: NDArray, period: float, table: HockeyTable) -> NDArray[np.float64]:
    """Into the table, (N, 2): of the wall that is passed farthest by straight motion."""
    end = before[:, :2] + period * before[:, 2:]
    axis = np.argmax(np.abs(end) - table.reach, axis=1)
    normals = np.zeros((len(before), 2))
    rows = np.arange(len(before))
    normals[rows, axis] = -np.sign(end[rows, axis])
    return normals


def _contact_normals(
    before: NDArray, mallet: NDArray, period: float, table: HockeyTable
) -> NDArray[np.float64]:
    """From mallet to puck where straight motion makes them touch, (N, 2)."""
    offset, speed = before[:, :2] - mallet[:, :2], before[:, 2:] - mallet[:, 2:]
    a = np.einsum("ti,ti->t", speed, speed)
    b = np.einsum("ti,ti->t", offset, speed)
    c = np.einsum("ti,ti->t", offset, offset) - table.contact_distance**2
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    time = np.clip((-b - root) / np.maximum(a, 1e-12), 0.0, period)
    return offset + time[:, None] * speed
