"""Cost terms against fine sampling and SciPy, and VP-STO from end to end."""

import doctest
import re

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.interpolate import CubicSpline

from vpsto_ros.exceptions import ConfigurationError, InfeasibleError, InvalidInputError
from vpsto_ros.optimization import costs
from vpsto_ros.optimization.costs import CostWeights, JointSpaceProblem
from vpsto_ros.optimization.terms import (
    collision_cost,
    duration_cost,
    joint_limit_cost,
    position_extrema,
    pushing_progress_cost,
    smoothness_cost,
)
from vpsto_ros.optimization.vpsto import VpstoConfig, search
from vpsto_ros.trajectory import (
    MINIMUM_DURATION,
    Limits,
    OptimalBasis,
    minimal_duration,
    synthesize,
    synthesize_batch,
)

LIMITS = Limits(np.array([1.0, 0.8]), np.array([2.0, 3.0]), np.array([-0.6, -0.5]), np.array([1.2, 0.9]))
V0, VT = np.array([0.4, -0.3]), np.array([0.1, 0.5])


@pytest.fixture
def basis():
    return OptimalBasis.uniform(3)


@pytest.fixture
def batch(basis):
    keys = np.random.default_rng(2).uniform(-0.6, 1.0, (40, 5, 2))
    return synthesize_batch(basis, keys, V0, VT, LIMITS, 60)


def test_durations_are_costs(batch):
    np.testing.assert_array_equal(duration_cost(batch), batch.duration)


def test_smoothness_is_the_exact_effort(basis, batch):
    weights = np.array([2.0, 0.5])
    cost = smoothness_cost(batch, weights)
    s = np.linspace(0, 1, 20_001)
    for keys, duration, value in zip(batch.key_positions, batch.duration, cost, strict=True):
        spline = CubicSpline(basis.knots, keys, bc_type=((1, V0 * duration), (1, VT * duration)))
        assert value == pytest.approx(0.5 * trapezoid(spline(s, 2) ** 2 @ weights, s), rel=1e-5)


def test_smoothness_does_not_depend_on_the_origin(basis, batch):
    moved = synthesize_batch(basis, batch.key_positions + 1e4, V0, VT, LIMITS, 2)
    np.testing.assert_allclose(
        smoothness_cost(moved), smoothness_cost(batch), rtol=1e-6
    )


def test_extrema_are_those_of_the_one_evaluator(basis, batch):
    lowest, highest = position_extrema(batch)
    for b, keys in enumerate(batch.key_positions):
        lower, upper = synthesize(basis, keys, V0, VT, LIMITS).extrema(0)
        np.testing.assert_allclose(lowest[b], lower, atol=1e-12)
        np.testing.assert_allclose(highest[b], upper, atol=1e-12)
    assert np.all(batch.position.max(axis=1) <= highest + 1e-12)


def test_joint_limits_are_exact(basis, batch):
    cost, valid = joint_limit_cost(batch, LIMITS)
    assert 0 < np.count_nonzero(valid) < len(valid)
    for b, keys in enumerate(batch.key_positions):
        broken = synthesize(basis, keys, V0, VT, LIMITS).violations(LIMITS)
        assert valid[b] == (not broken)
        assert valid[b] == (cost[b] == 0)
        assert cost[b] >= len(broken)


def test_joint_limit_cost_is_one_plus_the_excess(basis):
    keys = np.zeros((1, 5, 2))
    keys[0, 1:, 0] = 1.5  # overshoots the end position, whose excess alone would be 0.3
    batch = synthesize_batch(basis, keys, np.zeros(2), np.zeros(2), LIMITS, 10)
    _, highest = position_extrema(batch)
    cost, valid = joint_limit_cost(batch, LIMITS)
    assert not valid[0] and cost[0] == pytest.approx(1.0 + highest[0, 0] - 1.2)


def test_collisions_are_counted(batch):
    cost, valid = collision_cost(batch, lambda q: q[..., 0] > 0.8, 10.0)
    share = (batch.position[..., 0] > 0.8).mean(axis=1)
    np.testing.assert_allclose(cost, batch.duration * share)
    np.testing.assert_array_equal(valid, share == 0.0)
    with pytest.raises(InvalidInputError, match=r"bool of shape \(40, 60\)"):
        collision_cost(batch, lambda q: q > 0.8, 10.0)
    with pytest.raises(InvalidInputError, match="step between evaluation points must be positive"):
        collision_cost(batch, lambda q: q[..., 0] > 0.8, 0.0)


