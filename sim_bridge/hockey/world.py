"""The air-hockey world at 1 kHz, free of ROS and of wall clocks.

Everything is in the robot's base frame; see :mod:`sim_bridge.hockey.table` for the table's. Per step: the
reference of the trajectory follower, the arm's controller, the mallet's, MuJoCo, and a camera that watches
the puck.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.arm_world import TIMESTEP, ArmWorld, vector
from sim_bridge.camera import Camera, CameraConfig
from sim_bridge.hockey import table
from sim_bridge.hockey.contact_log import ContactLog, PuckContact
from sim_bridge.hockey.mallet import Mallet, MalletConfig, MalletState
from sim_bridge.hockey.rules import RulesMonitor
from sim_bridge.hockey.scene import AirHockeyScene, build
from sim_bridge.impedance import JointController
from sim_bridge.trajectory_follower import FollowerConfig, TrajectoryFollower
from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.iiwa import UNIVERSAL_JOINT, iiwa14

CAMERA = CameraConfig(rate=120.0, latency=0.01, position_std=5e-7**0.5, yaw_std=0.02, dropout=0.02)
"""A camera as above real tables: 120 Hz, position variance 5e-7 m²."""


_BEHIND_GOALS = 0.1  # so far beyond the rims the camera sees [m]


@documented
@dataclass(frozen=True)
class ArmGains:
    """Gains of the arm's joint controller; there is no coupling between the joints."""

    stiffness: tuple[float, ...] = option(
        (1500.0, 1500.0, 1200.0, 1200.0, 1000.0, 1000.0, 500.0),
        "joint stiffness", unit="Nm/rad", minimum=0.0, maximum=5000.0,
    )  # fmt: skip
    damping: tuple[float, ...] = option(
        (60.0, 80.0, 60.0, 30.0, 10.0, 1.0, 0.5), "joint damping", unit="Nm s/rad", minimum=0.0, maximum=500.0
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        validate(self)


@dataclass(frozen=True)
class Goal:
    """The puck's centre has passed the line of a goal, between its posts.

    Attributes:
        end: "far", or "near": the robot's own.
        time: of the first step beyond the line [s].
        position: of the puck's centre there (x, y) [m], base frame.
        velocity: likewise [m/s].
    """

    end: str
    time: float
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]


