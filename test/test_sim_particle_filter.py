"""The experiment of the particle filter: what an episode measures, and what is made of it."""

import dataclasses

import numpy as np
import pytest

from sim_bridge.experiments.estimation import particle_filter
from sim_bridge.experiments.estimation.episodes import Episode, record
from sim_bridge.experiments.estimation.filters import VARIANTS, Comparison, Track, compare
from sim_bridge.experiments.estimation.particle_filter import interval, mean_unseen_error, summarise, unseen


@pytest.fixture(scope="module")
def found():
    return compare(Episode("two_balls", 3))


def test_a_seed_names_an_episode():
    one, same = record(Episode("blind", 5)), record(Episode("blind", 5))
    np.testing.assert_array_equal(one.forces, same.forces)
    np.testing.assert_array_equal(one.pictures[0].pose, same.pictures[0].pose)
    assert len(one.pictures) == 1 and one.touched < one.times[-1]


def test_pictures_are_late_and_none_is_of_a_drop_out():
    log = record(Episode("one_ball", 3))
    stamps = np.array([picture.stamp for picture in log.pictures])
    assert all(p.arrival - p.stamp >= 0.04 - 1e-9 for p in log.pictures)
    for begin, end in log.dropouts:
        assert not ((stamps >= begin) & (stamps < end)).any()
    assert np.hypot(*(log.truth[-1] - log.truth[0])[:2]) > 0.03  # it was pushed


def test_forces_on_the_balls_point_away_from_the_can():
    log = record(Episode("two_balls", 3))
    late = slice(200, 350)
    balls = log.points[late].reshape(-1, 2, 2)
    away = balls - log.truth[late, None, :2]
    assert np.einsum("kei,kei->ke", log.forces[late], away).mean() > 0.0


def test_a_filter_that_knows_the_robot_bridges_drop_outs(found):
    assert set(found.tracks) == set(VARIANTS)
    assert 5.0 * mean_unseen_error(found, "particles") < mean_unseen_error(found, "kalman")
    row = summarise([found], "touch")
    assert row["unseen_mean"] < 0.01 and row["seen_mean"] < 0.005 and 0.0 <= row["covered"] <= 1.0


def test_only_what_is_pushed_and_unseen_counts():
    times = np.linspace(0.0, 1.0, 101)
    track = Track(np.where(times < 0.5, 1.0, 2.0), np.ones(101, dtype=bool), {})
    made = Comparison(Episode("two_balls", 0), times, np.array([[0.2, 0.795]]), 0.5, {"touch": track})
    assert mean_unseen_error(made, "touch") == 2.0
    np.testing.assert_allclose(times[unseen(made)][[0, -1]], [0.5, 0.83], atol=1e-9)
    early = dataclasses.replace(made, touched=0.0)
    assert mean_unseen_error(early, "touch") == pytest.approx(1.0 + 0.34 / 0.59, abs=0.03)


def test_an_interval_shrinks_with_the_number_of_episodes():
    values = np.random.default_rng(0).exponential(size=400)
    low, high = interval(values)
    assert low < values.mean() < high and high - low == pytest.approx(3.92 / 20.0, rel=0.25)
    assert np.ptp(interval(values[:25])) > 2.0 * (high - low)


def test_the_verdict_wants_both_and_a_belief_that_tells_the_truth(capsys):
    good = {
        "ratios": {
            "two_balls: particles to kalman": (0.05, 0.04, 0.06),
            "one_ball: particles to kalman": (0.06, 0.05, 0.07),
            "blind: touch to particles": (0.2, 0.1, 0.3),
        },
        "rows": [{"variant": "touch", "covered": 0.95}, {"variant": "kalman", "covered": 0.1}],
    }
    assert particle_filter.verdict(good) == 0 and "passed" in capsys.readouterr().out
    unsure = good | {"rows": [{"variant": "touch", "covered": 0.5}]}
    assert particle_filter.verdict(unsure) == 1
    slow = good | {"ratios": good["ratios"] | {"blind: touch to particles": (0.4, 0.3, 0.9)}}
    assert particle_filter.verdict(slow) == 1
