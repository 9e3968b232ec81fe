"""The arm against Pinocchio and coal, proofs along motions against dense sampling, bad input."""

import dataclasses

import numpy as np
import pytest

coal = pytest.importorskip("coal")
pin = pytest.importorskip("pinocchio")

from vpsto_ros.collision import arm_kernels as kernels  # noqa: E402
from vpsto_ros.collision.arm import ArmCollision, Contact  # noqa: E402
from vpsto_ros.collision.arm_cost import ArmPathCost  # noqa: E402
from vpsto_ros.collision.arm_model import MARGIN_LIMIT, SUFFIX, fr3_capsules, read_capsules  # noqa: E402
from vpsto_ros.collision.shapes import Box, Capsule, HalfSpace, Sphere, rotation_z  # noqa: E402
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError  # noqa: E402
from vpsto_ros.robot.kinematics import MODEL_PATH, fr3_pusher  # noqa: E402
from vpsto_ros.trajectory import OptimalBasis, Trajectory, TrajectoryBatch, synthesize, synthesize_batch  # noqa: E402

CELL = (
    HalfSpace([0, 0, 1], 0.0, "table"),
    Box([0.55, 0.3, 0.15], [0.1, 0.08, 0.15], rotation_z(0.4), "crate"),
    Box([0.5, -0.45, 0.45], [0.25, 0.15, 0.01], name="board"),
    Box([0.5, -0.6, 0.3], [0.25, 0.01, 0.3], name="back"),
    Capsule([0.4, 0.55, 0], [0.4, 0.55, 0.9], 0.04, "pillar"),
    Capsule([0.3, -0.2, 0.95], [0.9, 0.2, 0.95], 0.03, "beam"),
    Sphere([0.5, 0.1, 0.75], 0.08, "ball"),
)
HOME = np.array([0.0, -0.4, 0.0, -2.3, 0.0, 1.9, 0.8])
STILL = np.zeros(7)


def postures(seed, count):
    model = fr3_capsules()
    return np.random.default_rng(seed).uniform(model.lower, model.upper, (count, 7))


def as_coal(shape):
    if isinstance(shape, HalfSpace):
        return coal.Halfspace(shape.normal, shape.offset), coal.Transform3s()
    if isinstance(shape, Box):
        pose = coal.Transform3s(np.array(shape.rotation), np.array(shape.centre))
        return coal.Box(*(2.0 * shape.half_size)), pose
    if isinstance(shape, Sphere):
        return coal.Sphere(shape.radius), coal.Transform3s(np.eye(3), np.array(shape.centre))
    z = (shape.b - shape.a) / np.linalg.norm(shape.b - shape.a)
    x = np.cross(z, [1.0, 0, 0] if abs(z[0]) < 0.9 else [0, 1.0, 0])
    x /= np.linalg.norm(x)
    pose = coal.Transform3s(np.column_stack([x, np.cross(z, x), z]), 0.5 * (shape.a + shape.b))
    return coal.Capsule(shape.radius, np.linalg.norm(shape.b - shape.a)), pose


@pytest.fixture(scope="module")
def oracle():
    """Least distances by coal with the placements of Pinocchio, over the pairs that the checker has."""
    model = pin.buildModelFromMJCF(str(MODEL_PATH))
    geometry = pin.buildGeomFromMJCF(model, str(MODEL_PATH), pin.GeometryType.VISUAL)
    data, placed = model.createData(), geometry.createData()
    index = {g.name.removesuffix(SUFFIX): i for i, g in enumerate(geometry.geometryObjects)}

    def distances(checker, q):
        pin.updateGeometryPlacements(model, data, geometry, placed, q)
        obstacles = {shape.name: as_coal(shape) for shape in checker.obstacles}

        def part(name):
            pose = placed.oMg[index[name]]
            return geometry.geometryObjects[index[name]].geometry, coal.Transform3s(
                pose.rotation, pose.translation
            )

        request, found = coal.DistanceRequest(), {}
        for link, other in checker.pair_names:
            second = obstacles[other] if other in obstacles else part(other)
            found[link, other] = coal.distance(*part(link), *second, request, coal.DistanceResult())
        return found

    return distances


def test_distances_and_collisions_agree_with_pinocchio_and_coal(oracle):
    checker, q = ArmCollision(None, CELL), postures(5, 2000)
    hit, distance = checker.in_collision(q), checker.distance(q)
    assert 0.1 < hit.mean() < 0.9
    for n, row in enumerate(q):
        theirs = oracle(checker, row)
        least = min(theirs.values())
        assert distance[n] == pytest.approx(least, abs=1e-6)
        if abs(least) > 1e-6:
            assert hit[n] == (least < 0.0)
        if n < 20:
            ours = {(c.link, c.other): c.distance for c in checker.contacts(row, margin=np.inf)}
            assert ours == pytest.approx(theirs, abs=1e-6)


