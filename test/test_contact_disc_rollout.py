"""Rollouts of disc-shaped objects: the projection, friction and bookkeeping against independent oracles."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.contact import disc_rollout, disc_steps
from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import Disc, PlanarShape, Rectangle
from vpsto_ros.contact.projection import solve_contact
from vpsto_ros.contact.pushing import PushingModel, rollout

RADIUS, FINGER = 0.05, 0.015
OBJECT = PlanarShape.disc(RADIUS)
HAND = Rectangle(half_size=(0.1, 0.03))
EFFECTORS = {
    "one disc": EndEffectors.discs(FINGER),
    "two discs": EndEffectors.discs(FINGER, 2),
    "unequal discs": EndEffectors((Disc(radius=0.01), Disc(radius=0.03))),
    "three discs": EndEffectors.discs(FINGER, 3),
    "rectangle": EndEffectors((HAND,)),
    "two rectangles": EndEffectors((HAND, Rectangle(half_size=(0.02, 0.05)))),
    "mixed": EndEffectors((Disc(radius=FINGER), HAND)),
}


def dynamics(name, **options):
    return BeliefDynamics(OBJECT, EFFECTORS[name], step_variance=0.0, **options)


def belief_at(positions, **options):
    poses = np.zeros((len(positions), 3))
    poses[:, :2] = positions
    return ObjectBelief(poses, **options)


def states(model, belief, path):
    """Poses of all particles at every step, shape (K + 1, P, 3), and the wedge."""
    result = model.simulate(belief, path, np.random.default_rng(0))
    return result.poses, result.wedge


def gap_and_normal(shape, pose, point):
    """Signed distance of the object to one end effector in plain words, and the normal away from it."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    local = np.array([[c, s], [-s, c]]) @ (point - pose[:2])
    half = np.array(shape.half_size) if isinstance(shape, Rectangle) else np.zeros(2)
    radius = RADIUS if isinstance(shape, Rectangle) else RADIUS + shape.radius
    away = local - np.clip(local, -half, half)
    if away.any():
        distance = float(np.linalg.norm(away))
        normal = away / distance
    else:
        axis = int(np.argmax(np.abs(local) - half))
        distance, normal = float((np.abs(local) - half)[axis]), np.zeros(2)
        normal[axis] = math.copysign(1.0, local[axis])
    return distance - radius, np.array([[c, -s], [s, c]]) @ normal


def smallest_gap(effectors, row, point):
    poses = effectors.poses(row)
    return min(gap_and_normal(s, p, point)[0] for s, p in zip(effectors.shapes, poses, strict=True))


