"""Two kinds of an impact, told apart by how lively they are."""

import numpy as np
import pytest

from vpsto_ros.contact.linear_gaussian import LinearGaussian
from vpsto_ros.contact.two_kinds import TwoKinds, fit_two_kinds
from vpsto_ros.exceptions import InvalidInputError

APPROACH = np.array([[-1.0, 0.0], [0.0, 1.0]])
GROWTH = [[0.95, 0.0], [0.5, 0.45]]
USUAL = LinearGaussian(np.diag([-0.73, 0.84]), np.zeros(2), np.diag([0.02, 0.025]) ** 2, GROWTH, APPROACH)
LIVELY = LinearGaussian(np.diag([-0.92, 0.87]), np.zeros(2), np.diag([0.06, 0.03]) ** 2, GROWTH, APPROACH)
TRUE = TwoKinds(USUAL, LIVELY, 0.15)


def bounces(count, seed, kinds=TRUE):
    """Outputs, inputs, and which bounces were lively."""
    rng = np.random.default_rng(seed)
    inputs = np.column_stack([-rng.uniform(0.3, 2.2, count), rng.normal(0.0, 0.8, count)])
    lively = rng.random(count) < kinds.share
    outputs = kinds.usual.sample(inputs, rng)
    if kinds.rare is not None:
        outputs[lively] = kinds.rare.sample(inputs[lively], rng)
    return outputs, inputs, lively


def test_both_kinds_are_found_again():
    outputs, inputs, _ = bounces(6000, 0)
    found = fit_two_kinds(outputs, inputs, APPROACH, least_std=1e-4)
    assert found.share == pytest.approx(0.15, abs=0.02)
    for ours, true in ((found.usual, USUAL), (found.rare, LIVELY)):
        np.testing.assert_allclose(ours.matrix, true.matrix, atol=0.015)
        np.testing.assert_allclose(np.diag(ours.covariance), np.diag(true.covariance), rtol=0.15)
        assert ours.growth[0, 0] > 0.85


def test_a_single_kind_is_left_alone():
    for seed in range(8):
        outputs, inputs, _ = bounces(400, seed, TwoKinds(USUAL))
        assert fit_two_kinds(outputs, inputs, APPROACH, least_std=1e-4).rare is None


def test_a_rarer_kind_that_was_hardly_seen_is_none():
    outputs, inputs, lively = bounces(60, 2)
    assert 0 < lively.sum() < 15
    assert fit_two_kinds(outputs, inputs, APPROACH, least_std=1e-4).rare is None
    with pytest.raises(InvalidInputError, match="too few"):
        fit_two_kinds(outputs[:4], inputs[:4], APPROACH, least_std=1e-4)


def test_copies_do_not_count_as_evidence():
    """What pays for a second kind only when every sample counts six times is not enough."""
    outputs, inputs, _ = bounces(250, 3, TwoKinds(USUAL, LIVELY, 0.07))
    many = np.tile(outputs, (6, 1)), np.tile(inputs, (6, 1))
    once = fit_two_kinds(outputs, inputs, APPROACH, least_std=1e-4)
    again = fit_two_kinds(*many, APPROACH, least_std=1e-4, copies=6)
    assert (once.rare is None) == (again.rare is None)


def test_bounces_are_as_far_off_as_those_of_their_kind():
    outputs, inputs, lively = bounces(4000, 1)
    inside = TRUE.distances(outputs, inputs) < -2.0 * np.log(0.1)
    assert inside[~lively].mean() == pytest.approx(0.9, abs=0.03)
    assert inside[lively].mean() > 0.8
    single = LinearGaussian.fit(outputs, inputs, approach=APPROACH)
    assert TRUE.log_likelihood(outputs, inputs) > TwoKinds(single).log_likelihood(outputs, inputs) + 500.0
