"""The smoothness prior against an independent spline, and the algebra of Gaussians."""

import itertools
import tracemalloc

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.priors.contact import contact_factor
from vpsto_ros.priors.gaussian import GaussianPrior, SeparablePrior
from vpsto_ros.priors.smoothness import smoothness_prior
from vpsto_ros.trajectory import OptimalBasis

START, END = np.array([0.2, -1.0]), np.array([1.0, 0.5])
START_VELOCITY, END_VELOCITY = np.array([0.7, -0.4]), np.array([-0.3, 0.2])
DURATION = 1.7


def effort(keys, weights=(1.0, 1.0)):
    """1/2 int q''^T R q'' ds of the clamped spline through (N + 2, 2) keys, by SciPy."""
    knots = np.linspace(0, 1, len(keys))
    ends = ((1, START_VELOCITY * DURATION), (1, END_VELOCITY * DURATION))
    spline = CubicSpline(knots, keys, bc_type=ends)
    total = 0.0
    for left, right in itertools.pairwise(knots):
        nodes, factors = np.polynomial.legendre.leggauss(4)
        values = spline(left + (right - left) * (nodes + 1) / 2, 2)
        total += (right - left) / 2 * factors @ (values**2 @ np.asarray(weights))
    return 0.5 * total


def make(n_via, end=END, **options):
    return smoothness_prior(
        OptimalBasis.uniform(n_via), START, START_VELOCITY, end, END_VELOCITY, DURATION, **options
    )


def keys_of(points, end):
    tail = [] if end is None else [end]
    return np.vstack([START, points, *tail])


@pytest.mark.parametrize("end", [END, None])
@pytest.mark.parametrize("n_via", [1, 2, 4])
def test_the_mean_minimises_the_effort(n_via, end):
    prior = make(n_via, end)

    def cost(flat):
        return effort(keys_of(flat.reshape(-1, 2), end))

    best = minimize(cost, np.zeros(prior.dimension), method="BFGS", options={"gtol": 1e-9})
    np.testing.assert_allclose(prior.mean, best.x, atol=1e-5)


