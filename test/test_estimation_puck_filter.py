"""The filter of the puck: a textbook filter, contacts at their time, gaps, outliers, bad input."""

import dataclasses
import math

import numpy as np
import pytest

from vpsto_ros.contact.linear_gaussian import LinearGaussian
from vpsto_ros.contact.puck import HockeyTable, PuckModel
from vpsto_ros.estimation.puck_filter import PuckFilter, PuckFilterConfig
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError

TABLE, PERIOD, DRAG = HockeyTable(), 0.02, 0.5
STD, FRAME = 5e-7**0.5, 1.0 / 120.0
AT_ONCE = PuckFilterConfig(wall_contact=(0.0, 0.0), mallet_contact=(0.0, 0.0))


def model(floating=2e-4, wall=0.03, mallet=0.03, drag=0.0):
    return PuckModel(
        TABLE, PERIOD,
        LinearGaussian((1.0 - drag * PERIOD) * np.eye(2), np.zeros(2), floating**2 * np.eye(2)),
        LinearGaussian(np.diag([-0.75, 0.85]), np.zeros(2), np.diag([wall, 0.5 * wall]) ** 2),
        LinearGaussian(
            [[-0.45, 0.0, 1.45, 0.0], [0.0, 0.95, 0.0, 0.05]], np.zeros(2),
            np.diag([mallet, 0.5 * mallet]) ** 2,
        ),
    )  # fmt: skip


def seen(path, stamps, seed=0):
    return path(np.asarray(stamps)) + STD * np.random.default_rng(seed).normal(size=(len(stamps), 2))


def straight(start, velocity):
    return lambda t: np.asarray(start) + np.multiply.outer(t, velocity)


def slowing(start, velocity):
    return lambda t: np.asarray(start) + np.multiply.outer((1.0 - np.exp(-DRAG * t)) / DRAG, velocity)


def fed(path, stamps, config=AT_ONCE, puck=None, seed=0):
    """A filter that has seen a path, and the outcomes."""
    estimator = PuckFilter(puck or model(), config)
    outcomes = [estimator.update(t, x) for t, x in zip(stamps, seen(path, stamps, seed), strict=True)]
    return estimator, outcomes


def positive_definite(covariance):
    return np.array_equal(covariance, covariance.T) and np.linalg.eigvalsh(covariance)[0] > 0.0


# Floating


def test_a_floating_puck_is_filtered_as_by_a_textbook_kalman_filter():
    stamps = np.cumsum(np.random.default_rng(1).choice([FRAME, 2.0 * FRAME], 60))
    positions = seen(slowing([-0.5, 0.1], [0.7, 0.2]), stamps)
    estimator = PuckFilter(model(drag=DRAG), AT_ONCE)
    x, p = np.append(positions[0], [0.0, 0.0]), np.diag([STD**2] * 2 + [2.5**2] * 2)
    for k, (stamp, z) in enumerate(zip(stamps, positions, strict=True)):
        estimator.update(stamp, z)
        if k == 0:
            continue
        h = stamp - stamps[k - 1]
        keep = 1.0 - DRAG * h
        f = np.block([[np.eye(2), 0.5 * h * (1.0 + keep) * np.eye(2)], [np.zeros((2, 2)), keep * np.eye(2)]])
        x, p = f @ x, f @ p @ f.T + np.diag([0.0, 0.0, 1.0, 1.0]) * 2e-4**2 * h / PERIOD
        gain = p[:, :2] @ np.linalg.inv(p[:2, :2] + STD**2 * np.eye(2))
        x, p = x + gain @ (z - x[:2]), p - gain @ p[:2]
        state = estimator.state(stamp)
        np.testing.assert_allclose(state.mean, x, atol=1e-9)
        np.testing.assert_allclose(state.covariance, p, rtol=1e-6, atol=1e-12)
    assert state.contacts == 0 and estimator.status(stamp).kind == "tracking"


