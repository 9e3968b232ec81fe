"""Online VP-STO to a goal in joint space, among obstacles that may move (4.4, Algorithm 1).

:class:`JointSpaceMpc` plans step after step from the motion that is being executed and decides what to do
when the search finds nothing. One planning step is an
:class:`~vpsto_ros.planning.joint_space_problem.OnlineJointSpaceProblem`.
"""

import dataclasses
import math
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError, VpstoError
from vpsto_ros.optimization.progress import SearchResult
from vpsto_ros.optimization.terms import Term
from vpsto_ros.planning.joint_space_problem import JointSpaceMpcConfig, OnlineJointSpaceProblem
from vpsto_ros.planning.mpc import OnlineVpsto
from vpsto_ros.planning.stitching import as_batch, extended, remainder, resting
from vpsto_ros.trajectory import (
    MINIMUM_DURATION,
    Limits,
    OptimalBasis,
    Trajectory,
    braking_trajectory,
    synthesize,
    synthesize_batch,
)

AT_GOAL = 1e-9
"""Distance between the end of a motion and the goal that still counts as arriving."""

MOST_ESCAPES = 8
"""How many ways out are looked at more closely."""


@dataclasses.dataclass(frozen=True)
class JointSpacePlan:
    """Outcome of one planning step.

    Attributes:
        trajectory: what to execute from the takeover on; it ends at rest.
        mode: what the trajectory is. A new plan is "stop", "warm_start" or "explore" (Algorithm 1); "keep"
            goes on with the present one, which is valid and no worse; "hold" stands at the goal. Without a
            valid plan, "follow" goes on for now, "brake" comes to rest and "escape" moves out of the way.
        searched: which mode of Algorithm 1 was tried, "" if none.
        valid: whether the trajectory is known to reach the goal with all constraints satisfied.
        cost: its cost, inf if it is not valid.
        search: what the search reports, None without a search.
    """

    trajectory: Trajectory
    mode: str
    searched: str
    valid: bool
    cost: float
    search: SearchResult | None = None


