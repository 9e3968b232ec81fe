"""Laws of quasi-static pushing: what must hold for every shape, tool and path."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from vpsto_ros.contact.geometry import Disc, PlanarShape, Rectangle
from vpsto_ros.contact.pushing import PushingModel, push_directions, rollout
from vpsto_ros.exceptions import InvalidInputError

RADIUS = 0.015
DISC = PlanarShape.disc(RADIUS)
PADDLE = PlanarShape.box(0.02, 0.06)
SHAPES = {
    "box": PlanarShape.box(0.12, 0.08),
    "tee": PlanarShape.tee(),
    "ell": PlanarShape.ell(),
    "disc": PlanarShape.disc(0.05),
    "mixed": PlanarShape((Disc((0.03, 0.0), 0.03), Rectangle((-0.02, 0.0), (0.05, 0.02), 0.4))).recentred(),
}
TOLERANCE = 2e-6


def paths(count, samples=60, seed=0, yaw=False):
    """Curved pushes from all around through the object."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-math.pi, math.pi, count)
    start = 0.2 * np.stack([np.cos(angle), np.sin(angle)], 1)
    end = -0.6 * start + rng.normal(0, 0.03, (count, 2))
    middle = (start + end) / 2 + rng.normal(0, 0.04, (count, 2))
    t = np.linspace(0, 1, samples)[None, :, None]
    path = (1 - t) ** 2 * start[:, None] + 2 * t * (1 - t) * middle[:, None] + t**2 * end[:, None]
    if yaw:
        path = np.concatenate([path, angle[:, None, None] + rng.uniform(-1, 1, (count, 1, 1)) * t], axis=2)
    return path


def rotation(yaw):
    return np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])


def in_frame(pose, points):
    return (points - pose[:2]) @ rotation(pose[2])


def transformed(pose, points):
    """Poses or points of a frame at `pose`, in the parent frame."""
    moved = points.copy()
    moved[..., :2] = points[..., :2] @ rotation(pose[2]).T + pose[:2]
    if points.shape[-1] == 3:
        moved[..., 2] += pose[2]
    return moved


@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("name", SHAPES)
def test_a_disc_never_penetrates_and_nothing_moves_untouched(name, friction):
    model = PushingModel(SHAPES[name], DISC, friction=friction)
    tool = paths(24)
    result = rollout(model, np.zeros(3), tool)
    assert np.all(result.penetration == 0.0)
    for poses, path in zip(result.object_pose, tool, strict=True):
        gaps = [
            model.shape.signed_distance(in_frame(pose, p[None]))[0] - RADIUS
            for pose, p in zip(poses, path, strict=True)
        ]
        assert min(gaps) > -TOLERANCE
    still = np.all(np.diff(result.object_pose, axis=1) == 0.0, axis=2)
    np.testing.assert_array_equal(still, ~result.touched[:, 1:])
    assert 0.2 < result.touched.mean() < 0.9


@pytest.mark.parametrize("name", SHAPES)
def test_a_turning_paddle_never_penetrates(name):
    model = PushingModel(SHAPES[name], PADDLE)
    tool = paths(16, yaw=True, seed=4)
    result = rollout(model, np.zeros(3), tool)
    assert np.all(result.penetration == 0.0)
    paddle, _ = PADDLE.boundary(400)
    outline, _ = model.shape.boundary(400)
    for poses, path in zip(result.object_pose[:, ::4], tool[:, ::4], strict=True):
        for pose, at in zip(poses, path, strict=True):
            assert model.shape.signed_distance(in_frame(pose, transformed(at, paddle))).min() > -1e-5
            assert PADDLE.signed_distance(in_frame(at, transformed(pose, outline))).min() > -1e-5


def test_far_away_objects_stay():
    result = rollout(PushingModel(SHAPES["tee"], DISC), [5.0, 5.0, 1.0], paths(5))
    assert not result.touched.any()
    np.testing.assert_array_equal(result.object_pose, np.broadcast_to([5.0, 5.0, 1.0], (5, 60, 3)))


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_a_push_through_the_centre_goes_straight(friction):
    model = PushingModel(SHAPES["box"], DISC, friction=friction)
    path = np.stack([np.linspace(-0.15, 0.05, 50), np.zeros(50)], 1)
    poses = rollout(model, np.zeros(3), path).object_pose[0]
    np.testing.assert_allclose(poses[:, 0], np.maximum(path[:, 0] + 0.06 + RADIUS, 0.0), atol=1e-6)
    np.testing.assert_allclose(poses[:, 1:], 0.0, atol=1e-12)


