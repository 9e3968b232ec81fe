"""A learned stochastic model of a puck on an air-hockey table (5.2): floating, bouncing off walls, being hit.

Every mode predicts the velocity after it as a linear-Gaussian function of the velocity before it; positions
follow by integration. Walls and mallet are met at their time between two steps. Frame: the table's, origin in
its centre, x towards the goal that is shot at.
"""

import dataclasses
import json
import pathlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.contact import puck_rollout
from vpsto_ros.contact.linear_gaussian import LinearGaussian
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError

FORMAT = "vpsto_ros puck model 1"
SHIPPED = pathlib.Path(__file__).parent / "models" / "puck.json"
"""The model of the simulated world, which comes with the package; its origin is in the file."""
MODES = ("floating", "wall", "mallet")
_INPUTS = {"floating": 2, "wall": 2, "mallet": 4}


@documented
@dataclasses.dataclass(frozen=True)
class HockeyTable:
    """Geometry of table, puck and mallet."""

    half_length: float = option(0.974, "from the centre to an end rim", unit="m", minimum=0.1, maximum=10.0)
    half_width: float = option(0.519, "from the centre to a side rim", unit="m", minimum=0.1, maximum=10.0)
    goal_width: float = option(0.25, "width of a goal's opening", unit="m", minimum=0.01, maximum=2.0)
    puck_radius: float = option(0.03165, "radius of the puck", unit="m", minimum=1e-3, maximum=0.2)
    mallet_radius: float = option(0.04815, "radius of the mallet", unit="m", minimum=1e-3, maximum=0.2)

    def __post_init__(self) -> None:
        validate(self)
        if self.goal_width <= 2.0 * self.puck_radius:
            raise ConfigurationError(
                f"HockeyTable.goal_width = {self.goal_width} m lets no puck of radius {self.puck_radius} m "
                "pass"
            )

    @property
    def reach(self) -> NDArray[np.float64]:
        """How far from the centre the puck's centre gets, in x and in y, shape (2,) [m]."""
        return np.array([self.half_length, self.half_width]) - self.puck_radius

    @property
    def opening(self) -> float:
        """How far from the middle of a goal the puck's centre may pass [m]."""
        return 0.5 * self.goal_width - self.puck_radius

    @property
    def contact_distance(self) -> float:
        """Between the centres of puck and mallet when they touch [m]."""
        return self.puck_radius + self.mallet_radius


