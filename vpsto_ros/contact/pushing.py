"""Quasi-static planar pushing: the object dynamics of eq. (6.5a)–(6.5c) for a tool that slides on the object.

The thesis takes the inertia matrix for M in eq. (6.5b). What resists a slow push is friction with the table,
so M is the metric of the ellipsoidal limit surface instead: friction wrenches (fx, fy, m) about the centre of
friction satisfy ``f^2 + (m / c)^2 = f_max^2`` while sliding, the twist is normal to that surface, ``(v, w) ~
(f, m / c^2)``, hence ``M^-1 = diag(1, 1, 1 / c^2)`` and ``M = diag(1, 1, c^2)`` up to a factor that does not
matter. The pressure radius ``c = m_max / f_max`` is the mean distance of the supporting area to the centre of
friction. Contacts obey Coulomb's law in addition: the tool drags the object along its surface with at most
`friction` times the normal impulse.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vpsto_ros.contact import rollout_kernel
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.exceptions import InvalidInputError


@dataclass(frozen=True)
class PushingModel:
    """What is pushed, with what, and how it resists.

    Args:
        shape: the object.
        tool: one primitive; its frame is what tool paths move.
        pressure_radius: c of the limit surface [m]; None takes that of pressure spread evenly over the shape.
        friction: coefficient of friction between tool and object; 0 is the thesis's model.
        center_of_friction: where the friction of the table acts, object frame [m].
    """

    shape: PlanarShape
    tool: PlanarShape
    pressure_radius: float = None  # type: ignore[assignment]  # filled in from the shape
    friction: float = 0.3
    center_of_friction: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Check the fields and fill in the pressure radius."""
        if not isinstance(self.shape, PlanarShape) or not isinstance(self.tool, PlanarShape):
            raise InvalidInputError("shape and tool must be PlanarShape")
        if len(self.tool.primitives) != 1:
            raise InvalidInputError(f"the tool must be one primitive, got {len(self.tool.primitives)}")
        center = _finite("center_of_friction", self.center_of_friction)
        if center.shape != (2,):
            raise InvalidInputError(f"center_of_friction must have shape (2,), got {center.shape}")
        object.__setattr__(self, "center_of_friction", (float(center[0]), float(center[1])))
        radius = self.pressure_radius
        radius = self.shape.mean_distance(self.center_of_friction) if radius is None else float(radius)
        object.__setattr__(self, "pressure_radius", radius)
        if not (math.isfinite(radius) and radius > 0.0):
            raise InvalidInputError(f"pressure_radius must be positive, got {radius}")
        if not (math.isfinite(self.friction) and self.friction >= 0.0):
            raise InvalidInputError(f"friction must be finite and not negative, got {self.friction}")

    @cached_property
    def tool_row(self) -> np.ndarray:
        """The tool for the kernels: half sizes, radius, bounding radius; its offset goes into the path."""
        row = self.tool.as_array()[0]
        return np.array([row[2], row[3], row[5], math.hypot(row[2], row[3]) + row[5]])


@dataclass(frozen=True)
class PushRollout:
    """What B objects do under B tool paths of K samples.

    Attributes:
        object_pose: (x, y, yaw) at every sample, yaw continuous, shape (B, K, 3).
        touched: whether the object was moved between the previous sample and this one, shape (B, K).
        penetration: worst overlap that could not be resolved [m], 0 if none, shape (B,).
    """

    object_pose: np.ndarray
    touched: np.ndarray
    penetration: np.ndarray


def rollout(
    model: PushingModel,
    object_pose: np.ndarray,
    tool_path: np.ndarray,
    *,
    pressure_radius: np.ndarray | None = None,
    friction: np.ndarray | None = None,
    center_of_friction: np.ndarray | None = None,
    max_step: float = 0.006,
) -> PushRollout:
    """Predict how objects move when tools follow paths, eq. (6.6) applied along each path.

    The object's first pose is the start, moved out of the tool by the shortest way if they overlap. Inputs
    that are given once are shared by all B rollouts.

    Args:
        model: object, tool and friction.
        object_pose: start (x, y, yaw), world, shape (3,) or (B, 3).
        tool_path: samples of the tool's pose, world, shape (K, 2), (K, 3), (B, K, 2) or (B, K, 3); without
            yaw it is 0.
        pressure_radius: instead of the model's [m], scalar or shape (B,).
        friction: instead of the model's, scalar or shape (B,).
        center_of_friction: instead of the model's, object frame [m], shape (2,) or (B, 2).
        max_step: longest tool motion between two projections [m].

    Raises:
        InvalidInputError: something is not finite, has the wrong shape or is out of its domain.
    """
    start = _rows("object_pose", object_pose, (3,))
    path = _placed_tool(model, _path(tool_path))
    radius = _rows(
        "pressure_radius", model.pressure_radius if pressure_radius is None else pressure_radius, ()
    )
    mu = _rows("friction", model.friction if friction is None else friction, ())
    center = _rows(
        "center_of_friction",
        model.center_of_friction if center_of_friction is None else center_of_friction,
        (2,),
    )
    if radius.min(initial=1.0) <= 0.0 or mu.min(initial=0.0) < 0.0:
        raise InvalidInputError("pressure_radius must be positive and friction not negative")
    if not (math.isfinite(max_step) and max_step > 0.0):
        raise InvalidInputError(f"max_step must be positive, got {max_step}")
    batch = _batch_size(
        object_pose=start, tool_path=path, pressure_radius=radius, friction=mu, center_of_friction=center
    )
    poses = np.empty((batch, path.shape[1], 3))
    touched = np.zeros((batch, path.shape[1]), dtype=np.bool_)
    penetration = np.empty(batch)
    # Steps longer than half the tool could put its centre beyond the surface, where the nearest side may be
    # the wrong one.
    tool = model.tool_row
    step = min(max_step, 0.5 * (tool[2] if tool[2] > 0.0 else min(tool[0], tool[1])))
    rollout_kernel.rollout_batch(
        model.shape.kernel_rows, model.shape.outline_segments, tool, start, path, radius, mu, center, step,
        poses, touched, penetration,
    )  # fmt: skip
    return PushRollout(poses, touched, penetration)