def grown_outline(shape, pose, count=4000):
    """Points where the object just touches an end effector."""
    t = 2.0 * math.pi * np.arange(count) / count
    if isinstance(shape, Disc):
        return pose[:2] + (RADIUS + shape.radius) * np.stack([np.cos(t), np.sin(t)], axis=1)
    (hx, hy), points = shape.half_size, []
    for (sx, sy), begin in zip(((1, 1), (-1, 1), (-1, -1), (1, -1)), np.arange(4), strict=True):
        a = 0.5 * math.pi * (begin + np.linspace(0.0, 1.0, count // 8))
        points.append(np.array([sx * hx, sy * hy]) + RADIUS * np.stack([np.cos(a), np.sin(a)], axis=1))
    corners = np.vstack([*points, points[0][:1]])
    sides = [
        begin + (end - begin) * np.linspace(0.0, 1.0, count // 8)[:, None]
        for begin, end in ((p[-1], q[0]) for p, q in itertools.pairwise([*points, points[0]]))
    ]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.vstack([corners, *sides]) @ np.array([[c, s], [-s, c]]) + pose[:2]


def nearest_free(effectors, row, point):
    """min |p - q| such that q is outside all grown end effectors: brute force, then SLSQP."""
    poses = effectors.poses(row)
    if smallest_gap(effectors, row, point) >= 0.0:
        return 0.0

    def gaps(q):
        pairs = zip(effectors.shapes, poses, strict=True)
        return np.array([gap_and_normal(shape, pose, q)[0] for shape, pose in pairs])

    best = math.inf
    for shape, pose in zip(effectors.shapes, poses, strict=True):
        candidates = grown_outline(shape, pose)
        distances = np.linalg.norm(candidates - point, axis=1)
        for i in np.argsort(distances):
            if gaps(candidates[i]).min() > -2e-4:
                guess = minimize(
                    lambda q: 1e4 * ((q - point) ** 2).sum(), candidates[i], method="SLSQP",
                    constraints={"type": "ineq", "fun": lambda q: 100.0 * gaps(q)},
                    options={"ftol": 1e-14, "maxiter": 100},
                ).x  # fmt: skip
                if gaps(guess).min() > -1e-7:
                    best = min(best, float(np.linalg.norm(guess - point)))
                    break
    return best


def touching_configurations(name, count, seed):
    """Rows of plane coordinates in which some end effectors penetrate an object at the origin a little."""
    effectors, rng, rows = EFFECTORS[name], np.random.default_rng(seed), []
    while len(rows) < count:
        row = rng.uniform(-0.16, 0.16, effectors.dof)
        for column, shape in zip(effectors.columns, effectors.shapes, strict=True):
            if isinstance(shape, Rectangle):
                row[column + 2] = rng.uniform(-4.0, 4.0)
        pairs = list(zip(effectors.shapes, effectors.poses(row), strict=True))
        gaps = [gap_and_normal(shape, pose, np.zeros(2))[0] for shape, pose in pairs]
        if -0.012 < min(gaps) < -1e-4 and max(gaps) < 0.02:
            rows.append(row)
    return np.array(rows)


@pytest.mark.parametrize("name", EFFECTORS)
def test_objects_give_way_to_the_nearest_free_place(name):
    """Eqs. (6.5b) and (6.5c), against brute force refined by SLSQP."""
    model, differing, squeezed, rows = dynamics(name), 0, 0, touching_configurations(name, 25, 3)
    for row in rows:
        poses, wedge = states(model, belief_at([[0.0, 0.0]] * 2), np.array([row, row]))
        moved = poses[-1, 0, :2]
        if wedge == -1.0:
            squeezed += 1
            continue
        assert smallest_gap(model.effectors, row, moved) > -1e-8
        shortest = nearest_free(model.effectors, row, np.zeros(2))
        assert np.linalg.norm(moved) >= shortest - 1e-6
        differing += np.linalg.norm(moved) > shortest + 1e-6
    # Where two ways out are about equally long the linearisation may take the other one.
    exact = name in ("one disc", "two discs", "unequal discs", "rectangle")
    assert differing <= (0 if exact else 2)
    assert squeezed <= 5


def motions(effectors, angles, offsets, samples=40):
    """End effectors that come from their angles and go to offsets, shape (K + 1, m)."""
    t, parts = np.linspace(0.0, 1.0, samples + 1)[:, None], []
    for shape, angle, offset in zip(effectors.shapes, angles, offsets, strict=True):
        begin = 0.16 * np.array([math.cos(angle), math.sin(angle)])
        way = begin + t * (np.array(offset[:2]) - begin)
        parts.append(way if isinstance(shape, Disc) else np.hstack([way, angle + t * offset[2]]))
    return np.hstack(parts)


number = st.floats(-0.12, 0.12, allow_subnormal=False)
motion = st.tuples(st.floats(-math.pi, math.pi), st.tuples(number, number, st.floats(-1.5, 1.5)))


@pytest.mark.parametrize("friction", [False, True])
@pytest.mark.parametrize("name", EFFECTORS)
@settings(max_examples=25, deadline=None, derandomize=True)
@example([(0.0, (0.0, 0.0, 0.0)), (math.pi, (0.0, 0.0, 0.0)), (1.5, (0.0, 0.1, 0.0))])
@example([(0.0, (-0.1, 0.0, 0.0)), (math.pi, (0.1, 0.0, 0.0)), (1.5, (0.0, -0.1, 0.0))])
@given(st.lists(motion, min_size=3, max_size=3))
def test_nothing_penetrates_unless_the_wedge_says_so(name, friction, moves):
    model = dynamics(name, friction=friction)
    count = model.effectors.count
    path = motions(model.effectors, [m[0] for m in moves[:count]], [m[1] for m in moves[:count]])
    rng = np.random.default_rng(0)
    positions = np.vstack([[0.0, 0.0], rng.normal(0.0, 0.01, (5, 2))])
    belief = belief_at(positions, friction=rng.uniform(0, 0.5, 6), center=rng.normal(0, 0.01, (6, 2)))
    poses, wedge = states(model, belief, path)
    assert np.isfinite(poses).all()
    if wedge > -1.0:
        for row, particles in zip(path[1:], poses[1:], strict=True):
            for pose in particles:
                assert smallest_gap(model.effectors, row, pose[:2]) > -1e-6


def test_even_an_object_whose_centre_is_the_fingers_is_freed():
    for name, friction in itertools.product(("one disc", "two discs"), (False, True)):
        model = dynamics(name, friction=friction)
        row = np.array([0.0, 0.0, 0.3, 0.3])[: model.effectors.dof]
        poses, wedge = states(model, belief_at([[0.0, 0.0]] * 2), np.array([row, row]))
        np.testing.assert_allclose(np.hypot(*poses[-1, :, :2].T), RADIUS + FINGER, atol=1e-9)
        assert wedge == 1.0


def squeeze(apart, samples=60):
    """Two end effectors along x that close in on the origin from both sides, (K + 1, 4)."""
    x = np.linspace(apart, 0.5 * apart, samples + 1)
    return np.stack([-x, np.zeros_like(x), x, np.zeros_like(x)], axis=1)


@pytest.mark.parametrize("friction", [False, True])
@pytest.mark.parametrize("aside", [0.0, 0.004])
def test_opposing_fingers_are_a_wedge_and_nothing_pops_out_silently(friction, aside):
    model = dynamics("two discs", friction=friction)
    positions = [[0.0, aside], [0.002, aside]]
    prediction = model.predict(belief_at(positions, friction=[0.4, 0.4]), squeeze(0.08)[None])
    assert prediction.wedge[0] < -0.95
    assert prediction.step[0] > 0.0
    _, wedge = states(model, belief_at(positions), squeeze(0.08))
    assert wedge == pytest.approx(prediction.wedge[0], abs=1e-9)


@pytest.mark.parametrize("friction", [False, True])
def test_opposing_plates_are_a_wedge(friction):
    plate = Rectangle(half_size=(0.01, 0.05))
    model = BeliefDynamics(OBJECT, EndEffectors((plate, plate)), friction=friction)
    path = np.insert(squeeze(0.09), [2, 4], 0.0, axis=1)
    prediction = model.predict(belief_at([[0.0, 0.0], [0.001, 0.01]]), path[None])
    assert prediction.wedge[0] == -1.0
    mixed = BeliefDynamics(OBJECT, EndEffectors((plate, Disc(radius=FINGER))), friction=friction)
    prediction = mixed.predict(belief_at([[0.0, 0.0], [0.001, 0.002]]), path[:, [0, 1, 2, 3, 4]][None])
    assert prediction.wedge[0] < -0.95


def test_the_wedge_of_fingers_is_the_product_of_their_normals():
    """Fingers side by side hold the object with normals whose angle geometry tells."""
    for angle in (0.3, 0.6, 1.0):
        reach = RADIUS + FINGER
        side, back = reach * math.sin(angle), reach * math.cos(angle)
        x = np.linspace(-0.02, 0.1, 41) - back
        path = np.stack([x, np.full(41, side), x, np.full(41, -side)], axis=1)
        for name in ("two discs", "three discs"):
            far = np.full((41, 2), 0.8)
            whole = path if name == "two discs" else np.hstack([path, far])
            prediction = dynamics(name).predict(belief_at([[0.0, 0.002], [0.0, -0.003]]), whole[None])
            assert prediction.wedge[0] == pytest.approx(math.cos(2.0 * angle), abs=1e-6)
            np.testing.assert_allclose(prediction.mean[0, -1], [0.1, 0.0], atol=1e-9)


def push_path(step, kind):
    """A bent push along a bit more than 6 cm in steps of a given length, (K + 1, 2 or 3)."""
    t = np.linspace(0.0, 1.0, math.ceil(0.07 / step) + 1)
    if kind == "disc":
        return np.stack([-0.066 + 0.06 * t, 0.012 + 0.02 * t**2], axis=1)
    return np.stack([-0.0805 + 0.05 * t, 0.01 * t, math.pi / 2 + 0.3 * t], axis=1)


def final_errors(kind, step, friction, center):
    """Difference of the last pose to finely resolved pushing by the other model."""
    name = "one disc" if kind == "disc" else "rectangle"
    model = dynamics(name, friction=True)
    belief = belief_at([[0.0, 0.0]] * 2, friction=[friction] * 2, center=[center] * 2)
    poses, _ = states(model, belief, push_path(step, kind))
    tool = PlanarShape.disc(FINGER) if kind == "disc" else PlanarShape((HAND,))
    other = PushingModel(
        OBJECT, tool, friction=friction, center_of_friction=center, pressure_radius=model.pressure_radius
    )
    path = push_path(1e-4, kind)
    expected = rollout(other, np.zeros(3), path, max_step=1e-4).object_pose[0, -1]
    assert np.linalg.norm(expected[:2]) > 0.025
    return poses[-1, 0] - expected


@pytest.mark.parametrize("center", [(0.0, 0.0), (0.01, -0.006)])
@pytest.mark.parametrize("friction", [0.0, 0.15, 0.8])
@pytest.mark.parametrize("kind", ["disc", "rectangle"])
def test_friction_agrees_with_the_pushing_model(kind, friction, center):
    error = final_errors(kind, 0.0005, friction, center)
    assert np.abs(error[:2]).max() < 2e-4
    assert abs(error[2]) < 4e-3


@pytest.mark.parametrize("kind", ["disc", "rectangle"])
def test_the_error_of_friction_shrinks_with_the_step(kind):
    coarse, fine = (final_errors(kind, h, 0.3, (0.01, -0.006)) for h in (0.002, 0.0005))
    size = [float(np.hypot(np.hypot(*e[:2]), RADIUS * e[2])) for e in (coarse, fine)]
    assert size[0] > 1e-5
    assert size[1] < 0.4 * size[0]


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    st.floats(1e-6, 0.01), st.floats(-0.01, 0.01), st.floats(-0.02, 0.02), st.floats(-0.02, 0.02),
    st.floats(0.0, 2.0),
)  # fmt: skip
def test_the_impulse_is_that_of_the_general_model(depth, slip, bn, bt, mu):
    """The object's contact is at (-radius, 0) in axes n and t, its normal out of the object is -n."""
    k = 0.034**-2
    along, across, turn = disc_steps._impulse(depth, slip, bn, bt, RADIUS, k, mu)
    vx, vy, w = solve_contact(-depth, -1.0, 0.0, -RADIUS, 0.0, -slip, k, mu, bn, bt)
    # From the centre of friction to the disc's centre.
    np.testing.assert_allclose([along, across, turn], [vx + w * bt, vy - w * bn, w], atol=1e-9)


@pytest.mark.parametrize("name", EFFECTORS)
def test_without_friction_at_the_contact_the_friction_kernels_equal_the_others(name):
    path = random_path(name, 5)
    positions = np.random.default_rng(1).normal(0.0, 0.01, (8, 2))
    with_it, wedge = states(dynamics(name, friction=True), belief_at(positions), path)
    without, expected = states(dynamics(name), belief_at(positions), path)
    assert np.abs(without[-1] - without[0]).max() > 0.01
    np.testing.assert_allclose(with_it, without, atol=1e-9)
    assert wedge == pytest.approx(expected, abs=1e-6)
    barely = belief_at(positions, friction=np.full(8, 1e-9))
    np.testing.assert_allclose(states(dynamics(name, friction=True), barely, path)[0], without, atol=1e-7)


def random_path(name, seed, samples=60):
    """Side by side, or alone, through the object along a bent line."""
    effectors, rng = EFFECTORS[name], np.random.default_rng(seed)
    t, parts = np.linspace(0.0, 1.0, samples + 1)[:, None], []
    for e, shape in enumerate(effectors.shapes):
        aside = 0.0 if effectors.count == 1 else 0.09 * (e / (effectors.count - 1) - 0.5)
        begin = np.array([-0.15, aside]) + rng.normal(0.0, 0.004, 2)
        way = begin + t * [0.2, 0.0] + t**2 * rng.normal(0.0, 0.02, 2)
        yaw = 0.1 + 0.4 * t if shape is not HAND else 1.4 + 0.4 * t
        parts.append(way if isinstance(shape, Disc) else np.hstack([way, yaw]))
    return np.hstack(parts)


@pytest.mark.parametrize("friction", [False, True])
@pytest.mark.parametrize("name", EFFECTORS)
def test_motion_does_not_depend_on_the_frame(name, friction):
    model, path, rng = dynamics(name, friction=friction), random_path(name, 2), np.random.default_rng(2)
    poses = np.hstack([rng.normal(0.0, 0.01, (7, 2)), rng.uniform(-3, 3, (7, 1))])
    options = {"friction": rng.uniform(0, 0.5, 7), "center": rng.normal(0, 0.008, (7, 2))}
    turn, shift = 2.2, np.array([0.6, -0.4])
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[c, s], [-s, c]])

    def moved(p):
        return np.concatenate([p[..., :2] @ rotation + shift, p[..., 2:] + turn], axis=-1)

    other = path.copy()
    for column, shape in zip(model.effectors.columns, model.effectors.shapes, strict=True):
        size = 2 if isinstance(shape, Disc) else 3
        other[:, column : column + size] = moved(path[:, column : column + size])
    ours, wedge = states(model, ObjectBelief(poses, **options), path)
    theirs, same = states(model, ObjectBelief(moved(poses), **options), other)
    assert np.abs(ours[-1] - ours[0]).max() > 0.01
    np.testing.assert_allclose(theirs, moved(ours), atol=1e-7)
    assert wedge == pytest.approx(same, abs=1e-5)


