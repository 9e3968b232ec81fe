"""What every simulated world of an arm and an object shares, free of ROS and of wall clocks.

A world is stepped in lock-step or by a driver. What only some worlds have (hands that push the object, tools
that feel, pucks that are put back) is in those alone: :class:`sim_bridge.simulation.Simulation` and
:class:`sim_bridge.hockey.world.AirHockeyWorld`.
"""

import abc
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.camera import Camera, CameraFrame
from sim_bridge.impedance import JointController
from sim_bridge.limit_monitor import LimitMonitor
from sim_bridge.trajectory_follower import TrajectoryFollower
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.kinematics import Robot

TIMESTEP = 0.001
"""One step of the physics and one cycle of the controller [s]."""


class ArmWorld(abc.ABC):
    """An arm that follows trajectories, and an object that a camera sees.

    Attributes:
        scene: what was built.
        model: the MuJoCo model, for renderers and inspection; the joints of the arm come first.
        data: the MuJoCo data.
        robot: the model that controllers and planners use.
        follower: takes trajectories: ``world.follower.accept(command, world.time)``.
        controller: the arm's controller.
        camera: the camera.
        limits: counts what breaks the arm's limits.
        surface: height of the table, on which the object lies, above the base [m].
    """

    scene: Any
    follower: TrajectoryFollower
    controller: JointController
    camera: Camera
    surface = 0.0

    def __init__(self, model: mujoco.MjModel, robot: Robot) -> None:
        """Take views into MuJoCo's state, once: they stay valid as long as the data lives."""
        self.model, self.data, self.robot = model, mujoco.MjData(model), robot
        self.limits = LimitMonitor(robot.limits)
        self._q, self._qd = self.data.qpos[: robot.dof], self.data.qvel[: robot.dof]
        self._ctrl = self.data.ctrl[: robot.dof]
        self._steps = 0

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._steps * TIMESTEP

    @property
    def steps(self) -> int:
        """Steps of the physics so far."""
        return self._steps

    def step(self) -> None:
        """Advance by one millisecond."""
        now = self._steps * TIMESTEP
        # Forward quantities belong to the state before mj_step; splitting it gives the controllers the
        # present ones.
        mujoco.mj_step1(self.model, self.data)
        q_des, qd_des, qdd_des = self.follower.reference(now)
        controller = self.controller
        self._ctrl[:] = controller.torque(self._q, self._qd, q_des, qd_des, qdd_des)
        self.limits.observe(q_des, qd_des, qdd_des, self._q, self._qd, controller.demand)
        self._act(now)
        if now >= self.camera.next_capture:
            self.camera.capture(now, self.object_pose(), visible=self.object_visible)
        mujoco.mj_step2(self.model, self.data)
        self._steps += 1

    def advance(self, duration: float) -> None:
        """Advance by a duration [s], rounded to milliseconds."""
        for _ in range(round(duration / TIMESTEP)):
            self.step()

    @property
    def joint_position(self) -> NDArray[np.float64]:
        """Measured joint positions [rad], shape (n,)."""
        return self._q.copy()

    @property
    def joint_velocity(self) -> NDArray[np.float64]:
        """Measured joint velocities [rad/s], shape (n,)."""
        return self._qd.copy()

    @property
    def joint_torque(self) -> NDArray[np.float64]:
        """Torques of the last control cycle [Nm], shape (n,)."""
        return self._ctrl.copy()

    def camera_frames(self) -> list[CameraFrame]:
        """What the camera has delivered since the last call."""
        return self.camera.poll(self.time)

    @property
    def object_visible(self) -> bool:
        """Whether the object is where the camera looks."""
        return True

    @abc.abstractmethod
    def _act(self, now: float) -> None:
        """What else acts or is watched in the step that begins at a time [s]."""

    @abc.abstractmethod
    def object_pose(self) -> NDArray[np.float64]:
        """True pose of the object (x, y, yaw) [m, rad], shape (3,), base frame."""

    @abc.abstractmethod
    def object_twist(self) -> NDArray[np.float64]:
        """True velocity of the object's frame (vx, vy, yaw rate) [m/s, rad/s], shape (3,), base frame."""

    @abc.abstractmethod
    def arm_points(self) -> list[NDArray[np.float64]]:
        """Each arm as a polyline (P, 3) [m] from its base to the tip of its tool; made to be drawn."""

    @abc.abstractmethod
    def reset(self) -> None:
        """Put object and arm back as the scene says, the arm at rest; time goes on."""

    def _check_joints(self, q: NDArray) -> None:
        lower, upper = self.robot.position_range
        if np.any(q < lower) or np.any(q > upper):
            raise InvalidInputError(f"joints {np.round(q, 3).tolist()} are beyond their position limits")

    def _hold(self, q: NDArray) -> None:
        """Put the arm at rest at joint positions (n,) [rad] and hold it there."""
        self._q[:] = q
        self.camera.clear()
        self.controller.reset()
        self.follower.hold(q, self.time)


def vector(values: ArrayLike, name: str, size: int) -> NDArray[np.float64]:
    """Some finite numbers as an array (size,).

    Raises:
        InvalidInputError: they are not.
    """
    array = np.array(values, dtype=float)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise InvalidInputError(f"{name} must be {size} finite numbers, got {values!r}")
    return array
