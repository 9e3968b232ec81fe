"""Robust pushing in closed loop: which motion a step gives, and when it stops, holds or lets go."""

import dataclasses

import numpy as np
import pytest

from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.planning.belief_space.config import RobustMpcConfig
from vpsto_ros.planning.belief_space.contacts import ContactRule
from vpsto_ros.planning.belief_space.mpc import PlannedContact, RobustPushingMpc, StampedBelief
from vpsto_ros.planning.belief_space.targets import GoalTarget
from vpsto_ros.robot.bimanual_plane import BimanualPlane
from vpsto_ros.robot.hand_plane import HandPlane
from vpsto_ros.robot.kinematics import fr3_bimanual, fr3_hand_pusher

OBJECT, EFFECTORS = PlanarShape.disc(0.05), EndEffectors.discs(0.03, 2)
ARMS = BimanualPlane(fr3_bimanual(), 0.035)
START = np.array([0.36, 0.12, 0.36, -0.12])
PLACE, GOAL = np.array([0.48, 0.0, 0.0]), GoalTarget(np.array([0.55, 0.03]))
PERIOD = 0.05
HAND, HAND_EFFECTORS = HandPlane(fr3_hand_pusher(), 0.05), EndEffectors.rectangle(0.2, 0.06)


def planner(effectors=EFFECTORS, **options):
    config = RobustMpcConfig(**options)
    two = effectors.dof == 4
    rule = ContactRule.of(config.planning, effectors, OBJECT, two_arms=two)
    dynamics = BeliefDynamics(OBJECT, effectors, step_variance=1e-6)
    tools = ARMS if two or effectors.dof == 2 else HAND
    return RobustPushingMpc(config, dynamics, tools, rule, np.random.default_rng(0))


class Loop:
    """Arms that follow their reference exactly, or `offset` (4,) away from it."""

    def __init__(self, mpc):
        self.mpc, self.now, self.target, self.std, self.contact = mpc, 0.0, GOAL, 0.002, None
        self.place, self.offset, self.belief_age = PLACE.copy(), np.zeros(mpc.tools.dof), 0.0
        self.start = START if mpc.tools is ARMS else np.array([0.36, 0.0, 0.5 * np.pi])

    @property
    def joints(self):
        reference = self.mpc.reference
        if reference is None:
            return self.mpc.tools.joints(self.start[None])[0]
        q = reference(np.clip(self.now, reference.start_time, reference.end_time))
        tools = self.mpc.tools
        return tools.joints((tools.tool(q) + self.offset)[None])[0] if self.offset.any() else q

    def step(self):
        belief = ObjectBelief.gaussian(self.place, self.std, 50, np.random.default_rng(1))
        stamped = StampedBelief(self.now - self.belief_age, belief)
        step = self.mpc.step(self.now, self.joints, 0.0 * self.joints, stamped, self.target, self.contact)
        self.mpc.accept(step)
        self.now += PERIOD
        return step

    def take_over(self):
        step = self.step()
        assert step.mode == "wait" and "took over" in step.message
        while step.mode == "wait":
            step = self.step()
        return step


@pytest.fixture
def loop():
    return Loop(planner())


def within_limits(trajectory):
    return trajectory.violations(ARMS.robot.limits) == [] and trajectory.jumps()[0].max() < 1e-6


def test_a_step_pushes_within_limits_and_goes_on_from_the_last_one(loop):
    step = loop.take_over()
    assert step.mode == "robust" and step.valid and len(step.spread) > 10 and step.warning == ""
    for _ in range(20):
        before = loop.mpc.reference
        step = loop.step()
        assert step.valid and within_limits(step.trajectory)
        now = loop.now - PERIOD
        np.testing.assert_allclose(step.trajectory(now), before(now), atol=1e-6)
    assert np.linalg.norm(ARMS.tool(step.trajectory(step.trajectory.end_time)) - START) > 0.05


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"target": None}, "no goal"), ({"belief_age": 0.6}, "0.60 s old"), ({"std": 0.08}, "lost"),
        ({"place": np.array([0.9, 0.0, 0.0])}, "outside the workspace"),
    ],
)  # fmt: skip
def test_what_cannot_be_pushed_makes_the_arms_brake(loop, change, message):
    loop.take_over()
    for _ in range(8):
        loop.step()
    for name, value in change.items():
        setattr(loop, name, value)
    step = loop.step()
    assert step.mode == "brake" and not step.valid and message in step.message
    assert within_limits(step.trajectory)
    np.testing.assert_allclose(step.trajectory(step.trajectory.end_time, 1), 0.0, atol=1e-9)


def test_a_narrow_belief_at_the_goal_is_held_and_a_wide_one_is_not(loop):
    loop.place = np.array([*GOAL.position, 0.0])
    loop.take_over()
    assert loop.step().mode == "hold"
    loop.std = 0.04
    assert loop.step().mode != "hold"


