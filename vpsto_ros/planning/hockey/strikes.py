"""Strikes, tabulated: in which posture the mallet is fastest at a place, in a direction (5.13).

The thesis asks for the largest speed in a given shooting posture. Which posture decides it: one that inverse
kinematics finds near the start of the arm reaches little more than half of what the redundant joints can.
They are searched once, offline, for a grid of puck positions and shooting angles; online a posture is looked
up and moved to the exact place.
"""

import dataclasses
import functools
import hashlib
import json
import math
import pathlib
import zipfile
import zlib
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.planning.hockey.rules import PlayRules
from vpsto_ros.planning.hockey.strike_search import straighten
from vpsto_ros.robot.iiwa import iiwa14
from vpsto_ros.robot.iiwa_kinematics import add_least_motion, chain, jacobian, move_to

FORMAT = "vpsto_ros strikes 2"
SHIPPED = pathlib.Path(__file__).parent / "models" / "strikes.npz"
"""The table of the iiwa at the air-hockey table, which comes with the package; its origin is in the file."""
Cell = tuple[int, int, int, int]
"""An entry: layer, and indices of x, y and angle."""


@documented
@dataclasses.dataclass(frozen=True)
class StrikeConfig:
    """How a strike runs.

    Raises:
        ConfigurationError: a value is out of range; the message names what is allowed.
    """

    run_up: float = option(
        0.2, "time in which the joints accelerate before the touch", unit="s", minimum=0.11, maximum=1.0
    )
    hold: float = option(
        0.045, "time for which they keep their speed after it: a contact lasts 18 ms", unit="s", minimum=0.0,
        maximum=0.5,
    )  # fmt: skip
    brake: float = option(0.15, "time in which they come to rest", unit="s", minimum=0.11, maximum=1.0)
    lead_weights: tuple[float, ...] = option(
        (0.1, 0.5, 1.2, 3.0), "price of postures far from home, per second that the quickest joint motion to"
        " them takes; for each a layer of the table: fast strikes first, then ones that are soon there",
        unit="m/s²", minimum=0.0, maximum=10.0,
    )  # fmt: skip
    lead_factor: float = option(
        1.3, "time from rest into the run-up as a multiple of the way over the largest velocity", minimum=1.0,
        maximum=3.0,
    )  # fmt: skip
    speed_share: float = option(
        0.995, "share of the planned velocity limits in a strike: what replanning needs", minimum=0.1,
        maximum=1.0,
    )  # fmt: skip

    def __post_init__(self) -> None:
        validate(self)


