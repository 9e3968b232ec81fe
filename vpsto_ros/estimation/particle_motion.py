"""How particles move when the end effectors do: draws from the transition probability (6.10)."""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.estimation.particle_cloud import ParticleCloud


class ParticleMotion:
    """The noisy dynamics of the particles of a cloud, and what keeps them out of the end effectors."""

    def __init__(self, dynamics: BeliefDynamics, drift: tuple[float, float], longest_step: float):
        """Fix the model.

        Args:
            dynamics: object, end effectors and noise in contact.
            drift: random walk besides contact, linear and angular [m, rad per sqrt(s)].
            longest_step: plane points farther apart are interpolated [m or rad].
        """
        self._dynamics, self._longest_step = dynamics, longest_step
        self._drift = np.array([drift[0], *drift])
        self._pushes_out = dataclasses.replace(dynamics, friction=False, step_variance=0.0, way_variance=0.0)

    def drawn(
        self, cloud: ParticleCloud, poses: NDArray, gap: float, path: NDArray, rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """Poses after the end effectors have gone along a path (K + 1, m) within a time [s]."""
        moved = poses + math.sqrt(gap) * self._drift * rng.standard_normal(poses.shape)
        belief = ObjectBelief(moved, cloud.friction, cloud.center)
        return self._dynamics.simulate(belief, path, rng).belief.poses

    def outside(
        self, cloud: ParticleCloud, poses: NDArray, point: NDArray, rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """Poses moved out of standing end effectors by the shortest way."""
        belief = ObjectBelief(poses, cloud.friction, cloud.center)
        return self._pushes_out.simulate(belief, np.array([point, point]), rng).belief.poses

    def restart(self, cloud: ParticleCloud, stamp: float, poses: NDArray, rng: np.random.Generator) -> None:
        """Put a begun cloud to poses that belong to a stamp, and let what has happened since happen again."""
        start, before = cloud.at(stamp).point, stamp
        poses = self.outside(cloud, poses, start, rng)
        for snapshot in cloud.past:
            if snapshot.time > stamp:
                path = self.refined(start, snapshot.point)
                poses = self.drawn(cloud, poses, snapshot.time - before, path, rng)
                start, before = snapshot.point, snapshot.time
            snapshot.poses = poses

    def refined(self, start: NDArray, end: NDArray) -> NDArray[np.float64]:
        """Points from start to end, close enough for the dynamics, shape (K + 1, m)."""
        count = max(1, math.ceil(float(np.abs(end - start).max()) / self._longest_step))
        return start + np.linspace(0.0, 1.0, count + 1)[:, None] * (end - start)
