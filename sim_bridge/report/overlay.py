"""What the nodes draw for RViz and Foxglove, drawn over the cell as well: plans, beliefs, predictions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

LINE_STRIP, LINE_LIST, SPHERE_LIST, TEXT = 4, 5, 7, 9
"""Types of visualization_msgs/Marker that are understood."""
MARKERS = {
    "/state_estimator/markers": ("object_belief",),
    "/contact_planner/markers": (
        "touch", "contact_prior", "puck_path", "shot_path", "shot_spread", "stroke", "shot",
    ),
    "/mpc_planner/markers": ("planned_tool_path", "predicted_object_path", "predicted_spread"),
}  # fmt: skip
"""What is drawn of each topic."""
ON_TOP = ("object_belief", "predicted_object_path", "predicted_spread")
"""These would be hidden below the object: they are drawn at its height."""
_LIFT = 0.009  # lines lie so much higher than their markers, clear of the table [m]


@dataclass(frozen=True, eq=False)
class Overlay:
    """Lines or points in one colour, or a text.

    Attributes:
        name: of the marker.
        points: ends of the segments, shape (S, 2, 3), or points, shape (N, 3) [m]; where a text is, (1, 3).
        colour: red, green, blue from 0 to 1.
        width: of lines, or diameter of points [m].
        text: empty for lines and points.
    """

    name: str
    points: NDArray[np.float64]
    colour: tuple[float, float, float]
    width: float
    text: str = ""

    @property
    def lines(self) -> bool:
        """Whether it is made of segments."""
        return self.points.ndim == 3


def overlays_of(markers: Iterable[Any], wanted: Sequence[str], height: float) -> tuple[Overlay, ...]:
    """The markers of some names, as far as they are shown.

    Args:
        markers: of a visualization_msgs/MarkerArray.
        wanted: names (the namespace of a marker).
        height: of the object [m].
    """
    found = []
    for marker in markers:
        if marker.ns not in wanted or marker.action != 0:
            continue
        if marker.type == TEXT:
            found.append(_text(marker))
        if not len(marker.points):
            continue
        points = np.array([(p.x, p.y, p.z) for p in marker.points], dtype=float)
        points[:, 2] += _LIFT + (height if marker.ns in ON_TOP else 0.0)
        if marker.type == LINE_STRIP:
            points = np.stack([points[:-1], points[1:]], axis=1)
        elif marker.type == LINE_LIST:
            points = points.reshape(-1, 2, 3)
        elif marker.type != SPHERE_LIST:
            continue
        colour = marker.color
        found.append(Overlay(marker.ns, points, (colour.r, colour.g, colour.b), marker.scale.x))
    return tuple(found)


def _text(marker: Any) -> Overlay:
    place, colour = marker.pose.position, marker.color
    point = np.array([[place.x, place.y, place.z]], dtype=float)
    return Overlay(marker.ns, point, (colour.r, colour.g, colour.b), marker.scale.z, marker.text)