def test_pairs_left_out_never_touch(oracle):
    """No pair of distant links that the rules drop comes closer than any margin, on other postures."""
    checker = ArmCollision()
    arrays = checker.model.arrays
    everything = np.array(
        [(i, j) for i in range(15) for j in range(i + 1, 15) if arrays.link[j] - arrays.link[i] >= 3]
    )
    kept = {tuple(pair) for pair in arrays.pairs}
    dropped = np.array([pair for pair in everything if tuple(pair) not in kept])
    from vpsto_ros.collision.arm_distance_kernels import self_distance_range

    nearest, _ = self_distance_range(arrays._replace(pairs=dropped), postures(77, 50_000))
    assert len(dropped) and nearest.min() > MARGIN_LIMIT


def test_pruned_pairs_are_those_out_of_reach():
    q = postures(6, 5000)
    for margin in (0.0, 0.03):
        checker = ArmCollision(None, CELL, margin=margin)
        distance = checker.distance(q)
        clear = np.abs(distance - margin) > 1e-9
        assert (checker.in_collision(q) == (distance < margin))[clear].all()


def test_capsules_enclose_all_that_is_seen():
    model = pin.buildModelFromMJCF(str(MODEL_PATH))
    geometry = pin.buildGeomFromMJCF(model, str(MODEL_PATH), pin.GeometryType.VISUAL)
    capsules = [g for g in geometry.geometryObjects if g.name.endswith(SUFFIX)]
    seen = [g for g in geometry.geometryObjects if not g.name.endswith(SUFFIX)]
    assert len(capsules) == 15 and len(seen) == 32
    for part in seen:
        points = surface(part)
        assert any(
            encloses(capsule, points) for capsule in capsules if capsule.parentJoint == part.parentJoint
        ), part.name


def surface(part):
    shape, around = part.geometry, np.linspace(0.0, 2.0 * np.pi, 100)
    ring = np.column_stack([np.cos(around), np.sin(around), 0.0 * around])
    if isinstance(shape, coal.Box):
        points = np.array(np.meshgrid(*[[-h, h] for h in shape.halfSide])).reshape(3, -1).T
    elif isinstance(shape, coal.Cylinder):
        points = np.vstack([shape.radius * ring + [0, 0, z] for z in (-shape.halfLength, shape.halfLength)])
    else:
        tilt = np.linspace(0.0, np.pi / 2, 20)
        points = np.vstack([
            shape.radius * np.cos(t) * ring + [0, 0, side * (shape.halfLength + shape.radius * np.sin(t))]
            for t in tilt for side in (-1.0, 1.0)
        ])  # fmt: skip
    return points @ part.placement.rotation.T + part.placement.translation


def encloses(capsule, points):
    half = capsule.placement.rotation[:, 2] * capsule.geometry.halfLength
    a = capsule.placement.translation - half
    t = np.clip((points - a) @ half / (2.0 * half @ half), 0.0, 1.0)
    return np.linalg.norm(points - a - 2.0 * t[:, None] * half, axis=1).max() <= capsule.geometry.radius


def test_sines_and_placed_capsules():
    near = np.concatenate([np.random.default_rng(0).uniform(-100, 100, 5000), np.arange(-8, 9) * np.pi / 4])
    for angles in (near, np.append(near, [1e9, -1e15, 101.0])):
        sine, cosine = np.empty_like(angles), np.empty_like(angles)
        kernels.sines(angles, sine, cosine)
        np.testing.assert_allclose(sine, np.sin(angles), rtol=0, atol=1e-14)
        np.testing.assert_allclose(cosine, np.cos(angles), rtol=0, atol=1e-14)
    rod = next(c for c in ArmCollision().capsules(HOME) if c.name == "tool_rod")
    tip, rotation = fr3_pusher().forward(HOME)
    axis = rotation[:, 2]
    np.testing.assert_allclose(np.cross(rod.b - tip, axis), 0.0, atol=1e-12)
    assert 0.0 < (rod.b - tip) @ axis + rod.radius < 0.01  # its round end reaches a little beyond the tip


