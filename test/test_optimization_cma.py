"""CMA-ES and sep-CMA-ES against pycma, and their laws."""

import cma
import numpy as np
import pytest

from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.optimization.cma import STRATEGIES, CmaEs, has_collapsed, make_strategy
from vpsto_ros.optimization.cma_parameters import default_parameters
from vpsto_ros.optimization.costs import JointSpaceProblem
from vpsto_ros.optimization.vpsto import VpstoConfig, search
from vpsto_ros.trajectory import Limits, OptimalBasis


def sphere(x):
    return np.square(x).sum(axis=-1)


def ellipsoid(x):
    return np.square(x) @ np.logspace(0, 4, x.shape[-1])


def rosenbrock(x):
    return (100 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1 - x[:, :-1]) ** 2).sum(axis=-1)


def cigar(x):
    return np.square(x[..., 0]) + 1e4 * np.square(x[..., 1:]).sum(axis=-1)


def tablet(x):
    return 1e4 * np.square(x[..., 0]) + np.square(x[..., 1:]).sum(axis=-1)


def different_powers(x):
    return (np.abs(x) ** np.linspace(2, 6, x.shape[-1])).sum(axis=-1)


def iterations_to(
    function, name, seed, *, dimension=6, population=16, target=1e-8, start=0.7, limit=2000, **options
):
    mean = np.full(dimension, start)
    rng = np.random.default_rng(seed)
    strategy = make_strategy(name, dimension, population, rng, sigma=0.5, mean=mean, **options)
    for iteration in range(1, limit + 1):
        samples = strategy.ask()
        costs = function(samples)
        strategy.tell(samples, costs)
        if costs.min() < target:
            return iteration, strategy
    return limit, strategy


def pycma(dimension, population, rng, separable, start):
    """The cma package itself with its default options."""
    options = {
        "popsize": population,
        "CMA_diagonal": separable,
        "randn": lambda *shape: rng.standard_normal(shape),
        "seed": np.nan,
        "verbose": -9,
    }
    return cma.CMAEvolutionStrategy(np.full(dimension, start), 0.5, options)


def iterations_of_pycma(function, seed, separable, *, dimension, population, start, target=1e-8, limit=2000):
    strategy = pycma(dimension, population, np.random.default_rng(1000 + seed), separable, start)
    for iteration in range(1, limit + 1):
        samples = np.array(strategy.ask())
        costs = function(samples)
        strategy.tell(list(samples), costs.tolist())
        if costs.min() < target:
            return iteration
    return limit


def ratio_of(ours, theirs):
    """Logarithm of the ratio of the geometric means of iterations, and its standard error."""
    a, b = np.log(ours), np.log(theirs)
    return a.mean() - b.mean(), np.sqrt(a.var(ddof=1) / len(a) + b.var(ddof=1) / len(b))


SEEDS = range(20)
SEPARABLE = (sphere, ellipsoid, cigar, tablet, different_powers)
STANDARD = [
    *((function, 6, 16, separable) for function in SEPARABLE for separable in (False, True)),
    (rosenbrock, 6, 16, False),  # separably both need thousands of iterations along its valley
    *((function, 10, 12, separable) for function in (tablet,) for separable in (False, True)),
]


@pytest.mark.parametrize(("function", "dimension", "population", "separable"), STANDARD)
def test_needs_as_many_iterations_as_pycma(function, dimension, population, separable):
    size = {"dimension": dimension, "population": population, "start": 0.0 if function is rosenbrock else 0.7}
    theirs = [iterations_of_pycma(function, seed, separable, **size) for seed in SEEDS]
    assert max(theirs) < 2000
    name = "sep-cma" if separable else "cma"
    # Both end at the only point where the function is below the target.
    ours = [iterations_to(function, name, seed, **size)[0] for seed in SEEDS]
    ratio, error = ratio_of(ours, theirs)
    assert error < 0.05
    # Measured: full 0.97 to 1.02; separable, which is another rule in pycma, 0.92 to 1.00.
    assert -(0.08 if separable else 0.02) - 3 * error < ratio < 0.02 + 3 * error


@pytest.mark.parametrize("function", [tablet, cigar])
def test_separable_needs_no_more_iterations_than_pycma_in_many_dimensions(function):
    size, seeds = {"dimension": 28, "population": 25, "start": 0.7}, range(4)
    theirs = [iterations_of_pycma(function, seed, True, **size) for seed in seeds]
    ratio, error = ratio_of([iterations_to(function, "sep-cma", seed, **size)[0] for seed in seeds], theirs)
    assert ratio < 0.02 + 3 * error


