"""Compiled rollouts of the puck against twins in NumPy that are written as the equations are."""

import dataclasses
import math

import numpy as np
import pytest

from vpsto_ros.contact.linear_gaussian import LinearGaussian
from vpsto_ros.contact.puck import APPROACH, HockeyTable, PuckModel
from vpsto_ros.exceptions import InvalidInputError

TABLE, PERIOD = HockeyTable(), 0.02
REACH = TABLE.reach


def model(share=0.13, growth=0.6, slip=0.3, delay=5e-3):
    """One whose matrices are full, so that every entry counts."""
    shares = np.array([[growth, slip], [0.7 * growth, 0.5 * slip]])
    floating = LinearGaussian([[0.99, 2e-3], [-1e-3, 0.985]], [1e-4, -2e-4], [[4e-6, 1e-6], [1e-6, 9e-6]])
    wall = LinearGaussian(
        [[-0.73, 0.02], [0.03, 0.85]], [4e-3, -2e-3], [[9e-4, 1e-4], [1e-4, 4e-4]], shares, APPROACH["wall"]
    )
    mallet = LinearGaussian(
        [[-0.4, 0.01, 1.4, 0.02], [-0.01, 0.77, 0.03, 0.21]], [0.01, 2e-3], [[1e-3, 1e-4], [1e-4, 3e-4]],
        shares, APPROACH["mallet"],
    )  # fmt: skip
    lively = LinearGaussian(
        [[-0.92, 0.01], [0.02, 0.88]], [2e-3, 1e-3], [[4e-3, 2e-4], [2e-4, 6e-4]], shares, APPROACH["wall"]
    )
    mixed = {"lively": lively, "lively_share": share} if share else {}
    return PuckModel(TABLE, PERIOD, floating, wall, mallet, delay, **mixed)


# The twins.


def scaled(mode, inputs, variances):
    squares = (mode.approach @ inputs) ** 2 + variances
    root = np.diag(np.sqrt(1.0 - mode.growth.sum(axis=1) + mode.growth @ squares))
    return root @ mode.covariance @ root


def bounced(puck, kind, before, variances):
    """Matrix, velocity and covariance of a bounce in its frame."""
    modes = {"usual": [(1.0, puck.wall)], "lively": [(1.0, puck.lively)]}.get(kind)
    modes = modes or [(1.0 - puck.lively_share, puck.wall), (puck.lively_share, puck.lively or puck.wall)]
    mean = sum(w * m.mean(before) for w, m in modes)
    spread = sum(
        w * (scaled(m, before, variances) + np.outer(m.mean(before) - mean, m.mean(before) - mean))
        for w, m in modes
    )
    return sum(w * m.matrix for w, m in modes), mean, spread


def first_wall(state, duration, walls=(0, 1)):
    """(time, axis, side) of the wall met first; None if there is none."""
    met = []
    for axis in walls:
        side = np.sign(state[2 + axis])
        if side == 0.0:
            continue
        time = max(0.0, (side * REACH[axis] - state[axis]) / state[2 + axis])
        inside = axis == 0 and abs(state[1] + time * state[3]) <= TABLE.opening
        if time <= duration and not inside:
            met.append((time, axis, side))
    return min(met) if met else None


def step(puck, mean, covariance, kind="merged", part=1.0):
    """One step; whether a wall was met."""
    duration, eye, met = part * puck.period, np.eye(2), first_wall(mean, part * puck.period)
    x, v, a, noise = mean[:2], mean[2:], np.eye(4), np.zeros((4, 4))
    if met is None:
        theta, offset = eye + part * (puck.floating.matrix - eye), part * puck.floating.offset
        after = theta @ v + offset
        position = x + 0.5 * duration * (v + after)
        a[:2, 2:], noise[2:, 2:] = 0.5 * duration * (eye + theta), part * puck.floating.covariance
    else:
        time, axis, side = met
        frame = np.zeros((2, 2))
        frame[axis, 0] = -side
        frame[:, 1] = [-frame[1, 0], frame[0, 0]]
        variances = np.diag(covariance)[[2 + axis, 3 - axis]]
        theta, after, scatter = bounced(puck, kind, frame.T @ v, variances)
        theta, after, scatter = frame @ theta @ frame.T, frame @ after, frame @ scatter @ frame.T
        rest = duration - time
        position = x + time * v + rest * after
        if time > 0.0:
            a[:2, axis] -= (v - after) / v[axis]
            a[:2, 2 + axis] -= time * (v - after) / v[axis]
        a[:2, 2:] += time * eye + rest * theta
        block = np.vstack([rest * eye, eye])
        noise = block @ scatter @ block.T
    a[2:, 2:] = theta
    return np.concatenate([position, after]), a @ covariance @ a.T + noise, met is not None


