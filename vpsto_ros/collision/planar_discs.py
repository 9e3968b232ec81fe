"""Discs in motion: as obstacles whose motion is known, and as ones that may turn at any moment.

The motion of a disc in a :class:`~vpsto_ros.collision.planar.PlanarWorld` is taken at its word.
:class:`DiscMargin` is for discs that are only measured: it keeps away from wherever they may have got to
until the robot has had the time to react.
"""

import dataclasses
import math
from typing import Any, ClassVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vpsto_ros.collision.planar_checks import items, number, planar, positive, vector
from vpsto_ros.collision.planar_kernels import TOUCH
from vpsto_ros.collision.planar_path_kernels import disc_cuts, hermite_piece, set_path, workspace
from vpsto_ros.collision.planar_roots import value_and_slope
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory import TrajectoryBatch


@dataclasses.dataclass(frozen=True, eq=False)
class MovingDisc:
    """A disc in uniform motion.

    Args:
        centre: position at time 0 of the clock that trajectories use, shape (2,) [m].
        radius: [m], positive.
        velocity: shape (2,) [m/s].

    Raises:
        InvalidInputError: an argument is not finite, has the wrong shape, or the radius is not positive.
    """

    centre: NDArray[np.float64]
    radius: float
    velocity: NDArray[np.float64] = (0.0, 0.0)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", vector("disc: centre", self.centre))
        object.__setattr__(self, "velocity", vector("disc: velocity", self.velocity))
        object.__setattr__(self, "radius", positive("disc: radius", self.radius))

    def position(self, time: float) -> NDArray[np.float64]:
        """Centre at a time [s], shape (2,) [m].

        Raises:
            InvalidInputError: the time is not finite.
        """
        return self.centre + number("time", time) * self.velocity

    def at(self, time: float) -> "MovingDisc":
        """The disc as a clock sees it that starts at this time [s].

        Raises:
            InvalidInputError: the time is not finite.
        """
        return MovingDisc(self.position(time), self.radius, self.velocity)


def checked_discs(discs: Any) -> tuple[MovingDisc, ...]:
    """Discs as a tuple.

    Raises:
        InvalidInputError: it is no sequence of discs.
    """
    found = items("discs", discs)
    if not all(isinstance(disc, MovingDisc) for disc in found):
        raise InvalidInputError(f"discs must be MovingDisc objects, got {discs!r}")
    return found


def disc_rows(discs: tuple[MovingDisc, ...]) -> NDArray[np.float64]:
    """Rows x, y, velocity (2), radius as the kernels take them, shape (D, 5)."""
    rows = [(*disc.centre, *disc.velocity, disc.radius) for disc in discs]
    return np.array(rows, dtype=np.float64).reshape(-1, 5)


@dataclasses.dataclass(frozen=True, eq=False)
class DiscMargin:
    """The constraint to keep away from discs that may turn at any moment.

    For a look-ahead time t the distance to where a disc is predicted to be must be at least its radius plus
    ``margin + 2 |v| min(t, reaction)``: a disc that turns back now is 2 |v| t from its prediction, and after
    the reaction time the robot has seen it and given way. The time too near is exact for every instant, from
    the roots of polynomials of degree six, as that of a :class:`~vpsto_ros.collision.planar.PlanarWorld`.

    It is time and not the share of the duration, which a slow detour elsewhere would lower.

    Attributes:
        discs: as measured; their clocks start at the measurement.
        delay: time from the measurement to the start of the trajectories [s], not negative.
        margin: what to keep away besides [m], not negative.
        reaction: after which the robot has given way to a disc that turned [s], not negative.
        weight: cost of a second too near; well above the cost of a second of motion [1/s].

    Raises:
        InvalidInputError: something is not finite, out of range or no disc.
    """

    static: ClassVar[bool] = False
    """A goal that a disc covers now need not stay covered."""

    discs: tuple[MovingDisc, ...]
    delay: float
    margin: float
    reaction: float
    weight: float = 100.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "discs", checked_discs(self.discs))
        for name in ("delay", "margin", "reaction"):
            value = number(f"disc margin: {name}", getattr(self, name), least=0.0)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "weight", positive("disc margin: weight", self.weight))

    def __call__(self, batch: TrajectoryBatch) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Cost (B,) and validity (B,) of trajectories."""
        seconds = self.time_too_near(batch)
        return self.weight * seconds, seconds == 0.0

    def time_too_near(self, batch: TrajectoryBatch) -> NDArray[np.float64]:
        """Time (B,) [s] too near to discs, summed over them; infinite for an infinite duration.

        Raises:
            InvalidInputError: the trajectories do not have two degrees of freedom.
        """
        planar(batch.key_positions.shape[2])
        return times_too_near(
            batch.knots, batch.key_positions, batch.knot_slopes, batch.duration, disc_rows(self.discs),
            self.delay, self.margin, self.reaction,
        )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def times_too_near(knots, keys, slopes, durations, discs, delay, margin, reaction):
    """Time (B,) [s] that cubic Hermite segments are too near to discs, summed over the discs.

    Args:
        knots: phases (N + 2,).
        keys: key positions (B, N + 2, 2) [m].
        slopes: q' at the knots (B, N + 2, 2) [m].
        durations: (B,) [s]. What is not finite in a row gives it an infinite time.
        discs: (D, 5) rows x, y, velocity (2), radius at the measurement.
        delay: from the measurement to phase zero [s].
        margin: [m].
        reaction: [s].
    """
    total = np.zeros(len(keys))
    space = workspace(4, 3)
    control = np.empty((4, 2))
    for b in range(len(keys)):
        for i in range(knots.size - 1):
            hermite_piece(knots, keys, slopes, b, i, control)
            start, end = delay + durations[b] * knots[i], delay + durations[b] * knots[i + 1]
            if not math.isfinite(start + end + control.sum() + discs.sum() + margin + reaction):
                total[b] = np.inf
                break
            for disc in discs:
                share = _share_too_near(control, disc, start, end, margin, reaction, space)
                total[b] += (end - start) * share
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _share_too_near(control, disc, start, end, margin, reaction, space):
    """Share of a cubic piece, from `start` to `end` [s] after the measurement, too near to a disc."""
    growth, rest = 2.0 * math.hypot(disc[2], disc[3]), disc[4] + margin
    hull = set_path(control, 3, disc, start, end, space.path)
    if max(hull[0], hull[1], -hull[2], -hull[3]) >= rest + growth * min(end, reaction):
        return 0.0
    cuts, count = space.cuts, 1
    if start < reaction:
        count = disc_cuts(rest + growth * start, rest + growth * end, 3, space, count)
    if end > reaction:
        count = disc_cuts(rest + growth * reaction, rest + growth * reaction, 3, space, count)
    if start < reaction < end:
        cuts[count] = (reaction - start) / (end - start)
        count += 1
    cuts[0] = 0.0
    cuts[1:count].sort()
    cuts[count] = 1.0
    share = 0.0
    for c in range(count):
        u = 0.5 * (cuts[c] + cuts[c + 1])
        x, _ = value_and_slope(space.path[0], 3, u, space.work)
        y, _ = value_and_slope(space.path[1], 3, u, space.work)
        if math.hypot(x, y) < rest + growth * min(start + u * (end - start), reaction) - TOUCH:
            share += cuts[c + 1] - cuts[c]
    return share