def test_a_push_through_a_shifted_centre_of_friction_goes_straight():
    path = np.stack([np.linspace(-0.15, 0.0, 50), np.full(50, 0.02)], 1)
    model = PushingModel(SHAPES["box"], DISC, center_of_friction=(0.01, 0.02))
    assert abs(rollout(model, np.zeros(3), path).object_pose[0, -1, 2]) < 1e-9
    assert rollout(PushingModel(SHAPES["box"], DISC), np.zeros(3), path).object_pose[0, -1, 2] < -0.2


def test_mirrored_pushes_move_mirrored():
    model = PushingModel(SHAPES["tee"], DISC, friction=0.3)
    tool = paths(12)
    mirror = np.array([-1.0, 1.0])
    ours = rollout(model, np.zeros(3), tool).object_pose
    theirs = rollout(model, np.zeros(3), tool * mirror).object_pose
    np.testing.assert_allclose(theirs * [-1.0, 1.0, -1.0], ours, atol=1e-7)


@pytest.mark.parametrize("tool", [DISC, PADDLE], ids=["disc", "paddle"])
def test_motion_does_not_depend_on_the_frame(tool):
    model = PushingModel(SHAPES["ell"], tool, friction=0.3)
    path = paths(12, yaw=tool is PADDLE)
    frame = np.array([0.6, -0.3, 2.1])
    ours = rollout(model, np.zeros(3), path).object_pose
    if tool is PADDLE:
        theirs = rollout(model, frame, transformed(frame, path)).object_pose
    else:
        theirs = rollout(model, frame, path @ rotation(frame[2]).T + frame[:2]).object_pose
    np.testing.assert_allclose(theirs, transformed(frame, ours), atol=1e-7)


def test_batches_equal_single_rollouts_and_rows_are_shared():
    model = PushingModel(SHAPES["tee"], DISC)
    rng = np.random.default_rng(1)
    tool, start = paths(6), rng.normal(0, 0.01, (6, 3))
    options = {
        "pressure_radius": rng.uniform(0.03, 0.06, 6),
        "friction": rng.uniform(0, 0.5, 6),
        "center_of_friction": rng.normal(0, 0.01, (6, 2)),
    }
    batch = rollout(model, start, tool, **options)
    for b in range(6):
        single = rollout(model, start[b], tool[b], **{key: value[b] for key, value in options.items()})
        np.testing.assert_array_equal(single.object_pose[0], batch.object_pose[b])
        np.testing.assert_array_equal(single.touched[0], batch.touched[b])
    shared = rollout(model, start, tool[0]).object_pose
    tiled = rollout(model, start, np.repeat(tool[:1], 6, axis=0)).object_pose
    np.testing.assert_array_equal(shared, tiled)


def test_options_replace_the_models_values():
    tool, start = paths(4), np.zeros(3)
    model = PushingModel(
        SHAPES["box"], DISC, pressure_radius=0.03, friction=0.4, center_of_friction=(0.01, 0.0)
    )
    plain = PushingModel(SHAPES["box"], DISC)
    replaced = rollout(plain, start, tool, pressure_radius=0.03, friction=0.4, center_of_friction=(0.01, 0.0))
    np.testing.assert_array_equal(replaced.object_pose, rollout(model, start, tool).object_pose)


@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_a_flat_push_with_a_paddle_stays_flat(friction):
    model = PushingModel(SHAPES["box"], PADDLE, friction=friction)
    x = np.linspace(-0.12, 0.1, 60)
    poses = rollout(model, np.zeros(3), np.stack([x, np.full(60, 0.015), np.zeros(60)], 1)).object_pose[0]
    np.testing.assert_allclose(poses[:, 0], np.maximum(x + 0.07, 0.0), atol=2e-6)
    np.testing.assert_allclose(poses[:, 1:], 0.0, atol=1e-6)


def test_a_paddle_aligns_an_oblique_box():
    model = PushingModel(SHAPES["box"], PADDLE, friction=0.1)
    x = np.linspace(-0.15, 0.15, 60)
    poses = rollout(model, [0.0, 0.0, 0.3], np.stack([x, np.zeros(60), np.zeros(60)], 1)).object_pose[0]
    assert abs(poses[-1, 2]) < 1e-4


def test_a_paddle_pushes_a_disc_like_a_wall():
    model = PushingModel(SHAPES["disc"], PADDLE, friction=0.0)
    x = np.linspace(-0.12, 0.1, 60)
    poses = rollout(model, np.zeros(3), np.stack([x, np.full(60, 0.02)], 1)).object_pose[0]
    np.testing.assert_allclose(poses[:, 0], np.maximum(x + 0.06, 0.0), atol=2e-6)
    np.testing.assert_allclose(poses[:, 1:], 0.0, atol=1e-9)


