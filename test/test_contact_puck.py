"""The puck model: modes, rollouts against Monte-Carlo, goal probability, files."""

import dataclasses
import json

import numpy as np
import pytest

from vpsto_ros.contact.linear_gaussian import LinearGaussian
from vpsto_ros.contact.puck import HockeyTable, PuckModel, contact_frames
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError

TABLE = HockeyTable()
REACH = TABLE.reach
DRAG = 0.5
PERIOD = 0.02


def model(floating=2e-3, wall=0.03, mallet=0.03):
    keep = 1.0 - DRAG * PERIOD
    return PuckModel(
        TABLE, PERIOD,
        LinearGaussian(keep * np.eye(2), np.zeros(2), floating**2 * np.eye(2)),
        LinearGaussian(np.diag([-0.74, 0.84]), np.zeros(2), np.diag([wall, 0.5 * wall]) ** 2),
        LinearGaussian(
            [[-0.45, 0.0, 1.45, 0.0], [0.0, 0.95, 0.0, 0.05]], np.zeros(2),
            np.diag([mallet, 0.5 * mallet]) ** 2,
        ),
    )  # fmt: skip


QUIET = model(1e-6, 1e-6, 1e-6)


def roll(puck, state, steps, spread=None):
    mean, covariance = np.array(state, dtype=float), np.zeros((4, 4)) if spread is None else spread
    path = [mean]
    for _ in range(steps):
        mean, covariance = puck.step(mean, covariance)
        path.append(mean)
    return np.array(path), covariance


# Frames and hits


def test_frames_of_contact_are_right_handed_and_begin_with_the_normal():
    frames = contact_frames(np.random.default_rng(0).normal(size=(50, 2)))
    np.testing.assert_allclose(np.linalg.det(frames), 1.0)
    np.testing.assert_allclose(frames.transpose(0, 2, 1) @ frames, np.tile(np.eye(2), (50, 1, 1)), atol=1e-12)
    with pytest.raises(InvalidInputError, match="coincide"):
        contact_frames([[0.0, 0.0]])


def test_a_central_hit_drives_the_puck_along_the_normal():
    angle = np.linspace(-1.2, 1.2, 9)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    puck = np.hstack([np.full((9, 2), 0.1), np.zeros((9, 2))])
    mallet = np.hstack([puck[:, :2] - TABLE.contact_distance * normal, 1.2 * normal])
    mean, covariance = QUIET.hit(puck, mallet)
    np.testing.assert_allclose(mean[:, 2:], 1.45 * 1.2 * normal, atol=1e-12)
    np.testing.assert_array_equal(mean[:, :2], puck[:, :2])
    _, covariance = model().hit(puck, mallet)
    for k in range(9):
        along, across = normal[k], np.array([-normal[k, 1], normal[k, 0]])
        assert along @ covariance[k, 2:, 2:] @ along == pytest.approx(0.03**2)
        assert across @ covariance[k, 2:, 2:] @ across == pytest.approx(0.015**2)
    np.testing.assert_array_equal(covariance[:, :2], 0.0)


def test_a_delayed_hit_shifts_positions_unless_it_is_told_not_to():
    puck = np.array([[0.1, 0.0, -0.2, 0.0]])
    mallet = np.array([[0.1 - TABLE.contact_distance, 0.0, 1.0, 0.0]])
    late = dataclasses.replace(model(), hit_delay=5e-3)
    mean, covariance = late.hit(puck, mallet)
    assert mean[0, 0] == pytest.approx(0.1 - 5e-3 * (mean[0, 2] + 0.2))
    assert covariance[0, 0, 0] == pytest.approx(5e-3**2 * covariance[0, 2, 2])
    for found, expected in zip(late.hit(puck, mallet, delayed=False), model().hit(puck, mallet), strict=True):
        np.testing.assert_array_equal(found, expected)


# Steps