def test_errors_are_as_large_as_the_filter_says():
    rng, found = np.random.default_rng(5), []
    paths = model(5e-3).simulate(np.tile([-0.6, 0.0, 0.8, -0.3], (100, 1)), 50, rng)
    for path in paths:
        estimator = PuckFilter(model(5e-3), AT_ONCE)
        for k, x in enumerate(path[:, :2] + STD * rng.normal(size=(51, 2))):
            estimator.update(k * PERIOD, x)
        state = estimator.state(50 * PERIOD)
        off = state.mean - path[-1]
        found.append(off @ np.linalg.solve(state.covariance, off))
    assert np.mean(found) == pytest.approx(4.0, abs=3.0 * math.sqrt(8.0 / 100))


# Walls


def bouncing(dwell=0.0):
    """Towards the left wall at 1.2 m/s and off it 3 ms after a frame, without drag; meets it at 0.203 s."""
    met, out, back = 24 * FRAME + 0.003, np.array([0.4, 1.2]), np.array([0.34, -0.9])
    touch = np.array([0.1, TABLE.reach[1]])
    slide = touch + dwell * np.array([0.34, 0.0])

    def path(t):
        t = np.asarray(t)[..., None]
        after = np.where(t < met + dwell, touch + (t - met) * [0.34, 0.0], slide + (t - met - dwell) * back)
        return np.where(t < met, touch + (t - met) * out, after)

    return path, met, back


@pytest.mark.parametrize("dwell", [0.0, 0.004])
def test_a_wall_is_met_at_its_time_between_two_frames(dwell):
    path, met, back = bouncing(dwell)
    config = dataclasses.replace(AT_ONCE, wall_contact=(dwell, 1e-4))
    stamps = FRAME * np.arange(1, 25)
    estimator, outcomes = fed(path, stamps, config)
    assert estimator.state(stamps[-1]).contacts == 0
    before, later = estimator.state(met - 1e-3), estimator.state(met + 1e-3)
    assert before.contacts == 0 and before.mean[3] == pytest.approx(1.2, abs=0.02)
    assert later.contacts == 1 and later.mean[3] == pytest.approx(-0.9, abs=0.02)
    assert later.touching == ("wall" if dwell else "")
    ahead = estimator.state(met + 0.05)
    np.testing.assert_allclose(ahead.mean[:2], path(met + 0.05), atol=2e-3)
    for k in range(25, 32):
        outcomes.append(estimator.update(k * FRAME, seen(path, [k * FRAME], seed=k)[0]))
    assert set(outcomes) == {"accepted"}
    np.testing.assert_allclose(estimator.state(31 * FRAME).mean[2:], back, atol=0.03)


def test_a_state_is_predicted_through_both_walls_of_a_corner():
    estimator, _ = fed(straight([0.75, 0.32], [1.0, 1.0]), FRAME * np.arange(1, 10))
    ahead = estimator.state(0.4)
    assert ahead.contacts == 2 and (ahead.mean[2:] < -0.5).all() and positive_definite(ahead.covariance)


def test_a_prediction_changes_nothing():
    path, _, _ = bouncing()
    estimator, _ = fed(path, FRAME * np.arange(1, 20))
    one = estimator.state(0.17)
    estimator.state(2.0)
    np.testing.assert_array_equal(estimator.state(0.17).mean, one.mean)
    np.testing.assert_array_equal(estimator.state(0.0).mean, estimator.state(19 * FRAME).mean)


# The mallet