def test_a_turning_paddle_drags_along_a_box_that_sticks():
    """A box that sticks keeps its place in the frame of a paddle that pushes and turns slowly."""
    model = PushingModel(SHAPES["box"], PADDLE, friction=2.0)
    x = np.linspace(-0.0701, 0.05, 60)
    tool = np.stack([x, np.zeros(60), 0.1 * (x + 0.07)], 1)
    pose = rollout(model, np.zeros(3), tool, max_step=0.001).object_pose[0, -1]
    np.testing.assert_allclose(in_frame(tool[-1], pose[None, :2])[0], [0.07, 0.0], atol=3e-4)
    assert pose[2] == pytest.approx(tool[-1, 2], abs=1e-4)


def test_a_disc_held_in_a_concave_corner_carries_the_tee():
    model = PushingModel(SHAPES["tee"], DISC, friction=0.2)
    corner = np.array([0.02, 0.02])  # between stem and bar; both are touched from there
    start = corner + [RADIUS, -RADIUS]
    t = np.linspace(0, 0.1, 40)[:, None]
    direction = np.array([-0.9, 0.45])
    result = rollout(model, np.zeros(3), start + t * direction)
    assert result.penetration[0] == 0.0
    at_end = in_frame(result.object_pose[0, -1], (start + 0.1 * direction)[None])[0]
    np.testing.assert_allclose(at_end, start, atol=1e-3)


@pytest.mark.parametrize("tool", [DISC, PADDLE], ids=["disc", "paddle"])
@pytest.mark.parametrize("name", SHAPES)
def test_deep_overlap_at_the_start_is_resolved_outward(name, tool):
    model = PushingModel(SHAPES[name], tool)
    rng = np.random.default_rng(7)
    at = np.concatenate([rng.uniform(-0.08, 0.08, (300, 2)), rng.uniform(-3, 3, (300, 1))], 1)[:, None]
    at[0, 0], at[1, 0] = 0.0, [*model.shape.primitives[0].center, 0.0]
    result = rollout(model, np.zeros(3), at[..., : 2 if tool is DISC else 3].copy())
    assert np.all(np.isfinite(result.object_pose))
    assert np.all(result.penetration == 0.0)
    reach = max(-model.shape.signed_distance(model.shape.boundary(3000)[0] * 0.5).min(), 0.06)
    assert np.hypot(*result.object_pose[:, 0, :2].T).max() < reach + tool.bounding_radius


def test_disc_overlap_is_resolved_by_the_shortest_way():
    shape = SHAPES["box"]
    result = rollout(PushingModel(shape, DISC), np.zeros(3), np.array([[[-0.05, 0.0]], [[0.0, 0.035]]]))
    np.testing.assert_allclose(result.object_pose[:, 0], [[0.025, 0, 0], [0, -0.02, 0]], atol=2e-6)


def test_the_way_a_union_is_cut_does_not_matter():
    cut = PlanarShape((Rectangle((-0.03, 0), (0.03, 0.04)), Rectangle((0.03, 0), (0.03, 0.04))))
    overlapping = PlanarShape((Rectangle((-0.02, 0), (0.04, 0.04)), Rectangle((0.02, 0), (0.04, 0.04))))
    whole = rollout(PushingModel(SHAPES["box"], DISC), np.zeros(3), paths(24)).object_pose
    for shape in (cut, overlapping):
        np.testing.assert_allclose(
            rollout(PushingModel(shape, DISC), np.zeros(3), paths(24)).object_pose, whole, atol=1e-5
        )


def test_steps_are_second_order():
    model = PushingModel(SHAPES["box"], DISC, friction=0.2)
    tool = np.stack([np.linspace(-0.08, 0.06, 8), np.linspace(0.01, 0.03, 8)], 1)

    def end(step):
        return rollout(model, np.zeros(3), tool, max_step=step).object_pose[0, -1]

    reference = end(2e-5)
    errors = [np.linalg.norm(end(step) - reference) for step in (0.006, 0.003, 0.0015)]
    assert errors[0] < 4e-3
    assert errors[1] < errors[0] / 2.5
    assert errors[2] < errors[1] / 2.5


