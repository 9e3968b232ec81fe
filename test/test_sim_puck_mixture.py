"""Predictions of mixtures of usual and lively bounces."""

import numpy as np
import pytest

from sim_bridge.experiments.hockey.predictions import Prediction, merged, rolled
from sim_bridge.hockey.recordings import TABLE
from vpsto_ros.contact.puck import SHIPPED, PuckModel


@pytest.fixture(scope="module")
def model():
    return PuckModel.load(SHIPPED)


def test_ways_of_bouncing_together_are_the_gaussian_of_steps(model):
    start = np.array([TABLE.reach[0] - 0.05, 0.3, 1.2, 0.3])
    ways = rolled(model, (1.0, start, np.zeros((4, 4))), [0.02] * 10)
    assert len(ways) == 2 and sum(weight for weight, _, _ in ways) == pytest.approx(1.0)
    mean, covariance = start, np.zeros((4, 4))
    for _ in range(10):
        mean, covariance = model.step(mean, covariance)
    place, spread = merged(ways)
    np.testing.assert_allclose(place, mean[:2], atol=2e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(spread)), np.sqrt(np.diag(covariance[:2, :2])), rtol=0.1)
    assert len(rolled(model, (1.0, start, np.zeros((4, 4))), [0.02])) == 1, "nothing met yet"


def test_densest_regions_hold_as_much_as_they_say():
    wide, narrow = np.diag([0.06, 0.02]) ** 2, np.diag([0.01, 0.02]) ** 2
    ways = ((0.85, np.zeros(2), narrow), (0.15, np.array([0.1, 0.0]), wide))
    rng = np.random.default_rng(7)
    lively = rng.random(2000) < 0.15
    truths = np.where(
        lively[:, None], rng.multivariate_normal([0.1, 0.0], wide, 2000),
        rng.multivariate_normal([0.0, 0.0], narrow, 2000),
    )  # fmt: skip
    mean, covariance = merged(ways)
    distances = np.array([
        Prediction("wall", 0.2, np.zeros(2), mean, covariance, truth, ways).distance for truth in truths
    ])  # fmt: skip
    for level in (0.5, 0.9, 0.99):
        assert np.mean(distances < -2.0 * np.log(1.0 - level)) == pytest.approx(level, abs=0.04)


def test_a_single_way_is_its_gaussian():
    covariance, off = np.diag([4e-4, 1e-4]), np.array([0.03, 0.01])
    one = Prediction("hit", 0.1, np.zeros(2), np.zeros(2), covariance, off, ((1.0, np.zeros(2), covariance),))
    assert one.distance == pytest.approx(0.03**2 / 4e-4 + 0.01**2 / 1e-4)
