"""Training of the shooting policy: examples, the InfoNCE loss and its gradients, and that it learns."""

import dataclasses

import numpy as np
import pytest
from strikes_bench import StandInStrikes

from vpsto_ros.contact.puck import SHIPPED, PuckModel
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.planning.hockey.shooting_config import SETTINGS, ShootingConfig
from vpsto_ros.planning.hockey.shooting_policy import EnergyModel, ShootingPolicy
from vpsto_ros.planning.hockey.shooting_search import ShotSearch
from vpsto_ros.planning.hockey.shooting_training import (
    Examples,
    TrainingConfig,
    examples,
    loss_and_gradients,
    score,
    states,
    train,
)

MODEL = PuckModel.load(SHIPPED)
LOW, HIGH = np.array([-0.7, -0.4, -1.0, -1.0, -1.2]), np.array([-0.2, 0.4, 1.0, 1.0, 1.2])


def search(setting="balanced", **options):
    return ShotSearch(MODEL, StandInStrikes(), ShootingConfig(objective=SETTINGS[setting], **options))


def problem(seed=0, b=4, m=6):
    """Weights in double precision and inputs."""
    rng = np.random.default_rng(seed)
    model = EnergyModel.random(LOW, HIGH, 2, rng)
    weights = {name: array.astype(float) for name, array in model.weights.items()}
    for name in ("first_bias", "second_bias"):
        weights[name] += 0.1 * rng.standard_normal(128)
    inputs = model.state_inputs(rng.uniform(LOW[:4], HIGH[:4], (b, 4))).astype(float)
    angles = model.angle_inputs(rng.uniform(-1.2, 1.2, (b, m))).astype(float)
    return weights, inputs, angles


def test_the_loss_is_that_of_the_equation():
    weights, inputs, angles = problem()
    loss, _ = loss_and_gradients(weights, inputs, angles)
    terms = []
    for state, options in zip(inputs, angles, strict=True):
        both = np.hstack([np.tile(state, (len(options), 1)), options])
        hidden = np.maximum(both @ weights["first"] + weights["first_bias"], 0.0)
        energies = np.maximum(hidden @ weights["second"] + weights["second_bias"], 0.0) @ weights["last"]
        chances = np.exp(-energies)
        terms.append(-np.log(chances[0] / chances.sum()))
    assert loss == pytest.approx(np.mean(terms), rel=1e-9)


@pytest.mark.parametrize("name", ["first", "first_bias", "second", "second_bias", "last"])
def test_gradients_are_finite_differences(name):
    weights, inputs, angles = problem()
    _, gradients = loss_and_gradients(weights, inputs, angles)
    assert gradients[name].shape == weights[name].shape
    rng = np.random.default_rng(1)
    for _ in range(12):
        entry = tuple(rng.integers(0, size) for size in weights[name].shape)
        losses = []
        for step in (1e-6, -1e-6):
            moved = {**weights, name: weights[name].copy()}
            moved[name][entry] += step
            losses.append(loss_and_gradients(moved, inputs, angles)[0])
        assert gradients[name][entry] == pytest.approx((losses[0] - losses[1]) / 2e-6, rel=1e-4, abs=1e-8)


@pytest.mark.parametrize("setting", SETTINGS)
def test_the_first_angle_of_an_example_is_the_best(setting):
    finder, config = search(setting), TrainingConfig(states=60, actions=40)
    data = examples(finder, config, np.random.default_rng(1000))
    assert data.angles.shape == (len(data.states), 40) and 50 < len(data.states) <= 60
    reserved = dataclasses.replace(SETTINGS[setting], beta=SETTINGS[setting].beta + config.reserve)
    scores = score(finder, data.states, data.angles, config.covariance, reserved)
    np.testing.assert_array_equal(scores.argmax(axis=1), 0)
    scores = score(finder, data.states, data.angles, config.covariance)
    np.testing.assert_array_equal(data.allowed, scores[:, 0] > 0.0)
    assert data.allowed.mean() > 0.7 and np.abs(data.angles).max() <= finder.strikes.angle[-1]
    # Each score is that of direct search for this angle, never more than its best.
    for row in range(5):
        best = finder.best(0.0, data.states[row], config.covariance)
        assert scores[row, 0] <= best.value + 0.02


