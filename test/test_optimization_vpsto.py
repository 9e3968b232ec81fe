"""The search loop: what it returns, when it stops, what it refuses."""

import math

import numpy as np
import pytest

from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.optimization.progress import Evaluation
from vpsto_ros.optimization.vpsto import VpstoConfig, search
from vpsto_ros.priors.gaussian import GaussianPrior

TARGET = np.array([[0.5, -0.3], [1.0, 0.2]])


@pytest.fixture
def prior():
    root = np.random.default_rng(1).standard_normal((4, 4))
    return GaussianPrior(np.zeros(4), root @ root.T + np.eye(4), 2)


def distance(points):
    return np.square(points - TARGET).sum(axis=(1, 2))


def bowl(points):
    return Evaluation(distance(points), np.ones(len(points), dtype=bool))


def never_valid(points):
    return Evaluation(distance(points), np.zeros(len(points), dtype=bool))


class Recorder:
    """Remembers what it was asked to evaluate."""

    def __init__(self, evaluate=bowl):
        self.evaluate = evaluate
        self.batches = []

    def __call__(self, points):
        self.batches.append(points.copy())
        return self.evaluate(points)


def run(prior, evaluate=bowl, seed=0, **options):
    arguments = {name: options.pop(name) for name in list(options) if name in SEARCH_ARGUMENTS}
    return search(prior, evaluate, VpstoConfig(**options), np.random.default_rng(seed), **arguments)


SEARCH_ARGUMENTS = ("seeds", "mean", "means", "sigma", "deadline", "clock")


@pytest.mark.parametrize("strategy", ["sep-cma", "cma", "pycma", "pycma-sep"])
def test_finds_the_minimum(prior, strategy):
    result = run(prior, strategy=strategy, iterations=80)
    np.testing.assert_allclose(result.points, TARGET, atol=1e-4)
    assert result.status == "iterations" and result.iterations == 80 and result.evaluations == 80 * 32


def test_the_first_population_follows_the_prior(prior):
    recorder = Recorder()
    run(prior, recorder, population=20_000, iterations=1)
    flat = recorder.batches[0].reshape(-1, 4)
    np.testing.assert_allclose(np.cov(flat.T), prior.covariance, atol=0.05)


def test_seeds_and_the_mean_are_in_the_first_population(prior):
    recorder = Recorder()
    seeds = np.random.default_rng(5).standard_normal((3, 2, 2))
    result = run(prior, recorder, seeds=np.concatenate([seeds, TARGET[None]]), mean=seeds[0], iterations=1)
    first = recorder.batches[0]
    for wanted in (*seeds, TARGET):
        assert np.abs(first - wanted).max(axis=(1, 2)).min() < 1e-9
    assert result.cost < 1e-20
    assert np.count_nonzero(np.abs(first - seeds[0]).max(axis=(1, 2)) < 1e-9) == 1, "the mean only once"


def test_a_warm_start_stays_near_its_mean_and_is_never_worse(prior):
    start = TARGET + 0.01
    recorder = Recorder()
    result = run(prior, recorder, mean=start, sigma=0.01, iterations=1)
    assert np.abs(recorder.batches[0] - start).max() < 0.1
    assert result.cost <= distance(start[None])[0]


def test_several_starts_are_evaluated_in_one_batch_at_their_own_means(prior):
    recorder = Recorder()
    means = np.array([TARGET, TARGET + 5, TARGET - 5])
    result = run(prior, recorder, means=means, sigma=0.01, starts=3, population=8, iterations=3)
    assert [len(batch) for batch in recorder.batches] == [24, 24, 24]
    for mean, group in zip(means, recorder.batches[0].reshape(3, 8, 2, 2), strict=True):
        assert np.abs(group - mean).max() < 0.1
    assert result.evaluations == 72


def test_of_too_many_means_the_cheapest_are_taken(prior):
    recorder = Recorder()
    means = np.array([TARGET + 5, TARGET - 4, TARGET + 0.1, TARGET + 0.2])
    run(prior, recorder, means=means, sigma=0.001, starts=2, population=8, iterations=1)
    assert len(recorder.batches[0]) == 4
    assert np.abs(recorder.batches[1] - TARGET).max() < 0.3


def test_only_valid_candidates_are_returned_and_the_best_of_them(prior):
    recorder = Recorder(lambda p: Evaluation(distance(p), p[:, 0, 0] < 0.4))
    result = run(prior, recorder, iterations=30)
    every = np.concatenate(recorder.batches)
    costs = distance(every)
    assert result.valid and result.points[0, 0] < 0.4
    assert result.cost == costs[every[:, 0, 0] < 0.4].min()
    assert result.best_any_cost == costs.min() < result.cost
    assert result.history[-1].best_valid_cost == result.cost


