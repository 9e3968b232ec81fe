"""Linear-Gaussian models: conditioning, calibration and what is refused."""

import numpy as np
import pytest

from vpsto_ros.contact.linear_gaussian import LinearGaussian
from vpsto_ros.exceptions import InvalidInputError

MATRIX = np.array([[0.9, 0.1, -0.2], [0.0, -0.7, 0.3]])
OFFSET = np.array([0.05, -0.02])
COVARIANCE = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
TRUE = LinearGaussian(MATRIX, OFFSET, COVARIANCE)


def samples(count, seed=0):
    rng = np.random.default_rng(seed)
    inputs = rng.normal([0.5, -1.0, 2.0], [1.0, 0.4, 0.7], (count, 3))
    return TRUE.sample(inputs, rng), inputs


def test_what_made_the_data_is_found_again():
    model = LinearGaussian.fit(*samples(40_000))
    np.testing.assert_allclose(model.matrix, MATRIX, atol=2e-3)
    np.testing.assert_allclose(model.offset, OFFSET, atol=2e-3)
    np.testing.assert_allclose(model.covariance, COVARIANCE, rtol=0.05)


def test_it_is_the_joint_gaussian_conditioned():
    """Against eqs. (5.4), (5.5) written out with the blocks of the joint covariance."""
    outputs, inputs = samples(200)
    model = LinearGaussian.fit(outputs, inputs, least_std=0.0)
    joint = np.cov(np.hstack([outputs, inputs]).T, bias=True)
    yy, yx, xx = joint[:2, :2], joint[:2, 2:], joint[2:, 2:]
    theta = yx @ np.linalg.inv(xx)
    np.testing.assert_allclose(model.matrix, theta, atol=1e-10)
    np.testing.assert_allclose(model.offset, outputs.mean(axis=0) - theta @ inputs.mean(axis=0), atol=1e-10)
    conditioned = yy - yx @ np.linalg.inv(xx) @ yx.T
    np.testing.assert_allclose(model.covariance, conditioned * 200 / (200 - 4), atol=1e-12)


@pytest.mark.parametrize("count", [20, 50, 500])
def test_fresh_data_are_as_far_off_as_the_theory_of_regression_says(count):
    """m (nu / (nu - m - 1)) (1 + (n + 1) / N) on average, with nu = N - n - 1: m for many samples."""
    means = [
        LinearGaussian.fit(*samples(count, seed)).distances(*samples(200, 10_000 + seed)).mean()
        for seed in range(400)
    ]
    freedom = count - 4
    expected = 2.0 * freedom / (freedom - 3) * (1.0 + 4.0 / count)
    assert np.mean(means) == pytest.approx(expected, rel=0.08)


def test_samples_scatter_as_the_covariance_says():
    inputs = np.tile([1.0, 2.0, 3.0], (50_000, 1))
    drawn = TRUE.sample(inputs, np.random.default_rng(1))
    np.testing.assert_allclose(np.cov(drawn.T), COVARIANCE, atol=2e-5)
    np.testing.assert_allclose(drawn.mean(axis=0), TRUE.mean(inputs[0]), atol=1e-3)
    np.testing.assert_allclose(TRUE.widened(2.0).covariance, 4.0 * COVARIANCE)


def test_data_without_scatter_gives_a_positive_covariance():
    _, inputs = samples(50)
    model = LinearGaussian.fit(TRUE.mean(inputs), inputs)
    assert np.linalg.eigvalsh(model.covariance)[0] > 0.0
    np.testing.assert_allclose(model.matrix, MATRIX, atol=1e-9)


