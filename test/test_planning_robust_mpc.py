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
from vpsto_ros.planning.belief_space.contacts import ContactRule, CrossingRule
from vpsto_ros.planning.belief_space.mpc import RobustPushingMpc, StampedBelief
from vpsto_ros.planning.belief_space.targets import GoalTarget
from vpsto_ros.robot.bimanual_plane import BimanualPlane
from vpsto_ros.robot.kinematics import fr3_bimanual

OBJECT, EFFECTORS = PlanarShape.disc(0.05), EndEffectors.discs(0.03, 2)
ARMS = BimanualPlane(fr3_bimanual(), 0.035)
START = np.array([0.36, 0.12, 0.36, -0.12])
PLACE, GOAL = np.array([0.48, 0.0, 0.0]), GoalTarget(np.array([0.55, 0.03]))
PERIOD = 0.05


def planner(effectors=EFFECTORS, **options):
    config = RobustMpcConfig(**options)
    rule = ContactRule(
        effectors, OBJECT, config.planning.contact_angle, config.planning.contact_advance, CrossingRule()
    )
    dynamics = BeliefDynamics(OBJECT, effectors, step_variance=1e-6)
    return RobustPushingMpc(config, dynamics, ARMS, rule, np.random.default_rng(0))


class Loop:
    """Arms that follow their reference exactly, or `offset` (4,) away from it."""

    def __init__(self, mpc):
        self.mpc, self.now, self.target, self.std = mpc, 0.0, GOAL, 0.002
        self.place, self.offset, self.belief_age = PLACE.copy(), np.zeros(4), 0.0

    @property
    def joints(self):
        reference = self.mpc.reference
        if reference is None:
            return ARMS.joints(START[None])[0]
        q = reference(np.clip(self.now, reference.start_time, reference.end_time))
        return ARMS.joints((ARMS.tool(q) + self.offset)[None])[0] if self.offset.any() else q

    def step(self):
        belief = ObjectBelief.gaussian(self.place, self.std, 50, np.random.default_rng(1))
        stamped = StampedBelief(self.now - self.belief_age, belief)
        step = self.mpc.step(self.now, self.joints, np.zeros(14), stamped, self.target)
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
    assert step.mode == "robust" and step.valid and step.spread is not None
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
