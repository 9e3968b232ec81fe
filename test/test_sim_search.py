"""The experiment that backs the options of the search: its statistics, budgets and verdict."""

import argparse
import dataclasses
import json
import math

import numpy as np
import pytest

from sim_bridge.experiments.clutter import clutter_2d, clutter_2d_mpc
from sim_bridge.experiments.search import choices, deadline, problems, reach, variants
from sim_bridge.experiments.search.statistics import Sample, better, dominates, lower
from sim_bridge.experiments.timing import via_points
from vpsto_ros.optimization.vpsto import VpstoConfig
from vpsto_ros.planning.reaching import ReachConfig


def sample(gaps, seconds=1.0):
    return Sample(np.asarray(gaps, dtype=float), 100.0, seconds)


def test_the_interval_of_the_median_covers_it_as_often_as_promised():
    rng, covered = np.random.default_rng(0), 0
    for _ in range(2000):
        _, low, high = sample(rng.exponential(size=20)).median()
        covered += low <= math.log(2.0) <= high
    assert 0.95 <= covered / 2000 < 0.99


def test_failures_are_infinite_gaps():
    middle, low, high = sample([0.1] * 6 + [math.inf] * 4).median()
    assert middle == low == 0.1 and high == math.inf
    summary = sample([0.1] * 6 + [math.inf] * 4).summary()
    assert summary["success_rate"] == 0.6 and summary["gap_interval"] == [0.1, None]
    assert lower(sample([0.3] * 20), sample([0.3] * 10 + [math.inf] * 10), 0.01)
    assert not lower(sample([math.inf] * 20), sample([math.inf] * 20), 0.5)


def test_equal_values_are_seldom_called_better():
    rng = np.random.default_rng(1)
    pairs = [(sample(rng.exponential(size=20)), sample(rng.exponential(size=20))) for _ in range(1000)]
    assert sum(better(a, b) for a, b in pairs) <= 4
    assert better(sample(rng.uniform(0.0, 0.1, 20)), sample(rng.uniform(0.1, 0.2, 20)))
    tiny = sample(np.linspace(0.0, 0.001, 20))
    assert not better(tiny, sample(0.002 + tiny.gaps)), "a difference that does not matter"


def test_a_value_dominates_only_if_it_costs_nothing_elsewhere():
    good, bad = sample(np.linspace(0.0, 0.1, 20)), sample(np.linspace(0.2, 0.3, 20))
    assert dominates({"a": good, "b": bad}, {"a": bad, "b": bad})
    assert not dominates({"a": good, "b": bad}, {"a": bad, "b": good})
    assert not dominates({"a": good, "b": bad}, {"a": good, "b": bad})
    slow = sample(good.gaps, seconds=2.0)
    assert not dominates({"a": slow}, {"a": bad})


@pytest.mark.parametrize("changes", [{}, {"population": 48, "starts": 2}, variants.CONVERGED])
def test_budgets_are_used_up_and_kept(changes):
    for name in ("line", "walls"):
        budget = problems.problems()[name].budget
        result = problems.run_task(problems.Task(name, variants.changed(variants.SEARCH, changes), 1000))
        assert budget - 96 < result.evaluations <= budget


def test_reaching_counts_what_it_evaluates():
    config = variants.changed(variants.REACH, {"guesses": 10, "iterations": 3, "starts": 2})
    result = reach.run_task(reach.Task("cells", config, 1000), budget=500)
    assert 500 - 2 * 24 < result.evaluations <= 500 + 11 + 2 * 24
    assert result == dataclasses.replace(
        reach.run_task(reach.Task("cells", config, 1000), budget=500), seconds=result.seconds
    )


def test_every_option_is_compared_with_the_value_in_use():
    every = (*variants.OFFLINE, *variants.REPLANNING, *variants.REACHING, variants.RESERVES)
    assert len({choice.name for choice in every}) == len(every)
    for choice in every:
        assert [not changes for changes in choice.values.values()].count(True) == 1
        assert len(choice.values) > 1 and not choice.values[choice.in_use]
        # A spread of the prior belongs to a problem of a single search, not to its options.
        kept = [{k: v for k, v in c.items() if choice not in variants.OFFLINE or k != "spread"}
                for c in choice.values.values()]  # fmt: skip
        configs = {variants.changed(choice.base, changes) for changes in kept}
        assert choice.base in configs and len(configs) == len({str(changes) for changes in kept})
    for choice in variants.REPLANNING:
        search = [variants.changed(choice.base, c).online.search for c in choice.values.values()]
        assert {s.population * s.iterations for s in search} == {variants.STEP_EVALUATIONS}
    with pytest.raises(AssertionError, match="no horizon"):
        variants.changed(variants.ONLINE, {"horizon": 1.0})


