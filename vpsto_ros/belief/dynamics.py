"""Belief dynamics through contacts (6.3): prediction without sampling perturbations, and noisy rollouts.

Two models behind one interface. The thesis's: contacts are frictionless and all particles alike, a Gaussian
perturbation per step in contact stands for all that is unknown. The other one lets every particle carry its
own friction and centre of friction, which is what objects really differ in, and perturbs by the way that the
object is pushed, so that a prediction does not depend on how finely time is cut.
"""

import dataclasses
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.contact import disc_rollout, multi_tool
from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import Disc, PlanarShape
from vpsto_ros.exceptions import InvalidInputError


@dataclasses.dataclass(frozen=True)
class BeliefPrediction:
    """Nominal belief of B candidates at steps 0..K; nothing in it is random.

    Attributes:
        mean: mean position and, for objects with an orientation, yaw, shape (B, K + 1, 2 or 3) [m, rad].
        variance: (6.23) of the nominal belief, shape (B, K + 1) [m^2].
        contact: share of the particles in contact, (6.24), shape (B, K).
        wedge: smallest product of the normals of two contacts of one particle, shape (B,): 1 without any,
            towards -1 the object is squeezed, -1 where no displacement frees it.
        step: longest displacement of a particle in one step, shape (B,) [m].
    """

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    contact: NDArray[np.float64]
    wedge: NDArray[np.float64]
    step: NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class BeliefRollout:
    """A noisy rollout of a belief.

    Attributes:
        poses: of the particles at every stride-th step from the first on, shape (R, P, 3).
        belief: after the last step.
        wedge: smallest product of the normals of two contacts.
    """

    poses: NDArray[np.float64]
    belief: ObjectBelief
    wedge: float


@dataclasses.dataclass(frozen=True)
class BeliefDynamics:
    """The stochastic quasi-static dynamics (6.7) of an object among end effectors.

    Attributes:
        shape: the object: a disc centred in its frame, or any union of rectangles and discs.
        effectors: what the robot touches with.
        friction: whether particles' friction and centres of friction act; without, contacts are frictionless
            and pushes go through the centre, as in the thesis.
        step_variance: variance of the perturbation per step in contact [m^2]: the thesis's noise.
        way_variance: variance of the perturbation per metre that the object is pushed [m].
        pressure_radius: c of the limit surface [m]; that of evenly spread pressure if None.

    Raises:
        InvalidInputError: a noise is negative or not finite.
    """

    shape: PlanarShape
    effectors: EndEffectors
    friction: bool = False
    step_variance: float = 1e-6
    way_variance: float = 0.0
    pressure_radius: float = None  # type: ignore[assignment]  # filled in from the shape

    def __post_init__(self) -> None:
        for name in ("step_variance", "way_variance"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InvalidInputError(f"{name} must be finite and not negative, got {value}")
        if self.pressure_radius is None:
            object.__setattr__(self, "pressure_radius", self.shape.mean_distance())
        if not (math.isfinite(self.pressure_radius) and self.pressure_radius > 0.0):
            raise InvalidInputError(f"pressure_radius must be positive, got {self.pressure_radius}")

    @property
    def radius(self) -> float | None:
        """Radius of a disc-shaped object [m], None for others."""
        first, *rest = self.shape.primitives
        return first.radius if isinstance(first, Disc) and not rest and first.center == (0.0, 0.0) else None

    @property
    def _k(self) -> float:
        return self.pressure_radius**-2

    def predict(self, belief: ObjectBelief, paths: ArrayLike) -> BeliefPrediction:
        """Nominal belief dynamics (6.27) along candidate paths.

        Args:
            belief: where the object may be, P particles.
            paths: plane coordinates of the end effectors from where they are now on, shape (B, K + 1, m).

        Raises:
            InvalidInputError: a wrong shape, or a path that is not finite.
        """
        paths = self._paths(paths, 3)
        batch, steps = paths.shape[0], paths.shape[1] - 1
        columns = 3 if self.radius is None else 2
        mean, variance = np.empty((batch, steps + 1, columns)), np.empty((batch, steps + 1))
        contact, wedge, step = np.empty((batch, steps)), np.empty(batch), np.empty(batch)
        outputs = (mean, variance, contact, wedge, step)
        if self.radius is not None:
            table = disc_rollout.table_of(belief.poses, belief.friction, belief.center)
            disc_rollout.predict_discs(
                self.effectors.rows, self.radius, self._k, self.friction, table, paths, *outputs
            )
        else:
            friction, center = self._contact_parameters(belief)
            multi_tool.predict_shapes(
                self.shape.kernel_rows, self.shape.outline_segments, self.effectors.rows, self._k, friction,
                belief.continuous_poses, center, paths, *outputs,
            )  # fmt: skip
        return BeliefPrediction(*outputs)

    def simulate(
        self, belief: ObjectBelief, path: ArrayLike, rng: np.random.Generator, *, stride: int = 1
    ) -> BeliefRollout:
        """Noisy dynamics (6.7) of all particles along one path.

        Args:
            belief: at the beginning, P particles.
            path: plane coordinates, shape (K + 1, m).
            rng: source of randomness.
            stride: every how many steps poses are noted.

        Raises:
            InvalidInputError: a wrong shape, a path that is not finite, or a stride below 1.
        """
        path = self._paths(path, 2)
        if stride < 1:
            raise InvalidInputError(f"stride must be at least 1, got {stride}")
        noted = np.empty(((len(path) - 1) // stride + 1, belief.count, 3))
        noise = (self.step_variance, self.way_variance, rng, stride, noted)
        if self.radius is not None:
            table = disc_rollout.table_of(belief.poses, belief.friction, belief.center)
            wedge = disc_rollout.simulate_discs(
                self.effectors.rows, self.radius, self._k, self.friction, table, path, *noise
            )
            poses = table[[disc_rollout.X, disc_rollout.Y, disc_rollout.YAW]].T
        else:
            friction, center = self._contact_parameters(belief)
            poses = belief.poses.copy()
            wedge = multi_tool.simulate_shapes(
                self.shape.kernel_rows, self.shape.outline_segments, self.effectors.rows, self._k, friction,
                poses, center, path, *noise,
            )  # fmt: skip
        return BeliefRollout(noted, dataclasses.replace(belief, poses=poses), float(wedge))

    def _contact_parameters(self, belief: ObjectBelief) -> tuple[NDArray, NDArray]:
        if self.friction:
            return belief.friction, belief.center
        return np.zeros(belief.count), np.zeros((belief.count, 2))

    def _paths(self, paths: ArrayLike, dimensions: int) -> NDArray[np.float64]:
        array = np.ascontiguousarray(paths, dtype=float)
        if array.ndim != dimensions or array.shape[-1] != self.effectors.dof or array.shape[-2] < 2:
            expected = "(B, K + 1, m)" if dimensions == 3 else "(K + 1, m)"
            raise InvalidInputError(
                f"expected {expected} with m = {self.effectors.dof} and K >= 1, got shape {array.shape}"
            )
        if not np.isfinite(array).all():
            raise InvalidInputError("a path of the end effectors is not finite")
        return array
