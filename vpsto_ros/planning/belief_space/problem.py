"""One horizon of BS-VP-STO (6.4) as a problem for the search: priors, costs and constraints."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.belief.dynamics import BeliefDynamics, BeliefPrediction
from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.belief.variance import GAIN_TOLERANCE, robustness_costs
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.optimization.progress import Evaluation
from vpsto_ros.planning.belief_space import scoring
from vpsto_ros.planning.belief_space.config import RobustPushingConfig
from vpsto_ros.planning.belief_space.contact_plan import likely_contact
from vpsto_ros.planning.belief_space.contacts import ContactRule
from vpsto_ros.planning.belief_space.spaces import JointSpace, SearchSpace
from vpsto_ros.priors.gaussian import GaussianPrior
from vpsto_ros.priors.smoothness import smoothness_prior
from vpsto_ros.trajectory import OptimalBasis, Trajectory, TrajectoryBatch, synthesize, synthesize_batch

INVALID_COST = 1e3
"""Offset that ranks every candidate with a broken constraint behind all others, as lambda_c of eq. (6.33)."""

ROUND_OFF = 1e-6
"""Violations that differ by less are the same [m, rad]."""
LARGEST_LEEWAY = 3e-3
"""How far a constraint may be broken at the start of a horizon [m, rad]."""

Reach = Callable[[NDArray], NDArray]
"""Whether plane coordinates (K, m) are within reach, shape (K,) of bool."""


@dataclasses.dataclass(frozen=True)
class HorizonOutcome:
    """What candidates do, row by row.

    Attributes:
        motion: their motions in the search space.
        paths: plane coordinates, shape (B, K + 1, m).
        prediction: of the belief.
        gain: largest variance gain, shape (B,); NaN where nobody has looked at it.
        excess: largest violation of a constraint on the robot [m], shape (B,).
    """

    motion: TrajectoryBatch
    paths: NDArray
    prediction: BeliefPrediction
    gain: NDArray
    excess: NDArray


class RobustPushingProblem:
    """Push a belief along a way within one horizon, from a state of the robot.

    The search points are N - 1 via-points and the free final position.
    """

    def __init__(
        self,
        config: RobustPushingConfig,
        dynamics: BeliefDynamics,
        space: SearchSpace,
        rule: ContactRule,
        *,
        start: NDArray,
        velocity: NDArray,
        belief: ObjectBelief,
        way: NDArray,
        reach: Reach | None = None,
        start_time: float = 0.0,
        contact: tuple[NDArray, NDArray] | None = None,
        tool_offset: NDArray | float = 0.0,
    ) -> None:
        """Pose the problem.

        Args:
            config: weights and constraints.
            dynamics: of the belief.
            space: what is searched.
            rule: where to touch.
            start: present position in the search space, shape (n,).
            velocity: present velocity, shape (n,).
            belief: present belief.
            way: where to push the object, see :meth:`Target.way`, shape (L, 3) [m].
            reach: tells which plane coordinates the arms reach.
            start_time: time of the start [s].
            contact: mean (m,) and covariance (m, m) of the plane coordinates in contact, (6.38), as somebody
                else plans them; None: by the rule.
            tool_offset: where the end effectors are relative to their plane coordinates, shape (m,): under
                load an impedance-controlled arm lags.
        """
        self.config, self.dynamics, self.space, self.rule = config, dynamics, space, rule
        self.start, self.velocity, self.start_time = start, velocity, start_time
        self.belief, self.way, self.reach = belief, np.ascontiguousarray(way, dtype=float), reach
        self.present = space.plane(np.asarray(start)[None, None])[0][0, 0]
        self.basis, self.contact = OptimalBasis.uniform(config.points - 1), contact or self._contact()
        crossing = rule.crossing
        self._arms = (0.0, math.inf) if crossing is None else (crossing.offset, crossing.crossing)
        self._leeway, self._tool_offset = self._leeways(), tool_offset

    def evaluate(self, points: NDArray) -> Evaluation:
        """Costs and validity of candidates (B, N, n): c_task + c_robust, (6.54) and (6.32)."""
        outcome, config = self.outcome(points), self.config
        prediction, batch = outcome.prediction, len(points)
        cost, robust = np.empty(batch), np.zeros(batch)
        aside = config.aside_weight if len(self.way) > 1 else 1.0
        variance_weight = config.variance_weight if config.robust else 0.0
        scoring.progress_costs(
            prediction.mean, prediction.variance, self.way, aside, config.progress_weight, variance_weight,
            cost,
        )  # fmt: skip
        if config.distance_weight > 0.0:
            scoring.distance_costs(
                prediction.mean, prediction.variance, self.way, aside, config.distance_weight,
                variance_weight, cost,
            )  # fmt: skip
        if config.duration_weight > 0.0:
            cost += config.duration_weight * outcome.motion.duration
        # Squeezing breaks the assumption of stiff arms (6.3.1), whether the variance matters or not.
        valid = (outcome.excess <= 0.0) & (prediction.step <= config.longest_step)
        valid &= prediction.wedge >= config.wedge
        if config.robust:
            robustness_costs(
                prediction.variance, prediction.contact, config.perturbation, robust, outcome.gain,
                config.largest_gain,
            )  # fmt: skip
            valid &= outcome.gain <= config.largest_gain + GAIN_TOLERANCE
        cost += robust
        # Valid ones that move the object away may cost more than any offset.
        worst_valid = cost[valid].max(initial=0.0)
        penalty = np.where(valid, 0.0, INVALID_COST * (1.0 + outcome.excess) + worst_valid)
        return Evaluation(cost + penalty, valid)

    def outcome(self, points: NDArray) -> HorizonOutcome:
        """Synthesise candidates (B, N, n) and propagate the belief along them."""
        config = self.config
        motion = synthesize_batch(
            self.basis, self._keys(points), self.velocity, np.zeros_like(self.start), self.space.limits,
            config.steps + 1, derivatives=False,
        )  # fmt: skip
        paths, heights = self.space.plane(motion.position)
        prediction = self.dynamics.predict(self.belief, paths + self._tool_offset)
        excess = np.zeros(len(points))
        violations = self._violations(motion.position, paths, heights)
        for worst, leeway in zip(violations, self._leeway, strict=True):
            np.maximum(excess, worst - leeway, out=excess)
        if heights is None and self.reach is not None:
            inside = self.reach(paths.reshape(-1, paths.shape[2])).reshape(paths.shape[:2])
            # Arms that are out of reach now, as where a brake ended, have to come back.
            share = inside.mean(axis=1) if inside[0, 0] else inside[:, -1]
            np.maximum(excess, 0.1 * (1.0 - share), out=excess)
        return HorizonOutcome(motion, paths, prediction, np.full(len(points), np.nan), excess)

    def _violations(self, positions: NDArray, paths: NDArray, heights: NDArray | None) -> list[NDArray]:
        """How far each constraint on the robot is broken at worst, shape (B,) for each.

        Args:
            positions: in the search space, shape (B, K, n).
            paths: plane coordinates, shape (B, K, m).
            heights: of the tools, shape (B, K, E), if any.
        """
        batch, limits = len(paths), self.space.limits
        separation = np.empty(batch)
        scoring.separation_excess(
            self.dynamics.effectors.rows, paths, self.config.separation, *self._arms, separation
        )
        found = [separation]
        if limits.lower is not None and limits.upper is not None:
            found.append(np.maximum(limits.lower - positions, positions - limits.upper).max(axis=(1, 2)))
        if heights is not None:
            assert isinstance(self.space, JointSpace), "only it has heights"
            off = np.empty(batch)
            scoring.height_excess(heights, self.space.height, self.space.height_tolerance, off)
            found.append(off)
        return found

    def _leeways(self) -> list[float]:
        """By how much each constraint is broken now, as where a brake ended: it must not become worse.

        Without, a robot that stands a hair beyond a constraint would never find a valid motion again. More
        than a hair is not forgiven: a leeway for crossed arms must not let the tools collide.
        """
        here = np.asarray(self.start)[None, None]
        now = [float(worst[0]) for worst in self._violations(here, *self.space.plane(here))]
        return [min(worst, LARGEST_LEEWAY) + ROUND_OFF if worst > 0.0 else 0.0 for worst in now]

    def prior(self) -> GaussianPrior:
        """Product of the smoothness prior and the contact prior, eq. (6.49)."""
        config = self.config
        mean, covariance = self.contact
        way = float(np.abs(mean - self.present).max())
        prior = smoothness_prior(
            self.basis, self.start, self.velocity, None, np.zeros_like(self.start),
            max(way / config.speed, 0.3), weights=self.space.weights, spread=self.space.spread,
        )  # fmt: skip
        if not config.contact_prior:
            return prior
        return prior.times(*self.space.factor(config.points, mean, covariance, self.present))

    def trajectory(self, points: NDArray) -> Trajectory:
        """The timed motion of one candidate (N, n) in the search space; it ends at rest."""
        return synthesize(
            self.basis, self._keys(points[None])[0], self.velocity, np.zeros_like(self.start),
            self.space.limits, start_time=self.start_time,
        )  # fmt: skip

    def _direction(self) -> NDArray:
        """Unit vector from the belief's mean to the end of the way; along x where they coincide."""
        way = self.way[-1, :2] - self.belief.mean[:2]
        length = math.hypot(*way)
        return way / length if length > 1e-6 else np.array([1.0, 0.0])

    def _contact(self) -> tuple[NDArray, NDArray]:
        """Where to touch, eq. (6.38)."""
        return likely_contact(self.config, self.rule, self.belief, self.present, self._direction())

    def _keys(self, points: NDArray) -> NDArray:
        start = np.broadcast_to(self.start, (len(points), 1, points.shape[2]))
        return np.concatenate([start, points], axis=1)


def require_free(dynamics: BeliefDynamics, belief: ObjectBelief, point: NDArray) -> None:
    """Raise InvalidInputError when the expected object is in deep penetration with an end effector.

    Some millimetres are what an uncertain estimate of a touched object may say; more means that robot or
    object are not where they are thought to be.
    """
    gaps = dynamics.effectors.gaps(dynamics.shape, belief.mean, point)
    worst = int(np.argmin(gaps))
    allowed = 0.01 + 2.0 * math.sqrt(belief.variance)
    if gaps[worst] < -allowed:
        raise InvalidInputError(
            f"end effector {worst + 1} of {len(gaps)} penetrates the object by {-1e3 * gaps[worst]:.1f} mm "
            f"at the start; at most {1e3 * allowed:.1f} mm can be blamed on the belief's spread"
        )