def struck(config=AT_ONCE, informed=True):
    """A puck at rest, hit at 0.21 s by a mallet at 0.8 m/s that comes along x; a filter that has seen it."""
    met, puck = 0.21, np.array([-0.3, 0.05])
    mallet = straight(puck - [TABLE.contact_distance + 0.8 * met, 0.0], [0.8, 0.0])
    speed, dwell = 1.45 * 0.8, config.mallet_contact[0]

    def path(t):
        t = np.asarray(t)
        moved = np.clip(t - met, 0.0, dwell) * 0.8 + np.maximum(t - met - dwell, 0.0) * speed
        return puck + np.multiply.outer(moved, [1.0, 0.0])

    estimator, outcomes = PuckFilter(model(), config), []
    for k in range(1, 50):
        stamp = k * FRAME
        if informed:
            assert estimator.observe_mallet(stamp - 1e-3, mallet(stamp - 1e-3), [0.8, 0.0]) == "accepted"
        if stamp < 0.25 or stamp > 0.31:  # nothing is seen for a while after the hit
            outcomes.append(estimator.update(stamp, seen(path, [stamp], seed=k)[0]))
    return estimator, outcomes, path


@pytest.mark.parametrize("contact", [(0.0, 0.0), (0.0185, 1e-3)])
def test_a_hit_is_detected_from_the_motion_of_the_mallet(contact):
    config = dataclasses.replace(AT_ONCE, mallet_contact=contact)
    estimator, outcomes, path = struck(config)
    late = estimator.state(49 * FRAME)
    # A frame within the contact may be off by the dent, which the path above has not.
    assert set(outcomes[29:]) == {"accepted"} and outcomes.count("outlier") <= 2 and late.contacts == 1
    np.testing.assert_allclose(late.mean[2:], [1.16, 0.0], atol=0.04)
    np.testing.assert_allclose(late.mean[:2], path(49 * FRAME), atol=2e-3)


def test_without_the_mallet_a_hit_contradicts_and_is_recovered_from():
    estimator, outcomes, _ = struck(informed=False)
    assert "outlier" in outcomes and "reinitialized" in outcomes
    np.testing.assert_allclose(estimator.state(49 * FRAME).mean[2:], [1.16, 0.0], atol=0.1)
    assert "mallet" in estimator.status(49 * FRAME).reason


def test_a_hit_is_foreseen_at_its_time_and_only_while_the_mallet_is_known():
    estimator, _ = fed(straight([0.0, 0.0], [0.0, 0.0]), FRAME * np.arange(1, 20))
    at = 19 * FRAME
    distance = TABLE.contact_distance + 0.02
    estimator.observe_mallet(at, [-distance, 0.0], [1.0, 0.0])
    assert estimator.state(at + 0.0195).contacts == 0 and estimator.state(at + 0.0215).contacts == 1
    assert estimator.state(at + 0.0215).mean[2] == pytest.approx(1.45, abs=0.02)
    estimator.observe_mallet(at + 1e-3, [-distance - 0.05, 0.0], [1.0, 0.0])
    assert estimator.state(at + 0.5).contacts == 0


def test_the_covariance_of_a_hit_is_that_of_samples():
    estimator, _ = fed(straight([0.0, 0.0], [0.2, 0.1]), FRAME * np.arange(1, 30))
    at = 29 * FRAME
    state = estimator.state(at)
    mallet = np.array([*(state.mean[:2] - [0.085, 0.02]), 0.9, 0.1])
    estimator.observe_mallet(at, mallet[:2], mallet[2:])
    ahead = estimator.state(at + 0.03)
    rng = np.random.default_rng(0)
    ends = []
    for start in rng.multivariate_normal(state.mean, state.covariance, 3000):
        apart, w = start[:2] - mallet[:2], start[2:] - mallet[2:]
        times = np.roots([w @ w, 2.0 * apart @ w, apart @ apart - TABLE.contact_distance**2])
        time = times.real.min()
        touch = np.array([*(start[:2] + time * start[2:]), *start[2:]])
        hitter = np.array([*(mallet[:2] + time * mallet[2:]), *mallet[2:]])
        mean, noise = model().hit(touch[None], hitter[None])
        after = rng.multivariate_normal(mean[0, 2:], noise[0, 2:, 2:])
        ends.append([*(touch[:2] + (0.03 - time) * after), *after])
    ends = np.array(ends)
    np.testing.assert_allclose(ahead.mean, ends.mean(axis=0), atol=2e-3)
    ratio = np.sqrt(np.diag(ahead.covariance)) / ends.std(axis=0)
    np.testing.assert_allclose(ratio, 1.0, atol=0.06)


