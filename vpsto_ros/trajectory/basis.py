"""Optimal basis functions: the minimal-effort trajectory, linear in its key positions (section 3.1)."""

import dataclasses
import functools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError

_SMALLEST_GAP = 1e-9


@dataclasses.dataclass(frozen=True, eq=False)
class OptimalBasis:
    """Basis functions of the minimal-effort trajectory through N via-points (eqs. 3.1-3.12).

    Minimising the integral of q''(s)^2 under (3.2)-(3.4) gives the C2 cubic spline with clamped end slopes
    through the key positions, linear in w = (q_0, q_1 .. q_N, q_T, q'_0, q'_T). The thesis chains
    double-integrator segments (3.6)-(3.10); here the same spline is found from the tridiagonal system for the
    slopes at the knots. Every degree of freedom has the same basis, so w may carry any number of columns.

    Deviation: the thesis counts the final position among its N key positions; here N counts the via-points
    strictly between start and end, so w has N + 4 entries.

    Args:
        phases: (N + 1,) phases s_1 < .. < s_N < 1.0 of the key positions after the start; the last is 1.

    Attributes:
        knots: (N + 2,) all phases, with the 0 of the start in front.
        knot_slopes: (N + 2, N + 4) q'(s_n) = knot_slopes @ w.
        knot_curvatures: (N + 2, N + 4) q''(s_n) = knot_curvatures @ w; q'' is linear in between.

    Raises:
        InvalidInputError: if the phases do not increase strictly from above 0 to exactly 1.
    """

    phases: NDArray[np.float64]
    knots: NDArray[np.float64] = dataclasses.field(init=False, repr=False)
    knot_slopes: NDArray[np.float64] = dataclasses.field(init=False, repr=False)
    knot_curvatures: NDArray[np.float64] = dataclasses.field(init=False, repr=False)

    def __post_init__(self) -> None:
        phases = np.array(self.phases, dtype=np.float64)
        if phases.ndim != 1 or phases.size == 0 or not np.all(np.isfinite(phases)) or phases[-1] != 1.0:
            raise InvalidInputError(
                f"phases must be a vector of finite numbers that ends with 1.0, got {self.phases}"
            )
        knots = np.concatenate(([0.0], phases))
        if np.any(np.diff(knots) < _SMALLEST_GAP):
            raise InvalidInputError(f"phases must increase strictly between 0 and 1, got {phases}")
        slopes = _knot_slopes(knots)
        values = {
            "phases": phases,
            "knots": knots,
            "knot_slopes": slopes,
            "knot_curvatures": _knot_curvatures(knots, slopes),
        }
        for name, array in values.items():
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @staticmethod
    @functools.lru_cache(maxsize=256, typed=True)
    def uniform(n_via: int) -> "OptimalBasis":
        """The basis with N via-points equally spaced in phase; N = 0 joins start and end directly.

        Raises:
            InvalidInputError: if n_via is negative or not a whole number.
        """
        if isinstance(n_via, bool) or not isinstance(n_via, int | np.integer) or n_via < 0:
            raise InvalidInputError(f"n_via must be a whole number, 0 or more, got {n_via!r}")
        return OptimalBasis(np.arange(1, n_via + 2) / (n_via + 1))

    @property
    def n_via(self) -> int:
        """Number N of via-points between start and end."""
        return self.phases.size - 1

    def __call__(self, s: ArrayLike, order: int = 0) -> NDArray[np.float64]:
        """Evaluate the basis functions or their derivatives with respect to phase.

        Args:
            s: phases in [0, 1], scalar or (K,).
            order: 0 to 3; the third derivative is right-continuous at the knots.

        Returns:
            (K, N + 4) matrix Phi with q^(order)(s) = Phi @ w; columns q_0, q_1 .. q_N, q_T, q'_0, q'_T.

        Raises:
            InvalidInputError: if a phase lies outside [0, 1] or the order outside 0..3.
        """
        s = np.atleast_1d(np.asarray(s, dtype=np.float64))
        if s.ndim != 1 or not np.all((s >= 0.0) & (s <= 1.0)):
            raise InvalidInputError("phases to evaluate must lie in [0, 1]")
        segment, u = locate(self, s)
        left, right, out, back = hermite_weights(u, np.diff(self.knots)[segment], order)
        phi = out[:, None] * self.knot_slopes[segment] + back[:, None] * self.knot_slopes[segment + 1]
        row = np.arange(s.size)
        phi[row, segment] += left
        phi[row, segment + 1] += right
        return phi

    def gramian(self) -> NDArray[np.float64]:
        """The effort as a quadratic form: G (N + 4, N + 4) with integral of q''(s)^2 ds = w^T G w.

        Exact, since q'' is linear on every segment.
        """
        h = np.diff(self.knots)[:, None, None]
        left, right = self.knot_curvatures[:-1, :, None], self.knot_curvatures[1:, :, None]
        left_t, right_t = left.transpose(0, 2, 1), right.transpose(0, 2, 1)
        return np.sum(
            h / 6.0 * (2 * left * left_t + 2 * right * right_t + left * right_t + right * left_t), axis=0
        )


