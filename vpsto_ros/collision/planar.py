"""A point robot in a plane with polygons and moving discs, checked at every instant and not at samples.

A path of the search is a cubic between two key positions, so its crossings with the line of an edge are the
roots of a cubic, and those with a disc in uniform motion the roots of a polynomial of degree six. Between two
crossings it is inside or outside. A corner clipped between two evaluation points, which the sampled check of
the thesis (4.5.2) overlooks, is found, and the cost is the exact time in collision instead of a count of
points. Time and not phase, because a share of phase shrinks when the path takes a slow detour elsewhere: a
search that pays for phase settles on such a path now and then.
"""

import copy
import dataclasses
import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.collision import planar_kernels, planar_path_kernels
from vpsto_ros.collision.planar_checks import items, number, planar, points_and_times, positive, vector
from vpsto_ros.collision.planar_discs import MovingDisc, checked_discs, disc_rows
from vpsto_ros.collision.planar_polygons import bands, checked_polygon, edge_rows
from vpsto_ros.collision.planar_roots import from_powers
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory import Trajectory, TrajectoryBatch


class Stay(NamedTuple):
    """A part of a trajectory inside an obstacle.

    Attributes:
        obstacle: name of the obstacle.
        start: first instant [s].
        end: last instant [s].
    """

    obstacle: str
    start: float
    end: float


