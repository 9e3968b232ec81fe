"""Obstacles in space: boxes, spheres, capsules and half-spaces, each with a name. SI units, base frame."""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.exceptions import InvalidInputError

_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_REAL = int | float | np.integer | np.floating


@dataclasses.dataclass(frozen=True, eq=False)
class Box:
    """A solid cuboid.

    Attributes:
        centre: shape (3,) [m].
        half_size: half of the edge lengths, shape (3,), positive [m].
        rotation: rotation matrix (3, 3); its columns are the directions of the edges.
        name: what messages call it.

    Raises:
        InvalidInputError: a shape or a value makes no sense.
    """

    centre: NDArray[np.float64]
    half_size: NDArray[np.float64]
    rotation: NDArray[np.float64] = dataclasses.field(default_factory=lambda: np.array(_IDENTITY))
    name: str = "box"

    def __post_init__(self) -> None:
        _set(self, centre=_array(self, "centre", (3,)), half_size=_array(self, "half_size", (3,)))
        _set(self, rotation=_array(self, "rotation", (3, 3)))
        if not (self.half_size > 0.0).all():
            raise InvalidInputError(f"{self.name}: half_size must be positive, got {self.half_size}")
        error = np.abs(self.rotation.T @ self.rotation - np.eye(3)).max()
        if error > 1e-9 or np.linalg.det(self.rotation) < 0.0:
            raise InvalidInputError(f"{self.name}: rotation must be a right-handed rotation matrix")


@dataclasses.dataclass(frozen=True, eq=False)
class Sphere:
    """A ball.

    Attributes:
        centre: shape (3,) [m].
        radius: positive [m].
        name: what messages call it.

    Raises:
        InvalidInputError: a shape or a value makes no sense.
    """

    centre: NDArray[np.float64]
    radius: float
    name: str = "sphere"

    def __post_init__(self) -> None:
        _set(self, centre=_array(self, "centre", (3,)), radius=_radius(self))


@dataclasses.dataclass(frozen=True, eq=False)
class Capsule:
    """All points within a radius of a segment.

    Attributes:
        a: one end of the segment, shape (3,) [m].
        b: the other end, shape (3,) [m]; equal ends make a ball.
        radius: positive [m].
        name: what messages call it.

    Raises:
        InvalidInputError: a shape or a value makes no sense.
    """

    a: NDArray[np.float64]
    b: NDArray[np.float64]
    radius: float
    name: str = "capsule"

    def __post_init__(self) -> None:
        _set(self, a=_array(self, "a", (3,)), b=_array(self, "b", (3,)), radius=_radius(self))


@dataclasses.dataclass(frozen=True, eq=False)
class HalfSpace:
    """All points p with normal · p <= offset: a table top or a wall that nothing may pass.

    Attributes:
        normal: points out of the solid side, shape (3,); normalised on construction together with the offset.
        offset: [m] along the normal.
        name: what messages call it.

    Raises:
        InvalidInputError: a shape or a value makes no sense.
    """

    normal: NDArray[np.float64]
    offset: float
    name: str = "half-space"

    def __post_init__(self) -> None:
        normal = _array(self, "normal", (3,))
        length = float(np.linalg.norm(normal))
        if length < 1e-9:
            raise InvalidInputError(f"{self.name}: normal must not be zero")
        offset = _number(self, "offset", self.offset) / length
        _set(self, normal=_frozen(normal / length), offset=offset)


Shape = Box | Sphere | Capsule | HalfSpace


def rotation_z(angle: float) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) about the vertical by an angle [rad].

    Raises:
        InvalidInputError: the angle is no finite number.
    """
    if not math.isfinite(number("angle", angle)):
        raise InvalidInputError(f"angle must be finite, got {angle!r}")
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def number(name: str, value: object) -> float:
    """A real number, possibly infinite.

    Raises:
        InvalidInputError: it is something else, or nan.
    """
    if isinstance(value, bool) or not isinstance(value, _REAL):
        raise InvalidInputError(f"{name} must be a number, got {value!r}")
    if math.isnan(value):
        raise InvalidInputError(f"{name} must be a number, got nan")
    return float(value)


def _set(shape: Shape, **values) -> None:
    for name, value in values.items():
        object.__setattr__(shape, name, value)


def _frozen(array: NDArray[np.float64]) -> NDArray[np.float64]:
    array.setflags(write=False)
    return array


def _array(shape: Shape, field: str, expected: tuple[int, ...]) -> NDArray[np.float64]:
    value = getattr(shape, field)
    try:
        array = np.empty(0) if np.iscomplexobj(value) else np.array(value, dtype=float)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != expected or not np.isfinite(array).all():
        raise InvalidInputError(f"{shape.name}: {field} must be finite with shape {expected}, got {value!r}")
    return _frozen(array)


def _number(shape: Shape, field: str, value: float) -> float:
    if isinstance(value, bool) or not isinstance(value, _REAL) or not math.isfinite(value):
        raise InvalidInputError(f"{shape.name}: {field} must be a finite number, got {value!r}")
    return float(value)


def _radius(shape: "Sphere | Capsule") -> float:
    radius = _number(shape, "radius", shape.radius)
    if radius <= 0.0:
        raise InvalidInputError(f"{shape.name}: radius must be positive, got {radius}")
    return radius
