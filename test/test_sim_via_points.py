"""The linear-program oracle, and the experiments on via-points and key timing."""

import argparse
import json
import pickle

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.optimize import linprog

from sim_bridge.experiments.timing import key_timing, via_points
from sim_bridge.experiments.timing.linear_program import optimal_duration
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory import MINIMUM_DURATION, Limits, OptimalBasis, minimal_duration

ONE = Limits([0.1], [0.2])
UNEVEN = OptimalBasis([0.1, 0.15, 0.4, 0.85, 1.0])


def sampled_program_is_feasible(basis, duration, limits, count=400):
    """Whether SciPy's clamped splines can keep the limits at some phases: less than is asked for."""
    size = basis.n_via + 2
    splines = CubicSpline(basis.knots, np.eye(size), bc_type="clamped")
    s = np.linspace(0.0, 1.0, count)
    velocity, acceleration = splines(s, 1) / duration, splines(basis.knots, 2) / duration**2
    rows = np.vstack([velocity / limits.velocity, acceleration / limits.acceleration])
    free, goal = rows[:, 1:-1], rows[:, -1]
    bounds = [(None, None)] * basis.n_via
    both, rest = np.vstack([free, -free]), np.concatenate([1.0 - goal, 1.0 + goal])
    return linprog(np.zeros(basis.n_via), A_ub=both, b_ub=rest, bounds=bounds).status == 0


@pytest.mark.parametrize("n_via", range(3, 10))
def test_optimum_in_closed_form(n_via):
    # One segment to speed up with an acceleration that falls linearly to zero, one to slow down.
    optimum = optimal_duration(OptimalBasis.uniform(n_via), [0.0], [1.0], ONE)
    assert optimum.duration == pytest.approx(10.0 * (n_via + 1) / (n_via + 1 / 3), rel=1e-6)


@pytest.mark.parametrize("basis", [OptimalBasis.uniform(n) for n in (1, 2, 5, 10, 12)] + [UNEVEN])
@pytest.mark.parametrize("limits", [ONE, Limits([0.1], [0.02]), Limits([2.0], [0.5])])
def test_optimum_is_reached_and_nothing_below_it(basis, limits):
    optimum = optimal_duration(basis, [0.0], [1.0], limits)
    keys = np.concatenate([[[0.0]], optimum.via_points, [[1.0]]])
    still = np.zeros(1)
    assert minimal_duration(basis, keys, still, still, limits) == pytest.approx(optimum.duration, rel=1e-6)
    assert sampled_program_is_feasible(basis, optimum.duration * 1.0001, limits)
    # The velocity limit at 400 phases only is a little weaker.
    assert not sampled_program_is_feasible(basis, optimum.duration * 0.999, limits)


def test_the_optimum_need_not_fall_with_another_via_point():
    durations = [optimal_duration(OptimalBasis.uniform(n), [0.0], [1.0], ONE).duration for n in range(1, 12)]
    assert durations == sorted(durations[:10], reverse=True) + durations[10:]
    assert durations[10] > durations[9] > via_points.BANG_BANG


def test_the_slowest_joint_decides_and_direction_does_not():
    basis = OptimalBasis.uniform(4)
    limits = Limits([0.1, 1.0, 0.1], [0.2, 3.0, 0.2])
    optimum = optimal_duration(basis, [0.0, 0.5, 3.0], [1.0, -2.0, 3.0], limits)
    alone = optimal_duration(basis, [0.0], [2.5], Limits([1.0], [3.0])).duration
    np.testing.assert_allclose(optimum.durations, [optimum.duration, alone, MINIMUM_DURATION], rtol=1e-6)
    keys = np.vstack([[0.0, 0.5, 3.0], optimum.via_points, [1.0, -2.0, 3.0]])
    still = np.zeros(3)
    assert minimal_duration(basis, keys, still, still, limits) <= optimum.duration * (1.0 + 1e-6)


def test_seven_joints():
    seven = via_points.SEVEN
    for n_via, expected in ((4, 30.0 / 13.0), (9, 15.0 / 7.0)):
        optimum = optimal_duration(OptimalBasis.uniform(n_via), np.zeros(7), np.ones(7), seven)
        assert optimum.duration == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": [0.0, 0.0]}, "start must be"),
        ({"goal": [np.nan]}, "goal must be"),
        ({"limits": Limits([np.inf], [1.0])}, "finite limits"),
        ({"basis": OptimalBasis.uniform(0)}, "via-points"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"tolerance": np.nan}, "tolerance"),
    ],
)
def test_linear_program_refuses(change, message):
    arguments = {"basis": OptimalBasis.uniform(2), "start": [0.0], "goal": [1.0], "limits": ONE, **change}
    with pytest.raises(InvalidInputError, match=message):
        optimal_duration(**arguments)


