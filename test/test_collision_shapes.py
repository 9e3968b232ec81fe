"""Shapes and exact distances, against coal and against laws."""

import numpy as np
import pytest

coal = pytest.importorskip("coal")

from vpsto_ros.collision import distance as d  # noqa: E402
from vpsto_ros.collision.shapes import Box, Capsule, HalfSpace, Sphere, rotation_z  # noqa: E402
from vpsto_ros.exceptions import InvalidInputError  # noqa: E402


def random_rotation(rng):
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else q * [-1.0, 1.0, 1.0]


def frame_along(direction):
    z = direction / np.linalg.norm(direction)
    x = np.cross(z, [1.0, 0.0, 0.0] if abs(z[0]) < 0.9 else [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def coal_distance(first, pose, second, other_pose):
    return coal.distance(first, pose, second, other_pose, coal.DistanceRequest(), coal.DistanceResult())


def coal_capsule(a, direction, radius):
    pose = coal.Transform3s(frame_along(direction), a + 0.5 * direction)
    return coal.Capsule(radius, np.linalg.norm(direction)), pose


def test_capsule_and_box_agree_with_coal_also_when_they_overlap():
    rng = np.random.default_rng(0)
    deep = 0
    for _ in range(3000):
        rotation, centre, half = random_rotation(rng), rng.normal(size=3), rng.uniform(0.02, 0.6, 3)
        a, direction = centre + 0.6 * rng.normal(size=3), rng.normal(size=3) * rng.uniform(0.05, 1.0)
        ours = d.capsule_box_distance(np.append(a, direction), 0.07, d.box_row(centre, rotation, half))
        box = coal.Box(*(2.0 * half))
        theirs = coal_distance(*coal_capsule(a, direction, 0.07), box, coal.Transform3s(rotation, centre))
        assert ours == pytest.approx(theirs, abs=1e-6)
        deep += ours < -0.07
    assert deep > 200  # the axis itself is inside: the depth of the cores counts


def test_depth_is_the_shortest_way_out():
    rng = np.random.default_rng(1)
    half = np.array([0.3, 0.2, 0.4])
    checked = 0
    while checked < 200:
        p, e = rng.uniform(-0.5, 0.5, 3), rng.normal(size=3) * 0.4
        depth = -d.segment_box(*p, *e, *half)
        if depth <= 0.0:
            continue
        checked += 1
        steps = rng.normal(size=(300, 3))
        steps /= np.linalg.norm(steps, axis=1, keepdims=True)
        for step in steps:  # no shorter translation separates, in any direction
            assert d.segment_box(*(p + 0.99 * depth * step), *e, *half) < 0.0


def test_segments_agree_with_coal_parallel_and_without_length_too():
    rng = np.random.default_rng(2)
    for case in range(3000):
        p, q, e, f = rng.normal(size=(4, 3))
        if case % 5 == 0:
            f = -0.7 * e
        if case % 7 == 0:
            e = 1e-9 * e
        ours = d.capsule_capsule_distance(np.append(p, e), np.append(q, f), 0.3)
        theirs = coal_distance(*coal_capsule(p, e, 0.1), *coal_capsule(q, f, 0.2))
        assert ours == pytest.approx(theirs, abs=1e-6)
    point = np.append(rng.normal(size=3), np.zeros(3))
    other = np.append(rng.normal(size=3), np.zeros(3))
    assert d.capsule_capsule_distance(point, other, 0.0) == pytest.approx(
        np.linalg.norm(point[:3] - other[:3])
    )


def test_segment_to_box_against_dense_sampling():
    rng = np.random.default_rng(3)
    t = np.linspace(0.0, 1.0, 20_001)[:, None]
    for case in range(200):
        p, e, half = rng.normal(size=3), rng.normal(size=3), rng.uniform(0.05, 0.8, 3)
        if case % 4 == 0:
            e[rng.integers(3)] = 0.0  # never crosses these planes
        outside = np.maximum(np.abs(p + t * e) - half, 0.0)
        sampled = (outside**2).sum(axis=1).min()
        assert d.segment_box_squared(*p, *e, *half) <= sampled + 1e-12
        assert d.segment_box_squared(*p, *e, *half) >= sampled - 1e-4 * np.sqrt(sampled) - 1e-7


def test_signed_distance_has_no_step_where_the_cores_begin_to_touch():
    half = np.array([0.3, 0.2, 0.1])
    outside = d.segment_box(-1.0, 0.0, 0.1 + 1e-9, 2.0, 0.0, 0.0, *half)
    inside = d.segment_box(-1.0, 0.0, 0.1 - 1e-9, 2.0, 0.0, 0.0, *half)
    assert outside == pytest.approx(1e-9, abs=1e-12)
    assert inside == pytest.approx(-1e-9, abs=1e-12)


def test_half_space_counts_the_lower_end():
    plane = np.array([0.0, 0.0, 1.0, 0.1])
    segment = np.array([0.0, 0.0, 0.5, 0.3, 0.0, -0.2])
    assert d.capsule_plane_distance(segment, 0.05, plane) == pytest.approx(0.15)


def test_shapes_are_normalised_and_frozen():
    plane = HalfSpace([0.0, 0.0, 2.0], 0.5)
    np.testing.assert_allclose(plane.normal, [0.0, 0.0, 1.0])
    assert plane.offset == 0.25
    box = Box([1.0, 0.0, 0.0], [0.1, 0.1, 0.1], rotation_z(0.3))
    with pytest.raises(ValueError, match="read-only"):
        box.centre[0] = 3.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Box([0, 0], [1, 1, 1], name="crate"), r"crate: centre must be finite with shape \(3,\)"),
        (lambda: Box([0, 0, np.nan], [1, 1, 1]), "centre must be finite"),
        (lambda: Box([0, 0, 0], [1, 0, 1]), "half_size must be positive"),
        (lambda: Box([0, 0, 0], [1, 1, 1], np.diag([1.0, 1.0, -1.0])), "right-handed rotation"),
        (lambda: Box([0, 0, 0], [1, 1, 1], 2.0 * np.eye(3)), "rotation"),
        (lambda: Sphere([0, 0, 0], -1.0, "ball"), "ball: radius must be positive"),
        (lambda: Sphere("here", 1.0), "centre must be finite"),
        (lambda: Sphere([0, 0, 0], np.inf), "radius must be a finite number"),
        (lambda: Sphere([0, 0, 0], True), "radius must be a finite number"),
        (lambda: Capsule([0, 0, 0], [[0, 0, 1]], 0.1), "b must be finite"),
        (lambda: HalfSpace([0, 0, 0], 0.0, "wall"), "wall: normal must not be zero"),
        (lambda: HalfSpace([0, 0, 1], "low"), "offset must be a finite number"),
        (lambda: Box([0, 0, 1j], [1, 1, 1]), "centre must be finite"),
        (lambda: Box(np.array([0, 0, 1j]), [1, 1, 1]), "centre must be finite"),
        (lambda: Sphere([0, 0, 0], 1j), "radius must be a finite number"),
        (lambda: rotation_z(np.nan), "angle must be a number"),
        (lambda: rotation_z(np.inf), "angle must be finite"),
        (lambda: rotation_z("north"), "angle must be a number"),
    ],
)
def test_malformed_shapes_are_refused(make, message):
    with pytest.raises(InvalidInputError, match=message):
        make()
