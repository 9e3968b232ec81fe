"""Long moves between any two postures among obstacles: where the search of 4.3 begins, and how often.

The search of VP-STO is local: it improves the motions that it starts from. The thesis starts from the
straight line (4.3.1), which fails where the way leads round several obstacles. Here every round draws many
postures without collision and looks at the smoothest motions through one of them; the cheapest few become
starts of a search side by side, and the next round begins with new ones. Nothing of this knows what the
postures or the obstacles are.
"""

import dataclasses
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.optimization.costs import JointSpaceProblem
from vpsto_ros.optimization.progress import SearchResult
from vpsto_ros.optimization.vpsto import VpstoConfig, search
from vpsto_ros.trajectory import OptimalBasis, synthesize_batch

_LARGEST_DRAW = 8  # postures drawn for one that is kept


@documented
@dataclasses.dataclass(frozen=True)
class ReachConfig:
    """Options of :func:`plan_reach`; ``vpsto experiment search`` varies them in its table of reaching.

    Four starts are there for success. Fewer starts with more iterations give motions that are about five
    percent shorter, and missed one of sixty cells (seeds 1000 to 1059) in which four starts missed none.

    Raises:
        ConfigurationError: a value is out of range.
    """

    guesses: int = option(100, "motions through a random posture that are looked at in a round", minimum=0)
    near: float = option(
        0.5,
        "share of the postures drawn near the straight line instead of anywhere",
        minimum=0.0,
        maximum=1.0,
    )
    near_spread: float = option(
        0.7, "their standard deviation about it, in the unit of the joints", minimum=0.0
    )
    rounds: int = option(100, "rounds at most", minimum=1, maximum=100_000)
    evaluations: int = option(
        0, "candidates evaluated at most in all rounds; 0: as many as the rounds need", minimum=0
    )
    valid_rounds: int = option(2, "rounds with a valid motion after which the best one will do", minimum=1)
    spread: float = option(
        0.6, "standard deviation of the via-points, in the unit of the joints", minimum=1e-9
    )
    search: VpstoConfig = dataclasses.field(
        default_factory=lambda: VpstoConfig(population=24, starts=4, iterations=40, restarts=0)
    )

    def __post_init__(self) -> None:
        validate(self)


@dataclasses.dataclass(frozen=True)
class ReachResult:
    """Outcome of :func:`plan_reach`.

    Attributes:
        search: the best round: its points, cost, validity and status.
        rounds: how many rounds there were.
        evaluations: candidates evaluated in all rounds.
        first_valid: time of the clock after the first round with a valid motion, None without one.
    """

    search: SearchResult
    rounds: int
    evaluations: int
    first_valid: float | None


def plan_reach(
    problem: JointSpaceProblem,
    in_collision: Callable[[NDArray], NDArray],
    config: ReachConfig,
    rng: np.random.Generator,
    *,
    deadline: float | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> ReachResult:
    """Search for a valid motion from several guesses, round after round.

    Args:
        problem: start, goal, limits with position limits, and all costs.
        in_collision: maps postures (M, n) to bool (M,).
        config: options.
        rng: source of randomness.
        deadline: time of ``clock`` by which to be back. What is found then depends on the machine;
            ``config.evaluations`` limits the effort in a way that does not.
        clock: reads the time in seconds.

    Raises:
        InvalidInputError: the goal is free, the problem has no position limits to draw postures in, or the
            evaluations allowed are too few for one round of a single iteration.
    """
    if problem.goal is None or problem.limits.lower is None or problem.limits.upper is None:
        raise InvalidInputError("reaching needs a goal, and position limits to draw postures in")
    prior = problem.prior(spread=config.spread)
    best: SearchResult | None = None
    rounds = evaluations = valid_rounds = 0
    first_valid = None
    while rounds < config.rounds and valid_rounds < config.valid_rounds:
        if best is not None and deadline is not None and clock() >= deadline:
            break
        options = _within_budget(config, evaluations)
        if options is None:
            break
        means = np.concatenate([prior.mean_points[None], guesses(problem, in_collision, config, rng)])
        found = search(
            prior, problem.evaluate, options, rng, means=means, deadline=deadline, clock=clock
        )
        rounds, evaluations = rounds + 1, evaluations + found.evaluations
        valid_rounds += found.valid
        if found.valid and first_valid is None:
            first_valid = clock()
        if best is None or _rank(found) < _rank(best):
            best = found
    if best is None:
        raise InvalidInputError(f"{config.evaluations} evaluations are too few for a round")
    return ReachResult(best, rounds, evaluations, first_valid)


def _within_budget(config: ReachConfig, evaluations: int) -> VpstoConfig | None:
    """Options of the next round, None if too few evaluations are left for another one."""
    if not config.evaluations:
        return config.search
    largest = round(config.search.population * config.search.population_growth**config.search.restarts)
    left = config.evaluations - evaluations - config.guesses - 1
    iterations = left // (largest * config.search.starts)
    if iterations < 1:
        return None
    return dataclasses.replace(config.search, iterations=min(iterations, config.search.iterations))


def guesses(
    problem: JointSpaceProblem,
    in_collision: Callable[[NDArray], NDArray],
    config: ReachConfig,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Via-points (G, N, n) of the smoothest motions through a random posture without collision each."""
    if not config.guesses:
        return np.empty((0, problem.basis.n_via, problem.limits.dof))
    near = round(config.near * config.guesses)
    postures = [
        _free(lambda size: _near_line(problem, config, rng, size), in_collision, near),
        _free(lambda size: _anywhere(problem, rng, size), in_collision, config.guesses - near),
    ]
    return through(problem, np.concatenate(postures)[:, None])


def through(problem: JointSpaceProblem, postures: NDArray[np.float64]) -> NDArray[np.float64]:
    """Via-points (G, N, n) of the smoothest motions from start to goal through postures (G, M, n).

    The postures come at even phases: the mean of the prior with M via-points, sampled at the phases of N.
    """
    count, inner, _ = postures.shape
    keys = np.empty((count, inner + 2, problem.limits.dof))
    keys[:, 0], keys[:, 1:-1], keys[:, -1] = problem.start, postures, problem.goal
    phases = problem.basis.n_via + 2
    batch = synthesize_batch(
        OptimalBasis.uniform(inner), keys, problem.start_velocity, problem.end_velocity, problem.limits,
        phases, derivatives=False,
    )  # fmt: skip
    return batch.position[:, 1:-1]


def _near_line(
    problem: JointSpaceProblem, config: ReachConfig, rng: np.random.Generator, size: int
) -> NDArray:
    assert problem.goal is not None
    along = rng.uniform(0.0, 1.0, (size, 1))
    line = problem.start + along * (problem.goal - problem.start)
    shifted = line + config.near_spread * rng.standard_normal(line.shape)
    return np.clip(shifted, problem.limits.lower, problem.limits.upper)


def _anywhere(problem: JointSpaceProblem, rng: np.random.Generator, size: int) -> NDArray:
    assert problem.limits.lower is not None and problem.limits.upper is not None
    return rng.uniform(problem.limits.lower, problem.limits.upper, (size, problem.limits.dof))


def _free(draw: Callable[[int], NDArray], in_collision: Callable[[NDArray], NDArray], count: int) -> NDArray:
    """Up to `count` of the drawn postures that do not collide."""
    postures = draw(_LARGEST_DRAW * count)
    return postures[~in_collision(postures)][:count] if count else postures


def _rank(result: SearchResult) -> tuple[bool, float]:
    return not result.valid, result.cost if result.valid else result.best_any_cost