def test_examples_keep_a_reserve_where_there_is_one():
    finder, goals = search("aggressive"), []
    certain = ShotSearch(MODEL, StandInStrikes(), ShootingConfig(objective=SETTINGS["conservative"]))
    for reserve in (0.0, 0.1, 0.2):
        config = TrainingConfig(states=80, actions=60, reserve=reserve)
        data = examples(finder, config, np.random.default_rng(1000))
        chances = score(certain, data.states, data.angles[:, :1], config.covariance)[:, 0]
        goals.append(np.median(chances))
        assert (chances > 0.5 + reserve).mean() > 0.8
    assert goals[0] < goals[1] < goals[2]


def test_states_without_a_good_angle_give_the_likeliest():
    strict = dataclasses.replace(SETTINGS["balanced"], beta=0.999)
    finder = ShotSearch(MODEL, StandInStrikes(), ShootingConfig(objective=strict))
    config = TrainingConfig(states=20, actions=30)
    data = examples(finder, config, np.random.default_rng(1000))
    assert not data.allowed.any()
    likeliest = ShotSearch(MODEL, StandInStrikes(), ShootingConfig(objective=SETTINGS["conservative"]))
    chances = score(likeliest, data.states, data.angles, config.covariance)
    chances = np.where(chances < 0.0, chances + 10.0, chances)
    np.testing.assert_array_equal(chances.argmax(axis=1), 0)


def test_pucks_of_the_examples_are_where_the_arm_can_strike():
    finder = search()
    known = states(finder, 500, 0.8, np.random.default_rng(1000))
    speed = np.hypot(known[:, 2], known[:, 3])
    assert known.shape == (500, 4) and speed.max() <= 0.8 and 0.15 < (speed == 0.0).mean() < 0.35
    assert (np.abs(known[:, :2] - [-0.45, 0.0]) <= [0.25, 0.4]).all()

    class Nothing(StandInStrikes):
        def speeds(self, puck, angles):
            return np.zeros(len(angles))

    nowhere = ShotSearch(MODEL, Nothing(), ShootingConfig())
    with pytest.raises(InvalidInputError, match="strike nowhere"):
        states(nowhere, 5, 0.8, np.random.default_rng(1000))


def toy(count=400, actions=30, seed=0):
    """The best angle is a function of the state that is easy to write down."""
    rng = np.random.default_rng(seed)
    known = rng.uniform(LOW[:4], HIGH[:4], (count, 4))
    angles = rng.uniform(-1.2, 1.2, (count, actions))
    angles[:, 0] = 1.5 * known[:, 1] + 0.3 * known[:, 2]
    return Examples(known, angles, np.ones(count, dtype=bool))


def test_training_learns_what_the_examples_show():
    config = TrainingConfig(epochs=40, batch=20, negatives=15)
    start = EnergyModel.random(LOW, HIGH, config.harmonics, np.random.default_rng(1))
    found = list(train(start, toy(), config, np.random.default_rng(2)))
    assert len(found) == 40 and found[-1][1] < 0.5 * found[0][1]
    policy, unseen, rng = ShootingPolicy(found[-1][0]), toy(40, seed=5), np.random.default_rng(3)
    errors = [
        policy.solve(state, 25, rng)[0] - angle
        for state, angle in zip(unseen.states, unseen.angles[:, 0], strict=True)
    ]
    assert np.median(np.abs(errors)) < 0.05
    assert all(array.dtype == np.float32 for array in policy.energy.weights.values())


def test_training_depends_on_its_seed_alone_and_leaves_the_start_alone():
    config = TrainingConfig(epochs=2, batch=50, negatives=10)
    start = EnergyModel.random(LOW, HIGH, 2, np.random.default_rng(1))
    before = {name: array.copy() for name, array in start.weights.items()}
    ends = [list(train(start, toy(100), config, np.random.default_rng(2)))[-1] for _ in range(2)]
    assert ends[0][1] == ends[1][1]
    for name, array in before.items():
        np.testing.assert_array_equal(start.weights[name], array)
        np.testing.assert_array_equal(ends[0][0].weights[name], ends[1][0].weights[name])


def test_nonsense_is_refused():
    with pytest.raises(ConfigurationError, match=r"TrainingConfig.actions = 1"):
        TrainingConfig(actions=1)