def mass(low, high, mean, std):
    return 0.5 * (math.erf((high - mean) / std / math.sqrt(2)) - math.erf((low - mean) / std / math.sqrt(2)))


def outlook(puck, mean, covariance, weight=1.0, k=0, banks=0, steps=200):
    """Ways to the goal line: (weight, probability, speed, time, y, std, banks)."""
    while k < steps:
        if mean[2] > 0.0 and mean[0] + puck.period * mean[2] >= REACH[0]:
            time = (REACH[0] - mean[0]) / mean[2]
            if first_wall(mean, time, (1,)) is None:
                slope, time = mean[3] / mean[2], max(time, 0.0)
                row = np.array([-slope, 1.0, -slope * time, time])
                y, std = mean[1] + time * mean[3], math.sqrt(row @ covariance @ row)
                goal = max(0.0, mass(*puck.goal_window(slope), y, std))
                speed = np.linalg.norm(mean[2:])
                return [(weight, goal, speed, k * puck.period + time, y, std, banks)]
        met, k = first_wall(mean, puck.period) is not None, k + 1
        share = puck.lively_share
        if met and share and weight * min(share, 1.0 - share) >= 0.02:
            ways = []
            for kind, part in (("usual", 1.0 - share), ("lively", share)):
                after = step(puck, mean, covariance, kind)[:2]
                ways += outlook(puck, *after, weight * part, k, banks + 1, steps)
            return ways
        mean, covariance, _ = step(puck, mean, covariance)
        banks += met
    return []


def states(count, seed):
    rng = np.random.default_rng(seed)
    place = rng.uniform(-0.95, 0.95, (count, 2)) * REACH
    angle, speed = rng.uniform(-np.pi, np.pi, count), rng.uniform(0.05, 4.0, count)
    mean = np.column_stack([place, speed * np.cos(angle), speed * np.sin(angle)])
    root = rng.normal(0.0, 1.0, (count, 4, 4)) * np.array([2e-3, 2e-3, 2e-2, 2e-2])[:, None]
    return mean, root @ root.transpose(0, 2, 1)


# What is compared with them.


@pytest.mark.parametrize("share", [0.0, 0.13])
def test_steps_are_those_of_the_twin(share):
    puck, walls = model(share), 0
    for mean, covariance in zip(*states(400, 0), strict=True):
        for part in (1.0, 1.0, 0.4, 1.0, 1.0):
            expected = step(puck, mean, covariance, part=part)
            found = puck.step(mean, covariance, part * PERIOD)
            np.testing.assert_allclose(found[0], expected[0], rtol=1e-10, atol=1e-12)
            np.testing.assert_allclose(found[1], expected[1], rtol=1e-9, atol=1e-14)
            mean, covariance = found
            walls += expected[2]
    assert walls > 40


@pytest.mark.parametrize("share", [0.0, 0.13, 0.4])
def test_outlooks_are_those_of_the_twin(share):
    puck = model(share)
    means, covariances = states(400, 1)
    found = puck.outlook(means, covariances)
    arrived = np.zeros(4, dtype=int)
    for b in range(len(means)):
        ways = outlook(puck, means[b], covariances[b])
        if not ways:
            assert found.goal[b] == 0.0 and np.isnan(found.speed[b])
            continue
        assert found.goal[b] == pytest.approx(sum(way[0] * way[1] for way in ways), abs=1e-9)
        _, _, speed, time, y, std, banks = max(ways)
        np.testing.assert_allclose(
            [found.speed[b], found.time[b], *found.offset[b]], [speed, time, y, std], rtol=1e-7, atol=1e-10
        )
        assert found.banks[b] == banks
        arrived[min(banks, 3)] += 1
    assert arrived[:3].min() > 5 and found.goal.max() > 0.5


