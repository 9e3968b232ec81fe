"""A path against polygons and moving discs: every instant, checked by other means of finding out."""

import numpy as np
import pytest

from vpsto_ros.collision.planar import CollisionTerm, MovingDisc, PlanarWorld
from vpsto_ros.trajectory import Limits, OptimalBasis, Trajectory, TrajectoryBatch, synthesize

FREE = {"lower": np.full(2, -10.0), "upper": np.full(2, 10.0)}
SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
STAR = np.array([[np.cos(a), np.sin(a)] for a in np.arange(10) * np.pi / 5]) * np.tile([2.0, 0.7], 5)[:, None]


def hermite_batch(keys, slopes, durations=None):
    """A batch with these values (B, S, 2) and slopes at equally spaced phases."""
    durations = np.ones(len(keys)) if durations is None else np.asarray(durations, dtype=float)
    return TrajectoryBatch(
        durations, np.empty((len(keys), 0, 2)), None, None, keys, np.linspace(0, 1, keys.shape[1]), slopes
    )


def hermite(batch, row, s):
    """Positions (K, 2) at phases, by the textbook formula."""
    h = batch.knots[1] - batch.knots[0]
    i = np.minimum((s / h).astype(int), len(batch.knots) - 2)
    u = ((s - batch.knots[i]) / h)[:, None]
    keys, slopes = batch.key_positions[row], batch.knot_slopes[row] * h
    return (
        (1 + 2 * u) * (1 - u) ** 2 * keys[i]
        + u * (1 - u) ** 2 * slopes[i]
        + u**2 * (3 - 2 * u) * keys[i + 1]
        + u**2 * (u - 1) * slopes[i + 1]
    )


def winding(polygon, points):
    """Whether points are inside, from the sum of the angles under which they see the edges."""
    a, b = polygon - points[:, None], np.roll(polygon, -1, axis=0) - points[:, None]
    angles = np.arctan2(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], (a * b).sum(axis=-1))
    return np.abs(angles.sum(axis=1)) > np.pi


def share_in_collision(world, batch, start_time=0.0):
    """Share of the duration, which is what samples at equal steps of phase count, and validity."""
    seconds, valid = world.time_in_collision(batch, start_time)
    return seconds / batch.duration, valid


def random_cubics(seed, count, reach=2.0, pieces=2):
    rng = np.random.default_rng(seed)
    keys = rng.uniform(-reach, reach, (count, pieces + 1, 2))
    return hermite_batch(keys, rng.normal(0.0, 8.0, keys.shape), rng.uniform(0.5, 3.0, count))


def straight(start, end):
    """A batch of one straight path at constant speed."""
    keys = np.array([[start, end]], dtype=float)
    return hermite_batch(keys, np.repeat(keys[:, 1:] - keys[:, :1], 2, axis=1))


@pytest.mark.parametrize("polygon", [SQUARE, STAR, STAR[::-1]], ids=["square", "star", "clockwise"])
def test_share_agrees_with_dense_sampling(polygon):
    batch = random_cubics(1, 12)
    s = (np.arange(100_000) + 0.5) / 100_000
    share, valid = share_in_collision(PlanarWorld(**FREE, polygons=(polygon,)), batch)
    sampled = [winding(polygon, hermite(batch, row, s)).mean() for row in range(12)]
    np.testing.assert_allclose(share, sampled, atol=1e-4)
    assert (np.array(sampled) > 0).any()
    np.testing.assert_array_equal(valid, share == 0.0)


def test_share_agrees_with_numpy_roots_to_round_off():
    batch = random_cubics(2, 60, pieces=1)
    share, _ = share_in_collision(PlanarWorld(**FREE, polygons=(STAR,)), batch)
    u = np.linspace(0.0, 1.0, 4)
    for row in range(60):
        power = np.polyfit(u, hermite(batch, row, u), 3).T
        cuts = [0.0, 1.0]
        for a, b in zip(STAR, np.roll(STAR, -1, axis=0), strict=True):
            line = (b - a)[0] * (power[1] - [0, 0, 0, a[1]]) - (b - a)[1] * (power[0] - [0, 0, 0, a[0]])
            cuts += [r.real for r in np.roots(line) if abs(r.imag) < 1e-9 and 0 < r.real < 1]
        cuts = np.sort(cuts)
        middles = hermite(batch, row, 0.5 * (cuts[1:] + cuts[:-1]))
        assert share[row] == pytest.approx(np.diff(cuts)[winding(STAR, middles)].sum(), abs=1e-7)


