"""The closed loop of the pushing demos in lock-step and without ROS.

Simulated cell, camera, filter, contact planner and MPC take turns.

The planner sees what it would see on a robot: joint positions, late and noisy camera frames, the object's
outline. A plan computed at time t
reaches the arm `transport` seconds later, as a message would.
"""

import dataclasses
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sim_bridge.simulation import Simulation
from sim_bridge.trajectory_follower import TrajectoryCommand, TrajectoryRejected
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.contact.pushing import PushingModel
from vpsto_ros.estimation.planar_kalman import PlanarKalman
from vpsto_ros.planning.contact import ContactPlannerConfig, PushContactPlanner
from vpsto_ros.planning.goal import PlanarGoal
from vpsto_ros.planning.pushing import PushingMpc
from vpsto_ros.planning.pushing_config import PushingMpcConfig
from vpsto_ros.planning.running_reference import MpcStep
from vpsto_ros.robot.kinematics import forward_kinematics_batch, fr3_pusher
from vpsto_ros.trajectory import Trajectory


@dataclasses.dataclass
class Recording:
    """What happened, sampled at every planning step; ground truth is for judging only.

    `compute` is processor time: what other processes on the machine do does not count.
    """

    time: list[float] = dataclasses.field(default_factory=list)
    object_pose: list[NDArray] = dataclasses.field(default_factory=list)
    tool: list[NDArray] = dataclasses.field(default_factory=list)
    goal: list[NDArray] = dataclasses.field(default_factory=list)
    mode: list[str] = dataclasses.field(default_factory=list)
    compute: list[float] = dataclasses.field(default_factory=list)
    rejected: list[str] = dataclasses.field(default_factory=list)
    planned_height_error: float = 0.0


class PushingLoop:
    """Runs the closed loop step by step."""

    def __init__(
        self,
        simulation: Simulation,
        planner: PushingMpc,
        contact_planner: PushContactPlanner | None,
        goal: Callable[[float], PlanarGoal],
        *,
        period: float = 0.05,
        transport: float = 0.03,
    ) -> None:
        """Connect the parts.

        Args:
            simulation: the cell.
            planner: the MPC planner (or a baseline with the same interface).
            contact_planner: says where to touch; None to leave that to the planner.
            goal: the goal at a given time.
            period: planning period [s].
            transport: time from the start of planning until the arm gets the plan [s].
        """
        self.simulation, self.planner, self.contact_planner, self.goal = (
            simulation,
            planner,
            contact_planner,
            goal,
        )
        self.period, self.transport = period, transport
        self.filter = PlanarKalman()
        self.recording = Recording()
        self._next_plan = simulation.time

    def advance(self, duration: float) -> None:
        """Let `duration` seconds of simulated time pass, planning on time."""
        end = self.simulation.time + duration
        while self.simulation.time < end - 1e-9:
            step = self._plan() if self.simulation.time >= self._next_plan - 1e-9 else None
            self._run_until(min(self._next_plan, end), step)

    def _run_until(self, end: float, step: MpcStep | None) -> None:
        if step is not None and step.trajectory is not None:
            self.simulation.advance(self.transport)
            self._deliver(step, step.trajectory)
        self.simulation.advance(max(end - self.simulation.time, 0.0))
        for frame in self.simulation.camera_frames():
            self.filter.update(frame.stamp, frame.pose, frame.covariance)

    def _plan(self) -> MpcStep:
        sim, now = self.simulation, self.simulation.time
        state, goal = self.filter.state, self.goal(now)
        contact = None
        if state is not None and self.contact_planner is not None:
            contact = self.contact_planner.plan(now, sim.tool_position()[:2], state, goal)
        begin = time.thread_time()
        step = self.planner.step(now, sim.joint_position, sim.joint_velocity, state, goal, contact)
        self._record(now, goal, step, time.thread_time() - begin)
        self._next_plan = now + self.period
        return step

    def _deliver(self, step: MpcStep, trajectory: Trajectory) -> None:
        self._check_height(trajectory)
        try:
            self.simulation.follower.accept(
                TrajectoryCommand.of(trajectory, self.planner.robot.joint_names), self.simulation.time
            )
            self.planner.accept(step)
        except TrajectoryRejected as reason:
            self.recording.rejected.append(str(reason))

    def _check_height(self, trajectory: Trajectory) -> None:
        """Largest deviation of the tool from its plane along what is published."""
        times = np.linspace(trajectory.start_time, trajectory.end_time, 200)
        heights = forward_kinematics_batch(trajectory(times))[:, 2]
        error = float(np.abs(heights - self.planner.table_map.height).max())
        self.recording.planned_height_error = max(self.recording.planned_height_error, error)

    def _record(self, now: float, goal: PlanarGoal, step: MpcStep, compute: float) -> None:
        recording = self.recording
        recording.time.append(now)
        recording.object_pose.append(np.array(self.simulation.object_pose()))
        recording.tool.append(np.array(self.simulation.tool_position()))
        recording.goal.append(np.append(goal.position, np.nan if goal.yaw is None else goal.yaw))
        recording.mode.append(step.mode)
        recording.compute.append(compute)


def push_box_loop(goal: PlanarGoal | None = None, seed: int = 0) -> PushingLoop:
    """The demo's closed loop in lock-step: default cell, default planner, compiled and ready.

    Args:
        goal: where the box shall go, by default 11 cm aside.
        seed: of camera and search.
    """
    model = PushingModel(PlanarShape.box(0.12, 0.12), PlanarShape.disc(0.015))
    planner = PushingMpc(PushingMpcConfig(), model, fr3_pusher(), np.random.default_rng(seed))
    planner.warm_up()
    target = goal or PlanarGoal(np.array([0.55, 0.10]), None)
    contact_planner = PushContactPlanner(ContactPlannerConfig(), model)
    return PushingLoop(Simulation(seed=seed), planner, contact_planner, lambda now: target)
