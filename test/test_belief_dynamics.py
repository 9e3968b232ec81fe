"""Belief dynamics: predictions without sampling against Monte-Carlo, the noise, the variance gain."""

import math

import numpy as np
import pytest

from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.belief.variance import (
    GAIN_TOLERANCE,
    VIOLATION_WEIGHT,
    predicted_variance,
    robustness_costs,
    variance_gain,
)
from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import Disc, PlanarShape, Rectangle
from vpsto_ros.exceptions import InvalidInputError

RADIUS, FINGER = 0.05, 0.015
DISC, BOX = PlanarShape.disc(RADIUS), PlanarShape.box(0.12, 0.08)
ONE, TWO = EndEffectors.discs(FINGER), EndEffectors.discs(FINGER, 2)
FLAT = EndEffectors((Rectangle(half_size=(0.02, 0.15)),))
TOUCH = RADIUS + FINGER


def belief_at(positions, **options):
    poses = np.zeros((len(positions), 3))
    poses[:, :2] = positions
    return ObjectBelief(poses, **options)


def gaussian(std, count=20, seed=0, **options):
    return ObjectBelief.gaussian(np.zeros(3), std, count, np.random.default_rng(seed), **options)


def straight(effectors, begin, length, steps):
    """All end effectors move along x from plane coordinates on."""
    path = np.tile(np.asarray(begin, dtype=float), (steps + 1, 1))
    for column in effectors.columns:
        path[:, column] += np.linspace(0.0, length, steps + 1)
    return path


PUSHES = {
    "one finger": (ONE, [-TOUCH, 0.01]),
    "two fingers": (TWO, [-0.055, 0.035, -0.06, -0.025]),
    "flat": (FLAT, [-RADIUS - 0.02, 0.0, 0.0]),
}


@pytest.mark.parametrize("name", PUSHES)
def test_the_predicted_variance_is_that_of_sampled_perturbations(name):
    """Eqs. (6.21), (6.25): one step, tens of thousands of perturbations per particle."""
    effectors, begin = PUSHES[name]
    v_w, draws = 4e-6, 4000
    model = BeliefDynamics(DISC, effectors, step_variance=v_w)
    belief = gaussian(0.004)
    path = straight(effectors, begin, 0.003, 1)
    nominal = model.predict(belief, path[None])
    assert 0.2 < nominal.contact[0, 0] < 0.95
    many = belief_at(np.repeat(belief.poses[:, :2], draws, axis=0))
    sampled = model.simulate(many, path, np.random.default_rng(1)).poses[-1, :, :2]
    expected = predicted_variance(nominal.variance, nominal.contact, v_w)[0, 0]
    squares = ((sampled - sampled.mean(axis=0)) ** 2).sum(axis=1)
    error = math.sqrt(squares.reshape(-1, draws).var(axis=1).mean() / len(squares))
    if name == "two fingers":
        # What two contacts hold is not perturbed, and a second finger stops perturbations: an upper bound.
        assert nominal.variance[0, 1] < squares.mean() < expected
        return
    assert squares.mean() == pytest.approx(expected, abs=4.0 * error)
    # Zero mean, eq. (6.17).
    deviation = np.sqrt(sampled.reshape(-1, draws, 2).var(axis=1).mean(axis=0) / len(sampled))
    np.testing.assert_array_less(np.abs(sampled.mean(axis=0) - nominal.mean[0, 1]), 4.0 * deviation + 1e-9)


def test_the_variance_after_the_one_dimensional_push_is_that_of_the_closed_form():
    """Eq. (6.14): a flat hand through a uniform belief, for a perturbation that leaves its normal alone."""
    x = (np.arange(2000) + 0.5) / 2000 * 0.04
    belief = belief_at(np.stack([x, np.zeros(2000)], axis=1))
    model = BeliefDynamics(DISC, FLAT, step_variance=0.0)
    for share in (0.25, 0.5, 1.0):
        path = straight(FLAT, [-RADIUS - 0.025, 0.0, 0.0], 0.005 + 0.04 * share, 9)
        variance = model.predict(belief, path[None]).variance[0, -1]
        u, high = 0.04 * share, 0.04
        mean = share * u + (1 - share) * (u + high) / 2
        second = share * u**2 + (1 - share) * (high**3 - u**3) / (3 * (high - u) if share < 1 else 1)
        assert variance == pytest.approx(second - mean**2, abs=1e-8)


