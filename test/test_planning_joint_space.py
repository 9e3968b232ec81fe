"""Online VP-STO in joint space: what must hold whatever the search finds, with balls as obstacles."""

import dataclasses
import math

import numpy as np
import pytest

from vpsto_ros.collision.planar import PlanarWorld
from vpsto_ros.collision.planar_discs import DiscMargin, MovingDisc
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError, VpstoError
from vpsto_ros.optimization.costs import CostWeights
from vpsto_ros.optimization.vpsto import VpstoConfig
from vpsto_ros.planning.joint_space import JointSpaceMpc
from vpsto_ros.planning.joint_space_problem import JointSpaceMpcConfig
from vpsto_ros.planning.mpc import OnlineConfig
from vpsto_ros.planning.stitching import extended, remainder
from vpsto_ros.trajectory import Limits

PERIOD = 0.1
LIMITS = Limits(
    np.array([0.5, 0.4, 0.6]), np.array([2.0, 1.5, 2.5]), np.full(3, -2.0), np.full(3, 2.0)
)
START, GOAL = np.array([0.0, 0.1, 0.0]), np.array([1.0, 0.0, 0.1])


@dataclasses.dataclass
class Ball:
    """Out of which a trajectory has to stay; the clock starts with the trajectory."""

    centre: np.ndarray
    radius: float
    velocity: np.ndarray | float = 0.0

    def __call__(self, batch):
        duration = np.where(np.isfinite(batch.duration), batch.duration, 0.0)
        times = duration[:, None] * np.linspace(0.0, 1.0, batch.position.shape[1])
        way = batch.position - self.centre - times[..., None] * np.asarray(self.velocity)
        inside = (np.linalg.norm(way, axis=2) < self.radius).mean(axis=1)
        return 100.0 * inside, inside == 0.0

    def at(self, time):
        return dataclasses.replace(self, centre=self.centre + time * np.asarray(self.velocity))


def reject(batch):
    """Nothing is good enough."""
    return np.full(len(batch.duration), 50.0), np.zeros(len(batch.duration), dtype=bool)


IN_THE_WAY = Ball(np.array([0.5, 0.05, 0.05]), 0.2)


def config(**options):
    online = OnlineConfig(
        n_via=4, via_rate=1.5, stop_duration=0.6, search=VpstoConfig(population=24, iterations=6)
    )
    return JointSpaceMpcConfig(**{"online": online, "spread": 0.2, "samples": 60, **options})


def planner(seed=0, start=START, velocity=None, limits=LIMITS, **options):
    mpc = JointSpaceMpc(limits, config(**options), np.random.default_rng(seed))
    mpc.begin(start, 0.0, velocity)
    return mpc


def drive(mpc, terms, *, goal=GOAL, steps=100, until_hold=True):
    """Executed motion and plans; `terms` maps the time of the takeover to obstacles."""
    motion, plans = None, []
    for k in range(steps):
        now, takeover = k * PERIOD, (k + 1) * PERIOD
        piece = extended(remainder(mpc.reference, now), takeover)
        piece = piece.clipped(piece.start_time, takeover)
        motion = piece if motion is None else motion.followed_by(piece)
        plans.append(mpc.step(takeover, goal, terms(takeover)))
        mpc.accept(plans[-1])
        if until_hold and plans[-1].mode == "hold":
            break
    return motion, plans


@pytest.mark.parametrize("seed", range(4))
def test_the_whole_executed_motion_keeps_limits_and_reaches_the_goal(seed):
    motion, plans = drive(planner(seed), lambda t: (IN_THE_WAY,))
    assert plans[-1].mode == "hold"
    np.testing.assert_allclose(motion(motion.end_time), GOAL, atol=1e-9)
    assert motion.violations(LIMITS) == []
    assert max(step.max() for step in motion.jumps()) < 1e-9
    path = motion(np.linspace(0.0, motion.end_time, 2000))
    assert np.linalg.norm(path - IN_THE_WAY.centre, axis=1).min() > 0.2 - 1e-3
    assert np.abs(motion.extrema(1)[1]).max() > 0.3, "it does move"
    modes = [plan.searched for plan in plans]
    assert modes[0] == "explore" and "warm_start" in modes and "stop" in modes


