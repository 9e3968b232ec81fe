"""The baseline that a patient engineer would script: go behind the box, push straight at the goal, again."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.planning.contact import ContactPlan
from vpsto_ros.planning.goal import PlanarGoal
from vpsto_ros.planning.mpc import OnlineResult
from vpsto_ros.planning.pushes import around
from vpsto_ros.planning.pushing import PushingMpc
from vpsto_ros.planning.pushing_problem import PushingProblem
from vpsto_ros.planning.running_reference import MpcStep

ALIGNED = 0.008
"""Sideways distance from the line through the box and the goal within which the script pushes [m]."""


class StraightPushScript(PushingMpc):
    """Same arm, filter, limits and interface as the planner, but no search: a rule picks the via-points."""

    def _plan(
        self, now: float, pose: NDArray, goal: PlanarGoal, contact: ContactPlan | None,
        deadline: float | None, clock: Callable[[], float],
    ) -> MpcStep:  # fmt: skip
        problem = self._problem(now, pose, goal, None)
        plane = problem.trajectory(self._points(problem))
        return self._joint_step(now, problem, OnlineResult(plane, "script", 0.0), plane)

    def _points(self, problem: PushingProblem) -> NDArray:
        center, tool = problem.pose[:2], problem.start + problem.tool_offset
        ahead = problem.goal.position - center
        distance = float(np.hypot(*ahead))
        ahead = ahead / distance
        gap = self._half_depth(problem, ahead)
        behind, aside = (
            float((center - tool) @ ahead),
            abs(float(ahead[0] * (tool - center)[1] - ahead[1] * (tool - center)[0])),
        )
        if behind > 0.5 * gap and aside < ALIGNED:
            return (tool + max(behind - gap + distance, 0.0) * ahead - problem.tool_offset)[None]
        touch = center - (gap + 0.015) * ahead
        radius = self.model.shape.bounding_radius + self.model.tool.bounding_radius + 0.015
        return (
            np.concatenate([around(tool, touch[None], center, radius, 2)[0], touch[None]])
            - problem.tool_offset
        )

    def _half_depth(self, problem: PushingProblem, ahead: NDArray) -> float:
        """Distance of the tool centre from the object's centre when it touches from behind."""
        lengths = np.linspace(0.0, self.model.shape.bounding_radius + self.model.tool.bounding_radius, 200)
        c, s = np.cos(problem.pose[2]), np.sin(problem.pose[2])
        backwards = -np.array([c * ahead[0] + s * ahead[1], -s * ahead[0] + c * ahead[1]])
        free = (
            self.model.shape.signed_distance(lengths[:, None] * backwards) >= self.model.tool.bounding_radius
        )
        return float(lengths[free][0]) if free.any() else float(lengths[-1])