@pytest.mark.parametrize("end", [END, None])
def test_the_covariance_is_the_inverse_hessian_of_the_effort(end):
    weights = np.array([1.0, 3.0])
    prior = make(3, end, weights=weights)
    size = prior.dimension

    def cost(flat):
        return effort(keys_of(flat.reshape(-1, 2), end), weights)

    # The effort is quadratic: second differences with a large step are exact up to round-off.
    unit = np.eye(size)
    base = cost(np.zeros(size))
    hessian = np.array([[cost(a + b) - cost(a) - cost(b) + base for b in unit] for a in unit])
    np.testing.assert_allclose(prior.precision, hessian, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(prior.covariance @ hessian, np.eye(size), atol=1e-8)
    np.testing.assert_allclose(prior.cholesky @ prior.cholesky.T, prior.covariance, atol=1e-14)
    assert np.all(np.triu(prior.cholesky, 1) == 0)


def test_the_mean_of_a_motion_from_rest_to_rest_is_the_straight_cubic():
    still = np.zeros(2)
    prior = smoothness_prior(OptimalBasis.uniform(3), START, still, END, still, 1.0)
    s = np.array([0.25, 0.5, 0.75])[:, None]
    np.testing.assert_allclose(prior.mean_points, START + (END - START) * (3 * s**2 - 2 * s**3), atol=1e-12)
    free = smoothness_prior(OptimalBasis.uniform(3), START, still, None, still, 1.0)
    np.testing.assert_allclose(free.mean_points, np.tile(START, (4, 1)), atol=1e-12)


def test_samples_are_smooth():
    prior = make(8)
    rng = np.random.default_rng(0)
    samples = prior.sample(rng, 2000) - prior.mean_points
    np.testing.assert_allclose(np.cov(samples.reshape(2000, -1).T), prior.covariance, rtol=0.2, atol=1e-3)
    neighbours = np.corrcoef(samples[:, 3, 0], samples[:, 4, 0])[0, 1]
    assert neighbours > 0.9
    assert abs(np.corrcoef(samples[:, 3, 0], samples[:, 3, 1])[0, 1]) < 0.1, "joints are independent"
    white = rng.standard_normal(samples.shape) * samples.std(axis=0)
    assert np.abs(np.diff(samples, 2, axis=1)).mean() < 0.2 * np.abs(np.diff(white, 2, axis=1)).mean()


@pytest.mark.parametrize("end", [END, None])
def test_spread_is_the_mean_standard_deviation(end):
    prior = make(3, end, weights=np.array([1.0, 9.0]), spread=0.06)
    deviations = np.sqrt(np.diag(prior.covariance))
    assert deviations.mean() == pytest.approx(0.06)
    np.testing.assert_allclose(deviations[0::2], 3 * deviations[1::2])
    np.testing.assert_allclose(prior.precision @ prior.covariance, np.eye(prior.dimension), atol=1e-9)
    np.testing.assert_allclose(prior.mean, make(3, end).mean)


def test_scale_multiplies_the_standard_deviations():
    np.testing.assert_allclose(make(2, scale=0.5).covariance, 0.25 * make(2).covariance)
    np.testing.assert_allclose(make(2, scale=0.5).cholesky, 0.5 * make(2).cholesky)


def test_without_via_points():
    empty = make(0, spread=0.1)
    assert empty.dimension == 0 and empty.n_points == 0
    assert empty.to_points(np.zeros((3, 0))).shape == (3, 0, 2)
    only_end = make(0, None)
    assert only_end.n_points == 1
    # The end of least effort of one cubic segment: its chord is the mean of the boundary slopes.
    chord = DURATION * (START_VELOCITY + END_VELOCITY) / 2
    np.testing.assert_allclose(only_end.mean, START + chord, atol=1e-12)


def test_points_and_latent_variables_are_inverse():
    prior = make(3)
    latent = np.random.default_rng(0).standard_normal((5, prior.dimension))
    points = prior.to_points(latent)
    assert points.shape == (5, 3, 2)
    np.testing.assert_allclose(prior.to_latent(points), latent, atol=1e-9)
    np.testing.assert_allclose(prior.to_points(latent[0]), points[0], atol=1e-12)
    np.testing.assert_allclose(prior.to_latent(points[0]), latent[0], atol=1e-9)


def test_a_product_is_the_product_of_densities():
    first, second = make(2), make(2, END + 0.3, scale=2.0)
    product = first.times(second)

    def log(prior, x):
        return -0.5 * (x - prior.mean) @ prior.precision @ (x - prior.mean)

    x = np.random.default_rng(0).standard_normal((3, 4))
    total = [log(first, v) + log(second, v) - log(product, v) for v in x]
    np.testing.assert_allclose(total, total[0], rtol=1e-9)


def test_a_contact_factor_pulls_one_point_and_its_neighbours_follow():
    prior = make(3)
    target, covariance = np.array([2.0, 2.0]), 1e-8 * np.eye(2)
    product = prior.times(*contact_factor(3, 2, 1, target, covariance))
    np.testing.assert_allclose(product.mean_points[1], target, atol=1e-4)
    np.testing.assert_allclose(product.covariance[2:4, 2:4], covariance, rtol=1e-4)
    # The others follow as the spline through the point does, and are less uncertain than before.
    best = minimize(
        lambda others: effort(np.vstack([START, others[:2], target, others[2:], END])),
        np.zeros(4),
        method="BFGS",
        options={"gtol": 1e-9},
    )
    np.testing.assert_allclose(product.mean_points[[0, 2]].ravel(), best.x, atol=1e-4)
    assert np.all(np.linalg.eigvalsh(prior.covariance[:2, :2] - product.covariance[:2, :2]) > 0.0)
    last = prior.times(*contact_factor(3, 2, -1, target, covariance))
    np.testing.assert_allclose(last.mean_points[2], target, atol=1e-4)


def test_a_contact_factor_is_a_gaussian_on_its_point():
    covariance = np.array([[0.04, 0.01], [0.01, 0.09]])
    precision, information = contact_factor(3, 2, 2, np.array([1.0, 2.0]), covariance)
    assert precision.shape == (6, 6) and np.count_nonzero(precision[:4]) == 0
    np.testing.assert_allclose(precision[4:, 4:] @ covariance, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(information, precision @ [0, 0, 0, 0, 1.0, 2.0])


def dense(prior):
    """The same Gaussian without its structure."""
    return GaussianPrior(prior.mean, prior.precision, prior.dof)


@pytest.mark.parametrize("end", [END, None])
@pytest.mark.parametrize("n_via", [1, 3, 7])
def test_the_structured_form_equals_the_dense_one(n_via, end):
    prior = make(n_via, end, weights=np.array([0.3, 2.0]), spread=0.2)
    plain, rng = dense(prior), np.random.default_rng(0)
    latent = rng.standard_normal((6, prior.dimension))
    np.testing.assert_allclose(prior.to_points(latent), plain.to_points(latent), atol=1e-12)
    points = rng.standard_normal((6, prior.n_points, 2))
    np.testing.assert_allclose(prior.to_latent(points), plain.to_latent(points), atol=1e-9)
    np.testing.assert_allclose(prior.covariance, plain.covariance, atol=1e-12)
    np.testing.assert_allclose(prior.cholesky, plain.cholesky, atol=1e-12)
    samples = prior.sample(np.random.default_rng(1), 5)
    np.testing.assert_allclose(samples, plain.sample(np.random.default_rng(1), 5), atol=1e-12)
    spread = np.array([[0.02, 0.01], [0.01, 0.03]])
    factor = contact_factor(prior.n_points, 2, 0, np.array([0.4, 0.1]), spread)
    product, expected = prior.times(*factor), plain.times(*factor)
    np.testing.assert_array_equal(product.mean, expected.mean)
    np.testing.assert_array_equal(product.precision, expected.precision)
    np.testing.assert_allclose(prior.times(plain).mean, prior.mean, atol=1e-12)


def peak_memory(n):
    """Bytes it takes to make a prior over 4 points of n degrees of freedom, to draw from it and back."""
    zeros, ones = np.zeros(n), np.ones(n)
    tracemalloc.start()
    prior = smoothness_prior(OptimalBasis.uniform(4), zeros, zeros, ones, zeros, 1.0, spread=0.1)
    prior.to_latent(prior.sample(np.random.default_rng(0), 8))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_the_cost_grows_linearly_with_the_degrees_of_freedom():
    peak_memory(3)
    few, many = peak_memory(1000), peak_memory(4000)
    assert many < 4.5 * few
    assert many < 4000 * 4 * 8 * 40, "a dense matrix would take 4000 * 4 * 8 * 16000 bytes"


def test_many_points_stay_well_conditioned():
    prior = smoothness_prior(
        OptimalBasis.uniform(20), np.zeros(7), np.zeros(7), np.ones(7), np.zeros(7), 1.0, spread=0.3
    )
    np.testing.assert_allclose(prior.precision @ prior.covariance, np.eye(140), atol=1e-6)


def test_errors_name_what_is_wrong():
    with pytest.raises(InvalidInputError, match="duration"):
        smoothness_prior(OptimalBasis.uniform(1), START, START, END, END, 0.0)
    with pytest.raises(InvalidInputError, match=r"end_velocity must be finite with shape \(2,\)"):
        smoothness_prior(OptimalBasis.uniform(1), START, START, END, np.zeros(3), 1.0)
    with pytest.raises(InvalidInputError, match="weights"):
        make(2, weights=np.array([1.0, 0.0]))
    with pytest.raises(InvalidInputError, match="spread"):
        make(2, spread=-0.1)
    with pytest.raises(InvalidInputError, match="multiple of dof"):
        GaussianPrior(np.zeros(5), np.eye(5), 2)
    with pytest.raises(InvalidInputError, match="not positive definite"):
        _ = GaussianPrior(np.zeros(2), -np.eye(2), 2).cholesky
    with pytest.raises(InvalidInputError, match="not positive definite"):
        SeparablePrior(np.zeros((1, 2)), -np.eye(1), np.ones(2))
    with pytest.raises(InvalidInputError, match="2 positive scales"):
        SeparablePrior(np.zeros((1, 2)), np.eye(1), np.array([1.0, 0.0]))
    with pytest.raises(InvalidInputError, match="4 variables"):
        make(2).times(np.eye(3), np.zeros(3))
    with pytest.raises(InvalidInputError, match="information vector"):
        make(2).times(np.eye(4))


def test_contact_errors_name_what_is_wrong():
    with pytest.raises(InvalidInputError, match="point_index = 3"):
        contact_factor(3, 2, 3, np.zeros(2), np.eye(2))
    with pytest.raises(InvalidInputError, match="positive definite"):
        contact_factor(3, 2, 0, np.zeros(2), np.zeros((2, 2)))
    with pytest.raises(InvalidInputError, match=r"covariance \(2, 2\)"):
        contact_factor(3, 2, 0, np.zeros(3), np.eye(2))
    with pytest.raises(InvalidInputError, match="finite"):
        contact_factor(3, 2, 0, np.full(2, np.nan), np.eye(2))
