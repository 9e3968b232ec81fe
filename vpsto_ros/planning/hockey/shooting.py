"""Contact planning for shots (5.3): when, where and how fast the mallet should touch the puck, at 50 Hz.

Frame: the table's, origin in its centre, x towards the goal that is shot at.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.contact.puck import PuckModel, ShotOutlook
from vpsto_ros.estimation.puck_filter import PuckState
from vpsto_ros.planning.hockey.shooting_config import (
    SETTINGS,
    ShootingConfig,
    ShootingObjective,
    Shot,
    Strikes,
    middle_strike,
)
from vpsto_ros.planning.hockey.shooting_policy import PolicySamples, ShootingPolicy
from vpsto_ros.planning.hockey.shooting_search import ShotSearch, Strokes
from vpsto_ros.planning.hockey.shooting_times import ContactTimes, Round
from vpsto_ros.planning.hockey.touch import same_touch

__all__ = ["SETTINGS", "ShootingConfig", "ShootingObjective", "ShootingPlanner", "Shot", "Strikes"]

SEARCHING = "contact times are being searched"
"""Why there is no shot yet, before the first round is over."""
STRUCK = "the puck has just been struck"
"""Why there is no shot for a moment after a touch."""
_REMEMBERED = 8  # shots that were refused
_SPEED_LEFT = 0.98  # share of a shot's speed that must still be possible when it is chosen
_TURNS = np.array([0.0, -1.0, -0.5, -0.25, 0.25, 0.5, 1.0])  # of a chosen angle in a step, of the largest


class ShootingPlanner:
    """Chooses a shot and keeps to it while the estimate of the puck gets better.

    Every step searches some of the contact times, so that a round over all of them takes several steps; after
    a round without a chosen shot the best one is chosen. A chosen shot keeps its time. Its angle turns only
    for a gain, it gives way only to a shot that is clearly better, and shortly before the touch it only
    follows the puck.

    Attributes:
        config: options.
        search: of a shot at a contact time.
        committed: the chosen shot, or None.
        reason: why there is none, in words; empty if there is one.
    """

    def __init__(
        self,
        model: PuckModel,
        strikes: Strikes,
        config: ShootingConfig | None = None,
        policy: ShootingPolicy | None = None,
        rng: np.random.Generator | None = None,
    ) -> None:
        """Begin without a shot.

        Args:
            model: of the puck.
            strikes: what the arm can do.
            config: options.
            policy: gives the angle at each contact time, instead of the grid.
            rng: for the policy's samples; a fixed one by default.

        Raises:
            ConfigurationError: puck and mallet of the model and of the strikes are not of the same size.
        """
        self.config, self._policy = config or ShootingConfig(), policy
        self._rng = rng if rng is not None else np.random.default_rng(0)
        self.search = ShotSearch(model, strikes, self.config)
        self._times = ContactTimes(self.search, policy, self._rng)
        self.committed: Shot | None = None
        self.forget()

    def forget(self) -> None:
        """Begin anew, as after a restart."""
        self._drop(SEARCHING)
        self._times.be_confident()
        self._barred: list[Shot] = []
        self._now = self._struck = -math.inf  # times of the last step and of the last touch [s]

    def _drop(self, reason: str) -> None:
        """Let go of the shot, and of what the search has found."""
        self.committed, self.reason = None, reason
        self._before: Shot | None = None  # what gave way to the chosen shot
        self._share = 1.0  # of the largest speed that the chosen shot has
        self._round: Round | None = None
        self._samples: PolicySamples | None = None
        self._found_wrong = ""  # with what the last round has found

    def warm_up(self, joints: ArrayLike) -> None:
        """Compile whatever shots use: a round over all contact times for an imaginary puck, then forget it.

        Args:
            joints: posture of the arm that waits, shape (7,) [rad].
        """
        place, _ = middle_strike(self.search.strikes)
        mean, steps = np.append(place, np.zeros(2)), 2 + len(self._times.begin(0.0).times)
        for now in 0.02 * np.arange(steps):
            self.plan(float(now), PuckState(float(now), mean, 1e-6 * np.eye(4), 0, ""), joints)
        self.forget()

    def refuse(self) -> None:
        """The arm cannot do the chosen shot: back to the one that gave way to it, and never that again.

        One that is over or that was refused itself does not come back.
        """
        shot, before = self.committed, self._before
        self._drop(SEARCHING)
        if shot is not None:
            self._barred = [*self._barred, shot][-_REMEMBERED:]
            self._times.be_cautious()
        if before is not None and before.time > self._now and not self._is_barred(before):
            self._commit(before)

    def plan(self, now: float, puck: PuckState | None, joints: ArrayLike) -> Shot | None:
        """A step of the planner.

        Nothing that a filter or a robot delivers raises: where there is no shot, `reason` says why.

        Args:
            now: time [s].
            puck: the estimate, or None if there is none.
            joints: posture of the arm, shape (7,) [rad].

        Returns:
            The chosen shot, or None.
        """
        posture = np.asarray(joints, dtype=float)
        objection = self._objection(now, puck, posture)
        if objection or puck is None:
            self._drop(objection)
            self._times.be_confident()  # the next puck is another one
            return None
        if now < self._now:  # a clock that was set back
            self.forget()
        self._now = now
        if self.committed is not None and now >= self.committed.time:
            self._struck = self.committed.time
            self._times.be_confident()
            self._drop(STRUCK)
        if now - self._struck < self.config.pause:
            return None
        if self.committed is not None:
            objection = self._follow(self.committed, now, puck)
            if objection:
                self._drop(objection)
        if self.committed is None or self.committed.time - now > self.config.frozen:
            self._look_around(now, puck, posture)
        return self.committed

    def _objection(self, now: float, puck: PuckState | None, joints: NDArray) -> str:
        """What makes planning pointless, else empty."""
        if puck is None:
            return "no puck is known"
        if joints.shape != (7,) or not np.isfinite(joints).all():
            return "the posture of the arm is not seven finite numbers"
        if not (math.isfinite(now) and math.isfinite(puck.stamp)):
            return "a time is not finite"
        if np.shape(puck.mean) != (4,) or np.shape(puck.covariance) != (4, 4):
            return "the puck's state has not the shapes (4,) and (4, 4)"
        if not (np.isfinite(puck.mean).all() and np.isfinite(puck.covariance).all()):
            return "the puck's state is not finite"
        if (np.diag(puck.covariance) < 0.0).any():
            return "the puck's state has a negative variance"
        if abs(now - puck.stamp) > self.config.oldest:
            return f"the puck's state is {now - puck.stamp:.2f} s old"
        if self._times.off_table(puck.mean[None])[0]:
            return "the puck has left the table"
        return ""

    def _follow(self, shot: Shot, now: float, puck: PuckState) -> str:
        """Weigh the shot anew for what is now known of the puck; what speaks against it, else empty."""
        ahead = np.array([max(shot.time - puck.stamp, 0.0)])
        mean, covariance = self.search.model.predict(puck.mean, puck.covariance, ahead)
        _, (_, objection) = self._times.places(mean, covariance, chosen=True)
        if objection:
            return objection
        if math.dist(mean[0, :2], shot.puck[:2]) > self.config.largest_jump:
            return "the puck will be elsewhere than where the shot was planned"
        frozen = shot.time - now <= self.config.frozen
        strokes = self._same(shot, mean, covariance) if frozen else self._turned(shot, mean, covariance)
        if not strokes.angle.size:
            return "the puck cannot be struck any more where it will be"
        outlook = self.search.outlook(strokes)
        row = self._preferred(strokes.angle, outlook, shot.angle)
        if row is None:
            return f"the chance of the shot has fallen to {outlook.goal.max():.2f}"
        self.committed, self.reason = self.search.shot(strokes, outlook, row), ""
        return ""

    def _same(self, shot: Shot, mean: NDArray, covariance: NDArray) -> Strokes:
        """The shot at where the puck (1, 4) will be; empty if the mallet has no room there."""
        angles, times = np.array([shot.angle]), np.array([shot.time])
        kept = self.search.fits(mean[:, :2], angles)
        speeds = np.array([shot.speed])[kept]
        return Strokes(times[kept], mean[kept], covariance[kept], angles[kept], speeds)

    def _turned(self, shot: Shot, mean: NDArray, covariance: NDArray) -> Strokes:
        """The shot, and what it would be if it were turned; empty if the arm can do none of this."""
        angles = shot.angle + self.config.angle_step * _TURNS
        if self._policy is not None:
            angles = np.array([shot.angle, self._proposal(self._policy, mean[0])])
        largest = self.search.speeds(np.repeat(mean[:, :2], len(angles), axis=0), angles)
        kept = largest > 0.0
        rows = np.zeros(kept.sum(), dtype=int)
        times = np.full(len(rows), shot.time)
        return Strokes(times, mean[rows], covariance[rows], angles[kept], self._share * largest[kept])

    def _proposal(self, policy: ShootingPolicy, state: NDArray) -> float:
        """The angle by the policy: a step of Algorithm 2 from the samples of the step before, (5.3.4)."""
        if self._samples is None:
            angle, self._samples = policy.solve(state, self.config.policy_steps, self._rng)
        else:
            angle, self._samples = policy.infer(state, self._samples, self._rng)
        return angle

    def _preferred(self, angles: NDArray, outlook: ShotOutlook, angle: float) -> int | None:
        """Which of some angles to take: the one chosen before unless another gains; None if none is good."""
        objective, chance = self.config.objective, self.config.objective.beta - self.config.tolerance
        scores = objective.scores(outlook)
        best = int(np.argmax(scores))
        before = angles[0] == angle and np.isfinite(outlook.speed[0])
        if before and (outlook.goal[0] > chance or self.config.fallback):
            # A chance between the threshold and its tolerance counts as if it were good.
            own = objective.values(outlook)[0] if outlook.goal[0] > chance else scores[0]
            return best if scores[best] > own + self.config.angle_gain else 0
        good = bool(objective.allowed(outlook)[best]) or self.config.fallback
        return best if good and np.isfinite(outlook.speed[best]) else None

    def _look_around(self, now: float, puck: PuckState, joints: NDArray) -> None:
        """Search the next contact times, and choose a shot at the end of a round or for a clear gain."""
        if self._round is None:
            self._round = self._times.begin(now)
        current = self._round
        shot = self._times.advance(current, now, puck, joints)
        if shot is not None and self.search.taken(shot) and not self._is_barred(shot):
            current.shots.append(shot)
            before = self.committed
            if before is not None and self._clearly_better(shot, before):
                self._commit(shot)
                self._before = before
        if current.times.size:
            if self.committed is None:
                self.reason = self._found_wrong or SEARCHING
            return
        self._round = None
        if self.committed is None:
            self._choose(current, now, puck, joints)

    def _clearly_better(self, shot: Shot, committed: Shot) -> bool:
        """Whether a shot at another time gains enough, the price of waiting included."""
        gain = self._worth(shot) - self._worth(committed, self.config.tolerance)
        return gain > self.config.clear_gain and shot.time != committed.time

    def _choose(self, finished: Round, now: float, puck: PuckState, joints: NDArray) -> None:
        """Choose the best shot of a round that is still possible."""
        reason = finished.objection[1]
        for shot in sorted(finished.shots, key=self._worth, reverse=True):
            there, ahead = (shot.puck[None, :2], np.array([shot.angle])), np.array([shot.time - now])
            if self.search.strikes.timely_speeds(joints, *there, ahead)[0] < _SPEED_LEFT * shot.speed:
                reason = "the arm cannot be there in time"
                continue
            self._commit(shot)
            reason = self._follow(shot, now, puck)
            if not reason:
                return
        self._drop(reason)
        self._found_wrong = reason

    def _is_barred(self, shot: Shot) -> bool:
        """Whether it is one that the arm has refused."""
        return any(same_touch(shot.time, shot.mallet, bad.time, bad.mallet) for bad in self._barred)

    def _commit(self, shot: Shot) -> None:
        self._before = None
        largest = float(self.search.speeds(shot.puck[None, :2], np.array([shot.angle]))[0])
        self._share = shot.speed / largest if largest > 0.0 else 1.0
        self.committed, self.reason, self._samples = shot, "", None

    def _worth(self, shot: Shot, tolerance: float = 0.0) -> float:
        """The objective of a shot, less its price; far less if it breaks a constraint."""
        objective = self.config.objective
        good = shot.goal > objective.beta - tolerance and shot.banks >= objective.least_banks
        row = np.array([shot.angle]), np.array([shot.speed])
        price = self.search.prices(np.array([shot.time]), shot.puck[None], *row)[0]
        return float((shot.value if good else shot.goal - 10.0) - price)
