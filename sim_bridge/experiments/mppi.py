"""A short-horizon sampling MPC to compare with: model-predictive path integral control of a point.

Accelerations over a short horizon are drawn around the present sequence, simulated, and averaged with weights
exp(-cost / temperature); the first is applied, and the rest is where the next step begins. The noise is drawn
at a few knots and interpolated, so that the accelerations are smooth, and the sequence that brakes is always
among the samples: both as in the sampling MPC that the thesis compares to (4.5.1). The limits of acceleration
and velocity hold at every instant, because every sample is clamped to them while it is simulated.
"""

import dataclasses
import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vpsto_ros.collision.planar import MovingDisc, PlanarWorld
from vpsto_ros.configuration import option, validate
from vpsto_ros.trajectory import Limits


@dataclasses.dataclass(frozen=True)
class MppiConfig:
    """Options of :class:`Mppi`.

    Raises:
        ConfigurationError: a value is out of range.
    """

    period: float = option(0.05, "time for which an acceleration is applied", unit="s", minimum=1e-3)
    horizon: float = option(1.0, "how far samples reach", unit="s", minimum=0.1, maximum=60.0)
    points: int = option(12_500, "simulated points per control step, over all iterations", minimum=100)
    iterations: int = option(2, "how often the sequence is improved per control step", minimum=1)
    temperature: float = option(0.02, "temperature of the weights, in the unit of the cost", minimum=1e-9)
    noise: float = option(0.7, "standard deviation of accelerations, relative to the limit", minimum=1e-6)
    finest: float = option(
        0.03, "smallest standard deviation relative to the greatest; samples have all from one to the other",
        minimum=1e-6, maximum=1.0,
    )  # fmt: skip
    knots: int = option(6, "times at which noise is drawn; it is linear in between", minimum=2)
    terminal: float = option(1.0, "weight of the distance at the end of the horizon", minimum=0.0)
    running: float = option(1.0, "weight of the mean distance along the horizon", minimum=0.0)
    speed: float = option(0.1, "weight of the speed at the end of the horizon", unit="s", minimum=0.0)
    collision: float = option(10.0, "weight of the share of points in collision", minimum=0.0)

    def __post_init__(self) -> None:
        validate(self)

    @property
    def steps(self) -> int:
        """Number H of accelerations in a sequence."""
        return max(2, round(self.horizon / self.period))

    @property
    def samples(self) -> int:
        """Number M of sequences per iteration."""
        return max(4, self.points // (self.steps * self.iterations))


class Mppi:
    """Model-predictive path integral control of a double integrator in the plane."""

    def __init__(self, limits: Limits, config: MppiConfig, rng: np.random.Generator) -> None:
        self.limits, self.config, self.rng = limits, config, rng
        self.sequence = np.zeros((config.steps, limits.dof))
        knots = np.linspace(0.0, config.steps - 1.0, min(config.knots, config.steps))
        hats = [np.interp(np.arange(config.steps), knots, unit) for unit in np.eye(len(knots))]
        self._interpolation = np.stack(hats, axis=1)

    def step(self, position: NDArray, velocity: NDArray, goal: NDArray, world: PlanarWorld) -> NDArray:
        """The acceleration (n,) to apply for one period [1/s^2].

        Args:
            position: when it will be applied, shape (n,).
            velocity: at that time, shape (n,), within its limits.
            goal: where to come to rest, shape (n,).
            world: obstacles, with the margin to keep (see :func:`grown`); discs as they are at that time.
        """
        for _ in range(self.config.iterations):
            controls, cost = self._sample(position, velocity, goal, world)
            weights = np.exp(-(cost - cost.min()) / self.config.temperature)
            self.sequence = np.tensordot(weights / weights.sum(), controls, axes=1)
        mean = self._simulated(position, velocity, self.sequence[None].copy())
        if self._cost(*mean, goal, world)[0] > cost.min() + self.config.collision / self.config.steps:
            self.sequence = controls[int(cost.argmin())]  # the average of good ways may be a bad one
        else:
            self.sequence = mean[0][0]
        applied = self.sequence[0].copy()
        self.sequence = np.vstack([self.sequence[1:], np.zeros((1, self.limits.dof))])
        return applied

    def _sample(
        self, position: NDArray, velocity: NDArray, goal: NDArray, world: PlanarWorld
    ) -> tuple[NDArray, NDArray]:
        """Clamped sequences (M, H, n) and their costs (M,); the first is the mean, the second brakes."""
        config, n = self.config, self.limits.dof
        noise = self.rng.standard_normal((config.samples, self._interpolation.shape[1], n))
        noise *= np.geomspace(1.0, config.finest, config.samples)[:, None, None]
        controls = self.sequence + config.noise * self.limits.acceleration * (self._interpolation @ noise)
        controls[0] = self.sequence
        controls[1] = _braking(velocity, config.steps, config.period, self.limits.acceleration)
        simulated = self._simulated(position, velocity, controls)
        return simulated[0], self._cost(*simulated, goal, world)

    def _simulated(
        self, position: NDArray, velocity: NDArray, controls: NDArray
    ) -> tuple[NDArray, NDArray, NDArray]:
        """The sequences clamped to the limits, and the positions and speeds they lead through (M, H, n)."""
        limits = self.limits
        positions, velocities = simulate(
            position, velocity, controls, self.config.period, limits.velocity, limits.acceleration
        )
        return controls, positions, velocities

    def _cost(
        self, controls: NDArray, positions: NDArray, velocities: NDArray, goal: NDArray, world: PlanarWorld
    ) -> NDArray:
        config = self.config
        distance = np.linalg.norm(positions - goal, axis=2)
        times = config.period * np.arange(1, config.steps + 1)
        hit = world.inside(positions, times)
        return (
            config.running * distance.mean(axis=1)
            + config.terminal * distance[:, -1]
            + config.speed * np.linalg.norm(velocities[:, -1], axis=1)
            + config.collision * hit.mean(axis=1)
        )


@njit(cache=True, nogil=True)
def simulate(position, velocity, controls, period, fastest, strongest):
    """Positions and velocities (M, H, n) after every period; clamps `controls` (M, H, n) in place."""
    samples, steps, dof = controls.shape
    positions, velocities = np.empty_like(controls), np.empty_like(controls)
    for m in range(samples):
        for j in range(dof):
            q, v = position[j], velocity[j]
            for k in range(steps):
                a = min(max(controls[m, k, j], -strongest[j]), strongest[j])
                a = min(max(a, (-fastest[j] - v) / period), (fastest[j] - v) / period)
                q += period * (v + 0.5 * period * a)
                v = min(max(v + period * a, -fastest[j]), fastest[j])
                controls[m, k, j], positions[m, k, j], velocities[m, k, j] = a, q, v
    return positions, velocities


def _braking(velocity: NDArray, steps: int, period: float, strongest: NDArray) -> NDArray:
    """Accelerations (H, n) that come to rest evenly, as soon as all joints can."""
    needed = math.ceil(float(np.max(np.abs(velocity) / (strongest * period))) - 1e-9)
    controls = np.zeros((steps, len(velocity)))
    if needed:
        controls[:needed] = -velocity / (needed * period)
    return controls


def grown(world: PlanarWorld, margin: float) -> PlanarWorld:
    """The world with the edges of its polygons moved outwards, and the walls inwards, by a margin [m].

    Corners stay corners, so this costs no more to check, and keeps a little more away from them than needed.
    """
    polygons = []
    for polygon in world.polygons:
        along = np.roll(polygon, -1, axis=0) - polygon
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        x, y = polygon.T
        area = float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
        outward = math.copysign(1.0, area) * np.stack([along[:, 1], -along[:, 0]], axis=1)
        before = np.roll(outward, 1, axis=0)
        polygons.append(
            polygon + margin * (outward + before) / (1.0 + (outward * before).sum(axis=1, keepdims=True))
        )
    discs = tuple(MovingDisc(disc.centre, disc.radius + margin, disc.velocity) for disc in world.discs)
    return PlanarWorld(world.lower + margin, world.upper - margin, tuple(polygons), discs, world.names)