def test_a_floating_puck_slows_down_exponentially():
    path, _ = roll(QUIET, [-0.5, 0.0, 0.6, 0.1], 40)
    np.testing.assert_allclose(path[:, 2], 0.6 * (1.0 - DRAG * PERIOD) ** np.arange(41), rtol=1e-9)
    time = PERIOD * np.arange(41)
    np.testing.assert_allclose(path[:, 0], -0.5 + 0.6 / DRAG * (1.0 - np.exp(-DRAG * time)), atol=2e-3)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_walls_reflect_at_their_time_whatever_the_step_was(axis, side):
    """Starts that differ by parts of a step leave on one line."""
    ends = []
    for part in np.linspace(0.0, 0.9, 7):
        velocity = np.zeros(2)
        velocity[axis], velocity[1 - axis] = 1.5 * side, 0.4
        start = np.zeros(2)
        start[axis] = side * (REACH[axis] - 0.01)
        start[1 - axis] = 0.2
        start -= part * PERIOD * velocity
        mean, covariance = np.concatenate([start, velocity]), np.zeros((4, 4))
        while mean[2 + axis] * side > 0.0:
            mean, covariance = PuckModel.step(QUIET, mean, covariance)
        assert abs(mean[axis]) <= REACH[axis]
        assert mean[2 + axis] == pytest.approx(-0.74 * 1.5 * side, rel=0.03)
        assert mean[3 - axis] == pytest.approx(0.84 * 0.4, rel=0.03)
        # Extrapolated back to the wall along its velocity: the place where it was met.
        back = (side * REACH[axis] - mean[axis]) / mean[2 + axis]
        ends.append(mean[1 - axis] + back * mean[3 - axis])
    np.testing.assert_allclose(ends, ends[0], atol=1e-4)


def test_a_puck_passes_through_the_opening_of_the_goal_and_nowhere_else():
    for y, through in ((0.0, True), (TABLE.opening - 1e-3, True), (TABLE.opening + 1e-3, False)):
        path, _ = roll(QUIET, [0.8, y, 1.5, 0.0], 10)
        assert (path[-1, 0] > REACH[0]) == through


@pytest.mark.parametrize(
    "state",
    [[0.0, 0.0, 0.9, 0.3], [0.0, 0.2, 0.5, 1.6], [0.6, 0.3, 1.2, 0.2], [-0.5, -0.3, 0.4, -1.9]],
)  # fmt: skip
def test_gaussians_agree_with_samples(state):
    """Means and covariances of (5.8) against 20000 trajectories of the model, across a wall or not."""
    puck, steps, rng = model(4e-3, 0.02), 22, np.random.default_rng(0)
    spread = np.diag([1e-3, 1e-3, 0.01, 0.01]) ** 2
    path, covariance = roll(puck, state, steps, spread)
    starts = rng.multivariate_normal(state, spread, 20_000)
    ends = puck.simulate(starts, steps, rng)[:, -1]
    std = ends.std(axis=0)
    assert np.abs(path[-1] - ends.mean(axis=0)).max() < 0.15 * std.max()
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), std, rtol=0.12)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0


def test_parts_of_a_step_add_up():
    whole, spread = QUIET.step([0.1, 0.1, 0.5, -0.2], np.eye(4) * 1e-4)
    mean, covariance = np.array([0.1, 0.1, 0.5, -0.2]), np.eye(4) * 1e-4
    for _ in range(4):
        mean, covariance = QUIET.step(mean, covariance, PERIOD / 4)
    np.testing.assert_allclose(mean, whole, atol=5e-5)
    np.testing.assert_allclose(covariance, spread, rtol=1e-2, atol=1e-9)


# Goals


def shots(count=24, seed=0):
    """Half of them straight at the goal or beside it, the others by way of a side wall."""
    rng = np.random.default_rng(seed)
    place = np.stack([rng.uniform(-0.6, 0.2, count), rng.uniform(-0.3, 0.3, count)], axis=1)
    aim = np.stack([np.full(count, REACH[0]), rng.normal(0.0, 0.08, count)], axis=1)
    side = np.where(np.arange(count) % 2, 0.0, rng.choice([-1.0, 1.0], count))
    # A wall that keeps 0.84 along and 0.74 across: the image of the goal is a bit nearer than a mirror's.
    aim[:, 1] = np.where(side == 0.0, aim[:, 1], side * REACH[1] + 0.9 * (side * REACH[1] - aim[:, 1]))
    way = aim - place
    speed = rng.uniform(0.9, 2.2, (count, 1))
    return np.hstack([place, speed * way / np.linalg.norm(way, axis=1, keepdims=True)])


def crossings(paths):
    """y and slope where trajectories (S, K, 4) first come to the goal line, NaN where they never do."""
    x, vx = paths[..., 0], paths[..., 2]
    over = (x[:, 1:] >= REACH[0]) & (x[:, :-1] < REACH[0])
    turned = (vx[:, :-1] > 0.0) & (vx[:, 1:] < 0.0) & (x[:, 1:] > REACH[0] - 0.06)
    first = np.argmax(over | turned, axis=1)
    x, y, vx, vy = np.moveaxis(paths[np.arange(len(paths)), first], -1, 0)
    return np.where((over | turned).any(axis=1), y + (REACH[0] - x) / vx * vy, np.nan), vy / vx


