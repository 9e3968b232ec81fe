"""What the Cholesky factor of the smoothness prior does for the search (Fig. 4.7).

A point moves around one block in minimal time, with six free via-points and 25 candidates per iteration.
CMA-ES and sep-CMA-ES search either in the latent space of the smoothness prior, eq. (4.4), or over the
via-points themselves: then they start from an isotropic Gaussian with the same mean and the same mean
variance. World and spread were chosen on seeds from 1000 on, such that the block cannot be missed by chance.

For every variant: the iterations until a candidate is out of collision (the solution a search would return)
and until the updated mean is; until the cost of the mean changes by less than 1e-6 (the criterion of the
thesis); and the final cost over the best known one.
"""

import argparse
import dataclasses
import functools
import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.clutter import cholesky_figure
from sim_bridge.experiments.runs import (
    Execution,
    markdown_table,
    print_verdict,
    run_trials,
    success_interval,
    write_summary,
)
from vpsto_ros.collision.planar import PlanarWorld
from vpsto_ros.optimization.cma import make_strategy
from vpsto_ros.optimization.costs import CostWeights, JointSpaceProblem
from vpsto_ros.priors.gaussian import GaussianPrior, SeparablePrior
from vpsto_ros.trajectory import Limits, OptimalBasis

N_VIA = 6
SPREAD = 0.15
POPULATION = 25
ITERATIONS = 1000
TOLERANCE = 1e-6
EARLY = 3
REQUIRED_RATE = 0.95
STRATEGIES = {"cma": "CMA-ES", "sep-cma": "sep-CMA-ES"}
PRIORS = {"with_prior": "Cholesky factor of the prior", "without_prior": "isotropic"}

WORLD = PlanarWorld(
    np.zeros(2), np.ones(2), (np.array([[0.4, 0.2], [0.6, 0.2], [0.6, 0.7], [0.4, 0.7]]),), names=("block",)
)
LIMITS = Limits(np.full(2, 0.5), np.full(2, 1.0), WORLD.lower, WORLD.upper)


@functools.cache
def problem() -> JointSpaceProblem:
    """From left to right around the block in minimal time; above it is shorter than below."""
    return JointSpaceProblem(
        OptimalBasis.uniform(N_VIA), LIMITS, np.array([0.1, 0.5]), np.array([0.9, 0.5]),
        terms=(WORLD.term(),), weights=CostWeights(smoothness=0.0), samples=2,
    )  # fmt: skip


@functools.cache
def prior(name: str) -> GaussianPrior:
    """The first sampling distribution: of smooth paths, or isotropic with as much variance on average."""
    smooth = problem().prior(spread=SPREAD)
    if name == "with_prior":
        return smooth
    variance = float(np.mean(np.diag(smooth.covariance)))
    return SeparablePrior(smooth.mean_points.copy(), np.eye(N_VIA), np.full(2, np.sqrt(variance)))


@dataclasses.dataclass(frozen=True)
class Task:
    """One search: which strategy, from which distribution, with which seed."""

    strategy: str
    prior: str
    seed: int


@dataclasses.dataclass(frozen=True, eq=False)
class Outcome:
    """What one search did.

    Attributes:
        free: iterations until a candidate was out of collision, None if that never happened.
        mean_free: iterations until the updated mean was.
        settled: iterations until the cost of the mean changed by less than 1e-6.
        cost: of the best valid candidate, inf if there was none.
        points: its via-points (N, 2), or None.
        means: cost of the updated mean in every iteration.
    """

    free: int | None
    mean_free: int | None
    settled: int | None
    cost: float
    points: NDArray[np.float64] | None
    means: NDArray[np.float64]


