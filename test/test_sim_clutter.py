"""The clutter of Fig. 4.4 and the two offline experiments in the plane."""

import json

import numpy as np
import pytest

from sim_bridge import cli
from sim_bridge.experiments.clutter import cholesky, clutter_2d
from sim_bridge.experiments.clutter.world import CLUTTER, GOAL, LIMITS, STARTS, draw_world, homotopy_class
from vpsto_ros.collision.planar import MovingDisc, PlanarWorld
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.optimization.costs import JointSpaceProblem
from vpsto_ros.optimization.vpsto import VpstoConfig, search
from vpsto_ros.trajectory import OptimalBasis

START = STARTS["start_0.10_0.20"]


def path(*corners):
    """A polyline from the start to the goal, 200 samples per piece, shape (K, 2)."""
    points = np.array([START, *corners, GOAL])
    along = np.linspace(0.0, len(points) - 1.0, 200 * (len(points) - 1))
    return np.column_stack([np.interp(along, np.arange(len(points)), column) for column in points.T])


@pytest.mark.parametrize(
    ("corners", "letters"),
    [
        ([(0.08, 0.32), (0.2, 0.32)], "LR"),
        ([(0.09, 0.1), (0.24, 0.1), (0.3, 0.25)], "R"),
        ([(0.08, 0.35), (0.15, 0.43), (0.27, 0.46), (0.35, 0.42)], "LTR"),
        ([(0.08, 0.33), (0.21, 0.31), (0.3, 0.1), (0.38, 0.08), (0.44, 0.1), (0.45, 0.25)], "L"),
        ([(0.09, 0.1), (0.24, 0.1), (0.3, 0.1), (0.38, 0.08), (0.44, 0.1), (0.45, 0.25)], "-"),
        ([(0.08, 0.32), (0.2, 0.32), (0.08, 0.4), (0.2, 0.32)], "LR"),  # back and forth
        (
            [(0.09, 0.1), (0.24, 0.1), (0.24, 0.28), (0.21, 0.33), (0.21, 0.42), (0.26, 0.47), (0.34, 0.42)],
            "TR",
        ),
    ],
)
def test_homotopy_class_of_polylines(corners, letters):
    positions = path(*corners)
    assert not CLUTTER.inside(positions).any()
    assert homotopy_class(positions) == letters
    assert homotopy_class(positions[::7]) == letters


def test_homotopy_class_refuses_what_is_no_path():
    for positions in (np.zeros((1, 2)), np.zeros((5, 3)), np.full((5, 2), np.nan)):
        with pytest.raises(InvalidInputError, match="path"):
            homotopy_class(positions)


def test_world_has_room_for_starts_and_goal_and_can_be_drawn():
    assert (CLUTTER.clearance([*STARTS.values(), GOAL]) > 0.01).all()
    assert CLUTTER.inside([[0.17, 0.2], [0.27, 0.4], [0.38, 0.15], [-0.01, 0.2]]).all()
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots()
    draw_world(axes, CLUTTER.with_discs((MovingDisc((0.1, 0.1), 0.02, (1.0, 0.0)),)), time=0.2)
    assert len(axes.patches) == 4
    assert axes.patches[-1].center == pytest.approx((0.3, 0.1))
    plt.close(figure)


@pytest.mark.parametrize(
    ("start", "goal", "message"),
    [
        ([0.17, 0.2], GOAL, r"start \(0.17, 0.2\): in collision with L all along"),
        (START, [0.38, 0.15], r"goal \(0.38, 0.15\): in collision with R all along"),
        ([-0.1, 0.2], GOAL, r"start \(-0.1, 0.2\): position of joint 1"),
        (START, START, "the same point"),
        ([np.nan, 0.2], GOAL, "start must be finite"),
        ([0.1, 0.2, 0.3], GOAL, "start must be finite with shape"),
    ],
)
def test_bad_ends_are_refused(start, goal, message):
    with pytest.raises(InvalidInputError, match=message):
        clutter_2d.problem(np.array(start), np.array(goal), 3)


def task(config=clutter_2d.PLAIN, seed=1000):
    return clutter_2d.Task(tuple(START.tolist()), tuple(GOAL.tolist()), 3, config, seed)


def test_search_in_clutter_is_valid_and_repeatable():
    first, again = clutter_2d.solve(task()), clutter_2d.solve(task())
    assert first.valid and not first.reasons and not first.sampled_hits
    np.testing.assert_array_equal(first.points, again.points)
    assert first.letters in clutter_2d.EXPECTED["start_0.10_0.20"]
    trajectory = task().problem.trajectory(first.points)
    assert trajectory.violations(LIMITS) == []
    times = np.linspace(0.0, trajectory.duration, 20_001)
    assert CLUTTER.clearance(trajectory(times)).min() > -1e-12
    assert first.duration <= 1.02 * clutter_2d.EXPECTED["start_0.10_0.20"][first.letters]
    # The optimum leans on a corner: a search that stays away from the obstacles would not find it.
    assert CLUTTER.clearance(trajectory(times)).min() < 1e-4


