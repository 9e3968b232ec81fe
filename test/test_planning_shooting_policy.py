"""The energy-based shooting policy: its energies, Algorithm 2, and its file."""

import dataclasses
import json

import numpy as np
import pytest

from vpsto_ros.contact.puck import SHIPPED, PuckModel
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.planning.hockey.shooting_config import SETTINGS, ShootingObjective
from vpsto_ros.planning.hockey.shooting_policy import (
    LAYERS,
    EnergyModel,
    PolicySamples,
    ShootingPolicy,
    save_policies,
)
from vpsto_ros.planning.hockey.strikes import StrikeTable

LOW = np.array([-0.7, -0.4, -1.0, -1.0, -1.2])
HIGH = np.array([-0.2, 0.4, 1.0, 1.0, 1.2])
MODEL, STRIKES = PuckModel.load(SHIPPED), StrikeTable.load()
STATE = np.array([-0.4, 0.1, 0.2, -0.3])


def random_model(harmonics=3, seed=0):
    model = EnergyModel.random(LOW, HIGH, harmonics, np.random.default_rng(seed))
    rng = np.random.default_rng(seed + 1)
    for name in ("first_bias", "second_bias"):
        model.weights[name] += rng.standard_normal(128).astype(np.float32)
    return model


def valleys(*places, depth=60.0):
    """Energy is the distance to the nearest of two places, or to one."""
    model = EnergyModel.random(LOW, HIGH, 0, np.random.default_rng(0))
    weights = {name: np.zeros_like(array) for name, array in model.weights.items()}
    c = [place / HIGH[4] for place in places]
    weights["first"][4, :2], weights["first_bias"][:2] = [1.0, -1.0], [-c[-1], c[0]]
    weights["second"][:2, :2], weights["last"][:2] = np.eye(2), depth
    if len(c) == 2:  # a roof between them
        middle, half = 0.5 * (c[0] + c[1]), 0.5 * (c[1] - c[0])
        weights["first"][4, 2:4], weights["first_bias"][2:4] = [1.0, -1.0], [-middle, middle]
        weights["second"][2:4, 2], weights["second_bias"][2] = -1.0, half
        weights["last"][2] = depth
    return dataclasses.replace(model, weights=weights)


def test_energies_are_those_of_the_perceptron():
    model, angles = random_model(), np.linspace(-1.2, 1.2, 7)
    w = {name: array.astype(float) for name, array in model.weights.items()}
    for angle, energy in zip(angles, model.energies(STATE, angles), strict=True):
        scaled = 2.0 * (np.append(STATE, angle) - LOW) / (HIGH - LOW) - 1.0
        waves = np.pi * scaled[4] * np.arange(1, 4)
        inputs = np.concatenate([scaled, np.sin(waves), np.cos(waves)])
        hidden = np.maximum(inputs @ w["first"] + w["first_bias"], 0.0)
        hidden = np.maximum(hidden @ w["second"] + w["second_bias"], 0.0)
        assert energy == pytest.approx(hidden @ w["last"], abs=1e-4)


def test_inference_finds_the_least_energy():
    for place in (-1.0, -0.3, 0.0, 0.7, 1.15):
        angle, _ = ShootingPolicy(valleys(place)).solve(STATE, 25, np.random.default_rng(0))
        assert angle == pytest.approx(place, abs=0.01)


def test_inference_finds_the_least_energy_of_a_rugged_landscape():
    model, dense = random_model(8), np.linspace(-1.2, 1.2, 5001)
    energies = model.energies(STATE, dense)
    for seed in range(10):
        angle, _ = ShootingPolicy(model).solve(STATE, 25, np.random.default_rng(seed))
        found = model.energies(STATE, np.array([angle]))[0]
        assert found <= np.quantile(energies, 0.01)


def test_both_valleys_are_kept_while_the_samples_are_wide():
    rng, policy = np.random.default_rng(0), ShootingPolicy(valleys(-0.6, 0.6, depth=30.0), samples=256)
    _, samples = policy.solve(STATE, 4, rng)
    near = [(np.abs(samples.angles - place) < 0.25).mean() for place in (-0.6, 0.6)]
    assert min(near) > 0.15 and sum(near) > 0.9