class JointSpaceMpc:
    """Plans step after step to a goal, from the motion that is being executed.

    Safety: the executed motion is only replaced by a valid plan of lower cost, and goes on otherwise. When an
    obstacle has moved into it and no valid plan is found, the first of these that is clear for ``lookahead``
    seconds is taken: going on, braking, a short motion out of the way; without any, the one that breaks
    least. All of them end at rest, and velocity and acceleration limits hold on all of them. The exception
    is a robot that is taken over faster than its velocity limit: :meth:`begin` brakes it as hard as the
    acceleration limits allow, what is too fast only gets slower, and plans follow once it is within limits.
    """

    def __init__(self, limits: Limits, config: JointSpaceMpcConfig, rng: np.random.Generator) -> None:
        self.limits, self.config, self.rng = limits, config, rng
        self.online = OnlineVpsto(config.online, rng)
        self._reference: Trajectory | None = None
        self._solved = False
        self._posed: OnlineJointSpaceProblem | None = None

    @property
    def reference(self) -> Trajectory:
        """The motion that is being executed.

        Raises:
            VpstoError: nothing is being executed; :meth:`begin` comes first.
        """
        if self._reference is None:
            raise VpstoError("the planner does not know where the robot is; call begin() first")
        return self._reference

    def begin(self, position: ArrayLike, now: float, velocity: ArrayLike | None = None) -> Trajectory:
        """Take over a robot, coming to rest if it moves; returns what to execute until the first plan.

        Args:
            position: shape (n,).
            now: present time [s].
            velocity: shape (n,), zero by default; it may be beyond its limit, see the class.

        Raises:
            InvalidInputError: a shape does not fit or a number is not finite.
        """
        place = self._vector("the position", position)
        speed = np.zeros(self.limits.dof) if velocity is None else self._vector("the velocity", velocity)
        self._reference = braking_trajectory(place, speed, self.limits, start_time=_finite("now", now))
        self._solved = False
        return self._reference

    def accept(self, plan: JointSpacePlan) -> None:
        """Take note that a plan is being executed."""
        self._reference, self._solved = plan.trajectory, plan.valid

    def step(
        self,
        takeover: float,
        goal: ArrayLike,
        terms: tuple[Term, ...] = (),
        *,
        tolerated: tuple[Term, ...] | None = None,
        deadline: float | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> JointSpacePlan:
        """Plan once. Call :meth:`accept` when the plan is going to be executed.

        Args:
            takeover: time from which the plan will be executed [s]; until then the present motion goes on.
            goal: where to come to rest, shape (n,).
            terms: what new plans have to satisfy; moving obstacles as they will be at ``takeover``.
            tolerated: what the present motion has to satisfy to be kept, with smaller margins for instance,
                so that noise does not make it invalid; ``terms`` by default.
            deadline: value of `clock` at which to return the best found so far.
            clock: source of that time.

        Raises:
            InvalidInputError: the goal has another shape, is not finite, beyond its limits or inside an
                obstacle that does not move (a term with ``static = True``, on the term itself or the object
                whose method it is); or the takeover is not finite or before the present motion begins. The
                present motion, which ends at rest, stays the one being executed.
            VpstoError: nothing is being executed yet.
        """
        kept, goal = self._kept(takeover), self._checked(goal, terms)
        problem = self._posed = self._problem(kept, goal, terms)
        judge = problem if tolerated is None else self._problem(kept, goal, tolerated)
        cost, clear = judge.assess(kept)
        arrives = clear and bool(np.abs(kept(kept.end_time) - goal).max() <= AT_GOAL)
        if arrives and not kept(kept.times, 1).any() and self._ahead(judge, kept)[1]:
            return JointSpacePlan(kept, "hold", "", True, cost)
        self.online.accept(self.reference if clear and self._solved else None)
        result = self.online.step(problem, deadline=deadline, clock=clock)
        if result.trajectory is not None and not (arrives and cost <= result.cost):
            return JointSpacePlan(
                result.trajectory, result.mode, result.mode, True, result.cost, result.search
            )
        if arrives:
            return JointSpacePlan(kept, "keep", result.mode, True, cost, result.search)
        mode, motion = self._fallback(judge, kept)
        return JointSpacePlan(motion, mode, result.mode, False, math.inf, result.search)

    def explain(self, plan: JointSpacePlan) -> list[str]:
        """Why the search of the last step found no valid plan: what breaks its best candidate, in words."""
        best = None if plan.search is None or plan.search.valid else plan.search.best_any_points
        if best is None or self._posed is None:
            return []
        return self._posed.plain(len(best)).explain(best)

    def _kept(self, takeover: float) -> Trajectory:
        """What is left of the present motion at the takeover."""
        begin = self.reference.start_time
        if _finite("the takeover", takeover) < begin - 1e-9:
            raise InvalidInputError(
                f"the takeover at {takeover:.6g} s is before the present motion begins, at {begin:.6g} s"
            )
        return remainder(self.reference, takeover)

    def _vector(self, name: str, value: ArrayLike) -> NDArray:
        """A number for each joint."""
        try:
            array = np.array(value, dtype=float)
        except (TypeError, ValueError):
            array = np.empty(0)
        if array.shape != (self.limits.dof,) or not np.isfinite(array).all():
            raise InvalidInputError(f"{name} must be finite with shape ({self.limits.dof},), got {value!r}")
        return array

    def _checked(self, goal: ArrayLike, terms: tuple[Term, ...]) -> NDArray:
        """The goal, refused if no motion could end there."""
        target, limits = self._vector("the goal", goal), self.limits
        for bound, beyond, side in ((limits.lower, np.less, "below"), (limits.upper, np.greater, "above")):
            if bound is not None and beyond(target, bound).any():
                joint = int(np.argmax(beyond(target, bound)))
                raise InvalidInputError(
                    f"the goal {target[joint]:.6g} of joint {joint + 1} is {side} its limit "
                    f"{bound[joint]:.6g}"
                )
        standing = resting(target, 0.0, MINIMUM_DURATION)
        for term in terms:
            owner = getattr(term, "__self__", term)
            if getattr(owner, "static", False) and not term(as_batch(standing, self.config.samples))[1][0]:
                explain = getattr(owner, "explain", None)
                reasons = [] if explain is None else explain(standing)
                where = ", ".join(f"{value:.4g}" for value in target)
                raise InvalidInputError(f"the goal ({where}): {'; '.join(reasons) or 'in collision'}")
        return target

    def _problem(self, kept: Trajectory, goal: NDArray, terms: tuple[Term, ...]) -> OnlineJointSpaceProblem:
        position, velocity, _ = kept.state(kept.start_time)
        return OnlineJointSpaceProblem(
            self.limits, position=position, velocity=velocity, start_time=kept.start_time, goal=goal,
            terms=terms, config=self.config,
        )  # fmt: skip

    def _ahead(self, judge: OnlineJointSpaceProblem, motion: Trajectory) -> tuple[float, bool]:
        """Cost and validity of the next ``lookahead`` seconds, standing at the end of the motion included."""
        end = motion.start_time + self.config.lookahead
        return judge.assess(extended(motion, end).clipped(motion.start_time, end))

    def _fallback(self, judge: OnlineJointSpaceProblem, kept: Trajectory) -> tuple[str, Trajectory]:
        """What to do without a valid plan, and its name."""
        brake = braking_trajectory(
            judge.position, judge.velocity, self.limits, start_time=judge.start_time
        )
        options = [("follow", kept), ("brake", brake)]
        costs = []
        for mode, motion in options:
            cost, clear = self._ahead(judge, motion)
            if clear:
                return mode, motion
            costs.append(cost)
        for motion in self._escapes(judge, brake(brake.end_time)):
            cost, clear = self._ahead(judge, motion)
            if clear:
                return "escape", motion
            options.append(("escape", motion))
            costs.append(cost)
        return options[int(np.argmin(costs))]

    def _escapes(self, judge: OnlineJointSpaceProblem, centre: NDArray) -> list[Trajectory]:
        """Direct motions to random positions around a centre, the cheapest first (and best, if clear)."""
        limits, start = self.limits, judge.position
        reach = 0.5 * self.config.lookahead * np.where(np.isfinite(limits.velocity), limits.velocity, 1.0)
        ends = centre + self.rng.uniform(-1.0, 1.0, (self.config.escapes, limits.dof)) * reach
        ends = np.maximum(ends, -np.inf if limits.lower is None else limits.lower)
        ends = np.minimum(ends, np.inf if limits.upper is None else limits.upper)
        basis, still = OptimalBasis.uniform(0), np.zeros(limits.dof)
        keys = np.stack([np.broadcast_to(start, ends.shape), ends], axis=1)
        batch = synthesize_batch(basis, keys, judge.velocity, still, limits, self.config.samples)
        cost = judge.plain(0).assess(batch).cost
        order = [i for i in np.argsort(cost, kind="stable") if np.isfinite(cost[i])]
        return [
            synthesize(basis, keys[i], judge.velocity, still, limits, start_time=judge.start_time)
            for i in order[:MOST_ESCAPES]
        ]


def _finite(name: str, value: float) -> float:
    """A finite number; anything else is refused."""
    if isinstance(value, (int, float, np.number)) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    raise InvalidInputError(f"{name} must be a finite time, got {value!r}")