def test_predictions_are_those_of_steps():
    puck = model()
    times = np.array([0.5, 0.0, 0.013, 0.02, 0.9, 0.31, 0.9, 3.0])
    for mean, covariance in zip(*states(40, 2), strict=True):
        means, covariances = puck.predict(mean, covariance, times)
        for k, time in enumerate(times):
            state, spread = mean, covariance
            for _ in range(int(time / PERIOD + 1e-9)):
                state, spread = puck.step(state, spread)
            rest = time - PERIOD * int(time / PERIOD + 1e-9)
            if rest > 1e-9:
                state, spread = puck.step(state, spread, rest)
            np.testing.assert_allclose(means[k], state, rtol=1e-9, atol=1e-11)
            np.testing.assert_allclose(covariances[k], spread, rtol=1e-8, atol=1e-13)
    with pytest.raises(InvalidInputError, match="times"):
        puck.predict(mean, covariance, [-0.1])


def strike(rng, count, aside=0.3):
    """A puck, and mallets about to hit it from all around, not quite centrally."""
    puck = np.array([*rng.uniform(-0.4, 0.2, 2), *rng.normal(0.0, 0.2, 2)])
    angle = rng.uniform(-1.2, 1.2, count)
    heading, speed = angle + rng.uniform(-aside, aside, count), rng.uniform(0.5, 1.8, count)
    place = puck[:2] - TABLE.contact_distance * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return puck, np.column_stack([place, speed * np.cos(heading), speed * np.sin(heading)])


def hit_from(puck, state, mallet):
    """State as of the nominal touch after a hit of a puck that is somewhere else: met at its own time."""
    relative = state - mallet
    low, high = -0.02, 0.02
    for _ in range(80):
        time = 0.5 * (low + high)
        near = np.linalg.norm(relative[:2] + time * relative[2:]) < TABLE.contact_distance
        low, high = (low, time) if near else (time, high)
    before, other = state.copy(), mallet.copy()
    before[:2] += time * before[2:]
    other[:2] += time * other[2:]
    after = puck.hit(before[None], other[None])[0][0]
    after[:2] -= time * after[2:]
    return after


def test_what_is_not_known_of_a_puck_turns_the_hit():
    """Against hits of pucks that are a bit off, each met at its own time: the Jacobian column by column."""
    puck, rng, step_ = model(0.0, 0.0, 0.0), np.random.default_rng(3), 1e-6
    state, mallets = strike(rng, 20)
    for mallet in mallets:
        columns = []
        for offset in step_ * np.eye(4):
            ahead, behind = (hit_from(puck, state + sign * offset, mallet) for sign in (1.0, -1.0))
            columns.append((ahead - behind) / (2.0 * step_))
        jacobian = np.transpose(columns)
        spread = np.diag([1e-3, 2e-3, 1e-2, 2e-2]) ** 2
        mean, noise = puck.hit(state[None], mallet[None])
        expected = puck.outlook(mean, noise + jacobian @ spread @ jacobian.T)
        found = puck.shots(state, spread, mallet[None])
        np.testing.assert_allclose(found.offset, expected.offset, rtol=1e-4)
        np.testing.assert_allclose(found.goal, expected.goal, atol=1e-4)


def test_shots_of_a_puck_that_is_known_are_hits_and_outlooks():
    puck, rng = model(), np.random.default_rng(4)
    state, mallets = strike(rng, 60)
    found = puck.shots(state, np.zeros((4, 4)), mallets)
    expected = puck.outlook(*puck.hit(np.tile(state, (60, 1)), mallets))
    for field in dataclasses.fields(found):
        np.testing.assert_allclose(getattr(found, field.name), getattr(expected, field.name), rtol=1e-9)
    many = puck.shots(np.tile(state, (60, 1)), np.zeros((60, 4, 4)), mallets)
    np.testing.assert_array_equal(many.goal, found.goal)
    assert (found.goal > 0.2).sum() > 5


def test_samples_of_the_goal_line_count_what_the_mass_is():
    """(5.11) against the exact mass, for direct shots and such by way of walls."""
    puck, rng = model(), np.random.default_rng(5)
    state, mallets = strike(rng, 400)
    spread = np.diag([1e-3, 1e-3, 1e-2, 1e-2]) ** 2
    exact = puck.shots(state, spread, mallets)
    sampled = puck.shots(state, spread, mallets, samples=2000, rng=rng)
    some = (exact.goal > 0.05) & (exact.goal < 0.95)
    assert some.sum() > 50 and (exact.banks[some] > 0).sum() > 10
    assert np.abs(sampled.goal - exact.goal).max() < 0.05
    assert abs((sampled.goal - exact.goal)[some].mean()) < 0.005
    with pytest.raises(InvalidInputError, match="rng"):
        puck.shots(state, spread, mallets, samples=10)


