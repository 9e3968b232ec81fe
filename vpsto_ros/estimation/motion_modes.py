"""Interacting Kalman filters for an object that rests, moves evenly or is being accelerated (cf. 5.2.3).

The state is x, y, yaw and their time derivatives. All modes measure the pose; they differ in how the state
goes on. Each keeps a Gaussian; before every step the Gaussians are mixed according to how likely a change of
mode is (interacting multiple models, Blom and Bar-Shalom 1988). Yaw is continuous here, not wrapped, except
in differences.
"""

import dataclasses
import functools
import math

import numpy as np

from vpsto_ros.estimation.object_state import wrap_angle

_LOWEST_PROBABILITY = 1e-6
_IDENTITY = np.eye(6)
_MEASURES_POSE = np.eye(3, 6)


@dataclasses.dataclass(frozen=True)
class MotionModes:
    """How each of M modes moves.

    Attributes:
        keeps_velocity: 1 for constant velocity, 0 for an object at rest, shape (M,).
        position_noise: random walk of the pose in x, y [m/sqrt(s)] and yaw [rad/sqrt(s)], shape (M, 3).
        velocity_noise: random walk of the twist, shape (M, 3); as long as the mode keeps its velocity, per
            sqrt(s).
        dwell: mean time spent in a mode [s], shape (M,).
    """

    keeps_velocity: np.ndarray
    position_noise: np.ndarray
    velocity_noise: np.ndarray
    dwell: np.ndarray

    def transition(self, gap: float) -> tuple[np.ndarray, np.ndarray]:
        """Transition matrices (M, 6, 6) and process noise (M, 6, 6) over `gap` seconds > 0.

        White-noise acceleration with density q: the covariance of position and velocity is
        q [[dt^3/3, dt^2/2], [dt^2/2, dt]], positive definite, unlike (5.7) with its position noise of zero.
        """
        still, moving, noises = self._powers
        weights = np.array([1.0, gap, gap**2, gap**3])
        return still + gap * moving, (weights @ noises).reshape(still.shape)

    @functools.cached_property
    def _powers(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Transition still + dt moving, and process noise as a cubic in dt with coefficients (4, M * 36)."""
        count = len(self.dwell)
        axes = np.arange(3)
        keeps = self.keeps_velocity[:, None]
        still, moving = np.zeros((count, 6, 6)), np.zeros((count, 6, 6))
        still[:, axes, axes] = 1.0
        still[:, axes + 3, axes + 3] = keeps
        moving[:, axes, axes + 3] = keeps
        density = keeps * self.velocity_noise**2
        noise = np.zeros((4, count, 6, 6))
        noise[0][:, axes + 3, axes + 3] = (1.0 - keeps) * self.velocity_noise**2
        noise[1][:, axes, axes] = self.position_noise**2
        noise[1][:, axes + 3, axes + 3] = density
        noise[2][:, axes, axes + 3] = noise[2][:, axes + 3, axes] = density / 2
        noise[3][:, axes, axes] = density / 3
        return still, moving, noise.reshape(4, -1)

    def switching(self, gap: float) -> np.ndarray:
        """Probability of going from mode i to mode j within `gap` seconds, shape (M, M), rows sum to one."""
        count = len(self.dwell)
        leave = 1.0 - np.exp(-gap / self.dwell)
        if count == 1:
            return np.ones((1, 1))
        elsewhere = leave[:, None] / (count - 1)
        return elsewhere + np.diag(1.0 - leave - elsewhere[:, 0])


@dataclasses.dataclass(frozen=True)
class ModeBelief:
    """One Gaussian per mode: probability (M,), mean (M, 6) and covariance (M, 6, 6)."""

    probability: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (6,) and covariance (6, 6) of the mixture."""
        return _moments(self.probability, self.mean, self.covariance)

    def propagated(self, modes: MotionModes, gap: float, noise_gap: float | None = None) -> "ModeBelief":
        """Every mode by itself, `gap` seconds on.

        Args:
            modes: how the modes move.
            gap: time [s] by which the mean moves on, >= 0.
            noise_gap: time [s] over which the covariance grows, >= gap; the same by default.
        """
        matrix, noise = modes.transition(gap)
        if noise_gap is not None and noise_gap > gap:
            _, noise = modes.transition(noise_gap)
        mean = (matrix @ self.mean[:, :, None])[:, :, 0]
        return ModeBelief(self.probability, mean, _symmetric(matrix @ self.covariance @ _t(matrix) + noise))

    def mixed(self, modes: MotionModes, gap: float) -> "ModeBelief":
        """The belief at the start of each mode's step, when a change of mode may have happened."""
        joint = self.probability[:, None] * modes.switching(gap)
        probability = joint.sum(axis=0)
        share = (joint / probability).T  # row j: where mode j comes from
        mean = share @ self.mean
        off = self.mean[None] - mean[:, None]  # (j, i, 6)
        spread = self.covariance[None] + off[..., :, None] * off[..., None, :]
        covariance = (share[..., None, None] * spread).sum(axis=1)
        return ModeBelief(probability, mean, covariance)

    def innovation(self, pose: np.ndarray, covariance: np.ndarray) -> "Innovation":
        """How a measured pose (3,) with covariance (3, 3) differs from what each mode expects."""
        difference = pose - self.mean[:, :3]
        difference[:, 2] = wrap_angle(difference[:, 2])
        expected = self.covariance[:, :3, :3] + covariance
        inverse = np.linalg.inv(expected)
        weighted = (inverse @ difference[:, :, None])[:, :, 0]
        return Innovation(difference, expected, inverse, (difference * weighted).sum(axis=1))

    def updated(self, innovation: "Innovation", covariance: np.ndarray) -> "ModeBelief":
        """Bayes' rule for every mode and for their probabilities; Joseph form."""
        gain = self.covariance[:, :, :3] @ innovation.inverse
        mean = self.mean + (gain @ innovation.difference[:, :, None])[:, :, 0]
        rest = _IDENTITY - gain @ _MEASURES_POSE
        posterior = _symmetric(rest @ self.covariance @ _t(rest) + gain @ covariance @ _t(gain))
        log = -0.5 * (innovation.distance + np.log(np.linalg.det(innovation.expected)))
        probability = self.probability * np.exp(log - log.max())
        probability = np.maximum(probability / probability.sum(), _LOWEST_PROBABILITY)
        return ModeBelief(probability / probability.sum(), mean, posterior).unwound()

    def unwound(self) -> "ModeBelief":
        """Full turns removed from the yaw of all modes together."""
        yaw = float(self.probability @ self.mean[:, 2])
        turns = round(yaw / (2 * math.pi))
        if not turns:
            return self
        mean = self.mean.copy()
        mean[:, 2] -= 2 * math.pi * turns
        return dataclasses.replace(self, mean=mean)


@dataclasses.dataclass(frozen=True)
class Innovation:
    """Measured minus expected pose of each mode.

    Attributes:
        difference: shape (M, 3), yaw wrapped.
        expected: its covariance, shape (M, 3, 3).
        inverse: of that, shape (M, 3, 3).
        distance: squared Mahalanobis distance, shape (M,).
    """

    difference: np.ndarray
    expected: np.ndarray
    inverse: np.ndarray
    distance: np.ndarray


def _moments(
    weights: np.ndarray, means: np.ndarray, covariances: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    mean = weights @ means
    off = means - mean
    covariance = (weights[:, None, None] * covariances).sum(axis=0) + (off.T * weights) @ off
    return mean, _symmetric(covariance)


def _symmetric(matrices: np.ndarray) -> np.ndarray:
    return 0.5 * (matrices + _t(matrices))


def _t(matrices: np.ndarray) -> np.ndarray:
    return np.swapaxes(matrices, -1, -2)
