"""What is searched: coordinates of the end effectors in the plane, or joint positions."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.planning.belief_space.config import JointSpaceConfig, RobustPushingConfig
from vpsto_ros.priors.contact import Factor, contact_factor, joint_contact_factor
from vpsto_ros.robot.kinematics import TIP_NAMES
from vpsto_ros.robot.tool_plane import ToolPlane
from vpsto_ros.trajectory import Limits


class SearchSpace(Protocol):
    """Coordinates that are searched, and how they move the end effectors.

    Attributes:
        limits: velocity and acceleration limits of the coordinates, position limits if there are any.
        weights: diagonal of R of the smoothness prior, shape (n,).
        spread: mean standard deviation of the smoothness prior.
    """

    limits: Limits
    weights: NDArray
    spread: float

    def plane(self, positions: NDArray) -> tuple[NDArray, NDArray | None]:
        """Plane coordinates (B, K, m) of positions (B, K, n), and the tools' heights (B, K, E) if any."""

    def factor(self, n_points: int, mean: NDArray, covariance: NDArray, present: NDArray) -> Factor:
        """The contact prior over plane coordinates (m,) as a factor; the coordinates are `present` now."""


class PlaneSpace:
    """Plane coordinates of the end effectors: 4 for two discs."""

    def __init__(self, effectors: EndEffectors, config: RobustPushingConfig) -> None:
        velocity = np.full(effectors.dof, config.speed)
        acceleration = np.full(effectors.dof, config.acceleration)
        self.weights = np.ones(effectors.dof)
        for column, turns in zip(effectors.columns, effectors.rows[:, 5] > 0.0, strict=True):
            if turns:
                velocity[column + 2] = config.turn_speed
                acceleration[column + 2] = config.turn_acceleration
                self.weights[column + 2] = (config.contact_std / config.contact_yaw_std) ** 2
        self.limits, self.spread = Limits(velocity, acceleration), config.smoothness_spread

    def plane(self, positions: NDArray) -> tuple[NDArray, None]:
        """The coordinates themselves."""
        return positions, None

    def factor(self, n_points: int, mean: NDArray, covariance: NDArray, present: NDArray) -> Factor:
        """Eq. (6.39) in precision form."""
        return contact_factor(n_points, len(mean), n_points - 1, mean, covariance)


class JointSpace:
    """Joint positions of the arms that carry the end effectors: 14 for two arms (6.4.2, "in joint space").

    Attributes:
        tools: kinematics of the tools over the plane.
        height_tolerance: largest deviation of a tool from its height [m].
        limits: position limits of the arms; velocity and acceleration limits of slow pushing.
        weights: all joints alike.
        spread: mean standard deviation of the smoothness prior [rad].
    """

    # In the contact prior: how exactly tools keep their height, and stay upright.
    HEIGHT_STD = 0.001
    TILT_STD = 0.05

    def __init__(self, tools: ToolPlane, config: JointSpaceConfig | None = None) -> None:
        """Arms that carry tools, and options, the usual ones if None."""
        config, robot = config or JointSpaceConfig(), tools.robot.limits
        self.tools, self.height, self.height_tolerance = tools, tools.height, config.height_tolerance
        self.limits = Limits(
            np.minimum(robot.velocity, config.speed),
            np.minimum(robot.acceleration, config.acceleration),
            robot.lower,
            robot.upper,
        )
        self.weights, self.spread = np.ones(robot.dof), config.spread

    def plane(self, positions: NDArray) -> tuple[NDArray, NDArray]:
        """Forward kinematics of all samples in one pass."""
        tips = self.tools.tips(positions)
        planar = np.ascontiguousarray(tips[..., :2]).reshape(*tips.shape[:-2], -1)
        return planar, np.ascontiguousarray(tips[..., 2])

    def factor(self, n_points: int, mean: NDArray, covariance: NDArray, present: NDArray) -> Factor:
        """The contact prior (6.41)-(6.43), and for every point that tools keep their height and stay upright.

        Postures by inverse kinematics on the straight way to the contact are where it is linearised. Of a
        way that is partly out of reach, what is left is the part within.

        Raises:
            InfeasibleError: all of the way to the contact is out of reach for an arm.
        """
        begin, mean = self._within_reach(present, mean)
        shares = np.arange(1, n_points + 1)[:, None] / n_points
        postures = self.tools.joints(begin + shares * (mean - begin))
        size = n_points * self.limits.dof
        precision, information = np.zeros((size, size)), np.zeros(size)
        for point, joints in enumerate(postures):
            along, upright = self._jacobians(joints)
            spread, zero = self._upright_covariance(), np.zeros(len(upright))
            factors = [joint_contact_factor(n_points, point, joints, upright, zero, zero, spread)]
            if point == n_points - 1:
                factors.append(joint_contact_factor(n_points, point, joints, along, mean, mean, covariance))
            for more_precision, more_information in factors:
                precision, information = precision + more_precision, information + more_information
        return precision, information

    def _within_reach(self, begin: NDArray, end: NDArray) -> tuple[NDArray, NDArray]:
        """The first part of a straight way (m,) to (m,) that upright tools reach, all of it if none."""
        way = begin + np.linspace(0.0, 1.0, 21)[:, None] * (end - begin)
        inside = self.tools.contains(way)
        if inside.all() or not inside.any():
            return begin, end
        first = int(np.argmax(inside))
        outside = np.flatnonzero(~inside[first:])
        return way[first], way[first + outside[0] - 1] if outside.size else end

    def _jacobians(self, joints: NDArray) -> tuple[NDArray, NDArray]:
        """Derivatives of the plane coordinates (m, n), and of heights and tilts of all tools (4 E, n)."""
        full = [self.tools.robot.jacobian(joints, tip) for tip in _tip_names(self.tools)]
        return np.vstack([j[:2] for j in full]), np.vstack([j[2:] for j in full])

    def _upright_covariance(self) -> NDArray:
        std = [self.HEIGHT_STD, *[self.TILT_STD] * 3] * len(_tip_names(self.tools))
        return np.diag(np.square(std))


def _tip_names(tools: ToolPlane) -> tuple[str | None, ...]:
    return TIP_NAMES if tools.robot.dof == 14 else (None,)