@pytest.mark.parametrize("seed", range(12))
def test_a_frictionless_step_is_the_least_motion_without_penetration(seed):
    """Eq. (6.5b)–(6.5c) solved by a general optimiser with the exact distance."""
    rng = np.random.default_rng(seed)
    shape = list(SHAPES.values())[seed % 3]
    model = PushingModel(shape, DISC, friction=0.0)
    points, normals = shape.boundary(200)
    index = rng.integers(200)
    tool = points[index] + (RADIUS - 0.0015) * normals[index]
    result = rollout(model, np.zeros(3), tool[None])
    metric = np.array([1.0, 1.0, model.pressure_radius**2])
    scale = 1e3

    def gap(step):
        return scale * (shape.signed_distance(in_frame(step / scale, tool[None]))[0] - RADIUS)

    best = minimize(
        lambda d: d**2 @ metric,
        np.append(-normals[index] * 3, 0.0),
        constraints={"type": "ineq", "fun": gap},
        method="SLSQP",
    )
    assert best.success
    ours = scale * result.object_pose[0, 0]
    assert gap(ours) > -scale * TOLERANCE
    assert ours**2 @ metric == pytest.approx(best.fun, rel=0.02)


def test_a_sticking_contact_does_not_slide():
    model = PushingModel(SHAPES["box"], DISC, friction=5.0)
    path = np.stack([np.linspace(-0.0751, -0.0351, 40), np.linspace(0.01, 0.03, 40)], 1)
    poses = rollout(model, np.zeros(3), path, max_step=0.0005).object_pose[0]
    relative = np.array([in_frame(pose, p[None])[0] for pose, p in zip(poses[1:], path[1:], strict=True)])
    # A disc that does not turn rolls on the face: its centre travels by its radius times the turn of the box.
    np.testing.assert_allclose(
        relative[:, 1] - relative[0, 1], RADIUS * (poses[1:, 2] - poses[1, 2]), atol=2e-5
    )


@pytest.mark.parametrize("friction", [0.0, 0.2, 0.6])
def test_responses_obey_the_limit_surface_and_the_friction_cone(friction):
    shape, center = SHAPES["box"], np.array([0.01, -0.005])
    model = PushingModel(shape, DISC, pressure_radius=0.04, friction=friction, center_of_friction=center)
    rng = np.random.default_rng(3)
    points, normals = shape.boundary(60)
    motion = rng.normal(0, 1, (60, 2))
    twists = push_directions(model, points + RADIUS * normals, motion)
    approach = -np.sum(normals * motion, 1)
    assert np.all(twists[approach <= 0] == 0.0)
    for twist, point, normal, move, depth in zip(twists, points, normals, motion, approach, strict=True):
        if depth <= 0:
            continue
        spin = twist[2]
        at_center = twist[:2] + spin * np.array([-center[1], center[0]])
        # The force that belongs to this twist acts at the contact ...
        arm = point - center
        assert arm[0] * at_center[1] - arm[1] * at_center[0] == pytest.approx(0.04**2 * spin, abs=1e-12)
        tangent = np.array([-normal[1], normal[0]])
        ratio = (at_center @ tangent) / -(at_center @ normal)
        # ... inside the friction cone ...
        assert abs(ratio) <= friction + 1e-9
        at_contact = twist[:2] + spin * np.array([-point[1], point[0]])
        # ... the contact is kept, and sliding only happens on the cone's edge, against the force.
        assert -(at_contact @ normal) == pytest.approx(depth, abs=1e-9)
        slide = (move - at_contact) @ tangent
        if abs(slide) > 1e-9:
            assert abs(ratio) == pytest.approx(friction, abs=1e-9)
            assert friction == 0.0 or slide * ratio > 0.0


@pytest.mark.parametrize("tool", [DISC, PADDLE], ids=["disc", "paddle"])
def test_responses_are_what_small_rollouts_do(tool):
    model = PushingModel(SHAPES["tee"], tool, friction=0.3)
    points, normals = model.shape.boundary(37)
    at = points + (RADIUS if tool is DISC else 0.03) * normals
    touching = rollout(model, np.zeros(3), at[:, None])
    free = np.all(touching.object_pose[:, 0] == 0.0, axis=1)
    if tool is PADDLE:
        free &= np.abs(normals[:, 1]) > 0.5
    at, normals = at[free], normals[free]
    motion = -normals + 0.3 * np.stack([-normals[:, 1], normals[:, 0]], 1)
    size = 1e-4
    moved = rollout(model, np.zeros(3), np.stack([at - normals * 1e-9, at + size * motion], 1)).object_pose[
        :, -1
    ]
    np.testing.assert_allclose(moved / size, push_directions(model, at, motion), rtol=0.05, atol=0.05)