@pytest.mark.parametrize("friction", [False, True])
def test_particles_and_end_effectors_have_no_order(friction):
    rng, order = np.random.default_rng(4), np.array([3, 1, 4, 0, 2, 5])
    positions, mu, center = rng.normal(0, 0.01, (6, 2)), rng.uniform(0, 0.5, 6), rng.normal(0, 0.005, (6, 2))
    for name in ("two discs", "unequal discs", "three discs", "mixed"):
        model, path = dynamics(name, friction=friction), random_path(name, 3)
        belief = belief_at(positions, friction=mu, center=center)
        ours = model.predict(belief, path[None])
        shuffled = belief_at(positions[order], friction=mu[order], center=center[order])
        blocks = [
            path[:, column : column + (2 if isinstance(shape, Disc) else 3)]
            for column, shape in zip(model.effectors.columns, model.effectors.shapes, strict=True)
        ]
        swapped = BeliefDynamics(
            OBJECT, EndEffectors(model.effectors.shapes[::-1]), friction=friction, step_variance=0.0
        )
        for theirs in (
            model.predict(shuffled, path[None]),
            swapped.predict(belief, np.hstack(blocks[::-1])[None]),
        ):
            for field in ("mean", "variance", "contact", "wedge", "step"):
                np.testing.assert_allclose(
                    getattr(theirs, field), getattr(ours, field), atol=1e-9, err_msg=f"{name} {field}"
                )


