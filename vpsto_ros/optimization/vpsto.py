"""VP-STO (4.3): stochastic search over via-points in the latent space of a Gaussian prior.

The search knows nothing about trajectories: it draws via-points, hands them to ``evaluate`` in one batch and
keeps the best valid ones. :class:`vpsto_ros.optimization.costs.JointSpaceProblem` is the plain problem of the
thesis.
"""

import dataclasses
import math
import numbers
import time
from collections.abc import Callable

import numpy as np

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.optimization.cma import STRATEGIES, Strategy, has_collapsed, make_strategy
from vpsto_ros.optimization.progress import RESERVES, Evaluation, Incumbents, Iteration, SearchResult, Timer
from vpsto_ros.priors.gaussian import GaussianPrior


@documented
@dataclasses.dataclass(frozen=True)
class VpstoConfig:
    """Options of the search.

    The defaults suit few iterations, as when replanning. With a hundred iterations or more, and up to some
    sixty variables, ``strategy = "cma"`` is the better choice: an iteration takes up to three times as long
    and it comes closer to the optimum of time-optimal motions and of few via-points among obstacles
    (``vpsto experiment search``, rows "covariance adaptation").

    Raises:
        ConfigurationError: a value is out of range; the message names what is allowed.
    """

    population: int = option(32, "candidates per iteration and start", minimum=4, maximum=100_000)
    iterations: int = option(6, "iterations in total, restarts included", minimum=1, maximum=1_000_000)
    restarts: int = option(1, "how often to begin anew at most", minimum=0, maximum=1000)
    restart: str = option(
        "invalid",
        "when to begin anew: while nothing valid is known, or also once the search has converged",
        choices=("invalid", "converged"),
    )
    restart_widening: float = option(
        2.0, "factor on sigma at every restart while nothing valid is known", minimum=1.0, maximum=100.0
    )
    population_growth: float = option(
        1.0, "factor on the population at every restart; 2 is IPOP", minimum=1.0, maximum=10.0
    )
    starts: int = option(1, "independent starts searched side by side", minimum=1, maximum=1000)
    strategy: str = option("sep-cma", "evolution strategy", choices=STRATEGIES)
    sigma: float = option(1.0, "first standard deviation in units of the prior", minimum=1e-6, maximum=100.0)
    tolerance: float = option(
        0.0, "converged when the best cost of an iteration changes less; 0: only when it cannot", minimum=0.0
    )
    patience: int = option(1, "over how many iterations it has to", minimum=1, maximum=10_000)
    reserve: str = option(
        "longest", "time taken to be needed by one more iteration before a deadline", choices=RESERVES
    )

    def __post_init__(self) -> None:
        validate(self)


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
    are divided among the remaining restarts; every such restart widens sigma. With ``restart = "converged"``
    a search that has converged begins anew with what is left of its iterations, to find other local optima.
    The result is the same for the same ``rng`` as long as no deadline hits.

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
            as long as ``config.reserve`` says must still fit.
        clock: reads the time in seconds. A clock that counts evaluations makes the deadline a budget of them.

    Raises:
        InvalidInputError: a type or shape does not fit, the deadline is not a number, or ``evaluate``
            returned something else than costs (B,) and validity (B,).
    """
    _check_kinds(prior, evaluate, config, rng, deadline)
    best, timer = Incumbents(), Timer(deadline, clock, config.reserve)
    starts = _latent_starts(prior, config, mean, means)
    if len(starts) > config.starts:
        starts = _cheapest(prior, evaluate, starts, config.starts, best)
    injections, widths = _injections(prior, config, starts, seeds), _widths(config, sigma)
    history: list[Iteration] = []
    restarts, status = 0, "iterations"
    attempt = _Attempt(config, injections, widths[0], rng, 0, restarts)

    while len(history) < config.iterations:
        if timer.expired():
            status = "deadline"
            break
        points = prior.to_points(attempt.ask())  # eq. (4.4)
        evaluation = _checked(evaluate(points), len(points))  # synthesis and costs, 4.3.2 and 4.3.3
        count = best.update(points, evaluation)
        history.append(Iteration(float(evaluation.cost.min()), best.cost, count, attempt.sigma))
        attempt.tell(evaluation.cost)
        used_up = not best.valid and len(history) >= attempt.end
        if not (used_up or attempt.converged):
            continue
        if restarts < config.restarts and not (best.valid and config.restart == "invalid"):
            restarts += 1
            width = config.sigma if best.valid else widths[restarts]
            attempt = _Attempt(config, injections, width, rng, len(history), restarts)
        elif attempt.collapsed or (attempt.converged and best.valid):
            status = "converged"
            break

    return best.result(history, restarts, status)


class _Attempt:
    """The search from its starts until it converges or its share of the iterations is used up.

    Args:
        config: options.
        injections: latent variables that join the first population of every start, its mean first.
        sigma: first step size.
        rng: source of randomness.
        done: iterations done before.
        restarts: which restart this is, 0 for the first attempt.
    """

    def __init__(
        self,
        config: VpstoConfig,
        injections: list[np.ndarray],
        sigma: float,
        rng: np.random.Generator,
        done: int,
        restarts: int,
    ) -> None:
        population = round(config.population * config.population_growth**restarts)
        self._strategies: list[Strategy] = [
            make_strategy(config.strategy, rows.shape[1], population, rng, sigma=sigma, mean=rows[0])
            for rows in injections
        ]
        self._injections, self._config = injections, config
        self._samples = np.empty((len(injections), population, injections[0].shape[1]))
        self._best: list[float] = []
        # If nothing valid is found: an equal share of what is left.
        self.end = done + math.ceil((config.iterations - done) / (config.restarts - restarts + 1))

    @property
    def sigma(self) -> float:
        """Step size of the first start."""
        return self._strategies[0].sigma

    def ask(self) -> np.ndarray:
        """Latent variables of the populations of all starts, shape (S M, D)."""
        for rows, strategy in zip(self._samples, self._strategies, strict=True):
            rows[:] = strategy.ask()
        if not self._best:
            for rows, injection in zip(self._samples, self._injections, strict=True):
                rows[: len(injection)] = injection
        return self._samples.reshape(-1, self._samples.shape[2])

    def tell(self, cost: np.ndarray) -> None:
        """Learn from the costs (S M,)."""
        costs = cost.reshape(len(self._strategies), -1)
        first = not self._best
        for strategy, rows, row, injection in zip(
            self._strategies, self._samples, costs, self._injections, strict=True
        ):
            strategy.tell(rows, row, len(injection) if first else 0)
        self._best.append(float(cost.min()))

    @property
    def collapsed(self) -> bool:
        """Whether no start can find anything else any more."""
        return all(map(has_collapsed, self._strategies))

    @property
    def converged(self) -> bool:
        """The criterion of 4.5.3, |c_k - c_{k-1}| below the tolerance, or that it cannot change any more."""
        patience, recent = self._config.patience, self._best[-1 - self._config.patience :]
        # The difference of infinite costs is nan, which is not below the tolerance.
        settled = len(recent) > patience and max(recent) - min(recent) < self._config.tolerance
        return settled or self.collapsed


def _check_kinds(
    prior: GaussianPrior,
    evaluate: Evaluate,
    config: VpstoConfig,
    rng: np.random.Generator,
    deadline: float | None,
) -> None:
    expected: dict[str, tuple[object, type]] = {
        "prior": (prior, GaussianPrior),
        "config": (config, VpstoConfig),
        "rng": (rng, np.random.Generator),
    }
    for name, (value, kind) in expected.items():
        if not isinstance(value, kind):
            raise InvalidInputError(f"{name} must be a {kind.__name__}, got {value!r}")
    if not callable(evaluate):
        raise InvalidInputError(f"evaluate must be a function of points (B, P, n), got {evaluate!r}")
    if deadline is not None and (not isinstance(deadline, numbers.Real) or math.isnan(deadline)):
        raise InvalidInputError(f"deadline must be a time in seconds or None, got {deadline!r}")


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
    prior: GaussianPrior, evaluate: Evaluate, latent: np.ndarray, count: int, best: Incumbents
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
