"""Motions of the arm at the air-hockey table as problems for VP-STO: into a touch, and back home.

Via-points are joint positions; what is searched is moved by the least joint motion to where the universal
joint is in the plane of play, so that every candidate stays near it.
"""

import dataclasses
import itertools

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.exceptions import InfeasibleError
from vpsto_ros.optimization.progress import Evaluation
from vpsto_ros.planning.hockey.motion_kernels import assess, to_height
from vpsto_ros.planning.hockey.rules import PlayRules
from vpsto_ros.priors.gaussian import GaussianPrior
from vpsto_ros.priors.smoothness import smoothness_prior
from vpsto_ros.robot.iiwa_kinematics import arm_points, move_to
from vpsto_ros.trajectory import Limits, OptimalBasis, Trajectory, minimal_duration, synthesize


@dataclasses.dataclass(frozen=True, eq=False)
class ArmState:
    """Joint positions and velocities at a time.

    Attributes:
        time: when [s].
        position: shape (7,) [rad].
        velocity: shape (7,) [rad/s].
    """

    time: float
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Play:
    """What all motions at one table share.

    Attributes:
        rules: of play.
        limits: of the joints, as planned with.
        spacing: time between the instants at which places are looked at [s].
        spread: standard deviation of the prior over via-points [rad].
        weights: of duration [1/s], effort and excess in the cost, (3,).
    """

    rules: PlayRules
    limits: Limits
    spacing: float = 0.02
    spread: float = 0.12
    weights: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.array([1.0, 0.3, 1e3]))

    def raised(self, points: NDArray) -> NDArray[np.float64]:
        """Joint positions (B, P, 7) moved into the plane of play."""
        found = np.empty_like(points, dtype=float)
        to_height(np.ascontiguousarray(points, dtype=float), self.rules.height, found)
        return found

    def assess(
        self, basis: OptimalBasis, keys: NDArray, start: NDArray, end: NDArray, durations: NDArray
    ) -> Evaluation:
        """Costs of motions through key positions (B, N + 2, 7) with durations (B,)."""
        cost, valid = np.empty(len(keys)), np.empty(len(keys), dtype=bool)
        lower, upper = self.limits.position_range
        assess(
            basis.knots, basis.knot_slopes, keys, start, end, durations, self.limits.velocity,
            self.limits.acceleration, lower, upper, self.rules.kernel_row(), self.spacing, self.weights, cost,
            valid,
        )  # fmt: skip
        return Evaluation(cost, valid)


class PlayMotion:
    """A motion between two states of the arm, an :class:`~vpsto_ros.planning.mpc.OnlineProblem`.

    Attributes:
        start_time: when it begins [s].
        begin, end: its two states; the time of the end counts only if it is given.
    """

    def __init__(
        self, play: Play, begin: ArmState, end: ArmState, guess: NDArray, last: float = 0.0,
        hint: NDArray | None = None,
    ) -> None:  # fmt: skip
        """Pose the problem.

        Args:
            play: what all motions share.
            begin: state at the beginning.
            end: state at the end, to be reached at its time; as soon as the limits allow if that is infinite.
            guess: a position on the way, shape (7,) [rad]: where the run-up begins, or where a brake ends.
            last: for how long before the end there shall be no via-point, 0: evenly spaced ones [s].
            hint: via-points (N, 7) of an earlier search that came close, to look at first.
        """
        self.play, self.begin, self.end, self.start_time = play, begin, end, begin.time
        self._guess, self._last, self._hint = guess, last, hint
        self._bases: dict[int, OptimalBasis] = {}
        self._priors: dict[int, GaussianPrior] = {}

    @property
    def timed(self) -> bool:
        """Whether the end is to be reached at a given time."""
        return bool(np.isfinite(self.end.time))

    def basis(self, n_via: int) -> OptimalBasis:
        """With the last via-point where the run-up begins, if there is time for others before."""
        if n_via not in self._bases:
            basis = OptimalBasis.uniform(n_via)
            total = self.end.time - self.begin.time
            if n_via and self.timed and 0.0 < self._last < total / (n_via + 1):
                late = 1.0 - self._last / total
                basis = OptimalBasis(np.append(late * np.arange(1, n_via + 1) / n_via, 1.0))
            self._bases[n_via] = basis
        return self._bases[n_via]

    def keys(self, points: NDArray) -> NDArray[np.float64]:
        """Key positions (B, N + 2, 7) of via-points (B, N, 7)."""
        keys = np.empty((len(points), points.shape[1] + 2, 7))
        keys[:, 0], keys[:, -1] = self.begin.position, self.end.position
        keys[:, 1:-1] = self.play.raised(points)
        return keys

    def _durations(self, keys: NDArray) -> NDArray[np.float64]:
        if self.timed:
            return np.full(len(keys), self.end.time - self.begin.time)
        basis = self.basis(keys.shape[1] - 2)
        return np.asarray(
            minimal_duration(basis, keys, self.begin.velocity, self.end.velocity, self.play.limits)
        )

    def evaluate(self, points: NDArray) -> Evaluation:
        """Cost and validity of candidates (B, N, 7)."""
        keys = self.keys(points)
        basis = self.basis(points.shape[1])
        return self.play.assess(basis, keys, self.begin.velocity, self.end.velocity, self._durations(keys))

    def trajectory(self, points: NDArray) -> Trajectory:
        """The timed motion through via-points (N, 7)."""
        keys = self.keys(points[None])
        duration, basis = float(self._durations(keys)[0]), self.basis(len(points))
        ends = np.array([self.begin.velocity, self.end.velocity])
        by_keys, by_velocity = basis.knot_slopes[:, :-2], basis.knot_slopes[:, -2:]
        velocities = by_keys @ (keys[0] - keys[0, 0]) / duration + by_velocity @ ends
        return Trajectory.from_points(self.start_time + duration * basis.knots, keys[0], velocities)

    def direct(self, previous: Trajectory | None) -> NDArray[np.float64]:
        """No via-points."""
        return np.zeros((0, 7))

    def shifted(self, previous: Trajectory, n_via: int) -> NDArray[np.float64]:
        """Via-points (N, 7) on what is left of the previous motion."""
        finish = self.end.time if self.timed else previous.end_time
        begin = min(self.start_time, previous.end_time)
        times = begin + (finish - begin) * self.basis(n_via).phases[:-1]
        return previous(np.minimum(times, previous.end_time))

    def prior(self, n_via: int) -> GaussianPrior:
        """Smoothness prior, (4.15)."""
        if n_via not in self._priors:
            total = self.end.time - self.begin.time if self.timed else 1.0
            self._priors[n_via] = smoothness_prior(
                self.basis(n_via), self.begin.position, self.begin.velocity, self.end.position,
                self.end.velocity, total, spread=self.play.spread,
            )  # fmt: skip
        return self._priors[n_via]

    def guesses(self, n_via: int) -> NDArray[np.float64]:
        """Straight to the guess and on from there, the mean of the prior, and the hint, (S, N, 7)."""
        share = np.arange(1, n_via + 1)[:, None] / n_via
        if self.timed:
            way = self.begin.position + share * (self._guess - self.begin.position)
        else:
            way = self._guess + (share - 1.0 / n_via) * (self.end.position - self._guess)
        found = [way, self.prior(n_via).mean_points]
        if self._hint is not None and len(self._hint) == n_via:
            found.append(self._hint)
        return np.stack(found)


