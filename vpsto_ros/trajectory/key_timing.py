"""Timing of given key positions: the durations between them that make the motion shortest (section 3.2.2)."""

import contextlib
import dataclasses
import functools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.configuration import option, validate
from vpsto_ros.exceptions import InfeasibleError, InvalidInputError
from vpsto_ros.trajectory.basis import OptimalBasis
from vpsto_ros.trajectory.synthesis import synthesize
from vpsto_ros.trajectory.timing import MINIMUM_DURATION, Limits, minimal_duration
from vpsto_ros.trajectory.trajectory import Trajectory

_ON_LIMIT = 1e-6
"""A boundary velocity this close to its limit (relative) must not grow: see LimitConstraints."""


@dataclasses.dataclass(frozen=True)
class KeyTimingConfig:
    """Options of :func:`time_key_positions`.

    Raises:
        ConfigurationError: a value is out of range.
    """

    iterations: int = option(150, "SLSQP iterations per start", minimum=1, maximum=100_000)
    tolerance: float = option(1e-10, "relative change of the duration that ends SLSQP", minimum=1e-15)
    perturbations: int = option(4, "random starts around the best timing found", minimum=0, maximum=10_000)
    spread: float = option(0.8, "standard deviation of the logarithm of the segments there", minimum=0.0)
    shortest: float = option(
        1e-3, "shortest segment, as a share of the average one at first", minimum=1e-6, maximum=0.5
    )
    stretchable: bool = option(False, "whether every longer duration must keep the limits as well")

    def __post_init__(self) -> None:
        validate(self)


@dataclasses.dataclass(frozen=True, eq=False)
class TimedKeys:
    """Key positions with their timing.

    Attributes:
        phases: (N + 1,) phases of the key positions after the start; the last is 1.
        duration: of the whole motion [s].
        equal_spacing: duration with key positions equally spaced in time [s], never less than ``duration``.
        trajectory: the motion; its ``times`` are those of the key positions.
    """

    phases: NDArray[np.float64]
    duration: float
    equal_spacing: float
    trajectory: Trajectory


def time_key_positions(
    key_positions: ArrayLike,
    limits: Limits,
    *,
    start_velocity: ArrayLike | None = None,
    end_velocity: ArrayLike | None = None,
    config: KeyTimingConfig | None = None,
    rng: np.random.Generator | None = None,
    start_time: float = 0.0,
) -> TimedKeys:
    """Find the segment durations h that minimise T = sum(h) within the limits, eq. (3.27).

    The problem is not convex, so SLSQP starts from several timings, and the best result counts. From rest to
    rest all of them end alike as a rule; with boundary velocities they need not, and ``rng`` adds more.

    The limits hold at every instant: the acceleration is linear on a segment and extreme at its ends, the
    velocity is quadratic and has its vertex in closed form. What SLSQP returns keeps them to its tolerance
    only: it gives the phases, and the duration is that of :func:`vpsto_ros.trajectory.minimal_duration`,
    which is exact. Where this is longer, because with boundary velocities isolated shorter durations can
    exist, the one of SLSQP is taken if it passes :meth:`Trajectory.violations`; with ``config.stretchable``
    it never is, and the motion can be slowed down freely.

    Args:
        key_positions: (N + 2, n) from q_0 to q_T [rad or m].
        limits: velocity and acceleration limits; position limits play no part.
        start_velocity: q̇_0 (n,) [1/s], zero by default.
        end_velocity: q̇_T (n,) [1/s], zero by default.
        config: options.
        rng: source of the random starts; without it there are none.
        start_time: time of the first key position [s].

    Raises:
        InvalidInputError: if shapes do not fit or an entry is not finite.
        InfeasibleError: if a boundary velocity is beyond its limit.
    """
    keys = np.array(key_positions, dtype=np.float64)
    if keys.ndim != 2 or len(keys) < 2:
        raise InvalidInputError(
            f"key positions must have shape (N + 2, {limits.dof}) with at least a start and an end, "
            f"got {keys.shape}"
        )
    start, end = (np.zeros(limits.dof) if v is None else v for v in (start_velocity, end_velocity))
    uniform = OptimalBasis.uniform(len(keys) - 2)
    equal = synthesize(uniform, keys, start, end, limits, start_time=start_time)
    timing = _Timing(keys, np.array([start, end], dtype=np.float64), limits, config or KeyTimingConfig())
    if equal.duration > MINIMUM_DURATION and uniform.n_via > 0:
        timing.search(rng)
    if timing.duration >= equal.duration:
        return TimedKeys(uniform.phases, equal.duration, equal.duration, equal)
    best = timing.trajectory(timing.basis, timing.duration, start_time)
    return TimedKeys(timing.basis.phases, best.duration, equal.duration, best)


