"""The experiment that backs the options of the search: its statistics, budgets and verdict."""

import argparse
import json
import math

import numpy as np
import pytest

from sim_bridge.experiments.search import choices, deadline, problems, variants
from sim_bridge.experiments.search.statistics import Sample, better, dominates, lower
from vpsto_ros.optimization.vpsto import VpstoConfig


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
        result = problems.run_task(
            problems.Task(name, "", variants.search_config(changes), 1000)
        )
        assert budget - 96 < result.evaluations <= budget


def test_every_option_is_compared_with_its_default():
    for choice in (*variants.OFFLINE, *variants.REPLANNING, variants.RESERVES):
        assert [not changes for changes in choice.values.values()].count(True) == 1
        assert len(choice.values) > 1
    for choice in variants.OFFLINE:
        configs = {variants.search_config(changes) for changes in choice.values.values()}
        assert len(configs) == len(choice.values) and VpstoConfig() in configs
    for choice in variants.REPLANNING:
        configs = [variants.online_config(changes) for changes in choice.values.values()]
        assert len(set(configs)) == len(configs) and variants.ONLINE in configs
        search = [config.online.search for config in configs]
        assert {s.population * s.iterations for s in search} == {variants.STEP_EVALUATIONS}


def test_keeping_time_free_trades_iterations_for_punctuality():
    rows = {
        name: deadline.run_task(deadline.DeadlineTask(name, 1000))
        for name in ("longest", "last", "none")
    }
    late = {name: float((row.overrun > 0).mean()) for name, row in rows.items()}
    done = {name: row.iterations.mean() for name, row in rows.items()}
    assert late["longest"] <= late["last"] < late["none"] and done["longest"] <= done["last"] < done["none"]


@pytest.mark.parametrize(("default", "other", "verdict"), [(1.0, 1e-6, "passed"), (1e-6, 1.0, "FAILED")])
def test_the_experiment_runs_and_can_fail(tmp_path, monkeypatch, capsys, default, other, verdict):
    monkeypatch.setattr(variants, "SEARCH", VpstoConfig(sigma=default))
    step_size = variants.Choice("step size", {"its own": {}, "other": {"sigma": other}}, ("line",))
    nothing = {("N_max", "5"): {"standing": sample(np.zeros(12))}}
    monkeypatch.setattr(choices, "OFFLINE", (step_size,))
    monkeypatch.setattr(choices, "REPLANNING", (variants.Choice("N_max", {"5": {}}),))
    monkeypatch.setattr(choices, "compare_replanning", lambda seeds, execution: nothing)
    monkeypatch.setattr(deadline, "STEPS", 3)
    arguments = argparse.Namespace(
        runs=12, seed=1000, out=str(tmp_path), jobs=1, scheduler=None, resume=False
    )
    status = choices.run(arguments)
    last = capsys.readouterr().out.strip().splitlines()[-1]
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (tmp_path / "table.md").exists() and (tmp_path / "search.png").stat().st_size > 10_000
    assert len(summary["searches"]) == 2 and len(summary["deadline"]) == 3
    assert last == f"verdict: {verdict}: no value is better than the default of its option"
    assert status == (verdict == "FAILED")
    assert summary["better_than_the_default"] == (["step size = other"] if status else [])