class AirHockeyWorld(ArmWorld):
    """Table, puck, mallet and arm, stepped in lock-step or by a driver.

    The tip of the robot is the universal joint.

    Attributes:
        rules: counts what breaks the rules of play, since the last reset.
        goal: where the puck went out of play, or None; stays until the puck is put back.
    """

    surface = table.TABLE_ORIGIN[2]

    def __init__(
        self,
        scene: AirHockeyScene | None = None,
        *,
        seed: int = 0,
        camera: CameraConfig = CAMERA,
        gains: ArmGains | None = None,
        mallet: MalletConfig | None = None,
        follower: FollowerConfig | None = None,
    ):
        """Build the scene and start at time 0, at rest.

        Args:
            scene: starts, drag and contacts.
            seed: of the camera's noise and drop-outs.
            camera: camera.
            gains: of the arm; their defaults if None.
            mallet: gains of the mallet's hinges; their defaults if None.
            follower: tolerances of the trajectory rules; their defaults if None.

        Raises:
            InvalidInputError: the scene's starts are out of range; see :meth:`reset`.
        """
        self.scene = scene or AirHockeyScene()
        super().__init__(build(self.scene), iiwa14())
        start, gains = np.array(self.scene.joints), gains or ArmGains()
        self.follower = TrajectoryFollower(self.robot.limits, self.robot.joint_names, start, follower)
        self.controller = JointController(
            self.robot, gains.stiffness, np.diag(gains.damping), period=TIMESTEP, implicit=True
        )
        self.camera = Camera(camera, np.random.default_rng(seed))
        self.rules = RulesMonitor(self.robot.limits)
        self.goal: Goal | None = None
        self._mallet = Mallet(self.model, self.data, mallet)
        self._log = ContactLog(self.model, self.data)
        self._bind()
        self.reset()

    def _bind(self) -> None:
        """More views into MuJoCo's state."""
        d = self.data
        puck = self.model.joint("puck_x")
        # The puck's joints count from the table's centre.
        self._puck_q = d.qpos[puck.qposadr[0] :][:3]
        self._puck_qd = d.qvel[puck.dofadr[0] :][:3]
        self._puck_origin = np.array([*table.TABLE_ORIGIN[:2], 0.0])
        self._joint = d.site_xpos[self.model.site(UNIVERSAL_JOINT).id]
        self._elbow, self._wrist = (d.xpos[self.model.body(f"iiwa_link_{i}").id] for i in (4, 6))

    def step(self) -> None:
        """Advance by one millisecond."""
        super().step()
        self._watch_goals()

    def _act(self, now: float) -> None:
        """Hold the mallet, and watch rules and contacts."""
        self._mallet.control()
        self.rules.observe(self._joint, self._elbow, self._wrist, self._q, self._qd)
        self._log.observe(now, self.puck_pose(), self._puck_qd, self._mallet.state)

    def _watch_goals(self) -> None:
        position = self._puck_q[:2] + self._puck_origin[:2]
        end = table.goal_at(position) if self.goal is None else None
        if end is not None:
            self.goal = Goal(end, self.time, position, self._puck_qd[:2].copy())

    def puck_pose(self) -> NDArray[np.float64]:
        """True pose of the puck (x, y, yaw) [m, rad], shape (3,), base frame; the yaw counts turns."""
        return self._puck_q + self._puck_origin

    def puck_twist(self) -> NDArray[np.float64]:
        """True velocity of the puck (vx, vy, yaw rate) [m/s, rad/s], shape (3,), base frame."""
        return self._puck_qd.copy()

    def object_pose(self) -> NDArray[np.float64]:
        """True pose of the puck."""
        return self.puck_pose()

    def object_twist(self) -> NDArray[np.float64]:
        """True velocity of the puck."""
        return self.puck_twist()

    def arm_points(self) -> list[NDArray[np.float64]]:
        """The arm from its base to the universal joint, as of the last step's beginning."""
        links = [self.data.body(f"iiwa_link_{i}").xpos for i in range(8)]
        return [np.array([*links, self._joint])]

    @property
    def height_deviation(self) -> float:
        """Largest distance of the universal joint from the height of play since the last reset [m]."""
        return self.rules.report().height.worst

    @property
    def object_visible(self) -> bool:
        """Whether the puck is on the table or in a goal; the camera sees nothing of one that is gone."""
        return table.on_table(self.puck_pose()[:2], -_BEHIND_GOALS)

    def mallet_state(self) -> MalletState:
        """The mallet now."""
        # The step leaves MuJoCo's positions one millisecond behind the state.
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_comVel(self.model, self.data)
        return self._mallet.state()

    @property
    def contacts(self) -> list[PuckContact]:
        """Contacts of the puck that have ended since the last reset."""
        return list(self._log.contacts)

    @property
    def touching(self) -> tuple[str, ...]:
        """What the puck touched in the last step: "mallet" or rims."""
        return self._log.touching

    @property
    def off_table(self) -> bool:
        """Whether the puck is outside the rims, in a goal or through a rim."""
        return not table.on_table(self.puck_pose()[:2])

    def place_puck(self, pose: ArrayLike, velocity: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Put the puck somewhere at once, as a hand does that brings it back; the arm goes on.

        Args:
            pose: (x, y, yaw) [m, rad], base frame.
            velocity: (vx, vy, yaw rate) [m/s, rad/s].

        Raises:
            InvalidInputError: a wrong shape, or a puck that is not on the table or is under the mallet.
        """
        pose, twist = vector(pose, "puck", 3), vector(velocity, "puck_velocity", 3)
        _check_on_table(pose)
        _check_clear(self.mallet_state().position, pose)
        self._put(pose, twist)
        mujoco.mj_forward(self.model, self.data)

    def _put(self, pose: NDArray, twist: NDArray) -> None:
        self._puck_q[:], self._puck_qd[:] = pose - self._puck_origin, twist
        self.goal = None
        self._log.clear()
        self.camera.clear()

    def reset(
        self,
        puck: ArrayLike | None = None,
        puck_velocity: ArrayLike = (0.0, 0.0, 0.0),
        joints: ArrayLike | None = None,
    ) -> None:
        """Put puck and arm back, the arm at rest, holding, with the mallet hanging vertically.

        Time goes on, so that subscribers and filters never see it jump back.

        Args:
            puck: pose (x, y, yaw) [m, rad], base frame; that of the scene if None.
            puck_velocity: (vx, vy, yaw rate) [m/s, rad/s].
            joints: joint positions [rad], shape (7,); those of the scene if None.

        Raises:
            InvalidInputError: a wrong shape, joints beyond their limits, a rod that points upwards, or a puck
                that is not on the table or is under the mallet.
        """
        pose = vector(self.scene.puck if puck is None else puck, "puck", 3)
        twist = vector(puck_velocity, "puck_velocity", 3)
        q = vector(self.scene.joints if joints is None else joints, "joints", self.robot.dof)
        self._check_joints(q)
        _check_on_table(pose)
        self._check_mallet(q, pose)
        data = self.data
        data.qvel[:] = data.qacc_warmstart[:] = 0.0
        self._hold(q)
        self._put(pose, twist)
        mujoco.mj_kinematics(self.model, data)
        self._mallet.hang()
        self.rules.reset()
        mujoco.mj_forward(self.model, data)

    def _check_mallet(self, q: NDArray, pose: NDArray) -> None:
        """The mallet must be able to hang vertically, and not on the puck."""
        joint, rod = self.robot.forward(q)
        if rod[2, 2] >= 0.0:
            raise InvalidInputError("the rod points upwards; the mallet's joint turns by 90 degrees at most")
        _check_clear(joint, pose)


def _check_clear(mallet: NDArray, pose: NDArray) -> None:
    distance, least = float(np.linalg.norm(mallet[:2] - pose[:2])), table.PUCK_RADIUS + table.MALLET_RADIUS
    if distance < least:
        raise InvalidInputError(
            f"puck = ({pose[0]:.4g}, {pose[1]:.4g}) is under the mallet; their centres must be {least:.4f} m "
            f"apart, and are {distance:.4f} m"
        )


def _check_on_table(pose: NDArray) -> None:
    if not table.on_table(pose[:2], table.PUCK_RADIUS - 1e-9):
        corner = np.array([table.HALF_LENGTH, table.HALF_WIDTH])
        low, high = table.to_base(-corner), table.to_base(corner)
        raise InvalidInputError(
            f"puck = ({pose[0]:.4g}, {pose[1]:.4g}) is not on the table; its rim must be within x from "
            f"{low[0]:.3f} to {high[0]:.3f} m, y from {low[1]:.3f} to {high[1]:.3f} m of the base frame"
        )
