"""Experiments: how runs are judged and summed up, what is drawn, and small ones from end to end."""

import dataclasses
import json
import types

import numpy as np
import pytest

from sim_bridge import cli
from sim_bridge.experiments.pushing import push_box, push_t
from sim_bridge.experiments.pushing.experiment import Targets, results_table, run_variant, summarise
from sim_bridge.experiments.pushing.loop import Recording
from sim_bridge.experiments.pushing.trials import KNOCK_MARGIN, Trial, run_trial
from sim_bridge.experiments.runs import markdown_table, quantile, success_interval, write_summary
from sim_bridge.scene import ObjectPlant
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.planning.workspace import Workspace

GOAL = np.array([0.5, 0.1, 0.0])
AWAY = np.array([0.5, -0.1, 0.0])
OUTSIDE = np.array([0.9, 0.0, 0.0])


class FakeSimulation:
    """An object whose pose is a function of time and, from then on, of the time since the hand let go."""

    def __init__(self, path, after_knock=None, center=GOAL):
        self.path, self.after_knock, self.center = path, after_knock, np.array(center)
        self.milliseconds, self.knocks = 0, []
        self.limits = types.SimpleNamespace(violations=0)
        self.tool_height_deviation = 0.0003

    @property
    def time(self):
        return self.milliseconds * 1e-3

    def object_pose(self):
        if self.path is None:
            return self.center
        if self.knocks and self.after_knock is not None:
            return self.after_knock(self.time - self.knocks[-1][1] - 0.25)
        return self.path(self.time)

    def knock(self, displacement, duration):
        assert duration == 0.25
        self.knocks.append((np.array(displacement), self.time))


class FakeLoop:
    def __init__(self, simulation):
        self.simulation, self.recording = simulation, Recording()
        for name in ("time", "compute"):
            getattr(self.recording, name).append(0.01)
        self.recording.object_pose.append(AWAY)

    def advance(self, duration):
        self.simulation.milliseconds += round(1000 * duration)


def a_trial(**changes):
    trial = Trial(7, ObjectPlant(), AWAY, GOAL, None, 4.0, 12.0)
    return dataclasses.replace(trial, **changes)


def judged(path, after_knock=None, **changes):
    """The result of a run in which the object is where path(t) and after_knock(t) say."""
    simulation = FakeSimulation(path, after_knock)
    return run_trial(a_trial(**changes), FakeLoop(simulation), Workspace()), simulation


def at_goal(*intervals):
    def pose(t):
        return GOAL if any(low - 1e-9 <= t < high - 1e-9 for low, high in intervals) else AWAY

    return pose


def test_the_goal_counts_when_it_is_held_for_a_second():
    result, simulation = judged(at_goal((2.0, 99.0)))
    assert result.success and result.time_to_goal == pytest.approx(2.0)
    assert simulation.time == pytest.approx(3.0)
    assert result.time_to_goal_before_knock is None and result.final_error == 0.0


def test_leaving_the_goal_starts_the_second_anew():
    result, simulation = judged(at_goal((1.0, 1.9), (2.5, 99.0)))
    assert result.success and result.time_to_goal == pytest.approx(2.5)
    assert simulation.time == pytest.approx(3.5)


def test_a_goal_never_held_is_a_failure_at_the_time_limit():
    result, simulation = judged(at_goal(*((k, k + 0.9) for k in range(12))))
    assert not result.success and result.time_to_goal is None
    assert simulation.time == pytest.approx(12.0)
    assert result.final_error == pytest.approx(0.2)


def test_times_count_from_the_end_of_the_knock():
    result, simulation = judged(at_goal((1.0, 99.0)), at_goal((1.75, 99.0)), knock=np.array([0.0, -0.08]))
    assert [time for _, time in simulation.knocks] == [pytest.approx(4.0)]
    assert result.success and result.time_to_goal == pytest.approx(1.75)
    assert result.time_to_goal_before_knock == pytest.approx(1.0)
    assert simulation.time == pytest.approx(4.25 + 1.75 + 1.0)


