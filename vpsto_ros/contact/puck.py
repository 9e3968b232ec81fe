"""A learned stochastic model of a puck on an air-hockey table (5.2): floating, bouncing off walls, being hit.

Every mode predicts the velocity after it as a linear-Gaussian function of the velocity before it; positions
follow by integration. Walls and mallet are met at their time between two steps. Frame: the table's, origin in
its centre, x towards the goal that is shot at.
"""

import dataclasses
import functools
import hashlib
import pathlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.contact import puck_file, puck_modes, puck_rollout
from vpsto_ros.contact.hockey_table import HockeyTable
from vpsto_ros.contact.linear_gaussian import LinearGaussian
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError

SHIPPED = pathlib.Path(__file__).parent / "models" / "puck.json"
"""The model of the simulated world, which comes with the package; its origin is in the file."""
MODES = ("floating", "wall", "mallet")
APPROACH: dict[str, tuple[tuple[float, ...], ...]] = {
    "floating": (),
    "wall": ((-1.0, 0.0), (0.0, 1.0)),
    "mallet": ((-1.0, 0.0, 1.0, 0.0), (0.0, -1.0, 0.0, 1.0)),
}
"""Speeds that each mode's scatter may grow with, rows of its inputs: how fast bodies close in, and slip."""
_INPUTS = {"floating": 2, "wall": 2, "mallet": 4}
_TABLE_STEPS = 256  # of floating that are made at once


@dataclasses.dataclass(frozen=True)
class ShotOutlook:
    """What is expected of B shots; NaN where the puck does not come to the goal line in time.

    Bounces are more lively at times, so that a shot with banks has several ways; what is not the probability
    is that of the likeliest way.

    Attributes:
        goal: probability of scoring, (5.10), shape (B,); 0 for those that do not come.
        speed: expected speed at the goal line, shape (B,) [m/s].
        time: expected time from the start to the goal line, shape (B,) [s].
        offset: mean and standard deviation of y at the goal line, shape (B, 2) [m].
        banks: walls met on the way, shape (B,).
    """

    goal: NDArray[np.float64]
    speed: NDArray[np.float64]
    time: NDArray[np.float64]
    offset: NDArray[np.float64]
    banks: NDArray[np.int64]