@pytest.mark.parametrize(("separable", "gain"), [(False, 1.3), (True, 1.03)])
def test_bad_samples_teach_something(separable, gain):
    name = "sep-cma" if separable else "cma"
    with_them, without = (
        [iterations_to(tablet, name, seed, dimension=10, population=12, active=active)[0] for seed in SEEDS]
        for active in (True, False)
    )
    ratio, error = ratio_of(without, with_them)
    assert ratio - 3 * error > np.log(gain)


@pytest.mark.parametrize(("dimension", "population"), [(3, 12), (6, 16), (10, 12), (20, 10)])
def test_the_constants_are_those_of_pycma(dimension, population):
    reference = pycma(dimension, population, np.random.default_rng(0), False, 1.0)
    samples = np.array(reference.ask())
    reference.tell(list(samples), sphere(samples).tolist())  # some constants are only set by the first update
    p, theirs = default_parameters(dimension, population, False), reference.sp
    step_size = reference.adapt_sigma
    np.testing.assert_allclose(p.weights, theirs.weights, atol=1e-12)
    assert p.mu == theirs.weights.mu and p.mu_eff == pytest.approx(theirs.weights.mueff)
    found = [p.c_sigma, p.d_sigma, p.c_c, p.c_1, p.c_mu]
    np.testing.assert_allclose(found, [step_size.cs, step_size.damps, theirs.cc, theirs.c1, theirs.cmu])


@pytest.mark.parametrize(("dimension", "population"), [(6, 16), (3, 12)])
def test_told_the_same_it_becomes_what_pycma_becomes(dimension, population):
    reference = pycma(dimension, population, np.random.default_rng(1), False, 0.7)
    samples = np.array(reference.ask())
    ours = CmaEs(dimension, population, np.random.default_rng(0), sigma=0.5, mean=np.full(dimension, 0.7))
    ours._covariance = reference.sm.C.copy()  # which is not exactly the identity
    ours._decompose()
    for _ in range(10):
        costs = ellipsoid(samples)
        reference.tell(list(samples), costs.tolist())
        ours.tell(samples, costs)
        samples = np.array(reference.ask())
        np.testing.assert_allclose(ours.mean, reference.mean, rtol=1e-6)
        np.testing.assert_allclose(ours._covariance, reference.sm.C, rtol=1e-6, atol=1e-6)
        assert ours.sigma == pytest.approx(reference.sigma, rel=1e-6)


PLANE = Limits(np.full(2, 1.0), np.full(2, 2.0), np.full(2, -0.6), np.full(2, 1.2))
MOVES = {
    "round a disc": JointSpaceProblem(
        OptimalBasis.uniform(3), PLANE, np.zeros(2), np.array([1.0, 0.0]),
        collision=lambda q: np.hypot(q[..., 0] - 0.5, q[..., 1] + 0.05) < 0.3,
    ),
    "seven joints": JointSpaceProblem(
        OptimalBasis.uniform(2), Limits(np.linspace(0.5, 1, 7), np.full(7, 10.0)), np.zeros(7), np.ones(7)
    ),
}  # fmt: skip


@pytest.mark.parametrize(("ours", "theirs"), [("cma", "pycma"), ("sep-cma", "pycma-sep")])
@pytest.mark.parametrize("move", MOVES)
def test_agrees_with_pycma_on_trajectories(move, ours, theirs):
    problem = MOVES[move]
    prior = problem.prior(spread=0.2)

    def runs(strategy):
        config = VpstoConfig(strategy=strategy, population=24, iterations=100, restarts=0)
        return [search(prior, problem.evaluate, config, np.random.default_rng(seed)) for seed in SEEDS]

    found = {strategy: runs(strategy) for strategy in (ours, theirs)}
    costs = {strategy: [result.cost for result in results] for strategy, results in found.items()}
    best = min(costs[ours] + costs[theirs])
    assert min(costs[ours]) == pytest.approx(best, rel=2e-3)
    assert np.median(costs[ours]) < 1.002 * np.median(costs[theirs])

    def taken(result):
        below = (k for k, entry in enumerate(result.history, 1) if entry.best_valid_cost < 1.01 * result.cost)
        return next(below)

    ratio, error = ratio_of(*([taken(result) for result in found[strategy]] for strategy in (ours, theirs)))
    assert error < 0.1
    # In 14 dimensions pycma damps the step size of 24 samples more than the tutorial does, and is slower.
    least = -(0.4 if move == "seven joints" else 0.1 if ours == "sep-cma" else 0.03)
    assert least - 3 * error < ratio < 0.03 + 3 * error