def test_paths_through_corners_and_along_edges_agree_with_dense_sampling():
    # Whole-number coordinates line ends, corners and edges up, where roots coincide.
    rng, s = np.random.default_rng(13), (np.arange(4000) + 0.5) / 4000
    batch = hermite_batch(
        rng.integers(-3, 4, (300, 3, 2)).astype(float), rng.integers(-8, 9, (300, 3, 2)).astype(float)
    )
    share, _ = share_in_collision(PlanarWorld(**FREE, polygons=(SQUARE,)), batch)
    sampled = [winding(SQUARE, hermite(batch, row, s)).mean() for row in range(300)]
    np.testing.assert_allclose(share, sampled, atol=2e-3)


def test_overlapping_obstacles_add_up():
    batch = random_cubics(3, 10)
    one, _ = share_in_collision(PlanarWorld(**FREE, polygons=(SQUARE,)), batch)
    two, _ = share_in_collision(PlanarWorld(**FREE, polygons=(SQUARE, SQUARE)), batch)
    np.testing.assert_allclose(two, 2 * one)


@pytest.mark.parametrize("depth", [1e-2, 1e-5, 1e-8])
def test_corner_clipped_between_samples_is_found(depth):
    world = PlanarWorld(**FREE, polygons=(SQUARE,))
    for sign, hit in ((-1.0, True), (1.0, False)):
        middle = 1.0 + sign * depth / np.sqrt(2.0)
        batch = straight([middle - 1.7, middle + 1.7], [middle + 1.3, middle - 1.3])
        share, valid = share_in_collision(world, batch)
        assert valid[0] == (not hit)
        # Straight across a right angle at 45 degrees: twice the depth of 3 sqrt(2) in all.
        assert share[0] == pytest.approx(2 * depth / np.hypot(3, 3) if hit else 0.0, rel=1e-5)


@pytest.mark.parametrize("depth", [1e-3, 1e-6, 1e-9])
def test_tangent_to_an_edge(depth):
    # y = 1 + gap + (x^2 for x = 2 u - 1): as a cubic with these ends and slopes.
    world = PlanarWorld(**FREE, polygons=(SQUARE,))
    for sign in (1.0, -1.0):
        y = 2.0 + sign * depth
        keys, slopes = np.array([[[-1.0, y], [1.0, y]]]), np.array([[[2.0, -4.0], [2.0, 4.0]]])
        share, valid = share_in_collision(world, hermite_batch(keys, slopes))
        assert valid[0] == (sign > 0)
        assert share[0] == pytest.approx(np.sqrt(depth) if sign < 0 else 0.0, rel=1e-4)


@pytest.mark.parametrize(
    ("start", "end", "share"),
    [
        ([-0.5, 0.2], [0.5, -0.3], 1.0),  # inside all along
        ([0.0, 0.0], [3.0, 0.0], 1 / 3),  # starts inside
        ([-3.0, 0.0], [0.0, 0.0], 1 / 3),  # ends inside
        ([-2.0, -2.0], [2.0, 2.0], 0.5),  # through two corners
        ([0.0, -2.0], [0.0, 2.0], 0.5),
        ([-2.0, 1.0], [2.0, 1.0], 0.0),  # along an edge
        ([-2.0, -1.0], [2.0, -1.0], 0.0),
        ([-1.0, -1.0], [1.0, -1.0], 0.0),
        ([-1.0, 0.0], [-3.0, 0.0], 0.0),  # starts on an edge and leaves
        ([-1.0, 0.0], [1.0, 0.0], 1.0),  # starts on an edge and goes through
        ([0.0, 2.0], [2.0, 0.0], 0.0),  # touches a corner
        ([0.3, 0.3], [0.3, 0.3], 1.0),  # stands still inside
        ([1.3, 0.3], [1.3, 0.3], 0.0),  # stands still outside
        ([1.0, 1.0], [1.0, 1.0], 0.0),  # stands still on a corner
    ],
)
def test_straight_paths(start, end, share):
    found, valid = share_in_collision(PlanarWorld(**FREE, polygons=(SQUARE,)), straight(start, end))
    assert found[0] == pytest.approx(share, abs=1e-9)
    assert valid[0] == (share == 0.0)


