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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.collision import planar_kernels as kernels
from vpsto_ros.collision.planar_polygons import bands, checked_polygon, edge_rows
from vpsto_ros.collision.planar_roots import from_powers
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory import Trajectory, TrajectoryBatch


@dataclasses.dataclass(frozen=True, eq=False)
class MovingDisc:
    """A disc in uniform motion.

    Args:
        centre: position at time 0 of the clock that trajectories use, shape (2,) [m].
        radius: [m], positive.
        velocity: shape (2,) [m/s].

    Raises:
        InvalidInputError: an argument is not finite, has the wrong shape, or the radius is not positive.
    """

    centre: NDArray[np.float64]
    radius: float
    velocity: NDArray[np.float64] = (0.0, 0.0)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", _vector("disc: centre", self.centre))
        object.__setattr__(self, "velocity", _vector("disc: velocity", self.velocity))
        object.__setattr__(self, "radius", _positive_number("disc: radius", self.radius))

    def position(self, time: float) -> NDArray[np.float64]:
        """Centre at a time [s], shape (2,) [m]."""
        return self.centre + time * self.velocity

    def at(self, time: float) -> "MovingDisc":
        """The disc as a clock sees it that starts at this time [s]."""
        return MovingDisc(self.position(time), self.radius, self.velocity)


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
        lower = _vector("world: lower", self.lower, finite=False)
        upper = _vector("world: upper", self.upper, finite=False)
        if not np.all(lower < upper):
            raise InvalidInputError(f"world: lower must be below upper, got {lower} and {upper}")
        names = tuple(self.names) or tuple(f"polygon {i + 1}" for i in range(len(self.polygons)))
        if len(names) != len(self.polygons):
            raise InvalidInputError(f"world: {len(names)} names for {len(self.polygons)} polygons")
        polygons = tuple(
            checked_polygon(polygon, name) for polygon, name in zip(self.polygons, names, strict=True)
        )
        if not all(isinstance(disc, MovingDisc) for disc in self.discs):
            raise InvalidInputError(f"world: discs must be MovingDisc objects, got {self.discs!r}")
        values = {"lower": lower, "upper": upper, "polygons": polygons, "names": names}
        for name, value in {**values, "discs": tuple(self.discs)}.items():
            object.__setattr__(self, name, value)

    @functools.cached_property
    def packed(self) -> kernels.PackedWorld:
        """The world as compiled kernels take it."""
        corners = [len(polygon) for polygon in self.polygons]
        boxes = [np.concatenate([p.min(axis=0), p.max(axis=0)]) for p in self.polygons]
        return kernels.PackedWorld(
            edge_rows(self.polygons),
            np.concatenate([[0], np.cumsum(corners)]).astype(np.int64),
            np.array(boxes).reshape(-1, 4),
            _disc_rows(self.discs),
            np.concatenate([self.lower, self.upper]),
        )

    def at(self, time: float) -> "PlanarWorld":
        """The world as a clock sees it that starts at this time [s]: every disc has moved on."""
        return self.with_discs(tuple(disc.at(time) for disc in self.discs))

    def with_discs(self, discs: tuple[MovingDisc, ...]) -> "PlanarWorld":
        """The same walls and polygons with other discs; cheap enough for every step of a control loop."""
        world = copy.copy(self)
        object.__setattr__(world, "discs", tuple(discs))
        world.__dict__["packed"] = self.packed._replace(discs=_disc_rows(discs))
        return world

    def inflated(self, radius: float) -> "PlanarWorld":
        """The world as the centre of a round robot sees it, shape exact; obstacles overlap in the result.

        Raises:
            InvalidInputError: the radius is negative or not finite, or the robot does not fit into the box.
        """
        if not (np.isfinite(radius) and radius >= 0.0):
            raise InvalidInputError(f"the radius to inflate by must be finite and not negative, got {radius}")
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
        flat, clock, shape = _points_and_times(points, times)
        return kernels.inside_any(self.packed, flat, clock).reshape(shape)

    def clearance(self, points: ArrayLike, times: ArrayLike | None = None) -> NDArray[np.float64]:
        """Distance to the nearest obstacle or wall, shape (...) [m]; inside one minus the way out of it.

        Arguments as for :meth:`inside`. Where obstacles overlap, the largest depth in one of them counts.
        """
        flat, clock, shape = _points_and_times(points, times)
        return kernels.clearances(self.packed, flat, clock).reshape(shape)

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
            InvalidInputError: the trajectories do not have two degrees of freedom.
        """
        if batch.key_positions.shape[2] != 2:
            raise InvalidInputError(
                f"a planar world takes 2 degrees of freedom, not {batch.key_positions.shape[2]}"
            )
        seconds = kernels.times_in_collision(
            self.packed, batch.knots, batch.key_positions, batch.knot_slopes, batch.duration, start_time
        )
        return seconds, seconds == 0.0

    def stays(self, trajectory: Trajectory) -> list[Stay]:
        """All parts of a trajectory inside an obstacle, by start; the clock of the discs is its own.

        Raises:
            InvalidInputError: the trajectory does not have two degrees of freedom.
        """
        if trajectory.dof != 2:
            raise InvalidInputError(f"a planar world takes 2 degrees of freedom, not {trajectory.dof}")
        sizes = np.diff(trajectory.times)[:, None, None]
        powers = trajectory.coefficients * sizes ** np.arange(trajectory.coefficients.shape[1])[:, None]
        rows = kernels.stays(self.packed, from_powers(powers), trajectory.times)
        names = [*self.names, *(f"disc {i + 1}" for i in range(len(self.discs))), "the walls"]
        return sorted((Stay(names[o], start, end) for o, start, end in rows), key=lambda stay: stay.start)

    def first_contact(self, trajectory: Trajectory) -> float | None:
        """First instant in collision on the trajectory's own clock [s], or None; exact for every instant."""
        stays = self.stays(trajectory)
        return stays[0].start if stays else None

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

    def term(self, weight: float = 100.0, start_time: float = 0.0) -> "CollisionTerm":
        """The constraint to stay out of collision, for the terms of a problem."""
        return CollisionTerm(self, weight, start_time)