@pytest.mark.parametrize("seed", range(3))
def test_every_plan_ends_at_rest_and_starts_where_the_present_motion_is(seed):
    mpc = planner(seed)
    ball = Ball(np.array([0.6, -1.0, 0.0]), 0.25, np.array([0.0, 0.4, 0.0]))
    for k in range(1, 40):
        takeover = k * PERIOD
        before = mpc.reference.state(takeover)
        plan = mpc.step(takeover, GOAL, (ball.at(takeover),))
        assert np.abs(plan.trajectory(plan.trajectory.end_time, 1)).max() < 1e-12
        np.testing.assert_allclose(plan.trajectory(takeover), before[0], atol=1e-12)
        np.testing.assert_allclose(plan.trajectory(takeover, 1), before[1], atol=1e-12)
        assert plan.trajectory.start_time == pytest.approx(takeover, abs=1e-9)
        mpc.accept(plan)


def test_a_plan_never_gets_worse_in_a_world_at_rest():
    mpc = planner(1, weights=CostWeights(smoothness=0.0))
    _, plans = drive(mpc, lambda t: (IN_THE_WAY,))
    arrivals = [plan.trajectory.end_time for plan in plans if plan.valid and plan.mode != "hold"]
    assert len(arrivals) > 15
    assert np.diff(arrivals).max() <= 1e-9 and arrivals[0] - arrivals[-1] > 0.01


def test_the_number_of_via_points_follows_what_is_left():
    mpc = planner(2)
    seen = []
    for k in range(1, 25):
        takeover = k * PERIOD
        left = mpc.reference.end_time - takeover
        plan = mpc.step(takeover, GOAL, (IN_THE_WAY,))
        if plan.search is not None and plan.search.best_any_points is not None:
            expected = 4 if plan.searched == "explore" else max(1, min(math.ceil(1.5 * left), 4))
            assert len(plan.search.best_any_points) == expected
            seen.append(expected)
        mpc.accept(plan)
    assert seen[0] == 4 and min(seen) < 3, "it falls towards the end"


def test_the_present_plan_is_kept_when_the_search_finds_nothing():
    mpc = planner()
    mpc.accept(mpc.step(PERIOD, GOAL, (IN_THE_WAY,)))
    present = mpc.reference
    plan = mpc.step(5 * PERIOD, GOAL, (reject,), tolerated=(IN_THE_WAY,))
    assert plan.mode == "keep" and plan.valid and plan.searched == "warm_start"
    assert plan.search.status == "no valid plan"
    times = np.linspace(5 * PERIOD, present.end_time, 200)
    np.testing.assert_allclose(plan.trajectory(times), present(times), atol=1e-12)


def test_after_a_step_without_a_plan_the_next_one_explores():
    mpc = planner()
    mpc.accept(mpc.step(PERIOD, GOAL, (reject,)))
    plan = mpc.step(2 * PERIOD, GOAL, (IN_THE_WAY,))
    assert plan.searched == "explore" and mpc.explain(plan) == []


def test_brakes_before_a_wall_that_appears():
    def wall(batch):
        share = (batch.position[..., 0] > 0.45).mean(axis=1)
        return 100.0 * share, share == 0.0

    mpc = planner()
    _, plans = drive(mpc, lambda t: (), steps=8)
    assert plans[-1].valid and mpc.reference(0.8, 1)[0] > 0.3
    motion, plans = [], []
    for k in range(8, 16):
        plans.append(mpc.step((k + 1) * PERIOD, GOAL, (wall,)))
        mpc.accept(plans[-1])
        motion.append(plans[-1].trajectory)
    assert "brake" in {plan.mode for plan in plans} and not any(plan.valid for plan in plans)
    assert mpc.reference.end_time < 2.0 and mpc.reference(3.0)[0] <= 0.45
    assert all(not plan.trajectory.violations(LIMITS) for plan in plans)