def test_points_are_at_most_a_step_apart(batch):
    asked = []

    def record(positions):
        asked.append(positions)
        return np.zeros(positions.shape[:2], dtype=bool)

    step = 0.01
    collision_cost(batch, record, step)
    checked = np.concatenate([np.abs(np.diff(p, axis=1)).max(axis=(1, 2)) for p in asked[1:]])
    assert len(asked) > 2 and checked.size == len(batch.duration) and checked.max() <= step


def test_the_step_is_kept_by_a_motion_too_long_for_it_being_invalid():
    keys = np.array([[[0.0, 0.0], [1e4, 0.0], [1.0, 0.0]]])
    batch = synthesize_batch(OptimalBasis.uniform(1), keys, np.zeros(2), np.zeros(2), PLANE, 50)
    cost, valid = collision_cost(batch, lambda q: np.zeros(q.shape[:2], dtype=bool), 0.01)
    assert cost[0] > 0.0 and not valid[0]


def test_no_search_jumps_through_a_wall_between_two_points():
    """Fifty points at even phases invite detours that leave none of them inside the wall."""
    limits = Limits(np.ones(3), np.full(3, 2.0), np.full(3, -3.0), np.full(3, 3.0))
    problem = JointSpaceProblem(
        OptimalBasis.uniform(4), limits, np.zeros(3), np.eye(3)[0],
        collision=lambda q: np.abs(q[..., 0] - 0.5) < 0.1,
    )  # fmt: skip
    config = VpstoConfig(iterations=60, restarts=2)
    for seed in range(5):
        result = search(problem.prior(spread=0.5), problem.evaluate, config, np.random.default_rng(seed))
        assert not result.valid and "in collision for" in problem.explain(result.best_any_points)[0]


def test_pushing_progress():
    target = np.array([1.0, 0.0])
    end = np.array([[0.5, 0.0], [0.0, 0.0], [-0.5, 0.0]])
    cost, valid = pushing_progress_cost(np.zeros(2), end, target)
    np.testing.assert_allclose(cost, np.exp([0.25 - 1, 0.0, 2.25 - 1]))
    np.testing.assert_array_equal(valid, [True, False, False])


def disc(positions):
    return np.square(positions - [0.5, 0.0]).sum(axis=-1) < 0.3**2


PLANE = Limits(np.full(2, 1.0), np.full(2, 2.0), np.full(2, -0.6), np.full(2, 1.2))


def around_the_disc(n_via=3, limits=PLANE, **options):
    arguments = {"goal": np.array([1.0, 0.0]), "collision": disc} | options
    return JointSpaceProblem(OptimalBasis.uniform(n_via), limits, np.zeros(2), **arguments)


@pytest.mark.parametrize("strategy", ["sep-cma", "cma"])
def test_a_way_round_the_obstacle_is_found_every_time(strategy):
    limits = Limits(PLANE.velocity, PLANE.acceleration, np.full(2, -1.2), np.full(2, 1.2))
    problem = around_the_disc(limits=limits)
    sides = set()
    for seed in range(20):
        config = VpstoConfig(strategy=strategy, iterations=15)
        result = search(problem.prior(spread=0.3), problem.evaluate, config, np.random.default_rng(seed))
        assert result.valid, f"seed {seed}: {result.status}"
        trajectory = problem.trajectory(result.points)
        assert trajectory.violations(PLANE) == []
        fine = trajectory(np.linspace(0, trajectory.duration, 2000))
        assert np.linalg.norm(fine - [0.5, 0.0], axis=1).min() > 0.3 - 0.005, "between two samples at most"
        assert result.cost < 3.5
        sides.add(bool(trajectory(trajectory.duration / 2)[1] > 0))
    assert sides == {True, False}, "both ways round are found"


def test_all_seeds_converge_to_one_of_two_mirrored_optima():
    problem = around_the_disc()
    costs = []
    for seed in range(6):
        config = VpstoConfig(strategy="cma", iterations=100)
        costs.append(
            search(problem.prior(spread=0.3), problem.evaluate, config, np.random.default_rng(seed)).cost
        )
    np.testing.assert_allclose(costs, np.min(costs), rtol=5e-3)


def test_more_via_points_approach_the_bang_bang_time():
    # Thesis 4.5.3: from 0 to 1 with |v| <= 0.1 and |a| <= 0.2 takes at least 10.5 s.
    limits = Limits(np.array([0.1]), np.array([0.2]))
    best = []
    for n_via in (1, 3, 6):
        problem = JointSpaceProblem(
            OptimalBasis.uniform(n_via), limits, np.zeros(1), np.ones(1), weights=CostWeights(smoothness=0.0)
        )
        config = VpstoConfig(strategy="cma", iterations=120)
        best.append(
            search(problem.prior(spread=0.2), problem.evaluate, config, np.random.default_rng(0)).cost
        )
    assert best[0] > best[1] > best[2] > 10.5
    assert best[2] < 11.2


