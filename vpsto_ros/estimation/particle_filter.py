"""A particle filter of an object's pose among end effectors whose motion is known (6.5, 6.6.4, 7.2.3).

Prediction draws from the transition probability (6.10): every particle is pushed along the measured motion of
the end effectors, with friction and a centre of friction of its own, so that the filter goes on through
drop-outs of the camera and learns how the object behaves.

Frames are late. Particles therefore remember the poses of their last moments, and a frame weighs each by
where it was when the picture was taken. That is exact, since weights belong to whole paths; it costs no
second propagation, which for objects with corners would cost more than all the rest; and touch, which is not
late, may have been used before. The price: a correction acts by selection, so a belief much narrower than
its error takes some frames to follow. Copies are spread apart with their past.
"""

import dataclasses
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.estimation import touch as touching
from vpsto_ros.estimation.measurement import (
    MeasurementLimits,
    Outcome,
    PoseMeasurement,
    checked,
    could_follow,
    finite_array,
)
from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.estimation.particle_cloud import ParticleCloud, object_state, pose_moments, systematic
from vpsto_ros.estimation.particle_filter_config import FilterStatus, ParticleFilterConfig, unseen
from vpsto_ros.estimation.particle_motion import ParticleMotion
from vpsto_ros.estimation.pose_weights import weigh
from vpsto_ros.exceptions import InvalidInputError


