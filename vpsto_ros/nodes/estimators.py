"""The filters that a state estimator can run, behind one interface: Kalman filters, particles, or a puck's.

The Kalman filters know nothing of the robot: they follow what the camera says. Particles are pushed along by
the measured motion of the tools, and can be told what these feel. For a puck there is
:class:`vpsto_ros.nodes.puck_estimator.PuckEstimator`.
"""

import dataclasses
import math
from typing import Any, Protocol

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from sensor_msgs.msg import JointState

from vpsto_ros.estimation.measurement import MeasurementLimits, Outcome
from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.estimation.particle_filter import ObjectParticleFilter
from vpsto_ros.estimation.particle_filter_config import FilterStatus
from vpsto_ros.estimation.planar_kalman import PlanarKalman, PlanarKalmanConfig
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.nodes.conversions import require_finite, require_frame
from vpsto_ros.nodes.joint_conversions import read_joint_state
from vpsto_ros.nodes.lifecycle import ManagedNode
from vpsto_ros.robot.tool_plane import ToolPlane

TRACKING = FilterStatus("tracking", "")
_SEEN = np.array([0.5, 0.0, 0.0])  # an imaginary object, to compile with


class ObjectEstimator(Protocol):
    """What the node asks of a filter; times are in seconds of the node's time base.

    Attributes:
        with_frames: whether a state goes out with every frame, and at the node's rate only while frames stay
            away; else always at the node's rate.
    """

    with_frames: bool

    @property
    def frame_stamp(self) -> float:
        """When the last frame that was used is of, -inf without one [s]."""

    def reset(self) -> None:
        """Forget the object."""

    def update(self, stamp: float, pose: NDArray, covariance: NDArray) -> Outcome:
        """Take in a measured pose (3,) with its covariance (3, 3)."""

    def state(self, now: float) -> ObjectState | None:
        """What is known now, None if that is nothing or too old."""

    def belief(self, state: ObjectState, count: int) -> NDArray:
        """Equally likely poses (count, 3) at the time of a state that was just asked for."""

    def status(self, now: float) -> FilterStatus:
        """How the filter is doing."""

    def figures(self) -> dict[str, Any]:
        """What diagnostics show of it."""


@dataclasses.dataclass(frozen=True)
class Bridging:
    """How long a state goes out without new frames.

    Attributes:
        fresh: age of the last frame up to which its state goes out as it is [s].
        prediction: time for which frames that stay away are bridged after that [s].
    """

    fresh: float
    prediction: float


def measured_at(node: ManagedNode, stamp: Time, limits: MeasurementLimits) -> float:
    """When something that has just come was measured [s].

    Raises:
        InvalidInputError: longer ago than may be, or in the future.
        NoTimeYet: the simulation's clock was not heard yet.
    """
    when = node.seconds(stamp, limits.max_ahead)
    age = node.now() - when
    if age > limits.max_age:
        raise InvalidInputError(f"it is {age:.2f} s old (allowed {limits.max_age} s)")
    return when


class KalmanEstimator:
    """Interacting Kalman filters: the state at the last frame, predicted where frames stay away."""

    with_frames = True

    def __init__(self, config: PlanarKalmanConfig, bridging: Bridging, rng: np.random.Generator) -> None:
        """Compile the filter."""
        self._filter, self._bridging, self._rng = PlanarKalman(config), bridging, rng
        for index in range(3):
            self._filter.update(0.02 * index, _SEEN, 1e-4 * np.eye(3))
        self._filter.predict(0.2)
        self.reset()

    @property
    def frame_stamp(self) -> float:
        """When the last frame that was used is of [s]."""
        state = self._filter.state
        return -math.inf if state is None else state.stamp

    def reset(self) -> None:
        """Forget the object."""
        self._filter.reset()

    def update(self, stamp: float, pose: NDArray, covariance: NDArray) -> Outcome:
        """Take in a measured pose."""
        return self._filter.update(stamp, pose, covariance)

    def state(self, now: float) -> ObjectState | None:
        """The state at the last frame, predicted if old, None if too old."""
        state = self._filter.state
        if state is None:
            return None
        ahead = now - state.stamp - self._bridging.fresh
        if ahead <= 0.0:
            return state
        return self._filter.predict(state.stamp + ahead) if ahead <= self._bridging.prediction else None

    def belief(self, state: ObjectState, count: int) -> NDArray:
        """Samples of the state's Gaussian."""
        factor = np.linalg.cholesky(state.covariance[:3, :3] + 1e-18 * np.eye(3))
        return state.pose + self._rng.standard_normal((count, 3)) @ factor.T

    def status(self, now: float) -> FilterStatus:
        """It has nothing to say beyond the outcomes of its updates."""
        return TRACKING

    def figures(self) -> dict[str, Any]:
        """Nothing beyond what is shown anyway."""
        return {}


