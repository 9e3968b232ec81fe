"""VP-STO (4.3): stochastic search over via-points in the latent space of a Gaussian prior.

The search knows nothing about trajectories: it draws via-points, hands them to ``evaluate`` in one batch and
keeps the best valid ones. :class:`vpsto_ros.optimization.costs.JointSpaceProblem` is the plain problem of the
thesis.
"""

import dataclasses
import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vpsto_ros.configuration import option, validate
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.optimization.cma import STRATEGIES, Strategy, make_strategy
from vpsto_ros.priors.smoothness import GaussianPrior


@dataclasses.dataclass(frozen=True)
class VpstoConfig:
    """Options of the search.

    Raises:
        ConfigurationError: a value is out of range; the message names what is allowed.
    """

    population: int = option(32, "candidates per iteration and start", minimum=4, maximum=100_000)
    iterations: int = option(6, "iterations in total, restarts included", minimum=1, maximum=1_000_000)
    restarts: int = option(
        1, "how often to begin anew, wider, while nothing valid is known", minimum=0, maximum=100
    )
    restart_widening: float = option(2.0, "factor on sigma at every restart", minimum=1.0, maximum=100.0)
    starts: int = option(1, "independent starts searched side by side", minimum=1, maximum=1000)
    strategy: str = option("sep-cma", "evolution strategy", choices=STRATEGIES)
    sigma: float = option(1.0, "first standard deviation in units of the prior", minimum=1e-6, maximum=100.0)
    tolerance: float = option(
        0.0, "stop when the best cost changes less per iteration; 0: never", minimum=0.0
    )

    def __post_init__(self) -> None:
        validate(self)


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Costs of a batch of candidates, shape (B,), and which of them satisfy all constraints, shape (B,) bool.

    Candidates are ranked by cost alone (4.3.3), so constraints need a cost as well, as in (4.16).
    """

    cost: np.ndarray
    valid: np.ndarray


class Iteration(NamedTuple):
    """What one iteration saw.

    Attributes:
        best_cost: lowest cost in this iteration, valid or not.
        best_valid_cost: lowest cost of a valid candidate so far, inf if there was none.
        valid_count: how many candidates of this iteration were valid.
        sigma: step size of the first start.
    """

    best_cost: float
    best_valid_cost: float
    valid_count: int
    sigma: float


@dataclasses.dataclass(frozen=True)
class SearchResult:
    """Outcome of a search.

    Attributes:
        points: best valid points, shape (P, n), or None if there are none.
        cost: their cost, inf if there are none.
        valid: whether there are any.
        best_any_points: points of the lowest finite cost, valid or not, shape (P, n), or None if no cost was
            finite.
        best_any_cost: their cost, inf if there are none.
        iterations, evaluations, restarts: how often each happened.
        non_finite: number of candidates whose cost was not finite.
        status: "converged", "iterations" (all of them done), "deadline" or "no valid plan".
        history: one entry per iteration.
    """

    points: np.ndarray | None
    cost: float
    valid: bool
    best_any_points: np.ndarray | None
    best_any_cost: float
    iterations: int
    evaluations: int
    restarts: int
    non_finite: int
    status: str
    history: tuple[Iteration, ...]


Evaluate = Callable[[np.ndarray], Evaluation]


def search(
    prior: GaussianPrior,
    evaluate: Evaluate,
    config: VpstoConfig,
    rng: np.random.Generator,
    *,
    seeds: np.ndarray | None = None,
    mean: np.ndarray | None = None,
    means: np.ndarray | None = None,
    sigma: float | None = None,
    deadline: float | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> SearchResult:
    """Minimise a cost over via-points, eq. (4.3).

    The populations of all starts are evaluated in one batch. The first one also contains the mean of every
    start, so a warm start is never worse than what it started from. With more means than starts, all means
    are evaluated first and the cheapest become starts. While nothing valid is known, the remaining iterations
    are divided among the remaining restarts; every restart widens sigma. The result is the same for the same
    ``rng`` as long as no deadline hits.

    Args:
        prior: Gaussian over the P points; also the metric of the search.
        evaluate: maps points (B, P, n) to an :class:`Evaluation`.
        config: options.
        rng: source of randomness.
        seeds: points to try in the first population (and again after a restart), shape (S, P, n), distributed
            over the starts.
        mean: where to start instead of the mean of the prior, shape (P, n).
        means: several of them, shape (S, P, n), instead of ``mean``. There are ``min(config.starts, S)``
            starts, each at its own mean.
        sigma: first standard deviation of this search instead of ``config.sigma``.
        deadline: time of ``clock`` by which to be back. Checked before every iteration: one that would take
            as long as the longest so far must still fit.
        clock: reads the time in seconds.

    Raises:
        InvalidInputError: shapes do not fit, or ``evaluate`` returned something else than costs (B,) and
            validity (B,).
    """
    best, timer = _Incumbents(), _Timer(deadline, clock)
    starts = _latent_starts(prior, config, mean, means)
    if len(starts) > config.starts:
        starts = _cheapest(prior, evaluate, starts, config.starts, best)
    injections = _injections(prior, config, starts, seeds)
    widths = _widths(config, sigma)
    history: list[Iteration] = []
    restarts, round_end = 0, _round_end(config, 0, 0)
    strategies = _begin(config, starts, widths[0], rng)
    fresh, status = True, "iterations"

    while len(history) < config.iterations:
        if timer.expired():
            status = "deadline"
            break
        samples = np.stack([strategy.ask() for strategy in strategies])  # latent variables, (S, M, D)
        injected = _inject(samples, injections) if fresh else [0] * len(strategies)
        points = prior.to_points(samples.reshape(-1, prior.dimension))  # eq. (4.4)
        evaluation = _checked(evaluate(points), len(points))  # synthesis and costs, 4.3.2 and 4.3.3
        count = best.update(points, evaluation)
        history.append(Iteration(float(evaluation.cost.min()), best.cost, count, strategies[0].sigma))
        for strategy, sample, cost, count in zip(
            strategies, samples, evaluation.cost.reshape(len(strategies), -1), injected, strict=True
        ):
            strategy.tell(sample, cost, count)
        fresh = False
        converged = _converged(history, config.tolerance)
        if converged and best.valid:
            status = "converged"
            break
        if not best.valid and restarts < config.restarts and (converged or len(history) >= round_end):
            restarts += 1
            round_end = _round_end(config, len(history), restarts)
            strategies = _begin(config, starts, widths[restarts], rng)
            fresh = True

    return best.result(history, restarts, status)


class _Incumbents:
    """The best candidates so far."""

    def __init__(self) -> None:
        self.points: np.ndarray | None = None
        self.cost = math.inf
        self.any_points: np.ndarray | None = None
        self.any_cost = math.inf
        self.evaluations = 0
        self.non_finite = 0

    @property
    def valid(self) -> bool:
        return self.points is not None

    def update(self, points: np.ndarray, evaluation: Evaluation) -> int:
        """Take in a batch; returns how many of it are valid."""
        cost, valid = evaluation.cost, evaluation.valid
        self.evaluations += len(cost)
        self.non_finite += int(np.count_nonzero(cost == math.inf))
        lowest = int(cost.argmin())
        best_cost = float(cost[lowest])
        if best_cost < self.any_cost:
            self.any_cost, self.any_points = best_cost, points[lowest].copy()
        count = int(np.count_nonzero(valid))
        if count:
            lowest = int(np.where(valid, cost, math.inf).argmin())
            if cost[lowest] < self.cost:
                self.cost, self.points = float(cost[lowest]), points[lowest].copy()
        return count

    def result(self, history: list[Iteration], restarts: int, status: str) -> SearchResult:
        return SearchResult(
            points=self.points,
            cost=self.cost,
            valid=self.valid,
            best_any_points=self.any_points,
            best_any_cost=self.any_cost,
            iterations=len(history),
            evaluations=self.evaluations,
            restarts=restarts,
            non_finite=self.non_finite,
            status=status if self.valid else "no valid plan",
            history=tuple(history),
        )


class _Timer:
    """Tells when the next iteration would end too late."""

    def __init__(self, deadline: float | None, clock: Callable[[], float]) -> None:
        self._deadline = deadline
        self._clock = clock
        self._last: float | None = None
        self._longest = 0.0

    def expired(self) -> bool:
        if self._deadline is None:
            return False
        now = self._clock()
        if self._last is not None:
            self._longest = max(self._longest, now - self._last)
        self._last = now
        return now + self._longest >= self._deadline


def _latent_starts(
    prior: GaussianPrior, config: VpstoConfig, mean: np.ndarray | None, means: np.ndarray | None
) -> np.ndarray:
    """Latent means of the starts, shape (S, D)."""
    if not prior.dimension:
        raise InvalidInputError("there are no via-points to search over (N = 0 with a fixed end)")
    if means is not None and mean is not None:
        raise InvalidInputError("give either mean or means, not both")
    if means is not None:
        return prior.to_latent(_points_like(prior, "means", means))
    if mean is None:
        return np.zeros((config.starts, prior.dimension))
    latent = prior.to_latent(_points_like(prior, "mean", np.asarray(mean)[None]))
    return np.repeat(latent, config.starts, axis=0)


def _cheapest(
    prior: GaussianPrior, evaluate: Evaluate, latent: np.ndarray, count: int, best: _Incumbents
) -> np.ndarray:
    points = prior.to_points(latent)
    evaluation = _checked(evaluate(points), len(points))
    best.update(points, evaluation)
    return latent[np.argsort(evaluation.cost, kind="stable")[:count]]


def _injections(
    prior: GaussianPrior, config: VpstoConfig, starts: np.ndarray, seeds: np.ndarray | None
) -> list[np.ndarray]:
    """Latent variables that join the first population of each start: its mean and its share of the seeds."""
    latent = np.empty((0, prior.dimension))
    if seeds is not None and len(seeds):
        latent = prior.to_latent(_points_like(prior, "seeds", seeds))
        known = (np.abs(latent[:, None, :] - starts) < 1e-9).all(axis=-1).any(axis=1)
        latent = latent[~known]
    shares = [np.vstack([start, latent[i :: len(starts)]]) for i, start in enumerate(starts)]
    if len(shares[0]) > config.population:
        room = (config.population - 1) * len(starts)
        raise InvalidInputError(f"{len(latent)} seeds do not fit into the first population; at most {room}")
    return shares


def _points_like(prior: GaussianPrior, name: str, points: np.ndarray) -> np.ndarray:
    array = np.asarray(points, dtype=float)
    expected = (prior.n_points, prior.dof)
    if array.ndim != 3 or not len(array) or array.shape[1:] != expected or not np.isfinite(array).all():
        raise InvalidInputError(
            f"{name} must be finite points of shape {expected} each, got shape {array.shape}"
        )
    return array


def _widths(config: VpstoConfig, sigma: float | None) -> list[float]:
    """Step size of the first round and of every restart, which is wider than an ordinary search."""
    first = config.sigma if sigma is None else float(sigma)
    widest = max(first, config.sigma)
    return [first] + [widest * config.restart_widening ** (i + 1) for i in range(config.restarts)]


def _round_end(config: VpstoConfig, done: int, restarts: int) -> int:
    """Iteration at which the present round gives up if nothing is valid: an equal share of what is left."""
    return done + math.ceil((config.iterations - done) / (config.restarts - restarts + 1))


def _begin(config: VpstoConfig, starts: np.ndarray, sigma: float, rng: np.random.Generator) -> list[Strategy]:
    return [
        make_strategy(config.strategy, start.size, config.population, rng, sigma=sigma, mean=start)
        for start in starts
    ]


def _inject(samples: np.ndarray, injections: list[np.ndarray]) -> list[int]:
    for sample, injection in zip(samples, injections, strict=True):
        sample[: len(injection)] = injection
    return [len(injection) for injection in injections]


def _checked(evaluation: Evaluation, size: int) -> Evaluation:
    """Costs that are not finite become +inf and invalid."""
    cost = np.asarray(evaluation.cost, dtype=float)
    valid = np.asarray(evaluation.valid)
    if cost.shape != (size,) or valid.shape != (size,) or valid.dtype != bool:
        raise InvalidInputError(
            f"evaluate must return cost ({size},) and valid ({size},) of bool; "
            f"got cost {cost.shape} and valid {valid.shape} of {valid.dtype}"
        )
    finite = np.isfinite(cost)
    if finite.all():
        return Evaluation(cost, valid)
    return Evaluation(np.where(finite, cost, math.inf), valid & finite)


def _converged(history: list[Iteration], tolerance: float) -> bool:
    """The criterion of 4.5.3, |c_k - c_{k-1}| below the tolerance."""
    if tolerance <= 0 or len(history) < 2:
        return False
    change = abs(history[-1].best_cost - history[-2].best_cost)  # nan if both are infinite
    return change < tolerance
