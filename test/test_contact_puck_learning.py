"""Learning the puck model: labels and parameters from recordings whose truth is known."""

import numpy as np
import pytest

from vpsto_ros.contact.linear_gaussian import LinearGaussian
from vpsto_ros.contact.puck import HockeyTable, PuckModel
from vpsto_ros.contact.puck_learning import (
    FLOATING,
    MALLET,
    UNCLEAR,
    WALL,
    PuckRecording,
    collect,
    label,
    learn,
    velocities_at_touch,
)
from vpsto_ros.exceptions import InvalidInputError

TABLE, PERIOD = HockeyTable(), 0.02
TRUTH = PuckModel(
    TABLE, PERIOD,
    LinearGaussian(0.99 * np.eye(2), [0.001, 0.0], np.diag([2e-3, 2e-3]) ** 2),
    LinearGaussian(np.diag([-0.74, 0.84]), np.zeros(2), np.diag([0.03, 0.02]) ** 2),
    LinearGaussian(
        [[-0.45, 0.0, 1.45, 0.0], [0.0, 0.95, 0.0, 0.05]], np.zeros(2), np.diag([0.04, 0.02]) ** 2
    ),
)  # fmt: skip


def alone(seed, count=50, steps=50):
    """Pucks that float and bounce, no mallet about."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(-0.9, 0.9, (count, 2)) * TABLE.reach
    angle, speed = rng.uniform(-np.pi, np.pi, count), rng.uniform(0.3, 2.0, count)
    starts = np.column_stack([place, speed * np.cos(angle), speed * np.sin(angle)])
    paths = TRUTH.simulate(starts, steps, rng)
    return [PuckRecording(PERIOD, path, np.full_like(path, np.nan)) for path in paths]


def struck(seed, count=50):
    """A mallet that runs into a puck: a step before the hit, and one after it."""
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        puck = np.array([*rng.uniform(-0.4, 0.3, 2), *rng.normal(0.0, 0.3, 2)])
        angle, speed = rng.uniform(-1.0, 1.0), rng.uniform(0.4, 1.5)
        velocity = speed * np.array([np.cos(angle), np.sin(angle)])
        aside = rng.uniform(-0.03, 0.03) * np.array([-np.sin(angle), np.cos(angle)])
        relative = velocity - puck[2:]
        time = rng.uniform(0.2, 0.8) * PERIOD
        unit = relative / np.linalg.norm(relative)
        touch = -np.sqrt(TABLE.contact_distance**2 - aside @ aside + (aside @ unit) ** 2) * unit
        normal = -(touch + aside - (aside @ unit) * unit)
        normal *= TABLE.contact_distance / np.linalg.norm(normal)
        mallet = np.array([*(puck[:2] + time * puck[2:] - normal - time * velocity), *velocity])
        at_touch = np.concatenate([puck[:2] + time * puck[2:], puck[2:]])
        mean, covariance = TRUTH.hit(at_touch[None], np.concatenate([at_touch[:2] - normal, velocity])[None])
        after = rng.multivariate_normal(mean[0, 2:], covariance[0, 2:, 2:])
        end = np.concatenate([at_touch[:2] + (PERIOD - time) * after, after])
        later = np.concatenate([mallet[:2] + PERIOD * velocity, velocity])
        found.append(PuckRecording(PERIOD, np.stack([puck, end]), np.stack([mallet, later])))
    return found


def test_walls_and_hits_are_recognised():
    recordings = alone(0, 100)
    for recording in recordings:
        modes, puck = label(recording, TABLE), recording.puck
        inside = (np.abs(puck[:, 0]) < TABLE.reach[0]) | (np.abs(puck[:, 1]) > 0.125)
        for k in np.flatnonzero(modes == FLOATING):
            assert np.linalg.norm(puck[k + 1, 2:] - 0.99 * puck[k, 2:]) < 0.02, "nothing but drag and noise"
        for k in np.flatnonzero(modes == WALL):
            assert (np.sign(puck[k, 2:]) != np.sign(puck[k + 1, 2:])).sum() >= 1 and inside[k]
    shares = np.concatenate([label(r, TABLE) for r in recordings])
    assert (shares == WALL).sum() > 40 and (shares == UNCLEAR).mean() < 0.25
    hits = np.concatenate([label(r, TABLE) for r in struck(1)])
    assert (hits == MALLET).mean() > 0.9 and not (hits == FLOATING).any()


@pytest.mark.parametrize(
    ("start", "why"),
    [
        ((-0.938, -0.478, -0.57, -1.02), "both walls of a corner"),
        ((0.93, 0.3, 1.5, 0.0), "a plain bounce"),
        ((0.93, 0.486, 1.5, 0.0), "beside another wall"),
        ((0.93, 0.14, 1.5, -0.9), "at a post"),
        ((0.93, 0.0, 1.5, 0.0), "into the goal"),
        ((0.9415, 0.3, 1.5, 0.0), "begins at the wall"),
    ],
)
def test_only_plain_bounces_teach_the_wall(start, why):
    path = TRUTH.simulate([start], 1, np.random.default_rng(0))[0]
    wanted = WALL if why == "a plain bounce" else UNCLEAR
    assert label(PuckRecording(PERIOD, path, np.full_like(path, np.nan)), TABLE)[0] == wanted


@pytest.mark.parametrize("contact_time", [0.0, 0.018])
def test_hits_that_take_their_time_are_traced_back_to_their_touch(contact_time):
    """A puck that a steady mallet speeds up evenly for 18 ms, seen at any phase of the steps."""
    keep, gain, recordings = 1.0, 1.5, alone(4, 40)
    for phase, speed in zip(np.linspace(0.1, 0.9, 30), np.linspace(0.5, 1.5, 30), strict=True):
        time = PERIOD * (np.arange(6) - 1.0 - phase)  # since the touch
        duration = max(contact_time, 1e-9)
        driven = np.clip(time, 0.0, duration)
        v = gain * speed * driven / duration
        x = 0.5 * gain * speed * driven**2 / duration + gain * speed * np.maximum(time - duration, 0.0)
        zero = np.zeros(6)
        mallet = np.column_stack([speed * time - TABLE.contact_distance, zero, 0 * time + speed, zero])
        puck = np.column_stack([x, zero, keep * v, zero])
        recordings.append(PuckRecording(PERIOD, puck, mallet))
    steps = collect(recordings, TABLE, contact_time)
    hits = steps.outputs[MALLET]
    assert 20 <= len(hits) <= 30
    np.testing.assert_allclose(hits[:, 0], gain * steps.inputs[MALLET][:, 2], rtol=1e-6)
    still = LinearGaussian(np.eye(2), np.zeros(2), 1e-6 * np.eye(2))
    np.testing.assert_allclose(velocities_at_touch(steps, still), hits)
    advance = hits[:, 0] * (steps.elapsed - 0.5 * contact_time)
    np.testing.assert_allclose(steps.advance[:, 0], advance, atol=1e-5)


def test_what_made_the_recordings_is_learned():
    model = learn([*alone(0, 800), *struck(1, 400)], TABLE)
    assert model.hit_delay < 1e-4, "these hits take no time"
    for name, atol in (("floating", 0.002), ("wall", 0.02), ("mallet", 0.03)):
        ours, true = getattr(model, name), getattr(TRUTH, name)
        np.testing.assert_allclose(ours.matrix, true.matrix, atol=atol, err_msg=name)
        np.testing.assert_allclose(ours.offset, true.offset, atol=atol, err_msg=name)
        # Of what they are at a usual speed: how much they grow with it is not told well by so few.
        usual = {"floating": [1.0, 0.5], "wall": [-0.8, 0.5], "mallet": [0.0, 0.0, 0.9, 0.2]}[name]
        scatter = np.sqrt(np.diag(ours.covariance) * ours.scales(usual))
        np.testing.assert_allclose(scatter, np.sqrt(np.diag(true.covariance)), rtol=0.15, err_msg=name)
    assert model.lively is None, "there is one kind of bounces"


def test_fresh_recordings_lie_within_the_ellipses_that_are_predicted():
    model, k = learn([*alone(0, 100), *struck(1, 200)], TABLE), 12
    inside = []
    for recording in alone(9, 300, k):
        start = recording.puck[0]
        mean, covariance = start, np.zeros((4, 4))
        if (label(recording, TABLE) == UNCLEAR).any() or (label(recording, TABLE) == WALL).sum() > 1:
            continue
        for _ in range(k):
            mean, covariance = model.step(mean, covariance)
        off = recording.puck[-1] - mean
        inside.append(off @ np.linalg.solve(covariance + 1e-12 * np.eye(4), off))
    share = np.mean(np.array(inside) < 7.78)  # 90 % of a chi-squared with 4 degrees of freedom
    assert len(inside) > 150 and 0.82 < share < 0.97


def test_mirrored_data_leave_no_preferred_side():
    model = learn([*alone(2, 60), *struck(3, 60)], TABLE)
    for matrix in (model.wall.matrix, model.mallet.matrix[:, :2], model.mallet.matrix[:, 2:]):
        np.testing.assert_allclose([matrix[0, 1], matrix[1, 0]], 0.0, atol=1e-9)
    np.testing.assert_allclose([model.wall.offset[1], model.mallet.offset[1]], 0.0, atol=1e-9)


def test_recordings_that_teach_nothing_are_refused():
    with pytest.raises(InvalidInputError, match="mallet mode cannot be learned from 0"):
        learn(alone(0, 60), TABLE)
    with pytest.raises(InvalidInputError, match="one period"):
        learn([], TABLE)
    path = np.zeros((5, 4))
    with pytest.raises(InvalidInputError, match="puck and mallet"):
        PuckRecording(PERIOD, path, path[:3])
    with pytest.raises(InvalidInputError, match="finite"):
        PuckRecording(PERIOD, np.full((5, 4), np.nan), path)