def test_the_same_optimum_is_found():
    for name in ("cma", "pycma"):
        _, strategy = iterations_to(rosenbrock, name, 1, start=0.0, target=1e-12)
        np.testing.assert_allclose(strategy.mean, 1.0, atol=1e-4)


def test_the_covariance_becomes_the_inverse_hessian():
    rng = np.random.default_rng(3)
    root = rng.standard_normal((4, 4)) + 2 * np.eye(4)
    hessian = root @ root.T
    strategy = CmaEs(4, 40, rng, mean=np.ones(4))
    for _ in range(60):
        samples = strategy.ask()
        strategy.tell(samples, np.einsum("bi,ij,bj->b", samples, hessian, samples))
    shape = strategy._covariance @ hessian
    np.testing.assert_allclose(shape / np.trace(shape) * 4, np.eye(4), atol=0.5)


def test_default_parameters_follow_the_tutorial():
    p = default_parameters(10, 10, False)
    assert p.mu == 5 and p.weights[:5].sum() == pytest.approx(1.0)
    assert np.all(np.diff(p.weights) < 0)
    assert p.c_1 + p.c_mu * p.weights.sum() == pytest.approx(0.0)  # nothing is forgotten
    np.testing.assert_array_equal(default_parameters(10, 10, False, active=False).weights[5:], 0.0)
    assert p.mu_eff == pytest.approx(3.167, abs=0.01)  # pycma's value for popsize 10
    separable = default_parameters(10, 10, True)
    assert separable.c_1 == pytest.approx(p.c_1 * 4)
    assert separable.c_mu == pytest.approx(p.c_mu * 4)
    assert p.chi == pytest.approx(3.0847, abs=1e-3)
    for dimension in (1, 2, 50):
        for population in (4, 500):
            q = default_parameters(dimension, population, True)
            assert 0 <= q.c_mu <= 1 - q.c_1 <= 1
            negative = -q.weights[q.mu :].sum()
            assert 0 <= dimension * q.c_mu * negative <= (1 - q.c_1 - q.c_mu) * (1 + 1e-12)


@pytest.mark.parametrize("separable", [False, True])
def test_the_first_population_is_drawn_from_the_given_gaussian(separable):
    strategy = CmaEs(3, 20_000, np.random.default_rng(0), sigma=2.0, mean=np.arange(3.0), separable=separable)
    samples = strategy.ask()
    np.testing.assert_allclose(samples.mean(axis=0), np.arange(3.0), atol=0.06)
    np.testing.assert_allclose(np.cov(samples.T), 4 * np.eye(3), atol=0.15)


@pytest.mark.parametrize("name", STRATEGIES)
def test_bad_costs_rank_last_and_leave_no_trace(name):
    strategy = make_strategy(name, 4, 12, np.random.default_rng(0), mean=np.full(4, 2.0))
    for _ in range(120):
        samples = strategy.ask()
        costs = sphere(samples)
        costs[::3] = [np.nan, np.inf, -np.inf, np.nan]
        strategy.tell(samples, costs)
    assert sphere(strategy.mean) < 1e-3
    assert np.isfinite(strategy.covariance_diagonal).all() and np.isfinite(strategy.sigma)


def covariance(strategy):
    return np.diag(strategy._covariance) if strategy.separable else strategy._covariance


@pytest.mark.parametrize("separable", [False, True])
@pytest.mark.parametrize("population", [5, 8, 32])
@pytest.mark.parametrize("dimension", [1, 2, 6, 28, 60, 150])
def test_the_covariance_stays_positive_definite_at_worst(dimension, population, separable):
    """All bad samples lie in one direction, until the eigenvectors are computed anew."""
    strategy = CmaEs(dimension, population, np.random.default_rng(0), separable=separable)
    good = population // 2
    for _ in range(int(strategy._parameters.lazy_gap) + 1):
        samples = np.zeros((population, dimension))
        samples[good:, 0] = 30.0
        strategy.tell(strategy.mean + samples, np.arange(population, dtype=float))
        assert np.linalg.eigvalsh(covariance(strategy))[0] > 1e-5


@pytest.mark.parametrize("separable", [False, True])
def test_the_covariance_stays_positive_definite_with_few_finite_costs(separable):
    rng = np.random.default_rng(0)
    strategy = CmaEs(8, 16, rng, separable=separable)
    for _ in range(300):
        samples = strategy.ask()
        samples[:2] += 100.0 * rng.standard_normal((2, 8))
        costs = rng.standard_normal(16)
        costs[rng.permutation(16)[: rng.integers(0, 17)]] = np.nan
        strategy.tell(samples, costs, injected=2)
        values = np.linalg.eigvalsh(covariance(strategy))
        assert values[0] > 1e-9 * values[-1] and np.isfinite(strategy.sigma)