def test_search_that_finds_nothing_says_what_is_in_the_way():
    outcome = clutter_2d.solve(task(VpstoConfig(population=4, iterations=1, restarts=0, sigma=1e-3)))
    assert not outcome.valid
    assert outcome.sampled_hits > 0
    assert outcome.settled is None
    assert any(reason.startswith("in collision with L from") for reason in outcome.reasons)


def test_goal_behind_walls_is_reported_with_the_best_invalid_candidate():
    ring = [(0.3, 0.2, 0.5, 0.22), (0.3, 0.38, 0.5, 0.4), (0.3, 0.2, 0.32, 0.4), (0.48, 0.2, 0.5, 0.4)]
    boxes = tuple(np.array([(a, b), (c, b), (c, d), (a, d)]) for a, b, c, d in ring)
    world = PlanarWorld(CLUTTER.lower, CLUTTER.upper, boxes, names=("south", "north", "west", "east"))
    plan = JointSpaceProblem(OptimalBasis.uniform(3), LIMITS, START, GOAL, terms=(world.term(),))
    config = VpstoConfig(population=16, iterations=60, restarts=0)
    result = search(plan.prior(spread=0.1), plan.evaluate, config, np.random.default_rng(0))
    assert result.status == "no valid plan"
    reasons = plan.explain(result.best_any_points)
    assert len(reasons) == 1
    assert reasons[0].startswith("in collision with west from")


def outcome(letters="LR", duration=5.0, valid=True, milliseconds=50.0, hits=0):
    reasons = () if valid else ("in collision with L",)
    return clutter_2d.Outcome(np.zeros((3, 2)), valid, hits, duration, letters, 50, milliseconds, reasons)


GOOD = [outcome(), outcome("R", 4.9), outcome("LTR", 5.8)]
MORE = [outcome(duration=4.6)]


@pytest.mark.parametrize(
    ("plain", "more", "said"),
    [
        (GOOD, MORE, []),
        ([*GOOD, outcome(valid=False)], MORE, ["1 runs"]),
        (GOOD[:2], MORE, []),  # by bad luck
        (GOOD[1:], MORE, ["LR was never found"]),
        ([GOOD[0], GOOD[2]], MORE, ["R was never found"]),
        ([*GOOD[:2], outcome("LTR", 6.1)], MORE, ["LTR from start_0.10_0.20 takes"]),
        (GOOD, [outcome(duration=4.66)], ["median of 4.66 s, asked 4.65 s"]),
        (GOOD, [outcome(duration=4.7), *MORE, outcome(duration=4.8)], ["median of 4.70 s"]),  # not the best
        (GOOD, [outcome(valid=False)], ["1 of 1 runs", "no valid run, asked 4.65 s"]),
        (GOOD, [outcome(valid=False), *MORE], ["1 of 2 runs from start_0.10_0.20 with 7 via-points"]),
        ([outcome("LR", milliseconds=101.0), *GOOD[1:]] * 2, MORE, []),
        ([outcome(each, 4.9, 1, 101.0) for each in ("LR", "R", "LTR")], GOOD[1:2], ["101 ms", "4.65 s"]),
        ([*GOOD, outcome(hits=1)], MORE, ["collide when sampled"]),
        ([outcome(valid=False)], [outcome(valid=False)], ["1 runs", "1 of 1", "LR", "R was", "4.65"]),
    ],
)
def test_every_shortcoming_is_told(plain, more, said):
    name = "start_0.10_0.20"
    results = {name: clutter_2d.summarise(plain, {7: more})}
    found = clutter_2d.shortcomings(results, 100, clutter_2d.EXPECTED)
    assert len(found) == len(said)
    for words, line in zip(said, found, strict=True):
        assert words in line
    notes = clutter_2d.unlucky(results, 100, {name: clutter_2d.EXPECTED[name]})
    assert bool(notes) == ("LTR" not in results[name]["classes"])
    table = clutter_2d.class_table(results, clutter_2d.EXPECTED)
    assert table.count(name) >= 1 and ("5.15 s" in table) == ("LR" in results[name]["classes"])
    assert "5.15 s" not in clutter_2d.class_table(results, {})
    assert clutter_2d.more_table(results).count(name) == 1


