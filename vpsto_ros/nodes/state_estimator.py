"""The node between a camera and the planners: object_pose in, object_state and object_belief out."""

import dataclasses
import math
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from visualization_msgs.msg import MarkerArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.estimation.planar_kalman import PlanarKalman, PlanarKalmanConfig
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.nodes import markers
from vpsto_ros.nodes.conversions import belief_message, read_observation, state_message
from vpsto_ros.nodes.diagnostics import STALE, Diagnostics, Durations, Rate
from vpsto_ros.nodes.lifecycle import ManagedNode, NodeConfig, best_effort, latched, reliable, run
from vpsto_ros.nodes.scene import TableConfig


@documented
@dataclasses.dataclass(frozen=True)
class StateEstimatorConfig(NodeConfig):
    """Parameters of the state estimator."""

    rate: float = option(50.0, "rate at which object_state is kept up", unit="Hz", minimum=1.0, maximum=200.0)
    belief_rate: float = option(20.0, "rate of object_belief", unit="Hz", minimum=0.1, maximum=100.0)
    marker_rate: float = option(10.0, "rate of ~/markers", unit="Hz", minimum=0.1, maximum=50.0)
    belief_samples: int = option(50, "poses in object_belief", minimum=1, maximum=2000)
    fresh: float = option(
        0.15,
        "age of the last frame up to which its state goes out as it is",
        unit="s",
        minimum=0.0,
        maximum=5.0,
    )
    prediction: float = option(
        0.3,
        "time for which frames that stay away are bridged by prediction",
        unit="s",
        minimum=0.0,
        maximum=5.0,
    )
    max_age: float = option(1.0, "older frames are refused", unit="s", minimum=0.01, maximum=60.0)
    max_ahead: float = option(
        0.1, "frames farther in the future are refused", unit="s", minimum=0.0, maximum=10.0
    )
    position_std: float = option(
        0.005, "standard deviation of x and y where a frame gives none", unit="m", minimum=1e-5, maximum=1.0
    )
    yaw_std: float = option(
        0.05, "standard deviation of yaw where a frame gives none", unit="rad", minimum=1e-5, maximum=3.0
    )
    seed: int = option(0, "seed of the belief's samples", minimum=0)
    table: TableConfig = dataclasses.field(default_factory=TableConfig)
    filter: PlanarKalmanConfig = dataclasses.field(default_factory=PlanarKalmanConfig)

    def __post_init__(self) -> None:
        validate(self)