@dataclasses.dataclass(frozen=True, eq=False)
class PlanarWorld:
    """Free space in a plane: a box without polygons and discs. What is beyond the box counts as occupied.

    Touching is allowed: an obstacle, or the space beyond a wall, is entered where a point is more than
    1e-12 m deep in it. Obstacles may overlap.

    Args:
        lower: corner of the box with the lowest coordinates, shape (2,) [m]; may be infinite.
        upper: the opposite corner.
        polygons: corners (V, 2) of each, in order around it, in either sense [m].
        discs: of which each may move.
        names: of the polygons, for messages; "polygon 1", "polygon 2", .. by default.

    Raises:
        InvalidInputError: lower not below upper, a polygon with fewer than three corners, without area or
            with edges that meet, names that do not fit, or numbers that are not finite.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    polygons: tuple[NDArray[np.float64], ...] = ()
    discs: tuple[MovingDisc, ...] = ()
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        lower = vector("world: lower", self.lower, finite=False)
        upper = vector("world: upper", self.upper, finite=False)
        if not np.all(lower < upper):
            raise InvalidInputError(f"world: lower must be below upper, got {lower} and {upper}")
        polygons, names = items("world: polygons", self.polygons), items("world: names", self.names)
        names = names or tuple(f"polygon {i + 1}" for i in range(len(polygons)))
        if len(names) != len(polygons) or not all(isinstance(name, str) for name in names):
            raise InvalidInputError(f"world: {names!r} are not the names of {len(polygons)} polygons")
        polygons = tuple(map(checked_polygon, polygons, names))
        values = {"lower": lower, "upper": upper, "polygons": polygons, "names": names}
        for name, value in {**values, "discs": checked_discs(self.discs)}.items():
            object.__setattr__(self, name, value)

    @functools.cached_property
    def packed(self) -> planar_kernels.PackedWorld:
        """The world as compiled kernels take it."""
        corners = [len(polygon) for polygon in self.polygons]
        boxes = [np.concatenate([p.min(axis=0), p.max(axis=0)]) for p in self.polygons]
        return planar_kernels.PackedWorld(
            edge_rows(self.polygons),
            np.concatenate([[0], np.cumsum(corners)]).astype(np.int64),
            np.array(boxes).reshape(-1, 4),
            disc_rows(self.discs),
            np.concatenate([self.lower, self.upper]),
        )

    def at(self, time: float) -> "PlanarWorld":
        """The world as a clock sees it that starts at this time [s]: every disc has moved on.

        Raises:
            InvalidInputError: the time is not finite.
        """
        return self.with_discs(tuple(disc.at(time) for disc in self.discs))

    def with_discs(self, discs: tuple[MovingDisc, ...]) -> "PlanarWorld":
        """The same walls and polygons with other discs; cheap enough for every step of a control loop.

        Raises:
            InvalidInputError: it is no sequence of discs.
        """
        world = copy.copy(self)
        object.__setattr__(world, "discs", checked_discs(discs))
        world.__dict__["packed"] = self.packed._replace(discs=disc_rows(world.discs))
        return world

    def inflated(self, radius: float) -> "PlanarWorld":
        """The world as the centre of a round robot sees it: all points nearer than `radius` [m] are occupied.

        Exact, for every polygon: a rectangle along each edge and a disc at each corner join the obstacles, so
        they overlap. Those discs come before the moving ones in the result.

        Raises:
            InvalidInputError: the radius is negative or not finite, or the robot does not fit into the box.
        """
        radius = number("the radius to inflate by", radius, least=0.0)
        if radius == 0.0:
            return self
        polygons, names, discs = list(self.polygons), list(self.names), []
        for polygon, name in zip(self.polygons, self.names, strict=True):
            edges = bands(polygon, radius)
            polygons += edges
            names += [f"edge {i + 1} of {name}" for i in range(len(edges))]
            discs += [MovingDisc(corner, radius) for corner in polygon]
        discs += [MovingDisc(d.centre, d.radius + radius, d.velocity) for d in self.discs]
        return PlanarWorld(
            self.lower + radius, self.upper - radius, tuple(polygons), tuple(discs), tuple(names)
        )

    def inside(self, points: ArrayLike, times: ArrayLike | None = None) -> NDArray[np.bool_]:
        """Which points are inside an obstacle or beyond the walls.

        Args:
            points: shape (..., 2) [m].
            times: one for all or one for each point, for the discs [s]; 0 by default.

        Returns:
            bool of shape (...).

        Raises:
            InvalidInputError: a shape does not fit or a number is not finite.
        """
        flat, clock, shape = points_and_times(points, times)
        return planar_kernels.inside_any(self.packed, flat, clock).reshape(shape)

    def clearance(self, points: ArrayLike, times: ArrayLike | None = None) -> NDArray[np.float64]:
        """Distance to the nearest obstacle or wall, shape (...) [m]; inside one minus the way out of it.

        Arguments as for :meth:`inside`. Where obstacles overlap, the largest depth in one of them counts.
        """
        flat, clock, shape = points_and_times(points, times)
        return planar_kernels.clearances(self.packed, flat, clock).reshape(shape)

    def time_in_collision(
        self, batch: TrajectoryBatch, start_time: float = 0.0
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Time that each trajectory spends in collision, exact at every instant.

        Args:
            batch: B trajectories of two degrees of freedom.
            start_time: when they start, on the clock of the discs [s].

        Returns:
            Time (B,) [s], summed over the obstacles and infinite for a trajectory of infinite duration; and
            whether it is zero, shape (B,) bool.

        Raises:
            InvalidInputError: the trajectories do not have two degrees of freedom, or the start time is not
                finite.
        """
        planar(batch.key_positions.shape[2])
        start = number("start time", start_time)
        seconds = planar_path_kernels.times_in_collision(
            self.packed, batch.knots, batch.key_positions, batch.knot_slopes, batch.duration, start
        )
        return seconds, seconds == 0.0

    def stays(self, trajectory: Trajectory) -> list[Stay]:
        """All parts of a trajectory inside an obstacle, by start; the clock of the discs is its own.

        Raises:
            InvalidInputError: the trajectory does not have two degrees of freedom.
        """
        planar(trajectory.dof)
        sizes = np.diff(trajectory.times)[:, None, None]
        powers = trajectory.coefficients * sizes ** np.arange(trajectory.coefficients.shape[1])[:, None]
        rows = planar_path_kernels.stays(self.packed, from_powers(powers), trajectory.times)
        names = [*self.names, *(f"disc {i + 1}" for i in range(len(self.discs))), "the walls"]
        return sorted((Stay(names[o], start, end) for o, start, end in rows), key=lambda stay: stay.start)

    def explain(self, trajectory: Trajectory) -> list[str]:
        """What a trajectory collides with, when and how deep, in words."""
        lines = []
        for stay in self.stays(trajectory):
            times = np.linspace(stay.start, stay.end, 101)
            depth = -float(self.clearance(trajectory(times), times).min())
            always = stay.start <= trajectory.start_time and stay.end >= trajectory.end_time
            when = "all along" if always else f"from {stay.start:.3f} s to {stay.end:.3f} s"
            lines.append(
                f"in collision with {stay.obstacle} {when}, up to {1e3 * max(depth, 0.0):.3g} mm deep"
            )
        return lines

    def term(self, weight: float = 100.0) -> "CollisionTerm":
        """The constraint to stay out of collision, for the terms of a problem.

        Trajectories start as the clock of the discs does; for a later start take the term of :meth:`at`.
        """
        return CollisionTerm(self, weight)


@dataclasses.dataclass(frozen=True, eq=False)
class CollisionTerm:
    """A world as a cost term: the weight times the time in collision, and validity.

    Attributes:
        world: what to stay out of; its clock starts with the trajectories.
        weight: cost of a second in collision; well above the cost of a second of motion [1/s].

    Raises:
        InvalidInputError: the world is none, or the weight is not finite and positive.
    """

    world: PlanarWorld
    weight: float = 100.0

    def __post_init__(self) -> None:
        if not isinstance(self.world, PlanarWorld):
            raise InvalidInputError(f"collision term: world must be a PlanarWorld, got {self.world!r}")
        object.__setattr__(self, "weight", positive("collision term: weight", self.weight))

    @property
    def static(self) -> bool:
        """Whether no obstacle moves, so that a goal in collision stays one."""
        return not any(disc.velocity.any() for disc in self.world.discs)

    def __call__(self, batch: TrajectoryBatch) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Cost (B,) and validity (B,) of trajectories."""
        seconds, valid = self.world.time_in_collision(batch)
        return self.weight * seconds, valid

    def explain(self, trajectory: Trajectory) -> list[str]:
        """What a trajectory collides with, in words; the clock of the discs starts as it does."""
        return self.world.explain(trajectory.shifted(-trajectory.start_time))
