"""Plays planned motions of the tools on the simulated arms, without looking at the object."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from sim_bridge.simulation import Simulation
from sim_bridge.trajectory_follower import TrajectoryCommand
from vpsto_ros.planning.plane_path import follow_plane
from vpsto_ros.trajectory import Trajectory

PERIOD = 0.05
"""Time between two looks at the ground truth, for judging only [s]."""
_LEAD = 0.02


@dataclasses.dataclass(frozen=True)
class Playback:
    """What happened.

    Attributes:
        poses: true poses of the object, shape (K, 3).
        tools: true plane coordinates of the tools, shape (K, m).
        stretch: by how much the joints' limits slowed the motion down.
    """

    poses: NDArray
    tools: NDArray
    stretch: float


def play(simulation: Simulation, motion: Trajectory, *, rest: float = 0.3) -> Playback:
    """Let the arms follow a motion in the plane (m degrees of freedom) from now on, then wait [s]."""
    followed = follow_plane(motion, simulation.plane)
    joints = followed.trajectory.shifted(simulation.time + _LEAD - followed.trajectory.start_time)
    command = TrajectoryCommand.of(joints, simulation.robot.joint_names)
    simulation.follower.accept(command, simulation.time)
    poses, tools = [simulation.object_pose()], [simulation.plane.tool(simulation.joint_position)]
    end = joints.end_time + rest
    while simulation.time < end:
        simulation.advance(PERIOD)
        poses.append(simulation.object_pose())
        tools.append(simulation.plane.tool(simulation.joint_position))
    return Playback(np.array(poses), np.array(tools), followed.stretch)
