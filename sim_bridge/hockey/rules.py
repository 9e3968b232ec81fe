"""The rules of play that the arm has to keep, watched at every control cycle.

Everything is in the robot's base frame. Joints may use a share of their limits only.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim_bridge.hockey import table
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory.timing import Limits

NEAREST = 0.584
"""Smallest x of the universal joint: the mallet stays off the near rim [m]."""
WIDEST = 0.47085
"""Largest |y| of the universal joint: the mallet stays off the side rims [m]."""
HEIGHT_TOLERANCE = 0.02
"""How far the universal joint may be from its height [m]."""
LOWEST = 0.25
"""Smallest height of elbow and wrist [m]."""
JOINT_SHARE = 0.95
"""Share of the position and velocity limits that measured joints may use."""
KINDS = ("near", "side", "height", "elbow", "wrist", "joint_position", "joint_velocity")


@dataclass(frozen=True)
class RuleRecord:
    """How one rule was kept.

    Attributes:
        instants: control cycles in which it was broken.
        worst: the value that came nearest to breaking it, or broke it most.
    """

    instants: int
    worst: float


@dataclass(frozen=True)
class RulesReport:
    """How all rules were kept; the worst values are NaN before the first cycle.

    Attributes:
        cycles: control cycles that were watched.
        near: x of the universal joint [m].
        side: its distance |y| from the middle [m].
        height: its distance from the height of play [m].
        elbow: height of the elbow [m].
        wrist: height of the wrist [m].
        joint_position: share of a joint's range, from its middle.
        joint_velocity: share of a joint's velocity limit.
    """

    cycles: int
    near: RuleRecord
    side: RuleRecord
    height: RuleRecord
    elbow: RuleRecord
    wrist: RuleRecord
    joint_position: RuleRecord
    joint_velocity: RuleRecord

    @property
    def violations(self) -> dict[str, int]:
        """Broken rules and in how many cycles they were; empty when all were kept."""
        counts = {kind: getattr(self, kind).instants for kind in KINDS}
        return {kind: count for kind, count in counts.items() if count}


class RulesMonitor:
    """Counts the control cycles in which a rule is broken."""

    def __init__(self, limits: Limits) -> None:
        """Watch an arm with these limits.

        Raises:
            InvalidInputError: the position limits are not given.
        """
        if limits.lower is None or limits.upper is None:
            raise InvalidInputError("rules need limits with a position range; lower or upper is None")
        middle, half = 0.5 * (limits.upper + limits.lower), 0.5 * (limits.upper - limits.lower)
        self._joints = np.array([middle, half, limits.velocity])
        self._bounds = np.array(
            [-NEAREST, WIDEST, HEIGHT_TOLERANCE, -LOWEST, -LOWEST, JOINT_SHARE, JOINT_SHARE]
        )
        self.reset()

    def reset(self) -> None:
        """Forget everything seen so far."""
        self._cycles = 0
        self._counts = np.zeros(len(KINDS), dtype=np.int64)
        self._worst = np.full(len(KINDS), -np.inf)

    def observe(self, joint: NDArray, elbow: NDArray, wrist: NDArray, q: NDArray, qd: NDArray) -> None:
        """Take in one control cycle.

        Args:
            joint: position of the universal joint [m], shape (3,).
            elbow: of the elbow [m], shape (3,).
            wrist: of the wrist [m], shape (3,).
            q: measured joint positions [rad], shape (n,).
            qd: measured joint velocities [rad/s], shape (n,).
        """
        self._cycles += 1
        places, height = (joint, elbow, wrist), table.UNIVERSAL_JOINT_HEIGHT
        _observe(self._bounds, self._joints, *places, height, q, qd, self._counts, self._worst)

    def report(self) -> RulesReport:
        """What was seen since the last reset."""
        signs = np.array([-1.0, 1.0, 1.0, -1.0, -1.0, 1.0, 1.0])  # what must be large was negated
        worst = signs * np.where(self._cycles, self._worst, np.nan)
        rows = zip(KINDS, self._counts, worst, strict=True)
        records = {kind: RuleRecord(int(count), float(value)) for kind, count, value in rows}
        return RulesReport(self._cycles, **records)


@njit(cache=True, nogil=True)
def _observe(bounds, joints, joint, elbow, wrist, height, q, qd, counts, worst):
    position, velocity = 0.0, 0.0
    for i in range(q.shape[0]):
        position = max(position, abs(q[i] - joints[0, i]) / joints[1, i])
        velocity = max(velocity, abs(qd[i]) / joints[2, i])
    values = (
        -joint[0], abs(joint[1]), abs(joint[2] - height), -elbow[2], -wrist[2], position, velocity,
    )  # fmt: skip
    for kind in range(bounds.shape[0]):
        if values[kind] > bounds[kind]:
            counts[kind] += 1
        worst[kind] = max(worst[kind], values[kind])
