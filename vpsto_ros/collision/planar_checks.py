"""What the arguments of a planar world must be, with messages that say what was given instead."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError


def vector(name: str, value: ArrayLike, *, finite: bool = True) -> NDArray[np.float64]:
    """Two numbers as a read-only array.

    Raises:
        InvalidInputError: it is something else, NaN, or infinite although it must be finite.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{name} must be two numbers, got {value!r}") from error
    if array.shape != (2,) or not np.all(np.isfinite(array) if finite else ~np.isnan(array)):
        raise InvalidInputError(f"{name} must be two {'finite ' if finite else ''}numbers, got {value!r}")
    array.setflags(write=False)
    return array


def number(name: str, value: Any, *, least: float = -np.inf) -> float:
    """A finite number, `least` or more.

    Raises:
        InvalidInputError: it is something else; a bool is no number.
    """
    if _is_number(value) and np.isfinite(value) and value >= least:
        return float(value)
    bound = "" if least == -np.inf else f" and not {'negative' if least == 0.0 else f'below {least:g}'}"
    raise InvalidInputError(f"{name} must be finite{bound}, got {value!r}")


def positive(name: str, value: Any) -> float:
    """A finite number above zero.

    Raises:
        InvalidInputError: it is something else; a bool is no number.
    """
    if _is_number(value) and np.isfinite(value) and value > 0:
        return float(value)
    raise InvalidInputError(f"{name} must be finite and positive, got {value!r}")


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def items(name: str, value: Any) -> tuple[Any, ...]:
    """What a sequence holds.

    Raises:
        InvalidInputError: it is no sequence, or a string.
    """
    if isinstance(value, (str, bytes)) or not hasattr(value, "__iter__"):
        raise InvalidInputError(f"{name} must be a sequence, got {value!r}")
    return tuple(value)


def planar(dof: int) -> None:
    """Refuse motions of another number of degrees of freedom than two.

    Raises:
        InvalidInputError: there are more or fewer.
    """
    if dof != 2:
        raise InvalidInputError(f"a planar world takes 2 degrees of freedom, not {dof}")


def points_and_times(
    points: ArrayLike, times: Any
) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[int, ...]]:
    """Points (K, 2) and times (K,), contiguous, and the shape of the answer.

    Raises:
        InvalidInputError: a shape does not fit, or something is no finite number.
    """
    try:
        array = np.asarray(points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"points must be numbers of shape (..., 2), got {points!r}") from error
    if array.ndim < 1 or array.shape[-1] != 2 or not np.isfinite(array).all():
        raise InvalidInputError(f"points must be finite with shape (..., 2), got {np.shape(points)}")
    shape = array.shape[:-1]
    try:
        clock = np.broadcast_to(np.asarray(0.0 if times is None else times, dtype=np.float64), shape)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(
            f"times must be numbers that fit points of shape {array.shape}, got {times!r}"
        ) from error
    if not np.isfinite(clock).all():
        raise InvalidInputError("times must be finite")
    return np.ascontiguousarray(array.reshape(-1, 2)), np.ascontiguousarray(clock.reshape(-1)), shape