def test_a_model_survives_a_file():
    again = LinearGaussian(**TRUE.as_dict())
    for name in ("matrix", "offset", "covariance"):
        np.testing.assert_array_equal(getattr(again, name), getattr(TRUE, name))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"matrix": np.ones((2, 3)) * np.nan}, "must be finite"),
        ({"offset": np.zeros(3)}, "expected a matrix"), ({"matrix": np.ones(3)}, "expected a matrix"),
        ({"covariance": np.array([[1.0, 0.5], [0.2, 1.0]])}, "symmetric"),
        ({"covariance": np.array([[1.0, 2.0], [2.0, 1.0]])}, "positive definite"),
    ],
)  # fmt: skip
def test_what_is_no_model_is_refused(change, message):
    with pytest.raises(InvalidInputError, match=message):
        LinearGaussian(**{"matrix": MATRIX, "offset": OFFSET, "covariance": COVARIANCE, **change})


def test_data_that_determine_no_model_are_refused():
    outputs, inputs = samples(50)
    with pytest.raises(InvalidInputError, match="too few"):
        LinearGaussian.fit(outputs[:5], inputs[:5])
    with pytest.raises(InvalidInputError, match="do not vary"):
        LinearGaussian.fit(outputs, np.column_stack([inputs[:, :2], inputs[:, 0]]))
    with pytest.raises(InvalidInputError, match="expected finite"):
        LinearGaussian.fit(outputs[:-1], inputs)
    with pytest.raises(InvalidInputError, match="factor"):
        TRUE.widened(0.0)


# Scatter that grows with a speed of approach.

APPROACH = np.array([[0.0, -1.0, 0.5], [1.0, 0.0, 0.0]])


@pytest.mark.parametrize("growth", [np.zeros((2, 2)), [[0.5, 0.0], [0.0, 0.3]], [[0.6, 0.37], [0.9, 0.05]]])
def test_how_scatter_grows_is_found_again(growth):
    true = LinearGaussian(MATRIX, OFFSET, COVARIANCE, growth, APPROACH)
    rng = np.random.default_rng(3)
    inputs = rng.normal([0.5, -1.0, 2.0], [1.0, 0.8, 1.5], (20_000, 3))
    outputs = true.sample(inputs, rng)
    assert np.mean(true.distances(outputs, inputs)) == pytest.approx(2.0, rel=0.03)
    model = LinearGaussian.fit(outputs, inputs, approach=APPROACH)
    np.testing.assert_allclose(model.growth, growth, atol=0.07)
    np.testing.assert_allclose(model.covariance, COVARIANCE, atol=2e-5)
    np.testing.assert_allclose(model.matrix, MATRIX, atol=3e-3)
    scale = true.scales([3.0, -2.0, 0.0])
    np.testing.assert_allclose(scale, 1.0 - np.sum(growth, axis=1) + np.array(growth) @ [4.0, 9.0])


def test_weights_of_samples_count_as_that_many():
    outputs, inputs = samples(300)
    weights = np.tile([1.0, 0.0, 1.0], 100)
    chosen = weights > 0.0
    expected = LinearGaussian.fit(outputs[chosen], inputs[chosen])
    found = LinearGaussian.fit(outputs, inputs, weights=weights)
    np.testing.assert_allclose(found.matrix, expected.matrix)
    np.testing.assert_allclose(found.covariance, expected.covariance)


def test_log_densities_are_those_of_the_gaussian():
    scipy_stats = pytest.importorskip("scipy.stats")
    true = LinearGaussian(MATRIX, OFFSET, COVARIANCE, [[0.3, 0.4], [0.9, 0.0]], APPROACH)
    outputs, inputs = samples(20)
    expected = [
        scipy_stats.multivariate_normal(
            true.mean(xi), COVARIANCE * np.sqrt(np.outer(true.scales(xi), true.scales(xi)))
        ).logpdf(y)
        for y, xi in zip(outputs, inputs, strict=True)
    ]
    np.testing.assert_allclose(true.log_densities(outputs, inputs), expected)


def test_growth_out_of_range_is_refused():
    with pytest.raises(InvalidInputError, match="shares that grow"):
        LinearGaussian(MATRIX, OFFSET, COVARIANCE, [[0.5, 0.5], [0.0, 0.0]], APPROACH)
    with pytest.raises(InvalidInputError, match="approach"):
        LinearGaussian(MATRIX, OFFSET, COVARIANCE, [[0.5], [0.5]], [[1.0]])