def test_what_was_held_before_the_knock_does_not_count_after_it():
    result, simulation = judged(at_goal((1.0, 99.0)), knock=np.array([0.0, -0.08]))
    assert result.success and result.time_to_goal == pytest.approx(0.05), "seen at the next look"
    assert simulation.time == pytest.approx(5.3)


def test_without_the_goal_before_the_knock_there_is_no_time_to_it():
    result, _ = judged(at_goal((1.0, 2.0)), at_goal((0.5, 99.0)), knock=np.array([0.0, -0.08]))
    assert result.success and result.time_to_goal_before_knock is None


def test_leaving_the_workspace_once_is_remembered():
    result, _ = judged(lambda t: OUTSIDE if 0.99 < t < 1.06 else GOAL if t > 2.0 else AWAY)
    assert result.success and result.left_workspace
    assert not judged(at_goal((2.0, 99.0)))[0].left_workspace


def test_orientation_counts_where_a_tolerance_is_given():
    turned = np.append(GOAL[:2], np.pi - 0.02)
    goal = np.append(GOAL[:2], -np.pi + 0.02)
    assert judged(lambda t: turned, goal=goal, yaw_tolerance=0.05)[0].success, "4 hundredths across the cut"
    missed = judged(lambda t: turned, goal=goal, yaw_tolerance=0.03)[0]
    assert not missed.success and missed.final_yaw_error == pytest.approx(0.04)
    assert judged(lambda t: turned, goal=goal)[0].success
    assert a_trial().planar_goal.yaw is None and a_trial(yaw_tolerance=0.1).planar_goal.yaw == 0.0


def test_a_hand_never_pushes_out_of_the_workspace():
    rng, workspace = np.random.default_rng(0), Workspace()
    x, y = workspace.object_x, workspace.object_y
    inner = [[x[0] + KNOCK_MARGIN, y[0] + KNOCK_MARGIN], [x[1] - KNOCK_MARGIN, y[1] - KNOCK_MARGIN]]
    kept = 0
    for _ in range(500):
        center = np.append(rng.uniform([x[0], y[0]], [x[1], y[1]]), 0.0)
        length, angle = rng.uniform(0.05, 0.10), rng.uniform(-np.pi, np.pi)
        asked = length * np.array([np.cos(angle), np.sin(angle)])
        simulation = FakeSimulation(None, center=center)
        run_trial(a_trial(knock=asked, knock_time=0.0, time_limit=0.2), FakeLoop(simulation), workspace)
        ((given, time),) = simulation.knocks
        assert time == 0.0
        assert np.hypot(*given) == pytest.approx(length)
        after = center[:2] + given
        assert np.all((after >= inner[0]) & (after <= inner[1])), (center, asked, given)
        straight = np.all((center[:2] + asked >= inner[0]) & (center[:2] + asked <= inner[1]))
        kept += bool(straight)
        if straight:
            np.testing.assert_allclose(given, asked)
    assert 100 < kept < 500, "both cases occur"


@pytest.mark.parametrize(
    ("successes", "runs", "low", "high"),
    [(8, 10, 0.49016, 0.94331), (0, 10, 0.0, 0.27753), (100, 100, 0.96301, 1.0)],
)
def test_success_intervals_are_wilsons(successes, runs, low, high):
    assert success_interval(successes, runs) == (pytest.approx(low, abs=1e-5), pytest.approx(high, abs=1e-5))
    p, z = successes / runs, 1.959963984540054
    middle, spread = p + z * z / (2 * runs), z * np.sqrt(p * (1 - p) / runs + z * z / (4 * runs * runs))
    expected = np.array([middle - spread, middle + spread]) / (1 + z * z / runs)
    np.testing.assert_allclose(success_interval(successes, runs), expected, atol=1e-9)


def test_quantiles_leave_out_what_is_missing():
    assert quantile([3.0, None, 1.0, np.nan, 2.0, np.inf], 0.5) == 2.0
    assert quantile([None], 0.5) is None