def test_a_step_is_that_of_algorithm_2():
    """Resampled by their probabilities, moved by noise, clipped, weighed anew; the scale shrinks."""
    policy, rng = ShootingPolicy(valleys(0.3), samples=4000, std=0.05), np.random.default_rng(0)
    before = PolicySamples(np.array([-1.2, 0.2, 1.2]), np.array([0.0, 0.25, 0.75]), 0.05)
    angle, after = policy.infer(STATE, before, rng)
    low, high = after.angles < 0.7, after.angles > 0.7
    assert low.mean() == pytest.approx(0.25, abs=0.03) and (after.angles > -1.0).all()
    assert after.angles[low].mean() == pytest.approx(0.2, abs=0.01)
    assert after.angles[low].std() == pytest.approx(0.05, rel=0.1)
    assert after.angles.max() == 1.2 and (after.angles[high] == 1.2).mean() == pytest.approx(0.5, abs=0.05)
    energies = policy.energy.energies(STATE, after.angles).astype(float)
    weights = np.exp(-energies)
    np.testing.assert_allclose(after.probabilities, weights / weights.sum(), rtol=1e-4, atol=1e-12)
    assert angle == after.angles[np.argmax(after.probabilities)]
    assert after.std == pytest.approx(0.8 * 0.05)


def test_the_scale_shrinks_to_what_follows_a_moving_puck():
    policy, rng = ShootingPolicy(valleys(0.3)), np.random.default_rng(0)
    angle, samples = policy.solve(STATE, 60, rng)
    assert samples.std == policy.least_std
    moved = ShootingPolicy(valleys(0.34))
    for _ in range(20):
        angle, samples = moved.infer(STATE, samples, rng)
    assert angle == pytest.approx(0.34, abs=0.01)


def test_samples_depend_on_the_generator_alone():
    policy = ShootingPolicy(random_model())
    first, second = (policy.solve(STATE, 5, np.random.default_rng(7))[0] for _ in range(2))
    assert first == second


def test_states_out_of_range_are_taken_as_the_nearest():
    policy = ShootingPolicy(random_model())
    far, near = np.array([5.0, 0.1, 9.0, -0.3]), np.array([-0.2, 0.1, 1.0, -0.3])
    angles = [policy.solve(state, 5, np.random.default_rng(7))[0] for state in (far, near)]
    assert angles[0] == angles[1]


@pytest.mark.parametrize("state", [[0.0, 0.0, np.nan, 0.0], [0.0, 0.0, 0.0], [[0.0] * 4]])
def test_states_that_are_none_are_refused(state):
    with pytest.raises(InvalidInputError, match="four finite numbers"):
        ShootingPolicy(random_model()).infer(state, None, np.random.default_rng(0))


def test_nonsense_is_refused():
    with pytest.raises(InvalidInputError, match="two samples"):
        ShootingPolicy(random_model(), samples=1)
    with pytest.raises(InvalidInputError, match="positive deviations"):
        ShootingPolicy(random_model(), std=0.0)
    with pytest.raises(InvalidInputError, match="range is empty"):
        dataclasses.replace(random_model(), high=LOW)


# Files.


def saved(path, models=None, **figures):
    models = models or {"conservative": random_model(), "aggressive": random_model(seed=5)}
    figures = {name: {"epochs": 3, **figures} for name in models}
    save_policies(path, models, figures, MODEL, STRIKES, command="made", seed=4)
    return path


def loaded(setting, path, model=MODEL, strikes=STRIKES):
    return ShootingPolicy.load(setting, model, strikes, path)


def test_a_file_gives_back_what_was_saved(tmp_path):
    path = saved(tmp_path / "policies.npz", training_s=2.5)
    for name, seed in (("conservative", 0), ("aggressive", 5)):
        policy, model = loaded(name, path), random_model(seed=seed)
        for layer in LAYERS:
            np.testing.assert_array_equal(policy.energy.weights[layer], model.weights[layer])
        np.testing.assert_array_equal(policy.energy.low, LOW)
        assert policy.origin["command"] == "made" and policy.origin["seed"] == 4
        figures = {"epochs": 3, "training_s": 2.5, "objective": dataclasses.asdict(SETTINGS[name])}
        assert policy.origin["settings"] == {name: figures}


def altered(path, **changes):
    """The same file with other arrays, None for none."""
    with np.load(path) as file:
        content = dict(file)
    for name, array in changes.items():
        name = name.replace("__", ".")
        content.pop(name)
        if array is not None:
            content[name] = array
    np.savez(path, **content)


