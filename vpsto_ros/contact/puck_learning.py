"""Learning the puck model from recordings (5.2.2): which mode every step was, and a Gaussian fit for each."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.contact.linear_gaussian import LinearGaussian
from vpsto_ros.contact.puck import APPROACH, HockeyTable, PuckModel, contact_frames
from vpsto_ros.contact.two_kinds import TwoKinds, fit_two_kinds
from vpsto_ros.exceptions import InvalidInputError

FLOATING, WALL, MALLET, UNCLEAR = 0, 1, 2, -1
"""Modes of a step; unclear: more than one contact, a goal, or too near a contact to be sure of none."""

_MARGIN = 2e-3  # how near a contact a step without one must not come [m]
_TOUCH = 5e-4  # how deep the motion at the beginning of a step must take the mallet into the puck [m]
_POST = 1e-2  # how far beside its opening a goal still differs from a straight wall [m]
_PARTS = np.linspace(0.0, 1.0, 41)[:, None]  # parts of a step at which gaps to the mallet are looked at
_NAMES = {FLOATING: "floating", WALL: "wall", MALLET: "mallet"}


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
                "a recording needs puck and mallet (T, 4) with T >= 2, "
                f"got {shape} and {np.shape(self.mallet)}"
            )
        if not np.isfinite(self.puck).all() or not self.period > 0.0:
            raise InvalidInputError("a recording needs finite states of the puck and a positive period")


def label(recording: PuckRecording, table: HockeyTable, contact_time: float = 0.0) -> NDArray[np.int64]:
    """The mode of each of the T - 1 steps, from geometry: what the motion at its beginning must have met.

    Labels are strict: a step with two contacts, near a post or a second wall, or that begins or ends during
    a contact, is unclear. A hit is labelled in the step in which the mallet touches.

    Args:
        recording: what was seen.
        table: geometry.
        contact_time: longest time that mallet and puck stay in touch [s].
    """
    walls, near_wall = _walls(recording, table)
    touches = _touches(recording, table)
    modes = np.full(len(walls), UNCLEAR)
    modes[~near_wall & ~touches.near] = FLOATING
    modes[walls & ~touches.near] = WALL
    ends = _ends(touches.time, recording.period, contact_time)
    for k in np.flatnonzero(touches.met):
        last = k + ends[k]
        modes[k:last] = UNCLEAR
        if last <= len(modes) and not near_wall[k:last].any() and touches.gap[last] > 0.0:
            modes[k] = MALLET
    return modes


def learn(
    recordings: Sequence[PuckRecording], table: HockeyTable, contact_time: float = 0.0
) -> PuckModel:
    """Fit the three modes, and the delay of hits that take their time.

    Bounces and hits count twice, as they were and mirrored across the normal: neither side is special.

    Args:
        recordings: all with one period.
        table: geometry.
        contact_time: longest time that mallet and puck stay in touch [s].

    Raises:
        InvalidInputError: there is no recording, periods differ, or a mode was seen too rarely.
    """
    return fit(collect(recordings, table, contact_time), table)


@dataclasses.dataclass(frozen=True, eq=False)
class LabelledSteps:
    """Pairs for the fits, one row per labelled step, bounces and hits in their frames of contact.

    Attributes:
        period: of a step [s].
        outputs: velocities afterwards by mode, shapes (N, 2) [m/s].
        inputs: velocities before by mode, shapes (N, 2), for hits those of puck and mallet (N, 4) [m/s].
        elapsed: time from each touch of the mallet to the velocity after it, shape (N,) [s].
        advance: how far the puck came in that time, shape (N, 2) [m].
        unclear: steps that are of no use.
    """

    period: float
    outputs: dict[int, NDArray[np.float64]]
    inputs: dict[int, NDArray[np.float64]]
    elapsed: NDArray[np.float64]
    advance: NDArray[np.float64]
    unclear: int

    def counts(self) -> dict[str, int]:
        """How many steps there are of each mode, and unclear ones."""
        return {name: len(self.outputs[mode]) for mode, name in _NAMES.items()} | {"unclear": self.unclear}

    def part(self, rows: Callable[[int], NDArray]) -> "LabelledSteps":
        """Some of them: `rows` tells which of a number of steps to keep, as a mask (n,)."""
        kept = {mode: rows(len(self.outputs[mode])) for mode in _NAMES}
        return dataclasses.replace(
            self, outputs={mode: self.outputs[mode][kept[mode]] for mode in _NAMES},
            inputs={mode: self.inputs[mode][kept[mode]] for mode in _NAMES},
            elapsed=self.elapsed[kept[MALLET]], advance=self.advance[kept[MALLET]],
        )  # fmt: skip


def collect(
    recordings: Sequence[PuckRecording], table: HockeyTable, contact_time: float = 0.0
) -> LabelledSteps:
    """Label recordings and take the steps of every mode out of them; arguments as for :func:`learn`.

    Raises:
        InvalidInputError: there is no recording, or periods differ.
    """
    periods = {recording.period for recording in recordings}
    if len(periods) != 1:
        raise InvalidInputError(f"recordings must have one period, got {sorted(periods)}")
    found: dict[int, list] = {mode: [] for mode in _NAMES}
    unclear = 0
    for recording in recordings:
        modes = label(recording, table, contact_time)
        unclear += int((modes == UNCLEAR).sum())
        found[FLOATING].append(_floating_pairs(recording, np.flatnonzero(modes == FLOATING)))
        found[WALL].append(_wall_pairs(recording, np.flatnonzero(modes == WALL), table))
        found[MALLET].append(_mallet_pairs(recording, np.flatnonzero(modes == MALLET), table, contact_time))
    rows = {mode: [np.concatenate(column) for column in zip(*found[mode], strict=True)] for mode in _NAMES}
    return LabelledSteps(
        periods.pop(), {mode: rows[mode][0] for mode in _NAMES}, {mode: rows[mode][1] for mode in _NAMES},
        rows[MALLET][2], rows[MALLET][3], unclear,
    )  # fmt: skip


def fit(steps: LabelledSteps, table: HockeyTable) -> PuckModel:
    """The model of labelled steps, (5.4)-(5.5).

    Deviations: how much the scatter of bounces and hits grows with the speed of approach is fitted too, and
    bounces may be of two kinds (:mod:`vpsto_ros.contact.two_kinds`).

    Raises:
        InvalidInputError: a mode was seen too rarely.
    """
    floating = _fit(FLOATING, steps.outputs[FLOATING], steps.inputs[FLOATING], LinearGaussian.fit)
    wall = _fit(
        WALL, *_mirrored(steps.outputs[WALL], steps.inputs[WALL]), fit_two_kinds, copies=2,
        approach=np.array(APPROACH["wall"]),
    )
    after = velocities_at_touch(steps, floating)
    mallet = _fit(
        MALLET, *_mirrored(after, steps.inputs[MALLET]), LinearGaussian.fit, approach=APPROACH["mallet"]
    )
    delay = _delay(steps, after)
    return PuckModel(table, steps.period, floating, wall.usual, mallet, delay, wall.rare, wall.share)


def widening(
    steps: LabelledSteps, table: HockeyTable, *, levels: Sequence[float] = (0.9, 0.95, 0.99), folds: int = 5
) -> dict[str, float]:
    """Factors of the standard deviations with which fits hold for steps that they have not seen.

    Bounces and hits scatter with longer tails than a Gaussian. Each fold of the steps is judged by the fit of
    the others; a factor takes the Gaussian's ellipses of some probabilities to at least these shares of all
    steps.

    Args:
        steps: to learn from.
        table: geometry.
        levels: the shares.
        folds: parts that the steps are cut into, one after the other left out.

    Returns:
        Factors by mode, at least 1: narrower than fitted is never right.

    Raises:
        InvalidInputError: a mode was seen too rarely.
    """
    distances: dict[int, list[NDArray]] = {mode: [] for mode in _NAMES}
    for fold in range(folds):
        model = fit(steps.part(lambda n: np.arange(n) % folds != fold), table)  # noqa: B023
        unseen = steps.part(lambda n: np.arange(n) % folds == fold)  # noqa: B023
        for mode, squared in step_distances(unseen, model).items():
            distances[mode].append(squared)
    allowed = -2.0 * np.log1p(-np.asarray(levels))  # chi-squared with 2 degrees of freedom
    reached = {mode: np.quantile(np.concatenate(distances[mode]), levels) for mode in _NAMES}
    return {
        name: max(1.0, math.sqrt(float((reached[mode] / allowed).max()))) for mode, name in _NAMES.items()
    }


def step_distances(steps: LabelledSteps, model: PuckModel) -> dict[int, NDArray[np.float64]]:
    """Squared Mahalanobis distances (N,) of steps from what a model expects of them, by mode.

    A bounce counts as one of the kind that it likely was, usual or lively.
    """
    outputs = {**steps.outputs, MALLET: velocities_at_touch(steps, model.floating)}
    modes: dict[int, LinearGaussian | TwoKinds] = {
        FLOATING: model.floating, WALL: TwoKinds(model.wall, model.lively, model.lively_share),
        MALLET: model.mallet,
    }  # fmt: skip
    return {mode: modes[mode].distances(outputs[mode], steps.inputs[mode]) for mode in _NAMES}


def widened(model: PuckModel, factors: Mapping[str, float]) -> PuckModel:
    """A model with other standard deviations, by factors for its modes."""
    modes = {name: getattr(model, name).widened(factor) for name, factor in factors.items()}
    if model.lively is not None:
        modes["lively"] = model.lively.widened(factors["wall"])
    return dataclasses.replace(model, **modes)


def velocities_at_touch(steps: LabelledSteps, floating: LinearGaussian) -> NDArray[np.float64]:
    """What the velocities (N, 2) after hits must have been at once: traced back through floating [m/s].

    The floating mode is taken as the same in every direction, which a level table is.
    """
    keep = 0.5 * float(np.trace(floating.matrix))
    parts = steps.elapsed / steps.period
    return steps.outputs[MALLET] / keep ** parts[:, None]


def _delay(steps: LabelledSteps, after: NDArray) -> float:
    """How much later than at the touch a sudden change of velocity would come out at the same place [s]."""
    jump = after - steps.inputs[MALLET][:, :2]
    straight = 0.5 * steps.elapsed[:, None] * (after + steps.outputs[MALLET])
    return max(0.0, float(((straight - steps.advance) * jump).sum() / (jump * jump).sum()))


def _fit(mode: int, outputs: NDArray, inputs: NDArray, fitted: Callable[..., Any], **options: Any) -> Any:
    try:
        return fitted(outputs, inputs, least_std=1e-4, **options)
    except InvalidInputError as error:
        raise InvalidInputError(
            f"the {_NAMES[mode]} mode cannot be learned from {len(outputs)} steps: {error}"
        ) from None


def _mirrored(outputs: NDArray, inputs: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Outputs and inputs in frames of contact, and what a mirror shows across the normal."""
    mirror = np.tile([1.0, -1.0], inputs.shape[1] // 2)
    return np.vstack([outputs, outputs * [1.0, -1.0]]), np.vstack([inputs, inputs * mirror])


def _walls(recording: PuckRecording, table: HockeyTable) -> tuple[NDArray, NDArray]:
    """Which steps, shape (T - 1,), are the bounce of one wall, and which come near a wall or a goal."""
    puck, after = recording.puck[:-1], recording.puck[1:]
    end = puck[:, :2] + recording.period * puck[:, 2:]
    places = np.stack([puck[:, :2], end, after[:, :2]])
    depths = np.abs(places) - table.reach
    close: NDArray = np.any(depths > -_MARGIN, axis=0)  # by axis
    # Both ways of passing a wall: into it at the start's velocity, and back out of it at the end's.
    met = (depths[0] < -_MARGIN) & (depths[1] > _MARGIN) & (depths[2] < 0.0)
    met &= (puck[:, 2:] * end > 0.0) & (after[:, 2:] * end < 0.0)
    mouth = (np.abs(places[..., 1]) < 0.5 * table.goal_width + _POST) & (depths[..., 0] > -_POST)
    at_goal: NDArray = np.any(mouth, axis=0)
    bounce = np.all(met == close, axis=1) & (met.sum(axis=1) == 1) & ~at_goal
    return bounce, np.any(close, axis=1) | at_goal


@dataclasses.dataclass(frozen=True, eq=False)
class _Touches:
    """Puck and mallet in each of T - 1 steps.

    Attributes:
        met: whether they touch for certain, having been apart.
        near: whether they touch or come near.
        time: when they touch or are nearest, after the beginning of the step, shape (T - 1,) [s].
        offset: from the mallet's centre to the puck's then, shape (T - 1, 2) [m].
        velocity: of the mallet then, shape (T - 1, 2) [m/s].
        gap: between their rims at each of the T samples [m].
    """

    met: NDArray[np.bool_]
    near: NDArray[np.bool_]
    time: NDArray[np.float64]
    offset: NDArray[np.float64]
    velocity: NDArray[np.float64]
    gap: NDArray[np.float64]


def _touches(recording: PuckRecording, table: HockeyTable) -> _Touches:
    """Where a puck in straight motion and a mallet that speeds up evenly in each step come together."""
    puck, period = recording.puck[:-1], recording.period
    there: NDArray = np.all(np.isfinite(recording.mallet), axis=1)
    mallet = np.where(there[:, None], recording.mallet, 100.0)  # far away
    gap = np.linalg.norm(recording.puck[:, :2] - mallet[:, :2], axis=1) - table.contact_distance
    start, change = puck - mallet[:-1], mallet[1:, 2:] - mallet[:-1, 2:]
    change[~(there[:-1] & there[1:])] = 0.0

    def offset(parts: NDArray) -> NDArray:
        return start[:, :2] + period * (parts * start[:, 2:] - 0.5 * parts**2 * change)

    def gaps(parts: NDArray) -> NDArray:
        return np.linalg.norm(offset(parts), axis=-1) - table.contact_distance

    course = np.stack([gaps(part) for part in _PARTS])
    inside: NDArray = np.any(course < 0.0, axis=0)
    first = np.where(inside, np.argmax(course < 0.0, axis=0), course.argmin(axis=0))
    part = _refined(gaps, first, inside)
    near = (course.min(axis=0) < _MARGIN) | (gap[:-1] < _MARGIN) | (gap[1:] < _MARGIN)
    met = (gap[:-1] > _TOUCH) & (course.min(axis=0) < -_TOUCH) & there[:-1] & there[1:]
    velocity = mallet[:-1, 2:] + part * change
    return _Touches(met, near, period * part[:, 0], offset(part), velocity, gap)


def _refined(gaps: Callable[[NDArray], NDArray], first: NDArray, inside: NDArray) -> NDArray[np.float64]:
    """Parts of the step, shape (N, 1), at which gaps close, by bisection; where none does, the nearest."""
    high = _PARTS[first]
    low = np.where(inside[:, None], _PARTS[np.maximum(first - 1, 0)], high)
    for _ in range(20):
        middle = 0.5 * (low + high)
        touching = (gaps(middle) < 0.0)[:, None]
        low, high = np.where(touching, low, middle), np.where(touching, middle, high)
    return np.where(inside[:, None], high, _PARTS[first])


def _ends(time: NDArray, period: float, contact_time: float) -> NDArray[np.int64]:
    """How many steps after its own sample a touch is over for certain, at least 1."""
    return np.maximum(1, np.ceil((time + contact_time) / period - 1e-9)).astype(np.int64)


def _floating_pairs(recording: PuckRecording, steps: NDArray) -> tuple[NDArray, NDArray]:
    return recording.puck[steps + 1, 2:], recording.puck[steps, 2:]


def _wall_pairs(recording: PuckRecording, steps: NDArray, table: HockeyTable) -> tuple[NDArray, NDArray]:
    """Outputs and inputs, both (N, 2), in the frames of the walls."""
    puck = recording.puck[steps]
    end = puck[:, :2] + recording.period * puck[:, 2:]
    axis = np.argmax(np.abs(end) - table.reach, axis=1)[:, None]
    frames = contact_frames(np.where(np.arange(2) == axis, -np.sign(end), 0.0))
    return _seen_in(frames, recording.puck[steps + 1, 2:]), _seen_in(frames, puck[:, 2:])


def _mallet_pairs(
    recording: PuckRecording, steps: NDArray, table: HockeyTable, contact_time: float
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Outputs (N, 2), inputs (N, 4), elapsed times (N,) and advances (N, 2) of hits, in their frames."""
    touches = _touches(recording, table)
    time = touches.time[steps]
    ends = _ends(time, recording.period, contact_time)
    frames = contact_frames(touches.offset[steps])
    before, after = recording.puck[steps], recording.puck[steps + ends]
    advance = after[:, :2] - before[:, :2] - time[:, None] * before[:, 2:]
    inputs = [_seen_in(frames, v) for v in (before[:, 2:], touches.velocity[steps])]
    return (
        _seen_in(frames, after[:, 2:]), np.concatenate(inputs, axis=1),
        ends * recording.period - time, _seen_in(frames, advance),
    )  # fmt: skip


def _seen_in(frames: NDArray, vectors: NDArray) -> NDArray[np.float64]:
    """Vectors (N, 2) in frames (N, 2, 2)."""
    return np.einsum("bij,bi->bj", frames, vectors)