def test_share_does_not_depend_on_where_the_origin_is():
    batch, shift = random_cubics(4, 20), np.array([3.0, -5.0])
    moved = hermite_batch(batch.key_positions + shift, batch.knot_slopes)
    one, _ = share_in_collision(PlanarWorld(**FREE, polygons=(STAR,)), batch)
    two, _ = share_in_collision(PlanarWorld(**FREE, polygons=(STAR + shift,)), moved)
    np.testing.assert_allclose(one, two, atol=1e-12)


def test_walls_count_as_obstacles():
    world = PlanarWorld(-np.ones(2), np.ones(2))
    batch = random_cubics(5, 12)
    s = (np.arange(100_000) + 0.5) / 100_000
    share, valid = share_in_collision(world, batch)
    sampled = [(np.abs(hermite(batch, row, s)) > 1).any(axis=1).mean() for row in range(12)]
    np.testing.assert_allclose(share, sampled, atol=1e-4)
    assert not valid.any()
    assert world.time_in_collision(straight([-1.0, -1.0], [1.0, -1.0]))[1][0]


def test_moving_disc_agrees_with_dense_sampling():
    rng, batch = np.random.default_rng(6), random_cubics(6, 12)
    discs = tuple(MovingDisc(rng.uniform(-1, 1, 2), 0.7, rng.normal(0, 1, 2)) for _ in range(2))
    world = PlanarWorld(**FREE, discs=discs)
    start_time, s = 0.4, (np.arange(100_000) + 0.5) / 100_000
    share, valid = share_in_collision(world, batch, start_time)
    for row in range(12):
        positions, times = hermite(batch, row, s), start_time + batch.duration[row] * s
        sampled = 0.0
        for disc in discs:
            centres = disc.centre + times[:, None] * disc.velocity
            sampled += (np.linalg.norm(positions - centres, axis=1) < disc.radius).mean()
        assert share[row] == pytest.approx(sampled, abs=1e-4)
        assert valid[row] == (sampled == 0.0)
    later, _ = share_in_collision(world.at(start_time), batch)
    np.testing.assert_allclose(later, share, atol=1e-12)


def test_disc_grazed_between_samples():
    world = PlanarWorld(**FREE, discs=(MovingDisc((0.0, 0.0), 0.5),))
    for gap, valid in ((1e-9, True), (-1e-9, False)):
        share, free = share_in_collision(world, straight([-3.0, 0.5 + gap], [3.0, 0.5 + gap]))
        assert free[0] == valid
        assert share[0] == pytest.approx(0.0 if valid else 2 * np.sqrt(0.25 - (0.5 + gap) ** 2) / 6, rel=1e-4)


def test_disc_that_flees_is_not_hit_and_one_that_follows_is():
    batch = straight([0.0, 0.0], [1.0, 0.0])
    for velocity, valid in ((2.0, True), (0.0, False)):
        world = PlanarWorld(**FREE, discs=(MovingDisc((0.6, 0.0), 0.5, (velocity, 0.0)),))
        assert world.time_in_collision(batch)[1][0] == valid
    behind = PlanarWorld(**FREE, discs=(MovingDisc((-0.6, 0.0), 0.5, (1.5, 0.0)),))
    assert behind.stays(_as_trajectory(batch))[0].start == pytest.approx(0.2)


def _as_trajectory(batch):
    return Trajectory.from_points(
        batch.knots * batch.duration[0], batch.key_positions[0], batch.knot_slopes[0] / batch.duration[0]
    )


