"""The arm's collision as a term of the search."""

import math

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.collision import arm_path_kernels as paths
from vpsto_ros.collision.arm import TOLERANCE, ArmCollision
from vpsto_ros.collision.shapes import number
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory import Trajectory, TrajectoryBatch


class ArmPathCost:
    """Cost of a batch of motions of the arm; valid are those that are proven free at every instant.

    The cost is the time in collision, as in the plane, weighted by one plus the depth, so that a candidate
    that only grazes is better than one that passes through the middle of an obstacle: time alone cannot tell
    these apart and gives the search no direction. The samples measure it, each for an equal part of the
    duration, so that time spent elsewhere changes nothing. A motion without a sample in collision is proven
    free between the samples too; where that fails it costs half a sample and is invalid. A motion without a
    finite duration costs infinitely much.

    Args:
        checker: the arm in its cell; a sample closer than its margin counts.
        weight: cost of a second in collision.
        proof_margin: distance [m] that is proven of valid motions; smaller than the margin of the checker, so
            that motions that keep the margin at their samples rarely fail between them.
        depth_scale: overlap [m] that counts as much as being in collision at all.
        tolerance: of the proof [m], see :meth:`ArmCollision.free_along`.

    Raises:
        InvalidInputError: a number is out of range.
    """

    def __init__(
        self,
        checker: ArmCollision,
        *,
        weight: float = 60.0,
        proof_margin: float = 0.0,
        depth_scale: float = 0.05,
        tolerance: float = TOLERANCE,
    ) -> None:
        if not isinstance(checker, ArmCollision):
            raise InvalidInputError(f"expected an ArmCollision, got {checker!r}")
        if not 0.0 <= number("proof_margin", proof_margin) <= checker.margin:
            raise InvalidInputError(
                f"proof_margin must be from 0 to the margin of the checker, {checker.margin}, "
                f"got {proof_margin!r}"
            )
        options = {"weight": weight, "depth_scale": depth_scale, "tolerance": tolerance}
        if not all(0.0 < number(name, value) < math.inf for name, value in options.items()):
            raise InvalidInputError(f"these must be finite and positive: {options}")
        self.checker = checker
        self.weight = weight
        self.proof_margin = proof_margin
        self.depth_scale = depth_scale
        self.tolerance = tolerance

    def __call__(self, batch: TrajectoryBatch) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Cost (B,) and validity (B,)."""
        if batch.position.shape[-1] != 7:
            raise InvalidInputError(f"expected motions of 7 joints, got {batch.position.shape[-1]}")
        cost = np.empty(len(batch.position))
        paths.batch_cost(
            self.checker.model.arrays,
            self.checker.cell,
            batch.position,
            batch.duration,
            batch.knots,
            batch.key_positions,
            batch.knot_slopes,
            self.checker.margin,
            self.proof_margin,
            self.tolerance,
            self.depth_scale,
            cost,
        )
        return self.weight * cost, cost == 0.0

    def explain(self, trajectory: Trajectory) -> list[str]:
        """What a motion collides with, in words."""
        found = self.checker.free_along(trajectory, margin=self.proof_margin, tolerance=self.tolerance)
        if found.free:
            return []
        return self.checker.explain(trajectory) or [
            f"{contact} at {found.time:.3f} s" for contact in found.contacts
        ]