def solve(task: Task) -> Outcome:
    """Search until the cost of the mean has settled."""
    plan, start = problem(), prior(task.prior)
    rng = np.random.default_rng(task.seed)
    strategy = make_strategy(task.strategy, start.dimension, POPULATION, rng, sigma=1.0)
    free = mean_free = settled = None
    cost, points, means = np.inf, None, []
    for iteration in range(1, ITERATIONS + 1):
        latent = strategy.ask()
        candidates = start.to_points(latent)
        evaluation = plan.evaluate(candidates)
        strategy.tell(latent, evaluation.cost)
        valid_cost = np.where(evaluation.valid, evaluation.cost, np.inf)
        if valid_cost.min() < cost:
            cost, points = float(valid_cost.min()), candidates[valid_cost.argmin()].copy()
            free = free or iteration
        updated = plan.evaluate(start.to_points(strategy.mean[None]))
        if updated.valid[0]:
            mean_free = mean_free or iteration
        means.append(float(updated.cost[0]))
        if iteration > 1 and abs(means[-1] - means[-2]) < TOLERANCE:
            settled = iteration
            break
    return Outcome(free, mean_free, settled, cost, points, np.array(means))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Nothing beyond the options of every experiment."""


def run(arguments: argparse.Namespace) -> int:
    """Search with every variant and seed; 0 when the prior keeps its promise."""
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    variants = [(strategy, start) for strategy in STRATEGIES for start in PRIORS]
    tasks = [Task(*variant, seed) for variant in variants for seed in seeds]
    found = run_trials(solve, tasks, Execution.from_arguments(arguments), "cholesky")
    outcomes = {
        variant: found[i * len(seeds) : (i + 1) * len(seeds)] for i, variant in enumerate(variants)
    }
    best = min(outcome.cost for outcome in found)
    rows = {f"{s}_{p}": summarise(outcomes[s, p], best) for s, p in variants}
    rate = min(rows[f"{s}_with_prior"]["collision_free_by_3_rate"] for s in STRATEGIES)
    summary = {
        "experiment": "cholesky",
        "seed": arguments.seed,
        "runs": arguments.runs,
        "collision_free_by_3_rate": rate,
        "best_known_duration_s": best if np.isfinite(best) else None,
        "variants": rows,
    }
    folder = pathlib.Path(arguments.out)
    write_summary(folder, summary)
    table = variant_table(rows)
    (folder / "table.md").write_text(table)
    cholesky_figure.write(folder / "cholesky.png", outcomes)
    print(f"{table}\nresults in {folder}")
    return print_verdict(
        rate >= REQUIRED_RATE,
        f"with the prior, out of collision after {EARLY} iterations in {100 * rate:.0f} % of the runs "
        f"(at least {100 * REQUIRED_RATE:.0f} %)",
    )


def summarise(outcomes: list[Outcome], best: float) -> dict[str, Any]:
    """Rates with 95 % intervals (Wilson) and quantiles over the seeds of one variant.

    Args:
        outcomes: of the variant.
        best: lowest cost that any variant found.
    """
    runs = len(outcomes)
    early = sum(outcome.free is not None and outcome.free <= EARLY for outcome in outcomes)
    early_mean = sum(outcome.mean_free is not None and outcome.mean_free <= EARLY for outcome in outcomes)
    ratios = [outcome.cost / best for outcome in outcomes if np.isfinite(outcome.cost)]
    near = sum(ratio < 1.01 for ratio in ratios)
    return {
        "runs": runs,
        "collision_free_by_3_rate": early / runs,
        "collision_free_by_3_interval": success_interval(early, runs),
        "mean_collision_free_by_3_rate": early_mean / runs,
        "mean_collision_free_by_3_interval": success_interval(early_mean, runs),
        **_quantiles("iterations_to_collision_free", [outcome.free for outcome in outcomes]),
        **_quantiles("iterations_to_collision_free_mean", [outcome.mean_free for outcome in outcomes]),
        **_quantiles("iterations_to_converge", [outcome.settled for outcome in outcomes]),
        **_quantiles("cost_over_best", ratios),
        "near_best_rate": near / runs,
        "near_best_interval": success_interval(near, runs),
        "never_collision_free": runs - len(ratios),
    }


def _quantiles(name: str, values: list[Any]) -> dict[str, float | None]:
    """Median and 95 % quantile; None where too many runs never got there."""
    counted = [np.inf if value is None else float(value) for value in values]
    found = {}
    for label, q in (("p50", 0.5), ("p95", 0.95)):
        value = float(np.quantile(counted, q, method="higher")) if counted else np.inf
        found[f"{name}_{label}"] = value if np.isfinite(value) else None
    return found


def variant_table(rows: dict[str, dict[str, Any]]) -> str:
    """One row per strategy and prior."""
    header = [
        "strategy", "first distribution", "collision-free after 3 iterations", "its mean too",
        "iterations to collision-free", "iterations to converge", "cost over best", "within 1 % of best",
    ]  # fmt: skip
    body = [
        [
            STRATEGIES[s], PRIORS[p],
            _rate(row, "collision_free_by_3"), _rate(row, "mean_collision_free_by_3"),
            _pair(row, "iterations_to_collision_free", ".0f"), _pair(row, "iterations_to_converge", ".0f"),
            _pair(row, "cost_over_best", ".3f"), _rate(row, "near_best"),
        ]
        for s in STRATEGIES
        for p in PRIORS
        for row in (rows[f"{s}_{p}"],)
    ]  # fmt: skip
    return markdown_table(header, body) + "\nPairs are median / 95 % quantile.\n"


def _rate(row: dict[str, Any], name: str) -> str:
    low, high = row[f"{name}_interval"]
    return f"{100 * row[f'{name}_rate']:.0f} % ({100 * low:.0f}-{100 * high:.0f})"


def _pair(row: dict[str, Any], name: str, form: str) -> str:
    values = [row[f"{name}_{label}"] for label in ("p50", "p95")]
    return " / ".join("never" if value is None else format(value, form) for value in values)
