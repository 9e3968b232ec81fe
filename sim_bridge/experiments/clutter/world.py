"""The cluttered plane of Figs. 4.4 and 4.5: a point among three polygons."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.collision.planar import PlanarWorld
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory import Limits

_L = ((0.1019, 0.3161), (0.1561, 0.1997), (0.1045, 0.127), (0.2262, 0.1204), (0.1892, 0.2751))
_T = ((0.2288, 0.4008), (0.2447, 0.3452), (0.3122, 0.3532), (0.3135, 0.4087), (0.2646, 0.4352))
_R = ((0.3545, 0.2407), (0.3519, 0.1204), (0.3796, 0.0992), (0.4087, 0.1164), (0.418, 0.2103))

CLUTTER = PlanarWorld(
    lower=np.zeros(2),
    upper=np.full(2, 0.5),
    polygons=(np.array(_L), np.array(_T), np.array(_R)),
    names=("L", "T", "R"),
)
"""Bounds and obstacles [m]; the obstacles are named after left, top and right."""

LIMITS = Limits(
    velocity=np.full(2, 0.1), acceleration=np.full(2, 0.5), lower=CLUTTER.lower, upper=CLUTTER.upper
)
"""Of every axis: 0.1 m/s, 0.5 m/s^2, and the bounds of the world."""

STARTS = {"start_0.10_0.20": np.array([0.1, 0.2]), "start_0.05_0.20": np.array([0.05, 0.2])}
"""Where the motion starts from rest [m], by the name used in results."""

GOAL = np.array([0.4, 0.3])
"""Where it ends at rest [m]."""


def homotopy_class(positions: NDArray[np.float64]) -> str:
    """The obstacles that a path passes above, in the order L, T, R: "LR", "R", "LTR", .. (Fig. 4.4).

    A path passes above an obstacle if it crosses the vertical line through the middle of the obstacle more
    often above it than below, counted with direction. Paths that can be deformed into each other without
    crossing an obstacle have the same letters.

    Args:
        positions: samples along the path, shape (K, 2) [m], close enough that no crossing is missed.

    Returns:
        The letters, "-" if it passes above none.

    Raises:
        InvalidInputError: the shape does not fit.
    """
    path = np.asarray(positions, dtype=np.float64)
    if path.ndim != 2 or path.shape[1] != 2 or len(path) < 2 or not np.isfinite(path).all():
        raise InvalidInputError(f"a path must be finite with shape (K, 2), got {path.shape}")
    above = [
        name
        for name, polygon in zip(CLUTTER.names, CLUTTER.polygons, strict=True)
        if _crossings_above(path, polygon.mean(axis=0)) > 0
    ]
    return "".join(above) or "-"


def _crossings_above(path: NDArray, middle: NDArray) -> int:
    """Crossings of the ray upwards from a point, to the right minus to the left."""
    right = path[:, 0] > middle[0]
    steps = np.flatnonzero(right[1:] != right[:-1])
    start, end = path[steps], path[steps + 1]
    part = (middle[0] - start[:, 0]) / (end[:, 0] - start[:, 0])
    above = start[:, 1] + part * (end[:, 1] - start[:, 1]) > middle[1]
    return int(np.where(right[steps + 1], 1, -1)[above].sum())


def _deepest(world: PlanarWorld, polygon: NDArray) -> NDArray:
    """The point inside a polygon that is furthest from its border, about: the mean may be near a notch."""
    sides = np.linspace(polygon.min(axis=0), polygon.max(axis=0), 25).T
    points = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    alone = PlanarWorld(lower=world.lower, upper=world.upper, polygons=(polygon,))
    off_centre = np.linalg.norm(points - polygon.mean(axis=0), axis=1)
    return points[np.argmin(alone.clearance(points) + 0.05 * off_centre)]


def draw_world(axes: Any, world: PlanarWorld = CLUTTER, time: float = 0.0) -> None:
    """Draw obstacles, discs as they are at a time [s], and bounds into matplotlib axes."""
    from matplotlib.patches import Circle

    for name, polygon in zip(world.names, world.polygons, strict=True):
        axes.fill(*polygon.T, facecolor="0.8", edgecolor="0.5", lw=0.8, zorder=1)
        axes.text(*_deepest(world, polygon), name, ha="center", va="center", color="0.35", zorder=1)
    for disc in world.discs:
        axes.add_patch(Circle(tuple(disc.position(time)), disc.radius, facecolor="0.6", zorder=1))
    axes.set(
        xlim=(world.lower[0], world.upper[0]), ylim=(world.lower[1], world.upper[1]),
        xlabel="x [m]", ylabel="y [m]", aspect="equal",
    )  # fmt: skip