def project_numpy(effectors, row, point):
    """The nearest free place, by all contacts and pairs of contacts, Newton steps on their gaps."""
    poses = effectors.poses(row)
    pairs = list(zip(effectors.shapes, poses, strict=True))
    if min(gap_and_normal(shape, pose, point)[0] for shape, pose in pairs) >= -1e-9:
        return point, False
    best, found = point, math.inf
    sets = [(e,) for e in range(len(pairs))] + list(itertools.combinations(range(len(pairs)), 2))
    for active in sets:
        q = point.copy()
        for _ in range(60):
            gaps, normals = zip(*(gap_and_normal(*pairs[e], q) for e in active), strict=True)
            rows = np.array(normals)
            if len(active) == 1:
                q = q - gaps[0] * rows[0]
                continue
            if abs(np.linalg.det(rows)) < 1e-9:
                break
            q = q - np.linalg.solve(rows, gaps)
        if min(gap_and_normal(*pair, q)[0] for pair in pairs) > -1e-10:
            distance = float(np.linalg.norm(q - point))
            if distance < found:
                best, found = q, distance
    return best, True


def to_and_fro(name):
    """Far, near and far again."""
    out = random_path(name, 7, 40)
    return np.vstack([out, out[::-1][1:] + 0.002, out[1:] + 0.01])


