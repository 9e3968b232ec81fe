"""Where end effectors should touch an object to push it somewhere: f_c of eq. (6.37), goal-aware.

The thesis asks for contact only. Telling the prior on which side of the object contact helps makes it find
plans in the plant that hold where the plain one's do not.
"""

import dataclasses
import itertools
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import Disc, PlanarShape
from vpsto_ros.planning.belief_space.config import RobustContactConfig
from vpsto_ros.robot.bimanual_plane import CROSSED_OFFSET, LARGEST_CROSSING


@dataclasses.dataclass(frozen=True)
class CrossingRule:
    """Keeps two arms clear of each other, seen from above: the first end effector belongs to the left arm.

    Where it is to the right of the other one (smaller y), the arms need room to pass each other along x, and
    beyond a certain crossing they cannot: the rule of `BimanualPlane.arms_apart`.

    Attributes:
        offset: smallest distance along x between crossed end effectors [m].
        crossing: how far the left one may be to the right of the right one [m].
    """

    offset: float = CROSSED_OFFSET
    crossing: float = LARGEST_CROSSING

    def allows(self, left: NDArray, right: NDArray) -> bool:
        """Whether the end effectors may be at two positions (2,)."""
        ahead, aside = abs(left[0] - right[0]), left[1] - right[1]
        return aside >= 0.0 or bool(ahead >= self.offset and aside >= -self.crossing)


@dataclasses.dataclass(frozen=True)
class ContactRule:
    """Places end effectors behind an object as seen from where it shall go.

    Attributes:
        effectors: what touches.
        shape: the object.
        angle: discs are spread evenly within +- angle behind the object [rad].
        advance: how far ahead of touching [m].
        crossing: keeps the arms of two end effectors apart, None if there is nothing to keep apart.
    """

    effectors: EndEffectors
    shape: PlanarShape
    angle: float
    advance: float
    crossing: CrossingRule | None = None

    @classmethod
    def of(
        cls,
        config: RobustContactConfig,
        effectors: EndEffectors,
        shape: PlanarShape,
        *,
        two_arms: bool = False,
    ) -> "ContactRule":
        """The rule that options mean; end effectors on two arms may not cross."""
        crossing = CrossingRule() if two_arms else None
        return cls(effectors, shape, config.contact_angle, config.contact_advance, crossing)

    def configuration(self, pose: ArrayLike, direction: ArrayLike, present: ArrayLike) -> NDArray[np.float64]:
        """f_c: plane coordinates (m,) from which to push an object at a pose (3,) along a direction (2,).

        Which end effector goes where is decided by the way from its present place (m,) and by which arms
        would cross.
        """
        pose, along = np.asarray(pose, dtype=float), np.asarray(direction, dtype=float)
        present = np.asarray(present, dtype=float)
        discs = [isinstance(shape, Disc) for shape in self.effectors.shapes]
        if not all(discs):
            return self._rectangles(pose, along, present)
        effectors, angles = range(self.effectors.count), self._angles()
        # Places by slot and end effector: (slots, E, 2).
        places = np.array([[self._slot(pose, along, a, e) for e in effectors] for a in angles])
        orders = [list(order) for order in itertools.permutations(effectors)]
        candidates = [places[order, effectors] for order in orders]
        ways = [self._way(candidate, present.reshape(-1, 2)) for candidate in candidates]
        return candidates[int(np.argmin(ways))].ravel()

    def jacobian(self) -> NDArray[np.float64]:
        """A of eq. (6.38): all end effectors move along with the object, shape (m, 2)."""
        a = np.zeros((self.effectors.dof, 2))
        for column in self.effectors.columns:
            a[column, 0] = a[column + 1, 1] = 1.0
        return a

    def _way(self, places: NDArray, present: NDArray) -> float:
        """Way of all end effectors to their places (E, 2) [m], much longer where arms would cross there."""
        way = float(np.linalg.norm(places - present, axis=1).sum())
        crossed = self.crossing is not None and len(places) > 1 and not self.crossing.allows(*places[:2])
        return way + 10.0 if crossed else way

    def _angles(self) -> NDArray:
        count = self.effectors.count
        return np.zeros(1) if count == 1 else np.linspace(-self.angle, self.angle, count)

    def _slot(self, pose: NDArray, along: NDArray, angle: float, e: int) -> NDArray:
        c, s = math.cos(angle), math.sin(angle)
        back = -np.array([c * along[0] - s * along[1], s * along[0] + c * along[1]])
        shape = self.effectors.shapes[e]
        assert isinstance(shape, Disc)
        return pose[:2] + (self._extent(pose, back) + shape.radius) * back + self.advance * along

    def _rectangles(self, pose: NDArray, along: NDArray, present: NDArray) -> NDArray:
        """The long side of a rectangle behind the object, turned the shorter way; discs as if alone."""
        found = np.empty(self.effectors.dof)
        for e, (shape, column) in enumerate(zip(self.effectors.shapes, self.effectors.columns, strict=True)):
            if isinstance(shape, Disc):
                found[column : column + 2] = self._slot(pose, along, 0.0, e)
                continue
            long_along_x = shape.half_size[0] >= shape.half_size[1]
            reach = self._extent(pose, -along) + min(shape.half_size) - self.advance
            yaw = math.atan2(along[1], along[0]) - (0.5 * math.pi if long_along_x else 0.0)
            turns = round((present[column + 2] - yaw) / math.pi)
            found[column : column + 3] = [*(pose[:2] - reach * along), yaw + turns * math.pi]
        return found

    def _extent(self, pose: NDArray, outward: NDArray) -> float:
        """How far the object reaches from its origin along a direction: its support function [m]."""
        first, *rest = self.shape.primitives
        if isinstance(first, Disc) and not rest and first.center == (0.0, 0.0):
            return first.radius
        return max(float(((corners - pose[:2]) @ outward).max()) for corners in self.shape.transform(pose))
