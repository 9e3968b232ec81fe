"""One FR3 whose flange points straight down at a fixed height: what every tool in the plane wants.

The elbow stays in the vertical plane through the base axis (q3 = q5 = 0). What is left is a planar arm with
two links: joint positions are then exact, smooth functions of the flange's position (x, y), and so are their
derivatives.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InfeasibleError, InvalidInputError
from vpsto_ros.robot import kinematics as fr3
from vpsto_ros.robot.radial_arm import (
    FOREARM,
    STRAIGHT_ELBOW,
    UPPER_ARM,
    RadialArm,
    plane_to_joints,
    radial_arms,
)

_STRETCH_MARGIN = 0.3  # the elbow stays bent by at least this beyond the straight, singular arm [rad]


class UprightArm:
    """The axis of an upright tool, mapped to joint positions in closed form, in the frame of the arm's base.

    Attributes:
        radius_range: (r_min, r_max) [m], distances of the flange from the base axis for which the position
            limits of joints 2, 4 and 6 hold and the elbow stays clear of the singular, straight arm.
    """

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        height: float,
        tool_length: float,
        *,
        margin: float = 0.02,
        name: str = "the upright tool",
    ):
        """Fix the plane.

        Args:
            lower: least joint positions [rad], shape (7,).
            upper: greatest joint positions [rad], shape (7,).
            height: height of the tool's tip above the base [m].
            tool_length: how far the tip is below the flange [m].
            margin: distance kept from the joint position limits [rad].
            name: what messages call the tool.

        Raises:
            InvalidInputError: no radius is within the limits at this height.
        """
        self._lower, self._upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        self._height, self._margin, self._name = float(height), float(margin), name
        self._wrist_height = self._height + tool_length + fr3.FLANGE_OFFSET - fr3.SHOULDER_HEIGHT
        self.radius_range = self._find_radius_range()

    def _find_radius_range(self) -> tuple[float, float]:
        radii = np.linspace(fr3.WRIST_OFFSET + 1e-3, fr3.WRIST_OFFSET + UPPER_ARM + FOREARM, 7201)
        reach = np.hypot(radii - fr3.WRIST_OFFSET, self._wrist_height)
        radii = radii[(reach < UPPER_ARM + FOREARM - 1e-6) & (reach > abs(FOREARM - UPPER_ARM) + 1e-6)]
        angles = self.radial(radii).angle
        bent = angles[:, 1] < STRAIGHT_ELBOW - _STRETCH_MARGIN
        good = np.flatnonzero(self.within([1, 3, 5], angles) & bent)
        if len(good) == 0:
            raise InvalidInputError(
                f"no posture within the joint limits holds {self._name} at height {self._height} m"
            )
        return float(radii[good[0]]), float(radii[good[-1]])

    def within(self, joints: list[int], angles: ArrayLike) -> NDArray[np.bool_]:
        """Whether angles (..., k) [rad] of some joints (counted from 0) keep the margin from their limits."""
        angles = np.asarray(angles, dtype=float)
        lower, upper = self._lower[joints] + self._margin, self._upper[joints] - self._margin
        return np.all((angles >= lower) & (angles <= upper), axis=-1)

    def shared_range(self, joints: list[int]) -> tuple[float, float]:
        """Range of an angle [rad] that is the position of several joints and keeps the margin in each."""
        return (
            float(self._lower[joints].max()) + self._margin,
            float(self._upper[joints].min()) - self._margin,
        )

    def reaches(self, points: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether points (..., 2) [m] lie in radius_range, at least margin [m] from its ends."""
        radii = np.linalg.norm(np.asarray(points, dtype=float), axis=-1)
        return (radii >= self.radius_range[0] + margin) & (radii <= self.radius_range[1] - margin)

    def radial(self, radii: ArrayLike) -> RadialArm:
        """Joints 2, 4 and 6 [rad] and their derivatives by the radius [rad/m, rad/m²] for radii (K,) [m].

        Raises:
            InfeasibleError: a radius is out of reach.
        """
        radii = np.ascontiguousarray(radii, dtype=float)
        out, bad = radial_arms(radii, self._wrist_height)
        if bad >= 0:
            raise InfeasibleError(self._reach_message(radii[bad]))
        return RadialArm(out[:, 0], out[:, 1], out[:, 2])

    def motion(
        self,
        points: NDArray,
        velocities: NDArray,
        accelerations: NDArray,
        *,
        orders: int = 3,
        tool_yaw: float = 0.0,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Joint positions, velocities and accelerations, each (K, 7), of a motion of the tool's axis.

        Args:
            points: positions [m], shape (K, 2), contiguous.
            velocities: velocities [m/s], shape (K, 2).
            accelerations: accelerations [m/s²], shape (K, 2).
            orders: how many of the three are filled; the others are zero.
            tool_yaw: constant position of joint 7 [rad].

        Raises:
            InfeasibleError: a point is out of reach; joint limits are not checked.
        """
        q, qd, qdd, bad = plane_to_joints(
            points, velocities, accelerations, self._wrist_height, tool_yaw, orders
        )
        if bad >= 0:
            raise InfeasibleError(self._reach_message(float(np.linalg.norm(points[bad]))))
        return q, qd, qdd

    def _reach_message(self, radius: float) -> str:
        usable = getattr(self, "radius_range", None)
        hint = f"; usable radii: {usable[0]:.3f} to {usable[1]:.3f} m" if usable else ""
        return f"{self._name} cannot reach {radius:.3f} m from the base axis at height {self._height} m{hint}"