def test_searches_reach_the_optimum_within_limits():
    ones, sevens = via_points.cases()
    for case in (ones[0], ones[5], ones[9], sevens[0]):
        task = via_points.Task(case, 1003)
        outcome = via_points.solve(pickle.loads(pickle.dumps(task)))
        still = np.zeros(case.limits.dof)
        optimum = optimal_duration(case.problem.basis, still, still + 1.0, case.limits).duration
        assert optimum * (1.0 - 1e-6) <= outcome.duration <= optimum * 1.005
        assert outcome.broken == ()
        again = via_points.solve(task)
        assert (again.duration, again.iterations) == (outcome.duration, outcome.iterations)


def test_free_timing_comes_near_bang_bang():
    assert via_points.BANG_BANG < via_points.free_timing(4).duration < 10.51
    assert via_points.free_timing(1).duration < 15.0


def arguments(folder, runs):
    return argparse.Namespace(runs=runs, seed=1000, out=str(folder), jobs=1, scheduler=None, resume=False)


def test_via_points_experiment(tmp_path, monkeypatch, capsys):
    small = [via_points.cases()[0][n - 1] for n in (1, 4)], via_points.cases()[1]
    monkeypatch.setattr(via_points, "cases", lambda: small)
    monkeypatch.setattr(via_points, "JUDGED", (1, 4))
    monkeypatch.setattr(via_points, "MOST_SECONDS", 1e3)
    assert via_points.run(arguments(tmp_path, 2)) == 0
    assert "verdict: passed" in capsys.readouterr().out.splitlines()[-1]
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert 0.0 <= summary["worst_gap_to_lp"] <= 0.005
    assert 0.0 <= summary["gap_7dof_n5"] <= 0.005
    assert 0.0 <= summary["gap_7dof_n10"] <= 0.005
    assert (tmp_path / "via_points.png").stat().st_size > 10_000
    assert "15.0000 s" in (tmp_path / "table.md").read_text()


def test_via_points_verdict_can_fail():
    good = {
        "worst_gap_to_lp": 0.001, "gap_7dof_n5": 0.001, "gap_7dof_n10": 0.001, "seconds_7dof_n5_p50": 0.1,
        "limits_broken": 0,
    }  # fmt: skip
    assert via_points.verdict(good) == 0
    for key, value in {
        **dict.fromkeys(good, 0.0051),
        "seconds_7dof_n5_p50": 0.16,
        "limits_broken": 1,
    }.items():
        assert via_points.verdict({**good, key: value}) == 1
    for key in good:
        assert via_points.verdict({**good, key: np.nan}) == 1


def test_key_timing_experiment(tmp_path, capsys):
    assert key_timing.run(arguments(tmp_path, 3)) == 0
    assert "verdict: passed" in capsys.readouterr().out.splitlines()[-1]
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["worst_ratio"] <= 1.0
    assert len(summary["rows"]) == len(key_timing.SETS) * len(key_timing.COUNTS)
    assert (tmp_path / "key_timing.png").stat().st_size > 10_000


def test_key_timing_verdict_can_fail():
    good = {"worst_ratio": 1.0, "limits_broken": 0, "median_ratio": {"plane_uneven": 0.6, "fr3": 0.8}}
    assert key_timing.verdict(good) == 0
    worse = {"worst_ratio": 1.0 + 1e-9, "limits_broken": 1, "median_ratio": {"plane_uneven": 0.9, "fr3": 0.8}}
    for key, value in worse.items():
        assert key_timing.verdict({**good, key: value}) == 1


def test_key_position_sets_are_seeded():
    task = key_timing.Task("plane_uneven", 8, 1000)
    keys, limits = key_timing.key_positions(task)
    np.testing.assert_array_equal(keys, key_timing.key_positions(task)[0])
    assert not np.array_equal(keys, key_timing.key_positions(key_timing.Task("plane_uneven", 8, 1001))[0])
    lengths = np.linalg.norm(np.diff(keys, axis=0), axis=1)
    assert lengths.max() > 3.0 * lengths.min()
    even = key_timing.key_positions(key_timing.Task("plane_even", 8, 1000))[0]
    np.testing.assert_allclose(np.linalg.norm(np.diff(even, axis=0), axis=1), 0.5)
    np.testing.assert_allclose(key_timing.chord_phases(even, limits), np.arange(1, 10) / 9.0)