def test_stays_agree_with_the_share_and_with_bisection():
    world = PlanarWorld(**FREE, polygons=(STAR,), discs=(MovingDisc((0.0, 2.0), 0.4, (0.3, 0.0)),))
    batch = random_cubics(7, 20)
    share, valid = share_in_collision(world, batch)
    for row in range(20):
        one = hermite_batch(batch.key_positions[[row]], batch.knot_slopes[[row]], batch.duration[[row]])
        trajectory = _as_trajectory(one)
        stays = world.stays(trajectory)
        assert sum(stay.end - stay.start for stay in stays) == pytest.approx(
            share[row] * batch.duration[row], abs=1e-9
        )
        first = stays[0].start if stays else None
        assert (first is None) == valid[row]
        if first is not None and first > 1e-6:
            before, after = trajectory(first - 1e-7), trajectory(first + 1e-7)
            assert not world.inside(before, first - 1e-7)
            assert world.inside(after, first + 1e-7)


def test_quintic_trajectory_is_checked_too():
    rng = np.random.default_rng(8)
    world = PlanarWorld(**FREE, polygons=(STAR,), discs=(MovingDisc((0.5, -1.0), 0.4, (-0.2, 0.4)),))
    points = rng.normal(0.0, [[[0.8]], [[4.0]], [[8.0]]], (3, 3, 2))
    trajectory = Trajectory.from_points([1.0, 1.7, 2.5], *points)
    times = 1.0 + 1.5 * (np.arange(100_000) + 0.5) / 100_000
    positions = trajectory(times)
    centres = world.discs[0].centre + times[:, None] * world.discs[0].velocity
    sampled = winding(STAR, positions).mean() + (np.linalg.norm(positions - centres, axis=1) < 0.4).mean()
    assert sampled > 0.05
    spent = sum(stay.end - stay.start for stay in world.stays(trajectory))
    assert spent == pytest.approx(1.5 * sampled, abs=1e-4)


def test_term_weighs_the_share_and_explains():
    world = PlanarWorld(
        **FREE, polygons=(SQUARE,), discs=(MovingDisc((5.0, 3.0), 0.5, (-1.0, 0.0)),), names=("the square",)
    )
    term, batch = world.term(weight=7.0), straight([-3.0, 0.5], [3.0, 0.5])
    assert isinstance(term, CollisionTerm)
    cost, valid = term(batch)
    assert cost[0] == pytest.approx(7.0 / 3.0)
    assert not valid[0]
    (line,) = term.explain(_as_trajectory(batch))
    assert line == "in collision with the square from 0.333 s to 0.667 s, up to 500 mm deep"
    past = straight([0.0, 3.0], [0.0, 3.0])
    assert term.explain(_as_trajectory(past)) == []
    (line,) = world.at(4.0).term().explain(_as_trajectory(past).shifted(100.0))
    assert line.startswith("in collision with disc 1 from 0.500 s to 1.000 s")


def test_infinite_duration_is_never_valid():
    batch = random_cubics(11, 3)
    batch.duration[1] = np.inf
    world = PlanarWorld(**FREE, discs=(MovingDisc((9.0, 9.0), 0.1, (1.0, 0.0)),))
    seconds, valid = world.time_in_collision(batch)
    assert seconds.tolist() == [0.0, np.inf, 0.0]
    assert valid.tolist() == [True, False, True]


def test_paths_of_the_search_agree_with_their_trajectory():
    # From rest to rest, through random via-points: what the batch says and what the one trajectory says.
    limits, basis = Limits(np.ones(2), np.ones(2)), OptimalBasis.uniform(1)
    via = np.random.default_rng(12).uniform(-2, 2, (30, 2))
    world = PlanarWorld(**FREE, polygons=(STAR,))
    for point in via:
        trajectory = synthesize(basis, [[-3, 0], point, [3, 0]], np.zeros(2), np.zeros(2), limits)
        dense = winding(STAR, trajectory(np.linspace(0, trajectory.duration, 5001)))
        spent = sum(stay.end - stay.start for stay in world.stays(trajectory)) / trajectory.duration
        assert spent == pytest.approx(dense.mean(), abs=2e-3)