def test_swing_bounds_every_motion():
    """No point of a segment moves farther than sum_j delta_j r_j."""
    arm, rng = fr3_capsules().arrays, np.random.default_rng(3)
    before, after = np.empty((15, 9)), np.empty((15, 9))
    tightest = 0.0
    for q in postures(8, 2000):
        delta = rng.uniform(-0.3, 0.3, 7) * (rng.random(7) < 0.4)
        kernels.place(arm, np.sin(q), np.cos(q), before)
        kernels.place(arm, np.sin(q + delta), np.cos(q + delta), after)
        ends = [w[:, :3] + s * w[:, 3:6] for w in (before, after) for s in (0.0, 1.0)]
        moved = np.maximum(*(np.linalg.norm(ends[i] - ends[i + 2], axis=1) for i in (0, 1)))
        bound = arm.swing @ np.abs(delta)
        assert (moved <= bound + 1e-12).all()
        tightest = max(tightest, (moved[bound > 0] / bound[bound > 0]).max(initial=0.0))
    assert tightest > 0.9  # and the bound is no idle one


def random_motion(rng, pair):
    keys = np.stack([pair[0], *(0.5 * (pair[0] + pair[1]) + 0.3 * rng.normal(size=(2, 7))), pair[1]])
    return synthesize(OptimalBasis.uniform(2), keys, STILL, STILL, fr3_pusher().limits)


def test_proof_agrees_with_dense_sampling():
    checker, rng, tolerance = ArmCollision(None, CELL), np.random.default_rng(4), 1e-3
    free = postures(9, 400)
    free = free[~checker.in_collision(free)]
    outcomes = {True: 0, False: 0}
    for pair in free[:160].reshape(-1, 2, 7):
        motion = random_motion(rng, pair)
        times = np.linspace(0.0, motion.duration, 3000)
        distance = checker.distance(motion(times))
        found = checker.free_along(motion, tolerance=tolerance)
        outcomes[found.free] += 1
        if found.free:
            assert distance.min() > 0.0
        else:
            assert distance.min() <= 2.0 * tolerance
            first = times[np.argmax(distance <= 2.0 * tolerance)]
            assert found.time == pytest.approx(first, abs=0.02)
            assert found.contacts and found.contacts[0].distance < 2.0 * tolerance
    assert min(outcomes.values()) >= 10


def test_proof_finds_what_samples_miss():
    """A thin rod between two samples, and a motion of fifth degree."""
    end = HOME + np.array([1.5, 0, 0, 0, 0, 0, 0])
    acceleration = np.zeros((2, 7))
    motion = Trajectory.from_points([0.0, 2.0], [HOME, end], np.zeros((2, 7)), acceleration)
    assert motion.coefficients[:, 5].any()
    tip, _ = fr3_pusher().forward(motion(0.97))
    rod = Capsule(tip - [0, 0, 0.3], tip, 0.0005, "wire")
    checker = ArmCollision(None, [rod])
    assert not checker.in_collision(motion(np.linspace(0.0, 2.0, 9))).any()
    found = checker.free_along(motion)
    assert not found.free and found.contacts[0].other == "wire"
    assert found.time == pytest.approx(0.97, abs=0.1)
    assert ArmCollision().free_along(motion).free


def batch_of(keys, samples=40):
    return synthesize_batch(OptimalBasis.uniform(2), keys, STILL, STILL, fr3_pusher().limits, samples)


def test_cost_is_zero_exactly_for_proven_motions_and_grows_with_depth():
    checker, rng = ArmCollision(None, CELL, margin=0.01), np.random.default_rng(11)
    free = postures(10, 600)
    free = free[~checker.in_collision(free)][:200].reshape(-1, 2, 7)
    middle = 0.5 * (free[:, :1] + free[:, 1:]) + 0.3 * rng.normal(size=(len(free), 2, 7))
    keys = np.concatenate([free[:, :1], middle, free[:, 1:]], axis=1)
    batch = batch_of(keys)
    cost, valid = ArmPathCost(checker, weight=1.0)(batch)
    plain, _ = ArmPathCost(checker, weight=1.0, depth_scale=1e12)(batch)
    hits = checker.in_collision(batch.position).sum(axis=1)
    np.testing.assert_allclose(plain[hits > 0], (hits / 40 * batch.duration)[hits > 0], rtol=1e-9)
    assert (cost[hits > 0] > plain[hits > 0]).all()
    np.testing.assert_allclose(cost[(hits == 0) & ~valid], (0.5 / 40 * batch.duration)[(hits == 0) & ~valid])
    assert 0.1 < valid.mean() < 0.9
    bare = checker.with_margin(0.0)
    for b in range(len(keys)):
        motion = synthesize(OptimalBasis.uniform(2), keys[b], STILL, STILL, fr3_pusher().limits)
        assert valid[b] == (hits[b] == 0 and bare.free_along(motion).free)
        assert (cost[b] == 0.0) == valid[b]


