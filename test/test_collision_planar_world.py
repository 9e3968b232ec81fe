"""A planar world asked about points, what makes one usable, and the roots that its checks rest on."""

import numpy as np
import pytest

from vpsto_ros.collision import planar_kernels, planar_path_kernels
from vpsto_ros.collision.planar import CollisionTerm, MovingDisc, PlanarWorld
from vpsto_ros.collision.planar_roots import DEPTH, from_powers, roots
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory import Trajectory, TrajectoryBatch

FREE = {"lower": np.full(2, -10.0), "upper": np.full(2, 10.0)}
SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
STAR = np.array([[np.cos(a), np.sin(a)] for a in np.arange(10) * np.pi / 5]) * np.tile([2.0, 0.7], 5)[:, None]


def winding(polygon, points):
    """Whether points are inside, from the sum of the angles under which they see the edges."""
    a, b = polygon - points[:, None], np.roll(polygon, -1, axis=0) - points[:, None]
    angles = np.arctan2(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], (a * b).sum(axis=-1))
    return np.abs(angles.sum(axis=1)) > np.pi


def standing(dof):
    """A batch of one motion that stays at zero for a second."""
    none = np.zeros((1, 2, dof))
    return TrajectoryBatch(np.ones(1), np.empty((1, 0, dof)), None, None, none, np.array([0.0, 1.0]), none)


def test_inside_and_clearance_agree_with_brute_force():
    rng = np.random.default_rng(9)
    world = PlanarWorld(
        -2.5 * np.ones(2), 2.5 * np.ones(2), (STAR,), (MovingDisc((1.5, 1.5), 0.6, (-0.4, 0.0)),)
    )
    points, times = rng.uniform(-3, 3, (40, 10, 2)), rng.uniform(0, 2, (40, 10))
    centres = world.discs[0].centre + times[..., None] * world.discs[0].velocity
    in_disc = np.linalg.norm(points - centres, axis=-1) - 0.6
    in_star = winding(STAR, points.reshape(-1, 2)).reshape(40, 10)
    beyond = (np.abs(points) > 2.5).any(axis=-1)
    inside = world.inside(points, times)
    np.testing.assert_array_equal(inside, in_star | (in_disc < 0) | beyond)
    edge = np.linspace(STAR, np.roll(STAR, -1, axis=0), 4000).reshape(-1, 2)
    to_edge = np.array([[np.linalg.norm(edge - p, axis=1).min() for p in row] for row in points])
    excess = np.maximum(np.abs(points) - 2.5, 0.0)
    walls = np.where(beyond, -np.linalg.norm(excess, axis=-1), (2.5 - np.abs(points)).min(axis=-1))
    expected = np.minimum(np.minimum(np.where(in_star, -to_edge, to_edge), in_disc), walls)
    np.testing.assert_allclose(world.clearance(points, times), expected, atol=1e-3)
    np.testing.assert_array_equal(world.clearance(points, times) < 0, inside)
    assert world.inside([0.0, 0.0]).shape == ()
    assert world.inside(np.empty((0, 2))).shape == (0,)


def test_inflated_world_keeps_the_distance():
    world = PlanarWorld(**FREE, polygons=(STAR,), discs=(MovingDisc((3.0, 0.0), 0.5),))
    points = np.random.default_rng(10).uniform(-4, 4, (3000, 2))
    np.testing.assert_array_equal(world.inflated(0.3).inside(points), world.clearance(points) < 0.3)
    assert world.inflated(0.0) is world
    with pytest.raises(InvalidInputError, match="negative"):
        world.inflated(-0.1)
    with pytest.raises(InvalidInputError, match="lower must be below upper"):
        world.inflated(10.0)


@pytest.mark.parametrize("degree", [1, 2, 3, 6, 10])
def test_roots_of_products_are_found(degree):
    rng = np.random.default_rng(degree)
    for _ in range(50):
        wanted = np.sort(rng.uniform(-0.5, 1.5, degree))
        if np.diff(wanted, prepend=-9.0).min() < 0.02:
            continue
        power = np.polynomial.polynomial.polyfromroots(wanted)
        found = np.empty(40)
        form = from_powers(power[None, :, None])[0, :, 0]
        count = roots(form, degree, 1e-13 * np.abs(form).max(), np.empty((DEPTH, degree + 4)), found, 0)
        inside = wanted[(wanted > 0) & (wanted < 1)]
        np.testing.assert_allclose(np.sort(found[:count]), inside, atol=1e-8)