@pytest.mark.parametrize("separable", [False, True])
def test_the_length_of_a_bad_step_does_not_matter(separable):
    results = []
    for length in (1e-3, 1.0, 1e3):
        strategy = CmaEs(5, 10, np.random.default_rng(0), separable=separable)
        samples = strategy.ask()
        samples[5:] *= length
        strategy.tell(samples, np.arange(10.0))
        results.append(covariance(strategy))
    np.testing.assert_allclose(results[0], results[1], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(results[2], results[1], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("separable", [False, True])
def test_a_bad_direction_loses_variance_unless_it_is_an_injected_one(separable):
    def variance(injected, active=True):
        strategy = CmaEs(4, 8, np.random.default_rng(0), separable=separable, active=active)
        samples = np.zeros((8, 4))
        samples[:4, 0] = 1.0
        samples[4:, 1] = 1.0
        costs = np.array([4.0, 5.0, 6.0, 7.0, 0.0, 1.0, 2.0, 3.0])
        strategy.tell(samples, costs, injected)
        return covariance(strategy)[0, 0] / covariance(strategy)[2, 2]

    assert variance(0) < variance(2) < 1 - 1e-3
    assert variance(4) == pytest.approx(1.0) == variance(0, active=False)


@pytest.mark.parametrize("name", ["cma", "sep-cma"])
def test_nothing_is_learned_when_no_cost_is_finite(name):
    strategy = make_strategy(name, 3, 8, np.random.default_rng(0))
    strategy.tell(strategy.ask(), np.full(8, np.nan))
    np.testing.assert_array_equal(strategy.mean, 0.0)
    assert strategy.sigma == 1.0


@pytest.mark.parametrize("name", ["cma", "sep-cma"])
def test_a_distant_injected_solution_attracts_without_blowing_up(name):
    strategy = make_strategy(name, 4, 16, np.random.default_rng(0), sigma=0.1)
    target = np.full(4, 100.0)
    samples = strategy.ask()
    samples[0] = target
    strategy.tell(samples, sphere(samples - target), injected=1)
    assert strategy.mean @ target > 0
    assert np.linalg.norm(strategy.mean) < 1.0
    assert strategy.covariance_diagonal.max() < 10.0 and strategy.sigma < 0.4


@pytest.mark.parametrize("name", ["cma", "sep-cma", "pycma"])
def test_the_same_seed_gives_the_same_run(name):
    runs = [iterations_to(sphere, name, 7, limit=20, target=0)[1].mean for _ in range(2)]
    np.testing.assert_array_equal(*runs)


def test_flat_costs_keep_the_numbers_sane():
    for separable in (False, True):
        strategy = CmaEs(5, 10, np.random.default_rng(0), separable=separable)
        for _ in range(500):
            strategy.tell(strategy.ask(), np.zeros(10))
        assert np.isfinite(strategy.mean).all() and np.isfinite(strategy.sigma)


@pytest.mark.parametrize("name", ["cma", "sep-cma"])
@pytest.mark.parametrize("optimum", [0.0, 3.0])
def test_runs_to_the_end_of_precision_and_then_stands_still(name, optimum):
    strategy = make_strategy(name, 5, 12, np.random.default_rng(0), mean=np.ones(5))
    for _ in range(2000):
        samples = strategy.ask()
        strategy.tell(samples, ellipsoid(samples - optimum))
    np.testing.assert_allclose(strategy.mean, optimum, atol=1e-7)
    assert has_collapsed(strategy) and strategy.sigma > 0.0
    values = strategy.covariance_diagonal
    assert np.isfinite(values).all() and values.min() > 0.0


def test_one_dimension_works():
    _, strategy = iterations_to(sphere, "cma", 0, dimension=1, population=8)
    assert abs(strategy.mean[0]) < 1e-3


def test_errors_name_what_is_wrong():
    rng = np.random.default_rng(0)
    with pytest.raises(ConfigurationError, match=r"no strategy 'cmaes'; available: sep-cma, cma"):
        make_strategy("cmaes", 3, 8, rng)
    with pytest.raises(InvalidInputError, match="dimension"):
        CmaEs(0, 8, rng)
    with pytest.raises(InvalidInputError, match="sigma"):
        CmaEs(3, 8, rng, sigma=np.nan)
    with pytest.raises(InvalidInputError, match=r"shape \(3,\)"):
        CmaEs(3, 8, rng, mean=np.zeros(2))