def one_after_the_other(name):
    """The first end effector pushes the object towards the second one, which pushes it aside afterwards."""
    path = random_path(name, 7, 60)
    x = np.linspace(-0.1, 0.0, 31)
    path[:31, :2], path[31:, :2] = np.stack([x, 0.1 * x], axis=1), [-0.12, 0.0]
    column, disc = EFFECTORS[name].columns[1], isinstance(EFFECTORS[name].shapes[1], Disc)
    path[:, column], path[:, column + 1] = (0.08 if disc else 0.13), (0.12 if disc else 0.22)
    path[31:, column + 1] -= np.linspace(0.0, 0.05, 30)
    return path


@pytest.mark.parametrize(
    ("make", "name"),
    [
        *((to_and_fro, name) for name in EFFECTORS),
        *((one_after_the_other, name) for name in ("two discs", "unequal discs", "mixed")),
    ],
)
def test_predictions_equal_those_of_a_twin_that_never_skips(make, name):
    """Bounds on the clearance must not miss a contact."""
    model, effectors = dynamics(name), EFFECTORS[name]
    positions = np.random.default_rng(6).normal(0.0, 0.012, (6, 2))
    path = make(name)
    mean, variance, contact, longest = [positions.mean(axis=0)], [], [], 0.0
    particles = positions.copy()
    for row in path[1:]:
        results = [project_numpy(effectors, row, p) for p in particles]
        moved = np.array([r[0] for r in results])
        longest = max(longest, np.linalg.norm(moved - particles, axis=1).max())
        contact.append(np.mean([r[1] for r in results]))
        particles = moved
        mean.append(particles.mean(axis=0))
        variance.append(particles.var(axis=0).sum())
    ours = model.predict(belief_at(positions), path[None])
    assert ours.wedge[0] > -1.0
    assert 0.1 < np.mean(contact) < 0.9
    np.testing.assert_array_equal(ours.contact[0], contact)
    np.testing.assert_allclose(ours.mean[0], mean, atol=1e-8)
    np.testing.assert_allclose(ours.variance[0, 1:], variance, atol=1e-11)
    assert ours.step[0] == pytest.approx(longest, abs=1e-8)


