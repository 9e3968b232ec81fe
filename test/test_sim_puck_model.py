"""Recordings of the air-hockey world, the model learned from them, and how well it predicts."""

import json

import numpy as np
import pytest

from sim_bridge import cli
from sim_bridge.experiments.hockey import puck_model
from sim_bridge.experiments.hockey.predictions import HORIZONS, Prediction, predictions
from sim_bridge.hockey import table
from sim_bridge.hockey.recordings import (
    CONTACT_TIME,
    TABLE,
    Recorder,
    Strike,
    kind_of,
    strike_command,
)
from sim_bridge.hockey.scene import START_JOINTS
from sim_bridge.learn.puck_model import learn, record
from vpsto_ros.contact.puck import MODES, SHIPPED, PuckModel
from vpsto_ros.contact.puck_learning import FLOATING, MALLET, WALL, label, step_distances
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.iiwa import iiwa14


@pytest.fixture(scope="module")
def recorder():
    return Recorder()


@pytest.fixture(scope="module")
def episodes(recorder):
    return [recorder.episode(kind_of(k), (0, k)) for k in range(60)]


@pytest.fixture(scope="module")
def steps():
    return record(range(120), 3)


@pytest.fixture(scope="module")
def shipped():
    return PuckModel.load(SHIPPED)


# Recordings.


def mallet_contacts(episode):
    return [contact for contact in episode.contacts if contact.surface == "mallet"]


def test_recordings_are_in_the_table_frame_and_on_the_table(episodes):
    for episode in episodes:
        puck, mallet = episode.recording.puck, episode.recording.mallet
        assert puck.shape == mallet.shape == (51, 4) and episode.tilt.shape == (51, 2)
        on_field = np.abs(puck[:, :2]) <= TABLE.reach + 3e-3
        assert on_field[:, 1].all() and on_field[0].all()
        # Velocities are those of the places, wherever nothing is touched.
        floating = label(episode.recording, TABLE, CONTACT_TIME) == FLOATING
        mean = 0.5 * 0.02 * (puck[1:, 2:] + puck[:-1, 2:])
        np.testing.assert_allclose((puck[1:, :2] - puck[:-1, :2])[floating], mean[floating], atol=2e-5)


def test_half_of_the_pucks_are_free_and_the_others_are_struck(episodes):
    for kind in ("free", "struck"):
        touched = [bool(mallet_contacts(e)) for e in episodes if e.kind == kind]
        assert len(touched) == 30 and (np.mean(touched) > 0.85) == (kind == "struck")
    hits = [mallet_contacts(e)[0] for e in episodes if mallet_contacts(e)]
    speeds = [np.linalg.norm(hit.mallet.velocity[:2]) for hit in hits]
    angles = [np.arctan2(*hit.mallet.velocity[1::-1]) for hit in hits]
    assert np.quantile(speeds, 0.1) < 0.5 and np.quantile(speeds, 0.9) > 0.8
    assert np.quantile(angles, 0.1) < -0.6 and np.quantile(angles, 0.9) > 0.6
    assert max(hit.duration for hit in hits) < CONTACT_TIME
    assert max(np.abs(e.tilt).max() for e in episodes if e.kind == "struck") > 0.02, "the mallet swings"


def test_the_arm_keeps_its_limits_and_its_height(recorder, episodes):
    kept = Recorder()
    for episode in range(5):
        kept.episode("struck", (0, 2 * episode + 1))
    report = kept.world.limits.report()
    assert all(report[kind].instants == 0 for kind in ("reference_velocity", "joint_velocity", "torque"))
    assert recorder.world.height_deviation < 2e-3


def test_an_episode_depends_on_its_seed_alone(recorder, episodes):
    for k in (0, 1):
        again = recorder.episode(kind_of(k), (0, k))
        np.testing.assert_allclose(again.recording.puck, episodes[k].recording.puck, atol=1e-9)
    with pytest.raises(InvalidInputError, match="kind"):
        recorder.episode("thrown", (0, 0))
    with pytest.raises(InvalidInputError, match="steps >= 1"):
        recorder.episode("free", (0, 0), steps=0)