def test_files_that_are_no_policies_say_what_to_do(tmp_path):
    remedy = "vpsto learn shooting_policy"
    with pytest.raises(ConfigurationError, match=f"there are no shooting policies.*{remedy}"):
        loaded("balanced", tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("no policy")
    (tmp_path / "empty.npz").write_bytes(b"")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    np.save(tmp_path / "array.npz.npy", np.zeros(3))
    for name in ("text.npz", "empty.npz", "other.npz", "array.npz.npy"):
        with pytest.raises(ConfigurationError, match=f"holds no shooting policies.*{remedy}"):
            loaded("balanced", tmp_path / name)
    path = saved(tmp_path / "policies.npz")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ConfigurationError, match=remedy):
        loaded("conservative", path)


def test_files_with_wrong_contents_are_refused(tmp_path):
    path = tmp_path / "policies.npz"
    with pytest.raises(ConfigurationError, match="no policy for the setting 'bold'; it has conservative"):
        loaded("bold", saved(path))
    with pytest.raises(ConfigurationError, match="not trained"):
        loaded("conservative", saved(path, epochs=0))
    for change in (
        {"conservative__second": np.zeros((128, 127))},
        {"conservative__last": np.full(128, np.nan)},
        {"conservative__low": np.zeros(4)},
        {"conservative__low": HIGH + 1.0},
        {"conservative__first": None},
        {"conservative__first": np.zeros(())},
    ):
        altered(saved(path), **change)
        with pytest.raises(ConfigurationError, match="no usable policy 'conservative'"):
            loaded("conservative", path)
        loaded("aggressive", path)
    altered(saved(path), header=np.array(json.dumps({"format": "another", "settings": {}})))
    with pytest.raises(ConfigurationError, match="not of the format"):
        loaded("conservative", path)


def test_a_policy_of_another_objective_is_refused(tmp_path, monkeypatch):
    path, wanted = saved(tmp_path / "policies.npz"), SETTINGS["aggressive"]
    for change in ({"lambda1": 0.5}, {"lambda2": 2.0}, {"beta": 0.71}, {"least_banks": 1}):
        monkeypatch.setitem(SETTINGS, "aggressive", dataclasses.replace(wanted, **change))
        (name,) = change
        with pytest.raises(ConfigurationError, match=f"objective.*{name}.*vpsto learn shooting_policy"):
            loaded("aggressive", path)
        loaded("conservative", path)
    monkeypatch.setitem(SETTINGS, "aggressive", wanted)
    loaded("aggressive", path)


def test_a_policy_of_another_puck_or_arm_is_refused(tmp_path):
    path = saved(tmp_path / "policies.npz")
    wall = dataclasses.replace(MODEL.wall, matrix=MODEL.wall.matrix * [[1.0], [0.999]])
    table = dataclasses.replace(MODEL.table, goal_width=0.26)
    for change in ({"wall": wall}, {"table": table}, {"hit_delay": 0.5 * MODEL.hit_delay}):
        with pytest.raises(ConfigurationError, match=r"another model of the puck;.*vpsto learn shooting"):
            loaded("aggressive", path, model=dataclasses.replace(MODEL, **change))
    for change in ({"speed": 0.99 * STRIKES.speed}, {"x": STRIKES.x + 0.01}, {"contact_distance": 0.08}):
        with pytest.raises(ConfigurationError, match=r"other strikes of the arm;.*vpsto learn shooting"):
            loaded("aggressive", path, strikes=dataclasses.replace(STRIKES, **change))


def test_fingerprints_outlast_files(tmp_path):
    MODEL.save(tmp_path / "puck.json")
    STRIKES.save(tmp_path / "strikes.npz")
    again = PuckModel.load(tmp_path / "puck.json"), StrikeTable.load(tmp_path / "strikes.npz")
    assert [each.fingerprint for each in again] == [MODEL.fingerprint, STRIKES.fingerprint]
    loaded("aggressive", saved(tmp_path / "policies.npz"), *again)


def test_the_policies_that_come_with_the_package_fit_its_strikes():
    strikes = StrikeTable.load()
    for setting, objective in SETTINGS.items():
        policy = ShootingPolicy.load(setting, PuckModel.load(SHIPPED), strikes)
        assert ShootingObjective(**policy.origin["settings"][setting]["objective"]) == objective
        assert policy.origin["command"].startswith("vpsto learn shooting_policy --states")
        assert policy.origin["seed"] == 0
        low, high = policy.energy.low, policy.energy.high
        for entry, grid in ((0, strikes.x), (1, strikes.y), (4, strikes.angle)):
            assert low[entry] == pytest.approx(grid[0]) and high[entry] == pytest.approx(grid[-1])
        assert policy.origin["settings"][setting]["objective_ratio"] > 0.9
