"""A short-horizon sampling MPC to compare with: model-predictive path integral control of a point.

Velocities over a short horizon are drawn around the present sequence, simulated, and averaged with weights
exp(-cost / temperature); the first step is applied, and the rest is where the next one begins. The noise is
drawn at a few knots and interpolated, and standing still is always among the samples, both as in the sampling
MPC that the thesis compares to (4.5.1). The limits of velocity and acceleration hold at every instant,
because every sample is clamped to them while it is simulated. Accelerations can be drawn instead; what that
and other settings do, ``vpsto experiment clutter_2d_mpc --tune`` tells.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vpsto_ros.collision.planar import PlanarWorld
from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.trajectory import Limits


@documented
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
    accelerations: bool = option(False, "draw accelerations instead of velocities")
    noise: float = option(1.5, "standard deviation of what is drawn, relative to its limit", minimum=1e-6)
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
        mean = self._simulated(position, velocity, self.sequence[None])
        one_hit = self.config.collision / self.config.steps
        if self._cost(mean, goal, world)[0] > cost.min() + one_hit:
            best = samples[None, int(cost.argmin())]  # the average of good ways may be a bad one
            mean = self._simulated(position, velocity, best)
        self.sequence = np.vstack([mean.commands[0, 1:], np.zeros((1, self.limits.dof))])
        return (mean.velocities[0, 0] - velocity) / self.config.period

    def _sample(
        self, position: NDArray, velocity: NDArray, goal: NDArray, world: PlanarWorld
    ) -> tuple[NDArray, NDArray]:
        """Sequences (M, H, n) within the limits and their costs (M,); the second one comes to rest."""
        config, n = self.config, self.limits.dof
        limit = self.limits.acceleration if config.accelerations else self.limits.velocity
        noise = self.rng.standard_normal((config.samples, self._interpolation.shape[1], n))
        noise *= np.geomspace(1.0, config.finest, config.samples)[:, None, None]
        wanted = self.sequence + config.noise * limit * (self._interpolation @ noise)
        wanted[0], wanted[1] = self.sequence, self._stop(velocity)
        rollouts = self._simulated(position, velocity, wanted)
        return rollouts.commands, self._cost(rollouts, goal, world)

    def _stop(self, velocity: NDArray) -> NDArray:
        """The sequence (H, n) that comes to rest as fast as the limits allow."""
        if not self.config.accelerations:
            return np.zeros_like(self.sequence)
        steps = np.arange(self.config.steps)[:, None]
        left = np.abs(velocity) / self.config.period - steps * self.limits.acceleration
        return -np.sign(velocity) * np.clip(left, 0.0, self.limits.acceleration)

    def _simulated(self, position: NDArray, velocity: NDArray, wanted: NDArray) -> "Rollouts":
        """What the limits leave of the wanted sequences (M, H, n), and where it leads."""
        period, limits, accelerating = self.config.period, self.limits, self.config.accelerations
        velocities, positions = simulate(
            position, velocity, wanted, accelerating, period, limits.velocity, limits.acceleration
        )
        first = np.broadcast_to(velocity, (len(wanted), 1, limits.dof))
        commands = np.diff(velocities, axis=1, prepend=first) / period if accelerating else velocities
        return Rollouts(commands, velocities, positions)

    def _cost(self, rollouts: "Rollouts", goal: NDArray, world: PlanarWorld) -> NDArray:
        config, velocities, positions = self.config, rollouts.velocities, rollouts.positions
        distance = np.linalg.norm(positions - goal, axis=2)
        hit = world.inside(positions, config.period * np.arange(1, config.steps + 1))
        return (
            config.running * distance.mean(axis=1)
            + config.terminal * distance[:, -1]
            + config.speed * np.linalg.norm(velocities[:, -1], axis=1)
            + config.collision * hit.mean(axis=1)
        )


class Rollouts(NamedTuple):
    """Simulated sequences, each array (M, H, n).

    Attributes:
        commands: what is drawn and averaged: velocities, or accelerations.
        velocities: after every period [1/s].
        positions: after every period.
    """

    commands: NDArray
    velocities: NDArray
    positions: NDArray


@njit(cache=True, nogil=True)
def simulate(position, velocity, wanted, accelerating, period, fastest, strongest):
    """Velocities and positions (M, H, n) after every period under constant acceleration in between.

    `wanted` (M, H, n) are velocities at the ends of the periods or, if `accelerating`, accelerations in them.
    """
    samples, steps, dof = wanted.shape
    velocities, positions = np.empty_like(wanted), np.empty_like(wanted)
    for m in range(samples):
        for j in range(dof):
            q, v, most = position[j], velocity[j], period * strongest[j]
            for k in range(steps):
                after = v + period * wanted[m, k, j] if accelerating else wanted[m, k, j]
                after = min(max(after, -fastest[j]), fastest[j])
                after = min(max(after, v - most), v + most)
                q += 0.5 * period * (v + after)
                v = after
                velocities[m, k, j], positions[m, k, j] = v, q
    return velocities, positions
