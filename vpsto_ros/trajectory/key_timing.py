"""Timing of given key positions: the durations between them that make the motion shortest (section 3.2.2)."""

import contextlib
import dataclasses
import functools
import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import InfeasibleError, InvalidInputError
from vpsto_ros.trajectory.basis import OptimalBasis
from vpsto_ros.trajectory.limit_constraints import LimitConstraints
from vpsto_ros.trajectory.synthesis import synthesize
from vpsto_ros.trajectory.timing import MINIMUM_DURATION, Limits, minimal_duration
from vpsto_ros.trajectory.trajectory import Trajectory


@documented
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
        InvalidInputError: if a type or shape does not fit or an entry is not finite.
        InfeasibleError: if a boundary velocity is beyond its limit.
    """
    _check_kind("limits", limits, Limits)
    config = KeyTimingConfig() if config is None else config
    _check_kind("config", config, KeyTimingConfig)
    if rng is not None:
        _check_kind("rng", rng, np.random.Generator)
    keys = _matrix(key_positions, limits.dof)
    start = _velocity("start_velocity", start_velocity, limits.dof)
    end = _velocity("end_velocity", end_velocity, limits.dof)
    uniform = OptimalBasis.uniform(len(keys) - 2)
    equal = synthesize(uniform, keys, start, end, limits, start_time=start_time)
    timing = _Timing(keys, np.array([start, end]), limits, config)
    if equal.duration > MINIMUM_DURATION and uniform.n_via > 0:
        timing.search(rng)
    if timing.duration >= equal.duration:
        return TimedKeys(uniform.phases, equal.duration, equal.duration, equal)
    best = timing.trajectory(timing.basis, timing.duration, start_time)
    return TimedKeys(timing.basis.phases, best.duration, equal.duration, best)


def _check_kind(name: str, value: object, kind: type) -> None:
    if not isinstance(value, kind):
        raise InvalidInputError(f"{name} must be a {kind.__name__}, got {value!r}")


def _velocity(name: str, value: ArrayLike | None, dof: int) -> NDArray[np.float64]:
    """A boundary velocity (n,), zero if none is given; one joint may be given a plain number."""
    expected = f"{name} must be finite numbers of shape ({dof},)"
    try:
        velocity = np.zeros(dof) if value is None else np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{expected}: {error}") from error
    velocity = velocity.reshape(1) if velocity.ndim == 0 else velocity
    if velocity.shape != (dof,) or not np.isfinite(velocity).all():
        raise InvalidInputError(f"{expected}; got {value!r}")
    return velocity


def _matrix(key_positions: ArrayLike, dof: int) -> NDArray[np.float64]:
    expected = f"key positions must be numbers of shape (N + 2, {dof}), at least a start and an end"
    try:
        keys = np.array(key_positions, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{expected}: {error}") from error
    if keys.ndim != 2 or len(keys) < 2:
        raise InvalidInputError(f"{expected}; got {keys.shape}")
    return keys


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

        with warnings.catch_warnings():
            # Some versions of SciPy warn when a step is cut back to the bounds.
            warnings.simplefilter("ignore", RuntimeWarning)
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
