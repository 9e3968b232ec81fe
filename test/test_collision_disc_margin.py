"""Keeping away from discs that may turn: the time too near, exact, against dense sampling and in its laws."""

import numpy as np
import pytest

from vpsto_ros.collision.planar_discs import DiscMargin, MovingDisc, times_too_near
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory import Limits, OptimalBasis, TrajectoryBatch, synthesize, synthesize_batch

LIMITS = Limits(np.full(2, 0.1), np.full(2, 0.5))
STILL = np.zeros(2)
BAD = (np.nan, np.inf, -0.1, "a", True, None)
SEEN = (MovingDisc([0.3, 0.2], 0.02, [0.03, -0.04]), MovingDisc([0.15, 0.35], 0.03, [0.0, 0.01]))


def pieces(corners, times):
    """A batch of one path on a line through corners (N, 2), at one speed, with knots at times (N,) [s]."""
    keys, times = np.array([corners], dtype=float), np.array(times, dtype=float)
    slopes = np.diff(keys, axis=1) / np.diff(times)[:, None] * times[-1]
    slopes = np.concatenate([slopes, slopes[:, -1:]], axis=1)
    assert np.allclose(slopes, slopes[:, :1])
    return TrajectoryBatch(times[-1:], np.empty((1, 0, 2)), None, None, keys, times / times[-1], slopes)


@pytest.mark.parametrize(
    ("delay", "margin", "reaction"), [(0.0, 0.0, 0.0), (0.05, 0.01, 0.4), (0.2, 0.0, 0.8), (0.1, 0.0, 9.0)]
)
def test_the_time_too_near_agrees_with_dense_sampling(delay, margin, reaction):
    keys = np.random.default_rng(7).uniform(0.1, 0.4, (40, 5, 2))
    batch = synthesize_batch(OptimalBasis.uniform(3), keys, STILL, STILL, LIMITS, 2)
    cost, valid = DiscMargin(SEEN, delay, margin, reaction, weight=2.0)(batch)
    assert valid.sum() < 35 and valid.any() == (reaction < 1.0) and (valid == (cost == 0.0)).all()
    for b in range(len(keys)):
        motion = synthesize(OptimalBasis.uniform(3), keys[b], STILL, STILL, LIMITS)
        times = motion.duration * (np.arange(20_000) + 0.5) / 20_000
        ahead, near, gap = times + delay, 0.0, np.inf
        for one in SEEN:
            needed = one.radius + margin + 2.0 * np.hypot(*one.velocity) * np.minimum(ahead, reaction)
            way = motion(times) - one.centre - ahead[:, None] * one.velocity
            distance = np.hypot(*way.T) - needed
            near, gap = near + motion.duration * (distance < 0.0).mean(), min(gap, distance.min())
        if abs(gap) > 1e-6:
            assert valid[b] == (gap > 0.0)
        assert cost[b] == pytest.approx(2.0 * near, abs=4e-3)


def test_grazing_between_samples_is_found():
    disc = MovingDisc([0.0, 0.0], 0.5)
    for gap, free in ((1e-9, True), (-1e-9, False)):
        batch = pieces([[-3.0, 0.6 + gap], [3.0, 0.6 + gap]], [0.0, 6.0])
        cost, valid = DiscMargin((disc,), 0.0, 0.1, 1.0, weight=1.0)(batch)
        assert valid[0] == free
        expected = 0.0 if free else 2.0 * np.sqrt(0.36 - (0.6 + gap) ** 2)
        assert cost[0] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("detour", [0.1, 1.0, 10.0, 100.0])
def test_a_detour_elsewhere_never_lowers_the_cost(detour):
    """The way through the disc stays the same in space and time; what follows only takes time."""
    near, onwards = [[-1.0, 0.0], [1.0, 0.0]], [[-1.0, 0.0], [1.0, 0.0], [1.0 + detour, 0.0]]
    for velocity in ([0.0, 0.0], [0.0, 0.1], [-0.5, 0.2]):
        margin = DiscMargin((MovingDisc([0.0, 0.1], 0.3, velocity),), 0.1, 0.05, 0.5)
        plain = margin(pieces(near, [0.0, 2.0]))[0][0]
        longer = margin(pieces(onwards, [0.0, 2.0, 2.0 + detour]))[0][0]
        assert plain > 0.0 and longer == pytest.approx(plain, rel=1e-9)


@pytest.mark.parametrize("duration", [1e-3, 0.1, 1.0, 30.0])
def test_a_motion_that_is_always_too_near_costs_its_duration(duration):
    margin = DiscMargin((MovingDisc([0.0, 0.0], 0.3),), 0.0, 0.0, 0.0, weight=5.0)
    cost, valid = margin(pieces([[0.0, 0.0], [0.1, 0.0]], [0.0, duration]))
    assert cost[0] == pytest.approx(5.0 * duration) and not valid[0]


def test_more_margin_reaction_and_discs_never_cost_less():
    keys = np.random.default_rng(3).uniform(0.1, 0.4, (60, 4, 2))
    batch = synthesize_batch(OptimalBasis.uniform(2), keys, STILL, STILL, LIMITS, 2)
    base = DiscMargin(SEEN[:1], 0.05, 0.01, 0.3).time_too_near(batch)
    assert 0 < (base > 0.0).sum() < 60
    for discs, margin, reaction in ((SEEN[:1], 0.02, 0.3), (SEEN[:1], 0.01, 0.6), (SEEN, 0.01, 0.3)):
        more = DiscMargin(discs, 0.05, margin, reaction).time_too_near(batch)
        assert (more >= base - 1e-12).all() and (more > base + 1e-3).any()
    assert not DiscMargin((), 0.0, 0.0, 0.0).time_too_near(batch).any()
    assert DiscMargin.static is False


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(({name: value}, name) for name in ("delay", "margin", "reaction") for value in BAD),
        ({"weight": 0.0}, "weight"),
        ({"weight": np.nan}, "weight"),
        ({"weight": True}, "weight"),
        ({"discs": ("a",)}, "MovingDisc"),
        ({"discs": 5}, "sequence"),
        ({"discs": None}, "sequence"),
    ],
)  # fmt: skip
def test_bad_options_are_refused(options, message):
    with pytest.raises(InvalidInputError, match=message):
        DiscMargin(**{"discs": SEEN, "delay": 0.1, "margin": 0.0, "reaction": 0.3, **options})


def test_other_dimensions_are_refused_and_nan_is_never_valid():
    margin = DiscMargin(SEEN, 0.1, 0.0, 0.3)
    three = np.zeros((1, 2, 3))
    with pytest.raises(InvalidInputError, match="2 degrees of freedom"):
        margin(TrajectoryBatch(np.ones(1), three[:, :0], None, None, three, np.array([0.0, 1.0]), three))
    knots, rows = np.array([0.0, 1.0]), np.array([[0.0, 0.0, 0.0, 0.0, 0.1]])
    for where in range(8):
        given = [np.full((1, 2, 2), 4.0), np.zeros((1, 2, 2)), np.ones(1), rows.copy(), 0.1, 0.0, 0.3]
        if where < 4:
            given[where].flat[0] = np.nan
        elif where < 7:
            given[where] = np.nan
        (seconds,) = times_too_near(knots, *given)
        assert seconds == (np.inf if where < 7 else 0.0)
    far = pieces([[4.0, 4.0], [5.0, 4.0]], [0.0, 1.0])
    far.duration[0] = np.inf
    assert margin(far)[0][0] == np.inf and not margin(far)[1][0]
