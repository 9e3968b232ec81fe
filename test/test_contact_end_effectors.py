"""End effectors: how plane coordinates place them, and their distances to objects, against brute force."""

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import Disc, PlanarShape, Rectangle
from vpsto_ros.exceptions import InvalidInputError

BAR = Rectangle(half_size=(0.1, 0.02))
MIXED = EndEffectors((Disc(radius=0.015), BAR, Disc(radius=0.03)))


def outline(shape, pose, count=2000):
    """Points on the outline of a shape at a pose."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return shape.boundary(count)[0] @ np.array([[c, s], [-s, c]]) + pose[:2]


def nearest(first, first_pose, second, second_pose):
    """Distance of two outlines, by trying all pairs of points."""
    return cKDTree(outline(first, first_pose)).query(outline(second, second_pose))[0].min()


def test_coordinates_follow_each_other():
    assert MIXED.count == 3 and MIXED.dof == 7 and MIXED.columns == (0, 2, 5)
    two = EndEffectors.discs(0.02, 2)
    assert two.dof == 4 and two.columns == (0, 2) and two.shapes == (Disc(radius=0.02),) * 2
    hand = EndEffectors.rectangle(0.2, 0.06)
    assert hand.dof == 3 and hand.shapes[0].half_size == (0.1, 0.03)


def test_rows_say_what_kernels_need():
    expected = [
        (0.0, 0.0, 0.015, 0.015, 0, 0),
        (0.1, 0.02, 0.0, math.hypot(0.1, 0.02), 2, 1),
        (0.0, 0.0, 0.03, 0.03, 5, 0),
    ]
    np.testing.assert_allclose(MIXED.rows, expected)


def test_poses_take_each_end_effectors_own_coordinates():
    points = np.random.default_rng(0).normal(size=(4, 5, 7))
    poses = MIXED.poses(points)
    assert poses.shape == (4, 5, 3, 3)
    np.testing.assert_array_equal(poses[..., 0, :2], points[..., :2])
    np.testing.assert_array_equal(poses[..., 1, :], points[..., 2:5])
    np.testing.assert_array_equal(poses[..., 2, :2], points[..., 5:])
    assert not poses[..., [0, 2], 2].any(), "discs have no yaw"
    np.testing.assert_array_equal(MIXED.poses(points[0, 0]), poses[0, 0])


@pytest.mark.parametrize("name", ["disc", "box", "tee"])
def test_gaps_are_the_distances_of_the_outlines(name):
    shapes = {"disc": PlanarShape.disc(0.05), "box": PlanarShape.box(0.12, 0.08), "tee": PlanarShape.tee()}
    shape, rng, checked = shapes[name], np.random.default_rng(1), 0
    for _ in range(25):
        pose = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(-4.0, 4.0)])
        angles, yaw = rng.uniform(-math.pi, math.pi, 3), rng.uniform(-4.0, 4.0)
        centres = pose[:2] + rng.uniform(0.12, 0.25, (3, 1)) * np.stack([np.cos(angles), np.sin(angles)], 1)
        point = np.concatenate([centres[0], centres[1], [yaw], centres[2]])
        gaps = MIXED.gaps(shape, pose, point)
        for e, effector in enumerate(MIXED.shapes):
            own = PlanarShape((effector,))
            if effector is BAR and overlaps(own, MIXED.poses(point)[e], shape, pose):
                continue
            distance = nearest(own, MIXED.poses(point)[e], shape, pose)
            if effector is BAR and name != "disc":
                assert gaps[e] <= distance + 1e-9, "a lower bound"
                continue
            checked += 1
            # Samples miss corners by half their spacing at most.
            assert distance - 2e-4 < gaps[e] <= distance + 1e-9
    assert checked > 40


def overlaps(first, first_pose, second, second_pose):
    c, s = math.cos(second_pose[2]), math.sin(second_pose[2])
    seen = (outline(first, first_pose) - second_pose[:2]) @ np.array([[c, -s], [s, c]])
    return second.signed_distance(seen).min() < 0.0


def test_gaps_between_faces_and_of_penetrating_discs_are_exact():
    hand, box = EndEffectors.rectangle(0.2, 0.04), PlanarShape.box(0.12, 0.08)
    turned = np.array([0.0, 0.0, math.pi / 2])
    assert hand.gaps(box, np.zeros(3), [0.03, 0.09, 0.0])[0] == pytest.approx(0.03)
    assert hand.gaps(box, turned, [0.03, 0.09, 0.0])[0] == pytest.approx(0.01)
    assert hand.gaps(box, turned, [0.03, 0.07, 0.0])[0] == pytest.approx(-0.01)
    finger = EndEffectors.discs(0.015)
    assert finger.gaps(PlanarShape.disc(0.05), np.array([0.3, 0.1, 0.0]), [0.34, 0.1])[0] == (
        pytest.approx(-0.025)
    )
    assert finger.gaps(box, np.zeros(3), [0.065, 0.0])[0] == pytest.approx(-0.01)


def test_gaps_do_not_depend_on_the_frame():
    shape, rng = PlanarShape.tee(), np.random.default_rng(2)
    for _ in range(20):
        pose, poses = rng.normal(0.0, 0.1, 3), rng.normal(0.0, 0.2, (3, 3))
        turn, shift = rng.uniform(-3.0, 3.0), rng.normal(0.0, 1.0, 2)

        def moved(p, turn=turn, shift=shift):
            c, s = math.cos(turn), math.sin(turn)
            return np.array([c * p[0] - s * p[1] + shift[0], s * p[0] + c * p[1] + shift[1], p[2] + turn])

        def point(poses):
            return np.concatenate([poses[0][:2], poses[1], poses[2][:2]])

        np.testing.assert_allclose(
            MIXED.gaps(shape, moved(pose), point([moved(p) for p in poses])),
            MIXED.gaps(shape, pose, point(poses)),
            atol=1e-9,
        )


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        ((), "one or more"),
        ((PlanarShape.disc(0.1),), "one or more"),
        ((Disc((0.01, 0.0), 0.02),), "centred"),
        ((Rectangle((0.0, 0.0), (0.1, 0.02), 0.1),), "aligned"),
        ((Rectangle((0.0, -0.1), (0.1, 0.02)),), "centred"),
    ],
)
def test_what_cannot_be_an_end_effector_is_refused(shapes, message):
    with pytest.raises(InvalidInputError, match=message):
        EndEffectors(shapes)


def test_coordinates_of_another_robot_are_refused():
    with pytest.raises(InvalidInputError, match=r"\(\.\.\., 7\)"):
        MIXED.poses(np.zeros((3, 6)))
    with pytest.raises(InvalidInputError, match=r"plane coordinates must have shape \(7,\)"):
        MIXED.gaps(PlanarShape.disc(0.05), np.zeros(3), np.zeros(4))
    with pytest.raises(InvalidInputError, match=r"pose must have shape \(3,\)"):
        MIXED.gaps(PlanarShape.disc(0.05), np.zeros(2), np.zeros(7))