def test_a_strike_passes_the_puck_as_meant():
    strike = Strike(np.array([-0.45, 0.1]), 0.4, 0.6, 0.25, 0.5, 0.03, np.array([0.1, -0.1]))
    when = strike.phase * strike.duration
    places, rates = strike.motion(np.array([0.0, when, strike.duration]))
    np.testing.assert_allclose(np.linalg.norm(strike.place - places[1]), TABLE.contact_distance)
    np.testing.assert_allclose(rates[[0, 2]], 0.0, atol=1e-12)
    np.testing.assert_allclose(rates[1], 0.6 * strike.direction)
    np.testing.assert_allclose(strike.puck_start() + when * strike.puck_velocity, strike.place)
    command = strike_command(strike, iiwa14())
    height = iiwa14().forward(START_JOINTS)[0][2]
    reached = [iiwa14().forward(q)[0] for q in command.positions]
    wanted = table.to_base(strike.motion(command.time_from_start)[0])
    np.testing.assert_allclose(reached, np.column_stack([wanted, np.full(len(wanted), height)]), atol=1e-6)


def test_labels_agree_with_what_was_really_touched(episodes):
    """No step without a contact is taken for one, or the other way round."""
    counts = np.zeros(3, dtype=int)
    for episode in episodes:
        modes = label(episode.recording, TABLE, CONTACT_TIME)
        for k, mode in enumerate(modes):
            begin = episode.start + 0.02 * k
            met = [
                c.surface for c in episode.contacts if c.start < begin + 0.0195 and c.end > begin + 0.0005
            ]
            if mode == FLOATING:
                assert not met
            elif mode == WALL:
                assert len(met) == 1 and met != ["mallet"]
            elif mode == MALLET:
                assert met == ["mallet"]
            counts[mode] += mode >= 0
    assert counts.min() >= 15


# Learning.


def test_the_learned_model_is_what_the_table_was_measured_to_do(steps):
    model, factors = learn(steps)
    np.testing.assert_allclose(model.floating.matrix, np.exp(-0.5 * 0.02) * np.eye(2), atol=1e-4)
    assert 0.65 < -model.wall.matrix[0, 0] < 0.85 and 0.8 < model.wall.matrix[1, 1] < 0.9
    assert 1.3 < model.mallet.matrix[0, 2] < 1.55 and -0.55 < model.mallet.matrix[0, 0] < -0.3
    assert 0.003 < model.hit_delay < 0.009, "hits last 18 ms"
    assert min(factors.values()) >= 1.0 and max(factors.values()) < 2.5


def test_a_widened_model_holds_for_steps_that_it_has_not_seen(steps):
    distances = step_distances(record(range(160), 4), learn(steps)[0])
    for mode in (WALL, MALLET):
        assert len(distances[mode]) > 60, "so that one more or less outside is no matter"
        assert np.mean(distances[mode] < puck_model.ellipse(95)) > 0.85


def test_learn_command(tmp_path, capsys):
    path = tmp_path / "new" / "puck.json"
    assert cli.main(["learn", "puck_model", "--episodes", "70", "--seed", "5", "--out", str(path)]) == 0
    text = capsys.readouterr().out
    assert f"wrote {path}" in text and "verdict: passed: learned from" in text
    origin = json.loads(path.read_text())["origin"]
    assert origin["command"] == "vpsto learn puck_model --episodes 70 --seed 5"
    assert sum(origin["steps"].values()) == 70 * 50 and set(origin["widened"]) == set(MODES)
    assert PuckModel.load(path).table == TABLE