@dataclasses.dataclass(frozen=True, eq=False)
class CollisionTerm:
    """A world as a cost term: the weight times the time in collision, and validity.

    Attributes:
        world: what to stay out of.
        weight: cost of a second in collision; well above the cost of a second of motion [1/s].
        start_time: when trajectories start, on the clock of the discs [s].

    Raises:
        InvalidInputError: the weight is not positive, or a number is not finite.
    """

    world: PlanarWorld
    weight: float = 100.0
    start_time: float = 0.0

    def __post_init__(self) -> None:
        _positive_number("collision term: weight", self.weight)
        if not np.isfinite(self.start_time):
            raise InvalidInputError(f"collision term: start time must be finite, got {self.start_time!r}")

    @property
    def static(self) -> bool:
        """Whether no obstacle moves, so that a goal in collision stays one."""
        return not any(disc.velocity.any() for disc in self.world.discs)

    def __call__(self, batch: TrajectoryBatch) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Cost (B,) and validity (B,) of trajectories."""
        seconds, valid = self.world.time_in_collision(batch, self.start_time)
        return self.weight * seconds, valid

    def explain(self, trajectory: Trajectory) -> list[str]:
        """What a trajectory collides with, in words; its start counts as the start time of this term."""
        moved = trajectory.shifted(self.start_time - trajectory.start_time)
        return self.world.explain(moved)


def _disc_rows(discs: tuple[MovingDisc, ...]) -> NDArray[np.float64]:
    rows = [(*disc.centre, *disc.velocity, disc.radius) for disc in discs]
    return np.array(rows, dtype=np.float64).reshape(-1, 5)


def _vector(name: str, value: ArrayLike, finite: bool = True) -> NDArray[np.float64]:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{name} must be two numbers, got {value!r}") from error
    if array.shape != (2,) or not np.all(np.isfinite(array) if finite else ~np.isnan(array)):
        raise InvalidInputError(f"{name} must be two {'finite ' if finite else ''}numbers, got {value!r}")
    array.setflags(write=False)
    return array


def _positive_number(name: str, value: Any) -> float:
    if isinstance(value, (int, float, np.number)) and np.isfinite(value) and value > 0:
        return float(value)
    raise InvalidInputError(f"{name} must be finite and positive, got {value!r}")


def _points_and_times(
    points: ArrayLike, times: Any
) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[int, ...]]:
    """Points (K, 2) and times (K,), contiguous, and the shape of the answer."""
    array = np.asarray(points, dtype=np.float64)
    if array.ndim < 1 or array.shape[-1] != 2 or not np.isfinite(array).all():
        raise InvalidInputError(f"points must be finite with shape (..., 2), got {np.shape(points)}")
    shape = array.shape[:-1]
    try:
        clock = np.broadcast_to(np.asarray(0.0 if times is None else times, dtype=np.float64), shape)
    except ValueError as error:
        raise InvalidInputError(
            f"times of shape {np.shape(times)} do not fit points of shape {array.shape}"
        ) from error
    if not np.isfinite(clock).all():
        raise InvalidInputError("times must be finite")
    return np.ascontiguousarray(array.reshape(-1, 2)), np.ascontiguousarray(clock.reshape(-1)), shape