def test_cost_is_deeper_in_the_middle_of_an_obstacle():
    tip, _ = fr3_pusher().forward(HOME)
    batch = batch_of(np.tile(HOME, (1, 4, 1)))
    checkers = [
        ArmCollision(None, [Box(tip - [0, 0, below], [0.2, 0.2, 0.1], name="block")]) for below in (0.1, 0.05)
    ]
    grazing, central = (ArmPathCost(checker, weight=1.0)(batch)[0][0] for checker in checkers)
    assert central > grazing > batch.duration[0]  # every sample counts, and the deeper one more


def as_batch(motion, samples):
    """A motion of cubic pieces as a batch of one, whatever its knots."""
    times, duration = np.linspace(0.0, motion.duration, samples), motion.duration
    derivatives = [motion(times, order)[None] for order in (0, 1, 2)]
    slopes = duration * motion(motion.times, 1)[None]
    return TrajectoryBatch(
        np.array([duration]), *derivatives, motion(motion.times)[None], motion.times / duration, slopes
    )


def test_cost_is_the_time_in_collision_and_a_detour_elsewhere_does_not_lower_it():
    first = np.eye(7)[0]
    ball = Sphere(fr3_pusher().forward(HOME)[0], 0.08, "ball")
    term = ArmPathCost(ArmCollision(None, [ball]), weight=1.0, depth_scale=1e12)
    limits, basis = fr3_pusher().limits, OptimalBasis.uniform(0)
    through = synthesize(basis, np.stack([HOME - 0.5 * first, HOME + 0.5 * first]), STILL, STILL, limits)
    far = np.stack([HOME + 0.5 * first, HOME + 2.2 * first])
    there, back = (synthesize(basis, keys, STILL, STILL, limits) for keys in (far, far[::-1]))
    seconds = term.checker.in_collision(through(np.linspace(0.0, through.duration, 20_001))).mean()
    seconds *= through.duration
    assert seconds > 0.1
    motion = through
    for following in (there, back, there, back):
        (cost,), (valid,) = term(as_batch(motion, 4001))
        assert not valid and cost == pytest.approx(seconds, rel=0.02)
        motion = motion.followed_by(following.shifted(motion.end_time))
    # Two motions of the search to the same goal: what a detour changes is the time in the ball alone.
    for samples in (40, 400):
        ways = np.stack([[HOME + a * first for a in (-0.5, middle, 0.5)] for middle in (0.0, 2.2)])
        batch = synthesize_batch(OptimalBasis.uniform(1), ways, STILL, STILL, limits, samples)
        cost, _ = term(batch)
        for way, found in zip(ways, cost, strict=True):
            motion = synthesize(OptimalBasis.uniform(1), way, STILL, STILL, limits)
            hit = term.checker.in_collision(motion(np.linspace(0.0, motion.duration, 20_001)))
            assert found == pytest.approx(hit.mean() * motion.duration, abs=2.0 * motion.duration / samples)


def test_motion_without_a_finite_duration_costs_infinitely_much():
    batch = as_batch(synthesize(OptimalBasis.uniform(0), np.stack([HOME, HOME + 0.1]), STILL, STILL,
                                fr3_pusher().limits), 40)  # fmt: skip
    term = ArmPathCost(ArmCollision())
    assert term(batch)[1].all()
    broken = batch.position.copy()
    broken[0, 7, 3] = np.nan
    for changed in ({"duration": np.array([np.inf])}, {"position": broken}):
        cost, valid = term(dataclasses.replace(batch, **changed))
        assert cost[0] == np.inf and not valid[0]


def test_cost_explains_in_words():
    checker = ArmCollision(None, [Sphere(fr3_pusher().forward(HOME)[0], 0.05, "ball")], margin=0.01)
    motion = synthesize(
        OptimalBasis.uniform(0), np.stack([HOME - 0.5, HOME]), STILL, STILL, fr3_pusher().limits
    )
    words = ArmPathCost(checker).explain(motion)
    assert any("tool_rod is" in line and "mm deep in ball at" in line for line in words)
    assert ArmPathCost(ArmCollision()).explain(motion) == []


def test_posture_in_collision_is_refused_by_name_and_depth():
    tip, _ = fr3_pusher().forward(HOME)
    checker = ArmCollision(None, [Box(tip, [0.05, 0.05, 0.05], name="crate")], margin=0.005)
    words = r"start is in collision .*tool_rod is \d+\.\d mm deep in crate"
    with pytest.raises(InvalidInputError, match=words):
        checker.require_free(HOME, "start")
    checker.with_obstacles([]).require_free(HOME, "start")
    assert str(Contact("tool_rod", "crate", 0.002)) == "tool_rod is 2.0 mm from crate"