def test_nothing_valid_is_said_plainly_and_the_budget_is_kept(prior):
    result = run(prior, never_valid, iterations=20, restarts=3)
    assert result.status == "no valid plan" and not result.valid
    assert result.points is None and result.cost == math.inf
    assert result.restarts == 3 and result.iterations == 20
    assert result.best_any_points.shape == (2, 2) and np.isfinite(result.best_any_cost)


def test_every_restart_is_wider_and_restarts_share_what_is_left(prior):
    result = run(prior, never_valid, iterations=20, restarts=3, sigma=0.1)
    widths = [entry.sigma for entry in result.history]
    assert [widths[k] for k in (0, 5, 10, 15)] == pytest.approx([0.1, 2.0, 4.0, 8.0])  # config.sigma = 1


def test_no_restart_once_something_is_valid(prior):
    result = run(prior, iterations=12, restarts=3)
    assert result.restarts == 0


def test_a_far_valid_region_is_found_after_a_restart(prior):
    def far(points):
        off = np.linalg.norm(points[:, 0], axis=1)
        return Evaluation(-np.minimum(off, 5.0), off > 5.0)

    assert run(prior, far, iterations=12, restarts=2).valid


def test_bad_costs_are_never_returned_and_are_counted(prior):
    def broken(points):
        cost = distance(points)
        cost[::4], cost[1::4], cost[2::4] = np.nan, np.inf, -np.inf
        return Evaluation(cost, np.ones(len(points), dtype=bool))

    result = run(prior, broken, iterations=5)
    assert result.valid and np.isfinite(result.cost) and np.isfinite(result.points).all()
    assert result.non_finite == 5 * 24
    nothing = run(prior, lambda p: Evaluation(np.full(len(p), np.nan), np.ones(len(p), dtype=bool)))
    assert nothing.status == "no valid plan" and nothing.best_any_points is None


def test_the_deadline_is_kept_with_the_best_so_far(prior):
    now = [0.0]

    def slow(points):
        now[0] += 0.01
        return bowl(points)

    result = run(prior, slow, iterations=1000, deadline=0.035, clock=lambda: now[0])
    assert result.status == "deadline" and result.valid
    assert result.iterations == 3 and now[0] <= 0.035, "a fourth iteration would have ended too late"
    late = run(prior, deadline=0.0, clock=lambda: 1.0)
    assert late.iterations == 0 and late.status == "no valid plan" and late.points is None


def test_stops_when_converged(prior):
    result = run(prior, iterations=500, tolerance=1e-9)
    assert result.status == "converged" and result.iterations < 200
    flat = run(prior, never_valid, iterations=500, tolerance=1e-9, restarts=2)
    assert flat.status == "no valid plan" and flat.restarts == 2


def test_convergence_may_have_to_last(prior):
    iterations = [
        run(prior, iterations=500, tolerance=1e-4, patience=patience).iterations for patience in (1, 5, 20)
    ]
    assert iterations[0] < iterations[1] < iterations[2] < 500


def test_a_search_that_cannot_change_any_more_ends(prior):
    for strategy in ("sep-cma", "cma", "pycma"):
        result = run(prior, strategy=strategy, iterations=2000)
        assert result.status == "converged" and result.iterations < 1000
        np.testing.assert_allclose(result.points, TARGET, atol=1e-9)
    nothing = run(prior, never_valid, iterations=5000, restarts=2)
    assert nothing.status == "no valid plan" and nothing.iterations < 5000 and nothing.restarts == 2


def two_valleys(points):
    """A wide valley, and a deeper one that is narrower at -TARGET."""
    deep = 3.0 * np.square(points + TARGET).sum(axis=(1, 2)) - 0.5
    return Evaluation(np.minimum(distance(points), deep), np.ones(len(points), dtype=bool))


def test_restarts_after_convergence_find_other_optima(prior):
    once = [run(prior, two_valleys, seed=s, iterations=400, population=8).cost for s in range(8)]
    options = {"iterations": 400, "population": 8, "tolerance": 1e-3, "patience": 5, "restarts": 50}
    again = [run(prior, two_valleys, seed=s, restart="converged", **options) for s in range(8)]
    assert np.sum(np.array(once) > -0.4) >= 2, "a single search often ends in the wide valley"
    assert all(result.cost < -0.49 and 1 < result.restarts <= 50 for result in again)
    assert all(len(result.history) <= 400 for result in again)