def test_a_free_goal_is_part_of_the_search():
    def to_the_right(batch):
        cost = 10 * np.abs(batch.position[:, -1, 0] - 0.7)
        return cost, np.ones(len(cost), dtype=bool)

    problem = around_the_disc(2, goal=None, collision=None, terms=(to_the_right,))
    config = VpstoConfig(iterations=60)
    result = search(problem.prior(spread=0.3), problem.evaluate, config, np.random.default_rng(0))
    assert result.points.shape == (3, 2)
    assert problem.trajectory(result.points)(100.0)[0] == pytest.approx(0.7, abs=0.01)


def test_seven_joints_through_a_narrow_gap():
    limits = Limits(np.full(7, 2.0), np.full(7, 8.0), np.full(7, -2.0), np.full(7, 2.0))

    def wall(q):
        return (np.abs(q[..., 0] - 0.5) < 0.1) & (q[..., 1] < 0.5)

    goal = np.zeros(7)
    goal[0] = 1.0
    problem = JointSpaceProblem(OptimalBasis.uniform(4), limits, np.zeros(7), goal, collision=wall)
    config = VpstoConfig(iterations=60)
    result = search(problem.prior(spread=0.4), problem.evaluate, config, np.random.default_rng(0))
    assert result.valid and problem.trajectory(result.points).violations(limits) == []


def test_a_start_faster_than_the_limit_has_no_valid_plan():
    problem = around_the_disc(start_velocity=np.array([1.5, 0.0]))
    result = search(problem.prior(spread=0.3), problem.evaluate, VpstoConfig(), np.random.default_rng(0))
    assert result.status == "no valid plan" and result.non_finite == result.evaluations
    with pytest.raises(InfeasibleError):
        problem.trajectory(np.zeros((3, 2)))


def test_the_prior_uses_the_duration_of_the_direct_motion():
    velocity = np.array([0.5, 0.0])
    problem = around_the_disc(start_velocity=velocity)
    ends = np.array([[0.0, 0.0], [1.0, 0.0]])
    duration = minimal_duration(OptimalBasis.uniform(0), ends, velocity, np.zeros(2), PLANE)
    curve = CubicSpline([0, 1], ends, bc_type=((1, velocity * duration), (1, np.zeros(2))))
    np.testing.assert_allclose(problem.prior().mean_points, curve([0.25, 0.5, 0.75]), atol=1e-12)


class DiscTerm:
    """A term that can say what it means."""

    def __init__(self, centre, radius, **flags):
        self.centre, self.radius = np.asarray(centre), radius
        self.__dict__.update(flags)

    def __call__(self, batch):
        depth = (self.radius - np.linalg.norm(batch.position - self.centre, axis=2)).max(axis=1)
        return 10.0 * np.maximum(depth, 0.0), depth < 0.0

    def explain(self, trajectory):
        t = np.linspace(trajectory.start_time, trajectory.end_time, 200)
        distance = np.linalg.norm(trajectory(t) - self.centre, axis=1).min()
        return [f"in the disc at {self.centre}"] if distance <= self.radius else []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": np.array([0.0, -0.7])}, r"start \(0, -0\.7\): position of joint 2: -0\.7 < -0\.6"),
        ({"goal": np.array([1.3, 0.0])}, r"goal \(1\.3, 0\): position of joint 1: 1\.3 > 1\.2"),
        ({"start": np.array([0.4, 0.1])}, r"start \(0\.4, 0\.1\): in collision"),
        ({"goal": np.array([0.5, 0.2])}, r"goal \(0\.5, 0\.2\): in collision"),
        ({"terms": (DiscTerm([0.0, 0.1], 0.2),)}, r"start \(0, 0\): in the disc at"),
        ({"terms": (DiscTerm([1.0, 0.1], 0.2),)}, r"goal \(1, 0\): in the disc at"),
        ({"terms": (DiscTerm([1.0, 0.1], 0.2).__call__,)}, r"goal \(1, 0\): in the disc at"),
        ({"terms": (DiscTerm([0.0, 0.1], 0.2, static=False),)}, "start"),
    ],
)
def test_ends_that_allow_no_valid_motion_are_refused(change, message):
    arguments = {"start": np.zeros(2), "goal": np.array([1.0, 0.0]), "collision": disc} | change
    with pytest.raises(InvalidInputError, match=message):
        JointSpaceProblem(OptimalBasis.uniform(3), PLANE, **arguments)
    problem = JointSpaceProblem(OptimalBasis.uniform(3), PLANE, **arguments, check_ends=False)
    points = problem.prior(spread=0.3).sample(np.random.default_rng(0), 20)
    assert not problem.evaluate(points).valid.any()


