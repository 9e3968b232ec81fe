"""The closed loop of two arms in lock-step: simulated cell, camera, particle filter and planner take turns.

Planner and filter know what they would know on robots: joint positions, late and noisy camera frames, the
radius of the object, ranges of its friction. A plan computed at time t reaches the arms `TRANSPORT` later.
"""

import dataclasses
import time

import numpy as np
from numpy.typing import NDArray

from sim_bridge.camera import CameraConfig
from sim_bridge.experiments.belief.models import CENTER_SHARE, FRICTION, FRICTION_RANGE, THESIS
from sim_bridge.experiments.belief.planners import contact_rule, tool_plane
from sim_bridge.experiments.robust_pushing.setups import random_plant
from sim_bridge.scene import BallsStart, Scene
from sim_bridge.simulation import Simulation
from sim_bridge.trajectory_follower import TrajectoryCommand, TrajectoryRejected
from vpsto_ros.estimation.particle_filter import ObjectParticleFilter
from vpsto_ros.estimation.particle_filter_config import ParticleFilterConfig
from vpsto_ros.planning.belief_space.config import RobustMpcConfig
from vpsto_ros.planning.belief_space.mpc import RobustPushingMpc, StampedBelief
from vpsto_ros.planning.belief_space.targets import GoalTarget
from vpsto_ros.planning.running_reference import MpcStep
from vpsto_ros.robot.kinds import TOOL_KINDS

PERIOD, TRANSPORT = 0.05, 0.03
"""Time between two plans, and until the arms get one [s]."""
JOINT_PERIOD = 0.01
BALLS = (0.34, 0.12, 0.34, -0.12)
CAMERA = CameraConfig(position_std=0.004)


@dataclasses.dataclass
class Recording:
    """What happened; ground truth is for judging only, `compute` is processor time [s]."""

    times: list[float] = dataclasses.field(default_factory=list)
    poses: list[NDArray] = dataclasses.field(default_factory=list)
    tools: list[NDArray] = dataclasses.field(default_factory=list)
    modes: list[str] = dataclasses.field(default_factory=list)
    compute: list[float] = dataclasses.field(default_factory=list)
    rejected: int = 0


class BimanualLoop:
    """Runs the closed loop step by step."""

    def __init__(self, seed: int, radius: float, start: NDArray, goal: NDArray, config: RobustMpcConfig):
        """Set up cell, filter and planner.

        Args:
            seed: of plant, camera, filter and search.
            radius: of the object [m].
            start: where it is at first, shape (2,) [m].
            goal: where it shall go, shape (2,) [m].
            config: of the planner.
        """
        plant = random_plant(radius, np.random.default_rng([seed, 5]), off_centre=0.2)
        scene = Scene(
            plant=plant, robot="two_balls", object_pose=(*start.tolist(), 0.0), balls=BallsStart(start=BALLS)
        )
        self.simulation = Simulation(scene, seed=seed, camera=CAMERA)
        tools, effectors = tool_plane("two_balls"), TOOL_KINDS["two_balls"].effectors
        believed = FRICTION.dynamics(radius, effectors)
        options = ParticleFilterConfig(friction=FRICTION_RANGE, center_std=CENTER_SHARE * radius)
        self.filter = ObjectParticleFilter(options, believed, np.random.default_rng([seed, 6]))
        model = THESIS.dynamics(radius, effectors)
        rule = contact_rule("two_balls", radius, config.planning)
        self.planner = RobustPushingMpc(config, model, tools, rule, np.random.default_rng([seed, 7]))
        self.planner.warm_up()
        self.target, self.recording = GoalTarget(goal), Recording()
        self._next_plan = 0.0

    def advance(self, duration: float) -> None:
        """Let `duration` seconds pass, planning on time."""
        end = self.simulation.time + duration
        while self.simulation.time < end - 1e-9:
            if self.simulation.time < self._next_plan - 1e-9:
                self._observe(min(self._next_plan, end))
                continue
            now, step = self.simulation.time, self._plan()
            self._next_plan = now + PERIOD
            self._observe(now + TRANSPORT)
            self._deliver(step)

    def _observe(self, end: float) -> None:
        """Advance to a time; joint states and camera frames go to the filter."""
        sim = self.simulation
        while sim.time < end - 1e-9:
            sim.advance(min(JOINT_PERIOD, end - sim.time))
            self.filter.predict(sim.time, sim.plane.tool(sim.joint_position))
            for frame in sim.camera_frames():
                self.filter.update(frame.stamp, frame.pose, frame.covariance)

    def _plan(self) -> MpcStep:
        sim, now = self.simulation, self.simulation.time
        begin = time.thread_time()
        belief = self.filter.belief(now)
        stamped = None if belief is None else StampedBelief(now, belief)
        step = self.planner.step(now, sim.joint_position, sim.joint_velocity, stamped, self.target)
        record = self.recording
        record.compute.append(time.thread_time() - begin)
        record.times.append(now)
        record.poses.append(sim.object_pose())
        record.tools.append(sim.plane.tool(sim.joint_position))
        record.modes.append(step.mode)
        return step

    def _deliver(self, step: MpcStep) -> None:
        if step.trajectory is None:
            return
        command = TrajectoryCommand.of(step.trajectory, self.planner.robot.joint_names)
        try:
            self.simulation.follower.accept(command, self.simulation.time)
            self.planner.accept(step)
        except TrajectoryRejected:
            self.recording.rejected += 1