@dataclasses.dataclass(frozen=True, eq=False)
class StrikeTable:
    """Postures at the touch over a grid of puck positions (table frame) and shooting angles, in L layers.

    Attributes:
        x, y: uniform grids of the puck's centre at the touch, table frame [m].
        angle: uniform grid of the direction of the mallet's motion, from +x [rad].
        speed: largest speed of the mallet, shape (L, X, Y, A) [m/s]; 0 where there is no strike.
        posture: joint positions at the touch, the universal joint above the mallet, (L, X, Y, A, 7) [rad].
        rates: joint velocities there at that speed, (L, X, Y, A, 7) [rad/s].
        contact_distance: between the centres of puck and mallet when they touch [m].
        config: how strikes run.
        rules: what they keep.

    Raises:
        InvalidInputError: the shapes do not fit, a grid is not uniform, or a number is not finite.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    angle: NDArray[np.float64]
    speed: NDArray[np.float64]
    posture: NDArray[np.float64]
    rates: NDArray[np.float64]
    contact_distance: float
    config: StrikeConfig = dataclasses.field(default_factory=StrikeConfig)
    rules: PlayRules = dataclasses.field(default_factory=PlayRules)

    def __post_init__(self) -> None:
        shape = (len(self.config.lead_weights), len(self.x), len(self.y), len(self.angle))
        for name in ("x", "y", "angle", "speed", "posture", "rates"):
            array = np.ascontiguousarray(getattr(self, name), dtype=float)
            expected = {"x": shape[1:2], "y": shape[2:3], "angle": shape[3:], "speed": shape}.get(
                name, (*shape, 7)
            )
            if array.shape != expected or not np.isfinite(array).all():
                raise InvalidInputError(f"strikes: {name} must be finite, {expected}, got {array.shape}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        for grid in self.grids:
            if len(grid) < 2 or not np.allclose(np.diff(grid), grid[1] - grid[0]) or grid[1] <= grid[0]:
                raise InvalidInputError("strikes: grids must be uniform, increasing, of two values at least")
        if (self.speed < 0.0).any():
            raise InvalidInputError("strikes: speeds must not be negative")

    @property
    def grids(self) -> tuple[NDArray, NDArray, NDArray]:
        """x, y and angle."""
        return self.x, self.y, self.angle

    @property
    def center(self) -> NDArray[np.float64]:
        """Where the table's centre is, in the robot's base frame, shape (2,) [m]."""
        return self.rules.table

    @functools.cached_property
    def fingerprint(self) -> str:
        """Of what shots are chosen by: speeds, their grids and the distance at the touch."""
        digest = hashlib.sha256(np.float64(self.contact_distance).tobytes())
        for array in (*self.grids, self.speed):
            digest.update(array.tobytes())
        return digest.hexdigest()

    def speeds(self, puck: ArrayLike, angles: ArrayLike) -> NDArray[np.float64]:
        """Largest mallet speeds (B,) [m/s] for pucks (B, 2) and angles (B,); 0 where there is no strike.

        Trilinear between the entries of the table; 0 outside of it and next to an entry without a strike.
        """
        return self._layers(puck, angles).max(axis=0)

    def timely_speeds(
        self, joints: ArrayLike, puck: ArrayLike, angles: ArrayLike, available: ArrayLike
    ) -> NDArray[np.float64]:
        """Largest mallet speeds (B,) [m/s] of the strikes that can be reached in time.

        Args:
            joints: where the arm is at rest, shape (7,) [rad].
            puck: positions at the touch, table frame, shape (B, 2) [m].
            angles: shape (B,) [rad].
            available: until the touch, shape (B,) [s].
        """
        timely = self._leads(joints, puck, angles) <= np.asarray(available, dtype=float)
        return np.where(timely, self._layers(puck, angles), 0.0).max(axis=0)

    def lead(self, joints: ArrayLike, puck: ArrayLike, angles: ArrayLike) -> NDArray[np.float64]:
        """Least times (B,) [s] from joints (7,) at rest to the touch of pucks (B, 2) at angles (B,).

        The joints go to the start of the run-up on a smooth curve, and from there into the strike; inf
        without a strike.
        """
        return self._leads(joints, puck, angles).min(axis=0)

    def cell(self, mallet: ArrayLike, joints: ArrayLike) -> Cell | None:
        """The entry for a state (4,) of the mallet at the touch, table frame; None without a strike.

        Of the layers that are as fast as that, the one that is soonest reached from joints (7,).
        """
        x, y, vx, vy = np.asarray(mallet, dtype=float).tolist()
        angle, ahead = math.atan2(vy, vx), self.contact_distance
        puck = np.array([[x + ahead * math.cos(angle), y + ahead * math.sin(angle)]])
        index, inside = self._nearest(puck, np.array([angle]))
        speeds = self.speed[:, index[0][0], index[1][0], index[2][0]]
        if not inside[0] or not speeds.any():
            return None
        fast = speeds >= min(math.hypot(vx, vy), speeds.max())
        leads = self._nearest_leads(np.asarray(joints, dtype=float), index)[:, 0]
        layer = int(np.argmin(np.where(fast, leads, np.inf)))
        return layer, int(index[0][0]), int(index[1][0]), int(index[2][0])

    def _layers(self, puck: ArrayLike, angles: ArrayLike) -> NDArray[np.float64]:
        """Speeds (L, B), interpolated."""
        where = np.column_stack([np.asarray(puck, dtype=float), np.asarray(angles, dtype=float)])
        found = np.empty((len(self.speed), len(where)))
        low = np.array([grid[0] for grid in self.grids])
        step = np.array([grid[1] - grid[0] for grid in self.grids])
        for values, row in zip(self.speed, found, strict=True):
            _interpolate(values, low, step, np.ascontiguousarray(where), row)
        return found

    def _nearest(self, puck: NDArray, angles: NDArray) -> tuple[tuple[NDArray, NDArray, NDArray], NDArray]:
        """Nearest entries of pucks (B, 2) and angles (B,), and whether these are within half a step."""
        index, inside = [], np.ones(len(angles), dtype=bool)
        for grid, values in zip(self.grids, (puck[:, 0], puck[:, 1], angles), strict=True):
            at = (values - grid[0]) / (grid[1] - grid[0])
            inside &= (at >= -0.5) & (at <= len(grid) - 0.5)
            index.append(np.clip(np.rint(at), 0, len(grid) - 1).astype(int))
        return (index[0], index[1], index[2]), inside

    def _nearest_leads(self, joints: NDArray, index: tuple[NDArray, NDArray, NDArray]) -> NDArray[np.float64]:
        """Times (L, B) from joints (7,) at rest into entries."""
        begin = self._starts[:, index[0], index[1], index[2]]
        way = np.abs(begin - joints)
        times = np.maximum(self.config.lead_factor * way * self._slowness, np.sqrt(way * self._inertness))
        return times.max(axis=-1) + self.config.run_up

    def _leads(self, joints: ArrayLike, puck: ArrayLike, angles: ArrayLike) -> NDArray[np.float64]:
        """Times (L, B), inf where there is no strike."""
        index, _ = self._nearest(np.asarray(puck, dtype=float), np.asarray(angles, dtype=float))
        leads = self._nearest_leads(np.asarray(joints, dtype=float), index)
        return np.where(self._layers(puck, angles) > 0.0, leads, np.inf)

    @functools.cached_property
    def _starts(self) -> NDArray[np.float64]:
        """About where the run-ups begin at rest, joint positions (L, X, Y, A, 7) [rad]."""
        return self.posture - 0.5 * self.config.run_up * self.rates

    @functools.cached_property
    def _slowness(self) -> NDArray[np.float64]:
        return 1.0 / self.rules.limits(iiwa14()).velocity

    @functools.cached_property
    def _inertness(self) -> NDArray[np.float64]:
        """Of a cubic from rest to rest: its square of time per way."""
        return 6.0 / self.rules.limits(iiwa14()).acceleration

    def contact(
        self, cell: Cell, place: ArrayLike, velocity: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """The posture of an entry moved to where the universal joint is to be, with its velocity.

        Args:
            cell: entry.
            place: of the universal joint, base frame, shape (2,) [m].
            velocity: of it, shape (2,) [m/s].

        Returns:
            Joint positions and velocities (7,), each as near to those of the entry as possible; None where
            the place is out of reach.
        """
        q, qd = self.posture[cell].copy(), self.rates[cell].copy()
        vx, vy = np.asarray(velocity, dtype=float).tolist()
        x, y = np.asarray(place, dtype=float).tolist()
        share = np.hypot(vx, vy) / self.speed[cell]
        qd *= share
        return (q, qd) if _settle(q, qd, x, y, self.rules.height, vx, vy) else None

    def straight_on(
        self, position: NDArray, velocity: NDArray, duration: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Joint positions and velocities (7,) after the universal joint has gone on straight and evenly.

        To second order, with the least joint acceleration: a contact takes its time, and with even joint
        velocities the mallet would turn by some degrees meanwhile.
        """
        curvature = np.zeros(7)
        _curve(position, velocity, curvature)
        after = velocity + duration * curvature
        return position + 0.5 * duration * (velocity + after), after

    def start(self, cell: Cell) -> NDArray[np.float64]:
        """About where the run-up of an entry begins at rest, joint positions (7,) [rad]."""
        return self.straight_on(self.posture[cell], self.rates[cell], -0.5 * self.config.run_up)[0]

    def save(self, path: str | pathlib.Path, **origin: Any) -> None:
        """Write a file.

        Args:
            path: of the file, which ends in .npz.
            origin: where the table comes from (command, seed, figures), for people.
        """
        about = {
            "format": FORMAT, "origin": origin, "contact_distance": self.contact_distance,
            "config": dataclasses.asdict(self.config), "rules": dataclasses.asdict(self.rules),
        }  # fmt: skip
        np.savez_compressed(
            path, about=np.array(json.dumps(about)), x=self.x, y=self.y, angle=self.angle, speed=self.speed,
            posture=self.posture.astype(np.float32), rates=self.rates.astype(np.float32),
        )  # fmt: skip

    @classmethod
    def load(cls, path: str | pathlib.Path = SHIPPED) -> "StrikeTable":
        """Read a file that :meth:`save` wrote.

        Raises:
            ConfigurationError: there is no such file, it is of another format, or its numbers are no table.
        """
        remedy = "`vpsto learn strikes` makes one"
        try:
            content = np.load(path, allow_pickle=False)
            if not isinstance(content, np.lib.npyio.NpzFile):
                raise ValueError("it holds a single array")
            with content:
                about = json.loads(str(content["about"]))
                arrays = {name: content[name] for name in ("x", "y", "angle", "speed", "posture", "rates")}
        except FileNotFoundError:
            raise ConfigurationError(f"there is no table of strikes {path}; {remedy}") from None
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise ConfigurationError(f"{path} is not a table of strikes: {error}; {remedy}") from None
        if not isinstance(about, dict) or about.get("format") != FORMAT:
            raise ConfigurationError(f"{path} is not of the format '{FORMAT}'; {remedy}")
        try:
            rules = {**about["rules"], "home": tuple(about["rules"]["home"])}
            distance = float(about["contact_distance"])
            settings = {**about["config"], "lead_weights": tuple(about["config"]["lead_weights"])}
            config = StrikeConfig(**settings)
            return cls(**arrays, contact_distance=distance, config=config, rules=PlayRules(**rules))
        except (KeyError, TypeError, ValueError, InvalidInputError, ConfigurationError) as error:
            raise ConfigurationError(f"{path} is not a table of strikes: {error}; {remedy}") from None


