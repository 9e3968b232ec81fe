"""Robust pushing plans: targets, contact rule, constraints, single horizons and long plans."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import Disc, PlanarShape, Rectangle
from vpsto_ros.exceptions import ConfigurationError, InfeasibleError, InvalidInputError
from vpsto_ros.optimization.vpsto import VpstoConfig
from vpsto_ros.planning.belief_space import scoring
from vpsto_ros.planning.belief_space.config import JointSpaceConfig, RobustPushingConfig
from vpsto_ros.planning.belief_space.contacts import ContactRule, CrossingRule
from vpsto_ros.planning.belief_space.plan_choice import best_plan
from vpsto_ros.planning.belief_space.problem import INVALID_COST, RobustPushingProblem, require_free
from vpsto_ros.planning.belief_space.receding_horizon import RobustPlan, RobustPusher
from vpsto_ros.planning.belief_space.spaces import JointSpace, PlaneSpace
from vpsto_ros.planning.belief_space.targets import WAY_POINTS, GoalTarget, PathTarget
from vpsto_ros.robot.bimanual_plane import LEAST_DISTANCE, WORKSPACE, BimanualPlane
from vpsto_ros.robot.kinematics import fr3_bimanual

BALL = 0.03
OBJECT = PlanarShape.disc(0.05)
BALLS = EndEffectors.discs(BALL, 2)
HAND = EndEffectors((Rectangle(half_size=(0.1, 0.03)),))
START = np.array([0.40, 0.10, 0.40, -0.10])
PLACE = np.array([0.5, 0.0, 0.0])
CIRCLE = PathTarget.circle([0.5, 0.0], [0.5, 0.08])


def belief(std=0.005, count=20, seed=0, pose=PLACE):
    return ObjectBelief.gaussian(pose, std, count, np.random.default_rng(seed))


def rule_for(config, effectors=BALLS, shape=OBJECT, crossing=None):
    return ContactRule(effectors, shape, config.contact_angle, config.contact_advance, crossing)


def pusher(seed=0, effectors=BALLS, space=None, reach=None, **options):
    config = RobustPushingConfig(**options)
    dynamics = BeliefDynamics(OBJECT, effectors, step_variance=1e-6)
    rule = rule_for(config, effectors, crossing=CrossingRule() if effectors is BALLS else None)
    space = space(config) if space else PlaneSpace(effectors, config)
    return RobustPusher(config, dynamics, space, rule, np.random.default_rng(seed), reach=reach)


# Targets


def test_a_goal_is_a_place():
    goal = GoalTarget(np.array([0.6, 0.1]), tolerance=0.01, largest_std=0.004)
    assert goal.remaining(0.0, np.array([0.57, 0.06])) == pytest.approx(0.05)
    np.testing.assert_array_equal(goal.way(0.0), [[0.6, 0.1, 0.0]])
    assert goal.reached(0.0, belief(0.001, pose=[0.602, 0.1, 0.0]))
    assert not goal.reached(0.0, belief(0.001, pose=[0.62, 0.1, 0.0]))
    assert not goal.reached(0.0, belief(0.01, 400, pose=[0.6, 0.1, 0.0])), "too uncertain"


def test_progress_along_a_path_never_goes_back():
    rng, progress, seen = np.random.default_rng(0), 0.0, []
    for station in np.linspace(0.0, CIRCLE.length, 60):
        angle = station / 0.08 - math.pi / 2
        position = [0.5 + 0.08 * math.cos(angle), 0.08 + 0.08 * math.sin(angle)] + rng.normal(0.0, 0.01, 2)
        before, progress = progress, CIRCLE.advanced(progress, position)
        assert progress >= before
        seen.append(progress)
    assert seen[-1] > CIRCLE.length - 0.03
    np.testing.assert_allclose(seen, np.linspace(0.0, CIRCLE.length, 60), atol=0.03)


def test_a_closed_circle_is_not_done_before_it_has_been_gone_round():
    """Its end is its beginning: only progress tells them apart."""
    np.testing.assert_allclose(CIRCLE.points[0], CIRCLE.points[-1], atol=1e-12)
    assert CIRCLE.length == pytest.approx(2.0 * math.pi * 0.08, rel=1e-3)
    at_start = belief(0.0005)
    progress = CIRCLE.advanced(0.0, PLACE[:2])
    assert progress == 0.0 and not CIRCLE.reached(progress, at_start)
    assert CIRCLE.remaining(progress, PLACE[:2]) == pytest.approx(CIRCLE.length)
    assert CIRCLE.reached(CIRCLE.length, at_start)
    assert not CIRCLE.reached(CIRCLE.length, belief(0.0005, pose=[0.53, 0.0, 0.0]))
    assert not dataclasses.replace(CIRCLE, largest_std=0.001).reached(CIRCLE.length, belief(0.005))
    assert CIRCLE.remaining(CIRCLE.length, np.array([0.53, 0.0])) == pytest.approx(0.03)
    # Counter-clockwise for positive turns, from the bottom to the right.
    assert CIRCLE.points[10, 0] > 0.5
    assert PathTarget.circle([0.5, 0.0], [0.5, 0.08], turns=-1.0).points[10, 0] < 0.5


def test_the_way_is_what_lies_ahead():
    path = PathTarget(np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.1]]), lookahead=0.06)
    way = path.way(0.07)
    assert way.shape == (WAY_POINTS, 3)
    np.testing.assert_allclose(way[0], [0.07, 0.0, 0.06])
    np.testing.assert_allclose(way[-1], [0.1, 0.03, 0.0])
    lengths = np.linalg.norm(np.diff(way[:, :2], axis=0), axis=1).sum()
    assert lengths == pytest.approx(0.06, abs=2e-3)
    np.testing.assert_allclose(path.way(path.length), np.tile([0.1, 0.1, 0.0], (WAY_POINTS, 1)), atol=1e-12)
    np.testing.assert_allclose(path.way(path.length - 0.01)[0, 2], 0.01)


def test_distances_from_a_path_are_the_smallest():
    rng = np.random.default_rng(1)
    path = PathTarget(np.cumsum(rng.normal(0.0, 0.05, (8, 2)), axis=0))
    positions = rng.normal(0.0, 0.15, (4, 20, 2))
    dense = np.vstack([
        a + (b - a) * np.linspace(0.0, 1.0, 3000)[:, None] for a, b in itertools.pairwise(path.points)
    ])  # fmt: skip
    expected = [[np.linalg.norm(dense - p, axis=1).min() for p in row] for row in positions]
    np.testing.assert_allclose(path.distances(positions), expected, atol=2e-6)
    assert np.abs(CIRCLE.distances([0.5, 0.08]) - 0.08) < 1e-4


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: GoalTarget(np.zeros(3)), r"a goal must be finite with shape \(2,\)"),
        (lambda: GoalTarget(np.array([math.nan, 0.0])), "a goal"),
        (lambda: PathTarget(np.zeros((1, 2))), "two or more points"),
        (lambda: PathTarget(np.zeros((3, 2))), "no two neighbours alike"),
        (lambda: PathTarget(np.zeros((3, 3))), "a path"),
        (lambda: PathTarget(np.eye(2), lookahead=0.0), "lookahead"),
        (lambda: PathTarget(np.eye(2), lookahead=math.nan), "lookahead"),
    ],
)
def test_targets_that_are_none_are_refused(call, message):
    with pytest.raises(InvalidInputError, match=message):
        call()


# Where to touch


def test_balls_go_behind_the_object_each_to_its_side():
    rule = rule_for(RobustPushingConfig(contact_angle=0.6, contact_advance=0.0))
    found = rule.configuration(PLACE, [1.0, 0.0], START).reshape(2, 2)
    reach = 0.05 + BALL
    expected = PLACE[:2] + reach * np.array(
        [[-math.cos(0.6), math.sin(0.6)], [-math.cos(0.6), -math.sin(0.6)]]
    )
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(BALLS.gaps(OBJECT, PLACE, found.ravel()), 0.0, atol=1e-12)
    ahead = rule_for(RobustPushingConfig(contact_advance=0.03)).configuration(PLACE, [1.0, 0.0], START)
    np.testing.assert_allclose(ahead - found.ravel(), [0.03, 0.0] * 2, atol=1e-12)


def test_without_arms_the_shorter_way_decides_which_ball_goes_where():
    rule, rng = rule_for(RobustPushingConfig()), np.random.default_rng(2)
    for _ in range(40):
        present, angle = rng.uniform(0.2, 0.8, 4), rng.uniform(-math.pi, math.pi)
        found = rule.configuration(PLACE, [math.cos(angle), math.sin(angle)], present).reshape(2, 2)
        ways = [
            np.linalg.norm(places - present.reshape(2, 2), axis=1).sum() for places in (found, found[::-1])
        ]
        assert ways[0] <= ways[1] + 1e-12


def test_arms_do_not_cross_behind_the_object():
    """Whatever the direction; which ball is nearer does not matter."""
    crossing = CrossingRule()
    rule, rng = rule_for(RobustPushingConfig(), crossing=crossing), np.random.default_rng(3)
    for angle in np.linspace(-math.pi, math.pi, 41):
        direction = [math.cos(angle), math.sin(angle)]
        places = rule.configuration(PLACE, direction, rng.uniform(0.3, 0.7, 4)).reshape(2, 2)
        if any(crossing.allows(a, b) for a, b in (places, places[::-1])):
            assert crossing.allows(*places)


def test_unequal_balls_get_places_that_fit_them():
    effectors = EndEffectors((Disc(radius=0.01), Disc(radius=0.04)))
    rule = rule_for(RobustPushingConfig(contact_advance=0.0), effectors)
    for present in ([0.4, 0.1, 0.4, -0.1], [0.4, -0.1, 0.4, 0.1]):
        found = rule.configuration(PLACE, [1.0, 0.0], present)
        np.testing.assert_allclose(effectors.gaps(OBJECT, PLACE, found), 0.0, atol=1e-12)
        assert np.sign(found[1]) == np.sign(present[1])


@pytest.mark.parametrize("yaw", np.linspace(-7.0, 7.0, 9))
def test_a_rectangle_puts_its_long_side_behind_the_object_the_shorter_way_round(yaw):
    rule = rule_for(RobustPushingConfig(contact_advance=0.0), HAND)
    for angle in np.linspace(-3.0, 3.0, 7):
        direction = np.array([math.cos(angle), math.sin(angle)])
        x, y, turned = rule.configuration(PLACE, direction, [0.4, 0.0, yaw])
        assert HAND.gaps(OBJECT, PLACE, [x, y, turned])[0] == pytest.approx(0.0, abs=1e-9)
        long_side = np.array([math.cos(turned), math.sin(turned)])
        assert abs(long_side @ direction) < 1e-9
        assert abs(turned - yaw) <= math.pi / 2 + 1e-9
        np.testing.assert_allclose([x, y], PLACE[:2] - 0.08 * direction, atol=1e-12)


def test_tall_rectangles_and_boxes():
    tall = EndEffectors((Rectangle(half_size=(0.02, 0.1)),))
    box = PlanarShape.box(0.12, 0.08)
    rule = rule_for(RobustPushingConfig(contact_advance=0.0), tall, box)
    for pose, direction, reach in (
        (np.array([0.5, 0.0, 0.0]), [1.0, 0.0], 0.06 + 0.02),
        (np.array([0.5, 0.0, math.pi / 2]), [1.0, 0.0], 0.04 + 0.02),
        (np.array([0.5, 0.0, 0.0]), [0.0, 1.0], 0.04 + 0.02),
    ):
        x, y, yaw = rule.configuration(pose, direction, [0.3, 0.0, 0.0])
        np.testing.assert_allclose([x, y], pose[:2] - reach * np.array(direction), atol=1e-9)
        assert tall.gaps(box, pose, [x, y, yaw])[0] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("effectors", [BALLS, HAND])
def test_contacts_move_along_with_the_object(effectors):
    """A of eq. (6.38) is the derivative of f_c."""
    rule, direction = rule_for(RobustPushingConfig(), effectors), np.array([0.6, 0.8])
    present = np.zeros(effectors.dof)
    base = rule.configuration(PLACE, direction, present)
    for axis in range(2):
        moved = PLACE + 1e-3 * np.eye(3)[axis]
        change = (rule.configuration(moved, direction, present) - base) / 1e-3
        np.testing.assert_allclose(change, rule.jacobian()[:, axis], atol=1e-9)


def test_the_crossing_rule_is_the_one_of_the_arms():
    (x, y), rng, rule = WORKSPACE, np.random.default_rng(4), CrossingRule()
    points = rng.uniform([x[0], y[0]] * 2, [x[1], y[1]] * 2, (3000, 4))
    points[:1500, 2:] = points[:1500, :2] + rng.normal(0.0, 0.1, (1500, 2))
    apart = BimanualPlane(fr3_bimanual()).arms_apart(points)
    distant = np.hypot(*(points[:, :2] - points[:, 2:]).T) >= LEAST_DISTANCE
    ours = np.array([rule.allows(p[:2], p[2:]) for p in points]) & distant
    assert 0.1 < apart.mean() < 0.9
    np.testing.assert_array_equal(ours, apart)
    # And so does the compiled form judge: balls of 3 cm with a gap of 5 mm are as far apart as asked for.
    excess = np.empty(len(points))
    scoring.separation_excess(
        BALLS.rows, points[:, None], LEAST_DISTANCE - 2 * BALL, rule.offset, rule.crossing, excess
    )
    np.testing.assert_array_equal(excess <= 1e-12, apart)


# Scoring


def separation_numpy(effectors, path, gap, offset, crossing):
    worst = 0.0
    poses = effectors.poses(path)
    for e, f in itertools.combinations(range(effectors.count), 2):
        away = poses[:, e, :2] - poses[:, f, :2]
        worst = max(worst, np.max(effectors.rows[[e, f], 3].sum() + gap - np.linalg.norm(away, axis=1)))
        if np.isfinite(crossing):
            right = np.maximum(-away[:, 1], 0.0)
            worst = max(
                worst, np.max(right - crossing), np.max(np.minimum(right, offset - np.abs(away[:, 0])))
            )
    return max(worst, 0.0)


@pytest.mark.parametrize("arms", [(0.0, math.inf), (0.05, 0.12)])
def test_separation_equals_its_numpy_twin(arms):
    rng = np.random.default_rng(5)
    for effectors in (BALLS, EndEffectors((*BALLS.shapes, *HAND.shapes)), HAND):
        paths = rng.uniform(-0.2, 0.2, (60, 3, effectors.dof))
        excess = np.empty(60)
        scoring.separation_excess(effectors.rows, paths, 0.01, *arms, excess)
        expected = [separation_numpy(effectors, path, 0.01, *arms) for path in paths]
        np.testing.assert_allclose(excess, expected, atol=1e-12)
        assert (excess > 0.0).any() == (effectors is not HAND)


@pytest.mark.parametrize("weight", [0.0, 4.0])
def test_progress_costs_equal_their_formula(weight):
    """Eq. (6.54); on a path a metre aside counts more, and what the variance leaves counts."""
    rng = np.random.default_rng(6)
    mean, variance = rng.normal(0.0, 0.1, (30, 5, 2)), rng.uniform(0.0, 1e-4, (30, 5))
    cost, goal = np.empty(30), np.array([[0.1, 0.05, 0.0]])
    scoring.progress_costs(mean, variance, goal, 1.0, 30.0, weight, cost)
    d = np.sqrt(((mean - goal[0, :2]) ** 2).sum(axis=2) + weight * variance)
    np.testing.assert_allclose(cost, np.exp(-30.0 * (d[:, 0] - d[:, -1])), rtol=1e-12)
    way = CIRCLE.way(0.05)
    scoring.progress_costs(mean, variance, way, 2.0, 30.0, weight, cost)
    offsets = np.linalg.norm(mean[:, [0, -1], None] - way[:, :2], axis=3)
    d = np.sqrt((way[:, 2] + 2.0 * offsets).min(axis=2) ** 2 + weight * variance[:, [0, -1]])
    np.testing.assert_allclose(cost, np.exp(-30.0 * (d[:, 0] - d[:, 1])), rtol=1e-12)
    distance = np.zeros(30)
    scoring.distance_costs(mean, variance, way, 2.0, 3.0, weight, distance)
    np.testing.assert_allclose(distance, 3.0 * d[:, 1], rtol=1e-12)


def test_progress_costs_stay_finite():
    mean, cost = np.array([[[0.0, 0.0], [-9.0, 0.0]]]), np.empty(1)
    scoring.progress_costs(mean, np.zeros((1, 2)), np.array([[1.0, 0.0, 0.0]]), 1.0, 1e4, 0.0, cost)
    assert 1e6 < cost[0] < math.inf


def test_height_excess():
    heights, excess = np.array([[[0.03, 0.05]], [[0.034, 0.031]]]), np.empty(2)
    scoring.height_excess(heights, 0.035, 0.004, excess)
    np.testing.assert_allclose(excess, [0.011, 0.0], atol=1e-12)


# One horizon


def problem(way=None, start=START, velocity=None, reach=None, **options):
    config = RobustPushingConfig(**options)
    return RobustPushingProblem(
        config, BeliefDynamics(OBJECT, BALLS), PlaneSpace(BALLS, config),
        rule_for(config, crossing=CrossingRule()),
        start=np.asarray(start), velocity=np.zeros(4) if velocity is None else np.asarray(velocity),
        belief=belief(), way=np.array([[0.6, 0.0, 0.0]]) if way is None else way, reach=reach,
    )  # fmt: skip


def in_reach(points):
    return np.hypot(points[:, 0], points[:, 1]) < 0.52


@pytest.mark.parametrize("velocity", [[0.0] * 4, [0.06, 0.02, 0.05, -0.03]])
def test_valid_candidates_keep_every_constraint(velocity):
    posed = problem(velocity=velocity, reach=in_reach, contact_advance=0.04)
    points = posed.prior().sample(np.random.default_rng(7), 600)
    evaluation = posed.evaluate(points)
    outcome = posed.outcome(points)
    assert 10 < evaluation.valid.sum() < 590
    limits, config = posed.space.limits, posed.config
    rows = np.flatnonzero(evaluation.valid)
    for b in rows[:40]:
        motion = posed.trajectory(points[b])
        assert motion.violations(limits) == []
        np.testing.assert_allclose(motion(0.0), START, atol=1e-12)
        np.testing.assert_allclose(motion(0.0, 1), velocity, atol=1e-9)
        np.testing.assert_allclose(motion(motion.end_time, 1), 0.0, atol=1e-9)
        sampled = motion(np.linspace(0.0, motion.duration, config.steps + 1))
        np.testing.assert_allclose(sampled, outcome.paths[b], atol=1e-9)
        assert separation_numpy(BALLS, sampled, config.separation, 0.05, 0.12) == 0.0
        assert in_reach(sampled[:, :2]).all()
        # Between samples: not farther than half a step can lead.
        dense = motion(np.linspace(0.0, motion.duration, 1000))
        slack = np.abs(np.diff(sampled, axis=0)).max()
        assert separation_numpy(BALLS, dense, config.separation, 0.05, 0.12) <= slack
        v, e = outcome.prediction.variance[b], outcome.prediction.contact[b]
        gain = (v[1:] + e * config.perturbation) / (v[:-1] + config.perturbation)
        assert gain.max() <= 1.0 + 1e-6
        assert outcome.prediction.wedge[b] >= config.wedge
        assert outcome.prediction.step[b] <= config.longest_step


@pytest.mark.parametrize("too_near", [2e-4, 0.003])
def test_balls_that_stand_too_near_to_each_other_are_not_stuck(too_near):
    """As where a brake ended: plans may begin there if they do not make it worse."""
    apart = 2.0 * BALL + 0.005 - too_near
    start = [0.40, apart / 2.0, 0.40, -apart / 2.0]
    posed = problem(start=start)
    points = posed.prior().sample(np.random.default_rng(7), 400)
    evaluation, paths = posed.evaluate(points), posed.outcome(points).paths
    assert 0 < evaluation.valid.sum() < 400
    excess = [separation_numpy(BALLS, path, posed.config.separation, 0.05, 0.12) for path in paths]
    assert max(np.array(excess)[evaluation.valid]) <= too_near + 2e-6


def test_arms_that_stand_out_of_reach_come_back():
    posed = problem(start=[0.53, 0.10, 0.40, -0.10], reach=in_reach)  # the left ball is outside
    points = posed.prior().sample(np.random.default_rng(7), 400)
    ends = np.array([in_reach(path[-1:, :2])[0] for path in posed.outcome(points).paths])
    assert ends.any() and not ends.all()
    assert (posed.outcome(points).excess[ends] < 0.1).all()
    assert (posed.outcome(points).excess[~ends] >= 0.1).all()


@pytest.mark.parametrize(
    "options",
    [{}, {"progress_weight": 1e4}, {"distance_weight": 1e4}, {"robust": False}, {"duration_weight": 1e3}],
)
def test_no_invalid_candidate_is_cheaper_than_a_valid_one(options):
    posed = problem(way=np.array([[0.3, 0.0, 0.0]]), **options)
    points = posed.prior().sample(np.random.default_rng(8), 400)
    evaluation = posed.evaluate(points)
    assert 0 < evaluation.valid.sum() < 400
    assert np.isfinite(evaluation.cost).all()
    assert evaluation.cost[~evaluation.valid].min() >= evaluation.cost[evaluation.valid].max()
    assert evaluation.cost[~evaluation.valid].min() >= INVALID_COST


def test_an_object_that_jumps_makes_a_plan_invalid():
    free, strict = problem(), problem(longest_step=0.002)
    points = free.prior().sample(np.random.default_rng(16), 300)
    jumps = free.outcome(points).prediction.step > 0.002
    before, after = free.evaluate(points).valid, strict.evaluate(points).valid
    assert (before & jumps).any() and after.any()
    np.testing.assert_array_equal(after, before & ~jumps)


def test_a_worse_violation_costs_more():
    posed = problem(contact_prior=False, robust=False)
    still = np.tile(START, (3, 2, 1))
    near, nearer = still.copy(), still.copy()
    near[:, :, 1], near[:, :, 3] = 0.025, -0.025
    nearer[:, :, 1], nearer[:, :, 3] = 0.015, -0.015
    cost = [posed.evaluate(candidate).cost[0] for candidate in (still, near, nearer)]
    assert cost[0] < INVALID_COST < cost[1] < cost[2]


def test_the_cost_is_the_sum_of_its_terms():
    posed = problem(duration_weight=0.3)
    points = posed.prior().sample(np.random.default_rng(9), 60)
    evaluation, outcome = posed.evaluate(points), posed.outcome(points)
    prediction, config = outcome.prediction, posed.config
    d = np.sqrt(((prediction.mean - [0.6, 0.0]) ** 2).sum(axis=2) + 4.0 * prediction.variance)
    gain = (prediction.variance[:, 1:] + prediction.contact * config.perturbation) / (
        prediction.variance[:, :-1] + config.perturbation
    )
    expected = (
        np.exp(-config.progress_weight * (d[:, 0] - d[:, -1]))
        + 0.3 * outcome.motion.duration
        + np.exp(-(1.0 - gain).mean(axis=1))
    )
    valid = evaluation.valid
    assert valid.any()
    np.testing.assert_allclose(evaluation.cost[valid], expected[valid], rtol=1e-9)
    assert valid[gain.max(axis=1) > 1.0 + 1e-5].sum() == 0


def test_the_contact_prior_draws_touching_candidates():
    """Figure 6.6."""
    shares = []
    for contact_prior in (True, False):
        posed = problem(contact_prior=contact_prior, start=[0.3, 0.1, 0.3, -0.1])
        points = posed.prior().sample(np.random.default_rng(10), 300)
        shares.append((posed.outcome(points).prediction.contact.max(axis=1) > 0.0).mean())
    assert shares[0] > 0.7 > 0.3 > shares[1]
    prior = problem(contact_prior=False).prior()
    np.testing.assert_allclose(prior.mean_points, np.tile(START, (2, 1)), atol=1e-12)


def test_a_given_contact_replaces_the_rule():
    config = RobustPushingConfig(smoothness_spread=5.0)
    mean, covariance = np.array([0.45, 0.15, 0.55, -0.12]), np.diag([1e-6, 2e-6, 3e-6, 4e-6])
    posed = RobustPushingProblem(
        config, BeliefDynamics(OBJECT, BALLS), PlaneSpace(BALLS, config), rule_for(config),
        start=START, velocity=np.zeros(4), belief=belief(), way=np.array([[0.6, 0.0, 0.0]]),
        contact=(mean, covariance),
    )  # fmt: skip
    prior = posed.prior()
    np.testing.assert_allclose(prior.mean_points[-1], mean, atol=1e-4)
    np.testing.assert_allclose(prior.covariance[4:, 4:], covariance, rtol=1e-3, atol=1e-9)


def test_penetration_at_the_start_is_an_error_in_words():
    dynamics = BeliefDynamics(OBJECT, BALLS)
    require_free(dynamics, belief(), np.array([0.425, 0.0, 0.4, -0.15]))
    with pytest.raises(InvalidInputError, match=r"end effector 1 of 2 penetrates the object by 49\.9 mm"):
        require_free(dynamics, belief(), np.array([0.47, 0.0, 0.4, -0.15]))
    with pytest.raises(InvalidInputError, match="penetrates"):
        pusher().plan(np.array([0.3, 0.1, 0.52, 0.0]), belief(), CIRCLE)


# Long plans


def success(planner, plan, target, std, rollouts=1000):
    """Share of noisy rollouts that stay near the path and end near its end."""
    motion = plan.trajectory
    times = np.linspace(motion.start_time, motion.end_time, int(motion.duration / 0.02) + 2)
    rolled = planner.dynamics.simulate(
        belief(std, rollouts, 11), motion(times), np.random.default_rng(12), stride=25
    )
    positions = rolled.poses[..., :2]
    final = np.linalg.norm(positions[-1] - target.points[-1], axis=1)
    return float(((final < 0.02) & (target.distances(positions).max(axis=0) < 0.04)).mean())


@pytest.fixture(scope="module")
def plans():
    """Robust plans and those of the baseline for the circle, by seed."""
    found = {}
    for robust, seed in itertools.product((True, False), (0, 1, 2)):
        planner = pusher(seed, robust=robust)
        found[robust, seed] = planner, planner.plan(START, belief(seed=100 + seed), CIRCLE)
    return found


def test_the_circle_is_pushed_along_to_its_end(plans):
    for planner, plan in plans.values():
        assert plan.reached and plan.horizons <= 150
        motion = plan.trajectory
        assert motion.violations(planner.space.limits) == []
        assert max(j.max() for j in motion.jumps()) < 1e-9
        np.testing.assert_allclose(motion(0.0), START, atol=1e-12)
        np.testing.assert_allclose(motion(motion.end_time, 1), 0.0, atol=1e-9)
        np.testing.assert_allclose(motion(0.0, 1), 0.0, atol=1e-12)
        assert len(plan.means) == len(plan.stds) == len(plan.times) == plan.horizons + 1
        assert (np.diff(plan.times) > 0.0).all() and plan.violating <= plan.horizons
        assert CIRCLE.distances(plan.means).max() < 0.03
        assert np.linalg.norm(plan.belief.mean[:2] - PLACE[:2]) < 0.015
        assert plan.evaluations == plan.horizons * 300
        sampled = motion(np.linspace(0.0, motion.duration, 4000))
        excess = separation_numpy(BALLS, sampled, planner.config.separation, 0.05, 0.12)
        assert excess < 0.003


def test_robust_plans_hold_in_noisy_rollouts_and_those_of_the_baseline_do_not(plans):
    """Figure 6.12; the baseline is judged from the expected place."""
    shares = {
        key: success(planner, plan, CIRCLE, 0.005 if key[0] else 0.0)
        for key, (planner, plan) in plans.items()
    }
    robust, baseline = (np.mean([shares[kind, s] for s in (0, 1, 2)]) for kind in (True, False))
    assert min(shares[True, s] for s in (0, 1, 2)) > 0.85
    assert baseline < robust - 0.2


def test_the_same_seed_gives_the_same_plan(plans):
    plan = plans[True, 0][1]
    again = pusher(0).plan(START, belief(seed=100), CIRCLE)
    np.testing.assert_array_equal(again.trajectory.coefficients, plan.trajectory.coefficients)
    np.testing.assert_array_equal(again.belief.poses, plan.belief.poses)
    other = plans[True, 1][1]
    assert other.trajectory.duration != plan.trajectory.duration


def test_a_plan_can_start_in_motion_and_later():
    planner, velocity = pusher(3), np.array([0.05, 0.0, 0.05, 0.0])
    plan = planner.plan(START, belief(), CIRCLE, velocity=velocity, horizons=3, start_time=7.0)
    motion = plan.trajectory
    assert motion.start_time == 7.0 and plan.times[0] == 7.0
    assert not plan.reached and plan.horizons == 3
    np.testing.assert_allclose(motion(7.0, 1), velocity, atol=1e-9)
    np.testing.assert_allclose(motion(motion.end_time, 1), 0.0, atol=1e-9)
    assert motion.violations(planner.space.limits) == []


def test_a_target_that_is_reached_needs_no_plan():
    plan = pusher().plan(START, belief(), GoalTarget(PLACE[:2]))
    assert plan.reached and plan.trajectory is None and plan.horizons == 0


def test_without_any_valid_candidate_the_robot_brakes():
    """Nothing is ever in reach."""
    planner = pusher(reach=lambda points: np.zeros(len(points), dtype=bool))
    velocity = np.array([0.1, 0.02, 0.1, -0.02])
    step = planner.horizon(START, velocity, belief(), CIRCLE.way(0.0), start_time=2.0)
    assert not step.valid and step.trajectory.start_time == 2.0
    assert planner.executed_time(step) == pytest.approx(step.trajectory.duration)
    np.testing.assert_allclose(step.trajectory(step.trajectory.end_time, 1), 0.0, atol=1e-12)
    plan = planner.plan(START, belief(), CIRCLE, velocity=velocity, horizons=4)
    assert not plan.reached and plan.horizons == plan.violating == 4
    motion = plan.trajectory
    assert motion.violations(planner.space.limits) == []
    np.testing.assert_allclose(motion(motion.end_time, 1), 0.0, atol=1e-9)
    way = np.abs(motion(motion.end_time) - START)
    assert way.max() == pytest.approx(0.1**2 / (2 * 0.6), rel=0.01), "braked at once"
    np.testing.assert_array_equal(plan.belief.poses[:, :2].mean(axis=0), belief().mean[:2])


def test_an_unreachable_target_is_not_said_to_be_reached():
    reach = pusher(reach=lambda points: (points[:, [0, 2]] < 0.5).all(axis=1))
    plan = reach.plan(START, belief(), GoalTarget(np.array([0.9, 0.0])), horizons=12)
    assert not plan.reached and plan.horizons == 12
    assert plan.trajectory(np.linspace(0.0, plan.trajectory.duration, 500))[:, [0, 2]].max() < 0.505


def test_what_is_left_is_reported_horizon_by_horizon():
    left = []
    plan = pusher(4).plan(START, belief(), CIRCLE, horizons=6, report=left.append)
    assert len(left) == plan.horizons == 6
    assert left[-1] < left[0] <= CIRCLE.length


def test_one_hand_keeps_the_object_too():
    """6.6.2: a hand with a yaw pushes a disc to a place."""
    planner = pusher(5, effectors=HAND)
    goal = GoalTarget(np.array([0.62, 0.05]))
    plan = planner.plan(np.array([0.38, 0.0, math.pi / 2]), belief(), goal, horizons=120)
    assert plan.reached
    motion = plan.trajectory
    assert motion.violations(planner.space.limits) == []
    times = np.linspace(0.0, motion.duration, int(motion.duration / 0.02) + 2)
    ends = planner.dynamics.simulate(
        belief(count=1000, seed=13), motion(times), np.random.default_rng(14)
    ).poses[-1]
    assert (np.linalg.norm(ends[:, :2] - goal.position, axis=1) < 0.03).mean() > 0.8


@pytest.mark.parametrize(
    "options", [{"points": 0}, {"largest_gain": 0.5}, {"wedge": -2.0}, {"perturbation": 0.0}]
)
def test_options_out_of_range_are_refused(options):
    (name,) = options
    with pytest.raises(ConfigurationError, match=name):
        RobustPushingConfig(**options)


# Joint space

TOOLS = BimanualPlane(fr3_bimanual())


def joint_pusher(seed=0, spread=0.1, **options):
    joints = JointSpaceConfig(spread=spread)
    return pusher(seed, space=lambda config: JointSpace(TOOLS, joints), points=2, **options)


def test_in_joint_space_candidates_move_the_balls_where_kinematics_says():
    planner = joint_pusher()
    q = TOOLS.joints(np.stack([START, START + 0.02]))
    planar, heights = planner.space.plane(q[None])
    np.testing.assert_allclose(planar[0], [START, START + 0.02], atol=1e-9)
    np.testing.assert_allclose(heights, TOOLS.height, atol=1e-9)


def test_the_joint_space_prior_keeps_height_and_touches():
    """With a wide smoothness prior the contact prior alone says where; else it is a compromise."""
    start = TOOLS.joints(START[None])[0]
    for spread in (0.1, 3.0):
        planner = joint_pusher(spread=spread)
        posed = RobustPushingProblem(
            planner.config, planner.dynamics, planner.space, planner.rule, start=start,
            velocity=np.zeros(14), belief=belief(), way=np.array([[0.6, 0.0, 0.0]]),
        )  # fmt: skip
        prior, (mean, covariance) = posed.prior(), posed.contact
        planar, heights = (values[0] for values in planner.space.plane(prior.mean_points[None]))
        assert np.abs(heights - TOOLS.height).max() < 0.004
        left = np.linalg.norm(planar[-1] - mean) / np.linalg.norm(START - mean)
        assert left < (0.6 if spread == 0.1 else 0.06)
        # To first order balls spread as in the plane, or less.
        joints = prior.mean_points[-1]
        j, _ = planner.space._jacobians(joints)
        spreads = j @ prior.covariance[14:, 14:] @ j.T
        assert (np.diag(spreads) < 1.1 * np.diag(covariance)).all()
        if spread == 3.0:
            np.testing.assert_allclose(spreads, covariance, atol=0.05 * covariance.max())


def test_candidates_beyond_joint_limits_or_off_their_height_are_invalid():
    planner = joint_pusher(robust=False, smoothness_spread=0.01)
    start = TOOLS.joints(START[None])[0]
    posed = RobustPushingProblem(
        planner.config, planner.dynamics, planner.space, planner.rule, start=start,
        velocity=np.zeros(14), belief=belief(), way=np.array([[0.6, 0.0, 0.0]]),
    )  # fmt: skip
    still = np.tile(start, (3, 2, 1))
    upper = planner.space.limits.upper
    # Joint 2 lifts the ball; no other joint than 1 and 7 leaves its height where it is.
    still[1, :, 1] += 0.05
    still[2, :, 0] += 1.2 * (upper[0] - start[0])
    excess, valid = posed.outcome(still).excess, posed.evaluate(still).valid
    np.testing.assert_array_equal(valid, [True, False, False])
    assert excess[1] > 0.01
    assert excess[2] >= 0.2 * (upper[0] - start[0]) - 1e-9


def test_joint_space_plans_keep_joint_limits_and_heights():
    planner = joint_pusher(6, search=VpstoConfig(population=40, iterations=20, strategy="cma"))
    start = TOOLS.joints(START[None])[0]
    plan = planner.plan(start, belief(), GoalTarget(np.array([0.56, 0.0])), horizons=40)
    motion = plan.trajectory
    assert plan.reached
    assert motion.violations(planner.space.limits) == []
    np.testing.assert_allclose(motion(motion.end_time, 1), 0.0, atol=1e-9)
    planar, heights = planner.space.plane(motion(np.linspace(0.0, motion.duration, 2000))[None])
    assert np.abs(heights - TOOLS.height).max() < planner.space.height_tolerance + 5e-4
    assert separation_numpy(BALLS, planar[0], planner.config.separation, 0.05, 0.12) < 0.003


def test_a_contact_out_of_reach_of_an_arm():
    """The object is beyond both arms: an error for a horizon whose whole way is, else what is in reach."""
    planner = joint_pusher()
    far = belief(pose=[1.4, 0.0, 0.0])
    plan = planner.plan(TOOLS.joints(START[None])[0], far, GoalTarget(np.array([1.5, 0.0])), horizons=3)
    assert not plan.reached
    beyond = np.array([1.2, 0.2, 1.2, -0.2])
    with pytest.raises(InfeasibleError, match="cannot reach"):
        planner.space.factor(2, beyond + 0.1, np.eye(4) * 1e-4, beyond)


# Choosing among plans


def plan_with(reached, horizons):
    still = belief(0.001)
    nothing = np.zeros(1)
    return RobustPlan(None, reached, horizons, 0, still, nothing, nothing, nothing, 1.0, 0.0, 0)


@pytest.mark.parametrize(
    ("outcomes", "enough", "chosen", "made"),
    [
        ([(True, 0.5), (True, 0.99), (True, 0.7)], math.inf, 1, 3),
        ([(True, 0.5), (True, 0.99), (True, 0.7)], 0.9, 1, 2),
        ([(False, 1.0), (True, 0.1)], 0.9, 1, 2),
        ([(False, 0.2), (False, 0.3)], 0.0, 1, 2),
        ([(True, 0.9), (True, 0.9)], math.inf, 0, 2),
    ],
)  # fmt: skip
def test_the_best_plan_that_gets_there_is_taken(outcomes, enough, chosen, made):
    made_plans = []

    def make():
        made_plans.append(plan_with(outcomes[len(made_plans)][0], len(made_plans)))
        return made_plans[-1]

    plan, verdict = best_plan(
        make, lambda plan: outcomes[plan.horizons], lambda verdict: verdict[1], len(outcomes), enough=enough
    )
    assert plan is made_plans[chosen] and verdict == outcomes[chosen] and len(made_plans) == made


def test_at_least_one_plan_has_to_be_made():
    with pytest.raises(InvalidInputError, match="attempts = 0"):
        best_plan(lambda: plan_with(True, 0), lambda plan: 0.0, float, 0)