class StateEstimator(ManagedNode):
    """Publishes what the filter knows with every frame, and bridges drop-outs by prediction for a while."""

    default_config = StateEstimatorConfig()

    def configure(self, config: StateEstimatorConfig) -> None:
        """Set up filter, topics and timers."""
        self.config = config
        self.filter = PlanarKalman(config.filter)
        self.rng = np.random.default_rng(config.seed)
        self._default_covariance = np.diag(
            [config.position_std**2, config.position_std**2, config.yaw_std**2]
        )
        self._update_time, self._rate = Durations(), Rate()
        self.reinitialized = 0
        self._warm_up()
        self.on_time_reset()
        self._state_publisher = self.advertise(Odometry, "object_state", reliable(1))
        self._belief_publisher = self.advertise(PoseArray, "object_belief", best_effort(1))
        self._marker_publisher = self.advertise(MarkerArray, "~/markers", latched())
        self.subscribe(PoseWithCovarianceStamped, "object_pose", self._receive)
        self.every(1.0 / config.rate, self._bridge)
        self.every(1.0 / config.belief_rate, self._publish_belief)
        self.every(1.0 / config.marker_rate, self._publish_markers)
        self.diagnostics = Diagnostics(self, self.report)

    def on_time_reset(self) -> None:
        """Forget the object."""
        self.filter.reset()
        self._belief = PoseArray()
        self._last_frame = -math.inf

    def cleanup(self) -> None:
        """Stop reporting."""
        self.diagnostics.destroy()

    def state(self, now: float) -> ObjectState | None:
        """What to publish at `now` [s]: the state at the last frame, predicted if old, None if too old."""
        state = self.filter.state
        if state is None:
            return None
        ahead = now - state.stamp - self.config.fresh
        if ahead <= 0.0:
            return state
        return self.filter.predict(state.stamp + ahead) if ahead <= self.config.prediction else None

    def figures(self) -> dict[str, Any]:
        """Rate, age, compute time and uncertainty of the estimate, and how often it began anew."""
        state = self.filter.state
        values = {
            "rate_hz": f"{self._rate.take():.2f}",
            "frame_age_s": f"{self._age():.3f}",
            "reinitialized": self.reinitialized,
            **self._update_time.milliseconds("compute"),
        }
        if state is not None:
            values["position_std_mm"] = f"{1e3 * math.sqrt(np.trace(state.covariance[:2, :2]) / 2.0):.3f}"
        return values

    def health(self) -> tuple[int, str]:
        """Whether frames come and are taken."""
        age = self._age()
        if math.isinf(age):
            return STALE, "no camera frame yet" + self._because()
        if age > self.config.fresh + self.config.prediction:
            return STALE, f"the camera has been silent for {age:.1f} s" + self._because()
        return super().health()

    def _age(self) -> float:
        """Age of the last frame [s], inf without one."""
        state = self.filter.state
        return math.inf if state is None else self.now() - state.stamp

    def _because(self) -> str:
        trouble = self.complaints.recent()
        return f"; {trouble}" if trouble else ""

    def _receive(self, message: PoseWithCovarianceStamped) -> None:
        with self._update_time.measured():
            reading, covariance = read_observation(message, self.config.base_frame)
            self.config.table.check(reading)
            now, stamp = self.now(), self.seconds(message.header.stamp, self.config.max_ahead)
            self._check_age(stamp, now)
            self._update(stamp, reading.pose, self._default_covariance if covariance is None else covariance)
        self._last_frame = now
        self._publish(now)

    def _check_age(self, stamp: float, now: float) -> None:
        if stamp < now - self.config.max_age:
            raise InvalidInputError(f"the frame is {now - stamp:.2f} s old (allowed {self.config.max_age} s)")

    def _update(self, stamp: float, pose: NDArray, covariance: NDArray) -> None:
        outcome = self.filter.update(stamp, pose, covariance)
        if outcome.kind == "reinitialized":
            self.reinitialized += 1
            self.get_logger().info(f"the object is somewhere else: {outcome.reason}")
        elif outcome.kind != "accepted":
            self.complaints.add(outcome.kind, f"frame not used, {outcome.kind}: {outcome.reason}")

    def _bridge(self) -> None:
        """Keep the state coming while frames stay away."""
        now = self.now()
        if now - self._last_frame >= 1.5 / self.config.rate:
            self._publish(now)

    def _publish(self, now: float) -> None:
        state = self.state(now)
        if state is not None:
            self._state_publisher.publish(state_message(state, self.time_base, self.config.base_frame))
            self._rate.tick()

    def _publish_belief(self) -> None:
        state = self.state(self.now())
        if state is not None:
            count, frame = self.config.belief_samples, self.config.base_frame
            self._belief = belief_message(state, count, self.rng, self.time_base, frame)
            self._belief_publisher.publish(self._belief)

    def _publish_markers(self) -> None:
        make = markers.MarkerFactory(self.config.base_frame, self.get_clock().now().to_msg())
        points = np.array([[pose.position.x, pose.position.y] for pose in self._belief.poses]).reshape(-1, 2)
        drawn = [make.spheres("object_belief", points, markers.ESTIMATE)]
        self._marker_publisher.publish(MarkerArray(markers=drawn))

    def _warm_up(self) -> None:
        """Compile whatever the first frames would compile."""
        for index in range(3):
            self.filter.update(0.02 * index, np.array([0.5, 0.0, 0.0]), self._default_covariance)
        self.filter.predict(0.2)


def main(args: list[str] | None = None) -> int:
    """Run the state estimator; see :func:`vpsto_ros.nodes.lifecycle.run`."""
    return run(StateEstimator, "state_estimator", args)