class ObjectParticleFilter:
    """Estimates an object's planar pose from late poses, motions of the end effectors and touch.

    Feed it every measured plane point (:meth:`predict`), pose (:meth:`update`) and, if wanted, force
    (:meth:`touch`); none of these raises, whatever comes from outside, and each says whether it was used and
    why not. Yaws of discs are not looked at.
    """

    def __init__(
        self,
        config: ParticleFilterConfig,
        dynamics: BeliefDynamics,
        rng: np.random.Generator,
        limits: MeasurementLimits | None = None,
    ) -> None:
        """Nothing is known yet.

        Args:
            config: options.
            dynamics: object, end effectors and noise; with friction, particles carry some.
            rng: source of randomness. Asking for a belief does not change what the filter draws.
            limits: where the object can be, and how late or early measurements may be; the default ones if
                None.
        """
        self.config, self.dynamics = config, dynamics
        self.limits = limits or MeasurementLimits()
        self._rng = rng
        self._reader = np.random.default_rng(rng.integers(2**63))
        self._model_covariance = np.diag([config.model_std[0], *config.model_std]) ** 2
        self._with_yaw = dynamics.radius is None
        self._motion = ParticleMotion(dynamics, config.drift, config.longest_step)
        self.reset()

    def reset(self) -> None:
        """Forget everything, also how late it is."""
        self._cloud = ParticleCloud(self.limits.max_age)
        self._seen = self._stamp = self._touched = -math.inf
        self._felt: tuple[bool, ...] = ()
        self._pending: list[PoseMeasurement] = []
        self._unconfirmed = 0
        self._trouble = ""

    def predict(self, time: float, plane_point: ArrayLike) -> Outcome:
        """Take in where the end effectors are, and push the particles along.

        Args:
            time: of the measurement [s], later than the last one.
            plane_point: plane coordinates, shape (m,).

        Returns:
            "accepted", "stale" (not later; after a clock was set back, until :meth:`reset`) or "invalid:
            reason".
        """
        point, defect = finite_array(plane_point, (self.dynamics.effectors.dof,))
        when, wrong = finite_array(time, ())
        if defect or wrong:
            return Outcome("invalid", f"plane point or time: {defect or wrong}")
        cloud, now = self._cloud, float(when)
        if not cloud.past:
            cloud.push(now, point, np.empty((0, 3)))
            return Outcome("accepted", "first plane point")
        gap = now - cloud.head.time
        if gap <= 0.0:
            return Outcome("stale", f"time goes back by {-gap:.4g} s")
        jump = float(np.abs(point - cloud.head.point).max())
        known = gap <= self.config.longest_gap and jump <= self.config.longest_jump
        before, poses = cloud.head.point if known else point, cloud.head.poses
        if cloud.begun:
            path = self._motion.refined(before, point)
            poses = self._motion.drawn(cloud, poses, gap, path, self._rng)
        cloud.push(now, point, poses)
        reason = f"the way is unknown after a gap of {gap:.2g} s and {jump:.2g} m or rad"
        return Outcome("accepted", "" if known else reason)

    def update(self, stamp: float, pose: ArrayLike, covariance: ArrayLike) -> Outcome:
        """Take in a measured pose.

        Args:
            stamp: when it was measured [s]; may be late by ``limits.max_age``, but newer than the last one.
            pose: x, y [m] and yaw [rad] in the base frame, shape (3,).
            covariance: of the pose, shape (3, 3).

        Returns:
            "accepted", "outlier" (it has hardly any effect), "reinitialized" (the belief is drawn around this
            pose: the last few contradicted the old one and agree), "stale" or "invalid: reason".
        """
        defect, measurement = checked(stamp, pose, covariance)
        if measurement is None:
            return Outcome("invalid", defect)
        refused = self._refusal(measurement)
        if refused is not None:
            return refused
        noise = measurement.covariance + self._model_covariance
        measurement = dataclasses.replace(measurement, covariance=noise)
        self._stamp = measurement.stamp
        if not self._cloud.begun:
            self._restart(measurement)
            return Outcome("accepted", "first pose")
        doubt = weigh(self._cloud, measurement, self.config, with_yaw=self._with_yaw, rng=self._rng)
        self._settle()
        if doubt <= 0.5:
            self._seen = measurement.stamp
            self._pending.clear()
            self._unconfirmed = max(self._unconfirmed - 1, 0)
            return Outcome("accepted")
        return self._contradicted(measurement, doubt)

    def touch(self, stamp: float, force: ArrayLike, noise: float) -> Outcome:
        """Take in measured contact forces, or that there are none.

        Args:
            stamp: when [s]; no longer than ``limits.max_age`` ago.
            force: on the robot, in the plane, as in `external_wrench` [N]: on each end effector, shape
                (E, 2), or their sum, shape (2,).
            noise: standard deviation of a component [N].

        Returns:
            "accepted", "outlier" (a force where no particle can be), "stale" or "invalid: reason".
        """
        effectors = self.dynamics.effectors.count
        values, defect = finite_array(force, (2,), (effectors, 2))
        numbers, wrong = finite_array([stamp, noise], (2,))
        if defect or wrong or numbers[1] < 0.0:
            return Outcome("invalid", f"force, stamp or noise: {defect or wrong or 'noise is negative'}")
        refused = self._touch_refusal(float(stamp))
        if refused is not None:
            return refused
        measured = touching.read(self.config.touch, -values.reshape(-1, 2), float(noise))
        felt = tuple(measured.felt.tolist())
        if felt == self._felt and stamp < self._touched + self.config.touch.interval:
            return Outcome("stale", "says the same as the one just used")
        self._touched, self._felt = float(stamp), felt
        if not touching.weigh(
            self._cloud, measured, float(stamp), self.config.touch, self.dynamics, self._rng
        ):
            return Outcome("outlier", "a force is felt where no particle is near")
        self._settle()
        return Outcome("accepted", "contact" if measured.felt.any() else "no contact")

    def belief(
        self, time: float, count: int | None = None, path: ArrayLike | None = None
    ) -> ObjectBelief | None:
        """Equally likely particles at a time, None before the first pose.

        Args:
            time: [s]; beyond the last plane point the end effectors move on for ``extrapolation`` and stand
                then, unless `path` says where they go.
            count: number of particles; as many as the filter has if None.
            path: plane points from the last one to where the end effectors are at `time`, shape (K, m).

        Raises:
            InvalidInputError: the time is not finite, there are fewer than two particles, or the path is not
                one.
        """
        poses, cloud = self._poses(time, path), self._cloud
        if poses is None:
            return None
        rows = systematic(cloud.weights, cloud.weights.size if count is None else count, 0.5)
        return ObjectBelief(poses[rows], cloud.friction[rows], cloud.center[rows])

    def state(self, time: float) -> ObjectState | None:
        """Mean and covariance of pose and twist at a time [s], None before the first pose.

        Raises:
            InvalidInputError: the time is not finite.
        """
        poses = self._poses(time, None)
        if poses is None:
            return None
        state = object_state(self._cloud, poses, time)
        state.covariance[:3, :3] += self._model_covariance
        return state

    def status(self, time: float) -> FilterStatus:
        """How the filter is doing at a time [s], with the reason in words."""
        cloud = self._cloud
        if not cloud.begun:
            return FilterStatus("uninitialised", self._trouble or "no pose of the object yet")
        spread = math.sqrt(np.trace(pose_moments(cloud.head.poses, cloud.weights)[1][:2, :2]))
        gap = time - self._seen
        if gap > self.config.lost_after and spread > self.config.lost_spread:
            return FilterStatus("lost", unseen(gap, spread))
        if len(self._pending) > 1:
            return FilterStatus("recovering", f"{len(self._pending)} poses in a row contradict the belief")
        trouble = f"last pose refused: {self._trouble}" if self._trouble else ""
        if self._unconfirmed:
            reason = f"just started; {self._unconfirmed} more poses must agree"
            return FilterStatus("recovering", "; ".join(filter(None, (reason, trouble))))
        quiet = unseen(gap, spread) if gap > self.config.lost_after else ""
        return FilterStatus("tracking", trouble or quiet)

    def _refusal(self, measurement: PoseMeasurement) -> Outcome | None:
        """Why a well-formed pose cannot be used, None if it can."""
        cloud, limits = self._cloud, self.limits
        self._trouble = ""
        if not cloud.past:
            self._trouble = "no plane point of the end effectors yet"
        elif measurement.stamp > cloud.head.time + limits.max_ahead:
            ahead = measurement.stamp - cloud.head.time
            self._trouble = f"stamp is {ahead:.2g} s ahead of the last plane point"
        else:
            self._trouble = limits.objection(measurement.pose, measurement.covariance)
        if self._trouble:
            return Outcome("invalid", self._trouble)
        if measurement.stamp <= self._stamp:
            return Outcome("stale", f"stamp is {self._stamp - measurement.stamp:.4g} s older than the last")
        late = cloud.head.time - measurement.stamp
        if late > limits.max_age:
            return Outcome("stale", f"{late:.2g} s late; the particles remember {limits.max_age} s")
        return None

    def _touch_refusal(self, stamp: float) -> Outcome | None:
        cloud = self._cloud
        if not cloud.begun:
            return Outcome("invalid", "nothing is known about the object yet")
        ahead = stamp - cloud.head.time
        if ahead > self.limits.max_ahead:
            return Outcome("invalid", f"stamp is {ahead:.2g} s ahead of the last plane point")
        if stamp < self._touched or -ahead > self.limits.max_age:
            return Outcome("stale", f"stamp is {-ahead:.4g} s late, or older than the last one")
        return None

    def _restart(self, measurement: PoseMeasurement) -> None:
        """Draw the belief around a pose; what was learnt about friction stays."""
        config, cloud, count = self.config, self._cloud, self.config.particles
        if cloud.begun:
            cloud.resample(config.jitter, config.friction, self._rng)
            friction, center = cloud.friction, cloud.center
        else:
            friction = self._rng.uniform(*config.friction, count)
            center = config.center_std * self._rng.standard_normal((count, 2))
        root = np.linalg.cholesky(measurement.covariance)
        poses = measurement.pose + self._rng.standard_normal((count, 3)) @ root.T
        cloud.begin(poses, friction, center)
        self._motion.restart(cloud, measurement.stamp, poses, self._rng)
        self._seen = measurement.stamp
        self._pending, self._unconfirmed = [], config.confirmations - 1

    def _contradicted(self, measurement: PoseMeasurement, doubt: float) -> Outcome:
        """Count what the belief cannot explain; enough of it in agreement means that the belief is wrong."""
        config, last = self.config, self._pending[-1:]
        if last and not could_follow(last[0], measurement, config.max_speed, max_gap=config.lost_after):
            self._pending.clear()
        self._pending.append(measurement)
        count = len(self._pending)
        if count < config.confirmations:
            return Outcome("outlier", f"an outlier with probability {doubt:.3f}")
        self._restart(measurement)
        return Outcome("reinitialized", f"{count} consecutive poses contradict the belief and agree")

    def _settle(self) -> None:
        """Draw particles anew if few of them matter, and keep them out of the end effectors."""
        cloud, config = self._cloud, self.config
        if cloud.effective < config.resampling * config.particles:
            cloud.resample(config.jitter, config.friction, self._rng)
        head = cloud.head
        head.poses = self._motion.outside(cloud, head.poses, head.point, self._rng)

    def _poses(self, time: float, path: ArrayLike | None) -> NDArray[np.float64] | None:
        """Of the particles at a time, predicted if it is later than the last plane point."""
        if not math.isfinite(time):
            raise InvalidInputError(f"cannot predict to time {time!r}")
        cloud = self._cloud
        if not cloud.begun:
            return None
        gap = time - cloud.head.time
        if gap <= 0.0:
            return cloud.at(time).poses
        if path is None:
            ahead = min(gap, self.config.extrapolation)
            target = cloud.head.point + ahead * cloud.velocity(cloud.head.time)
            path = self._motion.refined(cloud.head.point, target)
        way = np.asarray(path, dtype=float)
        return self._motion.drawn(cloud, cloud.head.poses, gap, way, self._reader)
