"""Weighted particles that remember what they did during the last moments."""

import dataclasses
import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.estimation.object_state import ObjectState, wrap_angle

_TWIST_WINDOW = 0.05  # velocities are differences over this time [s]


@dataclasses.dataclass
class Snapshot:
    """What was at one time.

    Attributes:
        time: when [s].
        point: plane coordinates of the end effectors, shape (m,).
        poses: of the particles, yaw continuous over time, shape (P, 3).
    """

    time: float
    point: NDArray[np.float64]
    poses: NDArray[np.float64]


class ParticleCloud:
    """Particles with weights, parameters of their own and their recent past.

    Attributes:
        past: snapshots of the last moments, oldest first; poses are empty (0, 3) before :meth:`begin`.
        friction: of each particle, shape (P,).
        center: centre of friction of each, object frame [m], shape (P, 2).
        weights: sum to one, shape (P,).
    """

    def __init__(self, depth: float):
        """Remember `depth` seconds."""
        self._depth = depth
        self.past: deque[Snapshot] = deque()
        self.friction, self.center, self.weights = np.empty(0), np.empty((0, 2)), np.empty(0)

    @property
    def begun(self) -> bool:
        """Whether there are particles."""
        return len(self.weights) > 0

    @property
    def head(self) -> Snapshot:
        """The newest snapshot."""
        return self.past[-1]

    @property
    def effective(self) -> float:
        """Effective number of particles."""
        return float(1.0 / (self.weights @ self.weights))

    def begin(self, poses: NDArray, friction: NDArray, center: NDArray) -> None:
        """New particles, equally likely, that have stood where they are."""
        self.friction, self.center = friction, center
        self.weights = np.full(len(poses), 1.0 / len(poses))
        for snapshot in self.past:
            snapshot.poses = poses.copy()

    def push(self, time: float, point: NDArray, poses: NDArray) -> None:
        """Note what is now; what is too old is forgotten, but for one snapshot at or before the depth."""
        self.past.append(Snapshot(time, point, poses))
        while len(self.past) > 2 and self.past[1].time <= time - self._depth:
            self.past.popleft()

    def at(self, time: float) -> Snapshot:
        """What was at a time, interpolated; the newest or the oldest snapshot beyond them."""
        if time >= self.head.time:
            return self.head
        later = self.head
        for earlier in reversed(self.past):
            if earlier.time <= time:
                part = (time - earlier.time) / max(later.time - earlier.time, 1e-9)
                return Snapshot(
                    time,
                    earlier.point + part * (later.point - earlier.point),
                    earlier.poses + part * (later.poses - earlier.poses),
                )
            later = earlier
        return self.past[0]

    def velocity(self, time: float, window: float = 0.03) -> NDArray[np.float64]:
        """Velocity of the plane point during the last moments before a time, shape (m,)."""
        end, begin = self.at(time), self.at(time - window)
        return (end.point - begin.point) / max(end.time - begin.time, 1e-3)

    def shift(self, moves: NDArray) -> None:
        """Move particles by (P, 3), and their past with them."""
        for snapshot in self.past:
            snapshot.poses = snapshot.poses + moves

    def reweigh(self, likelihood: NDArray) -> None:
        """Multiply the weights; a likelihood that is zero for all changes nothing."""
        weights = self.weights * likelihood
        total = weights.sum()
        if total > 0.0 and math.isfinite(total):
            self.weights = weights / total

    def take(self, rows: NDArray) -> None:
        """Keep these particles, equally likely from now on."""
        self.friction, self.center = self.friction[rows], self.center[rows]
        self.weights = np.full(len(rows), 1.0 / len(rows))
        for snapshot in self.past:
            snapshot.poses = snapshot.poses[rows]

    def resample(self, width: float, friction_range: tuple[float, float], rng: np.random.Generator) -> None:
        """Draw equally likely particles and spread copies apart, so that mean and covariance stay.

        Kernel smoothing with shrinkage (Liu and West, 2001) over poses and parameters together: a belief that
        contact has made flat stays flat.

        Args:
            width: of the kernel in standard deviations of the belief; 0 leaves copies alike.
            friction_range: that friction is kept in.
            rng: source of randomness.
        """
        states = self._states()
        mean, covariance = moments(states, self.weights)
        rows = systematic(self.weights, len(self.weights), rng.random())
        self.take(rows)
        if width <= 0.0:
            return
        # A disc's yaw may have no spread at all: a positive semidefinite root.
        values, vectors = np.linalg.eigh(covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        noise = rng.standard_normal(states.shape) @ root.T
        spread = mean + math.sqrt(1.0 - width**2) * (states[rows] - mean) + width * noise
        self.shift(spread[:, :3] - states[rows, :3])
        self.friction = np.clip(spread[:, 3], *friction_range)
        self.center = spread[:, 4:]

    def _states(self) -> NDArray[np.float64]:
        poses = self.head.poses.copy()
        poses[:, 2] = poses[0, 2] + wrap_angle(poses[:, 2] - poses[0, 2])
        return np.column_stack([poses, self.friction, self.center])


def systematic(weights: NDArray, count: int, offset: float) -> NDArray[np.intp]:
    """Rows drawn in proportion to their weights, each as often as its share to within one.

    Args:
        weights: that sum to one, shape (P,).
        count: how many rows.
        offset: of the comb, in [0, 1); random for drawing, 0.5 for a fixed representative choice.
    """
    ladder = np.cumsum(weights)
    rows = np.searchsorted(ladder, (np.arange(count) + offset) / count * ladder[-1], side="right")
    return np.minimum(rows, len(weights) - 1)


def moments(rows: NDArray, weights: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weighted mean (n,) and covariance (n, n) of rows (P, n)."""
    mean = weights @ rows
    off = rows - mean
    return mean, (off.T * weights) @ off


def pose_moments(poses: NDArray, weights: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weighted mean pose, yaw in (-pi, pi], and covariance (3, 3)."""
    yaw = math.atan2(weights @ np.sin(poses[:, 2]), weights @ np.cos(poses[:, 2]))
    centred = poses.copy()
    centred[:, 2] = wrap_angle(poses[:, 2] - yaw)
    mean, covariance = moments(centred, weights)
    mean[2] = wrap_angle(mean[2] + yaw)
    return mean, covariance


def object_state(cloud: ParticleCloud, poses: NDArray, time: float) -> ObjectState:
    """Mean and covariance of pose and twist.

    Args:
        cloud: weights of the particles, and their past, from which their twists come.
        poses: of the particles at this time, shape (P, 3).
        time: [s].
    """
    last = min(time, cloud.head.time)
    end, begin = cloud.at(last), cloud.at(last - _TWIST_WINDOW)
    twists = (end.poses - begin.poses) / max(end.time - begin.time, 1e-3)
    mean, _ = pose_moments(poses, cloud.weights)
    off = poses - mean
    off[:, 2] = wrap_angle(off[:, 2])
    means, covariance = moments(np.column_stack([off, twists]), cloud.weights)
    return ObjectState(float(time), mean, means[3:], covariance + 1e-12 * np.eye(6))
