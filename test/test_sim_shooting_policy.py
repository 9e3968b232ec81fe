"""The command that trains the shooting policies, and the experiment that compares them with direct search."""

import dataclasses
import json

import numpy as np
import pytest

from sim_bridge import cli
from sim_bridge.experiments.hockey import shooting_policy as experiment
from sim_bridge.learn.shooting_comparison import STEPS, compare, shot_at
from sim_bridge.learn.shooting_policy import input_range, learn
from vpsto_ros.planning.hockey.shooting_config import SETTINGS
from vpsto_ros.planning.hockey.shooting_policy import EnergyModel, ShootingPolicy, save_policies
from vpsto_ros.planning.hockey.shooting_training import TrainingConfig, states

CONFIG = TrainingConfig(states=60, actions=30, epochs=2, batch=20, negatives=8)


@pytest.fixture(scope="module")
def untrained():
    """Policies of weights that nobody has trained."""
    ends = input_range(experiment.searcher("balanced"), CONFIG)
    return EnergyModel.random(*ends, 4, np.random.default_rng(0))


def test_learning_begins_with_examples_and_ends_with_figures():
    search = experiment.searcher("balanced")
    model, figures = learn("balanced", search, CONFIG, np.random.default_rng(1000))
    assert figures["epochs"] == 2 and 40 <= figures["states"] <= 60 and figures["training_s"] >= 0.0
    assert figures["last_loss"] < figures["first_loss"] and 0.0 <= figures["objective_ratio"] <= 1.05
    assert model.low[4] == search.strikes.angle[0] and model.high[3] == CONFIG.fastest


def test_learn_command(tmp_path, capsys):
    path = tmp_path / "new" / "policy.npz"
    arguments = ["--states", "50", "--epochs", "2", "--seed", "1000", "--out", str(path)]
    status = cli.main(["learn", "shooting_policy", *arguments])
    text = capsys.readouterr().out
    assert status == (0 if "verdict: passed" in text else 1) and f"wrote {path}" in text
    for setting in SETTINGS:
        policy = ShootingPolicy.load(setting, *experiment.models(), path)
        assert policy.origin["command"] == "vpsto learn shooting_policy --states 50 --epochs 2 --seed 1000"
        assert policy.origin["settings"][setting]["epochs"] == 2


def test_a_missing_model_is_a_message(tmp_path, capsys):
    for name, remedy in (("model", "vpsto learn puck_model"), ("strikes", "vpsto learn strikes")):
        missing = [f"--{name}", str(tmp_path / "none"), "--out", str(tmp_path / "a")]
        assert cli.main(["learn", "shooting_policy", *missing]) == 1
        assert remedy in capsys.readouterr().err
    arguments = ["--policies", str(tmp_path / "none.npz"), "--out", str(tmp_path / "out")]
    assert cli.main(["experiment", "shooting_policy", *arguments]) == 1
    assert "vpsto learn shooting_policy" in capsys.readouterr().err


def test_a_comparison_judges_the_angle_of_the_policy(untrained):
    search, rng = experiment.searcher("conservative"), np.random.default_rng(1000)
    ratios = []
    for state in states(search, 12, 0.5, rng):
        found = compare(search, ShootingPolicy(untrained), state, CONFIG.covariance, rng)
        assert found.inference_s.shape == (STEPS,) and (found.inference_s > 0.0).all()
        assert found.direct is not None and found.direct.goal > 0.5
        if found.policy is None or found.policy.goal <= 0.5:
            assert found.ratio == 0.0
        else:
            assert found.ratio == pytest.approx(found.policy.value / found.direct.value)
        same = shot_at(search, state, CONFIG.covariance, found.direct.angle)
        assert same.value <= found.direct.value + 1e-9
        ratios.append(found.ratio)
    assert np.mean(ratios) < 0.8, "nobody has trained it"


def test_a_perfect_policy_has_the_ratio_of_one(untrained):
    search, rng = experiment.searcher("conservative"), np.random.default_rng(1000)
    (state,) = states(search, 1, 0.0, rng)
    best = search.best(0.0, state, CONFIG.covariance)
    weights = {name: np.zeros_like(array) for name, array in untrained.weights.items()}
    low, high = untrained.low[4], untrained.high[4]
    scaled = (2.0 * best.angle - low - high) / (high - low)
    weights["first"][4, :2], weights["first_bias"][:2] = [1.0, -1.0], [-scaled, scaled]
    weights["second"][:2, 0], weights["last"][0] = 1.0, 60.0
    policy = ShootingPolicy(dataclasses.replace(untrained, weights=weights))
    assert compare(search, policy, state, CONFIG.covariance, rng).ratio == pytest.approx(1.0, abs=0.02)


def summary(**changes):
    row = {"objective_ratio": 0.97}
    good = {
        "inference_ms_p50": 0.1, "direct_search_ms_p50": 0.5,
        "settings": {setting: dict(row) for setting in SETTINGS},
    }  # fmt: skip
    return {**good, **changes}


def test_every_target_can_be_missed():
    assert experiment.missed_targets(summary()) == []
    assert "inference" in experiment.missed_targets(summary(inference_ms_p50=1.5))[0]
    assert "direct search" in experiment.missed_targets(summary(direct_search_ms_p50=1.5))[0]
    for setting in SETTINGS:
        poor = summary()
        poor["settings"][setting]["objective_ratio"] = 0.9
        (text,) = experiment.missed_targets(poor)
        assert setting in text and "0.900" in text


def test_the_pucks_of_a_run_depend_on_its_seed_alone():
    first, again, other = (experiment.trial((seed, str(experiment.SHIPPED))) for seed in (1000, 1000, 1001))
    for setting in SETTINGS:
        for a, b, c in zip(first[setting], again[setting], other[setting], strict=True):
            np.testing.assert_array_equal(a.state, b.state)
            assert a.policy is None or a.policy.angle == b.policy.angle
            assert not np.array_equal(a.state, c.state)


def test_experiment_command(tmp_path, untrained):
    path = tmp_path / "policies.npz"
    figures = {setting: {"epochs": 1, "training_s": 2.0} for setting in SETTINGS}
    model, strikes = experiment.models()
    energies = dict.fromkeys(SETTINGS, untrained)
    save_policies(path, energies, figures, model, strikes, command="test", seed=0)
    out = tmp_path / "out"
    arguments = ["--runs", "2", "--seed", "1000", "--jobs", "1", "--policies", str(path), "--out", str(out)]
    assert cli.main(["experiment", "shooting_policy", *arguments]) == 1
    found = json.loads((out / "summary.json").read_text())
    assert found["pucks"] == 3 * 2 * experiment.PUCKS and found["training_s"] == 6.0
    for setting in SETTINGS:
        row = found["settings"][setting]
        low, high = row["objective_ratio_interval"]
        assert low <= row["objective_ratio"] <= high and row["objective_ratio"] < 0.9
        assert row["direct"]["goal"] > 0.5 and row["solved"] <= row["pucks"] == 2 * experiment.PUCKS
    assert (out / "shooting_policy.png").stat().st_size > 30_000
    assert "| aggressive" in (out / "table.md").read_text()