def test_the_settings_in_use_are_those_of_the_experiments():
    assert variants.ONLINE is clutter_2d_mpc.VPSTO and ReachConfig() == variants.REACH
    assert via_points.cases()[1][1].config == variants.TIME_OPTIMAL_LONG
    spread = next(c for c in variants.OFFLINE if c.name == "plain setting: spread of the prior [m]")
    assert spread.in_use == str(clutter_2d.SPREAD) and spread.base is clutter_2d.PLAIN
    assert problems.problems()["clutter_plain"].spread == clutter_2d.SPREAD


@pytest.fixture(scope="module")
def reserves():
    names = ("longest", "last", "none")
    tasks = {name: [deadline.DeadlineTask(name, seed) for seed in range(1000, 1004)] for name in names}
    return deadline.punctuality({name: list(map(deadline.run_task, row)) for name, row in tasks.items()})


def test_keeping_time_free_trades_iterations_for_punctuality(reserves):
    late = {name: row.late / row.searches for name, row in reserves.items()}
    done = {name: row.iterations for name, row in reserves.items()}
    assert late["longest"] <= late["last"] < late["none"] == 1.0
    assert done["longest"] <= done["last"] < done["none"]


def punctual(late, gaps):
    return deadline.Punctuality(400, late, 0.0, 30.0, sample(gaps))


def test_a_reserve_is_preferable_only_if_it_gives_up_nothing():
    choice = variants.RESERVES
    low, high = np.linspace(0.0, 0.1, 400), np.linspace(0.05, 0.15, 400)
    rows = {"longest": punctual(20, high), "none": punctual(400, low)}
    assert not deadline.preferable({**rows, "last": punctual(60, low)}, choice), "cheaper, but later"
    cheaper, earlier = punctual(22, low), punctual(2, high)
    assert deadline.preferable({**rows, "last": cheaper}, choice) == [f"{choice.name} = last"]
    assert deadline.preferable({**rows, "last": earlier}, choice) == [f"{choice.name} = last"]
    assert not deadline.preferable({**rows, "last": punctual(2, high + 0.05)}, choice), "earlier, but worse"
    values = {"longest": {"reserve": "longest"}, "none": {}}
    careless, rows = dataclasses.replace(choice, values=values), {**rows, "longest": punctual(20, low)}
    assert deadline.preferable(rows, careless) == [f"{choice.name} = longest"]


def test_measured_iterations_take_time():
    durations = deadline.measure(searches=2, iterations=5)
    assert durations.shape == (10,) and (durations > 0.0).all()
    assert len(deadline.LEVELS) == len(deadline.ITERATION_MS)
    assert sorted(deadline.ITERATION_MS) == list(deadline.ITERATION_MS)


@pytest.mark.parametrize(("used", "other", "verdict"), [(1.0, 1e-6, "passed"), (1e-6, 1.0, "FAILED")])
def test_the_experiment_runs_and_can_fail(tmp_path, monkeypatch, capsys, used, other, verdict):
    step_size = variants.Choice(
        "step size", {"its own": {}, "other": {"sigma": other}}, ("line",), VpstoConfig(sigma=used)
    )
    searches = choices.groups()[0]
    group = dataclasses.replace(searches, choices=(step_size,), warm_up=lambda: None)
    monkeypatch.setattr(choices, "groups", lambda: (group,))
    monkeypatch.setattr(deadline, "STEPS", 3)
    monkeypatch.setattr(problems, "warm_up", lambda: None)
    arguments = argparse.Namespace(
        runs=12, seed=1000, out=str(tmp_path), jobs=1, scheduler=None, resume=False
    )
    status = choices.run(arguments)
    last = capsys.readouterr().out.strip().splitlines()[-1]
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (tmp_path / "table.md").exists() and (tmp_path / "search.png").stat().st_size > 10_000
    assert len(summary["searches"]) == 2 and len(summary["deadline"]) == 3
    said = {
        "passed": "of no option is there a better value than the one in use",
        "FAILED": "better than the value in use: step size = other",
    }
    assert last == f"verdict: {verdict}: {said[verdict]}"
    assert status == (verdict == "FAILED")
    assert summary["better_than_in_use"] == (["step size = other"] if status else [])


def test_replanning_and_reaching_make_tasks_of_their_choices():
    for group in choices.groups():
        for choice in group.choices:
            tasks = [group.task(choice, c, choice.problems[0], 1000) for c in choice.values.values()]
            assert len(set(tasks)) == len(tasks), choice.name
            assert all(task.seed == 1000 for task in tasks) and set(choice.problems) <= set(group.titles)
