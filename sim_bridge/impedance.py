"""Joint impedance control, eq. (2.5), as it runs on the arm at 1 kHz."""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numba import njit
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.kinematics import Robot


@documented
@dataclass(frozen=True)
class ImpedanceConfig:
    """Gains of the impedance controller.

    The stiffness lies between what FR3 controllers use in compliant tasks and the arm's own joint
    impedance; a push of 6 N at the tip then costs at most 3 mm on the table. Joint 7 turns a round rod
    about its axis and has next to no inertia: soft, so that its natural frequency stays far below the
    control rate. A tool that is not round has more inertia, and pushes with a lever: stiffer.
    """

    stiffness: tuple[float, ...] = option(
        (2000.0, 2000.0, 2000.0, 2000.0, 600.0, 450.0, 25.0),
        "joint stiffness of an arm", unit="Nm/rad", minimum=0.0, maximum=5000.0,
    )  # fmt: skip
    offset_stiffness: float = option(
        120.0, "stiffness of joint 7 under other tools", unit="Nm/rad", minimum=0.0, maximum=500.0
    )
    damping_ratio: float = option(1.0, "damping relative to critical", minimum=0.0, maximum=1.5)

    def __post_init__(self) -> None:
        """Check the ranges."""
        validate(self)

    def for_arms(self, arms: int, round_tool: bool = True) -> NDArray[np.float64]:
        """Stiffness of all joints of some arms [Nm/rad], shape (7 arms,)."""
        last = self.stiffness[-1] if round_tool else self.offset_stiffness
        return np.tile([*self.stiffness[:-1], last], arms)


class JointController:
    """Stiffness control in joint space with given gains, within torque and torque-rate limits.

    Eq. (2.5): u = C(q, qd) qd + g(q) + M(q) qdd_des - K (q - q_des) - D (qd - qd_des). One recursive
    Newton-Euler pass gives the first three terms.

    Attributes:
        saturated: control cycles in which each joint's torque was cut to its limit, shape (n,).
        rate_limited: likewise for the torque rate, shape (n,).
        demand: what the last cycle asked for before it was cut, as shares of the torque and torque-rate
            limits, shape (2, n).
    """

    def __init__(
        self, robot: Robot, stiffness: ArrayLike, damping: ArrayLike, *, period: float = 0.001,
        implicit: bool = False,
    ):  # fmt: skip
        """Take the gains.

        Args:
            robot: model of the arm, or of several arms.
            stiffness: joint stiffness [Nm/rad], shape (n,).
            damping: damping matrix [Nm s/rad], shape (n, n).
            period: control period [s].
            implicit: whether springs and dampers act on what position and velocity will be at the end of the
                cycle, as in drives that close their loops many times per cycle. Stiff dampers on light joints
                are unstable otherwise: D period must stay below 2 M.

        Raises:
            InvalidInputError: the period is not positive, or a gain has another shape.
        """
        if not period > 0.0:
            raise InvalidInputError(f"period must be positive, got {period}")
        n = robot.dof
        self._robot, self._period, self._implicit = robot, period, implicit
        self._stiffness = np.array(stiffness, dtype=float)
        self._damping = np.array(damping, dtype=float)
        if self._stiffness.shape != (n,) or self._damping.shape != (n, n):
            raise InvalidInputError(
                f"stiffness must have shape ({n},) and damping ({n}, {n}), got {self._stiffness.shape} and "
                f"{self._damping.shape}"
            )
        self._limit = np.array(robot.torque_limits)
        self._step = np.array(robot.torque_rate_limits) * period
        self._torque = np.zeros(n)
        self._counts = np.zeros((2, n), dtype=np.int64)
        self.demand = np.zeros((2, n))
        self._fresh = True

    @property
    def saturated(self) -> NDArray[np.int64]:
        """Control cycles cut to the torque limit, per joint."""
        return self._counts[0].copy()

    @property
    def rate_limited(self) -> NDArray[np.int64]:
        """Control cycles cut to the torque-rate limit, per joint."""
        return self._counts[1].copy()

    def reset(self) -> None:
        """Forget the last torque, so that the next one is not rate limited; counts are kept."""
        self._fresh = True

    def torque(
        self, q: NDArray, qd: NDArray, q_des: NDArray, qd_des: NDArray, qdd_des: NDArray
    ) -> NDArray[np.float64]:
        """Torques [Nm] for this cycle, shape (n,); the array is reused by the next call.

        Args:
            q: measured joint positions [rad], shape (n,).
            qd: measured joint velocities [rad/s], shape (n,).
            q_des: desired positions [rad], shape (n,).
            qd_des: desired velocities [rad/s], shape (n,).
            qdd_des: desired accelerations [rad/s²], shape (n,).
        """
        if self._implicit:
            qdd_des = qdd_des + self._return_acceleration(q, q - q_des, qd - qd_des)
            q_des, qd_des = q, qd
        model_torque = self._robot.inverse_dynamics(q, qd, qdd_des)
        _control_law(
            model_torque, q, qd, q_des, qd_des, self._stiffness, self._damping, self._limit, self._step,
            self._fresh, self._torque, self._counts, self.demand,
        )  # fmt: skip
        self._fresh = False
        return self._torque

    def _return_acceleration(self, q: NDArray, e: NDArray, ed: NDArray) -> NDArray[np.float64]:
        """What springs and dampers do to errors e and ed if they act on the ones at the end of the cycle.

        With those, e + h ed + h² a and ed + h a, M a = -K (e + h ed + h² a) - D (ed + h a).
        """
        h, mass = self._period, self._robot.mass_matrix(q)
        total = mass + h * self._damping + np.diag(h * h * self._stiffness)
        return np.linalg.solve(total, -self._stiffness * (e + h * ed) - self._damping @ ed)