@pytest.mark.parametrize("config", [AT_ONCE, PuckFilterConfig()])
def test_a_model_whose_hits_are_delayed_is_not_delayed_twice(config):
    late, at = dataclasses.replace(model(), hit_delay=6e-3), 19 * FRAME
    states = []
    for puck in (model(), late):
        estimator, _ = fed(straight([0.0, 0.0], [0.0, 0.0]), FRAME * np.arange(1, 20), config, puck)
        estimator.observe_mallet(at, [-TABLE.contact_distance - 0.02, 0.0], [1.0, 0.0])
        states.append(estimator.state(at + 0.045))
    assert states[1].contacts == 1
    np.testing.assert_array_equal(states[1].mean, states[0].mean)
    np.testing.assert_array_equal(states[1].covariance, states[0].covariance)


# What goes wrong


def test_drop_outs_are_bridged_through_a_wall():
    path, _, back = bouncing()
    stamps = [k * FRAME for k in range(1, 45) if not 20 <= k < 32]
    estimator, outcomes = fed(path, stamps)
    assert set(outcomes) == {"accepted"}
    np.testing.assert_allclose(estimator.state(stamps[-1]).mean[2:], back, atol=0.03)


def test_single_outliers_change_nothing():
    path, rng = straight([-0.5, 0.0], [0.5, 0.1]), np.random.default_rng(3)
    stamps = FRAME * np.arange(1, 90)
    clean, _ = fed(path, stamps)
    dirty, outcomes = PuckFilter(model(), AT_ONCE), []
    for k, (stamp, position) in enumerate(zip(stamps, seen(path, stamps), strict=True)):
        if k % 7 == 6:
            wrong = rng.uniform(-0.4, 0.4, 2)
            outcomes.append(dirty.update(stamp - 1e-3, wrong))
            assert dirty.status(stamp).kind == "recovering"
        assert dirty.update(stamp, position) == "accepted"
    assert set(outcomes) == {"outlier"}
    np.testing.assert_allclose(dirty.state(stamps[-1]).mean, clean.state(stamps[-1]).mean, atol=1e-9)


def test_a_puck_that_was_put_elsewhere_is_found_again():
    estimator, _ = fed(straight([-0.5, 0.0], [0.5, 0.1]), FRAME * np.arange(1, 40))
    path, stamps = straight([0.4, -0.2], [-0.3, 0.2]), 0.4 + FRAME * np.arange(1, 20)
    outcomes = [estimator.update(t, x) for t, x in zip(stamps, seen(path, stamps), strict=True)]
    assert outcomes[:3] == ["outlier", "outlier", "reinitialized"] and set(outcomes[3:]) == {"accepted"}
    np.testing.assert_allclose(estimator.state(stamps[-1]).mean[2:], [-0.3, 0.2], atol=0.03)


def test_after_a_long_gap_the_filter_begins_anew():
    estimator, _ = fed(straight([-0.5, 0.0], [0.5, 0.1]), FRAME * np.arange(1, 20))
    assert estimator.status(1.0).kind == "lost" and "not seen" in estimator.status(1.0).reason
    assert estimator.update(1.0, [0.5, 0.3]) == "reinitialized"
    np.testing.assert_array_equal(estimator.state(1.0).mean, [0.5, 0.3, 0.0, 0.0])