def push_directions(
    model: PushingModel,
    contact_points: np.ndarray,
    directions: np.ndarray,
    *,
    object_pose: np.ndarray | None = None,
) -> np.ndarray:
    """First-order response of the object to the motion of a tool that touches it: which push does what.

    The tool is taken to touch the object at its nearest point; a motion away from the object gives zero.

    Args:
        model: object, tool and friction.
        contact_points: tool centres, shape (K, 2).
        directions: motion of the tool [m], shape (K, 2); the response is linear in its length.
        object_pose: (x, y, yaw) of the object if points and directions are in the world frame; None if in the
            object frame.

    Returns:
        displacement of the object's origin and turn (dx, dy, dyaw) in the frame of the inputs, shape (K, 3).
    """
    points, motion = _finite("contact_points", contact_points), _finite("directions", directions)
    if points.ndim != 2 or points.shape[1] != 2 or motion.shape != points.shape:
        shapes = f"{points.shape} and {motion.shape}"
        raise InvalidInputError(f"contact_points and directions must both have shape (K, 2), got {shapes}")
    turn = np.eye(2)
    if object_pose is not None:
        x, y, yaw = _rows("object_pose", object_pose, (3,))[0]
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        points = np.column_stack([(points - (x, y)) @ turn, np.full(len(points), -yaw)])
    elif model.tool_row[2] == 0.0:
        points = np.column_stack([points, np.zeros(len(points))])
    points = _placed_tool(model, np.ascontiguousarray(points)[None])[0]
    twists = np.empty((len(points), 3))
    rollout_kernel.push_response(
        model.shape.kernel_rows, model.shape.outline_segments, model.tool_row, points,
        np.ascontiguousarray(motion @ turn), model.pressure_radius, model.friction, *model.center_of_friction,
        twists,
    )  # fmt: skip
    twists[:, :2] = twists[:, :2] @ turn.T
    return twists


def _finite(name: str, value) -> np.ndarray:
    array = np.asarray(value, dtype=float)
    if not np.all(np.isfinite(array)):
        raise InvalidInputError(f"{name} must be finite")
    return array


def _rows(name: str, value, shape: tuple[int, ...]) -> np.ndarray:
    """The value as a contiguous array of shape (1, ...) or (B, ...)."""
    array = np.ascontiguousarray(_finite(name, value))
    if np.ndim(value) == len(shape):
        array = array.reshape((1, *np.shape(value)))
    if array.shape[1:] != shape or array.ndim != len(shape) + 1:
        raise InvalidInputError(f"{name} must have shape {shape} or {('B', *shape)}, got {np.shape(value)}")
    return array


def _path(tool_path) -> np.ndarray:
    path = np.ascontiguousarray(_finite("tool_path", tool_path))
    path = path[None] if path.ndim == 2 else path
    if path.ndim != 3 or path.shape[1] < 1 or path.shape[2] not in (2, 3):
        allowed = "(K, 2), (K, 3), (B, K, 2) or (B, K, 3) with K >= 1"
        raise InvalidInputError(f"tool_path must have shape {allowed}, got {np.shape(tool_path)}")
    return path


def _placed_tool(model: PushingModel, path: np.ndarray) -> np.ndarray:
    """Path of the tool primitive's centre and angle, from the path of the tool's frame."""
    cx, cy, _, _, angle, _ = model.tool.as_array()[0]
    if cx == cy == angle == 0.0:
        return path
    yaw = path[..., 2] if path.shape[2] == 3 else np.zeros(path.shape[:2])
    c, s = np.cos(yaw), np.sin(yaw)
    x, y = path[..., 0] + c * cx - s * cy, path[..., 1] + s * cx + c * cy
    return np.ascontiguousarray(np.stack([x, y, yaw + angle], axis=-1))


def _batch_size(**arrays: np.ndarray) -> int:
    sizes = {name: len(array) for name, array in arrays.items()}
    batch = max(sizes.values())
    if any(size not in (1, batch) for size in sizes.values()):
        raise InvalidInputError(f"the numbers of rows must agree or be 1, got {sizes}")
    return batch