def test_tables_are_aligned_and_read_back():
    text = markdown_table(["planner", "runs"], [["VP-STO", "100"], ["a scripted push", 7]])
    lines = text.splitlines()
    assert len({len(line) for line in lines}) == 1 and text.endswith("|\n")
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert cells[0] == ["planner", "runs"] and cells[2:] == [["VP-STO", "100"], ["a scripted push", "7"]]
    assert all(set(cell) == {"-"} for cell in cells[1])


def runs_of_ten():
    """Nine successes in 1 to 9 s, and one failure that left the workspace and broke limits."""
    reached, _ = judged(at_goal((1.0, 99.0)))
    failed, _ = judged(at_goal())
    good = [dataclasses.replace(reached, seed=k, time_to_goal=1.0 + k) for k in range(9)]
    return [*good, dataclasses.replace(failed, seed=9, left_workspace=True, limit_violations=3, rejected=2)]


def test_a_summary_says_what_the_runs_say(tmp_path):
    summary = summarise(runs_of_ten())
    assert (summary["runs"], summary["success_rate"], summary["failed_seeds"]) == (10, 0.9, [9])
    assert summary["success_ci95"] == success_interval(9, 10)
    assert (summary["limit_violations"], summary["left_workspace"]) == (3, 1)
    assert summary["rejected_trajectories"] == 2
    assert summary["time_to_goal_s_median"] == 5.0
    assert summary["time_to_goal_s_p90"] == pytest.approx(8.2)
    assert summary["time_to_goal_before_knock_s_median"] is None
    assert summary["final_error_m_median"] == 0.0
    assert summary["tool_height_error_m_max"] == 0.0003
    assert summary["compute_ms"] == {key: pytest.approx(10.0) for key in ("p50", "p99", "max")}
    read = json.loads(write_summary(tmp_path / "new" / "folder", summary).read_text())
    assert read == summary | {"success_ci95": list(summary["success_ci95"])}


def test_a_summary_of_failures_alone_has_no_times():
    summary = summarise([judged(at_goal())[0]])
    assert summary["success_rate"] == 0.0 and summary["time_to_goal_s_median"] is None
    assert "- / - s" in results_table({"a": "planner A"}, {"a": summary})


def test_targets_name_what_was_missed():
    bad = summarise(runs_of_ten())
    reasons = Targets(success_rate=0.95, median_time_to_goal=4.0).missed(bad)
    for part in ("success rate 0.90, asked 0.95", "5.0 s, asked 4.0 s", "3 limit violations", "in 1 runs"):
        assert any(part in reason for reason in reasons), part
    assert len(reasons) == 4
    assert Targets(success_rate=1.0).missed(summarise(runs_of_ten()[:9])) == []
    never = summarise([judged(at_goal())[0]])
    assert any("median" in reason for reason in Targets(0.0, median_time_to_goal=4.0).missed(never))


def spreads_out(values, low, high):
    """Whether values stay within a range and use most of it."""
    used = (np.max(values) - np.min(values)) / (high - low)
    return low <= np.min(values) and np.max(values) <= high and used > 0.9


def plants_are_varied(trials, half_extents):
    plants = [trial.plant for trial in trials]
    assert spreads_out([plant.mass for plant in plants], 0.2, 1.0)
    assert spreads_out([plant.table_friction for plant in plants], 0.2, 0.6)
    assert spreads_out([plant.tool_friction for plant in plants], 0.1, 0.5)
    offsets = np.array([plant.com_offset for plant in plants]) / half_extents
    assert all(spreads_out(column, -0.2, 0.2) for column in offsets.T)
    assert {plant.support for plant in plants} == {"corners", "spread"}


def inside_workspace(trials):
    return all(Workspace().contains_object(pose) for trial in trials for pose in (trial.start, trial.goal))


