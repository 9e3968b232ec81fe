"""Robust pushing in closed loop (6.6.4): one horizon per cycle, the belief from a particle filter.

The search runs in the plane of the tools; joint trajectories follow it exactly. The last horizon goes on
until the new one takes over; what is left of it is a candidate of the new search.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.exceptions import ConfigurationError, InfeasibleError
from vpsto_ros.planning.belief_space.config import RobustMpcConfig
from vpsto_ros.planning.belief_space.contacts import ContactRule
from vpsto_ros.planning.belief_space.receding_horizon import Horizon, RobustPusher
from vpsto_ros.planning.belief_space.spaces import PlaneSpace
from vpsto_ros.planning.belief_space.targets import Target
from vpsto_ros.planning.plane_path import follow_plane
from vpsto_ros.planning.running_reference import AT_REST, MpcStep, ReferencePlanner
from vpsto_ros.planning.stitching import resting
from vpsto_ros.robot.tool_plane import ToolPlane
from vpsto_ros.trajectory import OptimalBasis, Trajectory, braking_trajectory, synthesize

_BELIEF_STEP = 0.02  # time between samples of the reference when a belief is carried on [s]
_KNOTS = 0.06  # between knots of a joint trajectory [s]: within a micrometre of the plane's motion
_REACH_MARGIN = 0.003  # by which searched motions stay within reach: so that brakes do, too [m]
_NEARER = 0.002  # that an object must come nearer to its goal to count as progress [m]
_MOVED = 0.02  # what an object moves in a cycle when somebody else moves it [m]
_JUMP = 1e-3  # that the reference may make where a motion takes over: after a stop tools may tilt [rad]
_MODES = {True: "robust", False: "deterministic"}


@dataclasses.dataclass(frozen=True)
class StampedBelief:
    """A belief and the time it is of [s]."""

    stamp: float
    belief: ObjectBelief


@dataclasses.dataclass(frozen=True)
class PlannedContact:
    """Where to touch, as somebody planned it for an object that has moved since.

    Attributes:
        mean: of the plane coordinates in contact, shape (m,).
        covariance: of these, shape (m, m).
        place: mean position of the object that it was planned for, shape (2,) [m].
    """

    mean: NDArray
    covariance: NDArray
    place: NDArray


class RobustPushingMpc(ReferencePlanner):
    """Plans, 20 times a second and more, how tools push an uncertain object to a goal or along a path.

    Attributes:
        config: options; with ``planning.robust = False`` it is the deterministic controller of 6.6.4.
        pusher: plans single horizons.
        tools: the plane of the tools.
    """

    def __init__(
        self,
        config: RobustMpcConfig,
        dynamics: BeliefDynamics,
        tools: ToolPlane,
        rule: ContactRule,
        rng: np.random.Generator,
    ) -> None:
        """Set up the planner.

        Args:
            config: options.
            dynamics: of the belief.
            tools: the robot's tools in their plane.
            rule: where to touch.
            rng: source of all randomness.

        Raises:
            ConfigurationError: end effectors and tools do not fit together.
        """
        super().__init__(tools.robot, tools.dof, config.lead, config.joint_tolerance, config.object_timeout)
        if dynamics.effectors.dof != tools.dof:
            raise ConfigurationError(
                f"the end effectors have {dynamics.effectors.dof} plane coordinates, the robot's tools "
                f"{tools.dof}; the rod has 2, the hand 3, two balls 4"
            )
        space = PlaneSpace(dynamics.effectors, config.planning)
        self.config, self.tools, self.rng = config, tools, rng
        reach = functools.partial(tools.contains, margin=_REACH_MARGIN)
        self.pusher = RobustPusher(config.planning, dynamics, space, rule, rng, reach=reach)
        self.reset()

    def reset(self) -> None:
        """Forget everything about the running motion, as after a restart of the robot's driver."""
        super().reset()
        self.holding, self._progress = False, 0.0
        self._target: Target | None = None
        self._nearest, self._nearest_at, self._left = math.inf, math.inf, math.inf

    def forget_plan(self) -> None:
        """Do not warm-start from the last plan."""
        self._plane: Trajectory | None = None

    def accept(self, step: MpcStep) -> None:
        """Take note that a step's trajectory is being executed."""
        super().accept(step)
        if step.trajectory is not None:
            self._plane = step.plane

    def step(
        self,
        now: float,
        joint_position: NDArray,
        joint_velocity: NDArray,
        belief: StampedBelief | None,
        target: Target | None,
        contact: PlannedContact | None = None,
        *,
        deadline: float | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> MpcStep:
        """Plan once. Call :meth:`accept` when the trajectory has been sent to the robot.

        Args:
            now: present time [s].
            joint_position: measured joint positions, shape (n,) [rad].
            joint_velocity: measured joint velocities, shape (n,) [rad/s].
            belief: latest belief over the object, None if there is none.
            target: where to push it, None if nobody said.
            contact: where to touch, moved along with the object; None: by the planner's own rule.
            deadline: value of `clock` at which to return the best found so far.
            clock: source of that time.
        """
        if self._lost(now, joint_position):
            if self._reference_moves(now):
                return self._stop(now, "brake", "the arms do not follow their reference; stopping first")
            return self._begin(now, joint_position, joint_velocity)
        if now + self.config.lead < self.ready_at:
            return MpcStep(None, "wait", False, "about to begin")
        offset = self._observe_offset(now, joint_position)
        if self._distance(offset) > self.config.largest_offset:
            return self._let_go(now, offset)
        problem = self._reason_to_stop(now, belief, target)
        if problem or belief is None or target is None:
            return self._stop(now, "brake", problem)
        ahead = self._carried(belief, now + self.config.lead)
        if self._reached(now, target, ahead):
            return self._stop(now, "hold", "the object is at its goal", valid=True)
        position, velocity = self._tools_at(now + self.config.lead)
        horizon = self.pusher.horizon(
            position, velocity, ahead, target.way(self._progress), start_time=now + self.config.lead,
            previous=self._plane, contact=self._moved(contact, ahead), tool_offset=self.tool_offset,
            deadline=deadline, clock=clock,
        )  # fmt: skip
        if not horizon.valid:
            return self._stop(now, "brake", "no valid plan found")
        try:
            return dataclasses.replace(self._joint_step(now, horizon), warning=self._impatience(now))
        except InfeasibleError as error:
            return self._stop(now, "brake", f"plan refused: {error}")

    def warm_up(self) -> None:
        """Compile every kernel by planning once for an imaginary object."""
        pose, start = self._reachable_push()
        belief = ObjectBelief.gaussian(pose, 0.003, self.config.planning.particles, np.random.default_rng(0))
        horizon = self.pusher.horizon(start, np.zeros(self.tools.dof), belief, np.array([[*pose[:2], 0.0]]))
        follow_plane(horizon.trajectory, self.tools)
        self._carried_along(belief, np.stack([start, start]))

    def _reachable_push(self) -> tuple[NDArray, NDArray]:
        """A pose (3,) in the workspace and plane coordinates (m,) behind it that are within reach.

        Raises:
            ConfigurationError: there is none.
        """
        config, rule = self.config, self.pusher.rule
        x, y = np.meshgrid(np.linspace(*config.workspace_x, 9), np.linspace(*config.workspace_y, 9))
        poses = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
        middle = np.array([np.mean(config.workspace_x), np.mean(config.workspace_y), 0.0])
        for pose in poses[np.argsort(np.linalg.norm(poses - middle, axis=1), kind="stable")]:
            start = rule.configuration(pose, np.array([1.0, 0.0]), np.zeros(self.tools.dof))
            for column in rule.effectors.columns:
                start[column] -= 2.0 * config.planning.contact_advance
            if self.tools.contains(start[None])[0]:
                return pose, start
        raise ConfigurationError(
            f"workspace_x = {config.workspace_x}, workspace_y = {config.workspace_y} m: nowhere in there can "
            "the tools get behind an object; move it nearer to where the arms reach"
        )

    def _begin(self, now: float, position: NDArray, velocity: NDArray) -> MpcStep:
        """Take over arms that stand still with their tools in the plane."""
        self.reset()
        if np.abs(velocity).max() > AT_REST:
            return MpcStep(None, "wait", False, "the arms move but not by this planner's reference")
        point = self.tools.tool(position)
        deviation = np.abs(self.tools.tool_heights(position) - self.tools.height).max()
        if deviation > 0.01 or not self.tools.contains(point[None])[0]:
            return MpcStep(
                None, "wait", False,
                f"the tools are {1e3 * deviation:.0f} mm off their height or out of reach; move them to "
                f"{self.tools.height:.3f} m above the table first",
            )  # fmt: skip
        start = now + 4.0 * self.config.lead
        upright = self.tools.joints(point[None])[0]
        if np.abs(upright - position).max() > self.config.joint_tolerance:
            return MpcStep(None, "wait", False, "the tools are in their plane but not upright")
        return MpcStep(
            resting(position, start, start + 0.5), "wait", False, "took over the arms where they stand",
            ready_at=start,
        )  # fmt: skip

    def _reason_to_stop(self, now: float, belief: StampedBelief | None, target: Target | None) -> str:
        config = self.config
        if target is None:
            return "no goal yet"
        if belief is None:
            return "no belief over the object yet"
        if now - belief.stamp > config.object_timeout:
            return (
                f"the belief over the object is {now - belief.stamp:.2f} s old (allowed "
                f"{config.object_timeout:.2f} s)"
            )
        spread = float(np.sqrt(belief.belief.variance))
        if spread > config.largest_std:
            return (
                f"the object is lost: the belief's standard deviation is {1e3 * spread:.0f} mm "
                f"(allowed {1e3 * config.largest_std:.0f} mm)"
            )
        if not config.contains(belief.belief.mean):
            x, y, _ = belief.belief.mean
            return f"the object at ({x:.3f}, {y:.3f}) m is outside the workspace"
        return ""

    def _carried(self, belief: StampedBelief, when: float) -> ObjectBelief:
        """The belief at a later time, pushed along by the running reference."""
        begin = max(min(belief.stamp, when), self._running.start_time)
        count = max(2, int(np.ceil((when - begin) / _BELIEF_STEP)) + 1)
        times = np.minimum(np.linspace(begin, when, count), self._running.end_time)
        return self._carried_along(belief.belief, self.tools.tool(self._running(times)) + self.tool_offset)

    def _distance(self, offset: NDArray) -> float:
        """How far a tool is moved at most by plane coordinates (m,), turning apart [m]."""
        return float(np.hypot(*self.pusher.rule.effectors.poses(offset)[:, :2].T).max())

    def _moved(
        self, contact: PlannedContact | None, belief: ObjectBelief
    ) -> tuple[NDArray, NDArray] | None:
        """A contact where the object is by then, (6.38)."""
        if contact is None:
            return None
        moved = self.pusher.rule.jacobian() @ (belief.mean[:2] - contact.place)
        return contact.mean + moved, contact.covariance

    def _impatience(self, now: float) -> str:
        """What to say when the object comes no nearer to its goal."""
        since = now - self._nearest_at
        if since <= self.config.patience:
            return ""
        return f"the object has come no nearer to its goal for {since:.0f} s"

    def _tool(self, q: ArrayLike) -> NDArray[np.float64]:
        return self.tools.tool(q)

    def _carried_along(self, belief: ObjectBelief, path: NDArray) -> ObjectBelief:
        return self.pusher.dynamics.simulate(belief, path, self.rng).belief

    def _reached(self, now: float, target: Target, belief: ObjectBelief) -> bool:
        """Hysteresis: rest within the hold distance until the object is beyond the resume distance.

        A belief that is too wide is not at its goal, wherever its mean is.
        """
        if target is not self._target:
            self._target, self._progress, self.holding = target, 0.0, False
            self._nearest, self._nearest_at, self._left = math.inf, now, math.inf
        self._progress = target.advanced(self._progress, belief.mean[:2])
        left = target.remaining(self._progress, belief.mean[:2])
        if self.holding or left < self._nearest - _NEARER or left > self._left + _MOVED:
            self._nearest, self._nearest_at = left, now
        self._left = left
        within = self.config.resume_distance if self.holding else self.config.hold_distance
        self.holding = left <= within and belief.variance <= self.config.hold_std**2
        return self.holding

    def _tools_at(self, when: float) -> tuple[NDArray, NDArray]:
        """Plane coordinates and their rates of the reference, within the planner's limits."""
        position, velocity, _ = self._running.state(when)
        return self.tools.tool(position), self._rates(position, velocity)

    def _rates(self, position: NDArray, velocity: NDArray) -> NDArray:
        """Of the plane coordinates (m,) in a joint state, cut to the planner's limits."""
        most = self.pusher.space.limits.velocity
        return np.clip(self.tools.tool_velocity(position, velocity), -most, most)

    def _joint_step(self, now: float, horizon: Horizon) -> MpcStep:
        plane, start = horizon.trajectory, horizon.trajectory.start_time
        followed = follow_plane(plane, self.tools, spacing=_KNOTS, cubic=True)
        moving = np.abs(plane(start, 1)).max() > 1e-6
        jump = np.abs(followed.trajectory(start) - self._running(start)).max()
        if jump > _JUMP:
            raise InfeasibleError(f"the arms are {jump:.4f} rad off the posture that holds the tools upright")
        if followed.stretch > 1.0 and moving:
            raise InfeasibleError(f"the joints' limits ask for a motion {followed.stretch:.2f} times slower")
        result = horizon.result
        assert result.points is not None
        outcome = horizon.problem.outcome(result.points[None])
        path = outcome.prediction.mean[0]
        return MpcStep(
            self._joined(now, followed.trajectory), _MODES[self.config.planning.robust], True, "pushing",
            result.cost, outcome.paths[0], np.column_stack([path[:, :2], np.zeros(len(path))]),
            result.iterations,
            plane if followed.stretch == 1.0 else None, spread=np.sqrt(outcome.prediction.variance[0]),
        )  # fmt: skip

    def _let_go(self, now: float, offset: NDArray) -> MpcStep:
        """Bring the reference to where the tools are, so that they do not press any more.

        An object that two tools squeeze, or that is stuck, does not move as predicted; a reference that goes
        on would only press harder.
        """
        takeover = now + self.config.lead
        position, velocity = self._tools_at(takeover)
        back = synthesize(
            OptimalBasis.uniform(0), np.stack([position, self.tools.tool(self._running(now)) + offset]),
            velocity, np.zeros_like(position), self.pusher.space.limits, start_time=takeover,
        )  # fmt: skip
        message = f"the tools are held {1e3 * self._distance(offset):.0f} mm off their reference; letting go"
        try:
            followed = follow_plane(back, self.tools, spacing=_KNOTS, cubic=True)
        except InfeasibleError:
            return self._stop(now, "brake", message)
        if followed.stretch > 1.0 and np.abs(velocity).max() > 1e-6:
            return self._stop(now, "brake", message)
        return MpcStep(self._joined(now, followed.trajectory), "brake", False, message)

    def _brake(self, takeover: float, position: NDArray, velocity: NDArray) -> Trajectory:
        state = self.tools.tool(position), self._rates(position, velocity)
        brake = braking_trajectory(*state, self.pusher.space.limits, start_time=takeover)
        followed = follow_plane(brake, self.tools, spacing=_KNOTS, cubic=True)
        if followed.stretch > 1.0:
            raise InfeasibleError(f"the joints would brake {followed.stretch:.2f} times slower")
        return followed.trajectory
