"""Closed-loop planar pushing with an arm: online VP-STO in the table plane, joint trajectories out (4.4).

The search runs in the plane in which the tool moves: with the tool vertical and at a fixed height, a plane
point determines the joints, so
seven joints would only add directions in which every candidate leaves the plane. The joint trajectory is
synthesised from the plane
solution with the same basis functions and keeps the joint limits at every instant.
"""

import dataclasses
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.contact.pushing import PushingModel, rollout
from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.exceptions import ConfigurationError, InfeasibleError
from vpsto_ros.planning.contact import ContactPlan
from vpsto_ros.planning.goal import PlanarGoal
from vpsto_ros.planning.mpc import OnlineResult, OnlineVpsto
from vpsto_ros.planning.pushes import PushRanking
from vpsto_ros.planning.pushing_config import PushingMpcConfig
from vpsto_ros.planning.pushing_problem import PushingProblem
from vpsto_ros.planning.running_reference import AT_REST, MpcStep, ReferencePlanner
from vpsto_ros.planning.stitching import resting
from vpsto_ros.planning.table_entry import enter_plane
from vpsto_ros.planning.table_path import TablePath
from vpsto_ros.robot.inverse_kinematics import TableMap
from vpsto_ros.robot.kinematics import Robot
from vpsto_ros.trajectory import Limits, Trajectory, braking_trajectory