@pytest.mark.parametrize("friction", [False, True])
@pytest.mark.parametrize("shape", [DISC, BOX], ids=["disc", "box"])
def test_without_noise_a_rollout_is_the_prediction(shape, friction):
    model = BeliefDynamics(shape, TWO, friction=friction, step_variance=0.0)
    belief = ObjectBelief.gaussian(
        np.zeros(3), [0.003, 0.003, 0.05], 15, np.random.default_rng(2), friction=(0.0, 0.4), center_std=0.004
    )
    path = straight(TWO, [-0.09, 0.025, -0.09, -0.025], 0.09, 45)
    nominal = model.predict(belief, path[None])
    result = model.simulate(belief, path, np.random.default_rng(3), stride=5)
    assert result.poses.shape == (10, 15, 3)
    columns = nominal.mean.shape[2]
    np.testing.assert_allclose(result.poses.mean(axis=1)[:, :columns], nominal.mean[0, ::5], atol=1e-8)
    np.testing.assert_array_equal(result.poses[0], belief.poses)
    np.testing.assert_array_equal(result.belief.poses, result.poses[-1])
    np.testing.assert_array_equal(result.belief.friction, belief.friction)
    assert result.wedge == pytest.approx(nominal.wedge[0], abs=1e-6)


@pytest.mark.parametrize("shape", [DISC, BOX], ids=["disc", "box"])
def test_the_noise_is_tangential_zero_mean_and_where_there_is_contact(shape):
    reach = RADIUS if shape is DISC else 0.06
    count, v_w = 20_000, 1e-6
    noisy = BeliefDynamics(shape, ONE, step_variance=v_w)
    positions = np.zeros((count, 2))
    positions[count // 2 :, 0] = 0.05  # not reached
    path = straight(ONE, [-reach - FINGER, 0.0], 0.004, 2)
    moved = noisy.simulate(belief_at(positions), path[:2], np.random.default_rng(4)).poses[-1]
    np.testing.assert_array_equal(moved[count // 2 :, :2], positions[count // 2 :])
    pushed = moved[: count // 2]
    np.testing.assert_allclose(pushed[:, 0], 0.002, atol=1e-5)
    assert abs(pushed[:, 1].mean()) < 4.0 * math.sqrt(v_w / len(pushed))
    assert pushed[:, 1].var() == pytest.approx(v_w, rel=4.0 * math.sqrt(2.0 / len(pushed)))
    kurtosis = (pushed[:, 1] ** 4).mean() / pushed[:, 1].var() ** 2
    assert kurtosis == pytest.approx(3.0, abs=4.0 * math.sqrt(96.0 / len(pushed))), "Gaussian"
    # In an oblique contact the tangent turns with the normal.
    if shape is DISC:
        at = TOUCH * np.array([-math.cos(0.5), math.sin(0.5)])
        path = np.stack([at, at - 0.002 * at / TOUCH])
        pushed = noisy.simulate(belief_at(positions[:1000]), path, np.random.default_rng(5)).poses[-1, :, :2]
        offset = pushed + 0.002 * at / TOUCH
        assert np.abs(offset @ at).max() / TOUCH < 1e-4 * offset.std()
    # A push away from the object is no contact.
    back = noisy.simulate(
        belief_at(positions), straight(ONE, path[0] * 1.1, -0.01, 3), np.random.default_rng(6)
    )
    np.testing.assert_array_equal(back.poses[-1, :, :2], positions)


def test_the_noise_of_a_turned_box_is_along_its_side():
    yaw, v_w, count = 0.7, 1e-6, 4000
    along, side = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
    path = -np.outer([0.06 + FINGER, 0.06 + FINGER - 0.002], along)
    belief = ObjectBelief(np.tile([0.0, 0.0, yaw], (count, 1)))
    model = BeliefDynamics(BOX, ONE, step_variance=v_w)
    moved = model.simulate(belief, path, np.random.default_rng(16)).poses[-1]
    np.testing.assert_allclose(moved[:, :2] @ along, 0.002, atol=1e-5)
    assert (moved[:, :2] @ side).var() == pytest.approx(v_w, rel=4.0 * math.sqrt(2.0 / count))


@pytest.mark.parametrize("shape", [DISC, BOX], ids=["disc", "box"])
def test_noise_does_not_make_anything_penetrate(shape):
    """A second finger waits beside: what the perturbation pushes into it is projected out."""
    model = BeliefDynamics(shape, TWO, step_variance=1e-4)
    top = 0.063 if shape is DISC else 0.055
    path = straight(TWO, [-0.09, 0.0, 0.0, top], 0.05, 25)
    path[:, 2] = 0.01
    result = model.simulate(gaussian(0.001, 300), path, np.random.default_rng(7))
    struck = 0
    for row, poses in zip(path[1:], result.poses[1:], strict=True):
        for pose in poses[::10]:
            gaps = TWO.gaps(shape, pose, row)
            struck += gaps[1] < 1e-5
            assert gaps.min() > -2e-6 or result.wedge == -1.0
    assert struck > 20
    assert result.wedge > -1.0


@pytest.mark.parametrize("shape", [DISC, BOX], ids=["disc", "box"])
def test_nothing_is_perturbed_where_two_contacts_hold_the_object(shape):
    begin = [-0.055, 0.035, -0.055, -0.035] if shape is DISC else [-0.08, 0.02, -0.08, -0.02]
    path = straight(TWO, begin, 0.06, 30)
    belief = belief_at(np.zeros((200, 2)))
    noisy = BeliefDynamics(shape, TWO, step_variance=1e-4, way_variance=1e-3)
    poses = noisy.simulate(belief, path, np.random.default_rng(8)).poses
    quiet = (
        BeliefDynamics(shape, TWO, step_variance=0.0).simulate(belief, path, np.random.default_rng(8)).poses
    )
    assert np.abs(quiet[-1] - quiet[0]).max() > 0.03
    held = (np.abs(np.diff(quiet, axis=0)) > 1e-12).any(axis=2)
    assert held.any()
    np.testing.assert_allclose(poses, quiet, atol=1e-7)


def lateral_spread(model, steps):
    belief = belief_at(np.zeros((6000, 2)))
    path = straight(FLAT, [-RADIUS - 0.02, 0.0, 0.0], 0.08, steps)
    return model.simulate(belief, path, np.random.default_rng(steps)).poses[-1, :, 1].var()


def test_noise_by_the_way_does_not_depend_on_the_step_but_noise_per_step_does():
    by_way = [
        lateral_spread(BeliefDynamics(DISC, FLAT, step_variance=0.0, way_variance=1e-4), k) for k in (8, 80)
    ]
    by_step = [lateral_spread(BeliefDynamics(DISC, FLAT, step_variance=1e-7), k) for k in (8, 80)]
    accuracy = 4.0 * math.sqrt(2.0 / 6000)
    np.testing.assert_allclose(by_way, 0.08 * 1e-4, rtol=accuracy)
    np.testing.assert_allclose(by_step, [8e-7, 80e-7], rtol=accuracy)


@pytest.mark.parametrize("shape", [DISC, BOX], ids=["disc", "box"])
def test_the_same_source_of_randomness_gives_the_same_rollout(shape):
    model, belief = BeliefDynamics(shape, ONE, friction=True), gaussian(0.005, friction=(0.0, 0.5))
    path = straight(ONE, [-0.09, 0.01], 0.08, 40)
    first, second, other = (model.simulate(belief, path, np.random.default_rng(s)).poses for s in (1, 1, 2))
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - other).max() > 1e-4


def gains(name, belief=None, v_w=1e-6, length=0.06):
    effectors, begin = PUSHES[name]
    model = BeliefDynamics(DISC, effectors)
    nominal = model.predict(belief or gaussian(0.003), straight(effectors, begin, length, 40)[None])
    return variance_gain(nominal.variance, nominal.contact, v_w)[0], nominal


def test_one_finger_loses_flat_keeps_and_two_fingers_gather():
    """Figure 6.5: gamma > 1, = 1 and < 1."""
    gain, nominal = gains("one finger")
    pushing = nominal.contact[0] == 1.0
    assert pushing.sum() > 10
    assert (gain[pushing] > 1.0 + 1e-3).all()
    gain, nominal = gains("flat")
    lined_up = gain[1:][nominal.contact[0, :-1] == 1.0]
    assert len(lined_up) > 10
    np.testing.assert_allclose(lined_up, 1.0, atol=GAIN_TOLERANCE)
    assert gain.max() <= 1.0 + GAIN_TOLERANCE
    gain, nominal = gains("two fingers")
    assert gain.max() <= 1.0 + GAIN_TOLERANCE and gain.min() < 0.99
    assert nominal.variance[0, -1] < 0.1 * nominal.variance[0, 0]


def test_no_contact_has_the_gain_that_it_must_have():
    """Eq. (6.30)."""
    model, belief = BeliefDynamics(DISC, ONE), gaussian(0.003)
    nominal = model.predict(belief, straight(ONE, [0.5, 0.5], 0.1, 10)[None])
    gain = variance_gain(nominal.variance, nominal.contact, 1e-6)
    np.testing.assert_allclose(gain, belief.variance / (belief.variance + 1e-6), rtol=1e-12)


def test_friction_and_its_centre_spread_a_belief():
    """Particles of one place that differ in friction and centre of friction part under one finger."""
    rng = np.random.default_rng(9)
    options = {"friction": rng.uniform(0.0, 0.5, 30), "center": rng.normal(0.0, 0.005, (30, 2))}
    belief, path = belief_at(np.zeros((30, 2)), **options), straight(ONE, [-TOUCH, 0.005], 0.08, 40)[None]
    alike = BeliefDynamics(DISC, ONE).predict(belief, path)
    apart = BeliefDynamics(DISC, ONE, friction=True).predict(belief, path)
    assert alike.variance[0, -1] < 1e-20
    assert apart.variance[0, -1] > 1e-6


def test_objects_with_an_orientation_are_measured_in_the_metric_of_the_limit_surface():
    rng = np.random.default_rng(10)
    belief = ObjectBelief(rng.normal(0.0, [0.004, 0.006, 0.1], (40, 3)))
    far = straight(ONE, [0.5, 0.5], 0.01, 3)[None]
    for radius in (0.02, 0.05):
        model = BeliefDynamics(BOX, ONE, pressure_radius=radius)
        expected = belief.poses.var(axis=0) @ [1.0, 1.0, radius**2]
        np.testing.assert_allclose(model.predict(belief, far).variance[0], expected, rtol=1e-12)
    assert BeliefDynamics(BOX, ONE).pressure_radius == pytest.approx(BOX.mean_distance())
    # Two fingers flat against a box take its yaw and one coordinate, but not the other one.
    model = BeliefDynamics(BOX, TWO)
    path = straight(TWO, [-0.1, 0.025, -0.1, -0.025], 0.1, 50)[None]
    nominal = model.predict(belief, path)
    assert nominal.variance[0, -1] == pytest.approx(belief.poses[:, 1].var(), rel=0.5)
    assert nominal.variance[0, -1] < 0.7 * nominal.variance[0, 0]


def test_robustness_costs_equal_their_formula():
    """Eqs. (6.32) and (6.33), with K instead of K - 1."""
    rng, v_w = np.random.default_rng(11), 3e-6
    variance, contact = rng.uniform(0.0, 2e-5, (50, 9)), rng.uniform(0.0, 1.0, (50, 8))
    variance[:20] = np.sort(variance[:20], axis=1)[:, ::-1]
    contact[:10] = 0.0
    cost, worst = np.empty(50), np.empty(50)
    robustness_costs(variance, contact, v_w, cost, worst)
    gamma = (variance[:, 1:] + contact * v_w) / (variance[:, :-1] + v_w)
    np.testing.assert_allclose(variance_gain(variance, contact, v_w), gamma, rtol=1e-12)
    np.testing.assert_allclose(worst, gamma.max(axis=1), rtol=1e-12)
    weight = np.where(gamma.max(axis=1) <= 1.0 + 1e-6, 1.0, 1e3)
    assert {1.0, 1e3} == set(weight)
    np.testing.assert_allclose(cost, weight * np.prod(np.exp(-(1.0 - gamma) / 8), axis=1), rtol=1e-12)


@pytest.mark.parametrize(("excess", "weight"), [(-1e-9, 1.0), (0.5e-6, 1.0), (2e-6, VIOLATION_WEIGHT)])
def test_the_weight_jumps_beyond_the_tolerance(excess, weight):
    v_w, cost, worst = 1e-6, np.empty(1), np.empty(1)
    before = 1e-5
    after = (1.0 + excess) * (before + v_w)
    robustness_costs(np.array([[before, after]]), np.zeros((1, 1)), v_w, cost, worst)
    assert cost[0] == pytest.approx(weight, rel=1e-5)
    assert worst[0] == pytest.approx(1.0 + excess, abs=1e-9)


@pytest.mark.parametrize("v_w", [0.0, -1e-6, math.nan, math.inf])
def test_a_perturbation_must_be_positive(v_w):
    with pytest.raises(InvalidInputError, match="V_w must be positive"):
        variance_gain(np.zeros((1, 2)), np.zeros((1, 1)), v_w)
    with pytest.raises(InvalidInputError, match="V_w must be positive"):
        predicted_variance(np.zeros((1, 2)), np.zeros((1, 1)), v_w)


@pytest.mark.parametrize("shape", [DISC, BOX], ids=["disc", "box"])
def test_a_belief_without_spread_is_fine(shape):
    model, belief = BeliefDynamics(shape, ONE, friction=True), belief_at(np.zeros((5, 2)))
    nominal = model.predict(belief, straight(ONE, [-0.1, 0.01], 0.08, 30)[None])
    assert np.isfinite(nominal.mean).all()
    np.testing.assert_allclose(nominal.variance, 0.0, atol=1e-20)
    gain = variance_gain(nominal.variance, nominal.contact, 1e-6)
    np.testing.assert_allclose(gain, nominal.contact, atol=1e-9)


@pytest.mark.parametrize(
    "poses",
    [np.zeros((1, 3)), np.zeros((0, 3)), np.zeros((4, 2)), np.zeros(3), [[0, 0, 0], [0, math.nan, 0]]],
)
def test_beliefs_that_are_none_are_refused(poses):
    with pytest.raises(InvalidInputError, match="belief"):
        ObjectBelief(np.asarray(poses, dtype=float))


def test_beliefs_check_what_particles_carry():
    poses = np.zeros((3, 3))
    with pytest.raises(InvalidInputError, match="must not be negative"):
        ObjectBelief(poses, friction=[0.1, -0.1, 0.0])
    with pytest.raises(InvalidInputError, match=r"friction \(3,\) and center \(3, 2\)"):
        ObjectBelief(poses, friction=[0.1, 0.1])
    with pytest.raises(InvalidInputError, match="finite"):
        ObjectBelief(poses, center=np.full((3, 2), math.inf))
    with pytest.raises(InvalidInputError, match="range"):
        gaussian(0.01, friction=(0.3, 0.1))
    with pytest.raises(InvalidInputError, match="not negative"):
        gaussian(-0.01)
    with pytest.raises(InvalidInputError, match="P >= 2"):
        gaussian(0.01, count=1)


def test_beliefs_have_the_moments_they_are_drawn_with():
    rng, count = np.random.default_rng(12), 40_000
    belief = ObjectBelief.gaussian(
        [0.4, -0.1, 3.1], [0.01, 0.02, 0.2], count, rng, friction=(0.1, 0.5), center_std=0.003
    )
    np.testing.assert_allclose(belief.mean, [0.4, -0.1, 3.1], atol=4 * 0.2 / math.sqrt(count))
    np.testing.assert_allclose(np.diag(belief.covariance), [1e-4, 4e-4], rtol=0.05)
    assert belief.variance == pytest.approx(5e-4, rel=0.05)
    assert belief.friction.min() >= 0.1 and belief.friction.max() <= 0.5
    assert belief.friction.mean() == pytest.approx(0.3, abs=0.005)
    assert belief.center.std() == pytest.approx(0.003, rel=0.03)
    np.testing.assert_allclose(belief.continuous_poses.std(axis=0), [0.01, 0.02, 0.2], rtol=0.05)
    assert np.abs(np.remainder(belief.continuous_poses - belief.poses + 1, 2 * math.pi) - 1).max() < 1e-9


def test_jitter_and_resampling():
    rng, belief = np.random.default_rng(13), gaussian(0.01, 7, friction=(0.0, 0.5))
    jittered = belief.resampled(4000, rng).jittered(0.002, rng)
    assert jittered.variance == pytest.approx(belief.variance + 2 * 0.002**2, rel=0.05)
    np.testing.assert_array_equal(jittered.poses[:, 2], 0.0)
    drawn = belief.resampled(16, rng)
    rows = [int(np.argmin(np.abs(belief.poses - p).sum(axis=1))) for p in drawn.poses]
    assert np.bincount(rows, minlength=7).min() == 2 and np.bincount(rows).max() == 3
    np.testing.assert_array_equal(drawn.friction, belief.friction[rows])
    fewer = belief.resampled(3, rng)
    assert len({tuple(p) for p in fewer.poses}) == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"step_variance": -1e-9}, "step_variance"),
        ({"way_variance": math.nan}, "way_variance"),
        ({"pressure_radius": 0.0}, "pressure_radius"),
        ({"pressure_radius": math.inf}, "pressure_radius"),
    ],
)
def test_dynamics_that_are_none_are_refused(options, message):
    with pytest.raises(InvalidInputError, match=message):
        BeliefDynamics(DISC, ONE, **options)