def test_a_moving_obstacle_may_be_at_the_goal_for_now():
    around_the_disc(terms=(DiscTerm([1.0, 0.1], 0.2, static=False),))


def test_ends_on_a_limit_are_fine_in_spite_of_round_off():
    problem = JointSpaceProblem(
        OptimalBasis.uniform(1), PLANE, np.array([-0.6, np.nextafter(1.2, 2)]), np.array([1.2, 0.0])
    )
    assert problem.evaluate(np.zeros((1, 1, 2)) + 0.1).valid.all()


def test_staying_where_one_is_takes_no_time():
    problem = JointSpaceProblem(OptimalBasis.uniform(3), PLANE, np.full(2, 0.4), np.full(2, 0.4))
    result = search(problem.prior(spread=0.3), problem.evaluate, VpstoConfig(), np.random.default_rng(0))
    assert result.valid and result.cost == pytest.approx(MINIMUM_DURATION, rel=1e-9)
    still = problem.trajectory(result.points)
    assert still.violations(PLANE) == []
    np.testing.assert_allclose(still(np.linspace(0, 1e-3, 9)), 0.4, rtol=1e-12)


def test_explain_says_why_a_candidate_is_invalid_and_only_then():
    problem = around_the_disc(terms=(DiscTerm([0.5, 0.5], 0.1),))
    points = problem.prior(spread=0.5).sample(np.random.default_rng(3), 200)
    valid = problem.evaluate(points).valid
    assert 10 < valid.sum() < 190
    reasons = [problem.explain(candidate) for candidate in points]
    assert [not lines for lines in reasons] == valid.tolist()
    text = "\n".join(line for lines in reasons for line in lines)
    assert "position of joint 2: " in text and "in the disc at [0.5 0.5]" in text
    assert re.search(r"in collision for 0\.\d+ s, first at \d\.\d+ s in \(", text)


def test_a_problem_without_a_solution_is_said_to_have_none_and_why():
    def wall(q):
        return np.abs(q[..., 0] - 0.5) < 0.3

    def in_time(batch):
        return batch.duration, batch.duration < 0.1

    problem = around_the_disc(collision=wall, terms=(in_time,))
    config = VpstoConfig(iterations=20, restarts=2)
    result = search(problem.prior(spread=0.3), problem.evaluate, config, np.random.default_rng(0))
    assert result.status == "no valid plan" and result.points is None and not result.valid
    *_, collided, late = problem.explain(result.best_any_points)
    assert collided.startswith("in collision for") and late.startswith("in_time is not satisfied (cost ")
    too_fast = around_the_disc(start_velocity=np.array([1.5, 0.0]))
    assert "boundary speed 1.5 of joint 1 is beyond its limit" in too_fast.explain(np.zeros((3, 2)))[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"basis": 3}, "basis must be an OptimalBasis"),
        ({"limits": 1.0}, "limits must be Limits"),
        ({"samples": 1}, "samples must be an integer from 2 on"),
        ({"samples": 50.0}, "samples must be an integer from 2 on"),
        ({"start": np.array([np.nan, 0.0])}, "start must be finite"),
        ({"start_velocity": [0.0]}, r"start_velocity must be finite with shape \(2,\)"),
        ({"terms": (3,)}, "must be functions"),
        ({"collision": np.zeros(3)}, "must be functions"),
        ({"collision": lambda q: q}, r"must return bool of shape \(1, 1\)"),
    ],
)
def test_problems_that_make_no_sense_are_refused(change, message):
    arguments = {"basis": OptimalBasis.uniform(1), "limits": PLANE, "start": np.zeros(2), "goal": np.ones(2)}
    with pytest.raises(InvalidInputError, match=message):
        JointSpaceProblem(**(arguments | change))


@pytest.mark.parametrize("options", [{"spread": 0.0}, {"spread": np.nan}, {"weights": np.zeros(2)}])
def test_priors_that_make_no_sense_are_refused(options):
    with pytest.raises(InvalidInputError, match="finite and positive"):
        around_the_disc().prior(**options)


def test_errors_name_what_is_wrong():
    with pytest.raises(InvalidInputError, match=r"goal must be finite with shape \(2,\)"):
        around_the_disc(goal=np.zeros(3))
    with pytest.raises(InvalidInputError, match=r"points of shape \(B, 3, 2\), got \(5, 2, 2\)"):
        around_the_disc().evaluate(np.zeros((5, 2, 2)))
    with pytest.raises(ConfigurationError, match=r"CostWeights\.collision = -1"):
        CostWeights(collision=-1.0)


def test_the_example_in_the_documentation_is_right():
    outcome = doctest.testmod(costs)
    assert outcome.attempted >= 10 and outcome.failed == 0