def test_posts_let_in_whoever_their_bounce_does_not_turn_back():
    """The window against discs that are moved straight on until they touch a post, and bounced off it."""
    puck = model(0.0)
    radius = TABLE.puck_radius + TABLE.post_radius
    posts = np.array([[REACH[0] + radius, side * (TABLE.opening + radius)] for side in (-1.0, 1.0)])
    keep, slide = -puck.wall.matrix[0, 0], puck.wall.matrix[1, 1]

    def goes_in(y, slope):
        unit = np.array([1.0, slope]) / math.hypot(1.0, slope)
        times = []
        for post in posts:
            off = post - np.array([REACH[0], y])
            aside = off @ np.array([-unit[1], unit[0]])
            times.append(off @ unit - math.sqrt(radius**2 - aside**2) if abs(aside) < radius else np.inf)
        if min(times) == np.inf:
            return True
        normal = np.array([REACH[0], y]) + min(times) * unit - posts[int(np.argmin(times))]
        normal /= np.linalg.norm(normal)
        across, along = normal @ unit, unit - (normal @ unit) * normal
        return (-keep * across * normal + slide * along)[0] > 0.0

    for slope in (-1.2, -0.3, 0.0, 0.5, 1.0):
        low, high = puck.goal_window(slope)
        assert low < 0.0 < high and high - low > 0.15
        for edge, inward in ((low, 1e-5), (high, -1e-5)):
            assert goes_in(edge + inward, slope) and not goes_in(edge - inward, slope)
    assert puck.goal_window(0.4)[0] == pytest.approx(-puck.goal_window(-0.4)[1])


def test_scatter_grows_with_the_speed_of_approach():
    puck, calm = model(0.0, 0.9, 0.0), model(0.0, 0.0, 0.0)
    for speed in (0.5, 1.0, 2.0):
        start = np.array([REACH[0] - 0.005, 0.3, speed, 0.0])
        grown, constant = (m.step(start, np.zeros((4, 4)))[1][2, 2] for m in (puck, calm))
        assert grown == pytest.approx((0.1 + 0.9 * speed**2) * constant)
        mallet = np.array([-TABLE.contact_distance, 0.0, speed, 0.0])
        grown, constant = (m.hit(np.zeros((1, 4)), mallet[None])[1][0, 2, 2] for m in (puck, calm))
        assert grown == pytest.approx((0.1 + 0.9 * speed**2) * constant)


def test_samples_bounce_lively_as_often_as_they_should():
    puck = model(0.3, 0.9, 0.05)
    paths = puck.simulate(np.tile([REACH[0] - 0.01, 0.3, 1.0, 0.2], (20_000, 1)), 1, np.random.default_rng(6))
    mean, covariance = puck.step([REACH[0] - 0.01, 0.3, 1.0, 0.2], np.zeros((4, 4)))
    np.testing.assert_allclose(paths[:, 1].mean(axis=0), mean, atol=3e-3)
    np.testing.assert_allclose(np.cov(paths[:, 1, 2:].T), covariance[2:, 2:], atol=3e-4)


def test_shots_refuse_what_does_not_fit():
    puck, spread = model(), np.zeros((4, 4))
    with pytest.raises(InvalidInputError, match=r"\(B, 4\)"):
        puck.shots(np.zeros(3), spread, np.ones((2, 4)))
    with pytest.raises(InvalidInputError, match=r"\(B, 4\)"):
        puck.shots(np.zeros((3, 4)), spread, np.ones((2, 4)))
    with pytest.raises(InvalidInputError, match="coincide"):
        puck.shots(np.zeros(4), spread, np.zeros((2, 4)))
    with pytest.raises(InvalidInputError, match="share of lively"):
        dataclasses.replace(puck, lively_share=0.0)
    with pytest.raises(InvalidInputError, match="speeds of approach"):
        dataclasses.replace(puck, wall=dataclasses.replace(puck.wall, approach=[[0.0, 1.0], [1.0, 0.0]]))