def test_tools_that_are_held_off_their_reference_let_go():
    """The reference comes to the tools instead of pressing on, and pushing goes on from there."""
    loop = Loop(planner(largest_offset=0.01))
    loop.take_over()
    for _ in range(10):
        assert loop.step().valid
    loop.offset = np.array([0.008, 0.0, 0.0, 0.0])
    assert loop.step().mode == "robust", "a lag of millimetres is normal"
    loop.offset = np.array([-0.014, 0.0, 0.0, 0.009])
    held = ARMS.tool(loop.joints)
    step = loop.step()
    assert step.mode == "brake" and "14 mm off their reference; letting go" in step.message
    assert within_limits(step.trajectory)
    end = ARMS.tool(step.trajectory(step.trajectory.end_time))
    np.testing.assert_allclose(end, held, atol=1e-4)
    loop.now, loop.offset = step.trajectory.end_time, np.zeros(4)
    assert loop.step().mode == "robust"


def test_arms_far_from_their_reference_stop_first(loop):
    loop.take_over()
    for _ in range(10):
        loop.step()
    loop.offset = np.array([0.06, 0.0, 0.06, 0.0])
    step = loop.step()
    assert step.mode == "brake" and "do not follow" in step.message


def test_end_effectors_must_be_those_of_the_robot():
    with pytest.raises(ConfigurationError, match="2 plane coordinates"):
        planner(EndEffectors.discs(0.03, 1))


def test_the_deterministic_controller_says_so():
    options = dataclasses.replace(RobustMpcConfig().planning, robust=False)
    assert Loop(planner(planning=options)).take_over().mode == "deterministic"


@pytest.mark.parametrize("change", [{"target": None}, {"belief_age": 0.6}, {"std": 0.08}])
def test_tools_let_go_whether_there_is_something_to_push_or_not(loop, change):
    loop.take_over()
    for _ in range(10):
        loop.step()
    for name, value in change.items():
        setattr(loop, name, value)
    loop.offset = np.array([-0.014, 0.0, 0.0, 0.009])
    assert "letting go" in loop.step().message


def test_a_hand_that_is_turned_off_its_reference_is_not_taken_for_squeezing():
    loop = Loop(planner(HAND_EFFECTORS))
    loop.take_over()
    loop.offset = np.array([0.0, 0.0, 0.03])
    assert "letting go" not in loop.step().message
    loop.offset = np.array([0.012, 0.0, 0.0])
    assert "12 mm off their reference; letting go" in loop.step().message


def test_a_planned_contact_moves_along_with_the_object(loop, monkeypatch):
    """What was planned for an object that has moved by 3 cm since is meant 3 cm farther."""
    loop.take_over()
    used, horizon = [], loop.mpc.pusher.horizon
    monkeypatch.setattr(
        loop.mpc.pusher, "horizon", lambda *a, **k: (used.append(k["contact"]), horizon(*a, **k))[1]
    )
    mean, covariance = START + 0.05, 1e-4 * np.eye(4)
    loop.contact = PlannedContact(mean, covariance, PLACE[:2] - [0.03, -0.01])
    loop.step()
    np.testing.assert_allclose(used[0][0] - mean, [0.03, -0.01, 0.03, -0.01], atol=2e-3)
    np.testing.assert_array_equal(used[0][1], covariance)


def test_no_progress_is_said(loop):
    """An object that never moves: the planner means to push, and says that it does not work."""
    loop.mpc.config = dataclasses.replace(loop.mpc.config, patience=1.0)
    loop.place = np.array([0.60, 0.0, 0.0])  # out of the tools' way for as long as this takes
    loop.take_over()
    loop.target = GoalTarget(np.array([0.63, 0.06]))
    for _ in range(19):
        assert loop.step().warning == ""
    for _ in range(4):
        step = loop.step()
    assert step.valid and "no nearer to its goal for 1 s" in step.warning
    loop.place = loop.place - [0.06, 0.0, 0.0]
    assert loop.step().warning == "", "somebody has moved it: the time begins anew"


def test_a_workspace_that_no_tool_gets_behind_is_refused_by_name():
    with pytest.raises(ConfigurationError, match=r"workspace_x = \(1.0, 1.1\), .*arms reach"):
        planner(workspace_x=(1.0, 1.1)).warm_up()


def test_a_wide_workspace_is_warmed_up_where_the_arms_reach():
    mpc = planner(workspace_x=(-0.5, 0.5), workspace_y=(-0.5, 0.5))
    mpc.warm_up()
    pose, tools = mpc._reachable_push()
    assert mpc.config.contains(pose) and ARMS.contains(tools)


def test_searched_motions_stay_within_reach_by_a_margin():
    mpc = planner()
    way = np.linspace(0.55, 0.95, 4001)
    points = np.column_stack([way, np.full_like(way, 0.2), way, np.full_like(way, -0.2)])
    strict, loose = way[mpc.pusher.reach(points)].max(), way[ARMS.contains(points)].max()
    assert 0.002 < loose - strict < 0.006


def test_a_reference_that_would_jump_is_not_followed(loop, monkeypatch):
    """Tools that a stop has tilted by more than a hair do not step back to upright."""
    loop.take_over()
    monkeypatch.setattr(loop.mpc, "_lost", lambda now, q: False)
    running = loop.mpc.reference
    tilted = running.coefficients.copy()
    tilted[:, 0, 5] += 0.02
    loop.mpc.reference = type(running)(running.times, tilted)
    step = loop.step()
    assert step.mode == "brake" and "off the posture" in step.message