def test_a_puck_that_left_through_a_goal_is_lost_until_there_is_another():
    path = straight([0.7, 0.0], [1.5, 0.0])
    estimator, outcomes = fed(path, FRAME * np.arange(1, 30))
    assert set(outcomes) == {"accepted"}
    status = estimator.status(29 * FRAME)
    assert status.kind == "lost" and "far goal" in status.reason
    assert [estimator.update(0.3 + k * FRAME, [0.0, 0.0]) for k in range(3)][-1] == "reinitialized"
    assert estimator.status(0.31).kind == "tracking"
    ahead = fed(path, FRAME * np.arange(1, 15))[0].state(2.0)
    assert 0.974 < ahead.mean[0] < 1.02, "it stays behind the line"


@pytest.mark.parametrize(
    ("stamp", "position", "covariance"),
    [
        (math.nan, [0.0, 0.0], None), (math.inf, [0.0, 0.0], None), ("soon", [0.0, 0.0], None),
        (None, [0.0, 0.0], None), (10**400, [0.0, 0.0], None), (0.5, [0.0, 0.0], 1e-14 * np.eye(2)),
        (0.5, [math.nan, 0.0], None), (0.5, [0.0], None), (0.5, "x", None),
        (0.5, None, None), (0.5, [0.0, 0.53], None), (0.5, [3.0, 0.0], None), (0.5, [1.0, 0.2], None),
        (0.5, [0.0, 0.0], np.zeros((2, 2))), (0.5, [0.0, 0.0], [[1.0, 2.0], [2.0, 1.0]]),
        (0.5, [0.0, 0.0], [[1.0, 0.5], [0.0, 1.0]]), (0.5, [0.0, 0.0], np.full((2, 2), np.inf)),
        (0.5, [0.0, 0.0], [1.0, 1.0]), (1e9, [0.0, 0.0], None), (-1e9, [0.0, 0.0], None),
    ],
)  # fmt: skip
def test_bad_measurements_are_refused_in_words(stamp, position, covariance):
    estimator, _ = fed(straight([-0.5, 0.0], [0.5, 0.1]), FRAME * np.arange(1, 20))
    before = estimator.state(0.2)
    outcome = estimator.update(stamp, position, covariance)
    assert outcome.kind == "invalid" and outcome.reason
    np.testing.assert_array_equal(estimator.state(0.2).mean, before.mean)


def test_bad_states_of_the_mallet_are_refused_and_old_positions_are_stale():
    estimator, _ = fed(straight([-0.5, 0.0], [0.5, 0.1]), FRAME * np.arange(1, 20))
    for stamp, position, velocity in (
        (math.nan, [0.0, 0.0], [0.0, 0.0]), (0.1, [0.0], [0.0, 0.0, 0.0]), (0.1, None, [0.0, 0.0]),
        ("x", [0.0, 0.0], [0.0, 0.0]), (0.1, [0.0, 0.0], [math.inf, 0.0]), (0.1, [0.0, 0.0], [0.0, 1e6]),
    ):  # fmt: skip
        assert estimator.observe_mallet(stamp, position, velocity).kind == "invalid"
    assert estimator.observe_mallet(0.1, [0.0, 0.0], [0.0, 0.0]) == "accepted"
    assert estimator.observe_mallet(0.1, [0.0, 0.0], [0.0, 0.0]) == "stale"
    assert estimator.update(0.1, [0.0, 0.0]) == "stale"
    with pytest.raises(InvalidInputError, match="time"):
        estimator.state(math.nan)


def test_nothing_is_known_before_the_first_position():
    estimator = PuckFilter(model())
    assert estimator.state(0.0) is None and estimator.status(0.0).kind == "uninitialised"
    assert estimator.update(0.0, [0.1, 0.2]) == "accepted" and estimator.state(0.0).mean[0] == 0.1
    estimator.reset()
    assert estimator.state(0.0) is None


def test_options_out_of_range_are_named():
    with pytest.raises(ConfigurationError, match="gate"):
        PuckFilterConfig(gate=0.0)
    with pytest.raises(ConfigurationError, match="max_jump"):
        PuckFilterConfig(max_jump=0.1)