class _Timing:
    """The best timing found so far of one set of key positions: its basis and duration."""

    def __init__(self, keys: NDArray, ends: NDArray, limits: Limits, config: KeyTimingConfig) -> None:
        self._keys, self._ends, self._limits, self._config = keys, ends, limits, config
        self._constraints = LimitConstraints(keys, ends, limits)
        fastest = _over(np.abs(np.diff(keys, axis=0)), limits.velocity).max(axis=1)
        self._full_speed = max(fastest.sum(), MINIMUM_DURATION)
        self.basis = OptimalBasis.uniform(len(keys) - 2)
        self.duration = np.inf

    def search(self, rng: np.random.Generator | None) -> None:
        """Descend from every first guess, then from random changes of the best."""
        for durations in first_guesses(self._keys, self._limits):
            self._improve(durations)
        if rng is None:
            return
        for _ in range(self._config.perturbations):
            durations = np.diff(self.basis.knots)
            self._improve(durations * np.exp(self._config.spread * rng.standard_normal(durations.size)))

    def trajectory(self, basis: OptimalBasis, duration: float, start_time: float = 0.0) -> Trajectory:
        """The motion with this timing; InfeasibleError where the duration breaks a limit."""
        start, end = self._ends
        return synthesize(
            basis, self._keys, start, end, self._limits, duration=duration, start_time=start_time
        )

    def _improve(self, durations: NDArray) -> None:
        """Descend from one timing, of which only the proportions count."""
        guess = self._basis(durations)
        proportions = np.diff(guess.knots)
        durations = proportions * self._shortest(guess)
        found = self._descend(durations, monotone=self._config.stretchable)
        missed = self._take(found) > found.sum() * (1.0 + 1e-4)
        if not self._ends.any() or self._config.stretchable:
            return
        # With boundary velocities short isolated durations lie beyond infeasible ones: start from below, too.
        self._take(self._descend(proportions * self._full_speed, monotone=False))
        if missed:
            self._take(self._descend(durations, monotone=True))

    def _take(self, durations: NDArray) -> float:
        """Exact duration [s] of a timing; remembers the best one."""
        basis, total = self._basis(durations), float(durations.sum())
        exact = self._shortest(basis)
        if total < min(exact, self.duration) and not self._config.stretchable:
            with contextlib.suppress(InfeasibleError):
                exact = self.trajectory(basis, total).duration
        if exact < self.duration:
            self.basis, self.duration = basis, exact
        return exact

    def _shortest(self, basis: OptimalBasis) -> float:
        return float(minimal_duration(basis, self._keys, self._ends[0], self._ends[1], self._limits))

    def _basis(self, durations: NDArray) -> OptimalBasis:
        """The basis with segments in these proportions, none of them vanishing."""
        share = np.maximum(durations / durations.sum(), 0.1 * self._config.shortest / durations.size)
        phases = np.cumsum(share / share.sum())
        phases[-1] = 1.0
        return OptimalBasis(phases)

    def _descend(self, durations: NDArray, *, monotone: bool) -> NDArray:
        """Segment durations (N + 1,) [s] of a local minimum of eq. (3.27)."""
        from scipy.optimize import minimize  # here, because it takes most of a second

        scale, ones = durations.sum(), np.ones(durations.size)

        @functools.lru_cache(maxsize=1)
        def slack(key: bytes) -> tuple[NDArray, NDArray]:
            return self._constraints.slack(scale * np.frombuffer(key), monotone)

        result = minimize(
            np.sum,
            durations / scale,
            jac=lambda x: ones,
            bounds=[(self._config.shortest / ones.size, None)] * ones.size,
            constraints={
                "type": "ineq",
                "fun": lambda x: slack(x.tobytes())[0],
                "jac": lambda x: scale * slack(x.tobytes())[1],
            },
            method="SLSQP",
            options={"ftol": self._config.tolerance, "maxiter": self._config.iterations},
        )
        usable = np.isfinite(result.x).all() and (result.x > 0.0).all()
        return scale * result.x if usable else durations


def first_guesses(keys: NDArray[np.float64], limits: Limits) -> list[NDArray[np.float64]]:
    """Proportions (N + 1,) of the durations to start from: equal, by chord length, by the slowest joint.

    Chords are measured in units of the velocity limits; the third guess is the time the slowest joint needs
    from rest to rest.
    """
    step = np.abs(np.diff(keys, axis=0))
    chord = np.linalg.norm(_over(step, limits.velocity), axis=1)
    alone = np.maximum(_over(step, limits.velocity), 2.0 * np.sqrt(_over(step, limits.acceleration)))
    guesses = [np.ones(len(step))]
    for guess in (chord, alone.max(axis=1)):
        if guess.any():
            guesses.append(np.maximum(guess, 0.05 * guess.mean()))
    return guesses


def _over(step: NDArray, limit: NDArray) -> NDArray:
    """Steps in units of a limit; infinite limits take no time."""
    return np.where(np.isfinite(limit), step / limit, 0.0)


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