def test_root_on_a_halving_point_and_round_off():
    # (u - 1/2)(u - 1/4)(u - 3/4): every root is where an interval is cut in two.
    form = from_powers(np.polynomial.polynomial.polyfromroots([0.25, 0.5, 0.75])[None, :, None])[0, :, 0]
    found, stack = np.empty(20), np.empty((DEPTH, 8))
    count = roots(form, 3, 1e-13, stack, found, 0)
    assert set(np.round(found[:count], 9)) == {0.25, 0.5, 0.75}
    noise = 1e-15 * np.random.default_rng(0).normal(size=4)
    assert roots(noise, 3, 1e-13, stack, found, 0) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"polygons": ([[0, 0], [1, 1], [1, 0], [0, 1]],)}, "polygon 1 intersects itself: its edges 1 and 3"),
        ({"polygons": (SQUARE, [[0, 0], [1, 0]])}, "polygon 2 must have at least 3 corners"),
        ({"polygons": ([],)}, "polygon 1 must have at least 3 corners"),
        ({"polygons": ([[0, 0], [1, 1], [2, 2]],)}, "no area"),
        ({"polygons": ([[0, 0], [1, 0], [1, 0], [0, 1]],)}, "corner 2 and the next one are the same"),
        ({"polygons": ([[0, 0], [1, 0], [0, 1], [0, 0]],)}, "corner 4 and the next one are the same"),
        ({"polygons": ([[0, 0], [2, 0], [1, 0], [1, 1]],)}, "intersects itself"),
        ({"polygons": ([[0, 0], [2, 0], [2, 2], [1, 0], [0, 2]],)}, "intersects itself"),
        ({"polygons": ([[0, 0], [1, np.nan], [1, 1]],)}, "must be finite"),
        ({"polygons": (["a", "b", "c"],)}, "corners must be numbers"),
        ({"polygons": (np.zeros((3, 3)),)}, "at least 3 corners"),
        ({"lower": [0.0, 0.0], "upper": [1.0, 0.0]}, "lower must be below upper"),
        ({"lower": [0.0, np.nan]}, "lower must be two numbers"),
        ({"upper": 1.0}, "upper must be two numbers"),
        ({"discs": ((0.0, 0.0, 1.0),)}, "must be MovingDisc"),
        ({"discs": 5}, "discs must be a sequence"),
        ({"polygons": 5}, "polygons must be a sequence"),
        ({"polygons": (SQUARE,), "names": ("a", "b")}, "not the names of 1 polygons"),
        ({"polygons": (SQUARE,), "names": (None,)}, "not the names of 1 polygons"),
        ({"polygons": (SQUARE,), "names": None}, "names must be a sequence"),
        ({"polygons": (SQUARE,), "names": "a"}, "names must be a sequence"),
    ],
)
def test_bad_worlds_are_refused(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        PlanarWorld(**{**FREE, **arguments})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0.0, 0.0), 0.0), "radius must be finite and positive"),
        (((0.0, 0.0), -1.0), "radius"),
        (((0.0, 0.0), np.nan), "radius"),
        (((0.0, np.inf), 1.0), "centre must be two finite"),
        (((0.0, 0.0, 0.0), 1.0), "centre"),
        (((0.0, 0.0), 1.0, 2.0), "velocity"),
        (((0.0, 0.0), "big"), "radius"),
        (((0.0, 0.0), True), "radius"),
    ],
)
def test_bad_discs_are_refused(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        MovingDisc(*arguments)


def test_bad_queries_are_refused():
    world = PlanarWorld(**FREE, polygons=(SQUARE,))
    for call in (
        lambda: world.inside(np.zeros(3)),
        lambda: world.clearance([[0.0, np.nan]]),
        lambda: world.inside(np.zeros((4, 2)), np.zeros(3)),
        lambda: world.inside(np.zeros((4, 2)), np.inf),
        lambda: world.term(weight=0.0),
        lambda: world.term(weight=np.inf),
        lambda: world.term(weight=True),
        lambda: CollisionTerm(5),
        lambda: world.time_in_collision(standing(3)),
        lambda: world.time_in_collision(standing(2), np.nan),
        lambda: world.time_in_collision(standing(2), np.inf),
        lambda: world.time_in_collision(standing(2), "now"),
        lambda: world.inside("ab"),
        lambda: world.inside(np.zeros((4, 2)), "ab"),
        lambda: world.inside(None),
        lambda: world.inflated("a"),
        lambda: world.inflated(np.nan),
        lambda: world.inflated(True),
        lambda: world.with_discs(("a",)),
        lambda: world.with_discs(5),
        lambda: world.with_discs((MovingDisc((0.0, 0.0), 1.0),)).at(np.nan),
        lambda: MovingDisc((0.0, 0.0), 1.0).position("now"),
        lambda: world.stays(Trajectory.from_points([0.0, 1.0], np.zeros((2, 3)))),
    ):
        with pytest.raises(InvalidInputError):
            call()


def test_kernels_take_nan_for_a_collision():
    world = PlanarWorld(**FREE, polygons=(SQUARE,), discs=(MovingDisc((5.0, 5.0), 0.1, (1.0, 0.0)),)).packed
    nan, knots, keys = np.nan, np.array([0.0, 1.0]), np.full((1, 2, 2), 4.0)
    points, times = np.array([[nan, 3.0], [3.0, nan], [3.0, 3.0], [3.0, 3.0]]), np.array([0.0, 0.0, nan, 0.0])
    assert planar_kernels.inside_any(world, points, times).tolist() == [True, True, True, False]
    assert (planar_kernels.clearances(world, points, times) > 0.0).tolist() == [False, False, False, True]
    for where in ("keys", "slopes", "duration", "start", None):
        arrays = {"keys": keys.copy(), "slopes": np.zeros_like(keys), "duration": np.ones(1), "start": 0.0}
        if where == "start":
            arrays["start"] = nan
        elif where:
            arrays[where].flat[-1] = nan
        (seconds,) = planar_path_kernels.times_in_collision(world, knots, *arrays.values())
        assert seconds == (0.0 if where is None else np.inf)