@njit(cache=True, nogil=True)
def _settle(q, qd, x, y, z, vx, vy):
    """Move joint positions and velocities (7,) by the least to where the universal joint is to be."""
    points, axes, jac = np.empty((4, 3)), np.empty((7, 3)), np.empty((3, 6))
    if not move_to(q, x, y, z, points, axes, jac):
        return False
    ex, ey, ez = vx, vy, 0.0
    for k in range(6):
        ex, ey, ez = ex - jac[0, k] * qd[k], ey - jac[1, k] * qd[k], ez - jac[2, k] * qd[k]
    add_least_motion(jac, ex, ey, ez, qd)
    return True


@njit(cache=True, nogil=True)
def _curve(q, qd, curvature):
    """The joint acceleration (7,) with which the universal joint keeps its velocity."""
    points, axes, jac, other, probe = (
        np.empty((4, 3)), np.empty((7, 3)), np.empty((3, 6)), np.empty((3, 6)), np.empty(7)
    )  # fmt: skip
    chain(q, points, axes)
    jacobian(points, axes, jac)
    straighten(q, qd, jac, curvature, probe, points, axes, other)


@njit(cache=True, nogil=True)
def _interpolate(values, low, step, where, found):
    """Trilinear interpolation of values (X, Y, A) at points (B, 3); 0 outside and next to a 0."""
    for b in range(len(where)):
        found[b] = 0.0
        i0, parts, inside = np.zeros(3, dtype=np.int64), np.zeros(3), True
        for d in range(3):
            at = (where[b, d] - low[d]) / step[d]
            if not -1e-9 <= at <= values.shape[d] - 1 + 1e-9:
                inside = False
                break
            i0[d] = min(max(int(at), 0), values.shape[d] - 2)
            parts[d] = min(max(at - i0[d], 0.0), 1.0)
        if not inside:
            continue
        total = 0.0
        for corner in range(8):
            weight, i, j, k = 1.0, i0[0], i0[1], i0[2]
            for d in range(3):
                weight *= parts[d] if corner >> d & 1 else 1.0 - parts[d]
            i, j, k = i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2 & 1)
            if weight > 1e-9 and values[i, j, k] == 0.0:
                total = 0.0
                break
            total += weight * values[i, j, k]
        found[b] = total
