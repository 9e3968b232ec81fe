"""Where the mallet is said to be: against Pinocchio at rest, against the simulated mallet in motion."""

import numpy as np
import pytest

from sim_bridge.hockey.world import AirHockeyWorld
from sim_bridge.trajectory_follower import TrajectoryCommand
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.robot.iiwa import JOINT_NAMES, iiwa14
from vpsto_ros.robot.mallet_observer import LONGEST_GAP, MalletObserver
from vpsto_ros.trajectory import OptimalBasis, synthesize


def swung():
    """Mallet states at 100 Hz while the arm swings sideways and back: true ones, and joints."""
    world = AirHockeyWorld()
    q = world.joint_position
    turn = np.array([0.5, 0.0, 0.6, 0.2, -0.6, 0.3, 0.0])
    keys = np.stack([q, q + turn, q - 0.5 * turn])
    motion = synthesize(OptimalBasis.uniform(1), keys, np.zeros(7), np.zeros(7), world.robot.limits)
    world.follower.accept(TrajectoryCommand.of(motion, JOINT_NAMES), world.time)
    rows = []
    while world.time < motion.duration + 0.3:
        state = world.mallet_state()
        mallet = np.concatenate([state.position[:2], state.velocity[:2]])
        joint = np.concatenate([state.joint_position[:2], state.joint_velocity[:2]])
        rows.append((world.time, world.joint_position, world.joint_velocity, mallet, joint))
        world.advance(0.01)
    return rows


def test_a_swinging_mallet_is_followed_four_times_better_than_one_that_hangs():
    observer, errors, without = MalletObserver(), [], []
    for stamp, q, qd, mallet, joint in swung():
        errors.append(observer.observe(stamp, q, qd) - mallet)
        without.append(joint - mallet)
    place, still = (np.linalg.norm(np.array(rows)[:, :2], axis=1) for rows in (errors, without))
    assert still.max() > 5e-3, "it swings"
    assert place.max() < 0.25 * still.max() and np.sqrt(np.mean(place**2)) < 1e-3


def test_at_rest_it_hangs_below_the_joint_of_pinocchios_arm():
    robot, rng = iiwa14(), np.random.default_rng(2)
    for _ in range(20):
        observer = MalletObserver()
        q, qd = rng.uniform(robot.limits.lower, robot.limits.upper), rng.standard_normal(7)
        found = observer.observe(0.0, q, qd)
        np.testing.assert_allclose(found[:2], robot.forward(q)[0][:2], atol=1e-9)
        np.testing.assert_allclose(found[2:], (robot.jacobian(q) @ qd)[:2], atol=1e-9)


def test_a_gap_hangs_it_up_and_an_old_measurement_changes_nothing():
    rows = swung()
    observer = MalletObserver()
    for stamp, q, qd, *_ in rows[:40]:
        before = observer.observe(stamp, q, qd)
    again = observer.observe(stamp - 0.005, q, qd)
    np.testing.assert_array_equal(again, before)
    fresh = MalletObserver().observe(0.0, q, qd)
    assert np.abs(before[:2] - fresh[:2]).max() > 1e-3
    np.testing.assert_array_equal(observer.observe(stamp + 1.01 * LONGEST_GAP, q, qd), fresh)


def test_a_clock_that_is_set_back_begins_anew():
    """The swing does not freeze until the clock is where it was."""
    rows, observer, fresh = swung(), MalletObserver(), MalletObserver()
    for stamp, q, qd, *_ in rows[:40]:
        observer.observe(stamp, q, qd)
    assert stamp > LONGEST_GAP + 0.2
    for stamp, q, qd, *_ in rows[10:40]:
        np.testing.assert_array_equal(observer.observe(stamp - 0.2, q, qd), fresh.observe(stamp - 0.2, q, qd))


def test_broken_joints_are_named():
    for q, qd in ((np.zeros(6), np.zeros(7)), (np.zeros(7), np.full(7, np.nan))):
        with pytest.raises(InvalidInputError, match="7 positions"):
            MalletObserver().observe(0.0, q, qd)