def locate(basis: OptimalBasis, s: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Segment index (K,) and local coordinate u in [0, 1] (K,) of phases s (K,)."""
    segment = np.clip(np.searchsorted(basis.knots, s, side="right") - 1, 0, basis.n_via)
    u = (s - basis.knots[segment]) / np.diff(basis.knots)[segment]
    return segment, np.minimum(u, 1.0)


def _knot_slopes(knots: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve P_v v = P_w w for the slopes: continuity of q'' at every inner knot, end slopes given."""
    size = knots.size
    g = 1.0 / np.diff(knots)
    left = np.eye(size)
    right = np.zeros((size, size + 2))
    right[0, size] = right[-1, size + 1] = 1.0
    for i in range(1, size - 1):
        left[i, i - 1 : i + 2] = g[i - 1], 2.0 * (g[i - 1] + g[i]), g[i]
        right[i, i - 1 : i + 2] = -3.0 * g[i - 1] ** 2, 3.0 * (g[i - 1] ** 2 - g[i] ** 2), 3.0 * g[i] ** 2
    slopes = np.asarray(np.linalg.solve(left, right), dtype=np.float64)
    # The end slopes are given numbers: no round-off of the solver may leak into them.
    slopes[[0, -1]] = right[[0, -1]]
    return slopes


def _knot_curvatures(knots: NDArray[np.float64], slopes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Second derivative at the left end of every segment, and at the right end of the last one."""
    h = np.diff(knots)[:, None]
    position = np.eye(knots.size, knots.size + 2)
    chord = np.diff(position, axis=0) / h
    left = (6.0 * chord - 4.0 * slopes[:-1] - 2.0 * slopes[1:]) / h
    last = (2.0 * slopes[-2] + 4.0 * slopes[-1] - 6.0 * chord[-1]) / h[-1]
    return np.vstack([left, last])


def hermite_weights(u: NDArray, h: NDArray, order: int) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Weights of (q_i, q_i+1, q'_i, q'_i+1) in the order-th derivative of a cubic Hermite segment."""
    one = np.ones_like(u)
    if order == 0:
        rise, out, back = u * u * (3 - 2 * u), u * (1 - u) ** 2, -u * u * (1 - u)
        return 1 - rise, rise, h * out, h * back
    if order == 1:
        rise = 6 * u * (1 - u) / h
        return -rise, rise, (1 - u) * (1 - 3 * u), u * (3 * u - 2)
    if order == 2:
        rise = (6 - 12 * u) / h**2
        return -rise, rise, (6 * u - 4) / h, (6 * u - 2) / h
    if order == 3:
        return 12 * one / h**3, -12 * one / h**3, 6 * one / h**2, 6 * one / h**2
    raise InvalidInputError(f"order must be 0, 1, 2 or 3, got {order}")
