"""Shots of the simulated arm, calibration of predicted goals, and the model against its own trajectories."""

import json

import numpy as np
import pytest

from sim_bridge import cli
from sim_bridge.experiments.hockey import goal_monte_carlo, goal_probability
from sim_bridge.experiments.hockey.goal_shots import ANGLES, LATEST, Shot, aim, fan, shoot
from sim_bridge.hockey.recordings import TABLE
from sim_bridge.hockey.world import AirHockeyWorld
from vpsto_ros.contact.puck import SHIPPED, PuckModel


@pytest.fixture(scope="module")
def model():
    return PuckModel.load(SHIPPED)


@pytest.fixture(scope="module")
def shots(model):
    world, rng = AirHockeyWorld(), np.random.default_rng(1000)
    found = [shoot(world, model, rng) for _ in range(60)]
    return [shot for shot in found if shot is not None]


def invented(predicted, scored, banks=0):
    puck = np.zeros(4)
    return [
        Shot(puck, puck, float(p), banks, float(p), banks, bool(s))
        for p, s in zip(predicted, scored, strict=True)
    ]


# Shots.


def test_aim_takes_a_fitting_angle(model):
    kinds = []
    for seed in range(30):
        strike = aim(model, np.random.default_rng(seed))
        if strike is None:
            continue
        outlook = fan(model, np.append(strike.place, strike.puck_velocity), strike.speed)
        index = int(np.argmin(np.abs(ANGLES - strike.angle)))
        assert strike.aside == 0.0 and outlook.time[index] <= LATEST
        kinds.append(outlook.banks[index] == 0)
    assert 0.2 < np.mean(kinds) < 0.8, "direct and bank shots"


def test_shots_are_struck_from_behind_and_end_in_the_goal_or_not(shots):
    assert len(shots) > 10 and {shot.scored for shot in shots} == {True, False}
    for shot in shots:
        apart = np.linalg.norm(shot.puck[:2] - shot.mallet[:2])
        assert apart == pytest.approx(TABLE.contact_distance, abs=2e-3), "at their touch"
        assert (shot.puck[:2] - shot.mallet[:2]) @ (shot.mallet[2:] - shot.puck[2:]) > 0.0, "closing in"
    safe = [shot.scored for shot in shots if shot.predicted > 0.9]
    hopeless = [shot.scored for shot in shots if shot.predicted < 0.1]
    assert np.mean(safe) > 0.7 and np.mean(hopeless) < 0.3


def test_a_shot_depends_on_its_seed_alone(model):
    first, second = (
        [shoot(AirHockeyWorld(), model, np.random.default_rng(seed)) for seed in range(4)] for _ in range(2)
    )
    for one, other in zip(first, second, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            np.testing.assert_array_equal(one.puck, other.puck)
            assert (one.predicted, one.scored) == (other.predicted, other.scored)


# Calibration.


def test_right_probabilities_are_found_right_and_wrong_ones_wrong():
    rng = np.random.default_rng(0)
    chances = rng.uniform(0.0, 1.0, 6000)
    scored = rng.random(6000) < chances
    monte_carlo = {"monte_carlo_gap": 0.01}
    for distorted, good in ((chances, True), (np.sqrt(chances), False), (1.0 - chances, False)):
        found = [*invented(distorted[::2], scored[::2]), *invented(distorted[1::2], scored[1::2], 1)]
        summary = {**goal_probability.summarise(found), **monte_carlo}
        assert (goal_probability.missed_targets(summary) == []) == good
        assert summary["shots"] == 6000 and summary["direct"]["shots"] == summary["bank"]["shots"] == 3000
        assert sum(row["shots"] for row in summary["bins"]) == 6000
        assert (summary["worst_gap"] < 0.06) == good


def test_bins_with_few_shots_do_not_count_but_there_must_be_others():
    few = invented([0.5] * 29, [False] * 29)
    part = goal_probability.calibration(few)
    assert part["worst_gap"] == 0.0 and part["bins"][0]["shots"] == 29
    summary = {**goal_probability.summarise(few), "monte_carlo_gap": 0.0}
    assert len(goal_probability.missed_targets(summary)) == 3, "too few of all, direct and bank shots"
    enough = invented([0.5] * 40, [False] * 40)
    enough += invented([0.99] * 40, [True] * 40, 1)
    summary = {**goal_probability.summarise(enough), "monte_carlo_gap": 0.0}
    assert len(goal_probability.missed_targets(summary)) == 2, "all and direct ones"


def test_a_gap_to_the_models_own_trajectories_is_a_miss():
    shots = [*invented([0.995] * 50, [True] * 50), *invented([0.995] * 50, [True] * 50, 1)]
    summary = {**goal_probability.summarise(shots), "monte_carlo_gap": 0.05}
    assert len(goal_probability.missed_targets(summary)) == 1


# Against the model's own trajectories.


def test_the_mass_agrees_with_trajectories(model, monkeypatch):
    monkeypatch.setattr(goal_monte_carlo, "SHOTS", 6)
    found = goal_monte_carlo.compare(model, np.random.default_rng(3))
    assert {each.banks for each in found} == {0, 1, 2} and len(found) == 18
    assert goal_monte_carlo.largest_gap(found) < 0.03
    assert max(abs(each.mass - each.sampled) for each in found) < 0.05
    assert all(0.1 <= each.mass <= 0.9 for each in found)


def test_without_turned_normals_the_mass_would_not_agree(model, monkeypatch):
    """What is not known of the puck before the hit is most of a direct shot's scatter."""
    monkeypatch.setattr(goal_monte_carlo, "SHOTS", 6)
    found = [each for each in goal_monte_carlo.compare(model, np.random.default_rng(3)) if each.banks == 0]
    shots = model.shots

    def blind(self, puck, _spread, mallet, **options):
        return shots(puck, 1e-9 * np.eye(4), mallet, **options)

    monkeypatch.setattr(PuckModel, "shots", blind)
    wrong = [each for each in goal_monte_carlo.compare(model, np.random.default_rng(3)) if each.banks == 0]
    gaps = [np.mean([abs(each.mass - each.simulated) for each in part]) for part in (found, wrong)]
    assert gaps[1] > 3.0 * gaps[0]


# The command.


def test_experiment_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(goal_monte_carlo, "SHOTS", 2)
    monkeypatch.setattr(goal_probability, "TRIES", 12)
    arguments = ["--runs", "1", "--seed", "1000", "--jobs", "1", "--out", str(tmp_path)]
    assert cli.main(["experiment", "goal_probability", *arguments]) in (0, 1)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert {"bins", "worst_gap", "shots", "monte_carlo_gap", "direct", "bank"} <= set(summary)
    assert summary["shots"] + summary["left_out"] == 12
    assert (tmp_path / "goal_probability.png").stat().st_size > 10_000
    assert "| predicted" in (tmp_path / "table.md").read_text()
    assert "verdict:" in capsys.readouterr().out