@dataclasses.dataclass(frozen=True)
class ShotOutlook:
    """What is expected of B shots; NaN where the puck does not come to the goal line in time.

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

    Attributes:
        table: geometry.
        period: time of a step [s].
        floating: velocity after a step from the velocity before it.
        wall: velocity after a step with a bounce from the velocity before it, in the frame of contact.
        mallet: velocity after a hit from the puck's and the mallet's before it, (puck, mallet), likewise.
        hit_delay: by how much later than at the touch the velocity seems to have changed: a hit takes its
            time [s].

    Raises:
        InvalidInputError: a mode has other inputs or outputs than its own, the period is not positive, or the
            delay is negative.
    """

    table: HockeyTable
    period: float
    floating: LinearGaussian
    wall: LinearGaussian
    mallet: LinearGaussian
    hit_delay: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.period) and self.period > 0.0):
            raise InvalidInputError(f"the period of a puck model must be positive, got {self.period}")
        if not (np.isfinite(self.hit_delay) and self.hit_delay >= 0.0):
            raise InvalidInputError(f"the delay of hits must not be negative, got {self.hit_delay}")
        for name in MODES:
            shape, expected = getattr(self, name).matrix.shape, (2, _INPUTS[name])
            if shape != expected:
                raise InvalidInputError(f"the {name} mode needs a matrix {expected}, got {shape}")

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
        puck, mallet = np.asarray(puck, dtype=float), np.asarray(mallet, dtype=float)
        if puck.ndim != 2 or puck.shape[1] != 4 or mallet.shape != puck.shape:
            raise InvalidInputError(f"expected states (B, 4), got {puck.shape} and {mallet.shape}")
        frames = contact_frames(puck[:, :2] - mallet[:, :2])
        before = np.concatenate(
            [np.einsum("bij,bi->bj", frames, state[:, 2:]) for state in (puck, mallet)], axis=1
        )
        mean, covariance = puck.copy(), np.zeros((len(puck), 4, 4))
        mean[:, 2:] = np.einsum("bij,bj->bi", frames, self.mallet.mean(before))
        delay = self.hit_delay if delayed else 0.0
        mean[:, :2] -= delay * (mean[:, 2:] - puck[:, 2:])
        spread = frames @ self.mallet.covariance @ frames.transpose(0, 2, 1)
        covariance[:, 2:, 2:], covariance[:, :2, :2] = spread, delay**2 * spread
        covariance[:, :2, 2:] = covariance[:, 2:, :2] = -delay * spread
        return mean, covariance

    def step(
        self, mean: ArrayLike, covariance: ArrayLike, duration: float | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """One step of (5.8), or a part of one: mean (4,) and covariance (4, 4) afterwards.

        Deviation: a wall is met at its time, which the state's uncertainty shifts, instead of at a step.
        """
        part = 1.0 if duration is None else duration / self.period
        state = np.array(mean, dtype=float)
        spread = np.array(covariance, dtype=float)
        puck_rollout.step(self.kernel_rows, part, state, spread)
        return state, spread

    def outlook(
        self, mean: ArrayLike, covariance: ArrayLike, *, longest: float = 4.0
    ) -> ShotOutlook:
        """Roll B Gaussian states out to the goal line and weigh the opening of the goal, (5.8)-(5.10).

        Deviation: y is taken where the goal line is crossed, not at the step that follows, and the mass of
        the Gaussian over the opening is exact instead of sampled (5.11).

        Args:
            mean: states after the hit, shape (B, 4).
            covariance: of these, shape (B, 4, 4).
            longest: time after which a puck counts as lost [s].

        Raises:
            InvalidInputError: the shapes do not fit.
        """
        mean, covariance = self._states(mean, covariance)
        found = np.empty((len(mean), 5))
        banks = np.zeros(len(mean), dtype=np.int64)
        steps = int(np.ceil(longest / self.period))
        puck_rollout.outlooks(self.kernel_rows, mean, covariance, steps, found, banks)
        return ShotOutlook(found[:, 0], found[:, 1], found[:, 2], found[:, 3:], banks)

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
        noise = rng.standard_normal((len(start), steps, 2))
        puck_rollout.sampled(self.kernel_rows, start, noise, found)
        return found

    @property
    def kernel_rows(self) -> NDArray[np.float64]:
        """The model as rows of numbers for the compiled rollouts, shape (13, 2)."""
        rows = [[self.period, self.table.opening], self.table.reach]
        for mode in (self.floating, self.wall):
            rows += [*mode.matrix, mode.offset, *mode.covariance]
        rows.append([0.0, 0.0])
        return np.array(rows)

    def save(self, path: str | pathlib.Path, **origin: Any) -> None:
        """Write a readable file.

        Args:
            path: of the file.
            origin: where the model comes from (command, seed, figures), for people.
        """
        content = {
            "format": FORMAT, "origin": origin, "period": self.period,
            "hit_delay": self.hit_delay, "table": dataclasses.asdict(self.table),
            **{name: getattr(self, name).as_dict() for name in MODES},
        }  # fmt: skip
        pathlib.Path(path).write_text(json.dumps(content, indent=1) + "\n")

    @classmethod
    def load(cls, path: str | pathlib.Path) -> "PuckModel":
        """Read a file that :meth:`save` wrote.

        Raises:
            ConfigurationError: there is no such file, it is of another format, or its numbers are no model.
        """
        try:
            content = json.loads(pathlib.Path(path).read_text())
        except FileNotFoundError:
            raise ConfigurationError(
                f"there is no puck model {path}; `vpsto learn puck_model` makes one"
            ) from None
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise ConfigurationError(f"{path} is not a puck model: {error}") from None
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ConfigurationError(f"{path} is not of the format '{FORMAT}'")
        try:
            modes = {name: LinearGaussian(**content[name]) for name in MODES}
            table, delay = HockeyTable(**content["table"]), float(content.get("hit_delay", 0.0))
            return cls(table, float(content["period"]), **modes, hit_delay=delay)
        except (KeyError, TypeError, ValueError, InvalidInputError, ConfigurationError) as error:
            raise ConfigurationError(f"{path} is not a puck model: {error}") from None

    def _states(self, mean: ArrayLike, covariance: ArrayLike) -> tuple[NDArray, NDArray]:
        mean = np.ascontiguousarray(mean, dtype=float)
        covariance = np.ascontiguousarray(covariance, dtype=float)
        if mean.ndim != 2 or mean.shape[1] != 4 or covariance.shape != (len(mean), 4, 4):
            raise InvalidInputError(
                f"expected means (B, 4) and covariances (B, 4, 4), got {mean.shape} and {covariance.shape}"
            )
        return mean, covariance


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
