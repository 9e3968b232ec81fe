"""Direct search of (5.12) over the reduced action of 5.3.2: angle and speed of the mallet at the touch."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.contact.puck import PuckModel, ShotOutlook
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.planning.hockey.shooting_config import ShootingConfig, Shot, Strikes

_LEAST_CLOSING = 0.05  # slower mallets hardly touch [m/s]
_SAME_DISTANCE = 1e-6  # between centres at the touch [m]


@dataclasses.dataclass(frozen=True, eq=False)
class Strokes:
    """B ways to touch the puck.

    Attributes:
        time: of the touch, shape (B,) [s].
        puck: states just before it, shape (B, 4).
        covariance: of these, shape (B, 4, 4).
        angle: of the mallet's velocity, shape (B,) [rad].
        speed: of the mallet, shape (B,) [m/s].
    """

    time: NDArray[np.float64]
    puck: NDArray[np.float64]
    covariance: NDArray[np.float64]
    angle: NDArray[np.float64]
    speed: NDArray[np.float64]

    def with_angles(self, rows: NDArray, angle: NDArray, speed: NDArray) -> "Strokes":
        """At the same times as some rows, in other ways."""
        return Strokes(self.time[rows], self.puck[rows], self.covariance[rows], angle, speed)


class ShotSearch:
    """Weighs shots by the stochastic model of the puck, and finds the best at a contact time.

    Attributes:
        model: of the puck.
        strikes: what the arm can do.
        config: options.
        angles: the grid that is searched, shape (A,) [rad].
    """

    def __init__(self, model: PuckModel, strikes: Strikes, config: ShootingConfig) -> None:
        """Lay out the grid.

        Raises:
            ConfigurationError: puck and mallet of the model and of the strikes are not of the same size.
        """
        if abs(model.table.contact_distance - strikes.contact_distance) > _SAME_DISTANCE:
            raise ConfigurationError(
                f"centres of puck and mallet are {model.table.contact_distance:g} m apart at a touch by the "
                f"model of the puck, {strikes.contact_distance:g} m by the strikes; `vpsto learn strikes` "
                "makes strikes anew"
            )
        self.model, self.strikes, self.config = model, strikes, config
        self.angles = np.linspace(strikes.angle[0], strikes.angle[-1], config.angles)
        self._distance = model.table.contact_distance
        spacing = self.angles[1] - self.angles[0]
        self._around = spacing * np.linspace(-1.0, 1.0, config.refinements + 2)[1:-1]
        self._shares = np.unique([1.0, config.lower_speed])[::-1]
        table = model.table
        self._mallet_reach = np.array([table.half_length, table.half_width]) - table.mallet_radius

    def speeds(self, puck: NDArray, angles: NDArray) -> NDArray[np.float64]:
        """Largest speeds (B,) at places (B, 2); 0 where the arm cannot strike or the mallet has no room.

        Beside the grid of strikes they are those at its edge; callers say how far that may be.
        """
        grid = self.strikes
        nearest = np.clip(puck, [grid.x[0], grid.y[0]], [grid.x[-1], grid.y[-1]])
        return np.where(self.fits(puck, angles), grid.speeds(nearest, angles), 0.0)

    def fits(self, puck: NDArray, angles: NDArray) -> NDArray[np.bool_]:
        """Whether there is room (B,) for the mallet behind the puck, and on its way there."""
        direction = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        behind = puck - (self._distance + self.config.run_up) * direction
        touching = puck - self._distance * direction
        farthest = np.maximum(np.abs(behind), np.abs(touching))
        inside: NDArray[np.bool_] = np.all(farthest <= self._mallet_reach - self.config.room, axis=-1)
        return inside

    def outlook(self, strokes: Strokes) -> ShotOutlook:
        """What is expected of B strokes.

        Deviation: the thesis begins the rollout with Q_3 alone. Here the puck's state is uncertain, too, and
        the mallet is off: its place across its motion and its speed have standard deviations. To first order
        each is as if the puck were off: by the same distance, which turns the normal of the contact; and by
        the speed that changes the outcome as much.
        """
        normal = np.stack([np.cos(strokes.angle), np.sin(strokes.angle)], axis=-1)
        tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=-1)
        mallet = np.hstack([strokes.puck[:, :2] - self._distance * normal, strokes.speed[:, None] * normal])
        covariance = strokes.covariance.copy()
        covariance[:, :2, :2] += self.config.aim_std**2 * tangent[:, :, None] * tangent[:, None, :]
        by_puck, by_mallet = self.model.mallet.matrix[0, [0, 2]]  # of the speed along the normal
        speed_std = self.config.speed_std * by_mallet / max(abs(by_puck), 1e-6)
        covariance[:, 2:, 2:] += speed_std**2 * normal[:, :, None] * normal[:, None, :]
        return self.model.shots(strokes.puck, covariance, mallet)

    def shot(self, strokes: Strokes, outlook: ShotOutlook, row: int) -> Shot:
        """One of them."""
        return Shot(
            float(strokes.time[row]), strokes.puck[row].copy(), float(strokes.angle[row]),
            float(strokes.speed[row]), float(outlook.goal[row]), float(outlook.speed[row]),
            int(outlook.banks[row]), float(self.config.objective.values(outlook)[row]), self._distance,
        )  # fmt: skip

    def prices(self, time: NDArray, puck: NDArray, angle: NDArray, speed: NDArray) -> NDArray[np.float64]:
        """What shots (B,) cost besides their objective: they come late, or slower than they could (5.13)."""
        largest = self.strikes.speeds(puck[:, :2], angle)
        slack = 1.0 - speed / np.maximum(largest, speed)
        return self.config.delay_price * time + self.config.slack_price * slack

    def ranked(self, strokes: Strokes, outlook: ShotOutlook) -> NDArray[np.float64]:
        """Scores (B,) less the prices of strokes."""
        prices = self.prices(strokes.time, strokes.puck, strokes.angle, strokes.speed)
        return self.config.objective.scores(outlook) - prices

    def taken(self, shot: Shot) -> bool:
        """Whether a shot may be chosen: it keeps the constraints, or is a fallback that reaches the goal."""
        objective = self.config.objective
        if not np.isfinite(shot.goal_speed):
            return False
        return (shot.goal > objective.beta and shot.banks >= objective.least_banks) or self.config.fallback

    def best(self, time: float, puck: NDArray, covariance: NDArray) -> Shot | None:
        """The best shot at a contact time; the likeliest if none keeps the constraints, None if none exists.

        Args:
            time: of the touch [s].
            puck: expected state then, shape (4,).
            covariance: of it, shape (4, 4).
        """
        places = np.repeat(puck[None, :2], len(self.angles), axis=0)
        return self.best_of(
            np.array([time]), puck[None], covariance[None], self.speeds(places, self.angles)[None]
        )

    def best_of(
        self, times: NDArray, pucks: NDArray, covariances: NDArray, speeds: NDArray
    ) -> Shot | None:
        """The best shot at some contact times, None if no mallet speed is given.

        Args:
            times: of the touch, shape (K,) [s].
            pucks: expected states then, shape (K, 4).
            covariances: of these, shape (K, 4, 4).
            speeds: of the mallet on the grid of angles, shape (K, A) [m/s]; 0 for what is not searched.
        """
        slot, column = np.nonzero(speeds)
        if not slot.size:
            return None
        grid = Strokes(
            times[slot], pucks[slot], covariances[slot], self.angles[column], speeds[slot, column]
        )
        outlook = self.outlook(grid)
        prices = self.prices(grid.time, grid.puck, grid.angle, grid.speed)
        ranks = self.config.objective.scores(outlook) - prices
        promise = np.full(speeds.shape, -np.inf)
        promise[slot, column] = self.config.objective.promise(outlook) - prices
        row = np.full(speeds.shape, -1)
        row[slot, column] = np.arange(len(slot))
        fine = self._refined(grid, row[_peaks(promise, self.config.peaks)])
        chances = self.outlook(fine)
        finest = self.ranked(fine, chances)
        first, second = int(np.argmax(ranks)), int(np.argmax(finest)) if finest.size else -1
        if second >= 0 and finest[second] > ranks[first]:
            return self.shot(fine, chances, second)
        return self.shot(grid, outlook, first)

    def _refined(self, grid: Strokes, rows: NDArray) -> Strokes:
        """Strokes around some of a grid, with every share of the largest speed."""
        low, high = self.strikes.angle[0], self.strikes.angle[-1]
        angles = np.clip(grid.angle[rows][:, None] + self._around, low, high).ravel()
        # Where time is short the speeds of the grid are less than the largest.
        share = grid.speed[rows] / self.strikes.speeds(grid.puck[rows, :2], grid.angle[rows])
        share, rows = np.repeat(share, len(self._around)), np.repeat(rows, len(self._around))
        largest = share * self.speeds(grid.puck[rows, :2], angles)
        angle = np.tile(angles, len(self._shares))
        speed = np.outer(self._shares, largest).ravel()
        rows = np.tile(rows, len(self._shares))
        there = speed > _LEAST_CLOSING
        return grid.with_angles(rows[there], angle[there], speed[there])


def _peaks(values: NDArray, count: int) -> tuple[NDArray, NDArray]:
    """Where (K, A) values are higher than their neighbours in a row: the best few."""
    padded = np.pad(values, ((0, 0), (1, 1)), constant_values=-np.inf)
    peak = np.isfinite(values) & (values >= padded[:, :-2]) & (values > padded[:, 2:])
    slot, column = np.nonzero(peak)
    chosen = np.argsort(-values[slot, column], kind="stable")[:count]
    return slot[chosen], column[chosen]
