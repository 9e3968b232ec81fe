"""The simulated robot, table and object at 1 kHz, free of ROS and of wall clocks.

Per step: the reference of the trajectory follower, the impedance controller, MuJoCo, and a camera that
watches the object.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.camera import Camera, CameraConfig, CameraFrame
from sim_bridge.impedance import ImpedanceConfig, ImpedanceController
from sim_bridge.limit_monitor import LimitMonitor
from sim_bridge.scene import TIMESTEP, Scene, build
from sim_bridge.trajectory_follower import FollowerConfig, TrajectoryFollower
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.inverse_kinematics import TableMap
from vpsto_ros.robot.kinematics import forward_kinematics_batch, fr3_pusher, tip_velocity_batch

_HAND_FREQUENCY = 60.0  # of the servoed hand [rad/s]
_HAND_FORCE = 25.0  # what the hand pushes with at most, beyond the object's weight [N]


@dataclass
class _Push:
    """A constant wrench on the object until a time."""

    end: float
    wrench: NDArray[np.float64]


@dataclass
class _Hand:
    """A hand that moves the object from one point to another."""

    begin: float
    duration: float
    origin: NDArray[np.float64]
    displacement: NDArray[np.float64]


class Simulation:
    """A scene that is stepped in lock-step or by a driver.

    Attributes:
        scene: what was built.
        model: the MuJoCo model, for renderers and inspection.
        data: the MuJoCo data.
        robot: the model that controllers and planners use.
        follower: takes trajectories: ``simulation.follower.accept(command, simulation.time)``.
        controller: the impedance controller.
        camera: the camera.
        limits: counts what breaks the arm's limits.
        tool_height_deviation: largest distance of the tip from the scene's tool_height so far [m].
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
        self.model = build(self.scene)
        self.data = mujoco.MjData(self.model)
        self.robot = fr3_pusher()
        start = self.scene.joints()
        nominal = TableMap(self.robot, self.scene.tool_height).joints([(0.5, 0.0)])[0]
        self.follower = TrajectoryFollower(self.robot.limits, self.robot.joint_names, start, follower)
        self.controller = ImpedanceController(self.robot, nominal, impedance, period=TIMESTEP)
        self.camera = Camera(camera or CameraConfig(), np.random.default_rng(seed))
        self.limits = LimitMonitor(self.robot.limits)
        self.tool_height_deviation = 0.0
        self._steps = 0
        self._disturbances: list[_Push | _Hand] = []
        self._bind()
        self.reset()

    def _bind(self) -> None:
        """Views into MuJoCo's state, taken once: they stay valid as long as the data lives."""
        d = self.data
        self._q, self._qd = d.qpos[:7], d.qvel[:7]
        self._object_q, self._object_qd = d.qpos[7:14], d.qvel[7:13]
        self._ctrl = d.ctrl
        self._body = self.model.body("object").id
        self._wrench = d.xfrc_applied[self._body]
        self._object_com = d.xipos[self._body]
        self._tip = d.site_xpos[self.model.site("tool_tip").id]

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
        model, data, now = self.model, self.data, self._steps * TIMESTEP
        # Forward quantities belong to the state before mj_step; splitting it gives the controller the
        # present ones.
        mujoco.mj_step1(model, data)
        q_des, qd_des, qdd_des = self.follower.reference(now)
        controller = self.controller
        self._ctrl[:] = controller.torque(self._q, self._qd, q_des, qd_des, qdd_des)
        self.limits.observe(q_des, qd_des, qdd_des, self._q, self._qd, controller.demand)
        deviation = abs(self._tip[2] - self.scene.tool_height)
        if deviation > self.tool_height_deviation:
            self.tool_height_deviation = float(deviation)
        if self._disturbances:
            self._disturb(now)
        if now >= self.camera.next_capture:
            self.camera.capture(now, self.object_pose())
        mujoco.mj_step2(model, data)
        self._steps += 1

    def advance(self, duration: float) -> None:
        """Advance by a duration [s], rounded to milliseconds."""
        for _ in range(round(duration / TIMESTEP)):
            self.step()

    @property
    def joint_position(self) -> NDArray[np.float64]:
        """Measured joint positions [rad], shape (7,)."""
        return self._q.copy()

    @property
    def joint_velocity(self) -> NDArray[np.float64]:
        """Measured joint velocities [rad/s], shape (7,)."""
        return self._qd.copy()

    @property
    def joint_torque(self) -> NDArray[np.float64]:
        """Torques of the last control cycle [Nm], shape (7,)."""
        return self._ctrl.copy()

    def tool_position(self) -> NDArray[np.float64]:
        """True position of the rod's tip in the base frame [m], shape (3,)."""
        return forward_kinematics_batch(self._q[None])[0]

    def tool_velocity(self) -> NDArray[np.float64]:
        """True velocity of the rod's tip in the base frame [m/s], shape (3,)."""
        return tip_velocity_batch(self._q[None], self._qd[None])[0]

    def object_pose(self) -> NDArray[np.float64]:
        """True pose of the object (x, y, yaw) [m, rad], shape (3,)."""
        x, y, _, w, i, j, k = self._object_q.tolist()
        return np.array([x, y, np.arctan2(2.0 * (w * k + i * j), 1.0 - 2.0 * (j * j + k * k))])

    def object_twist(self) -> NDArray[np.float64]:
        """True velocity of the object's frame, (vx, vy, yaw rate) [m/s, rad/s] in the base frame."""
        return self._object_qd[[0, 1, 5]]

    def camera_frames(self) -> list[CameraFrame]:
        """What the camera has delivered since the last call."""
        return self.camera.poll(self.time)

    def tool_contact_force(self) -> NDArray[np.float64]:
        """Force of the rod on the object during the last step [N], base frame, shape (3,)."""
        total, wrench = np.zeros(3), np.zeros(6)
        for index in range(self.data.ncon):
            contact = self.data.contact[index]
            names = {self.model.geom(contact.geom1).name, self.model.geom(contact.geom2).name}
            if "rod" in names and any(name.startswith("object") for name in names):
                mujoco.mj_contactForce(self.model, self.data, index, wrench)
                # The frame's first axis points from geom 1 to geom 2.
                sign = 1.0 if self.model.geom(contact.geom1).name == "rod" else -1.0
                total += sign * (contact.frame.reshape(3, 3).T @ wrench[:3])
        return total

    def push_object(self, force: ArrayLike, torque: ArrayLike, duration: float) -> None:
        """Push the object at its centre of mass with a constant wrench.

        Args:
            force: (3,) [N], base frame.
            torque: (3,) [Nm], base frame.
            duration: how long, from now [s].

        Raises:
            InvalidInputError: force or torque is not three finite numbers, or the duration is not positive.
        """
        wrench = np.concatenate([_vector(force, "force", 3), _vector(torque, "torque", 3)])
        self._disturbances.append(_Push(self.time + _positive(duration, "duration"), wrench))

    def knock(self, displacement: ArrayLike, duration: float = 0.25) -> None:
        """Let a hand move the object by about displacement (2,) [m] within a duration [s].

        The hand holds the object at its centre of mass, along a smooth path, without turning it on purpose,
        and gives way above a force limit, so that it does not push through the rod.

        Raises:
            InvalidInputError: the displacement is not two finite numbers, or the duration is not positive.
        """
        origin = self._object_center()
        self._disturbances.append(
            _Hand(
                self.time, _positive(duration, "duration"), origin, _vector(displacement, "displacement", 2)
            )
        )

    def reset(self, object_pose: ArrayLike | None = None, joints: ArrayLike | None = None) -> None:
        """Put object and arm back, at rest, holding.

        Time goes on, so that subscribers and filters never see it jump back.

        Args:
            object_pose: (x, y, yaw) [m, rad]; that of the scene if None.
            joints: joint positions [rad]; those of the scene if None.

        Raises:
            InvalidInputError: a wrong shape, or joints beyond their limits.
        """
        x, y, yaw = _vector(self.scene.object_pose if object_pose is None else object_pose, "object_pose", 3)
        q = _vector(self.scene.joints() if joints is None else joints, "joints", 7)
        lower, upper = self.robot.position_range
        if np.any(q < lower) or np.any(q > upper):
            raise InvalidInputError(f"joints {np.round(q, 3).tolist()} are beyond their position limits")
        data = self.data
        data.qvel[:] = 0.0
        data.qacc_warmstart[:] = 0.0
        data.xfrc_applied[:] = 0.0
        self._q[:] = q
        self._object_q[:] = (x, y, 0.0, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
        self._disturbances.clear()
        self.camera.clear()
        self.controller.reset()
        self.follower.hold(q, self.time)
        mujoco.mj_forward(self.model, data)

    def _object_center(self) -> NDArray[np.float64]:
        """Centre of mass of the object in the plane [m]."""
        return self._object_com[:2].copy()

    def _disturb(self, now: float) -> None:
        """Add up the disturbances of this instant; drop those that are over."""
        self._wrench[:] = 0.0
        running: list[_Push | _Hand] = []
        for disturbance in self._disturbances:
            if isinstance(disturbance, _Push) and now < disturbance.end:
                self._wrench += disturbance.wrench
                running.append(disturbance)
            elif isinstance(disturbance, _Hand) and now < disturbance.begin + disturbance.duration:
                self._wrench[:2] += self._hand_force(disturbance, now)
                running.append(disturbance)
        self._disturbances = running

    def _hand_force(self, hand: _Hand, now: float) -> NDArray[np.float64]:
        """Critically damped servo along a minimum-jerk path."""
        s = (now - hand.begin) / hand.duration
        share = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
        rate = 30.0 * (s * (1.0 - s)) ** 2 / hand.duration
        bend = 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / hand.duration**2
        w, plant = _HAND_FREQUENCY, self.scene.plant
        offset = hand.origin + share * hand.displacement - self._object_com[:2]
        velocity = np.empty(6)
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_BODY, self._body, velocity, 0)
        slip = rate * hand.displacement - velocity[3:5]
        along = slip + w * offset
        grip = plant.table_friction * plant.mass * 9.81 * along / (np.linalg.norm(along) + 0.02)
        force = plant.mass * (bend * hand.displacement + 2.0 * w * slip + w * w * offset) + grip
        most = _HAND_FORCE + plant.mass * 9.81
        return force * min(1.0, most / max(float(np.linalg.norm(force)), 1e-9))


def _vector(values: ArrayLike, name: str, size: int) -> NDArray[np.float64]:
    vector = np.array(values, dtype=float)
    if vector.shape != (size,) or not np.isfinite(vector).all():
        raise InvalidInputError(f"{name} must be {size} finite numbers, got {values!r}")
    return vector


def _positive(value: float, name: str) -> float:
    if not (np.isfinite(value) and value > 0.0):
        raise InvalidInputError(f"{name} must be positive, got {value}")
    return float(value)