class ImpedanceController(JointController):
    """Stiffness control of an FR3 whose damping is designed for its inertia.

    The damping matrix is designed once, at a nominal posture, such that every mode of M and K has the wanted
    damping ratio there (double diagonalization).
    """

    def __init__(
        self,
        robot: Robot,
        nominal_posture: ArrayLike,
        config: ImpedanceConfig | None = None,
        *,
        round_tool: bool = True,
        period: float = 0.001,
    ):
        """Design the gains.

        Args:
            robot: model of the arm, or of several arms.
            nominal_posture: joint positions at which the damping is designed [rad], shape (n,).
            config: gains.
            round_tool: whether joint 7 turns a round tool about its own axis.
            period: control period [s].

        Raises:
            InvalidInputError: the period is not positive.
        """
        config = config or ImpedanceConfig()
        stiffness = config.for_arms(robot.dof // 7, round_tool)
        mass_matrix = robot.mass_matrix(nominal_posture)
        damping = critical_damping(mass_matrix, stiffness, config.damping_ratio)
        super().__init__(robot, stiffness, damping, period=period)


def critical_damping(mass_matrix: NDArray, stiffness: NDArray, ratio: float = 1.0) -> NDArray[np.float64]:
    """Damping matrix (n, n) with which M x'' + D x' + K x = 0 falls apart into modes of equal damping ratio.

    With M = Q'Q and K = Q' diag(w²) Q it is D = 2 ratio Q' diag(w) Q.
    """
    squares, modes = scipy.linalg.eigh(np.diag(stiffness), mass_matrix)
    back = mass_matrix @ modes
    return np.ascontiguousarray((back * (2.0 * ratio * np.sqrt(np.maximum(squares, 0.0)))) @ back.T)


@njit(cache=True, nogil=True)
def _control_law(
    model_torque, q, qd, q_des, qd_des, stiffness, damping, limit, step, fresh, torque, counts, demand
):
    """Add stiffness and damping to the model's torque; cut to limits; write the torque in place."""
    for i in range(q.shape[0]):
        u = model_torque[i] - stiffness[i] * (q[i] - q_des[i])
        for j in range(q.shape[0]):
            u -= damping[i, j] * (qd[j] - qd_des[j])
        demand[0, i] = abs(u) / limit[i]
        if demand[0, i] > 1.0:
            counts[0, i] += 1
            u = limit[i] if u > 0.0 else -limit[i]
        change = u - torque[i]
        demand[1, i] = 0.0 if fresh else abs(change) / step[i]
        if demand[1, i] > 1.0:
            counts[1, i] += 1
            u = torque[i] + (step[i] if change > 0.0 else -step[i])
        torque[i] = u