@pytest.mark.parametrize("friction", [False, True])
@pytest.mark.parametrize("name", EFFECTORS)
def test_predictions_are_the_statistics_of_the_rollouts(name, friction):
    """The noisy kernel without noise visits the same states, also after particles have been gathered."""
    rng = np.random.default_rng(8)
    belief = belief_at(
        rng.normal(0, 0.008, (9, 2)), friction=rng.uniform(0, 0.5, 9), center=rng.normal(0, 0.004, (9, 2))
    )
    model = dynamics(name, friction=friction)
    paths = np.array([random_path(name, seed) for seed in range(5)])
    ours = model.predict(belief, paths)
    for b, path in enumerate(paths):
        poses, wedge = states(model, belief, path)
        positions = poses[:, :, :2]
        np.testing.assert_allclose(ours.mean[b], positions.mean(axis=1), atol=1e-9)
        np.testing.assert_allclose(ours.variance[b], positions.var(axis=1).sum(axis=-1), atol=1e-12)
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=2)
        assert ours.step[b] == pytest.approx(steps.max(), abs=1e-9)
        assert (ours.contact[b] >= (steps > 1e-8).mean(axis=1) - 1e-12).all()
        assert ours.wedge[b] == pytest.approx(wedge, abs=1e-6)


def gathering_path(samples=80):
    x = np.linspace(-0.08, 0.05, samples + 1)
    return np.stack([x, np.full_like(x, 0.03), x, np.full_like(x, -0.03)], axis=1)