def test_empty_cell_shapes_and_attached():
    checker = ArmCollision()
    q = postures(1, 12)
    assert checker.in_collision(q.reshape(3, 4, 7)).shape == (3, 4)
    assert checker.in_collision(HOME).shape == () and checker.distance(np.empty((0, 7))).shape == (0,)
    assert checker.in_collision(q)[4] == checker.in_collision(q[4])
    tip, rotation = fr3_pusher().forward(HOME)
    held = Sphere([0.0, 0.0, 0.1], 0.04, "held")
    obstacle = Sphere(tip + rotation @ [0.0, 0.0, 0.2], 0.05, "stop")
    with_held = ArmCollision(None, [obstacle], attached=[held])
    assert with_held.contacts(HOME, margin=np.inf)[0].link == "held"
    assert with_held.distance(HOME) == pytest.approx(0.01, abs=1e-12)
    assert ArmCollision(None, [obstacle]).distance(HOME) > 0.05


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda c: c.in_collision(np.zeros((2, 6))), r"shape \(\.\.\., 7\)"),
        (lambda c: c.distance(np.full(7, np.nan)), "finite"),
        (lambda c: c.in_collision(["a"] * 7), "real numbers"),
        (lambda c: c.in_collision(np.zeros(7) + 1j), "real numbers"),
        (lambda c: c.in_collision(None), "joint positions"),
        (lambda c: c.contacts(HOME, margin=np.nan), "margin must be a number"),
        (lambda c: c.contacts(HOME, margin="a"), "margin must be a number"),
        (lambda c: c.explain(Trajectory([0, 1], np.zeros((1, 6, 7))), samples=0), "samples must be"),
        (lambda c: c.explain(Trajectory([0, 1], np.zeros((1, 6, 3)))), "7 joints, got 3"),
        (lambda c: c.with_margin("a"), "margin must be a number"),
        (lambda c: c.with_margin(MARGIN_LIMIT), "less than 0.05 m"),
        (lambda c: c.free_along(Trajectory([0, 1], np.zeros((1, 6, 7))), margin=0.06), "less than 0.05 m"),
        (lambda c: c.free_along("a motion"), "expected a Trajectory"),
        (lambda c: c.with_obstacles(3), "obstacles must be a sequence"),
        (lambda c: ArmCollision(attached=3), "attached must be a sequence"),
        (lambda c: ArmCollision("fr3"), "expected an ArmModel"),
        (lambda c: c.contacts(np.zeros((2, 7))), "one posture"),
        (lambda c: c.with_margin(-0.1), "margin must be"),
        (lambda c: c.with_margin(np.nan), "margin must be"),
        (lambda c: c.with_obstacles(["box"]), "expected a Box, Sphere, Capsule or HalfSpace"),
        (lambda c: c.with_obstacles([Sphere([1, 0, 0], 0.1), Sphere([0, 1, 0], 0.1)]), "two bodies called"),
        (lambda c: c.with_obstacles([Sphere([1, 0, 0], 0.1, "tool_rod")]), "two bodies called 'tool_rod'"),
        (lambda c: ArmCollision(attached=[HalfSpace([0, 0, 1], 0)]), "only capsules and spheres"),
        (lambda c: ArmCollision(attached=[Sphere([0, 0, 0], 0.1, "tool_rod")]), "same name"),
        (lambda c: c.free_along(Trajectory([0, 1], np.zeros((1, 6, 3)))), "7 joints, got 3"),
        (lambda c: c.free_along(Trajectory([0, 1], np.zeros((1, 6, 7))), tolerance=0.0), "tolerance"),
        (lambda c: ArmPathCost(c, proof_margin=0.1), "proof_margin"),
        (lambda c: ArmPathCost(c, proof_margin=np.nan), "proof_margin"),
        (lambda c: ArmPathCost(c, weight=0.0), "positive"),
        (lambda c: ArmPathCost(c, weight=np.inf), "positive"),
        (lambda c: ArmPathCost(c, tolerance="fine"), "tolerance must be a number"),
        (lambda c: ArmPathCost("arm"), "expected an ArmCollision"),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(InvalidInputError, match=message):
        call(ArmCollision(None, CELL))


def test_model_without_capsules_is_refused(tmp_path):
    path = tmp_path / "bare.xml"
    body = "<body name='a'><joint/><geom name='g' size='0.1' mass='1'/></body>"
    path.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    with pytest.raises(ConfigurationError, match="no geom whose name ends in"):
        read_capsules(path)
