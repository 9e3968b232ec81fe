"""A short-horizon sampling MPC to compare with: model-predictive path integral control of a point.

Velocities over a short horizon are drawn around the present sequence, simulated, and averaged with weights
exp(-cost / temperature); the first step is applied, and the rest is where the next one begins. The noise is
drawn at a few knots and interpolated, and standing still is always among the samples, both as in the sampling
MPC that the thesis compares to (4.5.1). The limits of velocity and acceleration hold at every instant,
because every sample is clamped to them while it is simulated. Noise on accelerations instead was tried: it
settles at the goal more slowly, and not at all with long horizons.
"""

import dataclasses

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vpsto_ros.collision.planar import PlanarWorld
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
    temperature: float = option(0.003, "temperature of the weights, in the unit of the cost", minimum=1e-9)
    noise: float = option(1.5, "standard deviation of velocities, relative to the limit", minimum=1e-6)
    finest: float = option(
        1.0, "smallest standard deviation relative to the greatest; samples have all from one to the other",
        minimum=1e-6, maximum=1.0,
    )  # fmt: skip
    knots: int = option(4, "times at which noise is drawn; it is linear in between", minimum=2)
    terminal: float = option(3.0, "weight of the distance at the end of the horizon", minimum=0.0)
    running: float = option(1.0, "weight of the mean distance along the horizon", minimum=0.0)
    speed: float = option(0.0, "weight of the speed at the end of the horizon", unit="s", minimum=0.0)
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
        """The acceleration (n,) to apply for one period [1/s^2]; it keeps the limits.

        Args:
            position: when it will be applied, shape (n,).
            velocity: at that time, shape (n,), within its limits.
            goal: where to come to rest, shape (n,).
            world: obstacles, inflated by the margin to keep; discs as they are at that time.
        """
        for _ in range(self.config.iterations):
            samples, cost = self._sample(position, velocity, goal, world)
            weights = np.exp(-(cost - cost.min()) / self.config.temperature)
            self.sequence = np.tensordot(weights / weights.sum(), samples, axes=1)
        mean, positions = self._simulated(position, velocity, self.sequence[None])
        one_hit = self.config.collision / self.config.steps
        if self._cost(mean, positions, goal, world)[0] > cost.min() + one_hit:
            mean = samples[None, int(cost.argmin())]  # the average of good ways may be a bad one
        self.sequence = np.vstack([mean[0, 1:], np.zeros((1, self.limits.dof))])
        return (mean[0, 0] - velocity) / self.config.period

    def _sample(
        self, position: NDArray, velocity: NDArray, goal: NDArray, world: PlanarWorld
    ) -> tuple[NDArray, NDArray]:
        """Velocities (M, H, n) within the limits and their costs (M,); the second sample comes to rest."""
        config, n = self.config, self.limits.dof
        noise = self.rng.standard_normal((config.samples, self._interpolation.shape[1], n))
        noise *= np.geomspace(1.0, config.finest, config.samples)[:, None, None]
        wanted = self.sequence + config.noise * self.limits.velocity * (self._interpolation @ noise)
        wanted[0], wanted[1] = self.sequence, 0.0
        samples, positions = self._simulated(position, velocity, wanted)
        return samples, self._cost(samples, positions, goal, world)

    def _simulated(
        self, position: NDArray, velocity: NDArray, wanted: NDArray
    ) -> tuple[NDArray, NDArray]:
        """Velocities (M, H, n) as near to the wanted ones as the limits allow, and positions."""
        limits = self.limits
        return simulate(position, velocity, wanted, self.config.period, limits.velocity, limits.acceleration)

    def _cost(self, velocities: NDArray, positions: NDArray, goal: NDArray, world: PlanarWorld) -> NDArray:
        config = self.config
        distance = np.linalg.norm(positions - goal, axis=2)
        hit = world.inside(positions, config.period * np.arange(1, config.steps + 1))
        return (
            config.running * distance.mean(axis=1)
            + config.terminal * distance[:, -1]
            + config.speed * np.linalg.norm(velocities[:, -1], axis=1)
            + config.collision * hit.mean(axis=1)
        )


@njit(cache=True, nogil=True)
def simulate(position, velocity, wanted, period, fastest, strongest):
    """Velocities and positions (M, H, n) after every period under constant acceleration in between."""
    samples, steps, dof = wanted.shape
    velocities, positions = np.empty_like(wanted), np.empty_like(wanted)
    for m in range(samples):
        for j in range(dof):
            q, v, most = position[j], velocity[j], period * strongest[j]
            for k in range(steps):
                after = min(max(wanted[m, k, j], -fastest[j]), fastest[j])
                after = min(max(after, v - most), v + most)
                q += 0.5 * period * (v + after)
                v = after
                velocities[m, k, j], positions[m, k, j] = v, q
    return velocities, positions