def test_boxes_are_drawn_from_what_is_promised():
    trials = [push_box.random_trial(seed) for seed in range(200)]
    sides = np.array([2.0 * np.array(trial.plant.shape.primitives[0].half_size) for trial in trials])
    assert all(spreads_out(column, 0.08, 0.16) for column in sides.T)
    plants_are_varied(trials, 0.5 * sides)
    assert spreads_out([np.hypot(*trial.knock) for trial in trials], 0.05, 0.10)
    assert spreads_out([np.arctan2(*trial.knock) for trial in trials], -np.pi, np.pi)
    assert spreads_out([trial.knock_time for trial in trials], 4.0, 6.0)
    assert min(np.hypot(*(trial.goal - trial.start)[:2]) for trial in trials) >= 0.08
    assert {trial.time_limit for trial in trials} == {30.0} and inside_workspace(trials)


def test_tees_are_drawn_from_what_is_promised():
    trials = [push_t.random_trial(seed) for seed in range(200)]
    corners = np.concatenate(PlanarShape.tee().transform(np.zeros(3)))
    plants_are_varied(trials, 0.5 * np.ptp(corners, axis=0))
    assert {trial.knock for trial in trials} == {None} and inside_workspace(trials)
    assert spreads_out([trial.start[2] for trial in trials], -np.pi, np.pi)
    assert {trial.yaw_tolerance for trial in trials} == {float(np.radians(5.0))}


@pytest.mark.parametrize("experiment", [push_box, push_t])
def test_a_seed_names_a_trial(experiment):
    one, same, other = (experiment.random_trial(seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.start, same.start)
    assert one.plant == same.plant and one.plant != other.plant


@pytest.mark.parametrize("variant", [push_box.VARIANTS[0], push_box.VARIANTS[-1]], ids=lambda v: v.name)
def test_the_same_trial_takes_the_same_course(variant):
    trial = dataclasses.replace(push_box.random_trial(5), knock_time=1.0, time_limit=2.0)
    first, second = run_variant((variant, trial)), run_variant((variant, trial))
    assert len(first.times) > 20
    np.testing.assert_array_equal(first.object_path, second.object_path)
    np.testing.assert_array_equal(first.tool_path, second.tool_path)
    assert np.ptp(first.tool_path[:, :2], axis=0).max() > 0.05, "the arm moved"


def test_push_box_from_the_command_line(tmp_path, capsys):
    only = ["--only", "vpsto", "--only", "straight_push"]
    arguments = ["experiment", "push_box", "--runs", "2", "--seed", "2", "--jobs", "1", *only]
    assert cli.main([*arguments, "--out", str(tmp_path / "out")]) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "summary.json", "table.md", "times.png", "paths.png", "finished_runs",
    }  # fmt: skip
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["experiment"], summary["seed"]) == ("push_box", 2)
    assert list(summary["baselines"]) == ["straight_push"]
    for figures in (summary, summary["baselines"]["straight_push"]):
        assert (figures["runs"], figures["success_rate"], figures["failed_seeds"]) == (2, 1.0, [])
        assert (figures["limit_violations"], figures["left_workspace"]) == (0, 0)
        assert 0.0 < figures["time_to_goal_s_median"] < 30.0
        assert figures["final_error_m_median"] < 0.010
    for name in ("times.png", "paths.png"):
        assert (tmp_path / "out" / name).read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    assert (tmp_path / "out" / "table.md").read_text().splitlines()[2] in printed
    assert "passed" in printed


def test_planning_in_the_plane_keeps_the_height(tmp_path):
    assert cli.main(["experiment", "planning_space", "--runs", "3", "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["plane"]["error_p99"] <= 0.005 < summary["joints"]["error_p50"]
    assert summary["plane"]["within"] >= 0.95


def test_an_unknown_variant_is_named(tmp_path, capsys):
    assert cli.main(["experiment", "push_box", "--only", "vpst", "--out", str(tmp_path)]) == 1
    assert "--only vpst: no such variant; there are vpsto," in capsys.readouterr().err