def test_gets_out_of_the_way_of_a_ball_that_comes_to_a_standing_robot():
    ball = Ball(np.array([0.0, 1.0, 0.0]), 0.15, np.array([0.0, -0.2, 0.0]))

    def closed(batch):
        share = (batch.position[..., 0] > 0.3).mean(axis=1)
        return 100.0 * share, share == 0.0

    motion, plans = drive(planner(3), lambda t: (ball.at(t), closed), steps=70, until_hold=False)
    modes = {plan.mode for plan in plans}
    assert "escape" in modes and not any(plan.valid for plan in plans)
    times = np.linspace(0.0, motion.end_time, 3000)
    way = motion(times) - ball.centre - times[:, None] * ball.velocity
    assert np.linalg.norm(way, axis=1).min() > 0.15 - 2e-3
    assert np.linalg.norm(START - ball.at(4.5).centre) < 0.01, "it would have been hit"
    assert motion.violations(LIMITS) == []


def test_an_unreachable_goal_is_reported_and_the_robot_stays():
    shell, mpc = Ball(GOAL, 0.3), planner()
    motion, plans = drive(mpc, lambda t: (shell,), steps=6)
    (reason,) = mpc.explain(plans[-1])
    assert "Ball is not satisfied" in reason
    assert all(plan.mode == "follow" and not plan.valid and plan.cost == math.inf for plan in plans)
    assert all(plan.search.status == "no valid plan" for plan in plans)
    np.testing.assert_allclose(motion.extrema(0), np.stack([START, START]), atol=1e-12)


def test_a_start_in_collision_is_no_error_in_a_control_loop():
    class Explained(Ball):
        """An obstacle that says what is wrong, as the library's do."""

        def explain(self, trajectory):
            return ["inside the ball"]

    mpc = planner()
    plan = mpc.step(PERIOD, GOAL, (Explained(START, 0.05),))
    assert not plan.valid and mpc.explain(plan) == ["inside the ball"]
    away = plan.trajectory(plan.trajectory.end_time) - START
    assert plan.mode != "escape" or np.linalg.norm(away) > 0.05


def test_where_nothing_is_clear_the_least_bad_motion_still_keeps_the_limits():
    everywhere = Ball(np.zeros(3), 5.0)
    mpc = planner()
    drive(mpc, lambda t: (), steps=6)
    plan = mpc.step(7 * PERIOD, GOAL, (everywhere,))
    assert not plan.valid and plan.trajectory.violations(LIMITS) == []
    assert np.abs(plan.trajectory(plan.trajectory.end_time, 1)).max() < 1e-12


def test_a_new_goal_is_planned_for_from_the_running_motion():
    mpc = planner()
    drive(mpc, lambda t: (IN_THE_WAY,), steps=8)
    other = np.array([0.8, 0.6, -0.2])
    plan = mpc.step(9 * PERIOD, other, (IN_THE_WAY,))
    assert plan.valid and plan.mode != "keep"
    np.testing.assert_allclose(plan.trajectory(plan.trajectory.end_time), other, atol=1e-12)


def test_a_robot_at_its_goal_holds_until_something_comes():
    mpc = planner(start=GOAL)
    plan = mpc.step(PERIOD, GOAL)
    assert plan.mode == "hold" and plan.valid
    mpc.accept(plan)
    ball = Ball(GOAL - [0.0, 0.4, 0.0], 0.15, np.array([0.0, 0.2, 0.0]))
    assert mpc.step(2 * PERIOD, GOAL, (ball,)).mode in ("escape", "explore", "warm_start", "stop")


@pytest.mark.parametrize("goal_in", ["polygon", "still ball"])
def test_a_goal_inside_what_does_not_move_is_refused(goal_in):
    still = Ball(GOAL, 0.2)
    still.static = True
    limits = Limits(LIMITS.velocity[:2], LIMITS.acceleration[:2])
    square = np.array([[0.8, -0.2], [1.2, -0.2], [1.2, 0.2], [0.8, 0.2]])
    wall = PlanarWorld(np.full(2, -5.0), np.full(2, 5.0), (square,), names=("the square",)).term()
    if goal_in == "polygon":
        mpc, goal, term = planner(start=START[:2], limits=limits), GOAL[:2], wall
    else:
        mpc, goal, term = planner(), GOAL, still
    before = mpc.reference
    with pytest.raises(InvalidInputError, match=r"the goal \(1, 0.*\): in collision"):
        mpc.step(PERIOD, goal, (term,))
    assert mpc.reference is before
    beside = goal - np.eye(len(goal))[0] * 0.4
    assert mpc.step(PERIOD, beside, (term,)).valid
    still.static = False  # it may be gone by then
    assert goal_in == "polygon" or not mpc.step(PERIOD, goal, (term,)).valid


