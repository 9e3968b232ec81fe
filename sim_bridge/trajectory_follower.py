"""Follows joint trajectories by the rules of a stock joint_trajectory_controller, without ROS.

The rules are those of ros2_controllers' validation with its defaults (no partial goals, no velocity at the
end, no integration), and its interpolation: linear without velocities, cubic with them, quintic where two
neighbouring points also have accelerations. Stricter on purpose, because a real arm's safety layer would
stop it: limits must hold at every instant and the reference must not jump. Milder in one place: until a
trajectory's first point the running one goes on if it leads there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory import Limits, Trajectory, braking_trajectory

_END_VELOCITY = 1.2e-7  # the single-precision epsilon to which the stock controller compares [rad/s]


@dataclass(frozen=True, eq=False)
class TrajectoryCommand:
    """A trajectory as a message carries it.

    Args:
        joint_names: names of the columns.
        stamp: when time_from_start begins [s]; 0 means now.
        time_from_start: of each point [s], shape (P,).
        positions: [rad], shape (P, n).
        velocities: [rad/s], shape (P, n), or None: no point has any.
        accelerations: [rad/s²], shape (P, n), or None; a row of NaN stands for a point without.
    """

    joint_names: Sequence[str]
    stamp: float
    time_from_start: ArrayLike
    positions: ArrayLike
    velocities: ArrayLike | None = None
    accelerations: ArrayLike | None = None

    @classmethod
    def of(cls, trajectory: Trajectory, joint_names: Sequence[str]) -> "TrajectoryCommand":
        """What makes the controller reproduce a trajectory of cubics, or of quintics without a jump.

        Cubics are sent without accelerations: theirs may jump at the knots.
        """
        positions, velocities, accelerations = trajectory.knots()
        start = trajectory.start_time
        quintic = bool(np.any(trajectory.coefficients[:, 4:]))
        return cls(
            joint_names, start, trajectory.times - start, positions, velocities,
            accelerations if quintic else None,
        )  # fmt: skip


class TrajectoryRejected(InvalidInputError):
    """A command broke a rule; the reference goes on as before.

    Attributes:
        rule: which one, a short word: joint_names, empty, shape, finite, time, past, future, end_velocity,
            limits or jump.
        message: what was expected, what came, and what to do.
    """

    def __init__(self, rule: str, message: str):
        """Name the rule and say what to do."""
        super().__init__(f"trajectory refused ({rule}): {message}")
        self.rule = rule
        self.message = message


@documented
@dataclass(frozen=True)
class FollowerConfig:
    """Tolerances of the rules."""

    position_jump: float = option(
        2e-3, "largest step of the reference position", unit="rad", minimum=0.0, maximum=0.1
    )
    velocity_jump: float = option(
        2e-2, "largest step of the reference velocity", unit="rad/s", minimum=0.0, maximum=1.0
    )
    horizon: float = option(10.0, "how far ahead a stamp may be", unit="s", minimum=0.0, maximum=1e4)
    limit_tolerance: float = option(
        1e-4,
        "share by which limits may be exceeded: messages round times to nanoseconds",
        minimum=0.0,
        maximum=0.1,
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        validate(self)


class TrajectoryFollower:
    """Holds the running trajectory and gives the reference at any time; see the module for the rules.

    Times must not go back: what has been passed is dropped.
    """

    def __init__(
        self,
        limits: Limits,
        joint_names: Sequence[str],
        start: ArrayLike,
        config: FollowerConfig | None = None,
    ):
        """Hold the position `start` (n,) [rad] until a trajectory comes.

        Raises:
            InvalidInputError: the number of names, of limits and of start positions differ.
        """
        self._limits = limits
        self._names = tuple(joint_names)
        self.config = config or FollowerConfig()
        if not len(self._names) == limits.dof == np.size(start):
            raise InvalidInputError(
                f"{len(self._names)} joint names, {limits.dof} limits and {np.size(start)} positions do not "
                "fit together"
            )
        self._next = np.inf
        self.hold(start, 0.0)

    @property
    def active(self) -> Trajectory:
        """The trajectory accepted last; it may begin in the future."""
        return self._schedule[-1][1]

    def reference(self, t: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Reference position [rad], velocity and acceleration at time t [s], each (n,)."""
        while t >= self._next:
            self._schedule.pop(0)
            self._next = self._schedule[1][0] if len(self._schedule) > 1 else np.inf
        return self._schedule[0][1].state(t)

    def hold(self, q: ArrayLike, t: float) -> None:
        """Hold the position q (n,) [rad] from time t [s] on, whatever ran before."""
        rows = np.tile(np.asarray(q, dtype=float), (2, 1))
        self._set_schedule([(t, Trajectory.from_points([t, t + 1.0], rows, np.zeros_like(rows)))])

    def stop(self, t: float) -> Trajectory:
        """Brake to rest from the reference at time t [s], as hard as the limits allow, and hold."""
        q, qd, _ = self.reference(t)
        if np.abs(qd).max() > 0.0:
            self._set_schedule([(t, braking_trajectory(q, qd, self._limits, start_time=t))])
        else:
            self.hold(q, t)
        return self.active

    def accept(self, command: TrajectoryCommand, now: float) -> None:
        """Check a command and let it replace what runs from now [s], or from its first point's time, on.

        Raises:
            TrajectoryRejected: it breaks a rule.
        """
        points = self._points(command)
        times = points[0] + self._start_time(command, points[0], now)
        new = self._trajectory(times, points)
        if times[0] > now:
            schedule = self._lead_in(new, now)
        else:
            self._check_join(self._at(now), new.state(now), now)
            schedule = [(now, new)]
        for begin, part in schedule:
            self._check_limits(part, begin)
        kept = [entry for entry in self._schedule if entry[0] < schedule[0][0]]
        self._set_schedule(kept + schedule)

    def _points(self, command: TrajectoryCommand):
        """Times, positions, velocities and accelerations (or None), in the controller's order of joints."""
        order = self._joint_order(command.joint_names)
        times = _array(command.time_from_start, "time_from_start")
        if times.ndim != 1 or times.size == 0:
            raise TrajectoryRejected("empty", "it has no points; send at least one")
        shape = (len(times), len(self._names))
        columns: list[NDArray[np.float64] | None] = []
        for name in ("positions", "velocities", "accelerations"):
            values = getattr(command, name)
            if values is None and name != "positions":
                columns.append(None)
                continue
            array = _array(values, name)
            if array.shape != shape:
                raise TrajectoryRejected(
                    "shape", f"{name} must have one value per point and joint, {shape}, got {array.shape}"
                )
            missing = (
                np.isnan(array).all(axis=1) if name == "accelerations" else np.zeros(len(array), dtype=bool)
            )
            if not np.isfinite(array[~missing]).all():
                raise TrajectoryRejected(
                    "finite", f"{name} must be finite numbers; check the planner for NaN or inf"
                )
            columns.append(array[:, order])
        return times, *columns

    def _joint_order(self, names: Sequence[str]) -> list[int]:
        names = list(names)
        expected = ", ".join(self._names)
        if not names:
            raise TrajectoryRejected("joint_names", f"it names no joints; name all of {expected}")
        unknown = [name for name in names if name not in self._names]
        if unknown:
            raise TrajectoryRejected("joint_names", f"no joint '{unknown[0]}' here; available: {expected}")
        missing = [name for name in self._names if name not in names]
        if missing:
            raise TrajectoryRejected(
                "joint_names",
                f"partial trajectories are not taken; '{missing[0]}' is missing; name all of {expected}",
            )
        if len(names) != len(self._names):
            raise TrajectoryRejected(
                "joint_names", f"a joint is named twice in {', '.join(names)}; name each once"
            )
        return [names.index(name) for name in self._names]

    def _start_time(self, command: TrajectoryCommand, offsets: NDArray, now: float) -> float:
        if not (np.isfinite(offsets).all() and np.isfinite(command.stamp)):
            raise TrajectoryRejected("finite", "stamp and time_from_start must be finite numbers")
        if offsets[0] < 0.0 or np.any(np.diff(offsets) <= 0.0):
            i = 0 if offsets[0] < 0.0 else int(np.flatnonzero(np.diff(offsets) <= 0.0)[0])
            raise TrajectoryRejected(
                "time",
                f"time_from_start must be >= 0 and increase strictly; see point {i} at {offsets[i]:.9g} s "
                "and the next",
            )
        start = command.stamp if command.stamp != 0.0 else now
        if start + offsets[-1] < now:
            raise TrajectoryRejected(
                "past",
                f"it ended at {start + offsets[-1]:.3f} s and now is {now:.3f} s; stamp it with the time of "
                "planning, or with zero to start now, and check that both sides use the same clock",
            )
        if start > now + self.config.horizon:
            raise TrajectoryRejected(
                "future",
                f"its stamp {start:.3f} s is more than {self.config.horizon:g} s after now, {now:.3f} s; "
                "check that both sides use the same clock (use_sim_time)",
            )
        return start

    def _trajectory(self, times: NDArray, points) -> Trajectory:
        _, positions, velocities, accelerations = points
        if velocities is not None and np.abs(velocities[-1]).max() > _END_VELOCITY:
            j = int(np.abs(velocities[-1]).argmax())
            raise TrajectoryRejected(
                "end_velocity",
                f"the last point must be at rest, {self._names[j]} still moves at {velocities[-1, j]:.3g} "
                "rad/s; let every trajectory end in a stop",
            )
        if velocities is None:
            accelerations = None  # as in the stock controller: nothing can be made of accelerations alone
        if len(times) == 1:
            # A single point: reach it, then stay there.
            times, positions = np.append(times, times[0] + 1.0), np.vstack([positions, positions])
            velocities, accelerations = np.zeros_like(positions), None
        try:
            new = Trajectory.from_points(times, positions, velocities, accelerations)
        except InvalidInputError as error:
            raise TrajectoryRejected("time", f"{error}; points may be too close in time") from error
        if velocities is None:
            self._check_corners(new)
        return new

    def _check_corners(self, new: Trajectory) -> None:
        """Straight lines between points must not step in velocity, neither at a point nor at the end."""
        jump = np.maximum(new.jumps()[1], np.abs(new.knots()[1][-1]))
        if jump.max() > self.config.velocity_jump:
            raise TrajectoryRejected(
                "jump",
                f"without velocities points are joined by straight lines, which step by {jump.max():.3g} "
                f"rad/s in velocity (allowed: {self.config.velocity_jump:g}); send velocities too",
            )

    def _lead_in(self, new: Trajectory, now: float) -> list[tuple[float, Trajectory]]:
        """What to follow until the first point of a trajectory that begins later, and that trajectory."""
        first = new.start_time
        q, qd, _ = self._at(first)
        q_new, qd_new, _ = new.state(first)
        if (
            self._jump(q, q_new, self.config.position_jump) <= 1.0
            and self._jump(qd, qd_new, self.config.velocity_jump) <= 1.0
        ):
            return [(first, new)]
        q, qd, _ = self._at(now)
        bridge = Trajectory.from_points([now, first], [q, q_new], [qd, qd_new])
        return [(now, bridge), (first, new)]

    def _check_join(self, running, new, now: float) -> None:
        names = (
            ("position", "rad", self.config.position_jump),
            ("velocity", "rad/s", self.config.velocity_jump),
        )
        for (name, unit, allowed), before, after in zip(names, running, new, strict=False):
            if self._jump(before, after, allowed) > 1.0:
                j = int(np.abs(after - before).argmax())
                raise TrajectoryRejected(
                    "jump",
                    f"at {now:.3f} s, where it takes over, the {name} of {self._names[j]} would step from "
                    f"{before[j]:.5g} to {after[j]:.5g} {unit} (allowed: {allowed:g}); continue the "
                    "trajectory that runs, or let the first point lie in the future",
                )

    @staticmethod
    def _jump(before: NDArray, after: NDArray, allowed: float) -> float:
        return float(np.abs(after - before).max() / max(allowed, 1e-300))

    def _check_limits(self, part: Trajectory, begin: float) -> None:
        if part.start_time < begin < part.end_time:
            part = part.clipped(begin, part.end_time)
        broken = part.violations(self._limits, self.config.limit_tolerance)
        if broken:
            raise TrajectoryRejected(
                "limits",
                f"limits must hold at every instant, also between points: {'; '.join(broken)}; slow it down",
            )

    def _at(self, t: float):
        """Reference at a time now or later, also beyond what is scheduled next."""
        part = self._schedule[0][1]
        for begin, candidate in self._schedule[1:]:
            if begin <= t:
                part = candidate
        return part.state(t)

    def _set_schedule(self, schedule: list[tuple[float, Trajectory]]) -> None:
        self._schedule: list[tuple[float, Trajectory]] = schedule
        self._next = schedule[1][0] if len(schedule) > 1 else np.inf


def _array(values: ArrayLike, name: str) -> NDArray[np.float64]:
    try:
        return np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise TrajectoryRejected(
            "shape", f"{name} must be a table of numbers with equally long rows"
        ) from error