def test_too_few_episodes_are_said_to_be_too_few(tmp_path, capsys):
    assert cli.main(["learn", "puck_model", "--episodes", "30", "--out", str(tmp_path / "a.json")]) == 1
    assert "FAILED: only" in capsys.readouterr().out
    assert cli.main(["learn", "puck_model", "--episodes", "2", "--out", str(tmp_path / "b.json")]) == 1
    assert "cannot be learned from" in capsys.readouterr().err


def test_the_model_that_comes_with_the_package_is_of_this_world(shipped, steps):
    origin = json.loads(SHIPPED.read_text())["origin"]
    assert origin["command"].startswith("vpsto learn puck_model --episodes") and origin["seed"] == 0
    assert shipped.table == TABLE and shipped.period == 0.02
    distances = step_distances(steps, shipped)
    for mode in (WALL, MALLET):
        assert np.mean(distances[mode] < puck_model.ellipse(90)) > 0.85


# The experiment.


def test_predictions_begin_and_end_where_the_puck_was(episodes, shipped):
    found = [(episode, p) for episode in episodes for p in predictions(episode, shipped)]
    assert {p.horizon for _, p in found} == set(HORIZONS) and {"wall", "hit"} <= {p.kind for _, p in found}
    for episode, p in found:
        puck = episode.recording.puck[:, :2]
        assert np.linalg.norm(puck - p.truth, axis=1).min() == 0.0
        assert np.linalg.eigvalsh(p.covariance)[0] > 0.0
        if p.kind == "floating":
            assert p.error < 1e-3
    assert np.median([p.error for _, p in found if p.kind == "hit" and p.horizon == 0.1]) < 5e-3


def test_a_calibrated_model_is_found_calibrated():
    rng = np.random.default_rng(0)
    covariance = np.array([[4e-4, 1e-4], [1e-4, 2e-4]])
    for scale, good in ((1.0, True), (2.0, False), (0.3, False)):
        offs = rng.multivariate_normal(np.zeros(2), scale**2 * covariance, 3000)
        found = [
            Prediction(kind, 0.2, np.zeros(2), np.ones(2), covariance, np.ones(2) + off)
            for kind, off in zip(["wall", "hit", "hit_wall"] * 1000, offs, strict=True)
        ]
        summary = puck_model.summarise(found)
        assert (puck_model.missed_targets(summary) == []) == good
        if good:
            for level in puck_model.LEVELS:
                assert summary[f"coverage_{level}"] == pytest.approx(0.01 * level, abs=0.03)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("coverage_50", 0.4), ("coverage_50", 0.9), ("coverage_90", 0.8), ("coverage_90", 0.98),
        ("coverage_99", 0.96), ("least_coverage_90", 0.7), ("floating_error", 2e-3),
    ],
)  # fmt: skip
def test_every_target_of_the_puck_model_can_be_missed(name, value):
    good = {
        "coverage_50": 0.6, "coverage_90": 0.92, "coverage_99": 0.98, "least_coverage_90": 0.85,
        "floating_error": 1e-4,
    }  # fmt: skip
    assert puck_model.missed_targets(good) == []
    assert len(puck_model.missed_targets({**good, name: value})) == 1


def test_experiment_command(tmp_path):
    arguments = ["--runs", "6", "--seed", "1000", "--jobs", "1", "--out", str(tmp_path)]
    assert cli.main(["experiment", "puck_model", *arguments]) in (0, 1)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert {"coverage_50", "coverage_90", "coverage_99"} <= set(summary)
    assert summary["kinds"]["wall"]["predictions"] > 5 and summary["kinds"]["hit"]["predictions"] > 5
    assert (tmp_path / "puck_model.png").stat().st_size > 10_000
    assert "| wall" in (tmp_path / "table.md").read_text()


def test_a_missing_model_is_a_message(tmp_path, capsys):
    arguments = ["--model", str(tmp_path / "none.json"), "--out", str(tmp_path)]
    assert cli.main(["experiment", "puck_model", *arguments]) == 1
    assert "vpsto learn puck_model" in capsys.readouterr().err
