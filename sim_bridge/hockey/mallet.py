"""The mallet on its passive universal joint, held vertical by a weak controller: it lags and swings."""

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim_bridge.hockey.scene import MALLET_JOINTS
from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.robot.iiwa import UNIVERSAL_JOINT


@documented
@dataclass(frozen=True)
class MalletConfig:
    """Gains that hold the mallet vertical.

    The damping acts on the joint's own velocity, not on its error: while the rod turns, the mallet follows
    the vertical late by damping / stiffness, 78 ms (74 ms with the mallet's weight, which helps).
    """

    stiffness: float = option(4.0, "stiffness of each hinge", unit="Nm/rad", minimum=0.0, maximum=100.0)
    damping: float = option(0.31, "damping of each hinge", unit="Nm s/rad", minimum=0.0, maximum=1.0)

    def __post_init__(self) -> None:
        """Check the ranges."""
        validate(self)


@dataclass(frozen=True)
class MalletState:
    """The mallet at one instant, in the robot's base frame.

    Attributes:
        position: of its centre [m], shape (3,).
        velocity: of its centre [m/s], shape (3,).
        tilt: angles by which its lower end is swung out towards x and towards y [rad], shape (2,).
        joint_position: of the universal joint [m], shape (3,).
        joint_velocity: of the universal joint [m/s], shape (3,).
    """

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    tilt: NDArray[np.float64]
    joint_position: NDArray[np.float64]
    joint_velocity: NDArray[np.float64]


class Mallet:
    """The mallet's hinges, their controller and its state, in the data of one model."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, config: MalletConfig | None = None):
        """Bind to the model's joints and motors."""
        self._model, self._data = model, data
        self._config = config or MalletConfig()
        first = model.joint(MALLET_JOINTS[0])
        self._q = data.qpos[first.qposadr[0] :][:2]
        self._qd = data.qvel[first.dofadr[0] :][:2]
        self._ctrl = data.ctrl[model.actuator(MALLET_JOINTS[0]).id :][:2]
        self._rod = data.site_xmat[model.site(UNIVERSAL_JOINT).id]
        self._geom = model.geom("mallet").id
        self._body, self._link = model.body("mallet").id, model.body("mallet_link").id

    def vertical(self) -> tuple[float, float]:
        """Angles of the two hinges [rad] at which the mallet is vertical under the rod as it is now."""
        # The mallet's axis R R_y(a) R_x(b) e_z points down if R_y(a) R_x(b) e_z is the downward direction
        # seen from the rod, the negative third row of R.
        x, y, z = (-self._rod[6:9]).tolist()
        return math.atan2(x, z), -math.asin(max(-1.0, min(1.0, y)))

    def control(self) -> None:
        """Set the torques of this step; the motors cut them to their limit."""
        stiffness, damping = self._config.stiffness, self._config.damping
        for i, angle in enumerate(self.vertical()):
            self._ctrl[i] = stiffness * (angle - self._q[i]) - damping * self._qd[i]

    def hang(self) -> None:
        """Hang vertically, at rest, under the rod as it is now; it must not point upwards."""
        self._q[:], self._qd[:] = self.vertical(), 0.0

    def state(self) -> MalletState:
        """State as of the last time that positions and velocities were computed."""
        axis = self._data.geom_xmat[self._geom].reshape(3, 3)[:, 2]
        return MalletState(
            position=self._data.geom_xpos[self._geom].copy(),
            velocity=self._velocity(mujoco.mjtObj.mjOBJ_GEOM, self._geom),
            tilt=np.arctan2(axis[:2], -axis[2]),
            joint_position=self._data.xpos[self._link].copy(),
            joint_velocity=self._velocity(mujoco.mjtObj.mjOBJ_XBODY, self._link),
        )

    def _velocity(self, kind: mujoco.mjtObj, index: int) -> NDArray[np.float64]:
        twist = np.empty(6)  # angular, then linear
        mujoco.mj_objectVelocity(self._model, self._data, kind, index, twist, 0)
        return twist[3:]
