"""Collision checking of the arm: its links and tool as capsules, against a cell of obstacles and each other.

``in_collision`` says yes or no, more than a million times a second; ``distance`` says how far, ``contacts``
which link and which obstacle; ``free_along`` proves a whole motion free, between
samples too; :class:`ArmPathCost` is the term that the search ranks candidates by.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.collision import arm_distance_kernels as distances
from vpsto_ros.collision import arm_kernels as kernels
from vpsto_ros.collision import arm_path_kernels as paths
from vpsto_ros.collision.arm_model import MARGIN_LIMIT, ArmModel, fr3_capsules
from vpsto_ros.collision.cell import cell_arrays
from vpsto_ros.collision.shapes import Box, Capsule, HalfSpace, Shape, Sphere, number
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory import Trajectory

TOLERANCE = 1e-3  # of the proof along a motion [m]


@dataclasses.dataclass(frozen=True)
class Contact:
    """Two bodies and how far they are apart.

    Attributes:
        link: part of the arm, such as "fr3_link5_wrist".
        other: obstacle, or another part of the arm.
        distance: signed [m]: negative by the shortest translation that separates the two.
    """

    link: str
    other: str
    distance: float

    def __str__(self) -> str:
        """In words, in millimetres."""
        if self.distance < 0.0:
            return f"{self.link} is {-1e3 * self.distance:.1f} mm deep in {self.other}"
        return f"{self.link} is {1e3 * self.distance:.1f} mm from {self.other}"


@dataclasses.dataclass(frozen=True)
class PathCheck:
    """Outcome of :meth:`ArmCollision.free_along`.

    Attributes:
        free: whether the distance is proven to stay above the margin at every instant.
        time: the first instant that could not be proven [s], None if free.
        contacts: what is close then, nearest first.
    """

    free: bool
    time: float | None
    contacts: tuple[Contact, ...]


class ArmCollision:
    """The arm in a cell of obstacles; immutable.

    ``pair_names`` are the names (link, other) of all pairs that are looked at.

    Args:
        robot_model: the arm; the FR3 with its pushing rod by default.
        obstacles: any number of named shapes in the frame of the base; without any, only the arm itself is
            checked. The base stands where it is mounted and is not checked against them.
        margin: bodies closer than this count as in collision, links of the arm among themselves too [m]; less
            than 5 cm, because pairs of links that never come that close are left out.
        attached: capsules and spheres fixed to the tool, see :meth:`ArmModel.with_attached`.

    Raises:
        InvalidInputError: an obstacle is no shape, two have the same name, or the margin is out of range.
    """

    def __init__(
        self,
        robot_model: ArmModel | None = None,
        obstacles: Sequence[Shape] = (),
        *,
        margin: float = 0.0,
        attached: Sequence[Capsule | Sphere] = (),
    ) -> None:
        model = fr3_capsules() if robot_model is None else robot_model
        if not isinstance(model, ArmModel):
            raise InvalidInputError(f"expected an ArmModel, got {robot_model!r}")
        self.model = model.with_attached(_sequence("attached", attached))
        self.obstacles = _checked_obstacles(obstacles, self.model.names)
        self.margin = _checked_margin(margin)
        self._arm = self.model.arrays
        self.cell = cell_arrays(self._arm, self.obstacles, self.margin)
        self._whole_cell = cell_arrays(self._arm, self.obstacles, math.inf)
        self._reach = self._arm.radius + self.margin
        self._pair_reach = self._arm.radius[self._arm.pairs].sum(axis=1) + self.margin
        self.pair_names: list[tuple[str, str]] = _named_pairs(self)

    def with_obstacles(self, obstacles: Sequence[Shape]) -> "ArmCollision":
        """The same arm and margin among other obstacles, as when they move; fast enough for every cycle."""
        return ArmCollision(self.model, obstacles, margin=self.margin)

    def with_margin(self, margin: float) -> "ArmCollision":
        """The same arm and obstacles with another margin [m]."""
        return ArmCollision(self.model, self.obstacles, margin=margin)

    def in_collision(self, q: ArrayLike) -> NDArray[np.bool_]:
        """Whether anything is closer than the margin.

        Args:
            q: joint positions [rad], shape (..., 7).

        Returns:
            shape (...).

        Raises:
            InvalidInputError: the last axis is not 7 long, or an entry is not finite.
        """
        rows, shape = _postures(q)
        hit = np.empty(len(rows), dtype=bool)
        kernels.check(self._arm, self.cell, rows, self._reach, self._pair_reach, hit)
        return hit.reshape(shape)

    def distance(self, q: ArrayLike) -> NDArray[np.float64]:
        """Least signed distance [m] over all pairs, shape (...), for joint positions q (..., 7) [rad].

        Negative by the penetration depth of the deepest pair; infinite if there is nothing to meet. Parts of
        the arm that never come near each other are left out.

        Raises:
            InvalidInputError: as :meth:`in_collision`.
        """
        rows, shape = _postures(q)
        found = np.empty(len(rows))
        distances.nearest(self._arm, self._whole_cell, rows, found)
        return found.reshape(shape)

    def contacts(self, q: ArrayLike, *, margin: float | None = None) -> list[Contact]:
        """All pairs closer than a margin [m] (that of the checker by default) at q (7,) [rad], deepest first.

        The margin may be anything here; infinite, for all pairs. Parts of the arm that never come within 5 cm
        of each other are no pair.

        Raises:
            InvalidInputError: as :meth:`in_collision`, or the margin is no number.
        """
        rows, limit = _one_posture(q), self.margin if margin is None else number("margin", margin)
        found = np.empty((1, len(self.pair_names)))
        distances.every_pair(self._arm, self._whole_cell, rows, found)
        order = [int(i) for i in np.argsort(found[0], kind="stable") if found[0, i] < limit]
        return [Contact(*self.pair_names[int(i)], float(found[0, i])) for i in order]

    def require_free(self, q: ArrayLike, name: str) -> None:
        """Refuse a posture in collision.

        Args:
            q: joint positions (7,) [rad].
            name: what the message calls the posture, such as "start".

        Raises:
            InvalidInputError: naming the link, what it meets and how deep.
        """
        found = self.contacts(q)
        if found:
            rule = f" (closer than the margin of {1e3 * self.margin:g} mm)" if self.margin else ""
            raise InvalidInputError(f"{name} is in collision{rule}: " + "; ".join(map(str, found[:5])))

    def free_along(
        self, trajectory: Trajectory, *, margin: float | None = None, tolerance: float = TOLERANCE
    ) -> PathCheck:
        """Prove that a motion keeps its distance at every instant, or find where it may not.

        No sampling: an interval counts as free when the posture in its middle is free with every capsule
        grown by the most it can move within the interval; else it is halved. A motion that stays farther
        than ``margin + 2 * tolerance`` from everything is always proven free; one that comes closer than the
        margin never is.

        Args:
            trajectory: of the 7 joints.
            margin: distance to keep [m], less than 5 cm; that of the checker by default.
            tolerance: motion of the links at which halving stops [m].

        Raises:
            InvalidInputError: the trajectory has another number of joints, or a number is out of range.
        """
        _require_seven(trajectory)
        keep = self.margin if margin is None else _checked_margin(margin)
        if not 1e-6 <= number("tolerance", tolerance) < math.inf:
            raise InvalidInputError(f"tolerance must be finite and at least 1e-6 m, got {tolerance!r}")
        piece, begin, end = paths.first_contact(
            self._arm, self._whole_cell, trajectory.coefficients, np.diff(trajectory.times), keep, tolerance
        )
        if piece < 0:
            return PathCheck(True, None, ())
        time = float(trajectory.times[piece] + 0.5 * (begin + end))
        close = self.contacts(trajectory(time), margin=keep + 2.0 * tolerance)
        return PathCheck(False, time, tuple(close))

    def explain(self, trajectory: Trajectory, *, samples: int = 500) -> list[str]:
        """What a motion collides with, in words: the deepest overlap of every pair and when it happens.

        Args:
            trajectory: of the 7 joints.
            samples: postures that are looked at, at even times; at least 2.

        Raises:
            InvalidInputError: the trajectory has another number of joints, or there are too few samples.
        """
        _require_seven(trajectory)
        if isinstance(samples, bool) or not isinstance(samples, int) or samples < 2:
            raise InvalidInputError(f"samples must be an integer from 2 on, got {samples!r}")
        times = np.linspace(trajectory.start_time, trajectory.end_time, samples)
        found = np.empty((samples, len(self.pair_names)))
        distances.every_pair(self._arm, self._whole_cell, _postures(trajectory(times))[0], found)
        deepest = found.min(axis=0, initial=math.inf)
        return [
            f"{Contact(*self.pair_names[int(n)], float(deepest[n]))} at {times[found[:, n].argmin()]:.3f} s"
            for n in np.argsort(deepest, kind="stable")
            if deepest[n] < self.margin
        ]

    def capsules(self, q: ArrayLike) -> tuple[Capsule, ...]:
        """The parts of the arm at a posture (7,) [rad], in the frame of the base."""
        world = np.empty((len(self.model.names), kernels.ROW))
        row = _one_posture(q)[0]
        kernels.place(self._arm, np.sin(row), np.cos(row), world)
        return tuple(
            Capsule(w[:3], w[:3] + w[3:6], float(radius), name)
            for w, radius, name in zip(world, self._arm.radius, self.model.names, strict=True)
        )


def _named_pairs(checker: ArmCollision) -> list[tuple[str, str]]:
    """Names of all pairs in the order of the kernels."""
    parts, cell = checker.model.names, checker._whole_cell
    kinds = ((HalfSpace, cell.plane_pairs), (Box, cell.box_pairs), (Sphere | Capsule, cell.capsule_pairs))
    named = []
    for kind, pairs in kinds:
        names = [shape.name for shape in checker.obstacles if isinstance(shape, kind)]
        named += [(parts[k], names[i]) for k, i in pairs]
    return named + [(parts[i], parts[k]) for k, i in checker.model.arrays.pairs]


def _checked_obstacles(obstacles: Sequence[Shape], parts: tuple[str, ...]) -> tuple[Shape, ...]:
    names: set[str] = set(parts)
    shapes = _sequence("obstacles", obstacles)
    for shape in shapes:
        if not isinstance(shape, Shape):
            raise InvalidInputError(f"expected a Box, Sphere, Capsule or HalfSpace, got {shape!r}")
        if shape.name in names:
            raise InvalidInputError(f"there are two bodies called '{shape.name}'; give each its own name")
        names.add(shape.name)
    return shapes


def _sequence(name: str, shapes: Sequence) -> tuple:
    try:
        return tuple(shapes)
    except TypeError as error:
        raise InvalidInputError(f"{name} must be a sequence of shapes, got {shapes!r}") from error


def _checked_margin(margin: float) -> float:
    if not 0.0 <= number("margin", margin) < MARGIN_LIMIT:
        raise InvalidInputError(
            f"margin must be from 0 to less than {MARGIN_LIMIT} m, got {margin!r}: pairs of links that never "
            "come that close are left out; to keep more distance from obstacles, make these bigger"
        )
    return float(margin)


def _require_seven(trajectory: Trajectory) -> None:
    if not isinstance(trajectory, Trajectory):
        raise InvalidInputError(f"expected a Trajectory, got {trajectory!r}")
    if trajectory.dof != 7:
        raise InvalidInputError(f"expected a trajectory of 7 joints, got {trajectory.dof}")


def _postures(q: ArrayLike) -> tuple[NDArray[np.float64], tuple[int, ...]]:
    """Rows (M, 7) and the shape in front."""
    try:
        array = None if np.iscomplexobj(q) else np.ascontiguousarray(q, dtype=float)
    except (TypeError, ValueError):
        array = None
    if array is None:
        raise InvalidInputError(f"joint positions must be real numbers of shape (..., 7), got {q!r}")
    if not array.ndim or array.shape[-1] != 7:
        raise InvalidInputError(f"joint positions must have shape (..., 7), got {array.shape}")
    rows = array.reshape(-1, 7)
    if not kernels.all_finite(rows):
        raise InvalidInputError("joint positions must be finite")
    return rows, array.shape[:-1]


def _one_posture(q: ArrayLike) -> NDArray[np.float64]:
    rows, shape = _postures(q)
    if shape:
        raise InvalidInputError(f"expected one posture of shape (7,), got shape {(*shape, 7)}")
    return rows
