"""How the mallet swings on its passive universal joint, so that its centre is where it is wanted.

A weak controller holds the mallet vertical. Its damping acts on the joint's own motion, so the mallet is
dragged along while the rod turns, and its weight lags behind while the joint accelerates. For small angles,
seen from the world,

    I tau'' = -(k A + m c g) tau - d A (tau' - r) - m c a,

with the tilt tau of the lower end towards x and y, the rate r at which the rod's lower end turns, and the
acceleration a of the joint. A is the unit matrix where the axis of the first hinge, the rod's y axis, is
horizontal. Frame: the robot's base.
"""

import dataclasses

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.iiwa_kinematics import chain, jacobian
from vpsto_ros.trajectory import Trajectory

_GRAVITY = 9.81  # [m/s²]
_LEAST_LEVEL = 0.05  # square of the horizontal part of the first hinge's axis
_UPRIGHT = 0.004  # a mallet that leans less touches in between the puck's edges [rad]
_SWING_ON = 0.003  # by which it leans farther ahead while the contact lasts [rad]


@documented
@dataclasses.dataclass(frozen=True)
class MalletTilt:
    """The mallet's mechanics, as a planner takes them to be.

    Raises:
        ConfigurationError: a value is out of range; the message names what is allowed.
    """

    stiffness: float = option(
        4.0, "of each hinge towards the vertical", unit="Nm/rad", minimum=0.1, maximum=1000.0
    )  # fmt: skip
    damping: float = option(0.31, "of each hinge", unit="Nm s/rad", minimum=0.0, maximum=100.0)
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
    puck: tuple[float, float] = option(
        (0.0483, 0.0655), "from the joint down to where a mallet that leans back, or ahead, touches the puck:"
        " near its upper or its lower edge", unit="m", minimum=0.0, maximum=0.5,
    )  # fmt: skip
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

    def touching(self, state: NDArray, direction: NDArray) -> NDArray[np.float64]:
        """Where the mallet's axis is relative to the joint, (2,) [m], at the height at which it touches.

        A mallet whose lower end swings ahead touches the puck's lower edge, else the upper one: if it leans
        aside as well, its axis is elsewhere at that height than at its centre.

        Args:
            state: tilt and rates (4,).
            direction: towards the puck, a unit vector (2,).
        """
        upper, lower = self.puck
        ahead = float(direction @ state[:2]) + _SWING_ON
        share = min(max(ahead / _UPRIGHT, -1.0), 1.0)
        return (0.5 * (upper + lower) + 0.5 * share * (lower - upper)) * np.tan(state[:2])


@njit(cache=True, nogil=True)
def _drive(q, qd, qdd, row, arm, axes, jac, out):
    """A node of the integration: d A r - m c a towards x and y, and the matrix A (xx, xy, yy)."""
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
    _stiffening(q, axes, out)
    rx, ry = -wy, wx  # of the rod's lower end
    out[0] = row[1] * (out[2] * rx + out[3] * ry) - row[3] * ax
    out[1] = row[1] * (out[3] * rx + out[4] * ry) - row[3] * ay


@njit(cache=True, nogil=True)
def _stiffening(q, axes, out):
    """The matrix A (xx, xy, yy): the first hinge turns about an axis that may not be horizontal.

    The more upright it is, the more it has to turn for the same swing, and the stiffer it seems.
    """
    c, s = np.cos(q[6]), np.sin(q[6])
    # The rod's y axis; those of joints 6 and 7 and their product are its frame before joint 7 turns.
    xx = axes[5, 1] * axes[6, 2] - axes[5, 2] * axes[6, 1]
    xy = axes[5, 2] * axes[6, 0] - axes[5, 0] * axes[6, 2]
    yx, yy = c * axes[5, 0] - s * xx, c * axes[5, 1] - s * xy
    level = max(yx * yx + yy * yy, _LEAST_LEVEL)
    more = (1.0 / level - 1.0) / level
    out[2], out[3], out[4] = 1.0 + more * yy * yy, -more * yy * yx, 1.0 + more * yx * yx


@njit(cache=True, nogil=True)
def _accelerations(node, row, tx, ty, rx, ry):
    """Of the tilt (tx, ty) with rates (rx, ry)."""
    k, d, inertia, weight = row[0], row[1], row[2], row[3] * _GRAVITY
    sx, sy = k * tx + d * rx, k * ty + d * ry
    return (
        (node[0] - weight * tx - node[2] * sx - node[3] * sy) / inertia,
        (node[1] - weight * ty - node[3] * sx - node[4] * sy) / inertia,
    )


@njit(cache=True, nogil=True)
def _swing(q, qd, qdd, step, row, state):
    """Integrate the tilt (4,) in place over samples at half steps (2 K + 1, 7), by Runge and Kutta's rule."""
    arm, axes, jac = np.empty((4, 3)), np.empty((7, 3)), np.empty((3, 6))
    nodes, h = np.empty((3, 5)), step
    _drive(q[0], qd[0], qdd[0], row, arm, axes, jac, nodes[0])
    for i in range(q.shape[0] // 2):
        _drive(q[2 * i + 1], qd[2 * i + 1], qdd[2 * i + 1], row, arm, axes, jac, nodes[1])
        _drive(q[2 * i + 2], qd[2 * i + 2], qdd[2 * i + 2], row, arm, axes, jac, nodes[2])
        x, y, u, v = state[0], state[1], state[2], state[3]
        ax1, ay1 = _accelerations(nodes[0], row, x, y, u, v)
        u2, v2 = u + 0.5 * h * ax1, v + 0.5 * h * ay1
        ax2, ay2 = _accelerations(nodes[1], row, x + 0.5 * h * u, y + 0.5 * h * v, u2, v2)
        u3, v3 = u + 0.5 * h * ax2, v + 0.5 * h * ay2
        ax3, ay3 = _accelerations(nodes[1], row, x + 0.5 * h * u2, y + 0.5 * h * v2, u3, v3)
        u4, v4 = u + h * ax3, v + h * ay3
        ax4, ay4 = _accelerations(nodes[2], row, x + h * u3, y + h * v3, u4, v4)
        state[0] = x + h * (u + 2.0 * u2 + 2.0 * u3 + u4) / 6.0
        state[1] = y + h * (v + 2.0 * v2 + 2.0 * v3 + v4) / 6.0
        state[2] = u + h * (ax1 + 2.0 * ax2 + 2.0 * ax3 + ax4) / 6.0
        state[3] = v + h * (ay1 + 2.0 * ay2 + 2.0 * ay3 + ay4) / 6.0
        nodes[0] = nodes[2]
