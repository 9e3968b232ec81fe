"""Counts every instant at which a run breaks a limit of the arm, and how far."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory.timing import Limits

KINDS = (
    "reference_position", "reference_velocity", "reference_acceleration",
    "joint_position", "joint_velocity", "torque", "torque_rate",
)  # fmt: skip
_TOLERANCE = 1e-4  # share of a limit; what interpolating a trajectory that touches its limits may add


@dataclass(frozen=True)
class LimitReport:
    """What a monitor saw of one kind.

    Attributes:
        instants: instants at which some joint was beyond its limit.
        worst: largest share of the limit over joints and instants; 1 is the limit. For positions the range
            counts from its middle.
        joint: joint of the worst share, from 1; 0 if nothing was seen yet.
    """

    instants: int
    worst: float
    joint: int


class LimitMonitor:
    """Reference, measured motion and torques against the limits of the arm, at every control cycle.

    Torques and torque rates are counted as asked for, before the controller cuts them. A torque asked for
    beyond its limit is a violation; a rate is not, the controller ramps it.
    """

    def __init__(self, limits: Limits):
        """Watch these limits.

        Raises:
            InvalidInputError: the position limits are not given.
        """
        if limits.lower is None or limits.upper is None:
            raise InvalidInputError("a monitor needs limits with a position range; lower or upper is None")
        middle, half = 0.5 * (limits.upper + limits.lower), 0.5 * (limits.upper - limits.lower)
        self._bounds = np.array([middle, half, limits.velocity, limits.acceleration])
        self.reset()

    def reset(self) -> None:
        """Forget everything seen so far."""
        self.instants = 0
        self._counts = np.zeros(len(KINDS), dtype=np.int64)
        self._worst = np.zeros(len(KINDS))
        self._joints = np.zeros(len(KINDS), dtype=np.int64)

    def observe(
        self, q_des: NDArray, qd_des: NDArray, qdd_des: NDArray, q: NDArray, qd: NDArray, demand: NDArray
    ) -> None:
        """Take in one control cycle.

        Args:
            q_des: reference position [rad], shape (n,).
            qd_des: reference velocity [rad/s], shape (n,).
            qdd_des: reference acceleration [rad/s²], shape (n,).
            q: measured position [rad], shape (n,).
            qd: measured velocity [rad/s], shape (n,).
            demand: shares of the torque and torque-rate limits asked for, shape (2, n).
        """
        self.instants += 1
        _observe(self._bounds, q_des, qd_des, qdd_des, q, qd, demand, self._counts, self._worst, self._joints)

    def report(self) -> dict[str, LimitReport]:
        """What was seen, by kind; see KINDS."""
        rows = zip(KINDS, self._counts, self._worst, self._joints, strict=True)
        return {kind: LimitReport(int(count), float(worst), int(joint)) for kind, count, worst, joint in rows}

    @property
    def violations(self) -> int:
        """Instants beyond a limit of position, velocity, acceleration or torque, summed over kinds.

        Torque-rate cuts do not count: the controller ramps the torque, which is then within its limits,
        whenever the reference's acceleration steps; see :attr:`ramped`.
        """
        return int(self._counts[: KINDS.index("torque_rate")].sum())

    @property
    def ramped(self) -> int:
        """Instants at which the controller cut the rate of a torque."""
        return int(self._counts[KINDS.index("torque_rate")])


@njit(cache=True, nogil=True)
def _observe(bounds, q_des, qd_des, qdd_des, q, qd, demand, counts, worst, joints):
    for kind in range(counts.shape[0]):
        most, joint = 0.0, 0
        for i in range(q.shape[0]):
            if kind == 0:
                share = abs(q_des[i] - bounds[0, i]) / bounds[1, i]
            elif kind == 1:
                share = abs(qd_des[i]) / bounds[2, i]
            elif kind == 2:
                share = abs(qdd_des[i]) / bounds[3, i]
            elif kind == 3:
                share = abs(q[i] - bounds[0, i]) / bounds[1, i]
            elif kind == 4:
                share = abs(qd[i]) / bounds[2, i]
            else:
                share = demand[kind - 5, i]
            if share > most:
                most, joint = share, i + 1
        if most > 1.0 + _TOLERANCE:
            counts[kind] += 1
        if most > worst[kind]:
            worst[kind], joints[kind] = most, joint