def test_two_fingers_gather_particles_in_one_point():
    model = dynamics("two discs")
    positions = np.random.default_rng(9).normal(0.0, 0.004, (12, 2))
    ours = model.predict(belief_at(positions), gathering_path()[None])
    poses, _ = states(model, belief_at(positions), gathering_path())
    assert np.all(poses[-1] == poses[-1, 0])
    assert ours.variance[0, 0] > 1e-5 and ours.variance[0, -1] == 0.0
    np.testing.assert_allclose(ours.mean[0], poses[:, :, :2].mean(axis=1), atol=1e-12)
    assert (ours.contact[0, -5:] == 1.0).all()
    # Alone, each particle takes the way it takes among the others.
    alone = model.predict(belief_at(np.tile(positions[:1], (2, 1))), gathering_path()[None])
    np.testing.assert_allclose(alone.mean[0], poses[:, 0, :2], atol=1e-12)


def test_candidates_do_not_influence_each_other():
    model, belief = dynamics("two discs"), belief_at(np.random.default_rng(9).normal(0.0, 0.004, (12, 2)))
    paths = np.array([gathering_path(60), random_path("two discs", 1), gathering_path(60) + 0.3])
    together = model.predict(belief, paths)
    for b, path in enumerate(paths):
        alone = model.predict(belief, path[None])
        for field in ("mean", "variance", "contact", "wedge", "step"):
            np.testing.assert_array_equal(getattr(alone, field)[0], getattr(together, field)[b])
    assert not together.contact[2].any() and together.step[2] == 0.0
    np.testing.assert_array_equal(together.variance[2], together.variance[2, 0])


@pytest.mark.parametrize("friction", [False, True])
def test_contact_counts_the_particles_that_are_pushed(friction):
    """Eq. (6.24): particles wait one behind the other, the finger meets one after the other."""
    positions = np.stack([0.01 * np.arange(10), np.zeros(10)], axis=1)
    x = np.linspace(-0.005, 0.095, 11) - RADIUS - FINGER
    path = np.stack([x, np.zeros(11)], axis=1)
    belief = belief_at(positions, friction=np.full(10, 0.3))
    contact = dynamics("one disc", friction=friction).predict(belief, path[None]).contact[0]
    np.testing.assert_allclose(contact, np.arange(1, 11) / 10)


@pytest.mark.parametrize("friction", [False, True])
@pytest.mark.parametrize("name", ["one disc", "two discs", "three discs", "rectangle", "mixed"])
def test_resting_and_parting_contacts_do_not_count(name, friction):
    model, belief = dynamics(name, friction=friction), belief_at([[0.0, 0.0], [0.0, 0.002]])
    there = random_path(name, 1)
    back = np.zeros_like(there[:20])
    back[:, list(model.effectors.columns)] = -0.002 * np.arange(20)[:, None]
    contact = model.predict(belief, np.vstack([there, there[-1] + back])[None]).contact[0]
    assert contact[len(there) - 2] > 0.0
    assert not contact[len(there) - 1 :].any()
    still = model.predict(belief, np.vstack([there, np.tile(there[-1:], (6, 1))])[None]).contact[0]
    assert not still[len(there) - 1 :].any()


def test_tables_hold_the_belief_in_world_axes():
    poses = np.array([[0.1, 0.2, math.pi / 2], [0.3, 0.4, 0.0]])
    table = disc_rollout.table_of(poses, np.array([0.1, 0.2]), np.array([[0.01, 0.0], [0.0, 0.02]]))
    expected = [[0.1, 0.3], [0.2, 0.4], [0.0, 0.0], [0.01, 0.02], [math.pi / 2, 0.0], [0.1, 0.2]]
    np.testing.assert_allclose(table[: disc_steps.STATE_ROWS], expected, atol=1e-15)
