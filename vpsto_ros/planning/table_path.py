"""From motions of the tool in the table plane to joint trajectories whose limits hold at every instant."""

import contextlib
import dataclasses

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.exceptions import InfeasibleError
from vpsto_ros.robot.inverse_kinematics import TableMap
from vpsto_ros.robot.kinematics import Robot, forward_kinematics_batch
from vpsto_ros.trajectory import OptimalBasis, Trajectory, synthesize

STRETCHES = (1.0, 1.02, 1.05, 1.1, 1.2, 1.4)
"""Durations to try, relative to that of the motion in the plane."""


@dataclasses.dataclass(frozen=True)
class TablePath:
    """Maps plane trajectories to joint trajectories through dense key positions.

    The joint trajectory is the spline of ch. 3 through the joint positions of the plane trajectory at evenly
    spaced times: with
    about 40 ms between key positions its tool stays within a small fraction of a millimetre of the plane. Its
    limits are those of the
    joints, are checked exactly for the duration that is chosen.

    Attributes:
        robot: joint limits.
        table_map: inverse kinematics of the plane.
        spacing: time between key positions [s].
        height_tolerance: largest allowed deviation of the tool from the plane [m].
    """

    robot: Robot
    table_map: TableMap
    spacing: float = 0.04
    height_tolerance: float = 0.004

    def joints(self, plane: Trajectory, position: NDArray, velocity: NDArray) -> Trajectory:
        """The joint trajectory that follows a plane trajectory from the given joint state to rest.

        Args:
            plane: motion of the tool (x, y), ending at rest.
            position: joint positions at its start [rad]; they may differ slightly from the plane's inverse
                kinematics.
            velocity: joint velocities at its start [rad/s].

        Raises:
            InfeasibleError: the motion leaves the reachable plane, or the arm cannot follow it within limits
                and height tolerance.
        """
        count = int(np.clip(np.ceil(plane.duration / self.spacing), 4, 100))
        phases = np.linspace(0.0, 1.0, count + 1)
        keys = self.table_map.joints(plane(plane.start_time + phases * plane.duration))
        # What differs at the start (a remainder of the spline through the previous key positions)
        # fades out along the way.
        keys = keys + (1.0 - phases[:, None]) ** 3 * (position - keys[0])
        trajectory = synthesize_near(
            OptimalBasis.uniform(count - 1), keys, velocity, self.robot, plane.duration, plane.start_time
        )
        self.check(trajectory)
        return trajectory

    def check(self, trajectory: Trajectory) -> None:
        """Raise InfeasibleError unless joint limits and tool height hold along a trajectory."""
        broken = trajectory.violations(self.robot.limits)
        if broken:
            raise InfeasibleError("joint limits do not hold: " + "; ".join(broken))
        times = np.linspace(trajectory.start_time, trajectory.end_time, 4 * len(trajectory.times))
        heights = forward_kinematics_batch(trajectory(times))[:, 2]
        worst = float(np.abs(heights - self.table_map.height).max())
        if worst > self.height_tolerance:
            raise InfeasibleError(
                f"the tool would leave its plane by {1e3 * worst:.1f} mm"
            )


def synthesize_near(
    basis: OptimalBasis, keys: NDArray, velocity: NDArray, robot: Robot, duration: float, start_time: float
) -> Trajectory:
    """The spline through joint key positions with the first feasible duration from `duration` [s] up.

    The key positions are spaced for `duration`, and the arm moves already: with another one the first segment
    has to catch up, so that
    durations somewhat above it are often infeasible although it is feasible itself. The rule of 3.2.1, above
    which *every* duration is
    feasible, would then pick one several times as long; it is the last resort here.
    """
    rest = np.zeros_like(velocity)
    for stretch in STRETCHES:
        with contextlib.suppress(InfeasibleError):
            return synthesize(
                basis, keys, velocity, rest, robot.limits, duration=stretch * duration, start_time=start_time
            )
    return synthesize(basis, keys, velocity, rest, robot.limits, start_time=start_time)
