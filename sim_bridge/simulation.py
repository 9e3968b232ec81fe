"""The simulated robot, table and object at 1 kHz, free of ROS and of wall clocks.

Per step: the reference of the trajectory follower, the impedance controller, MuJoCo, and a camera that
watches the object.
"""

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.arm_world import TIMESTEP, ArmWorld, vector
from sim_bridge.camera import Camera, CameraConfig
from sim_bridge.contacts import Contacts, RobotContacts
from sim_bridge.disturbances import Disturbances, Hand, Push
from sim_bridge.impedance import ImpedanceConfig, ImpedanceController
from sim_bridge.scene import Scene, build
from sim_bridge.trajectory_follower import FollowerConfig, TrajectoryFollower
from vpsto_ros.exceptions import InvalidInputError

_DISPLACEMENT = 0.05  # largest displacement of the object at once [m]


class Simulation(ArmWorld):
    """A robot that pushes an object on a table, stepped in lock-step or by a driver.

    Attributes:
        plane: the plane of the robot's tools at the scene's height.
        tool_height_deviation: largest distance of a tip from the scene's height so far [m].
    """

    def __init__(
        self,
        scene: Scene | None = None,
        *,
        seed: int = 0,
        camera: CameraConfig | None = None,
        impedance: ImpedanceConfig | None = None,
        follower: FollowerConfig | None = None,
    ):
        """Build the scene and start at time 0, at rest.

        Args:
            scene: plant, start poses and friction.
            seed: of the camera's noise and drop-outs.
            camera: camera; its default if None.
            impedance: gains; their defaults if None.
            follower: tolerances of the trajectory rules; their defaults if None.

        Raises:
            ConfigurationError: the scene does not fit the arm.
        """
        self.scene = scene or Scene()
        kind = self.scene.kind
        super().__init__(build(self.scene), kind.load())
        self.plane = self.scene.plane()
        start = self.scene.joints()
        nominal = self.plane.joints([kind.nominal])[0]
        self.follower = TrajectoryFollower(self.robot.limits, self.robot.joint_names, start, follower)
        self.controller = ImpedanceController(
            self.robot, nominal, impedance, round_tool=kind.round_tool, period=TIMESTEP
        )
        self.camera = Camera(camera or CameraConfig(), np.random.default_rng(seed))
        self.tool_height_deviation = 0.0
        self._disturbances = Disturbances(self.model, self.data, self.scene.plant)
        self._contacts = Contacts(self.model, self.data, kind)
        self._bind()
        self.reset()

    def _bind(self) -> None:
        """More views into MuJoCo's state."""
        d, n = self.data, self.robot.dof
        self._object_q, self._object_qd = d.qpos[n : n + 7], d.qvel[n : n + 6]
        self._object_com = d.xipos[self.model.body("object").id]
        names = [f"{arm.prefix}tool_tip" for arm in self.scene.kind.arms]
        self._tips = [d.site_xpos[self.model.site(name).id] for name in names]

    def _act(self, now: float) -> None:
        """Watch tips and contacts, and let hands push."""
        for tip in self._tips:
            deviation = abs(tip[2] - self.plane.height)
            if deviation > self.tool_height_deviation:
                self.tool_height_deviation = float(deviation)
        self._contacts.count()
        if self._disturbances.active:
            self._disturbances.apply(now)

    def tool_position(self, tool: int = 0) -> NDArray[np.float64]:
        """True position of a tool's tip in the base frame [m], shape (3,); tools count from 0."""
        return self.plane.tips(self._q)[tool]

    def tool_velocity(self, tool: int = 0) -> NDArray[np.float64]:
        """True velocity of a tool's tip in the base frame [m/s], shape (3,); tools count from 0."""
        return self.plane.tip_velocities(self._q, self._qd)[tool]

    def arm_points(self) -> list[NDArray[np.float64]]:
        """Each arm as a polyline (P, 3) [m]: base, joints, flange, the corner of a crank, tip of the tool.

        As of the last step's beginning; made to be drawn.
        """
        lines = []
        for arm, tip in zip(self.scene.kind.arms, self._tips, strict=True):
            links = [self.data.body(f"{arm.prefix}fr3_link{i}").xpos for i in range(8)]
            flange = self.data.site(f"{arm.prefix}flange").xpos
            axis = self.data.site(f"{arm.prefix}tool_tip").xmat.reshape(3, 3)[:, 2]
            corner = tip - axis * (axis @ (tip - flange))
            bend = [corner] if np.linalg.norm(corner - flange) > 1e-6 else []
            lines.append(np.array([*links, flange, *bend, tip]))
        return lines

    def cube_positions(self) -> NDArray[np.float64]:
        """Centres (C, 3) [m] of the loose cubes."""
        bodies = [self.data.body(f"cube{i}").xpos for i in range(len(self.scene.cubes))]
        return np.array(bodies).reshape(-1, 3)

    def object_pose(self) -> NDArray[np.float64]:
        """True pose of the object (x, y, yaw) [m, rad], shape (3,)."""
        x, y, _, w, i, j, k = self._object_q.tolist()
        return np.array([x, y, np.arctan2(2.0 * (w * k + i * j), 1.0 - 2.0 * (j * j + k * k))])

    def object_twist(self) -> NDArray[np.float64]:
        """True velocity of the object's frame, (vx, vy, yaw rate) [m/s, rad/s] in the base frame."""
        return self._object_qd[[0, 1, 5]]

    def tool_contact_force(self, tool: int | None = None) -> NDArray[np.float64]:
        """Force on the object during the last step [N], base frame, shape (3,): of one tool, or of all."""
        tools = range(len(self._tips)) if tool is None else [tool]
        return np.sum([self._contacts.tool_force(k) for k in tools], axis=0)

    @property
    def robot_contacts(self) -> RobotContacts:
        """During how many steps arms touched each other, the table, or the object not by their tools."""
        return self._contacts.counts()

    def push_object(self, force: ArrayLike, torque: ArrayLike, duration: float) -> None:
        """Push the object at its centre of mass with a constant wrench.

        Args:
            force: (3,) [N], base frame.
            torque: (3,) [Nm], base frame.
            duration: how long, from now [s].

        Raises:
            InvalidInputError: force or torque is not three finite numbers, or the duration is not positive.
        """
        wrench = np.concatenate([vector(force, "force", 3), vector(torque, "torque", 3)])
        self._disturbances.active.append(Push(self.time + _positive(duration, "duration"), wrench))

    def knock(self, displacement: ArrayLike, duration: float = 0.25) -> None:
        """Let a hand move the object by about displacement (2,) [m] within a duration [s].

        The hand holds the object at its centre of mass, along a smooth path, without turning it on purpose,
        and gives way above a force limit, so that it does not push through the rod.

        Raises:
            InvalidInputError: the displacement is not two finite numbers, or the duration is not positive.
        """
        origin = self._object_com[:2].copy()
        move = vector(displacement, "displacement", 2)
        self._disturbances.active.append(Hand(self.time, _positive(duration, "duration"), origin, move))

    def displace_object(self, dx: float, dy: float) -> None:
        """Put the object somewhere else on the table at once, at rest, as somebody does between two runs.

        Args:
            dx: by how much along x [m], at most 5 cm.
            dy: likewise along y.

        Raises:
            InvalidInputError: dx or dy is not a finite number, or larger.
        """
        move = vector([dx, dy], "displacement", 2)
        if np.abs(move).max() > _DISPLACEMENT:
            raise InvalidInputError(f"the object is displaced by at most {_DISPLACEMENT} m, got ({dx}, {dy})")
        self.place_object(self._object_q[:2] + move)

    def place_object(self, position: ArrayLike) -> None:
        """Put the object upright at a position (2,) [m] at once, at rest, as a hand does that lifts it over.

        Raises:
            InvalidInputError: the position is not two finite numbers.
        """
        yaw = self.object_pose()[2]
        self._object_q[:2] = vector(position, "position", 2)
        self._object_q[2:] = (0.0, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
        self._object_qd[:] = 0.0
        mujoco.mj_forward(self.model, self.data)

    def reset(self, object_pose: ArrayLike | None = None, joints: ArrayLike | None = None) -> None:
        """Put object and arm back, at rest, holding.

        Time goes on, so that subscribers and filters never see it jump back.

        Args:
            object_pose: (x, y, yaw) [m, rad]; that of the scene if None.
            joints: joint positions [rad]; those of the scene if None.

        Raises:
            InvalidInputError: a wrong shape, or joints beyond their limits.
        """
        x, y, yaw = vector(self.scene.object_pose if object_pose is None else object_pose, "object_pose", 3)
        q = vector(self.scene.joints() if joints is None else joints, "joints", self.robot.dof)
        self._check_joints(q)
        data = self.data
        data.qpos[:] = self.model.qpos0  # cubes go back, too
        data.qvel[:] = 0.0
        data.qacc_warmstart[:] = 0.0
        data.xfrc_applied[:] = 0.0
        self._object_q[:] = (x, y, 0.0, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
        self._disturbances.active.clear()
        self._hold(q)
        mujoco.mj_forward(self.model, data)


def _positive(value: float, name: str) -> float:
    if not (np.isfinite(value) and value > 0.0):
        raise InvalidInputError(f"{name} must be positive, got {value}")
    return float(value)