def test_the_probability_of_a_goal_is_that_of_samples():
    puck, rng = model(3e-3, 0.02), np.random.default_rng(1)
    starts, spread = shots(), np.zeros((24, 4, 4))
    spread[:, 2:, 2:] = np.eye(2) * 0.02**2
    outlook = puck.outlook(starts, spread)
    assert (outlook.goal > 0.3).sum() >= 3 and (outlook.banks >= 1).sum() >= 5
    compared = 0
    for k, start in enumerate(starts):
        drawn = np.column_stack([np.tile(start[:2], (4000, 1)), rng.normal(start[2:], 0.02, (4000, 2))])
        y, slope = crossings(puck.simulate(drawn, 150, rng))
        came = np.isfinite(y)
        if came.mean() < 0.99 or outlook.banks[k] > 1:
            continue  # slow ones are still on their way, and after two walls a Gaussian is none any more
        compared += 1
        low, high = np.transpose([puck.goal_window(m) for m in slope[came]])
        observed = ((low <= y[came]) & (y[came] <= high)).mean()
        assert outlook.goal[k] == pytest.approx(observed, abs=0.04), (k, start)
        assert outlook.offset[k, 0] == pytest.approx(y[came].mean(), abs=0.003)
        assert outlook.offset[k, 1] == pytest.approx(y[came].std(), rel=0.1)
    assert compared >= 18


def test_fast_straight_shots_are_safer_than_slow_ones_and_banks_less_safe():
    """Figure 5.4: uncertainty grows with time and with every wall."""
    puck = model(5e-3, 0.04)
    spread = np.zeros((3, 4, 4))
    spread[:, 2:, 2:] = np.diag([0.03, 0.015]) ** 2
    # Mirrored at the wall for the bank, whose tangential and normal losses bend it.
    states = np.array([[0.0, 0.0, 2.0, 0.0], [0.0, 0.0, 0.9, 0.0], [0.0, 0.0, 1.3, 1.33]])
    outlook = puck.outlook(states, spread)
    fast, slow, bank = outlook.offset[:, 1]
    assert outlook.banks.tolist() == [0, 0, 1]
    assert fast < slow < bank
    assert outlook.speed[0] > outlook.speed[1] and outlook.time[0] < outlook.time[1]


def test_pucks_that_never_arrive_never_score():
    states = np.array([[0.0, 0.0, -0.05, 0.0], [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.1, 0.0]])
    outlook = model().outlook(states, np.zeros((3, 4, 4)))
    np.testing.assert_array_equal(outlook.goal, 0.0)
    assert np.isnan(outlook.speed).all() and np.isnan(outlook.time).all()


# Files and bad input


def test_a_model_survives_its_file(tmp_path):
    path = tmp_path / "puck.json"
    model().save(path, seed=3, command="vpsto learn puck_model")
    again = PuckModel.load(path)
    assert again.table == TABLE and again.period == PERIOD
    np.testing.assert_array_equal(again.kernel_rows, model().kernel_rows)
    np.testing.assert_array_equal(again.mallet.matrix, model().mallet.matrix)
    assert json.loads(path.read_text())["origin"] == {"seed": 3, "command": "vpsto learn puck_model"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "other"}, "not of the format"), ({"period": -1.0}, "period"),
        ({"wall": None}, "not a puck"), ({"table": {"half_length": 99.0}}, "half_length"),
    ],
)  # fmt: skip
def test_files_that_are_no_model_are_refused(tmp_path, change, message):
    path = tmp_path / "puck.json"
    model().save(path)
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(ConfigurationError, match=message):
        PuckModel.load(path)


def test_a_covariance_that_is_none_is_refused_when_read(tmp_path):
    path = tmp_path / "puck.json"
    model().save(path)
    content = json.loads(path.read_text())
    content["wall"]["covariance"] = [[1.0, 2.0], [2.0, 1.0]]
    path.write_text(json.dumps(content))
    with pytest.raises(ConfigurationError, match="positive definite"):
        PuckModel.load(path)
    path.write_text("no json")
    with pytest.raises(ConfigurationError, match="not a puck model"):
        PuckModel.load(path)
    with pytest.raises(ConfigurationError, match="vpsto learn puck_model"):
        PuckModel.load(tmp_path / "missing.json")


def test_shapes_are_checked():
    with pytest.raises(InvalidInputError, match="wall mode"):
        dataclasses.replace(model(), wall=model().mallet)
    with pytest.raises(InvalidInputError, match="period"):
        dataclasses.replace(model(), period=0.0)
    with pytest.raises(InvalidInputError, match=r"\(B, 4\)"):
        model().outlook(np.zeros((3, 4)), np.zeros((2, 4, 4)))
    with pytest.raises(InvalidInputError, match=r"\(B, 4\)"):
        model().hit(np.zeros((3, 4)), np.zeros((2, 4)))
    with pytest.raises(ConfigurationError, match="lets no puck"):
        HockeyTable(goal_width=0.05)