def test_paths_are_checked():
    model, belief = BeliefDynamics(DISC, TWO), gaussian(0.01)
    rng = np.random.default_rng(0)
    for call, path in (
        (model.predict, np.zeros((3, 5, 3))),
        (model.predict, np.zeros((5, 4))),
        (model.predict, np.zeros((3, 1, 4))),
        (lambda b, p: model.simulate(b, p, rng), np.zeros((3, 5, 4))),
        (lambda b, p: model.simulate(b, p, rng), np.zeros((1, 4))),
    ):
        with pytest.raises(InvalidInputError, match="m = 4"):
            call(belief, path)
    with pytest.raises(InvalidInputError, match="finite"):
        model.predict(belief, np.full((1, 3, 4), math.nan))
    with pytest.raises(InvalidInputError, match="stride"):
        model.simulate(belief, np.zeros((3, 4)), rng, stride=0)


def test_only_centred_discs_take_the_fast_way_and_both_ways_agree_on_what_they_are():
    assert BeliefDynamics(DISC, ONE).radius == RADIUS
    assert BeliefDynamics(BOX, ONE).radius is None
    assert BeliefDynamics(PlanarShape((Disc((0.01, 0.0), 0.05),)), ONE).radius is None
    path = straight(ONE, [-0.1, 0.0], 0.05, 5)[None]
    assert BeliefDynamics(DISC, ONE).predict(gaussian(0.01), path).mean.shape == (1, 6, 2)
    assert BeliefDynamics(BOX, ONE).predict(gaussian(0.01), path).mean.shape == (1, 6, 3)
