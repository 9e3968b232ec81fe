"""Where end effectors should touch an object whose place is uncertain, eq. (6.38), as a plan for others."""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.planning.belief_space.config import RobustContactConfig
from vpsto_ros.planning.belief_space.contacts import ContactRule
from vpsto_ros.planning.belief_space.targets import Target
from vpsto_ros.priors.contact import contact_distribution


@dataclasses.dataclass(frozen=True)
class RobustContactPlan:
    """Where, how fast and when all end effectors touch.

    Attributes:
        stamp: time at which the slowest of them can be there [s].
        mean: of the plane coordinates in contact, shape (m,).
        covariance: of the plane coordinates, shape (m, m).
        velocity: of the push, shape (2,) [m/s].
    """

    stamp: float
    mean: NDArray
    covariance: NDArray
    velocity: NDArray


class RobustContactPlanner:
    """Places end effectors behind a belief as seen from its target."""

    def __init__(self, config: RobustContactConfig, rule: ContactRule) -> None:
        self.config, self.rule = config, rule

    def plan(self, now: float, present: NDArray, belief: ObjectBelief, target: Target) -> RobustContactPlan:
        """Where to touch.

        Args:
            now: present time [s].
            present: plane coordinates of the end effectors, shape (m,).
            belief: over the object.
            target: where it shall go.
        """
        config, rule = self.config, self.rule
        progress = target.advanced(0.0, belief.mean[:2])
        way = target.way(progress)[-1, :2] - belief.mean[:2]
        length = math.hypot(*way)
        along = way / length if length > 1e-6 else np.array([1.0, 0.0])
        mean, covariance = likely_contact(config, rule, belief, present, along)
        ways = rule.effectors.poses(mean)[:, :2] - rule.effectors.poses(present)[:, :2]
        arrival = now + float(np.hypot(*ways.T).max()) / config.speed
        return RobustContactPlan(arrival, mean, covariance, config.speed * along)


def likely_contact(
    config: RobustContactConfig, rule: ContactRule, belief: ObjectBelief, present: NDArray, along: NDArray
) -> tuple[NDArray, NDArray]:
    """Mean (m,) and covariance (m, m) of the plane coordinates in contact, eq. (6.38).

    Args:
        config: how exactly contacts are meant.
        rule: where to touch an object whose place is known.
        belief: over the object.
        present: plane coordinates of the end effectors, shape (m,).
        along: unit vector of the push, shape (2,).
    """
    effectors = rule.effectors
    stds = np.full(effectors.dof, config.contact_std)
    for column, turns in zip(effectors.columns, effectors.rows[:, 5] > 0.0, strict=True):
        if turns:
            stds[column + 2] = config.contact_yaw_std
    contact = rule.configuration(belief.mean, along, present)
    return contact_distribution(contact, rule.jacobian(), belief.covariance, np.diag(stds**2))
