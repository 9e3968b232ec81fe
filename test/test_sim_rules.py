"""The rules of air hockey: what is counted, and against what."""

import numpy as np
import pytest

from sim_bridge.hockey import table
from sim_bridge.hockey.rules import JOINT_SHARE, KINDS, LOWEST, NEAREST, WIDEST, RulesMonitor
from sim_bridge.hockey.scene import START_JOINTS
from sim_bridge.hockey.world import AirHockeyWorld
from sim_bridge.trajectory_follower import TrajectoryCommand
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.iiwa import JOINT_NAMES, iiwa14
from vpsto_ros.trajectory import Limits, OptimalBasis, synthesize

LIMITS = iiwa14().limits
LEGAL = {
    "joint": np.array([0.7, 0.1, table.UNIVERSAL_JOINT_HEIGHT]),
    "elbow": np.array([0.3, 0.0, 0.7]),
    "wrist": np.array([0.6, 0.0, 0.6]),
    "q": np.zeros(7),
    "qd": np.zeros(7),
}


def moved(name, index, value):
    changed = LEGAL[name].copy()
    changed[index] = value
    return {**LEGAL, name: changed}


@pytest.mark.parametrize(
    ("kind", "name", "index", "legal", "broken"),
    [
        ("near", "joint", 0, NEAREST + 1e-6, NEAREST - 1e-6),
        ("side", "joint", 1, -WIDEST + 1e-6, -WIDEST - 1e-6),
        ("height", "joint", 2, table.UNIVERSAL_JOINT_HEIGHT - 0.0199, table.UNIVERSAL_JOINT_HEIGHT - 0.0201),
        ("elbow", "elbow", 2, LOWEST + 1e-6, LOWEST - 1e-6),
        ("wrist", "wrist", 2, LOWEST + 1e-6, LOWEST - 1e-6),
        ("joint_position", "q", 1, -0.949 * LIMITS.upper[1], -0.951 * LIMITS.upper[1]),
        ("joint_velocity", "qd", 3, 0.949 * LIMITS.velocity[3], 0.951 * LIMITS.velocity[3]),
    ],
)
def test_each_rule_is_counted_beyond_its_bound_and_only_there(kind, name, index, legal, broken):
    monitor = RulesMonitor(LIMITS)
    monitor.observe(**moved(name, index, legal))
    assert monitor.report().violations == {}
    monitor.observe(**moved(name, index, broken))
    monitor.observe(**moved(name, index, broken))
    monitor.observe(**LEGAL)
    report = monitor.report()
    assert report.cycles == 4 and report.violations == {kind: 2}


def test_the_worst_values_are_those_nearest_to_breaking_a_rule():
    monitor, rng = RulesMonitor(LIMITS), np.random.default_rng(1)
    assert all(np.isnan(getattr(monitor.report(), kind).worst) for kind in KINDS)
    noise = [{name: 0.1 * rng.standard_normal(len(LEGAL[name])) for name in LEGAL} for _ in range(50)]
    seen = [{name: value + each[name] for name, value in LEGAL.items()} for each in noise]
    for each in seen:
        monitor.observe(**each)
    report = monitor.report()
    joint = np.array([each["joint"] for each in seen])
    assert report.near.worst == joint[:, 0].min()
    assert report.side.worst == np.abs(joint[:, 1]).max()
    assert report.height.worst == np.abs(joint[:, 2] - table.UNIVERSAL_JOINT_HEIGHT).max()
    assert report.elbow.worst == min(each["elbow"][2] for each in seen)
    assert report.wrist.worst == min(each["wrist"][2] for each in seen)
    q, qd = (np.array([each[name] for each in seen]) for name in ("q", "qd"))
    np.testing.assert_allclose(report.joint_position.worst, np.abs(q / LIMITS.upper).max())
    np.testing.assert_allclose(report.joint_velocity.worst, np.abs(qd / LIMITS.velocity).max())
    assert report.near.instants == np.count_nonzero(joint[:, 0] < NEAREST)
    assert JOINT_SHARE == 0.95


def test_limits_without_a_range_are_refused():
    with pytest.raises(InvalidInputError, match="position range"):
        RulesMonitor(Limits(np.ones(7), np.ones(7)))


def test_a_world_at_rest_keeps_all_rules_and_says_where_its_arm_is():
    world = AirHockeyWorld()
    world.advance(0.2)
    report = world.rules.report()
    assert report.cycles == 200 and report.violations == {}
    shoulder, upper, forearm = 0.36, 0.42, 0.40  # textbook geometry of the arm in its plane
    lean, bend = START_JOINTS[1], START_JOINTS[3]
    elbow = shoulder + upper * np.cos(lean)
    np.testing.assert_allclose(report.elbow.worst, elbow, atol=1e-3)
    np.testing.assert_allclose(report.wrist.worst, elbow + forearm * np.cos(lean - bend), atol=1e-3)
    assert report.near.worst == pytest.approx(0.65, abs=2e-3)


def test_a_motion_against_the_rules_is_seen_and_forgotten_by_a_reset():
    world = AirHockeyWorld()
    q, limits = world.joint_position, world.robot.limits
    keys = np.stack([q, q + np.array([0.0, 0.0, 0.0, -0.15, 0.0, 0.0, 0.0])])  # the elbow bends: up and back
    motion = synthesize(OptimalBasis.uniform(0), keys, np.zeros(7), np.zeros(7), limits, start_time=0.0)
    world.follower.accept(TrajectoryCommand.of(motion, JOINT_NAMES), world.time)
    world.advance(1.0)
    violations = world.rules.report().violations
    assert violations["height"] > 0 and violations["near"] > 0 and "elbow" not in violations
    world.reset()
    assert world.rules.report().cycles == 0
    world.advance(0.05)
    assert world.rules.report().violations == {}