class PushingMpc(ReferencePlanner):
    """Plans, 20 to 50 times a second, how the arm pushes an object to a goal."""

    def __init__(
        self, config: PushingMpcConfig, model: PushingModel, robot: Robot, rng: np.random.Generator
    ) -> None:
        """Set up the planner.

        Args:
            config: options.
            model: contact model: shape, tool, pressure radius, friction.
            robot: the arm.
            rng: source of all randomness.

        Raises:
            ConfigurationError: the workspace is beyond what the arm reaches.

        Speed and acceleration are the tool's, in every place and direction. Near the far rim the joints can
        ask for less:
        the joint trajectory is then slower than the plane motion (see :class:`TablePath`), and the step's
        message says so.
        """
        super().__init__(robot, 2, config.lead, config.joint_tolerance, config.object_timeout)
        self.config, self.model = config, model
        table_map = TableMap(robot, config.tool_height)
        _check_workspace(config, table_map)
        self.table_path = TablePath(robot, table_map)
        self.limits = Limits(np.full(2, config.speed), np.full(2, config.acceleration))
        self.online = OnlineVpsto(config.online, rng)
        costs = config.costs
        self.ranking = PushRanking(0.8 * config.speed, costs.error, costs.rotation, config.contacts)
        self.reset()

    def reset(self) -> None:
        """Forget everything about the running motion, as after a restart of the robot's driver."""
        super().reset()
        self.holding = False

    def forget_plan(self) -> None:
        """Do not warm-start from the last plan."""
        self.online.accept(None)

    @property
    def table_map(self) -> TableMap:
        """Inverse kinematics of the plane."""
        return self.table_path.table_map

    def step(
        self,
        now: float,
        joint_position: NDArray,
        joint_velocity: NDArray,
        object_state: ObjectState | None,
        goal: PlanarGoal | None,
        contact: ContactPlan | None = None,
        *,
        deadline: float | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> MpcStep:
        """Plan once. Call :meth:`accept` when the trajectory has been sent to the robot.

        Args:
            now: present time [s].
            joint_position: measured joint positions, shape (7,) [rad].
            joint_velocity: measured joint velocities, shape (7,) [rad/s].
            object_state: latest estimate of the object, None if there is none.
            goal: where the object shall go, None if nobody said.
            contact: where to touch, None if nobody says.
            deadline: value of `clock` at which to return the best found so far.
            clock: source of that time.
        """
        if self._lost(now, joint_position):
            if self._reference_moves(now):
                return self._stop(
                    now, "brake", "the arm does not follow its reference; stopping before planning anew"
                )
            return self._begin(now, joint_position, joint_velocity, object_state)
        if now + self.config.lead < self.ready_at:
            return MpcStep(None, "wait", False, "on the way to where planning begins")
        self._observe_offset(now, joint_position)
        problem = self._reason_to_stop(now, object_state, goal)
        if problem or object_state is None or goal is None:
            return self._stop(now, "brake", problem)
        pose = self._object_at(now + self.config.lead, object_state)
        if self._goal_reached(pose, goal):
            return self._stop(now, "hold", "the object is at its goal", valid=True)
        return self._plan(now, pose, goal, contact, deadline, clock)

    def accept(self, step: MpcStep) -> None:
        """Take note that a step's trajectory is being executed."""
        super().accept(step)
        if step.trajectory is not None:
            self.online.accept(step.plane)

    def warm_up(self) -> None:
        """Compile every kernel by planning once for an imaginary object."""
        tool = np.array([0.42, -0.1])
        state = ObjectState(0.0, np.array([0.5, 0.0, 0.3]), np.zeros(3), 1e-4 * np.eye(6))
        joints = self.table_map.joints(tool[None])[0]
        still = np.zeros_like(joints)
        for yaw in (None, 0.5):
            for now in (0.0, 0.3, 0.35):
                self.accept(
                    self.step(
                        now,
                        joints,
                        still,
                        dataclasses.replace(state, stamp=now),
                        PlanarGoal(np.array([0.55, 0.1]), yaw),
                    )
                )
            self.stop(0.5)
            self.reset()

    def _begin(self, now: float, position: NDArray, velocity: NDArray, state: ObjectState | None) -> MpcStep:
        """Take over an arm that stands still; one that is not in the plane is moved there first."""
        self.reset()
        if np.abs(velocity).max() > AT_REST:
            return MpcStep(
                None,
                "wait",
                False,
                "the arm moves but not by this planner's reference; waiting until it stands still",
            )
        deviation = np.abs(self.table_map.joints(self.table_map.tool(position)[None])[0] - position).max()
        height = abs(float(self.robot.forward(position)[0][2]) - self.table_map.height)
        if not deviation < self.config.joint_tolerance or height > 2.0 * self.table_path.height_tolerance:
            return self._enter_plane(now, position, state)
        start = now + 4.0 * self.config.lead
        rest = resting(position, start, start + 0.5)
        return MpcStep(rest, "wait", False, "took over the arm where it stands", ready_at=start)

    def _enter_plane(self, now: float, position: NDArray, state: ObjectState | None) -> MpcStep:
        if state is None or now - state.stamp > self.config.object_timeout:
            return MpcStep(
                None,
                "wait",
                False,
                "the tool is not in its plane; lowering it needs a fresh state of the object",
            )
        config, start = self.config, now + 4.0 * self.config.lead
        try:
            motion = enter_plane(self.table_path, self.model, config.workspace, position, state.pose, start)
        except InfeasibleError as error:
            return MpcStep(None, "wait", False, str(error))
        return MpcStep(motion, "enter", False, "moving the tool into its plane", ready_at=motion.end_time)

    def _tool(self, q: ArrayLike) -> NDArray[np.float64]:
        return self.table_map.tool(q)

    def _reason_to_stop(self, now: float, state: ObjectState | None, goal: PlanarGoal | None) -> str:
        if goal is None:
            return "no goal yet"
        if state is None:
            return "no object state yet"
        if now - state.stamp > self.config.object_timeout:
            age, allowed = now - state.stamp, self.config.object_timeout
            return f"the object's state is {age:.2f} s old (allowed {allowed:.2f} s)"
        if not self.config.workspace.contains_object(np.append(goal.position, 0.0)):
            return f"the goal ({goal.position[0]:.3f}, {goal.position[1]:.3f}) m is outside the workspace"
        return ""

    def _object_at(self, when: float, state: ObjectState) -> NDArray:
        """Object pose at `when`: rolled out along the reference since the estimate's time."""
        times = np.linspace(min(state.stamp, when), when, 8)
        path = self.table_map.tool(self._running(times)) + self.tool_offset
        return rollout(self.model, state.pose, path[None]).object_pose[0, -1]

    def _goal_reached(self, pose: NDArray, goal: PlanarGoal) -> bool:
        """Hysteresis: rest within the hold distance until the object is beyond the resume distance."""
        error = float(goal.error(pose, self.model.pressure_radius))
        self.holding = error <= (self.config.resume_distance if self.holding else self.config.hold_distance)
        return self.holding

    def _plan(
        self,
        now: float,
        pose: NDArray,
        goal: PlanarGoal,
        contact: ContactPlan | None,
        deadline: float | None,
        clock: Callable[[], float],
    ) -> MpcStep:
        problem = self._problem(now, pose, goal, contact)
        result = self.online.step(problem, deadline=deadline, clock=clock)
        if result.trajectory is None:
            return self._stop(now, "brake", "no valid plan found")
        try:
            return self._joint_step(now, problem, result, result.trajectory)
        except InfeasibleError as error:
            return self._stop(now, "brake", f"plan refused: {error}")

    def _problem(
        self, now: float, pose: NDArray, goal: PlanarGoal, contact: ContactPlan | None
    ) -> PushingProblem:
        takeover = now + self.config.lead
        position, velocity, _ = self._running.state(takeover)
        tool = self.table_map.tool(position)
        tool_velocity = self.table_map.tool_velocity(position, velocity)
        pushes = self.ranking.rank(self.model, pose, goal, tool + self.tool_offset)
        return PushingProblem(
            self.model, self.config.costs, self.config.workspace, self.limits,
            start=tool, start_time=takeover,
            velocity=np.clip(tool_velocity, -self.limits.velocity, self.limits.velocity),
            tool_offset=self.tool_offset, pose=pose, goal=goal, contact=contact,
            pushes=pushes.diverse(self.config.seeds, self.config.seed_separation),
        )  # fmt: skip

    def _joint_step(
        self, now: float, problem: PushingProblem, result: OnlineResult, plane: Trajectory
    ) -> MpcStep:
        position, velocity, _ = self._running.state(problem.start_time)
        joints = self.table_path.joints(plane, position, velocity)
        keys = plane(np.linspace(plane.start_time, plane.end_time, 40))
        poses = rollout(self.model, problem.pose, (keys + self.tool_offset)[None]).object_pose[0]
        iterations = result.search.iterations if result.search else 0
        stretch = joints.duration / plane.duration
        message = (
            "pushing"
            if stretch < 1.0 + 1e-9
            else f"pushing, {stretch:.2f} times slower for the joints' limits"
        )
        return MpcStep(
            self._joined(now, joints), result.mode, True, message, result.cost, keys, poses, iterations,
            plane if stretch < 1.05 else None,
        )  # fmt: skip

    def _brake(self, takeover: float, position: NDArray, velocity: NDArray) -> Trajectory:
        """Straight in the plane (N = 0 with a free end)."""
        tool, tool_velocity = self.table_map.tool(position), self.table_map.tool_velocity(position, velocity)
        plane = braking_trajectory(tool, tool_velocity, self.limits, start_time=takeover)
        return self.table_path.joints(plane, position, velocity)


def _check_workspace(config: PushingMpcConfig, table_map: TableMap) -> None:
    """Refuse a workspace that the arm does not reach with the tool upright."""
    low, high = table_map.radius_range
    space = config.workspace
    if space.radius_min < low or space.radius_max > high:
        raise ConfigurationError(
            f"workspace.radius_min = {space.radius_min}, workspace.radius_max = {space.radius_max} m; "
            f"the arm reaches {low:.3f} to {high:.3f} m"
        )
