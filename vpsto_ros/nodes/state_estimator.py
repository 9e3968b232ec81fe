"""The node between a camera and the planners: object_pose in, object_state and object_belief out."""

import math
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from visualization_msgs.msg import MarkerArray

from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.estimation.particle_filter import ObjectParticleFilter
from vpsto_ros.nodes import markers
from vpsto_ros.nodes.conversions import belief_message, read_observation, state_message
from vpsto_ros.nodes.diagnostics import OK, STALE, WARN, Diagnostics, Durations, Rate
from vpsto_ros.nodes.estimators import (
    Bridging,
    KalmanEstimator,
    ObjectEstimator,
    ParticleEstimator,
    measured_at,
)
from vpsto_ros.nodes.lifecycle import ManagedNode, best_effort, latched, reliable, run
from vpsto_ros.nodes.puck_estimator import PuckEstimator, puck_model
from vpsto_ros.nodes.robots import belief_dynamics
from vpsto_ros.nodes.state_estimator_config import KALMAN, PUCK, StateEstimatorConfig


class StateEstimator(ManagedNode):
    """Publishes what the filter knows with every frame, and bridges drop-outs by prediction for a while."""

    default_config = StateEstimatorConfig()

    def configure(self, config: StateEstimatorConfig) -> None:
        """Set up filter, topics and timers."""
        self.config = config
        std = config.puck.position_std if config.kind == PUCK else config.position_std
        self._default_covariance = np.diag([std**2, std**2, config.yaw_std**2])
        self._update_time, self._rate = Durations(), Rate()
        self.reinitialized = 0
        self.estimator = self._make_estimator(config)
        self.on_time_reset()
        self._state_publisher = self.advertise(Odometry, "object_state", reliable(1))
        self._belief_publisher = self.advertise(PoseArray, "object_belief", best_effort(1))
        self._marker_publisher = self.advertise(MarkerArray, "~/markers", latched())
        self.subscribe(PoseWithCovarianceStamped, "object_pose", self._receive)
        self.every(1.0 / config.rate, self._bridge)
        self.every(1.0 / config.belief_rate, self._publish_belief)
        self.every(1.0 / config.marker_rate, self._publish_markers)
        self.diagnostics = Diagnostics(self, self.report)

    def _make_estimator(self, config: StateEstimatorConfig) -> ObjectEstimator:
        rng, bridging = np.random.default_rng(config.seed), Bridging(config.fresh, config.prediction)
        if config.kind == KALMAN:
            return KalmanEstimator(config.filter, bridging, rng)
        if config.kind == PUCK:
            model = puck_model(config.puck_model)
            puck = PuckEstimator(model, config.puck, config.mallet, config.hockey, bridging, rng)
            puck.listen(self)
            return puck
        dynamics = belief_dynamics(config.robot, config.model, config.way_variance)
        particles = ObjectParticleFilter(config.particles, dynamics, rng, config.limits)
        made = ParticleEstimator(particles, config.robot.plane(), bridging)
        made.listen(self, config.base_frame, config.force_noise, touch=config.touch)
        return made

    def on_time_reset(self) -> None:
        """Forget the object."""
        self.estimator.reset()
        self._belief = np.zeros((0, 3))
        self._last_frame = -math.inf

    def cleanup(self) -> None:
        """Stop reporting."""
        self.diagnostics.destroy()

    def figures(self) -> dict[str, Any]:
        """Rate, age, compute time and uncertainty of the estimate, and how often it began anew."""
        now = self.now()
        state, status = self.estimator.state(now), self.estimator.status(now)
        values = {
            "rate_hz": f"{self._rate.take():.2f}",
            "frame_age_s": f"{self._age():.3f}",
            "reinitialized": self.reinitialized,
            **self._update_time.milliseconds("compute"),
            "filter": f"{status.kind}: {status.reason}" if status.reason else status.kind,
            **self.estimator.figures(),
        }
        if state is not None:
            values["position_std_mm"] = f"{1e3 * math.sqrt(np.trace(state.covariance[:2, :2]) / 2.0):.3f}"
        return values

    def health(self) -> tuple[int, str]:
        """Whether frames come and are taken."""
        age = self._age()
        status = self.estimator.status(self.now())
        if math.isinf(age):
            reason = status.reason if status.kind != "tracking" else "no camera frame yet"
            return STALE, reason + self._because()
        if age > self.config.fresh + self.config.prediction:
            return STALE, f"the camera has been silent for {age:.1f} s" + self._because()
        level, message = super().health()
        if level == OK and status.kind != "tracking":
            return WARN, f"{status.kind}: {status.reason}"
        return level, message

    def _age(self) -> float:
        """Age of the last frame that was used [s], inf without one."""
        return self.now() - self.estimator.frame_stamp

    def _because(self) -> str:
        trouble = self.complaints.recent()
        return f"; {trouble}" if trouble else ""

    def _receive(self, message: PoseWithCovarianceStamped) -> None:
        with self._update_time.measured():
            reading, covariance = read_observation(message, self.config.base_frame)
            self.config.table.check(reading)
            stamp, now = measured_at(self, message.header.stamp, self.config.limits), self.now()
            self._update(stamp, reading.pose, self._default_covariance if covariance is None else covariance)
        self._last_frame = now
        if self.estimator.with_frames:
            self._publish(now)

    def _update(self, stamp: float, pose: NDArray, covariance: NDArray) -> None:
        outcome = self.estimator.update(stamp, pose, covariance)
        if outcome.kind == "reinitialized":
            self.reinitialized += 1
            self.get_logger().info(f"the object is somewhere else: {outcome.reason}")
        elif outcome.kind != "accepted":
            self.complaints.add(outcome.kind, f"frame not used, {outcome.kind}: {outcome.reason}")

    def _bridge(self) -> None:
        """Keep the state coming, by some filters only while frames stay away."""
        now = self.now()
        if not self.estimator.with_frames or now - self._last_frame >= 1.5 / self.config.rate:
            self._publish(now)

    def _publish(self, now: float) -> None:
        state = self.estimator.state(now)
        if state is not None:
            frame, height = self.config.base_frame, self.config.surface
            self._state_publisher.publish(state_message(state, self.time_base, frame, height=height))
            self._rate.tick()

    def _publish_belief(self) -> None:
        state: ObjectState | None = self.estimator.state(self.now())
        if state is None:
            return
        self._belief = self.estimator.belief(state, self.config.belief_samples)
        stamp = self.time_base.stamp(state.stamp)
        self._belief_publisher.publish(belief_message(self._belief, stamp, self.config.base_frame))

    def _publish_markers(self) -> None:
        stamp = self.get_clock().now().to_msg()
        make = markers.MarkerFactory(self.config.base_frame, stamp, self.config.surface)
        drawn = [make.spheres("object_belief", self._belief[:, :2], markers.ESTIMATE)]
        self._marker_publisher.publish(MarkerArray(markers=drawn))


def main(args: list[str] | None = None) -> int:
    """Run the state estimator; see :func:`vpsto_ros.nodes.lifecycle.run`."""
    return run(StateEstimator, "state_estimator", args)