class ParticleEstimator:
    """Particles that are pushed along by the tools; a state is of the last measured posture of the robot."""

    with_frames = True

    def __init__(self, particles: ObjectParticleFilter, tools: ToolPlane, bridging: Bridging) -> None:
        """Compile the filter."""
        self._filter, self._tools, self._bridging = particles, tools, bridging
        self._warm_up()
        self.reset()

    @property
    def limits(self) -> MeasurementLimits:
        """Which measurements the filter takes."""
        return self._filter.limits

    @property
    def frame_stamp(self) -> float:
        """When the last frame that was used is of [s]."""
        return self._frame_stamp

    def listen(self, node: ManagedNode, frame: str, force_noise: float, *, touch: bool) -> None:
        """Subscribe to what the robot measures.

        Args:
            node: that listens.
            frame: the base frame.
            force_noise: standard deviation of a measured force [N].
            touch: whether external_wrench is used.
        """

        def receive_joints(message: JointState) -> None:
            position, _ = read_joint_state(message, self._tools.robot.joint_names)
            self.move(node.seconds(message.header.stamp), position)

        def receive_force(message: WrenchStamped) -> None:
            require_frame(message.header, frame)
            force = np.array([message.wrench.force.x, message.wrench.force.y])
            require_finite("force", force)
            stamp = measured_at(node, message.header.stamp, self.limits)
            outcome = self.feel(stamp, force, force_noise)
            if outcome.kind not in ("accepted", "stale"):
                words = f"force not used, {outcome.kind}: {outcome.reason}"
                node.complaints.add(f"touch_{outcome.kind}", words)

        node.subscribe(JointState, "joint_states", receive_joints)
        if touch:
            node.subscribe(WrenchStamped, "external_wrench", receive_force)

    def move(self, stamp: float, joints: NDArray) -> None:
        """Push the particles to where the tools are at joint positions (n,) [rad]."""
        if self._filter.predict(stamp, self._tools.tool(joints)) == "accepted":
            self._moved = stamp

    def feel(self, stamp: float, force: NDArray, noise: float) -> Outcome:
        """Weigh the particles by the sum of the forces on the tools.

        Args:
            stamp: when it was measured [s].
            force: on the robot, x and y in the base frame, shape (2,) [N].
            noise: standard deviation of a component [N].

        Returns:
            What became of it; "stale" where it adds nothing: it says the same as the last one, or no object
            has been seen yet.
        """
        if not math.isfinite(self._frame_stamp):
            return Outcome("stale", "no object has been seen yet")
        return self._filter.touch(stamp, force, noise)

    def reset(self) -> None:
        """Forget the object and the tools."""
        self._filter.reset()
        self._frame_stamp = self._moved = -math.inf

    def update(self, stamp: float, pose: NDArray, covariance: NDArray) -> Outcome:
        """Take in a measured pose."""
        outcome = self._filter.update(stamp, pose, covariance)
        if outcome.kind in ("accepted", "reinitialized"):
            self._frame_stamp = stamp
        return outcome

    def state(self, now: float) -> ObjectState | None:
        """Mean and covariance, None if the object was not seen or the robot not heard for too long."""
        longest = self._bridging.fresh + self._bridging.prediction
        if now - self._frame_stamp > longest or now - self._moved > longest:
            return None
        return self._filter.state(self._moved)

    def belief(self, state: ObjectState, count: int) -> NDArray:
        """Particles."""
        belief = self._filter.belief(state.stamp, count)
        return np.zeros((0, 3)) if belief is None else belief.poses

    def status(self, now: float) -> FilterStatus:
        """How the filter is doing."""
        if not math.isfinite(self._moved):
            return FilterStatus("uninitialised", "no joint_states yet")
        return self._filter.status(now)

    def figures(self) -> dict[str, Any]:
        """How many particles there are."""
        return {"particles": self._filter.config.particles}

    def _warm_up(self) -> None:
        """Push an imaginary object, and look at it, with a filter whose table it is on."""
        dynamics, tools = self._filter.dynamics, self._tools
        twin = ObjectParticleFilter(self._filter.config, dynamics, np.random.default_rng(0))
        point = np.zeros(tools.dof)
        for column in dynamics.effectors.columns:
            point[column : column + 2] = 0.4, 0.1 - 0.1 * column
        tools.tool(tools.joints(point[None])[0])
        for index in range(8):
            point = point + 0.002
            twin.predict(0.01 * index, point)
            pose = _SEEN + np.array([0.004 * index, 0.0, 0.0])
            twin.update(0.01 * index, pose, 1e-6 * np.eye(3))
            twin.touch(0.01 * index, np.array([2.0, 0.0]), 0.1)
        twin.belief(0.08, 10)
        twin.state(0.08)