def test_experiment_clutter_2d(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(clutter_2d, "LONG", clutter_2d.PLAIN)
    monkeypatch.setattr(clutter_2d, "MORE_VIA_POINTS", (7,))
    monkeypatch.setattr(clutter_2d, "MOST_MS", np.inf)
    monkeypatch.setattr(clutter_2d, "LONGEST_WITH_MORE", {"start_0.10_0.20": 5.3})
    arguments = ["experiment", "clutter_2d", "--runs", "2", "--seed", "1000", "--jobs", "1", "--out"]
    assert cli.main([*arguments, str(tmp_path)]) == 0
    assert capsys.readouterr().out.strip().splitlines()[-1].startswith("verdict: passed")
    summary = json.loads((tmp_path / "summary.json").read_text())
    for name in STARTS:
        assert summary[name]["invalid"] == 0
        assert sum(each["count"] for each in summary[name]["classes"].values()) == 2
        assert summary[name]["best_duration_s"] <= summary[name]["best_duration_more_via_points_s"]
        assert summary[name]["solve_ms_p50"] > 0.0
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
    assert (tmp_path / "table.md").read_text().startswith("| start")


@pytest.mark.parametrize(
    ("start", "goal", "known"),
    [((0.1, 0.2), (0.4, 0.3), True), ((0.101, 0.2), (0.4, 0.3), False), ((0.1, 0.2), (0.4, 0.31), False)],
)
def test_only_the_problems_of_the_figure_have_reference_durations(start, goal, known):
    found = clutter_2d._expected({"start_0.10_0.20": np.array(start)}, np.array(goal))
    assert found == ({"start_0.10_0.20": clutter_2d.EXPECTED["start_0.10_0.20"]} if known else {})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--start", "0.17", "0.2"], "in collision with L"),
        (["--start", "0.4", "0.3"], "the same point"),
        (["--goal", "0.7", "0.3"], "goal (0.7, 0.3)"),
        (["--start", "nan", "0.3"], "start must be finite"),
    ],
)
def test_experiment_clutter_2d_refuses_bad_ends(tmp_path, options, message, capsys):
    arguments = ["experiment", "clutter_2d", "--runs", "1", "--out", str(tmp_path / "out"), *options]
    assert cli.main(arguments) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_variants_of_the_first_distribution_are_as_wide():
    smooth, isotropic = cholesky.prior("with_prior"), cholesky.prior("without_prior")
    np.testing.assert_allclose(isotropic.mean, smooth.mean)
    assert np.trace(isotropic.covariance) == pytest.approx(np.trace(smooth.covariance))
    np.testing.assert_allclose(isotropic.covariance, isotropic.covariance[0, 0] * np.eye(12), atol=1e-15)
    assert not cholesky.problem().evaluate(smooth.mean_points[None]).valid[0]


def test_outcome_of_a_cholesky_search_is_what_it_says():
    found = cholesky.solve(cholesky.Task("cma", "with_prior", 1000))
    evaluation = cholesky.problem().evaluate(found.points[None])
    assert evaluation.valid[0]
    assert evaluation.cost[0] == found.cost
    assert found.settled == len(found.means)
    assert np.abs(np.diff(found.means))[-1] < cholesky.TOLERANCE
    assert (np.abs(np.diff(found.means))[:-1] >= cholesky.TOLERANCE).all()
    assert 1 <= found.free <= found.mean_free <= found.settled


def test_rates_count_every_run():
    runs = [cholesky.Outcome(n, n, 9, 2.0, None, np.ones(1)) for n in (1, 3, 4)]
    runs.append(cholesky.Outcome(None, None, None, np.inf, None, np.ones(1)))
    row = cholesky.summarise(runs, 1.0)
    assert row["collision_free_by_3_rate"] == 0.5
    assert row["collision_free_by_3_interval"][0] < 0.5 < row["collision_free_by_3_interval"][1]
    assert row["iterations_to_collision_free_p50"] == 4.0
    assert row["iterations_to_collision_free_p95"] is None
    assert row["cost_over_best_p50"] == 2.0
    assert row["never_collision_free"] == 1
    assert row["near_best_rate"] == 0.0


def test_experiment_cholesky(tmp_path, monkeypatch, capsys):
    arguments = ["experiment", "cholesky", "--runs", "3", "--seed", "1000", "--jobs", "1"]
    arguments += ["--out", str(tmp_path)]
    assert cli.main(arguments) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["collision_free_by_3_rate"] >= 0.95
    assert set(summary["variants"]) == {f"{s}_{p}" for s in cholesky.STRATEGIES for p in cholesky.PRIORS}
    assert (tmp_path / "cholesky.png").stat().st_size > 10_000
    # With nothing but the isotropic distribution the figure is out of reach.
    isotropic = cholesky.prior("without_prior")
    monkeypatch.setattr(cholesky, "prior", lambda name: isotropic)
    assert cli.main(arguments) == 1
    assert capsys.readouterr().out.strip().splitlines()[-1].startswith("verdict: FAILED")
