"""Searching contact times (5.3.1): when the puck can be struck, and the best shot then."""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.estimation.puck_filter import PuckState
from vpsto_ros.planning.hockey.shooting_config import Shot
from vpsto_ros.planning.hockey.shooting_policy import ShootingPolicy
from vpsto_ros.planning.hockey.shooting_search import ShotSearch, Strokes
from vpsto_ros.robot.iiwa import iiwa14

Objection = tuple[int, str]
"""What rules a shot out, and how far it had come until then; the farthest one is told."""
NO_OBJECTION: Objection = (-1, "")
_CAUTION, _MOST_CAUTION = 1.15, 2.0
"""Factor on the time that the arm is said to need, for every shot that it refuses, and the largest."""
_SLOWER_FROM = 1.4  # caution beyond which the mallet is asked to be slower, too
_PACE, _LEAST_PACE = 0.9, 0.6
"""Factor on the mallet's speed, likewise: slower strikes are easier to run up to; and the least."""
_SOONEST = 0.05  # no touch is planned so soon [s]
_SURE = 2.0  # standard deviations of its place by which a puck must be within reach
_BEYOND = 0.01  # how far beyond the reach a chosen shot may get [m]
_FASTER = 1.02  # what makes it worth while to search a direction again
_RIM = 0.02  # estimates of a puck at a rim may be so far in it [m]
_AT_REST = 0.03  # slower pucks do not move away [m/s]


@dataclasses.dataclass(eq=False)
class Round:
    """A search over all contact times, a part of them in each step.

    Attributes:
        times: that are left to search, shape (K,) [s].
        shots: the best of each step so far.
        place: of the puck where the grid was searched last, shape (2,) [m].
        covered: largest speed that has been searched there in each direction, shape (A,) [m/s].
        objection: how far the best candidates have come, and what was wrong with them.
    """

    times: NDArray
    shots: list[Shot] = dataclasses.field(default_factory=list)
    place: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.full(2, np.inf))
    covered: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.zeros(0))
    objection: Objection = NO_OBJECTION


