"""The Franka Research 3 and its pushing tools: limits, dynamics by Pinocchio, fast kinematics of the rod.

A robot description (such as ``models/fr3_pusher.xml``) is read by Pinocchio here and by the simulator
elsewhere.
What the planners call thousands of times per replan, the position of the tool tip, is compiled here from
the modified DH table instead.
"""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.trajectory.timing import Limits

_MODELS = Path(__file__).parent / "models"
MODEL_PATH = _MODELS / "fr3_pusher.xml"
HAND_MODEL_PATH = _MODELS / "fr3_hand_pusher.xml"
BIMANUAL_MODEL_PATH = _MODELS / "fr3_bimanual.xml"
TIP_NAMES = ("left_tool_tip", "right_tool_tip")  # frames of the two balls
JOINT_NAMES = tuple(f"fr3_joint{i}" for i in range(1, 8))

# Limits of the FR3 that its MJCF cannot hold (Pinocchio leaves the velocity limit of an MJCF infinite)
# [rad/s, rad/s², Nm/s].
VELOCITY_LIMITS = (2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26)
ACCELERATION_LIMITS = (10.0,) * 7
TORQUE_RATE_LIMITS = (1000.0,) * 7

SHOULDER_HEIGHT = 0.333  # from the base to joint 2 [m]
UPPER_ARM = 0.316
FOREARM = 0.384
ELBOW_OFFSET = 0.0825
WRIST_OFFSET = 0.088
FLANGE_OFFSET = 0.107
TOOL_LENGTH = 0.16  # from the flange to the tip of the rod

# Modified DH rows (a, d, cos alpha, sin alpha); alpha is a multiple of 90 degrees, so its sine and cosine
# are exact.
_DH = np.array(
    [
        (0.0, SHOULDER_HEIGHT, 1.0, 0.0),
        (0.0, 0.0, 0.0, -1.0),
        (0.0, UPPER_ARM, 0.0, 1.0),
        (ELBOW_OFFSET, 0.0, 0.0, 1.0),
        (-ELBOW_OFFSET, FOREARM, 0.0, -1.0),
        (0.0, 0.0, 0.0, 1.0),
        (WRIST_OFFSET, 0.0, 0.0, 1.0),
    ]
)
_TIP = FLANGE_OFFSET + TOOL_LENGTH


def dh_table() -> NDArray[np.float64]:
    """Rows (a, d, cos alpha, sin alpha) of the modified DH table of joints 1..7, a copy, shape (7, 4)."""
    return _DH.copy()


@njit(cache=True, nogil=True)
def _tip_motion(dh, tip, q, qd, position, velocity):
    """Positions and, if the array is not empty, velocities of the tips, shapes (B, 3).

    The tip is handed from frame to frame, from the flange down to the base, which needs no rotation
    matrices. It lies on the axis of joint 7, so that this joint moves nothing.
    """
    moving = velocity.shape[0] > 0
    for b in range(q.shape[0]):
        x, y, z = 0.0, 0.0, tip
        u, v, w = 0.0, 0.0, 0.0
        for i in range(6, -1, -1):
            a, d, ca, sa = dh[i, 0], dh[i, 1], dh[i, 2], dh[i, 3]
            if i < 6:
                c, s = np.cos(q[b, i]), np.sin(q[b, i])
                x, y = c * x - s * y, s * x + c * y
                if moving:
                    u, v = c * u - s * v - qd[b, i] * y, s * u + c * v + qd[b, i] * x
            x, z = x + a, z + d
            y, z = ca * y - sa * z, sa * y + ca * z
            if moving:
                v, w = ca * v - sa * w, sa * v + ca * w
        position[b, 0], position[b, 1], position[b, 2] = x, y, z
        if moving:
            velocity[b, 0], velocity[b, 1], velocity[b, 2] = u, v, w


