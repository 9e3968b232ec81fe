"""The fastest motion of the mallet in a posture (5.13) against a linear program, and the search."""

import math

import numpy as np
import pytest
from scipy.optimize import linprog

from vpsto_ros.planning.hockey.rules import PlayRules
from vpsto_ros.planning.hockey.strike_search import fastest, rate_posture, search_posture, straighten
from vpsto_ros.robot.iiwa import iiwa14
from vpsto_ros.robot.iiwa_kinematics import chain, jacobian

HOME = np.array(PlayRules().home)
LIMITS = np.array(iiwa14().limits.velocity)
ANGLES = np.deg2rad([-75.0, -30.0, -1.0, 0.0, 1.0, 30.0, 60.0, 90.0, 180.0])


def kinematics(q):
    points, axes, jac = np.empty((4, 3)), np.empty((7, 3)), np.empty((3, 6))
    chain(q, points, axes)
    jacobian(points, axes, jac)
    return jac


def direction(angle):
    return np.array([math.cos(angle), math.sin(angle), 0.0])


def program(jac, angle):
    """(5.13) as it stands, by HiGHS."""
    equations = np.column_stack([jac, -direction(angle)])
    bounds = [(-limit, limit) for limit in LIMITS[:6]] + [(0.0, None)]
    return -linprog([0.0] * 6 + [-1.0], A_eq=equations, b_eq=np.zeros(3), bounds=bounds, method="highs").fun


def assert_optimal(q, angle):
    jac, rates = kinematics(q), np.full(7, np.nan)
    speed = fastest(jac, math.cos(angle), math.sin(angle), LIMITS, rates)
    assert speed == pytest.approx(program(jac, angle), rel=1e-7), (q, angle)
    np.testing.assert_allclose(jac @ rates[:6], speed * direction(angle), atol=1e-6)
    assert np.all(np.abs(rates) <= LIMITS * (1.0 + 1e-6))


def postures(zeros, count, seed):
    q = HOME + 0.6 * np.random.default_rng(seed).standard_normal((count, 7))
    q[:, zeros] = 0.0
    return q


@pytest.mark.parametrize("angle", ANGLES)
def test_it_is_the_linear_programs_optimum_everywhere(angle):
    for q in np.random.default_rng(1004).uniform(-2.0, 2.0, (60, 7)):
        assert_optimal(q, angle)


@pytest.mark.parametrize(
    "zeros", [(), (0,), (2,), (4,), (0, 2), (2, 4), (0, 2, 4, 6), (1,), (3,), (5,), (1, 2)], ids=str
)
def test_it_is_in_symmetric_postures_too(zeros):
    for q in postures(list(zeros), 10, 1005):
        for angle in ANGLES:
            assert_optimal(q, angle)


def test_it_is_at_home():
    for angle in np.deg2rad(np.arange(-180, 180, 5)):
        assert_optimal(HOME, angle)


def test_no_speed_where_the_jacobian_is_singular():
    """Straight up: no joint lifts or lowers, and none pulls."""
    rates = np.zeros(7)
    assert fastest(kinematics(np.zeros(7)), 1.0, 0.0, LIMITS, rates) == pytest.approx(0.0, abs=1e-9)


def test_twice_the_limits_give_twice_the_speed_and_the_opposite_way_is_as_fast():
    rates = np.zeros((3, 7))
    for q in postures([], 20, 1006):
        jac = kinematics(q)
        one = fastest(jac, 0.8, 0.6, LIMITS, rates[0])
        assert fastest(jac, 0.8, 0.6, 2.0 * LIMITS, rates[1]) == pytest.approx(2.0 * one)
        assert fastest(jac, -0.8, -0.6, LIMITS, rates[2]) == pytest.approx(one)
        np.testing.assert_allclose(rates[1:], [2.0 * rates[0], -rates[0]], atol=1e-8)


def test_the_curvature_keeps_the_universal_joint_on_its_line():
    """Of the way off the line, which without it grows as time squared, next to nothing is left."""
    robot, rng, s = iiwa14(), np.random.default_rng(1007), 0.03
    for q in postures([], 20, 1008):
        jac, rates, curvature = kinematics(q), 0.5 * rng.standard_normal(7), np.zeros(7)
        scratch = np.empty(7), np.empty((4, 3)), np.empty((7, 3)), np.empty((3, 6))
        straighten(q, rates, jac, curvature, *scratch)
        off = []
        for kappa in (curvature, np.zeros(7)):
            ends = [robot.forward(q + t * rates + 0.5 * s * s * kappa)[0] for t in (s, -s)]
            off.append(np.linalg.norm(0.5 * sum(ends) - robot.forward(q)[0]))
        assert off[0] < 0.05 * off[1] + 1e-6


def test_the_search_returns_what_it_rates_and_is_never_worse_than_its_seeds():
    rules, rng = PlayRules(), np.random.default_rng(1009)
    robot = iiwa14()
    limits = rules.limits(robot)
    row = np.array([*rules.kernel_row(), 0.2, 0.045, 0.15, 0.5, 10.0])
    positions = 0.99 * limits.position_range[1]
    for angle in (0.0, 0.6):
        posture, rates = np.zeros(7), np.zeros(7)
        seeds = HOME + 0.4 * rng.standard_normal((200, 7))
        found = search_posture(
            0.9, 0.1, angle, limits.velocity, positions, row, HOME, seeds, rng.standard_normal((800, 7)), 8,
            posture, rates,
        )  # fmt: skip
        work = np.empty((4, 3)), np.empty((7, 3)), np.empty((3, 6)), np.empty((3, 6)), np.empty(7)
        again = rate_posture(
            posture, angle, limits.velocity, positions, row, HOME, np.zeros(7), np.zeros(7), work
        )
        np.testing.assert_allclose(found, again)
        np.testing.assert_allclose(robot.forward(posture)[0], [0.9, 0.1, rules.height], atol=1e-6)
        moved = robot.jacobian(posture)[:3] @ rates
        np.testing.assert_allclose(moved, found[1] * direction(angle), atol=1e-5)
        assert np.all(np.abs(rates) <= limits.velocity * (1.0 + 1e-6))
        # The speed of a strike is at most what the posture allows at the touch alone.
        assert 0.5 < found[1] <= program(kinematics(posture), angle) + 1e-9
        fewer = search_posture(
            0.9, 0.1, angle, limits.velocity, positions, row, HOME, seeds, np.zeros((0, 7)), 8, posture, rates
        )
        assert found[0] >= fewer[0]


def test_a_place_out_of_reach_has_no_strike():
    rules, posture, rates = PlayRules(), np.zeros(7), np.zeros(7)
    row = np.array([*rules.kernel_row(), 0.2, 0.045, 0.15, 0.5, 10.0])
    _, speed, breaches = search_posture(
        3.0, 0.0, 0.0, LIMITS, 3.0 * np.ones(7), row, HOME, np.tile(HOME, (5, 1)), np.zeros((8, 7)), 5,
        posture, rates,
    )  # fmt: skip
    assert speed == 0.0 and breaches == np.inf
