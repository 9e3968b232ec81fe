"""The contact planner for pushing: where to touch the object next, as a Gaussian over tool positions.

The thesis lets every trajectory end at the box centre, so that all candidates make contact, and leaves the
point of contact to the search
(4.5.2). Telling the search where touching pays makes that unnecessary: the distribution found here seeds its
candidates and enters its
prior as a Gaussian over one via-point.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.contact.pushing import PushingModel
from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.planning.goal import PlanarGoal
from vpsto_ros.planning.pushes import PushRanking, StraightPushes, way_length


@documented
@dataclasses.dataclass(frozen=True)
class ContactPlannerConfig:
    """Options of the contact planner."""

    speed: float = option(0.3, "speed at which the object is touched", unit="m/s", minimum=0.01, maximum=1.0)
    error_cost: float = option(
        60.0, "seconds that one metre of remaining error is worth", unit="s/m", minimum=0.0, maximum=1e4
    )
    rotation_cost: float = option(
        0.5,
        "seconds that one radian of rotation is worth if the goal has no orientation",
        unit="s/rad",
        minimum=0.0,
        maximum=1e3,
    )
    contacts: int = option(40, "touch points tried along the outline", minimum=8, maximum=400)
    temperature: float = option(
        0.3, "cost above the best at which a touch point still counts", unit="s", minimum=1e-3, maximum=10.0
    )
    minimum_std: float = option(
        0.008, "smallest standard deviation of the touch point", unit="m", minimum=1e-4, maximum=0.2
    )
    neighbourhood: float = option(
        0.05, "touch points farther from the best one do not count", unit="m", minimum=0.0, maximum=1.0
    )

    def __post_init__(self) -> None:
        validate(self)


@dataclasses.dataclass(frozen=True)
class ContactPlan:
    """Where, how fast and when to touch.

    Attributes:
        stamp: time at which the tool can be there [s].
        position: mean of the tool centre at the touch, shape (2,) [m], base frame.
        velocity: tool velocity of the push, shape (2,) [m/s].
        covariance: covariance of the position, shape (2, 2) [m^2].
    """

    stamp: float
    position: NDArray
    velocity: NDArray
    covariance: NDArray

    def __post_init__(self) -> None:
        shapes = (np.shape(self.position), np.shape(self.velocity), np.shape(self.covariance))
        if shapes != ((2,), (2,), (2, 2)):
            raise InvalidInputError(f"a contact plan needs shapes (2,), (2,) and (2, 2), got {shapes}")
        values = np.concatenate([self.position, self.velocity, np.ravel(self.covariance), [self.stamp]])
        if not np.isfinite(values).all() or np.linalg.eigvalsh(self.covariance).min() <= 0.0:
            raise InvalidInputError("a contact plan needs finite values and a positive definite covariance")


class PushContactPlanner:
    """Ranks straight pushes and summarises the good ones as a Gaussian."""

    def __init__(self, config: ContactPlannerConfig, model: PushingModel) -> None:
        self.config = config
        self.model = model
        self.ranking = PushRanking(config.speed, config.error_cost, config.rotation_cost, config.contacts)

    def plan(self, now: float, tool: NDArray, object_state: ObjectState, goal: PlanarGoal) -> ContactPlan:
        """Where to touch, given the present tool position and object state.

        Args:
            now: present time [s].
            tool: tool position in the plane, shape (2,) [m].
            object_state: estimate of the object.
            goal: where the object shall go.
        """
        pushes = self.ranking.rank(self.model, object_state.pose, goal, tool)
        return self.summarise(now, tool, object_state.pose, pushes)

    def summarise(self, now: float, tool: NDArray, pose: NDArray, pushes: StraightPushes) -> ContactPlan:
        """Weighted covariance of the pushes that are nearly as good as the best one and touch near it."""
        best, config = pushes.touch[0], self.config
        offset = pushes.touch - best
        near = np.linalg.norm(offset, axis=1) <= config.neighbourhood
        weight = np.where(near, np.exp(-(pushes.cost - pushes.cost[0]) / config.temperature), 0.0)
        spread = np.einsum("s,si,sj->ij", weight / weight.sum(), offset, offset)
        push = pushes.end[0] - best
        length = np.hypot(*push)
        velocity = config.speed * push / length if length > 1e-9 else np.zeros(2)
        radius = self.model.shape.bounding_radius + self.model.tool.bounding_radius
        travel = float(way_length(tool, best[None], pose[:2], radius)[0])
        return ContactPlan(
            now + travel / config.speed, best, velocity, spread + config.minimum_std**2 * np.eye(2)
        )