def _joint_rows(values: ArrayLike, name: str) -> NDArray[np.float64]:
    rows = np.ascontiguousarray(values, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != 7:
        raise InvalidInputError(f"{name} must have shape (B, 7), got {rows.shape}")
    return rows


def forward_kinematics_batch(q: ArrayLike) -> NDArray[np.float64]:
    """Positions of the tool tip in the base frame.

    Args:
        q: joint positions [rad], shape (B, 7).

    Returns:
        Tip positions [m], shape (B, 3).

    Raises:
        InvalidInputError: q has another shape.
    """
    rows = _joint_rows(q, "q")
    position = np.empty((len(rows), 3))
    _tip_motion(_DH, _TIP, rows, rows, position, np.empty((0, 3)))
    return position


def tip_velocity_batch(q: ArrayLike, qd: ArrayLike) -> NDArray[np.float64]:
    """Linear velocities of the tool tip in the base frame.

    Args:
        q: joint positions [rad], shape (B, 7).
        qd: joint velocities [rad/s], shape (B, 7).

    Returns:
        Tip velocities [m/s], shape (B, 3).

    Raises:
        InvalidInputError: q or qd has another shape, or they differ in length.
    """
    rows, rates = _joint_rows(q, "q"), _joint_rows(qd, "qd")
    if len(rows) != len(rates):
        raise InvalidInputError(
            f"q and qd must have as many rows as each other, got {len(rows)} and {len(rates)}"
        )
    position, velocity = np.empty((len(rows), 3)), np.empty((len(rows), 3))
    _tip_motion(_DH, _TIP, rows, rates, position, velocity)
    return velocity


class Robot:
    """A serial arm read from an MJCF file: kinematics and dynamics of its tool tip through Pinocchio.

    Not thread-safe: the Pinocchio workspace is shared by the methods of one instance. The compiled
    functions of this module are.

    Attributes:
        joint_names: names of the joints, in the order of q.
        limits: position, velocity and acceleration limits of the joints.
        torque_limits: largest joint torques [Nm], shape (n,).
        torque_rate_limits: largest rates of the joint torques [Nm/s], shape (n,).
    """

    def __init__(
        self, model, *, velocity: ArrayLike, acceleration: ArrayLike, torque_rate: ArrayLike, tip: str
    ):
        """Wrap a Pinocchio model; see :meth:`from_mjcf`."""
        import pinocchio

        self._pin = pinocchio
        self._model = model
        self._data = model.createData()
        self._tip = _frame(model, tip)
        self.joint_names: tuple[str, ...] = tuple(list(model.names)[1:])
        self.torque_limits = _per_joint(model.effortLimit, model.nv, "effort limits")
        self.torque_rate_limits = _per_joint(torque_rate, model.nv, "torque_rate")
        self.limits = Limits(
            velocity=_per_joint(velocity, model.nv, "velocity"),
            acceleration=_per_joint(acceleration, model.nv, "acceleration"),
            lower=np.array(model.lowerPositionLimit),
            upper=np.array(model.upperPositionLimit),
        )

    @classmethod
    def from_mjcf(
        cls,
        path: str | Path,
        *,
        velocity: Sequence[float] = VELOCITY_LIMITS,
        acceleration: Sequence[float] = ACCELERATION_LIMITS,
        torque_rate: Sequence[float] = TORQUE_RATE_LIMITS,
        tip: str = "tool_tip",
    ) -> "Robot":
        """Read a robot description.

        Args:
            path: MJCF file. Everything that belongs to the robot must be inside its first top-level body,
                and that body must be at the origin: Pinocchio reads no other and drops its offset.
            velocity: velocity limits [rad/s], one per joint (an MJCF holds none).
            acceleration: acceleration limits [rad/s²], one per joint.
            torque_rate: limits of the torque rates [Nm/s], one per joint.
            tip: name of the frame (MJCF site) at the tip of the tool.

        Raises:
            ConfigurationError: there is no such file or frame, or a limit has not one entry per joint.
        """
        import pinocchio

        if not Path(path).is_file():
            raise ConfigurationError(f"no robot description at '{path}'")
        model = pinocchio.buildModelFromMJCF(str(path))
        return cls(model, velocity=velocity, acceleration=acceleration, torque_rate=torque_rate, tip=tip)

    @property
    def position_range(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest joint positions [rad], each (n,), as in ``limits``."""
        return self._model.lowerPositionLimit.copy(), self._model.upperPositionLimit.copy()

    @property
    def dof(self) -> int:
        """Number of joints."""
        return self._model.nv

    def forward(
        self, q: ArrayLike, tip: str | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Position (3,) [m] and rotation matrix (3, 3) of the tool tip for joint positions q (n,) [rad].

        Args:
            q: joint positions.
            tip: name of another frame to look at instead, such as the second tool's.

        Raises:
            ConfigurationError: there is no such frame.
        """
        frame = self._tip if tip is None else _frame(self._model, tip)
        self._pin.framesForwardKinematics(self._model, self._data, self._vector(q, "q"))
        placement = self._data.oMf[frame]
        return placement.translation.copy(), placement.rotation.copy()

    def jacobian(self, q: ArrayLike, tip: str | None = None) -> NDArray[np.float64]:
        """Jacobian (6, n) of the tool tip, or of another frame: linear, then angular, in axes of the base.

        Args:
            q: joint positions [rad], shape (n,).
            tip: name of another frame to look at instead, such as the second tool's.

        Raises:
            ConfigurationError: there is no such frame.
        """
        frame = self._tip if tip is None else _frame(self._model, tip)
        axes = self._pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return self._pin.computeFrameJacobian(self._model, self._data, self._vector(q, "q"), frame, axes)

    def inverse_dynamics(self, q: NDArray, qd: NDArray, qdd: NDArray) -> NDArray[np.float64]:
        """Torques M(q) qdd + C(q, qd) qd + g(q) [Nm], shape (n,); eq. (2.1) without external forces.

        One recursive Newton-Euler pass; called every control cycle, so that its arguments go to Pinocchio
        unchecked.
        """
        return self._pin.rnea(self._model, self._data, q, qd, qdd)

    def mass_matrix(self, q: ArrayLike) -> NDArray[np.float64]:
        """Inertia matrix M(q) (n, n) [kg m²] at q (n,) [rad]."""
        return self._pin.crba(self._model, self._data, self._vector(q, "q")).copy()

    def _vector(self, values: ArrayLike, name: str) -> NDArray[np.float64]:
        vector = np.asarray(values, dtype=float)
        if vector.shape != (self.dof,):
            raise InvalidInputError(f"{name} must have shape ({self.dof},), got {vector.shape}")
        return vector


def _per_joint(values: ArrayLike, dof: int, name: str) -> NDArray[np.float64]:
    vector = np.array(values, dtype=float)
    if vector.shape != (dof,) or not np.all(vector > 0.0):
        raise ConfigurationError(f"{name} must be {dof} positive numbers, one per joint, got {values!r}")
    vector.setflags(write=False)
    return vector


def _frame(model, name: str) -> int:
    if not model.existFrame(name):
        names = ", ".join(frame.name for frame in model.frames)
        raise ConfigurationError(f"the robot description has no frame '{name}'; it has: {names}")
    return model.getFrameId(name)


@lru_cache(maxsize=1)
def fr3_pusher() -> Robot:
    """The Franka Research 3 with the pushing rod, read once and shared (but not by threads)."""
    return Robot.from_mjcf(MODEL_PATH)


@lru_cache(maxsize=1)
def fr3_hand_pusher() -> Robot:
    """The Franka Research 3 with a block like its hand as a pusher, read once and shared."""
    return Robot.from_mjcf(HAND_MODEL_PATH)


@lru_cache(maxsize=1)
def fr3_bimanual() -> Robot:
    """Two Franka Research 3, each with a ball on a crank, read once and shared; see TIP_NAMES."""
    return Robot.from_mjcf(
        BIMANUAL_MODEL_PATH,
        velocity=2 * VELOCITY_LIMITS,
        acceleration=2 * ACCELERATION_LIMITS,
        torque_rate=2 * TORQUE_RATE_LIMITS,
        tip=TIP_NAMES[0],
    )