class ContactTimes:
    """Searches contact times on a fixed grid of times, so that they stay comparable from step to step.

    Attributes:
        search: of a shot at a contact time.
        policy: gives the angle at each contact time, or None for the grid of angles.
        caution: factor on the time that the arm is said to need, 1 until it has refused a shot.
        pace: share of the largest speeds that is asked for, likewise.
    """

    def __init__(self, search: ShotSearch, policy: ShootingPolicy | None, rng: np.random.Generator) -> None:
        """Hold what is searched with."""
        self.search, self.policy, self._rng = search, policy, rng
        self.caution, self.pace = 1.0, 1.0
        strikes = search.strikes
        self._low = np.array([strikes.x[0], strikes.y[0]])
        self._high = np.array([strikes.x[-1], strikes.y[-1]])

    def be_cautious(self) -> None:
        """The arm has refused a shot: count on more time, and where that was not enough on less speed."""
        self.caution = min(_MOST_CAUTION, _CAUTION * self.caution)
        if self.caution > _SLOWER_FROM:
            self.pace = max(_LEAST_PACE, _PACE * self.pace)

    def be_confident(self) -> None:
        """The arm is taken at its word again."""
        self.caution = self.pace = 1.0

    def begin(self, now: float) -> Round:
        """A new round from a time [s] on."""
        step = self.search.config.time_step
        first, last = now + _SOONEST, now + self.search.config.latest
        return Round(step * np.arange(math.ceil(first / step), math.floor(last / step) + 1))

    def advance(self, current: Round, now: float, puck: PuckState, joints: NDArray) -> Shot | None:
        """Search the next contact times of a round; what is left to search is changed in place.

        Args:
            current: the round.
            now: time [s].
            puck: the estimate.
            joints: posture of the arm, shape (7,) [rad].

        Returns:
            The best shot, which may break constraints, or None.
        """
        config = self.search.config
        current.times = current.times[current.times > now + _SOONEST]
        if not current.times.size:
            return None
        ahead = np.maximum(current.times - puck.stamp, 0.0)
        means, covariances = self.search.model.predict(puck.mean, puck.covariance, ahead)
        places, objection = self.places(means, covariances)
        slots, count = np.flatnonzero(places), config.times_per_step
        if self.policy is not None:
            count = config.policy_times_per_step
        chunk, rest = slots[:count], slots[count:]
        times, shot, found = current.times[chunk], None, NO_OBJECTION
        if chunk.size:
            speeds, largest, objection = self._speeds(means[chunk], times - now, joints)
            speeds = self._fresh(current, means[chunk, :2], speeds)
            if rest.size and self._all_seen(current, means[rest, :2], largest[-1]):
                rest = rest[:0]
            if speeds.any():
                find = self._inferred if self.policy is not None else self.search.best_of
                shot = find(times, means[chunk], covariances[chunk], speeds)
                found = self._complaint(shot)
        current.objection = max(current.objection, objection, found)
        current.times = current.times[rest]
        return shot

    def _inferred(
        self, times: NDArray, means: NDArray, covariances: NDArray, speeds: NDArray
    ) -> Shot | None:
        """The best of what the policy proposes; arguments as of :meth:`ShotSearch.best_of`."""
        assert self.policy is not None
        steps = self.search.config.policy_steps
        slots = np.flatnonzero(speeds.any(axis=1))
        angles = np.array([self.policy.solve(means[slot], steps, self._rng)[0] for slot in slots])
        near = np.argmin(np.abs(self.search.angles - angles[:, None]), axis=1)
        largest = self.search.speeds(means[slots, :2], angles)
        possible = (largest > 0.0) & (speeds[slots, near] > 0.0)
        if not possible.any():
            return None
        slots, angles, near = slots[possible], angles[possible], near[possible]
        # Where time is short the speeds of the grid are less than the largest.
        share = speeds[slots, near] / self.search.strikes.speeds(means[slots, :2], self.search.angles[near])
        largest = share * largest[possible]
        strokes = Strokes(times[slots], means[slots], covariances[slots], angles, largest)
        outlook = self.search.outlook(strokes)
        return self.search.shot(strokes, outlook, int(np.argmax(self.search.ranked(strokes, outlook))))

    def places(
        self, means: NDArray, covariances: NDArray, *, chosen: bool = False
    ) -> tuple[NDArray, Objection]:
        """At which contact times (K,) the puck is where it could be struck, and the objection if at none.

        It must be there for all that is known; a shot that has been chosen may be a little beyond the reach.
        """
        x, y, vx = means[:, 0], means[:, 1], means[:, 2]
        inside = [-_BEYOND if chosen else _SURE * np.sqrt(covariances[:, i, i]) for i in (0, 1)]
        std, largest = _largest_std(covariances), self.search.config.largest_std
        far, close = x > self._high[0] - inside[0], x < self._low[0] + inside[0]
        beside = (y < self._low[1] + inside[1]) | (y > self._high[1] - inside[1])
        checks = [
            (~np.logical_or.accumulate(self.off_table(means)), "the puck is leaving the table"),
            (~np.logical_or.accumulate(far & (vx > _AT_REST)), "the puck is out of reach and moves away"),
            (~far, "the puck is out of the arm's reach"),
            (~close, "the puck is behind where the mallet can strike"),
            (~beside, "the puck is too near to a side wall"),
            (std <= largest, f"where the puck will be is uncertain by {1e3 * std.min():.0f} mm"),
        ]
        return _narrowed(np.ones(len(means), dtype=bool), checks, 0)

    def _speeds(
        self, means: NDArray, available: NDArray, joints: NDArray
    ) -> tuple[NDArray, NDArray, Objection]:
        """Speeds (K, A) of the mallet for the grid; 0 for what is not possible in the time (K,) [s].

        Returns:
            The speeds; those (K, A) that there would be with more time; the objection if there is none.
        """
        shape = (len(means), len(self.search.angles))
        puck = np.repeat(means[:, :2], shape[1], axis=0)
        angles = np.tile(self.search.angles, shape[0])
        fits, speeds = self.search.fits(puck, angles), self.search.strikes.speeds(puck, angles)
        mallet = iiwa14().forward(joints)[0][:2] - self.search.strikes.center
        direction = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        behind = ((puck - mallet) * direction).sum(axis=1) > 0.0
        there, objection = _narrowed(
            np.ones(len(puck), dtype=bool),
            [
                (fits, "there is no room for the mallet behind the puck"),
                (speeds > 0.0, "the arm cannot strike there"),
                (behind, "the puck is behind the mallet"),
            ],
            6,
        )
        rows, timely = np.flatnonzero(there), np.zeros(len(puck))
        if rows.size:
            spare = (np.repeat(available, shape[1])[rows] - self.search.config.lead_margin) / self.caution
            timely[rows] = self.search.strikes.timely_speeds(joints, puck[rows], angles[rows], spare)
            timely[rows] *= self.pace
            if not timely.any():
                objection = (9, "the arm cannot be there in time")
        return timely.reshape(shape), np.where(there, speeds, 0.0).reshape(shape), objection

    def _fresh(self, current: Round, places: NDArray, speeds: NDArray) -> NDArray[np.float64]:
        """Speeds (K, A) of which none as fast has been searched at nearly the same place (K, 2), else 0."""
        fresh = speeds.copy()
        for k, place in enumerate(places):
            if math.dist(place, current.place) < self.search.config.same_place:
                fresh[k, speeds[k] <= _FASTER * current.covered] = 0.0
                current.covered = np.maximum(current.covered, speeds[k])
            else:
                current.place, current.covered = place, speeds[k]
        return fresh

    def _all_seen(self, current: Round, places: NDArray, largest: NDArray) -> bool:
        """Whether the puck stays where all that there is to search, up to speeds (A,), has been searched."""
        apart = np.linalg.norm(places - current.place, axis=1).max()
        return bool(apart < self.search.config.same_place and (_FASTER * current.covered >= largest).all())

    def _complaint(self, shot: Shot | None) -> Objection:
        """What is wrong with the best shot that was found."""
        objective = self.search.config.objective
        if shot is None or not math.isfinite(shot.goal_speed):
            return 10, "no shot from there reaches the goal"
        if shot.banks < objective.least_banks:
            return 11, f"no shot from there meets {objective.least_banks} walls on its way to the goal"
        if not shot.goal > objective.beta:
            return 12, f"the best shot scores with probability {shot.goal:.2f}, wanted {objective.beta:g}"
        return -1, ""

    def off_table(self, states: NDArray) -> NDArray[np.bool_]:
        """Which of some states (K, 4) are outside the rims, or in a goal."""
        farthest = self.search.model.table.reach + _RIM
        beyond: NDArray[np.bool_] = np.any(np.abs(states[:, :2]) > farthest, axis=1)
        return beyond


def _largest_std(covariances: NDArray) -> NDArray[np.float64]:
    """Standard deviations (K,) of places along their longest axes, of covariances (K, 4, 4)."""
    a, b, c = covariances[:, 0, 0], covariances[:, 1, 1], covariances[:, 0, 1]
    return np.sqrt(0.5 * (a + b) + np.hypot(0.5 * (a - b), c))


def _narrowed(
    mask: NDArray, checks: list[tuple[NDArray, str]], first: int
) -> tuple[NDArray, Objection]:
    """What passes all checks, and the first check, numbered from `first`, after which nothing is left."""
    for number, (passed, text) in enumerate(checks, start=first):
        mask = mask & passed
        if not mask.any():
            return mask, (number, text)
    return mask, NO_OBJECTION