@dataclasses.dataclass(frozen=True, eq=False)
class PuckModel:
    """The mixture of linear-Gaussian dynamics (5.1)-(5.3).

    Velocities in contact are given along the normal, which points from the wall into the table or from the
    mallet to the puck, and along the tangent, a quarter turn counter-clockwise from it.

    Deviations: scatter may grow with the speed of approach (:class:`LinearGaussian`), and walls may have two
    linear-Gaussian modes between which chance decides: a share of the bounces is more lively than usual.

    Attributes:
        table: geometry.
        period: time of a step [s].
        floating: velocity after a step from the velocity before it.
        wall: velocity after a step with a bounce from the velocity before it, in the frame of contact.
        mallet: velocity after a hit from the puck's and the mallet's before it, (puck, mallet), likewise.
        hit_delay: by how much later than at the touch the velocity seems to have changed: a hit takes its
            time [s].
        lively: like `wall`, of lively bounces; None if there is one kind of bounces.
        lively_share: of all bounces; 0 if there is one kind.

    Raises:
        InvalidInputError: a mode has other inputs or outputs than its own, or its scatter grows with another
            speed than that of approach, the period is not positive, the delay is negative, or the share does
            not fit.
    """

    table: HockeyTable
    period: float
    floating: LinearGaussian
    wall: LinearGaussian
    mallet: LinearGaussian
    hit_delay: float = 0.0
    lively: LinearGaussian | None = None
    lively_share: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.period) and self.period > 0.0):
            raise InvalidInputError(f"the period of a puck model must be positive, got {self.period}")
        if not (np.isfinite(self.hit_delay) and self.hit_delay >= 0.0):
            raise InvalidInputError(f"the delay of hits must not be negative, got {self.hit_delay}")
        for name in MODES:
            _check_mode(name, name, getattr(self, name))
        if self.lively is not None:
            _check_mode("lively", "wall", self.lively)
        if not ((0.0 < self.lively_share < 1.0) if self.lively is not None else self.lively_share == 0.0):
            raise InvalidInputError(
                f"the share of lively bounces must be between 0 and 1, and 0 without any, got "
                f"{self.lively_share}"
            )

    def hit(
        self, puck: ArrayLike, mallet: ArrayLike, *, delayed: bool = True
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Puck states after being hit, (5.3).

        Deviation: a real hit takes about 20 ms, so that the puck moves on as if it had changed its velocity
        `hit_delay` later; its position is shifted back by what that delay takes away.

        Args:
            puck: states (x, y, vx, vy) before, shape (B, 4) [m, m/s].
            mallet: states of the mallet likewise; the normal is the direction from it to the puck.
            delayed: whether positions are shifted by `hit_delay`; not for callers who say themselves where
                the puck is while a hit lasts.

        Returns:
            mean (B, 4) and covariance (B, 4, 4) as of the touch: without a delay positions are those before,
            and certain.

        Raises:
            InvalidInputError: the shapes do not fit, or centres coincide.
        """
        mean, mallet = np.array(puck, dtype=float), np.ascontiguousarray(mallet, dtype=float)
        if mean.ndim != 2 or mean.shape[1] != 4 or mallet.shape != mean.shape:
            raise InvalidInputError(f"expected states (B, 4), got {mean.shape} and {mallet.shape}")
        contact_frames(mean[:, :2] - mallet[:, :2])  # refuses centres that coincide
        covariance = np.zeros((len(mean), 4, 4))
        puck_modes.hits(self.kernel_rows, self.hit_delay if delayed else 0.0, mallet, mean, covariance)
        return mean, covariance

    def step(
        self, mean: ArrayLike, covariance: ArrayLike, duration: float | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """One step of (5.8), or a part of one [s]: mean (4,) and covariance (4, 4) afterwards.

        Deviation: a wall is met at its time, which the state's uncertainty shifts, instead of at a step. Both
        kinds of bounces are taken together, as the Gaussian with the mean and covariance of their mixture.
        """
        part = 1.0 if duration is None else duration / self.period
        state = np.array(mean, dtype=float)
        spread = np.array(covariance, dtype=float)
        puck_modes.step(self.kernel_rows, part, state, spread)
        return state, spread

    def split_step(
        self, mean: ArrayLike, covariance: ArrayLike, duration: float | None = None
    ) -> list[tuple[float, NDArray[np.float64], NDArray[np.float64]]]:
        """:meth:`step` with usual and lively bounces apart: (share, mean, covariance) of each."""
        if self.lively is None:
            return [(1.0, *self.step(mean, covariance, duration))]
        part, found = 1.0 if duration is None else duration / self.period, []
        shares = {puck_modes.WALL: 1.0 - self.lively_share, puck_modes.LIVELY: self.lively_share}
        for kind, share in shares.items():
            state, spread = np.array(mean, dtype=float), np.array(covariance, dtype=float)
            if not puck_modes.step(self.kernel_rows, part, state, spread, kind):
                return [(1.0, state, spread)]
            found.append((share, state, spread))
        return found

    def predict(
        self, mean: ArrayLike, covariance: ArrayLike, times: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """States at several times ahead, as many steps give them, off walls but not off the mallet.

        Args:
            mean: state now, shape (4,).
            covariance: of it, shape (4, 4).
            times: from now on, in any order, shape (K,) [s].

        Returns:
            means (K, 4) and covariances (K, 4, 4). A puck that leaves through a goal goes on behind it.

        Raises:
            InvalidInputError: the shapes do not fit, or a time is negative or not finite.
        """
        first, spreads = np.asarray(mean, dtype=float)[None], np.asarray(covariance, dtype=float)[None]
        means, covariances = self._states(first, spreads)
        ahead = np.asarray(times, dtype=float)
        if ahead.ndim != 1 or not (np.isfinite(ahead) & (ahead >= 0.0)).all():
            raise InvalidInputError("expected times (K,) from 0 on")
        order = np.argsort(ahead, kind="stable")
        found, spread = np.empty((len(ahead), 4)), np.empty((len(ahead), 4, 4))
        puck_rollout.predictions(
            self.kernel_rows, self.floating_table, means[0], covariances[0], ahead[order], found, spread
        )
        back = np.argsort(order)
        return found[back], spread[back]

    def outlook(
        self,
        mean: ArrayLike,
        covariance: ArrayLike,
        *,
        longest: float = 4.0,
        samples: int = 0,
        rng: np.random.Generator | None = None,
    ) -> ShotOutlook:
        """Roll B Gaussian states out to the goal line and weigh the opening of the goal, (5.8)-(5.10).

        Deviations: y is taken where the goal line is crossed, not at the step that follows. The opening
        is where a puck gets in between the rounded posts (:meth:`goal_window`). Usual and lively bounces are
        followed each on its own, as long as that way has a weight worth it, and the masses are added up. The
        mass of a Gaussian is exact, unless samples are asked for.

        Args:
            mean: states after the hit, shape (B, 4).
            covariance: of these, shape (B, 4, 4).
            longest: time after which a puck counts as lost [s].
            samples: N_G of (5.11), the Monte-Carlo form of the mass; 0: exact.
            rng: for the samples.

        Raises:
            InvalidInputError: the shapes do not fit, or there are samples without an rng.
        """
        means, covariances = self._states(mean, covariance)
        found, banks, normals = _outputs(len(means), samples, rng)
        puck_rollout.outlooks(
            self.kernel_rows, self.floating_table, means, covariances, self._steps(longest), normals, found,
            banks,
        )  # fmt: skip
        return ShotOutlook(found[:, 0], found[:, 1], found[:, 2], found[:, 3:], banks)

    def shots(
        self,
        puck: ArrayLike,
        covariance: ArrayLike,
        mallet: ArrayLike,
        *,
        longest: float = 4.0,
        samples: int = 0,
        rng: np.random.Generator | None = None,
    ) -> ShotOutlook:
        """What is expected of B shots: the hit (5.3), then :meth:`outlook`, in one compiled call.

        What is not known of the puck before the hit counts: where it is otherwise, the mallet meets it at
        another time and the normal of the contact is turned, to first order.

        Args:
            puck: state when the mallet touches it, shape (4,) or (B, 4).
            covariance: of it, shape (4, 4) or (B, 4, 4).
            mallet: states of the mallet's centre then, shape (B, 4).
            longest: time after the touch after which a puck counts as lost [s].
            samples: as in :meth:`outlook`.
            rng: likewise.

        Raises:
            InvalidInputError: the shapes do not fit, centres coincide, or there are samples without an rng.
        """
        strikers = np.ascontiguousarray(mallet, dtype=float)
        pucks = np.ascontiguousarray(np.atleast_2d(np.asarray(puck, dtype=float)))
        spreads = np.asarray(covariance, dtype=float)
        spreads = np.ascontiguousarray(spreads[None] if spreads.ndim == 2 else spreads)
        count = len(strikers)
        fits = strikers.shape == (count, 4) and pucks.shape in ((1, 4), (count, 4))
        if not (fits and spreads.shape in ((1, 4, 4), (count, 4, 4))):
            raise InvalidInputError(
                f"expected the puck (4,) or (B, 4), its covariance (4, 4) or (B, 4, 4) and the mallet "
                f"(B, 4), got {np.shape(puck)}, {np.shape(covariance)} and {strikers.shape}"
            )
        if not (np.abs(pucks[:, :2] - strikers[:, :2]).max(axis=1) > 1e-9).all():
            raise InvalidInputError("the centres of puck and mallet coincide; there is no normal")
        found, banks, normals = _outputs(count, samples, rng)
        puck_rollout.shots(
            self.kernel_rows, self.floating_table, pucks, spreads, strikers, self._steps(longest), normals,
            found, banks,
        )  # fmt: skip
        return ShotOutlook(found[:, 0], found[:, 1], found[:, 2], found[:, 3:], banks)

    def goal_window(self, slope: float) -> tuple[float, float]:
        """Lowest and highest y on the goal line from which a puck with slope vy / vx gets in [m].

        Whoever touches a round post still gets in when the bounce off it does not turn the puck back.
        """
        low, high = puck_modes.goal_window(self.kernel_rows, float(slope))
        return float(low), float(high)

    def simulate(
        self, states: ArrayLike, steps: int, rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """Draw trajectories from the stochastic model: states (S, 4) at steps 0..K, shape (S, K + 1, 4).

        Pucks that have crossed a goal line go on floating behind it.
        """
        start = np.ascontiguousarray(states, dtype=float)
        if start.ndim != 2 or start.shape[1] != 4:
            raise InvalidInputError(f"expected states (S, 4), got {start.shape}")
        found = np.empty((len(start), steps + 1, 4))
        noise, choice = rng.standard_normal((len(start), steps, 2)), rng.random((len(start), steps))
        puck_rollout.sampled(self.kernel_rows, start, noise, choice, found)
        return found

    @functools.cached_property
    def kernel_rows(self) -> NDArray[np.float64]:
        """The model as rows of numbers for the compiled rollouts, shape (34, 2)."""
        table = self.table
        rows = [[self.period, table.opening], table.reach, [self.hit_delay, self.lively_share]]
        rows.append([table.contact_distance, table.puck_radius + table.post_radius])
        for mode in (self.floating, self.wall, self.lively or self.wall, self.mallet):
            rows += [*mode.matrix[:, :2], mode.offset, *mode.covariance]
            rows += [*mode.growth] if mode.growth.any() else [[0.0, 0.0], [0.0, 0.0]]
        return np.array([*rows, *self.mallet.matrix[:, 2:]])

    @functools.cached_property
    def fingerprint(self) -> str:
        """Of all its numbers: that of another model differs."""
        table = np.array(dataclasses.astuple(self.table))
        return hashlib.sha256(table.tobytes() + self.kernel_rows.tobytes()).hexdigest()

    @functools.cached_property
    def floating_table(self) -> NDArray[np.float64]:
        """What numbers of floating steps do at once, for the compiled rollouts."""
        return puck_rollout.powers(self.kernel_rows, _TABLE_STEPS)

    def _steps(self, longest: float) -> int:
        return int(np.ceil(longest / self.period))

    def save(self, path: str | pathlib.Path, **origin: Any) -> None:
        """Write a readable file.

        Args:
            path: of the file.
            origin: where the model comes from (command, seed, figures), for people.
        """
        puck_file.write(self, path, origin)

    @classmethod
    def load(cls, path: str | pathlib.Path) -> "PuckModel":
        """Read a file that :meth:`save` wrote.

        Raises:
            ConfigurationError: there is no such file, it is of another format, or its numbers are no model.
        """
        try:
            return cls(**puck_file.read(path))
        except InvalidInputError as error:
            raise ConfigurationError(f"{path} is not a puck model: {error}") from None

    def _states(self, mean: ArrayLike, covariance: ArrayLike) -> tuple[NDArray, NDArray]:
        mean = np.ascontiguousarray(mean, dtype=float)
        covariance = np.ascontiguousarray(covariance, dtype=float)
        if mean.ndim != 2 or mean.shape[1] != 4 or covariance.shape != (len(mean), 4, 4):
            raise InvalidInputError(
                f"expected means (B, 4) and covariances (B, 4, 4), got {mean.shape} and {covariance.shape}"
            )
        return mean, covariance


def _check_mode(name: str, kind: str, mode: LinearGaussian) -> None:
    shape, expected = mode.matrix.shape, (2, _INPUTS[kind])
    if shape != expected:
        raise InvalidInputError(f"the {name} mode needs a matrix {expected}, got {shape}")
    if mode.growth.any() and not np.array_equal(mode.approach, APPROACH[kind]):
        raise InvalidInputError(
            f"the scatter of the {name} mode may only grow with {APPROACH[kind]} of its inputs, the speeds "
            f"of approach, got {mode.approach.tolist()}"
        )


def _outputs(
    count: int, samples: int, rng: np.random.Generator | None
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Room for the outlooks of B shots, and standard normal numbers (B, N)."""
    if samples < 0 or (samples > 0 and rng is None):
        raise InvalidInputError(f"expected samples >= 0, with an rng if there are any, got {samples}")
    normals = np.empty((count, 0)) if rng is None else rng.standard_normal((count, samples))
    return np.empty((count, 5)), np.zeros(count, dtype=np.int64), normals


def contact_frames(normals: ArrayLike) -> NDArray[np.float64]:
    """Frames (B, 2, 2) whose columns are the unit normal and the tangent, of normals (B, 2) of any length.

    Raises:
        InvalidInputError: a normal is zero.
    """
    normals = np.asarray(normals, dtype=float)
    length = np.linalg.norm(normals, axis=-1)
    if (length < 1e-9).any():
        raise InvalidInputError("the centres of two bodies in contact coincide; there is no normal")
    n = normals / length[:, None]
    return np.stack([n, np.stack([-n[:, 1], n[:, 0]], axis=-1)], axis=-1)
