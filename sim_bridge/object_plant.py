"""The object as it really is: mass, friction, support and the solids it is made of."""

import math
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.contact.geometry import Disc, PlanarShape, Rectangle
from vpsto_ros.exceptions import ConfigurationError


@documented
@dataclass(frozen=True)
class ObjectPlant:
    """The object as it really is.

    Args:
        shape: outline seen from above, in the object frame.
        height: height [m].
        mass: mass [kg].
        table_friction: friction coefficient between object and table.
        tool_friction: friction coefficient between object and rod.
        com_offset: centre of mass relative to the centre of the outline's area [m], object frame.
        support: where the object touches the table: "corners" or "spread" evenly.

    Raises:
        ConfigurationError: naming the field, its value and what is allowed.
    """

    shape: PlanarShape = field(default_factory=lambda: PlanarShape.box(0.12, 0.12))
    height: float = option(0.06, "height of the object", unit="m", minimum=0.03, maximum=0.3)
    mass: float = option(0.5, "mass of the object", unit="kg", minimum=0.01, maximum=10.0)
    table_friction: float = option(0.35, "friction coefficient on the table", minimum=0.01, maximum=2.0)
    tool_friction: float = option(0.25, "friction coefficient against the rod", minimum=0.0, maximum=2.0)
    com_offset: tuple[float, float] = option(
        (0.0, 0.0), "centre of mass relative to the centre of area", unit="m", minimum=-0.1, maximum=0.1
    )
    support: str = option("corners", "where the object touches the table", choices=("corners", "spread"))

    def __post_init__(self) -> None:
        """Check the ranges, and that the centre of mass is above the supported area."""
        validate(self)
        com = self.shape.centroid() + self.com_offset
        if not _inside_hull(self.feet(), com):
            raise ConfigurationError(
                f"ObjectPlant.com_offset = {self.com_offset} puts the centre of mass beyond the feet; the "
                "object would tip over"
            )

    def feet(self) -> NDArray[np.float64]:
        """Where the object touches the table, shape (F, 2) [m], object frame.

        Corners: the corners of the outline (four points on the rim of a disc). Spread: the centre of each
        primitive and four points around it, such that equal loads have the second moments of an evenly
        spread pressure.
        """
        points = [foot for p in self.shape.primitives for foot in _primitive_feet(p, self.support)]
        feet = np.array(points)
        if self.support == "corners" and len(self.shape.primitives) > 1:
            feet = feet[self.shape.signed_distance(feet) > -1e-6]
        return feet[_first_of_each(feet)]


def solids(shape: PlanarShape, height: float):
    """Type, position, size and quaternion of one geom per primitive, standing on the object frame's z = 0."""
    for p in shape.primitives:
        pos = [*p.center, height / 2]
        if isinstance(p, Disc):
            yield mujoco.mjtGeom.mjGEOM_CYLINDER, pos, [p.radius, height / 2, 0.0], [1.0, 0.0, 0.0, 0.0]
        else:
            turn = [math.cos(p.angle / 2), 0.0, 0.0, math.sin(p.angle / 2)]
            yield mujoco.mjtGeom.mjGEOM_BOX, pos, [*p.half_size, height / 2], turn


def _primitive_feet(primitive: Rectangle | Disc, support: str) -> NDArray[np.float64]:
    """Feet under one primitive, in the object frame; see :meth:`ObjectPlant.feet`."""
    signs = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    if isinstance(primitive, Disc):
        half, angle = np.full(2, primitive.radius * math.sqrt(0.5)), 0.0
        # Four fifths of the load at this share of the radius: the second moment of a disc, r²/2.
        share = math.sqrt(5.0 / 8.0)
    else:
        half, angle = np.array(primitive.half_size), primitive.angle
        share = math.sqrt(5.0 / 12.0)  # likewise for a rectangle: half²/3 along each axis
    local = signs * half if support == "corners" else np.vstack([signs * half * share, np.zeros((1, 2))])
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return local @ turn.T + primitive.center


def _first_of_each(points: NDArray) -> list[int]:
    """Indices of points that do not repeat an earlier one."""
    return [i for i, p in enumerate(points) if i == 0 or np.linalg.norm(points[:i] - p, axis=1).min() > 1e-6]


def _inside_hull(points: NDArray, query: NDArray) -> bool:
    """Whether a point is inside the hull of others: seen from it, no gap between them spans 180 degrees."""
    angles = np.sort(np.arctan2(points[:, 1] - query[1], points[:, 0] - query[0]))
    gaps = np.diff(np.append(angles, angles[0] + 2.0 * np.pi))
    return bool(gaps.max() < np.pi - 1e-3)
