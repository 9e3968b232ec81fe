"""The belief over an object: equally weighted particles, eq. (6.22)."""

import dataclasses
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError


@dataclasses.dataclass(frozen=True, eq=False)
class ObjectBelief:
    """Equally likely hypotheses about an object on the table.

    Args:
        poses: (x, y, yaw) in the base frame [m, m, rad], shape (P, 3), P >= 2.
        friction: coefficient of friction between object and end effectors, shape (P,); 0 by default.
        center: centre of friction (below the centre of mass) in the object frame [m], shape (P, 2); the
            origin by default.

    Raises:
        InvalidInputError: a shape does not fit, a number is not finite, a friction is negative, or there is
            only one particle.
    """

    poses: NDArray[np.float64]
    friction: NDArray[np.float64] = None  # type: ignore[assignment]  # filled in
    center: NDArray[np.float64] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        poses = np.array(self.poses, dtype=float)
        if poses.ndim != 2 or poses.shape[1:] != (3,) or len(poses) < 2:
            raise InvalidInputError(f"a belief needs poses (P, 3) with P >= 2, got shape {poses.shape}")
        count = len(poses)
        friction = np.zeros(count) if self.friction is None else np.array(self.friction, dtype=float)
        center = np.zeros((count, 2)) if self.center is None else np.array(self.center, dtype=float)
        if friction.shape != (count,) or center.shape != (count, 2):
            raise InvalidInputError(
                f"a belief of {count} particles needs friction ({count},) and center ({count}, 2), got "
                f"{friction.shape} and {center.shape}"
            )
        if not all(np.isfinite(array).all() for array in (poses, friction, center)):
            raise InvalidInputError("a belief must be finite: a particle has a NaN or an infinite entry")
        if (friction < 0.0).any():
            raise InvalidInputError(f"friction must not be negative, got {friction.min()}")
        for name, array in {"poses": poses, "friction": friction, "center": center}.items():
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @classmethod
    def gaussian(
        cls,
        mean: ArrayLike,
        std: ArrayLike,
        count: int,
        rng: np.random.Generator,
        *,
        friction: tuple[float, float] = (0.0, 0.0),
        center_std: float = 0.0,
    ) -> "ObjectBelief":
        """Draw a belief.

        Args:
            mean: mean pose (3,).
            std: standard deviations of x, y and yaw, (3,), or one number for x and y alone [m].
            count: number of particles P.
            rng: source of randomness.
            friction: range of the uniformly distributed friction.
            center_std: standard deviation of both coordinates of the centre of friction [m].

        Raises:
            InvalidInputError: an argument is out of range or of the wrong shape.
        """
        mean = np.asarray(mean, dtype=float)
        spread = np.asarray(std, dtype=float)
        spread = np.array([spread, spread, 0.0]) if spread.ndim == 0 else spread
        if mean.shape != (3,) or spread.shape != (3,) or not (spread >= 0.0).all() or center_std < 0.0:
            raise InvalidInputError(
                f"expected a mean (3,) and standard deviations that are not negative, got {mean!r}, {std!r} "
                f"and center_std = {center_std}"
            )
        if not 0.0 <= friction[0] <= friction[1]:
            raise InvalidInputError(f"friction must be a range from 0 up, got {friction}")
        return cls(
            mean + spread * rng.standard_normal((count, 3)),
            rng.uniform(*friction, count),
            center_std * rng.standard_normal((count, 2)),
        )

    @property
    def count(self) -> int:
        """Number of particles P."""
        return len(self.poses)

    @cached_property
    def mean(self) -> NDArray[np.float64]:
        """Mean pose (3,); the yaw is the direction of the mean of the directions."""
        yaw = np.arctan2(np.sin(self.poses[:, 2]).mean(), np.cos(self.poses[:, 2]).mean())
        return np.array([*self.poses[:, :2].mean(axis=0), yaw])

    @cached_property
    def continuous_poses(self) -> NDArray[np.float64]:
        """The poses with yaws within half a turn of the mean, so that they can be averaged, (P, 3)."""
        poses, mean = self.poses.copy(), self.mean[2]
        poses[:, 2] = mean + np.remainder(poses[:, 2] - mean + np.pi, 2.0 * np.pi) - np.pi
        return poses

    @cached_property
    def covariance(self) -> NDArray[np.float64]:
        """Covariance of the position (2, 2) [m^2]."""
        offset = self.poses[:, :2] - self.mean[:2]
        return offset.T @ offset / self.count

    @property
    def variance(self) -> float:
        """Variance of the position, eq. (6.23): the trace of its covariance [m^2]."""
        return float(np.trace(self.covariance))

    def jittered(self, std: float, rng: np.random.Generator) -> "ObjectBelief":
        """The same with independent noise on the positions.

        A robust plan gathers the particles of its nominal rollout in one point, where the variance gain says
        nothing any more (6.5); a real belief never is one point.
        """
        poses = self.poses.copy()
        poses[:, :2] += std * rng.standard_normal((self.count, 2))
        return dataclasses.replace(self, poses=poses)

    def resampled(self, count: int, rng: np.random.Generator) -> "ObjectBelief":
        """`count` particles drawn from these, each as often as can be."""
        rows = np.concatenate(
            [np.tile(np.arange(self.count), count // self.count),
             rng.permutation(self.count)[: count % self.count]]
        )  # fmt: skip
        return ObjectBelief(self.poses[rows], self.friction[rows], self.center[rows])
