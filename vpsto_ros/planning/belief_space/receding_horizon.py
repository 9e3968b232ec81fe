"""Receding-horizon BS-VP-STO, Algorithm 3: long pushes as a sequence of robust horizons.

Each horizon is one search. Offline the belief is then carried on by a noisy rollout; online an estimator
does that. A horizon without any valid candidate is not executed: the robot brakes, and the next horizon
begins from there.
"""

import dataclasses
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.exceptions import ConfigurationError, InfeasibleError
from vpsto_ros.optimization.progress import SearchResult
from vpsto_ros.optimization.vpsto import search
from vpsto_ros.planning.belief_space.config import RobustPushingConfig
from vpsto_ros.planning.belief_space.contacts import ContactRule
from vpsto_ros.planning.belief_space.problem import Reach, RobustPushingProblem, require_free
from vpsto_ros.planning.belief_space.spaces import SearchSpace
from vpsto_ros.planning.belief_space.targets import Target
from vpsto_ros.trajectory import Trajectory, braking_trajectory

MAX_HORIZONS = 500
"""Horizons after which the thesis gives up (6.6.3)."""
EXECUTED = 12
"""Steps H of a horizon after which a plan made offline is continued anew."""
STILL = 1e-9
"""Speed below which there is nothing to brake, in units of the search space per second: round-off."""

_STEP_TIME = 0.02  # of a brake before any horizon was valid [s]


@dataclasses.dataclass(frozen=True)
class Horizon:
    """One horizon.

    Attributes:
        trajectory: motion in the search space from the present state to rest.
        valid: whether it keeps all constraints; if not, it brakes.
        result: of the search.
        problem: what was solved.
    """

    trajectory: Trajectory
    valid: bool
    result: SearchResult
    problem: RobustPushingProblem


@dataclasses.dataclass(frozen=True)
class RobustPlan:
    """A long push.

    Attributes:
        trajectory: motion in the search space, from rest or the given velocity to rest; None if no horizon
            was planned.
        reached: whether the target was reached within the horizons allowed.
        horizons: number of searches.
        violating: how many of them found no valid candidate and braked instead.
        belief: at the end.
        means: mean position of the belief after each horizon, shape (horizons + 1, 2) [m].
        stds: root of the belief's variance after each, shape (horizons + 1,) [m].
        times: at which each horizon began, and the end, shape (horizons + 1,) [s].
        wedge: smallest product of two contact normals in the noisy rollouts.
        seconds: planning time [s].
        evaluations: candidates rolled out.
    """

    trajectory: Trajectory | None
    reached: bool
    horizons: int
    violating: int
    belief: ObjectBelief
    means: NDArray
    stds: NDArray
    times: NDArray
    wedge: float
    seconds: float
    evaluations: int


