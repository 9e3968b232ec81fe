"""One planning step of planar pushing as a problem for VP-STO: costs, priors and first guesses (4.5.2)."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.contact.pushing import PushingModel, rollout
from vpsto_ros.optimization.progress import Evaluation
from vpsto_ros.planning.contact import ContactPlan
from vpsto_ros.planning.goal import PlanarGoal
from vpsto_ros.planning.pushes import StraightPushes, around
from vpsto_ros.planning.pushing_config import PushingCosts
from vpsto_ros.planning.workspace import Workspace
from vpsto_ros.priors.contact import contact_factor
from vpsto_ros.priors.gaussian import GaussianPrior
from vpsto_ros.priors.smoothness import smoothness_prior
from vpsto_ros.trajectory import (
    Limits,
    OptimalBasis,
    Trajectory,
    TrajectoryBatch,
    synthesize,
    synthesize_batch,
)

INVALID_COST = 100.0
"""Offset that ranks every invalid candidate behind the valid ones."""


@dataclasses.dataclass(frozen=True)
class PushOutcome:
    """What candidates do.

    Attributes:
        motion: the candidate motions of the tool.
        poses: predicted object poses, shape (B, K, 3) of the nominal model.
        error: goal error at the end, averaged over the models, shape (B,) [m].
        regress: sum of all increases of the error on the way, averaged over the models, shape (B,) [m].
        rotation: |rotation| of the object, averaged over the models, shape (B,) [rad].
        excess: largest violation of a region by tool or object, shape (B,) [m].
    """

    motion: TrajectoryBatch
    poses: NDArray
    error: NDArray
    regress: NDArray
    rotation: NDArray
    excess: NDArray


class PushingProblem:
    """Planning a push from a given state of tool and object: an ``OnlineProblem`` in the plane (n = 2).

    Search points are the via-points and, with a free end, the end point.
    """

    def __init__(
        self,
        model: PushingModel,
        costs: PushingCosts,
        workspace: Workspace,
        limits: Limits,
        *,
        start: NDArray,
        velocity: NDArray,
        start_time: float,
        tool_offset: NDArray,
        pose: NDArray,
        goal: PlanarGoal,
        contact: ContactPlan | None,
        pushes: StraightPushes,
    ) -> None:
        """Pose the problem.

        Args:
            model: contact model.
            costs: weights of the objective.
            workspace: regions of tool and object.
            limits: velocity and acceleration limits of the tool in x and y.
            start: tool position when the plan takes over, shape (2,) [m].
            velocity: tool velocity at that time, shape (2,) [m/s].
            start_time: that time [s].
            tool_offset: where the tool is relative to its reference, shape (2,) [m]: under load an impedance-
                controlled arm lags.
            pose: object pose predicted for that time, shape (3,).
            goal: where the object shall go.
            contact: where to touch, None if nobody says.
            pushes: straight pushes for first guesses, best first.
        """
        self.model, self.costs, self.workspace, self.limits = model, costs, workspace, limits
        self.start, self.velocity, self.start_time = start, velocity, start_time
        self.tool_offset, self.pose, self.goal = tool_offset, pose, goal
        self.contact, self.pushes = contact, pushes
        self.start_error = float(goal.error(pose, model.pressure_radius))
        # An object that is near or beyond the border must be allowed to come back, and to go to a
        # goal that is there.
        ends = np.stack([pose, np.append(goal.position, 0.0)])[:, None]
        self._allowed_excess = float(workspace.object_excess(ends, workspace.margin).max()) + 1e-3
        self._fixed_end = pose[:2] - tool_offset if costs.end_point == "object" else None

    def evaluate(self, points: NDArray) -> Evaluation:
        """Costs [s] and validity of candidates (B, P, 2); :class:`PushingCosts` lists the terms."""
        outcome, costs = self.outcome(points), self.costs
        motion = outcome.motion
        cost = costs.error * (outcome.error + costs.regress * outcome.regress) + motion.duration
        if self.goal.yaw is None:
            cost = cost + costs.rotation * outcome.rotation
        if costs.smoothness > 0.0:
            effort = np.mean((np.asarray(motion.acceleration) / self.limits.acceleration) ** 2, axis=(1, 2))
            cost = cost + costs.smoothness * effort * motion.duration
        late = np.maximum(motion.duration - costs.horizon, 0.0)
        gain = outcome.error <= self.start_error - costs.minimum_gain
        valid = gain & (outcome.excess <= 0.0) & (late <= 0.0)
        penalty = np.where(valid, 0.0, INVALID_COST + 1e3 * outcome.excess + late)
        return Evaluation(cost + penalty, valid)

    def outcome(self, points: NDArray) -> PushOutcome:
        """Synthesise candidates and roll the object out along them."""
        keys = self._keys(points)
        motion = synthesize_batch(
            OptimalBasis.uniform(keys.shape[1] - 2), keys, self.velocity, np.zeros(2), self.limits,
            self.costs.samples,
            derivatives=self.costs.smoothness > 0.0,
        )  # fmt: skip
        poses = self._rollouts(motion.position + self.tool_offset)
        errors = self.goal.error(poses, self.model.pressure_radius)
        regress = np.maximum(np.diff(errors, axis=-1), 0.0).sum(axis=-1).mean(axis=0)
        rotation = np.abs(poses[:, :, -1, 2] - self.pose[2]).mean(axis=0)
        leaves = self.workspace.object_excess(poses, self.workspace.margin).max(axis=0)
        excess = np.maximum(
            self.workspace.tool_excess(motion.position), np.maximum(leaves - self._allowed_excess, 0.0)
        )
        return PushOutcome(
            motion, poses[len(poses) // 2], errors[..., -1].mean(axis=0), regress, rotation, excess
        )

    def trajectory(self, points: NDArray) -> Trajectory:
        """The timed plane trajectory of one candidate (P, 2)."""
        keys = self._keys(points[None])[0]
        basis = OptimalBasis.uniform(len(keys) - 2)
        return synthesize(basis, keys, self.velocity, np.zeros(2), self.limits, start_time=self.start_time)

    def direct(self, previous: Trajectory | None) -> NDArray | None:
        """Straight to where the previous solution ended (4.4.1); to the object if that is the end point."""
        if self._fixed_end is not None:
            return np.zeros((0, 2))
        return None if previous is None else previous(previous.end_time)[None]

    def shifted(self, previous: Trajectory, n_via: int) -> NDArray:
        """What is left of the previous solution, resampled at even times."""
        count = n_via + (self._fixed_end is None)
        begin = min(self.start_time, previous.end_time)
        times = begin + (previous.end_time - begin) * np.arange(1, n_via + 2) / (n_via + 1)
        return previous(times)[:count]

    def guesses(self, n_via: int) -> NDArray:
        """Go round, touch, push: the contact plan's push first, then the other good ones."""
        radius = self.model.shape.bounding_radius + self.model.tool.bounding_radius + 0.01
        touch, end = self.pushes.touch - self.tool_offset, self.pushes.end - self.tool_offset
        if self.contact is not None:
            ahead = self._contact_push(self.contact)
            touch = np.concatenate([self.contact.position[None] - self.tool_offset, touch])
            end = np.concatenate([touch[:1] + ahead, end])
        way = around(self.start, touch, self.pose[:2], radius, n_via - 1)
        late_touch = np.concatenate([way, touch[:, None], end[:, None]], axis=1)
        even = _resampled(
            np.concatenate([np.broadcast_to(self.start, (len(touch), 1, 2)), late_touch], axis=1), n_via + 1
        )
        both = np.stack([late_touch, even], axis=1).reshape(-1, n_via + 1, 2)
        return both if self._fixed_end is None else both[:, :n_via]

    def _contact_push(self, contact: ContactPlan) -> NDArray:
        """Tool displacement from the contact plan's touch: its direction, the length of the best push."""
        best = self.pushes.end[0] - self.pushes.touch[0]
        speed = float(np.hypot(*contact.velocity))
        return best if speed < 1e-6 else np.hypot(*best) * contact.velocity / speed

    def prior(self, n_via: int) -> GaussianPrior:
        """Smoothness prior (4.3.1) times the contact plan's Gaussian on the last via-point."""
        push = float(np.linalg.norm(self.pushes.end[0] - self.pushes.touch[0])) / float(
            self.limits.velocity.min()
        )
        approach = float(np.linalg.norm(self.pushes.touch[0] - self.start)) / float(
            self.limits.velocity.min()
        )
        if self.contact is not None:
            approach = self.contact.stamp - self.start_time
        duration = max(approach + push, 0.3)
        prior = smoothness_prior(
            OptimalBasis.uniform(n_via),
            self.start,
            self.velocity,
            self._fixed_end,
            np.zeros(2),
            duration,
            spread=0.06,
        )
        if self.contact is None or self._fixed_end is not None:
            return prior
        mean = self.contact.position - self.tool_offset
        return prior.times(*contact_factor(n_via + 1, 2, n_via - 1, mean, self.contact.covariance))

    def _keys(self, points: NDArray) -> NDArray:
        batch = len(points)
        parts = [np.broadcast_to(self.start, (batch, 1, 2)), points]
        if self._fixed_end is not None:
            parts.append(np.broadcast_to(self._fixed_end, (batch, 1, 2)))
        return np.concatenate(parts, axis=1)

    def _rollouts(self, path: NDArray) -> NDArray:
        """Object poses (models, B, K, 3): the nominal model, or three from slippery to sticky."""
        signs = np.array(
            [-1.0, 0.0, 1.0] if max(self.costs.pressure_spread, self.costs.friction_spread) > 0.0 else [0.0]
        )
        per_candidate = np.repeat(signs, len(path))
        poses = rollout(
            self.model, self.pose, np.tile(path, (len(signs), 1, 1)),
            pressure_radius=self.model.pressure_radius * (1.0 + self.costs.pressure_spread * per_candidate),
            friction=self.model.friction * (1.0 + self.costs.friction_spread * per_candidate),
        ).object_pose  # fmt: skip
        return poses.reshape(len(signs), *path.shape[:2], 3)


def _resampled(polyline: NDArray, count: int) -> NDArray:
    """`count` points at even arc length along polylines (S, V, 2), without the start, with the end."""
    lengths = np.linalg.norm(np.diff(polyline, axis=1), axis=2)
    stations = np.concatenate([np.zeros((len(lengths), 1)), np.cumsum(lengths, axis=1)], axis=1)
    wanted = stations[:, -1:] * np.arange(1, count + 1) / count
    return np.stack([
        np.stack([np.interp(w, s, line[:, axis]) for axis in range(2)], axis=-1)
        for w, s, line in zip(wanted, stations, polyline, strict=True)
    ])  # fmt: skip