@pytest.mark.parametrize("seed", range(6))
def test_covariances_stay_positive_definite_whatever_happens(seed):
    rng = np.random.default_rng(seed)
    estimator, stamp = PuckFilter(model(*10.0 ** rng.uniform(-5, -1, 3))), 0.0
    truth = np.array([*rng.uniform(-0.4, 0.4, 2), *rng.normal(0.0, 2.0, 2)])
    mallet = np.array([-0.6, 0.0, 0.0, 0.0])
    for _ in range(400):
        stamp += FRAME * rng.integers(1, 4)
        mallet[2:] = rng.normal(0.0, 1.5, 2)
        mallet[:2] = np.clip(mallet[:2] + FRAME * mallet[2:], -0.5, 0.5)
        estimator.observe_mallet(stamp, mallet[:2], mallet[2:])
        truth[:2] += FRAME * truth[2:]
        out = np.abs(truth[:2]) > TABLE.reach
        truth[2:][out] *= -0.8
        truth[:2] = np.clip(truth[:2], -TABLE.reach, TABLE.reach)
        if rng.random() < 0.05:
            truth = np.array([*rng.uniform(-0.4, 0.4, 2), *rng.normal(0.0, 2.0, 2)])
        estimator.update(stamp, truth[:2] + STD * rng.normal(size=2))
        for ahead in (0.0, rng.uniform(0.0, 0.2)):
            state = estimator.state(stamp + ahead)
            assert np.isfinite(state.mean).all() and positive_definite(state.covariance)


@pytest.mark.parametrize("seed", range(10))
def test_nothing_from_outside_raises_or_leaves_numbers_that_are_none(seed):
    rng, estimator, stamp = np.random.default_rng(seed), PuckFilter(model(wall=0.1, mallet=0.1)), 0.0
    for _ in range(150):
        stamp += rng.choice([0.0, 0.001, 0.008, 0.1, -0.01, 1.0, 1e-12])
        fast = rng.normal(size=2) * rng.choice([0.0, 1.0, 4.0, 1e6])
        estimator.observe_mallet(stamp + 0.01 * rng.normal(), rng.uniform(-1.0, 1.0, 2), fast)
        near = np.array([-0.5, 0.48]) + 1e-3 * rng.normal(size=2)
        position = rng.uniform(-1.1, 1.1, 2) if rng.random() < 0.3 else near
        estimator.update(stamp, position, 10.0 ** rng.uniform(-14.0, 0.0) * np.eye(2))
        state = estimator.state(stamp + rng.choice([0.0, 0.01, 3.0]))
        assert estimator.status(stamp).kind
        if state is not None:
            assert np.isfinite(state.mean).all() and positive_definite(state.covariance)


# Measured velocities.


def observed(covariance=None):
    """A filter that has seen a puck move at (0.4, -0.2) m/s four times, and its state."""
    estimator = PuckFilter(model())
    for k in range(4):
        estimator.update(FRAME * k, np.array([0.1 + 0.4 * FRAME * k, 0.2 - 0.2 * FRAME * k]), covariance)
    return estimator, estimator.state(3 * FRAME)


