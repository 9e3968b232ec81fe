"""CMA-ES and sep-CMA-ES against pycma, and their laws."""

import numpy as np
import pytest

from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.optimization.cma import STRATEGIES, CmaEs, default_parameters, has_collapsed, make_strategy


def sphere(x):
    return np.square(x).sum(axis=-1)


def ellipsoid(x):
    return np.square(x) @ np.logspace(0, 4, x.shape[-1])


def rosenbrock(x):
    return (100 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1 - x[:, :-1]) ** 2).sum(axis=-1)


def iterations_to(function, name, seed, *, dimension=6, population=16, target=1e-8, start=0.7, limit=2000):
    strategy = make_strategy(
        name, dimension, population, np.random.default_rng(seed), sigma=0.5, mean=np.full(dimension, start)
    )
    for iteration in range(1, limit + 1):
        samples = strategy.ask()
        costs = function(samples)
        strategy.tell(samples, costs)
        if costs.min() < target:
            return iteration, strategy
    return limit, strategy


@pytest.mark.parametrize("function", [sphere, ellipsoid, rosenbrock])
def test_needs_about_as_many_iterations_as_pycma(function):
    start = 0.0 if function is rosenbrock else 0.7
    ours = [iterations_to(function, "cma", seed, start=start)[0] for seed in range(5)]
    theirs = [iterations_to(function, "pycma", seed, start=start)[0] for seed in range(5)]
    # pycma also learns from bad samples (negative weights), which makes it a little faster.
    assert np.median(ours) < 1.4 * np.median(theirs)
    assert max(ours) < 2000


@pytest.mark.parametrize("function", [sphere, ellipsoid])
def test_separable_needs_about_as_many_iterations_as_pycma(function):
    ours = [iterations_to(function, "sep-cma", seed)[0] for seed in range(5)]
    theirs = [iterations_to(function, "pycma-sep", seed)[0] for seed in range(5)]
    assert np.median(ours) < 1.4 * np.median(theirs)


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
    assert p.weights.size == 5 and p.weights.sum() == pytest.approx(1.0)
    assert np.all(np.diff(p.weights) < 0)
    assert p.mu_eff == pytest.approx(3.167, abs=0.01)  # pycma's value for popsize 10
    separable = default_parameters(10, 10, True)
    assert separable.c_1 == pytest.approx(p.c_1 * 4)
    assert separable.c_mu == pytest.approx(p.c_mu * 4)
    assert p.chi == pytest.approx(3.0847, abs=1e-3)
    for dimension in (1, 2, 50):
        for population in (4, 500):
            q = default_parameters(dimension, population, True)
            assert 0 <= q.c_mu <= 1 - q.c_1 <= 1


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
