"""Obstacles as the arrays that the kernels read, without the pairs that can never meet."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.collision.arm_kernels import ArmArrays, CellArrays
from vpsto_ros.collision.distance import box_row
from vpsto_ros.collision.shapes import Box, Capsule, HalfSpace, Shape, Sphere


def cell_arrays(arm: ArmArrays, obstacles: Sequence[Shape], margin: float) -> CellArrays:
    """Arrays of the obstacles, in the order they are given within each kind.

    A link that does not reach an obstacle from the shoulder, whatever the posture, is not checked against it;
    neither is the base, which stands where it is mounted.

    Args:
        arm: the capsules of the arm.
        obstacles: any number of shapes.
        margin: how far beyond touching a pair counts [m].
    """
    boxes = [shape for shape in obstacles if isinstance(shape, Box)]
    rods = [shape for shape in obstacles if isinstance(shape, Sphere | Capsule)]
    planes = [shape for shape in obstacles if isinstance(shape, HalfSpace)]
    box_rows = _rows([box_row(box.centre, box.rotation, box.half_size) for box in boxes], 15)
    capsule_rows = _rows([_capsule_row(shape) for shape in rods], 9)
    plane_rows = _rows([np.append(plane.normal, plane.offset) for plane in planes], 4)
    bound = np.linalg.norm(box_rows[:, 12:], axis=1)
    shoulder = np.array([0.0, 0.0, arm.dh[0, 1]])
    reach = arm.radius + _reach_of_shoulder(arm) + margin
    return CellArrays(
        box_rows,
        bound,
        capsule_rows,
        plane_rows,
        _pairs(arm, reach, [_box_distance(row, shoulder) for row in box_rows]),
        _pairs(arm, reach, [_capsule_distance(row, shoulder) for row in capsule_rows]),
        _pairs(arm, reach, [float(row[:3] @ shoulder - row[3]) for row in plane_rows]),
    )


def _rows(rows: list[NDArray[np.float64]], width: int) -> NDArray[np.float64]:
    return np.ascontiguousarray(np.array(rows, dtype=float).reshape(-1, width))


def _capsule_row(shape: Sphere | Capsule) -> NDArray[np.float64]:
    """Start, direction, radius, half the length of the segment, and 1 / length² or zero."""
    a, b = (shape.centre, shape.centre) if isinstance(shape, Sphere) else (shape.a, shape.b)
    squared = float((b - a) @ (b - a))
    tail = [shape.radius, 0.5 * np.sqrt(squared), 1.0 / squared if squared > 0.0 else 0.0]
    return np.concatenate([a, b - a, tail])


def _reach_of_shoulder(arm: ArmArrays) -> NDArray[np.float64]:
    """Largest distance (C,) of each segment's points from the shoulder, where joints 1 and 2 meet."""
    ends = np.stack([arm.local[:, :3], arm.local[:, :3] + arm.local[:, 3:]])
    own = np.linalg.norm(ends, axis=-1).max(axis=0)
    return np.where(arm.link <= 2, own, arm.swing[:, 1])


def _box_distance(row: NDArray[np.float64], point: NDArray[np.float64]) -> float:
    local = row[3:12].reshape(3, 3).T @ (point - row[:3])
    return float(np.linalg.norm(np.maximum(np.abs(local) - row[12:], 0.0)))


def _capsule_distance(row: NDArray[np.float64], point: NDArray[np.float64]) -> float:
    t = np.clip((point - row[:3]) @ row[3:6] * row[8], 0.0, 1.0)
    return float(np.linalg.norm(row[:3] + t * row[3:6] - point) - row[6])


def _pairs(arm: ArmArrays, reach: NDArray[np.float64], distances: list[float]) -> NDArray[np.int64]:
    """Pairs (capsule, obstacle), the outermost links first: they are the first to hit."""
    pairs = [
        (k, i)
        for k in range(len(arm.link) - 1, -1, -1)
        for i, distance in enumerate(distances)
        if arm.link[k] > 0 and distance < reach[k]
    ]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)