def test_responses_turn_with_the_frame():
    model = PushingModel(SHAPES["ell"], DISC, friction=0.3, center_of_friction=(0.01, 0.0))
    points, normals = model.shape.boundary(40)
    at, motion = points + RADIUS * normals, -normals + [0.2, 0.1]
    pose = np.array([0.4, 0.2, 1.0])
    turn = rotation(1.0)
    ours = push_directions(model, at, motion)
    theirs = push_directions(model, at @ turn.T + pose[:2], motion @ turn.T, object_pose=pose)
    np.testing.assert_allclose(theirs, np.column_stack([ours[:, :2] @ turn.T, ours[:, 2]]), atol=1e-9)


def test_what_cannot_be_resolved_is_reported():
    """A disc wider than the slot of a U is pressed into it: nothing explodes, and the rest is reported."""
    slot = PlanarShape(
        (
            Rectangle((0, -0.05), (0.05, 0.01)),
            Rectangle((-0.04, 0), (0.01, 0.05)),
            Rectangle((0.04, 0), (0.01, 0.05)),
        )
    )
    model = PushingModel(slot, PlanarShape.disc(0.035), friction=0.3)
    path = np.stack([np.zeros(60), np.linspace(0.12, 0.0, 60)], 1)
    result = rollout(model, np.zeros(3), path)
    assert np.all(np.isfinite(result.object_pose))
    assert np.abs(np.diff(result.object_pose[0], axis=0)).max() < 0.3
    inside = rollout(model, np.zeros(3), np.zeros((1, 2)))
    assert np.all(np.isfinite(inside.object_pose))


def test_an_offset_tool_is_a_shifted_path():
    model = PushingModel(SHAPES["box"], PlanarShape((Disc((0.02, 0.01), RADIUS),)))
    tool = paths(6, yaw=True)
    c, s = np.cos(tool[..., 2]), np.sin(tool[..., 2])
    shifted = np.stack(
        [tool[..., 0] + 0.02 * c - 0.01 * s, tool[..., 1] + 0.02 * s + 0.01 * c, tool[..., 2]], -1
    )
    expected = rollout(PushingModel(SHAPES["box"], DISC), np.zeros(3), shifted).object_pose
    np.testing.assert_allclose(rollout(model, np.zeros(3), tool).object_pose, expected, atol=1e-12)


def test_the_default_pressure_radius_is_that_of_even_pressure():
    assert PushingModel(SHAPES["disc"], DISC).pressure_radius == pytest.approx(0.05 * 2 / 3, rel=1e-4)
    shifted = PushingModel(SHAPES["box"], DISC, center_of_friction=(0.02, 0.0))
    assert shifted.pressure_radius == pytest.approx(SHAPES["box"].mean_distance((0.02, 0.0)))


GOOD = PushingModel(SHAPES["box"], DISC)
PATH = np.zeros((2, 5, 2))


@pytest.mark.parametrize(
    "call",
    [
        lambda: PushingModel(SHAPES["box"], SHAPES["tee"]),
        lambda: PushingModel("box", DISC),
        lambda: PushingModel(SHAPES["box"], DISC, pressure_radius=0.0),
        lambda: PushingModel(SHAPES["box"], DISC, friction=-0.1),
        lambda: PushingModel(SHAPES["box"], DISC, center_of_friction=(0, math.nan)),
        lambda: rollout(GOOD, [0, 0, math.nan], PATH),
        lambda: rollout(GOOD, [0, 0], PATH),
        lambda: rollout(GOOD, np.zeros((3, 3)), PATH),
        lambda: rollout(GOOD, np.zeros(3), np.full((5, 2), math.inf)),
        lambda: rollout(GOOD, np.zeros(3), np.zeros((5, 4))),
        lambda: rollout(GOOD, np.zeros(3), np.zeros((2, 0, 2))),
        lambda: rollout(GOOD, np.zeros(3), PATH, friction=-0.1),
        lambda: rollout(GOOD, np.zeros(3), PATH, pressure_radius=[0.1, 0.0]),
        lambda: rollout(GOOD, np.zeros(3), PATH, pressure_radius=[0.1, 0.1, 0.1]),
        lambda: rollout(GOOD, np.zeros(3), PATH, max_step=0.0),
        lambda: push_directions(GOOD, np.zeros((3, 2)), np.zeros((2, 2))),
        lambda: push_directions(GOOD, np.zeros((3, 2)), np.full((3, 2), math.nan)),
    ],
)
def test_nonsense_is_refused(call):
    with pytest.raises(InvalidInputError):
        call()