def test_the_population_may_grow_at_every_restart(prior):
    recorder = Recorder()
    run(
        prior, recorder, iterations=300, population=6, restarts=2, restart="converged", tolerance=1e-3,
        population_growth=2.0, starts=2,
    )  # fmt: skip
    sizes = [len(batch) for batch in recorder.batches]
    assert sorted(set(sizes)) == [12, 24, 48] and sizes == sorted(sizes)


def test_a_clock_of_evaluations_makes_the_deadline_a_budget(prior):
    recorder = Recorder()

    def evaluations():
        return sum(map(len, recorder.batches))

    options = {"iterations": 10_000, "population": 10, "population_growth": 2.0, "restarts": 100}
    result = run(
        prior, recorder, deadline=1001, clock=evaluations, restart="converged", tolerance=1e-2, **options
    )
    assert result.status == "deadline" and 900 < result.evaluations == evaluations() <= 1000


@pytest.mark.parametrize(("reserve", "done"), [("longest", 3), ("last", 7), ("none", 8)])
def test_what_is_kept_free_before_the_deadline(prior, reserve, done):
    now, durations = [0.0], iter([0.01, 0.05] + [0.01] * 50)

    def slow(points):
        now[0] += next(durations)
        return bowl(points)

    result = run(prior, slow, iterations=1000, deadline=0.1195, clock=lambda: now[0], reserve=reserve)
    assert result.iterations == done and result.status == "deadline"


def test_the_result_depends_on_the_generator_only(prior):
    first, second, other = run(prior), run(prior), run(prior, seed=1)
    np.testing.assert_array_equal(first.points, second.points)
    assert first.history == second.history
    assert not np.array_equal(first.points, other.points)


def test_the_result_survives_changes_to_the_evaluated_array(prior):
    arrays = []

    def keeping(points):
        arrays.append(points)
        return bowl(points)

    result = run(prior, keeping, iterations=2)
    kept = result.points.copy()
    for array in arrays:
        array[:] = np.nan
    np.testing.assert_array_equal(result.points, kept)


@pytest.mark.parametrize(
    ("cost", "valid"),
    [((31,), (32,)), ((32, 1), (32,)), ((32,), (31,))],
)
def test_wrong_shapes_from_evaluate_are_named(prior, cost, valid):
    with pytest.raises(InvalidInputError, match=r"must return cost \(32,\) and valid \(32,\) of bool; got"):
        run(prior, lambda p: Evaluation(np.zeros(cost), np.ones(valid, dtype=bool)))


def test_validity_must_be_bool(prior):
    with pytest.raises(InvalidInputError, match="float64"):
        run(prior, lambda p: Evaluation(distance(p), np.ones(len(p))))


def test_wrong_arguments_are_named(prior):
    with pytest.raises(InvalidInputError, match=r"seeds must be finite points of shape \(2, 2\) each"):
        run(prior, seeds=np.zeros((3, 2, 3)))
    with pytest.raises(InvalidInputError, match="mean must be finite"):
        run(prior, mean=np.full((2, 2), np.nan))
    with pytest.raises(InvalidInputError, match="either mean or means"):
        run(prior, mean=TARGET, means=TARGET[None])
    with pytest.raises(InvalidInputError, match="40 seeds do not fit"):
        run(prior, seeds=np.random.default_rng(0).standard_normal((40, 2, 2)))
    with pytest.raises(InvalidInputError, match="no via-points"):
        run(GaussianPrior(np.zeros(0), np.zeros((0, 0)), 2))
    with pytest.raises(InvalidInputError, match="sigma"):
        run(prior, sigma=0.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"prior": None}, "prior must be a GaussianPrior"),
        ({"evaluate": None}, "evaluate must be a function"),
        ({"config": {}}, "config must be a VpstoConfig"),
        ({"rng": None}, "rng must be a Generator"),
        ({"rng": 3}, "rng must be a Generator"),
        ({"deadline": math.nan}, "deadline must be a time"),
        ({"deadline": "soon"}, "deadline must be a time"),
    ],
)
def test_things_of_another_kind_are_named(prior, change, message):
    arguments = {
        "prior": prior, "evaluate": bowl, "config": VpstoConfig(), "rng": np.random.default_rng(0), **change,
    }  # fmt: skip
    with pytest.raises(InvalidInputError, match=message):
        search(**arguments)


@pytest.mark.parametrize(
    ("field", "value"), [("population", 2), ("iterations", 0), ("strategy", "adam"), ("sigma", -1.0)]
)
def test_configuration_errors_name_the_field(field, value):
    with pytest.raises(ConfigurationError, match=f"VpstoConfig.{field} = "):
        VpstoConfig(**{field: value})
