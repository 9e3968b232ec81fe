"""The contact prior: eqs. (6.37)-(6.43) and (6.49) against sampling and dense linear algebra."""

import math

import numpy as np
import pytest

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.priors.contact import contact_distribution, contact_factor, joint_contact_factor
from vpsto_ros.priors.smoothness import smoothness_prior
from vpsto_ros.robot.kinematics import fr3_pusher
from vpsto_ros.trajectory import OptimalBasis

SAMPLES = 200_000
SPREAD = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])


def smooth(dof=3, points=3, spread=0.4):
    start = np.linspace(0.1, 0.5, dof)
    return smoothness_prior(
        OptimalBasis.uniform(points - 1), start, 0.2 * start, None, np.zeros(dof), 1.5, spread=spread
    )


def jacobian(seed=0, rows=2, columns=3):
    return np.random.default_rng(seed).normal(0.0, 1.0, (rows, columns))


def test_the_contact_distribution_is_that_of_contacts_with_sampled_objects():
    """Eq. (6.38): the robot touches f_c(q_o) up to Sigma^{r|o}, where q_o is what it is."""
    rng, a = np.random.default_rng(1), jacobian(1, 4, 2)
    given = np.diag([1e-4, 2e-4, 3e-4, 4e-4])
    mean, covariance = contact_distribution([0.4, 0.1, 0.5, -0.1], a, SPREAD, given)
    objects = rng.multivariate_normal([0.0, 0.0], SPREAD, SAMPLES)
    contacts = mean + objects @ a.T + rng.multivariate_normal(np.zeros(4), given, SAMPLES)
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(contacts.mean(axis=0), mean, atol=4.0 * scale.max() / math.sqrt(SAMPLES))
    error = np.sqrt(2.0 / SAMPLES) * np.outer(scale, scale)
    assert (np.abs(np.cov(contacts.T) - covariance) < 4.0 * error).all()


def test_joints_drawn_from_the_product_touch_where_the_contact_prior_says():
    """Eq. (6.43): a wide prior over q times the factor, pushed through J, has the covariance of x."""
    j, q_c, mean = jacobian(), np.array([0.3, -0.5, 0.8]), np.array([0.45, 0.1])
    prior = smooth(spread=300.0)
    product = prior.times(*joint_contact_factor(3, 2, q_c, j, mean, mean, SPREAD))
    q = product.sample(np.random.default_rng(2), SAMPLES)[:, 2]
    x = mean + (q - q_c) @ j.T
    scale = np.sqrt(np.diag(SPREAD))
    np.testing.assert_allclose(x.mean(axis=0), mean, atol=5.0 * scale.max() / math.sqrt(SAMPLES))
    assert (np.abs(np.cov(x.T) - SPREAD) < 5.0 * math.sqrt(2.0 / SAMPLES) * np.outer(scale, scale)).all()
    # What J does not see stays as uncertain as before.
    unseen = np.linalg.svd(j)[2][2]
    assert (q @ unseen).std() > 100.0


def test_what_inverse_kinematics_left_moves_the_mean():
    """x = x_c + J (q - q_c) = mean holds at the mean of the factor."""
    j, q_c = jacobian(3), np.array([0.3, -0.5, 0.8])
    mean, reached = np.array([0.45, 0.1]), np.array([0.44, 0.13])
    precision, information = joint_contact_factor(1, 0, q_c, j, mean, reached, SPREAD)
    best = np.linalg.lstsq(precision, information, rcond=1e-9)[0]
    np.testing.assert_allclose(reached + j @ (best - q_c), mean, atol=1e-9)
    assert np.linalg.matrix_rank(precision, tol=1e-6 * np.abs(precision).max()) == 2


def test_the_contact_prior_of_an_arm_puts_its_tool_there():
    """With the robot's own Jacobian: draws spread by millimetres land where (6.41) says."""
    robot = fr3_pusher()
    q_c = np.array([0.2, 0.4, 0.1, -2.0, 0.1, 2.4, 0.9])
    position, _ = robot.forward(q_c)
    j = robot.jacobian(q_c)[:2]
    covariance = np.diag([9e-6, 4e-6])
    prior = smoothness_prior(OptimalBasis.uniform(1), q_c, np.zeros(7), None, np.zeros(7), 1.0, spread=0.02)
    target = position[:2] + [0.004, -0.002]
    product = prior.times(*joint_contact_factor(2, -1, q_c, j, target, position[:2], covariance))
    draws = product.sample(np.random.default_rng(4), 1500)[:, 1]
    tips = np.array([robot.forward(q)[0][:2] for q in draws])
    free = prior.sample(np.random.default_rng(4), 1500)[:, 1]
    untouched = np.array([robot.forward(q)[0][:2] for q in free])
    assert np.abs(tips.mean(axis=0) - target).max() < 1e-3
    assert (tips.std(axis=0) < [3.3e-3, 2.3e-3]).all()
    assert (untouched.std(axis=0) > 2.0 * tips.std(axis=0)).all()


