"""The limits of eq. (3.27) as smooth functions of the durations between key positions."""

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.trajectory.timing import Limits

_ON_LIMIT = 1e-6
"""A boundary velocity this close to its limit (relative) must not grow: see LimitConstraints."""


class LimitConstraints:
    """Slack of every limit of eq. (3.27) as a function of the segment durations, with its derivative.

    The slopes v of the spline solve, with g = 1 / h and steps d,

        g_{i-1} v_{i-1} + 2 (g_{i-1} + g_i) v_i + g_i v_{i+1} = 3 (g_{i-1}^2 d_{i-1} + g_i^2 d_i),

    so dv/dg_k is the same matrix' inverse on what is left over in rows k and k + 1.

    Args:
        keys: (N + 2, n) key positions.
        ends: (2, n) boundary velocities.
        limits: of n degrees of freedom; those that do not move and infinite limits are left out.
    """

    def __init__(self, keys: NDArray[np.float64], ends: NDArray[np.float64], limits: Limits) -> None:
        moving = np.ptp(keys, axis=0) + np.abs(ends).max(axis=0) > 0.0
        self._steps, self._ends = np.diff(keys, axis=0)[:, moving], ends[:, moving]
        fastest = np.maximum(limits.velocity[moving], np.abs(self._ends).max(axis=0))
        self._velocity, self._acceleration = fastest, limits.acceleration[moving]
        self._fast, self._strong = np.isfinite(fastest), np.isfinite(self._acceleration)
        on_limit = np.abs(self._ends) >= fastest * (1.0 - _ON_LIMIT)
        self._tangents = np.where(on_limit & self._fast, np.sign(self._ends) * [[1.0], [-1.0]], 0.0)

    def slack(
        self, durations: NDArray[np.float64], monotone: bool = False
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values (R,), not negative where the limits hold, and their derivatives (R, N + 1) [1/s].

        Args:
            durations: (N + 1,) of the segments [s].
            monotone: also ask that a longer duration would keep the acceleration limits.
        """
        g = 1.0 / durations
        v, dv = self._slopes(g, self._steps)
        rows = [self._knot_velocity(v, dv), self._vertex_velocity(g, v, dv)]
        acceleration = _knot_acceleration(g, v, dv, self._steps)
        rows.append(_within(*acceleration, self._acceleration, self._strong))
        rows += self._boundary_tangents(*acceleration)
        if monotone:
            rows.append(self._stretchable(g))
        values, by_g = (np.concatenate(part) for part in zip(*rows, strict=True))
        return values, -(g**2) * by_g

    def _slopes(self, g: NDArray, d: NDArray) -> tuple[NDArray, NDArray]:
        """Velocities v (N + 2, n) at the knots and dv/dg (N + 2, N + 1, n), for steps d."""
        size = g.size + 1
        inverse = np.zeros((size, size))
        inverse[1:-1, 1:-1] = np.linalg.inv(
            np.diag(2.0 * (g[:-1] + g[1:])) + np.diag(g[1:-1], 1) + np.diag(g[1:-1], -1)
        )
        right = np.zeros((size, d.shape[1]))
        pull = 3.0 * (g**2)[:, None] * d
        right[1:-1] = pull[:-1] + pull[1:]
        right[1] -= g[0] * self._ends[0]
        right[-2] -= g[-1] * self._ends[1]
        v = inverse @ right
        v[[0, -1]] = self._ends
        rest = 6.0 * g[:, None] * d - v[:-1] - v[1:]
        dv = inverse[:, :-1, None] * (rest - v[:-1]) + inverse[:, 1:, None] * (rest - v[1:])
        return v, dv

    def _knot_velocity(self, v: NDArray, dv: NDArray) -> tuple[NDArray, NDArray]:
        return _within(v[1:-1], dv[1:-1], self._velocity, self._fast)

    def _vertex_velocity(self, g: NDArray, v: NDArray, dv: NDArray) -> tuple[NDArray, NDArray]:
        """Velocity at the vertex of every segment's parabola, or at the end nearest to it.

        Continuously differentiable: the vertex itself does not contribute, since the slope there is zero.
        """
        chord, left, right = g[:, None] * self._steps, v[:-1], v[1:]
        p1, p2 = 6.0 * chord - 4.0 * left - 2.0 * right, 3.0 * (left + right) - 6.0 * chord
        u = np.clip(np.divide(-0.5 * p1, p2, out=np.zeros_like(p1), where=p2 != 0.0), 0.0, 1.0)
        mean, start, stop = 6.0 * u * (1.0 - u), (1.0 - u) * (1.0 - 3.0 * u), u * (3.0 * u - 2.0)
        by_g = start[:, None] * dv[:-1] + stop[:, None] * dv[1:]
        segment = np.arange(g.size)
        by_g[segment, segment] += mean * self._steps
        return _within(mean * chord + start * left + stop * right, by_g, self._velocity, self._fast)

    def _boundary_tangents(self, a: NDArray, da: NDArray) -> list[tuple[NDArray, NDArray]]:
        """Where a boundary velocity is on its limit it must not grow beyond: a sign of the acceleration.

        The velocity slack alone has no slope there that could tell.
        """
        rows = []
        for end, knot in ((0, 0), (1, -1)):
            joints = np.flatnonzero(self._tangents[end])
            sign = -self._tangents[end, joints]
            strength = np.where(self._strong[joints], self._acceleration[joints], 1.0)
            rows.append((sign * a[knot, joints] / strength, (sign * da[knot][:, joints] / strength).T))
        return rows

    def _stretchable(self, g: NDArray) -> tuple[NDArray, NDArray]:
        """2 q̈_max T >= |B| at every knot, where q̈ = A / T^2 + B / T: beyond the vertex of eq. (3.24).

        B / T is the acceleration of the same durations without any steps between the key positions.
        """
        still = np.zeros_like(self._steps)
        coasting = _knot_acceleration(g, *self._slopes(g, still), still)
        return _within(*coasting, 2.0 * self._acceleration, self._strong)


def _knot_acceleration(g: NDArray, v: NDArray, dv: NDArray, d: NDArray) -> tuple[NDArray, NDArray]:
    """Accelerations a (N + 2, n) and da/dg (N + 2, N + 1, n), for steps d."""
    chord = g[:, None] * d
    first = 6.0 * chord - 4.0 * v[:-1] - 2.0 * v[1:]
    last = 2.0 * v[-2] + 4.0 * v[-1] - 6.0 * chord[-1]
    a = np.vstack([g[:, None] * first, g[-1] * last])
    da = np.empty_like(dv)
    da[:-1] = g[:, None, None] * (-4.0 * dv[:-1] - 2.0 * dv[1:])
    da[-1] = g[-1] * (2.0 * dv[-2] + 4.0 * dv[-1])
    segment = np.arange(g.size)
    da[segment, segment] += first + 6.0 * chord
    da[-1, -1] += last - 6.0 * chord[-1]
    return a, da


def _within(values: NDArray, by_g: NDArray, limit: NDArray, finite: NDArray) -> tuple[NDArray, NDArray]:
    """Slack (1 - (x / limit)^2) / 2 of |x| <= limit as rows, for x (K, n), and its derivatives.

    The square makes one smooth constraint of two, which SLSQP answers in half the time.
    """
    x = (values[:, finite] / limit[finite]).ravel()
    dx = np.moveaxis(by_g[:, :, finite] / limit[finite], 1, 2).reshape(x.size, by_g.shape[1])
    return 0.5 - 0.5 * x**2, -x[:, None] * dx
