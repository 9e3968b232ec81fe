"""Planar shapes against brute force: area integrals, outline, distances."""

import math

import numpy as np
import pytest

from vpsto_ros.contact.geometry import Disc, PlanarShape, Rectangle
from vpsto_ros.exceptions import InvalidInputError

UNION = PlanarShape(
    (
        Rectangle((0.01, 0.0), (0.05, 0.02), 0.3),
        Disc((0.04, 0.03), 0.03),
        Rectangle((-0.03, 0.02), (0.02, 0.03), -0.7),
    )
)
SHAPES = {
    "box": PlanarShape.box(0.12, 0.08),
    "tee": PlanarShape.tee(),
    "ell": PlanarShape.ell(0.14, 0.05, 0.1),
    "disc": PlanarShape.disc(0.05),
    "union": UNION,
}


def inside(shape, points):
    result = np.zeros(len(points), dtype=bool)
    for cx, cy, hx, hy, angle, radius in shape.as_array():
        d = points - (cx, cy)
        local = np.stack(
            [
                math.cos(angle) * d[:, 0] + math.sin(angle) * d[:, 1],
                math.cos(angle) * d[:, 1] - math.sin(angle) * d[:, 0],
            ],
            1,
        )
        result |= np.hypot(*d.T) <= radius if radius > 0 else np.all(np.abs(local) <= (hx, hy), axis=1)
    return result


def grid(shape, n=1200):
    axis = ((np.arange(n) + 0.5) / n * 2 - 1) * shape.bounding_radius
    points = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    return points[inside(shape, points)], (axis[1] - axis[0]) ** 2


@pytest.mark.parametrize("name", SHAPES)
def test_area_integrals_agree_with_a_fine_grid(name):
    shape = SHAPES[name]
    points, cell = grid(shape)
    center = points.mean(0)
    assert shape.area() == pytest.approx(len(points) * cell, rel=4e-3)
    np.testing.assert_allclose(shape.centroid(), center, atol=1e-4)
    assert shape.polar_radius == pytest.approx(
        math.sqrt(np.mean(np.sum((points - center) ** 2, 1))), rel=3e-3
    )
    for at in ((0.0, 0.0), (0.03, -0.05)):
        assert shape.mean_distance(at) == pytest.approx(np.mean(np.hypot(*(points - at).T)), rel=3e-3)


def test_known_integrals():
    assert PlanarShape.disc(0.06).mean_distance() == pytest.approx(0.04, rel=1e-4)
    assert PlanarShape.disc(0.06).polar_radius == pytest.approx(0.06 / math.sqrt(2), rel=1e-4)
    square = (math.sqrt(2) + math.asinh(1)) / 3 / 2  # mean distance to the centre of a unit square
    assert PlanarShape.box(0.12, 0.12).mean_distance() == pytest.approx(0.12 * square, rel=1e-8)
    tee = PlanarShape.tee()
    assert tee.area() == pytest.approx(2 * 0.12 * 0.04, rel=1e-12)
    np.testing.assert_allclose(tee.centroid(), 0.0, atol=1e-15)
    np.testing.assert_allclose(PlanarShape.ell().centroid(), 0.0, atol=1e-15)


@pytest.mark.parametrize("name", SHAPES)
def test_bounding_radius_holds_the_shape_and_is_tight(name):
    points, _ = SHAPES[name].boundary(4000)
    reach = np.hypot(*points.T).max()
    assert reach <= SHAPES[name].bounding_radius + 1e-12
    assert reach >= SHAPES[name].bounding_radius - 5e-4


@pytest.mark.parametrize("name", SHAPES)
def test_boundary_lies_on_the_outline_with_outward_normals(name):
    shape = SHAPES[name]
    points, normals = shape.boundary(300)  # none of them is a corner of the T, which belongs to two edges
    np.testing.assert_allclose(np.hypot(*normals.T), 1.0, atol=1e-12)
    np.testing.assert_allclose(shape.signed_distance(points), 0.0, atol=1e-5)
    assert not inside(shape, points + 1e-5 * normals).any()
    assert inside(shape, points - 1e-5 * normals).all()


def test_boundary_is_evenly_spaced_and_runs_counter_clockwise():
    points, _ = PlanarShape.tee().boundary(560)
    steps = np.hypot(*(np.roll(points, -1, 0) - points).T)
    # A step around a corner cuts it; all others are 1 mm along the outline of 0.56 m.
    assert np.median(steps) == pytest.approx(1e-3, rel=1e-9)
    assert steps.max() < 1e-3 + 1e-9
    assert steps.min() > 0.7e-3 - 1e-9
    x, y = points.T
    assert 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) == pytest.approx(
        PlanarShape.tee().area(), rel=1e-3
    )


def test_outline_does_not_depend_on_how_the_union_is_cut():
    overlapping = PlanarShape(
        (Rectangle((0, 0.02), (0.06, 0.02)), Rectangle((0, -0.04), (0.02, 0.08)))
    ).recentred()
    for shape in (PlanarShape.tee(), overlapping):
        assert shape.area() == pytest.approx(0.0096, rel=1e-9)
        segments = shape.outline_segments
        assert np.hypot(*(segments[:, 2:4] - segments[:, :2]).T).sum() == pytest.approx(0.56, abs=1e-6)


@pytest.mark.parametrize("name", SHAPES)
def test_signed_distance_agrees_with_brute_force(name):
    shape = SHAPES[name]
    points = np.random.default_rng(0).uniform(-0.15, 0.15, (400, 2))
    outline, _ = shape.boundary(20000)
    nearest = np.array([np.hypot(*(outline - p).T).min() for p in points])
    sign = np.where(inside(shape, points), -1.0, 1.0)
    np.testing.assert_allclose(shape.signed_distance(points), sign * nearest, atol=2e-5)


def test_rows_mark_discs_by_their_radius():
    rows = PlanarShape((Disc((0.1, 0.2), 0.3), Rectangle((1, 2), (3, 4), 0.5))).as_array()
    np.testing.assert_array_equal(rows, [[0.1, 0.2, 0, 0, 0, 0.3], [1, 2, 3, 4, 0.5, 0]])


def test_transform_turns_about_the_origin_of_the_frame():
    (corners,) = PlanarShape.box(0.2, 0.1).transform([1.0, 2.0, math.pi / 2])
    expected = {(1.05, 2.1), (1.05, 1.9), (0.95, 2.1), (0.95, 1.9)}
    assert {tuple(corner) for corner in np.round(corners, 12)} == expected
    assert len(UNION.transform([0, 0, 0])) == 3


@pytest.mark.parametrize(
    "make",
    [
        lambda: Disc(radius=0.0),
        lambda: Disc(radius=math.nan),
        lambda: Disc(center=(0, math.inf), radius=1),
        lambda: Rectangle(half_size=(0.1, -0.1)),
        lambda: Rectangle(half_size=(0.1, 0.1, 0.1)),
        lambda: Rectangle(half_size=(0.1, 0.1), angle=math.nan),
        lambda: PlanarShape(()),
        lambda: PlanarShape(("box",)),
        lambda: PlanarShape.ell(0.1, 0.2),
        lambda: PlanarShape.box().boundary(0),
        lambda: PlanarShape.box().signed_distance([[math.nan, 0]]),
        lambda: PlanarShape.box().transform([0, 0]),
    ],
)
def test_nonsense_is_refused(make):
    with pytest.raises(InvalidInputError):
        make()