def test_a_measured_velocity_is_a_linear_gaussian_observation():
    """Against the information form: precisions add up."""
    estimator, before = observed()
    measured, noise = np.array([0.45, -0.15]), np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
    assert estimator.observe_velocity(measured, noise) == "accepted"
    after = estimator.state(3 * FRAME)
    pick = np.hstack([np.zeros((2, 2)), np.eye(2)])
    precision = np.linalg.inv(before.covariance) + pick.T @ np.linalg.inv(noise) @ pick
    mean = np.linalg.solve(
        precision, np.linalg.solve(before.covariance, before.mean) + pick.T @ np.linalg.solve(noise, measured)
    )
    np.testing.assert_allclose(after.covariance, np.linalg.inv(precision), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(after.mean, mean, rtol=1e-6, atol=1e-9)
    assert positive_definite(after.covariance)


def test_the_noise_of_the_options_is_used_where_none_comes_along():
    with_default, _ = observed()
    with_same, _ = observed()
    std = with_default.config.velocity_std
    with_default.observe_velocity([0.4, -0.2])
    with_same.observe_velocity([0.4, -0.2], std**2 * np.eye(2))
    first, second = (each.state(3 * FRAME) for each in (with_default, with_same))
    np.testing.assert_array_equal(first.mean, second.mean)
    np.testing.assert_array_equal(first.covariance, second.covariance)


def test_a_first_position_with_its_velocity_is_all_that_is_needed():
    estimator = PuckFilter(model())
    assert estimator.observe_velocity([1.0, 0.0]) == "stale"
    estimator.update(0.0, [0.1, 0.2])
    assert estimator.observe_velocity([0.4, -0.2], 1e-6 * np.eye(2)) == "accepted"
    np.testing.assert_allclose(estimator.state(0.0).mean, [0.1, 0.2, 0.4, -0.2], atol=1e-3)


@pytest.mark.parametrize(
    ("velocity", "covariance"),
    [
        ([math.nan, 0.0], None),
        ([1.0], None),
        ("fast", None),
        (None, None),
        ([0.0, 0.0], -np.eye(2)),
        ([0.0, 0.0], np.zeros((2, 2))),
        ([0.0, 0.0], 1.0),
        ([0.0, 0.0], [[1.0, 0.5], [0.0, 1.0]]),
    ],
)
def test_a_velocity_that_is_none_changes_nothing(velocity, covariance):
    estimator, before = observed()
    outcome = estimator.observe_velocity(velocity, covariance)
    assert outcome.kind == "invalid" and ("velocity" in outcome.reason or "covariance" in outcome.reason)
    after = estimator.state(3 * FRAME)
    np.testing.assert_array_equal(after.mean, before.mean)
    np.testing.assert_array_equal(after.covariance, before.covariance)


def test_an_unlikely_velocity_is_an_outlier():
    estimator, _ = observed(1e-8 * np.eye(2))
    for _ in range(3):  # it settles
        estimator.observe_velocity([0.4, -0.2], 1e-4 * np.eye(2))
    before = estimator.state(3 * FRAME)
    outcome = estimator.observe_velocity([3.0, 2.0], 1e-4 * np.eye(2))
    assert outcome.kind == "outlier" and "Mahalanobis" in outcome.reason
    np.testing.assert_array_equal(estimator.state(3 * FRAME).mean, before.mean)


def test_while_a_contact_lasts_no_velocity_counts():
    """It is the one before or the one after, and nobody knows which."""
    estimator = PuckFilter(model(), PuckFilterConfig(wall_contact=(0.05, 1e-4)))
    y, stamp = 0.3, 0.0
    while y < TABLE.reach[1]:
        estimator.update(stamp, [0.2, y])
        assert estimator.observe_velocity([0.0, 1.5]) == "accepted"
        stamp, y = stamp + FRAME, y + 1.5 * FRAME
    assert estimator.update(stamp, [0.2, TABLE.reach[1]]) == "accepted"
    before = estimator.state(stamp)
    assert before.touching == "wall"
    outcome = estimator.observe_velocity([0.0, 1.5])
    assert outcome.kind == "outlier" and "contact" in outcome.reason
    np.testing.assert_array_equal(estimator.state(stamp).mean, before.mean)


def test_a_warm_up_meets_mallet_and_wall_and_forgets_it(monkeypatch):
    tracker, contacts = PuckFilter(model()), []
    state = PuckFilter.state
    monkeypatch.setattr(PuckFilter, "state", lambda self, at: contacts.append(state(self, at).contacts))
    tracker.warm_up()
    monkeypatch.undo()
    assert contacts[0] >= 2 and tracker.state(1.0) is None
