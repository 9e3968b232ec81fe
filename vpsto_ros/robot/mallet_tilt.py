"""How the mallet swings on its passive universal joint, so that its centre is where it is wanted.

A weak controller holds the mallet vertical. Its damping acts on the joint's own motion, so the mallet is
dragged along while the rod turns, and its weight lags behind while the joint accelerates. For small angles,
seen from the world,

    I tau'' = -k tau - d (tau' - r) - m c a,

with the tilt tau of the lower end towards x and y, the rate r at which the rod's lower end turns, and the
acceleration a of the joint. Frame: the robot's base.
"""

import dataclasses

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.iiwa_kinematics import chain, jacobian
from vpsto_ros.trajectory import Trajectory


@documented
@dataclasses.dataclass(frozen=True)
class MalletTilt:
    """The mallet's mechanics, as a planner takes them to be.

    Raises:
        ConfigurationError: a value is out of range; the message names what is allowed.
    """

    stiffness: float = option(
        4.19, "of the joint towards the vertical, the mallet's weight included", unit="Nm/rad", minimum=0.1,
        maximum=1000.0,
    )  # fmt: skip
    damping: float = option(0.31, "of the joint", unit="Nm s/rad", minimum=0.0, maximum=100.0)
    inertia: float = option(
        0.0063, "of the mallet about the joint", unit="kg m²", minimum=1e-5, maximum=1.0
    )
    moment: float = option(
        0.0193, "mass of the mallet times the distance of its centre of mass from the joint", unit="kg m",
        minimum=0.0, maximum=1.0,
    )  # fmt: skip
    offset: float = option(
        0.0505, "from the joint down to the mallet's centre", unit="m", minimum=0.0, maximum=0.5
    )
    step: float = option(0.004, "of the integration", unit="s", minimum=1e-4, maximum=0.02)

    def __post_init__(self) -> None:
        validate(self)

    def along(
        self, trajectory: Trajectory, end: float, start: float | None = None, state: NDArray | None = None
    ) -> NDArray[np.float64]:
        """Tilt and its rate at the end of a motion.

        Args:
            trajectory: of the joints.
            end: when the tilt is asked for [s].
            start: from when on it is integrated, the trajectory's start if None [s].
            state: tilt (2,) [rad] and rate (2,) [rad/s] then, shape (4,); vertical at rest if None.

        Returns:
            Tilt towards x and y and its rates, shape (4,).

        Raises:
            InvalidInputError: the end is before the start.
        """
        begin = trajectory.start_time if start is None else start
        if end < begin - 1e-9:
            raise InvalidInputError(f"cannot follow the mallet back from {begin:.4f} s to {end:.4f} s")
        found = np.zeros(4) if state is None else np.array(state, dtype=float)
        count = int(np.ceil((end - begin) / self.step - 1e-9))
        if count > 0:
            times = np.linspace(begin, end, 2 * count + 1)
            row = np.array([self.stiffness, self.damping, self.inertia, self.moment])
            q, qd = trajectory(times), trajectory(times, 1)
            _swing(q, qd, trajectory(times, 2), (end - begin) / count, row, found)
        return found

    def displacement(self, state: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Place [m] and velocity [m/s] of the mallet's centre relative to the joint, each (2,)."""
        return self.offset * np.sin(state[:2]), self.offset * np.cos(state[:2]) * state[2:]


@njit(cache=True, nogil=True)
def _drive(q, qd, qdd, row, arm, axes, jac, out):
    """What turns the mallet besides its own state: d r - m c a, towards x and y."""
    chain(q, arm, axes)
    jacobian(arm, axes, jac)
    wx, wy = 0.0, 0.0
    for k in range(7):
        wx, wy = wx + axes[k, 0] * qd[k], wy + axes[k, 1] * qd[k]
    # The acceleration: J qdd, and what the turning of each joint's arm adds, by the joints' own motion.
    ax, ay = 0.0, 0.0
    for k in range(6):
        ax, ay = ax + jac[0, k] * qdd[k], ay + jac[1, k] * qdd[k]
    # And J' qd: with z_k the axes, sum_k z_k qd_k x (J_k qd_k + 2 sum_{j > k} J_j qd_j).
    for k in range(6):
        vx, vy, vz = 0.0, 0.0, 0.0
        for j in range(k + 1, 6):
            vx, vy, vz = vx + jac[0, j] * qd[j], vy + jac[1, j] * qd[j], vz + jac[2, j] * qd[j]
        ux, uy, uz = axes[k, 0] * qd[k], axes[k, 1] * qd[k], axes[k, 2] * qd[k]
        ax += uy * (jac[2, k] * qd[k] + 2.0 * vz) - uz * (jac[1, k] * qd[k] + 2.0 * vy)
        ay += uz * (jac[0, k] * qd[k] + 2.0 * vx) - ux * (jac[2, k] * qd[k] + 2.0 * vz)
    out[0] = row[1] * -wy - row[3] * ax
    out[1] = row[1] * wx - row[3] * ay


@njit(cache=True, nogil=True)
def _swing(q, qd, qdd, step, row, state):
    """Integrate the tilt (4,) in place over samples at half steps (2 K + 1, 7), by Runge and Kutta's rule."""
    arm, axes, jac = np.empty((4, 3)), np.empty((7, 3)), np.empty((3, 6))
    drives = np.empty((3, 2))
    k, d, inertia = row[0], row[1], row[2]
    _drive(q[0], qd[0], qdd[0], row, arm, axes, jac, drives[0])
    for i in range(q.shape[0] // 2):
        _drive(q[2 * i + 1], qd[2 * i + 1], qdd[2 * i + 1], row, arm, axes, jac, drives[1])
        _drive(q[2 * i + 2], qd[2 * i + 2], qdd[2 * i + 2], row, arm, axes, jac, drives[2])
        for c in range(2):
            t, r = state[c], state[2 + c]
            a1 = (drives[0, c] - k * t - d * r) / inertia
            a2 = (drives[1, c] - k * (t + 0.5 * step * r) - d * (r + 0.5 * step * a1)) / inertia
            t3, r3 = t + 0.5 * step * (r + 0.5 * step * a1), r + 0.5 * step * a2
            a3 = (drives[1, c] - k * t3 - d * r3) / inertia
            t4, r4 = t + step * (r + 0.5 * step * a2), r + step * a3
            a4 = (drives[2, c] - k * t4 - d * r4) / inertia
            state[c] = t + step * r + step * step * (a1 + a2 + a3) / 6.0
            state[2 + c] = r + step * (a1 + 2.0 * a2 + 2.0 * a3 + a4) / 6.0
        drives[0, 0], drives[0, 1] = drives[2, 0], drives[2, 1]