def test_a_goal_that_a_moving_disc_covers_is_not_refused():
    disc = MovingDisc(GOAL[:2], 0.2, (0.1, 0.0))
    world = PlanarWorld(np.full(2, -5.0), np.full(2, 5.0), discs=(disc,))
    for term in (world.term(), DiscMargin((disc,), 0.1, 0.0, 0.3)):
        mpc = planner(start=START[:2], limits=Limits(LIMITS.velocity[:2], LIMITS.acceleration[:2]))
        assert mpc.step(PERIOD, GOAL[:2], (term,)).mode


@pytest.mark.parametrize(
    ("takeover", "message"),
    [(0.9, "the present motion begins, at 1 s"), (np.nan, "finite"), (np.inf, "finite"), ("ab", "finite")],
)
def test_bad_takeovers_are_refused(takeover, message):
    mpc = JointSpaceMpc(LIMITS, config(), np.random.default_rng(0))
    mpc.begin(START, 1.0)
    with pytest.raises(InvalidInputError, match=message):
        mpc.step(takeover, GOAL)
    assert mpc.step(1.0, GOAL).valid


def test_takes_over_a_moving_robot_by_braking():
    velocity = np.array([0.7, -0.2, 0.0])  # joint 1 is beyond its limit
    mpc = planner(velocity=velocity)
    np.testing.assert_allclose(mpc.reference(0.0, 1), velocity)
    speed = np.abs(mpc.reference(np.linspace(0.0, mpc.reference.end_time, 100), 1))
    assert (np.diff(speed, axis=0) <= 1e-12).all() and (speed[-1] < 1e-12).all(), "it only gets slower"
    plan = mpc.step(0.05, GOAL)
    assert plan.mode == "follow" and not plan.valid
    mpc.accept(plan)
    assert mpc.step(0.3, GOAL).valid


def test_the_same_seed_gives_the_same_motion():
    one, _ = drive(planner(5), lambda t: (IN_THE_WAY,), steps=10)
    two, _ = drive(planner(5), lambda t: (IN_THE_WAY,), steps=10)
    np.testing.assert_array_equal(one.coefficients, two.coefficients)


@pytest.mark.parametrize("dof", [1, 7])
def test_any_number_of_joints(dof):
    limits = Limits(np.full(dof, 1.0), np.full(dof, 4.0))
    mpc = planner(start=np.zeros(dof), limits=limits)
    ball = Ball(np.full(dof, 5.0), 0.1)
    motion, plans = drive(mpc, lambda t: (ball,), goal=np.linspace(0.3, 0.6, dof))
    assert plans[-1].mode == "hold" and motion.violations(limits) == []


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (np.zeros(2), r"shape \(3,\)"),
        ("ab", r"shape \(3,\)"),
        (None, r"shape \(3,\)"),
        (np.array([0.0, np.nan, 0.0]), "finite"),
        (np.array([0.0, 0.0, 2.5]), "joint 3 is above its limit 2"),
        (np.array([0.0, -2.1, 0.0]), "joint 2 is below its limit -2"),
    ],
)
def test_bad_goals_are_refused(goal, message):
    with pytest.raises(InvalidInputError, match=message):
        planner().step(PERIOD, goal)


def test_a_planner_must_be_told_where_the_robot_is():
    mpc = JointSpaceMpc(LIMITS, config(), np.random.default_rng(0))
    with pytest.raises(VpstoError, match="begin"):
        mpc.step(PERIOD, GOAL)
    with pytest.raises(InvalidInputError):
        mpc.begin(np.zeros(2), 0.0)
    with pytest.raises(InvalidInputError):
        mpc.begin(np.zeros(3), 0.0, np.full(3, np.inf))
    for arguments in (("abc", 0.0), (np.zeros(3), 0.0, "abc"), (np.zeros(3), np.nan), (np.zeros(3), None)):
        with pytest.raises(InvalidInputError):
            mpc.begin(*arguments)


@pytest.mark.parametrize("options", [{"samples": 1}, {"spread": 0.0}, {"lookahead": -1.0}, {"escapes": 0}])
def test_options_are_checked(options):
    with pytest.raises(ConfigurationError, match=next(iter(options))):
        JointSpaceMpcConfig(**options)