@pytest.mark.parametrize("point", [0, 1, -1])
def test_the_product_is_conditioning_on_a_noisy_look_at_one_point(point):
    """Eq. (6.49) equals Kalman's update of the smoothness prior with y = J q + noise."""
    prior, j, q_c = smooth(), jacobian(5), np.array([0.3, -0.5, 0.8])
    mean, reached = np.array([0.45, 0.1]), np.array([0.40, 0.2])
    product = prior.times(*joint_contact_factor(3, point, q_c, j, mean, reached, SPREAD))
    h = np.zeros((2, 9))
    h[:, 3 * (point % 3) : 3 * (point % 3) + 3] = j
    gain = prior.covariance @ h.T @ np.linalg.inv(h @ prior.covariance @ h.T + SPREAD)
    looked = mean - reached + j @ q_c
    np.testing.assert_allclose(product.mean, prior.mean + gain @ (looked - h @ prior.mean), atol=1e-9)
    np.testing.assert_allclose(product.covariance, prior.covariance - gain @ h @ prior.covariance, atol=1e-9)


def test_the_product_is_the_dense_formula():
    """Eq. (6.49) as printed, with Q_theta of (6.39) in precision form."""
    prior, spread = smooth(dof=2), np.array([[0.02, 0.01], [0.01, 0.03]])
    q_theta, target = np.zeros((6, 6)), np.array([1.0, -0.4])
    q_theta[4:, 4:] = np.linalg.inv(spread)
    theta_c = np.array([0.0, 0.0, 0.0, 0.0, *target])
    sigma = np.linalg.inv(q_theta + prior.precision)
    product = prior.times(*contact_factor(3, 2, 2, target, spread))
    np.testing.assert_allclose(product.covariance, sigma, atol=1e-12)
    expected = sigma @ (q_theta @ theta_c + prior.precision @ prior.mean)
    np.testing.assert_allclose(product.mean, expected, atol=1e-12)
    draws = product.sample(np.random.default_rng(6), SAMPLES).reshape(SAMPLES, 6)
    scale = np.sqrt(np.diag(sigma))
    error = math.sqrt(2.0 / SAMPLES) * np.outer(scale, scale)
    assert (np.abs(np.cov(draws.T) - sigma) < 5.0 * error).all()


def test_in_the_plane_the_joint_factor_is_the_plain_one():
    """With J = 1 the joints are the coordinates."""
    target = np.array([0.4, 0.1])
    plain = contact_factor(3, 2, 1, target, SPREAD)
    joint = joint_contact_factor(3, 1, np.array([0.7, 0.7]), np.eye(2), target, [0.7, 0.7], SPREAD)
    for ours, theirs in zip(plain, joint, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-9)


def test_no_contact_prior_is_the_smoothness_prior():
    """Q_q = 0 (figure 6.6), and what comes near to it."""
    prior, j = smooth(), jacobian()
    same = prior.times(np.zeros((9, 9)), np.zeros(9))
    np.testing.assert_allclose(same.mean, prior.mean, atol=1e-12)
    np.testing.assert_allclose(same.covariance, prior.covariance, atol=1e-12)
    vague = joint_contact_factor(3, 2, np.ones(3), j, np.ones(2), np.zeros(2), 1e9 * np.eye(2))
    np.testing.assert_allclose(prior.times(*vague).mean, prior.mean, atol=1e-7)
    unseen = joint_contact_factor(3, 2, np.ones(3), np.zeros((2, 3)), np.ones(2), np.zeros(2), SPREAD)
    assert not unseen[0].any() and not unseen[1].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"point_index": 3}, "point_index = 3"),
        ({"point_index": -4}, "point_index = -4"),
        ({"jacobian": np.ones((2, 4))}, "Jacobian"),
        ({"reached": np.ones(3)}, "coordinates"),
        ({"mean": np.array([math.nan, 0.0])}, "finite"),
        ({"reached": np.array([math.inf, 0.0])}, "finite"),
        ({"joints": np.array([math.nan, 0.0, 0.0])}, "finite"),
        ({"covariance": np.zeros((2, 2))}, "positive definite"),
        ({"covariance": np.diag([1e-8, -1e-8])}, "positive definite"),
        ({"covariance": np.array([[1e-8, 5e-9], [0.0, 1e-8]])}, "symmetric"),
        ({"covariance": np.eye(3)}, r"covariance \(2, 2\)"),
    ],
)
def test_errors_name_what_is_wrong(change, message):
    arguments = {
        "n_points": 3, "point_index": 2, "joints": np.zeros(3), "jacobian": np.ones((2, 3)),
        "mean": np.zeros(2), "reached": np.zeros(2), "covariance": SPREAD,
    }  # fmt: skip
    joint_contact_factor(**arguments)
    with pytest.raises(InvalidInputError, match=message):
        joint_contact_factor(**(arguments | change))


@pytest.mark.parametrize(
    "arguments",
    [
        (np.zeros(4), np.zeros((3, 2)), np.eye(2), np.eye(4)),
        (np.zeros(4), np.zeros((4, 2)), np.eye(3), np.eye(4)),
        (np.zeros(4), np.zeros((4, 2)), np.eye(2), 1e-4),
        (np.zeros(4), np.zeros(4), np.eye(2), np.eye(4)),
    ],
)
def test_contact_distributions_check_shapes(arguments):
    with pytest.raises(InvalidInputError, match=r"\(m, o\)"):
        contact_distribution(*arguments)