class RobustPusher:
    """Plans horizons for one robot and one object."""

    def __init__(
        self,
        config: RobustPushingConfig,
        dynamics: BeliefDynamics,
        space: SearchSpace,
        rule: ContactRule,
        rng: np.random.Generator,
        *,
        reach: Reach | None = None,
        executed: int = EXECUTED,
    ) -> None:
        """Set up the planner; see :class:`RobustPushingProblem` for the other arguments.

        Args:
            config: options.
            dynamics: of the belief.
            space: what is searched.
            rule: where to touch.
            rng: source of randomness.
            reach: tells which plane coordinates the arms reach.
            executed: steps H of a horizon after which :meth:`plan` plans anew.

        Raises:
            ConfigurationError: H is not from 1 to the number of steps.
        """
        if not 1 <= executed <= config.steps:
            raise ConfigurationError(
                f"executed = {executed}: a horizon of steps = {config.steps} is executed for 1 to as many"
            )
        self._executed = executed
        self.config, self.dynamics, self.space, self.rule = config, dynamics, space, rule
        self.rng, self.reach = rng, reach
        self._step_time = _STEP_TIME
        self._quiet = dataclasses.replace(dynamics, friction=False, step_variance=0.0, way_variance=0.0)

    def horizon(
        self,
        start: NDArray,
        velocity: NDArray,
        belief: ObjectBelief,
        way: NDArray,
        *,
        start_time: float = 0.0,
        previous: Trajectory | None = None,
        contact: tuple[NDArray, NDArray] | None = None,
        tool_offset: NDArray | float = 0.0,
        deadline: float | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> Horizon:
        """Plan one horizon.

        Args:
            start: state of the robot in the search space when the horizon begins, shape (n,).
            velocity: its velocity, shape (n,).
            belief: at that time; jitter is added here.
            way: where to push the object, see :meth:`Target.way`, shape (L, 3) [m].
            start_time: when the horizon begins [s].
            previous: what was planned before; what is left of it is one more candidate.
            contact: where to touch, see :class:`RobustPushingProblem`.
            tool_offset: of the end effectors, see :class:`RobustPushingProblem`.
            deadline: value of `clock` by which to be back.
            clock: reads the time.
        """
        config = self.config
        problem = RobustPushingProblem(
            config, self.dynamics, self.space, self.rule, start=start, velocity=velocity,
            belief=self._planning_belief(belief, start), way=way, reach=self.reach, start_time=start_time,
            contact=contact, tool_offset=tool_offset,
        )  # fmt: skip
        result = search(
            problem.prior(), problem.evaluate, config.search, self.rng,
            seeds=self._left_over(previous, start_time), deadline=deadline, clock=clock,
        )  # fmt: skip
        if result.points is not None:
            motion = problem.trajectory(result.points)
            self._step_time = motion.duration / config.steps
            return Horizon(motion, True, result, problem)
        brake = braking_trajectory(start, velocity, self.space.limits, start_time=start_time)
        return Horizon(brake, False, result, problem)

    def executed_time(self, horizon: Horizon) -> float:
        """How long a horizon is executed before :meth:`plan` plans anew; a brake is to its end [s]."""
        share = self._executed / self.config.steps if horizon.valid else 1.0
        return share * horizon.trajectory.duration

    def plan(
        self,
        start: NDArray,
        belief: ObjectBelief,
        target: Target,
        *,
        velocity: NDArray | None = None,
        horizons: int = MAX_HORIZONS,
        start_time: float = 0.0,
        report: Callable[[float], None] | None = None,
    ) -> RobustPlan:
        """Algorithm 3, offline: a plan that needs no sensors.

        Args:
            start: of the robot in the search space, shape (n,).
            belief: over the object.
            target: where to push it.
            velocity: of the robot, zero by default, shape (n,).
            horizons: how many are planned at most.
            start_time: when the motion begins [s].
            report: called with what is left to push [m] after every horizon.

        Raises:
            InvalidInputError: robot and object penetrate each other at the start.
        """
        require_free(self.dynamics, belief, self.space.plane(np.asarray(start)[None, None])[0][0, 0])
        began, q, dynamics = time.perf_counter(), np.asarray(start, dtype=float), self.dynamics
        if not self.config.robust:  # the baseline takes the expected place and the nominal model for true
            belief = ObjectBelief(np.tile(belief.mean, (2, 1)))
            dynamics = self._quiet
        qd = np.zeros_like(q) if velocity is None else np.asarray(velocity, dtype=float)
        history = _History(belief, start_time)
        motion: Trajectory | None = None
        progress, previous, now = target.advanced(0.0, belief.mean[:2]), None, start_time
        while not target.reached(progress, belief) and history.horizons < horizons:
            try:
                step = self.horizon(q, qd, belief, target.way(progress), start_time=now, previous=previous)
            except InfeasibleError:  # no arm reaches a place to touch the object any more
                break
            end = now + max(self.executed_time(step), 1e-3)
            piece = step.trajectory.clipped(now, min(end, step.trajectory.end_time))
            rollout = dynamics.simulate(belief, self._path(step.trajectory, now, end), self.rng)
            belief, now = rollout.belief, piece.end_time
            motion = piece if motion is None else motion.followed_by(piece)
            q, qd, _ = piece.state(now)
            previous = step.trajectory if step.valid else None
            progress = target.advanced(progress, belief.mean[:2])
            history.add(step, belief, rollout.wedge, now)
            if report is not None:
                report(target.remaining(progress, belief.mean[:2]))
        if motion is not None and np.abs(qd).max() > STILL:
            brake = braking_trajectory(q, qd, self.space.limits, start_time=now)
            belief = dynamics.simulate(belief, self._path(brake, now, brake.end_time), self.rng).belief
            motion = motion.followed_by(brake)
        return history.plan(motion, target.reached(progress, belief), belief, time.perf_counter() - began)

    def _planning_belief(self, belief: ObjectBelief, start: NDArray) -> ObjectBelief:
        """A few particles, jittered, none of them inside a tool; the baseline believes in the mean alone.

        A particle that jitter had left between two tools would be squeezed by whatever they do next, and no
        candidate would be valid.
        """
        config = self.config
        if not config.robust:
            return ObjectBelief(np.tile(belief.mean, (2, 1)))
        if belief.count != config.particles:
            belief = belief.resampled(config.particles, self.rng)
        if config.jitter == 0.0:
            return belief
        here = self.space.plane(start[None, None])[0][0, 0]
        jittered = belief.jittered(config.jitter, self.rng)
        return self._quiet.simulate(jittered, np.stack([here, here]), self.rng).belief

    def _path(self, motion: Trajectory, begin: float, end: float) -> NDArray:
        """Plane coordinates between two times, as finely as the steps of the last horizon that was valid.

        Noise per step ties the spread of a rollout to the length of its steps: brakes have no other ones.
        """
        steps = max(1, round((end - begin) / self._step_time))
        times = np.linspace(begin, min(end, motion.end_time), steps + 1)
        return self.space.plane(motion(times)[None])[0][0]

    def _left_over(self, previous: Trajectory | None, now: float) -> NDArray | None:
        """What is left of the previous horizon as search points (1, N, n)."""
        if previous is None or previous.end_time - now < 0.05:
            return None
        times = now + (previous.end_time - now) * np.arange(1, self.config.points + 1) / self.config.points
        return previous(times)[None]


class _History:
    """What happened horizon by horizon."""

    def __init__(self, belief: ObjectBelief, start_time: float) -> None:
        self.horizons, self.violating, self.evaluations, self.wedge = 0, 0, 0, 1.0
        self._means, self._stds, self._times = [belief.mean[:2]], [np.sqrt(belief.variance)], [start_time]

    def add(self, step: Horizon, belief: ObjectBelief, wedge: float, now: float) -> None:
        """Take in a horizon and the belief after it."""
        self.horizons += 1
        self.violating += not step.valid
        self.evaluations += step.result.evaluations
        self.wedge = min(self.wedge, wedge)
        self._means.append(belief.mean[:2])
        self._stds.append(np.sqrt(belief.variance))
        self._times.append(now)

    def plan(
        self, motion: Trajectory | None, reached: bool, belief: ObjectBelief, seconds: float
    ) -> RobustPlan:
        """The finished plan."""
        return RobustPlan(
            motion, reached, self.horizons, self.violating, belief, np.array(self._means),
            np.array(self._stds), np.array(self._times), self.wedge, seconds, self.evaluations,
        )  # fmt: skip