_RAISED = 0.12  # by how much the universal joint is raised to get over what stands on the table [m]
_CHECKED = 60  # postures of a motion that are looked at
_HARDLY = 1e-3  # arms that begin too low may be so much lower on their way [m]


def way_in(play: Play, position: NDArray, start: float, share: float) -> Trajectory:
    """Home from rest outside the plane of play: straight in the joints, or up, across and down; slowly.

    Args:
        play: rules and limits.
        position: joint positions at the start, shape (7,) [rad].
        start: time of the start [s].
        share: of the velocity limits.

    Raises:
        InfeasibleError: on either way the arm would touch the table or come too low.
    """
    home = np.array(play.rules.home)
    for keys in ([position, home], [position, _raised(play, position), _raised(play, home), home]):
        if any(key is None for key in keys):
            continue
        way = _straight([key for key in keys if key is not None], play.limits, start, share)
        if _clear(play, way):
            return way
    raise InfeasibleError("the arm cannot get home without coming too low; move it by hand above the table")


def _raised(play: Play, position: NDArray) -> NDArray[np.float64] | None:
    """The posture with the universal joint right above where it is, well above the plane of play."""
    q, (x, y, z) = position.copy(), arm_points(position[None])[0, 3]
    arm, axes, jac = np.empty((4, 3)), np.empty((7, 3)), np.empty((3, 6))
    return q if move_to(q, x, y, max(z, play.rules.height) + _RAISED, arm, axes, jac) else None


def _straight(keys: list[NDArray], limits: Limits, start: float, share: float) -> Trajectory:
    """From rest to rest along straight lines between postures."""
    slow = Limits(share * limits.velocity, share * limits.acceleration)
    still, whole = np.zeros(len(keys[0])), None
    for first, second in itertools.pairwise(keys):
        begin = start if whole is None else whole.end_time
        part = synthesize(
            OptimalBasis.uniform(0), np.stack([first, second]), still, still, slow, start_time=begin
        )
        whole = part if whole is None else whole.followed_by(part)
    assert whole is not None
    return whole


def _clear(play: Play, motion: Trajectory) -> bool:
    """Whether joints keep their range, the universal joint stays above the table and the arm high enough."""
    rows = motion(np.linspace(motion.start_time, motion.end_time, _CHECKED))
    points, (lower, upper) = arm_points(rows), play.limits.position_range
    arm, joint = points[:, 1:3, 2].min(axis=1), points[:, 3, 2]
    least = min(play.rules.clearance, arm[0] - _HARDLY)
    lowest = min(play.rules.height - play.rules.height_tolerance, joint[0] - _HARDLY)
    within = np.all((rows[1:] >= lower) & (rows[1:] <= upper)) or not np.all(
        (rows[0] >= lower) & (rows[0] <= upper)
    )
    return bool(within and arm.min() >= least and joint.min() >= lowest)
