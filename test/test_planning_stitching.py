"""Motions joined and cut: what is left of one is that motion, and at rest nothing moves."""

import dataclasses

import numpy as np
import pytest

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.planning.joint_space_problem import JointSpaceMpcConfig, OnlineJointSpaceProblem
from vpsto_ros.planning.stitching import as_batch, extended, remainder, resting
from vpsto_ros.trajectory import Limits, OptimalBasis, Trajectory, synthesize, synthesize_batch

LIMITS = Limits(np.array([0.5, 0.4, 0.6]), np.array([2.0, 1.5, 2.5]))


def test_a_quintic_cannot_be_measured_as_a_batch():
    bent = Trajectory.from_points(
        np.array([0.0, 1.0]), np.zeros((2, 1)), np.ones((2, 1)), np.array([[3.0], [0.0]])
    )
    with pytest.raises(InvalidInputError, match="cubic"):
        as_batch(bent, 10)


def test_the_remainder_of_a_motion_is_that_motion():
    trajectory = synthesize(
        OptimalBasis.uniform(2), np.random.default_rng(1).uniform(-1, 1, (4, 3)), np.zeros(3), np.zeros(3),
        LIMITS, start_time=1.0,
    )  # fmt: skip
    for start in (1.0, 1.0 + 1e-12, 1.7, trajectory.end_time - 1e-6, trajectory.end_time, 99.0):
        rest = remainder(trajectory, start)
        times = np.linspace(rest.start_time, rest.end_time, 50)
        np.testing.assert_allclose(rest(times), trajectory(times), atol=1e-12)
        np.testing.assert_allclose(rest(times, 1), trajectory(times, 1), atol=1e-9)
        assert rest.start_time == pytest.approx(start, abs=1e-9)


def test_an_extended_motion_rests_at_its_end():
    keys = np.random.default_rng(2).uniform(-1, 1, (3, 3))
    trajectory = synthesize(OptimalBasis.uniform(1), keys, np.zeros(3), np.zeros(3), LIMITS, start_time=1.0)
    longer = extended(trajectory, trajectory.end_time + 2.0)
    assert longer.end_time == pytest.approx(trajectory.end_time + 2.0)
    times = np.linspace(1.0, trajectory.end_time, 50)
    np.testing.assert_allclose(longer(times), trajectory(times), atol=1e-12)
    after = np.linspace(trajectory.end_time, longer.end_time, 20)
    np.testing.assert_allclose(longer(after), np.broadcast_to(keys[-1], (20, 3)), atol=1e-12)
    np.testing.assert_allclose(longer(after[1:], 1), 0.0, atol=1e-12)
    assert extended(trajectory, trajectory.end_time) is trajectory
    still = resting(keys[0], 2.0, 3.5)
    assert (still.start_time, still.end_time) == (2.0, 3.5)
    assert not still(np.linspace(2.0, 3.5, 9), 1).any()


def test_a_running_motion_is_measured_like_a_candidate():
    def slow(batch):
        """Some constraint on the derivatives too."""
        excess = np.maximum(np.abs(batch.velocity).max(axis=(1, 2)) - 0.4, 0.0)
        return excess, excess == 0.0

    basis, keys = OptimalBasis.uniform(3), np.random.default_rng(0).uniform(-0.5, 0.5, (5, 3))
    velocity = np.array([0.2, -0.1, 0.3])
    trajectory = synthesize(basis, keys, velocity, np.zeros(3), LIMITS, start_time=3.0)
    one, other = as_batch(trajectory, 40), synthesize_batch(basis, keys, velocity, np.zeros(3), LIMITS, 40)
    for field in dataclasses.fields(one):
        expected = getattr(other, field.name)
        np.testing.assert_allclose(getattr(one, field.name), expected, atol=1e-9, err_msg=field.name)
    problem = OnlineJointSpaceProblem(
        LIMITS, position=keys[0], velocity=velocity, start_time=3.0, goal=keys[-1], terms=(slow,),
        config=JointSpaceMpcConfig(samples=60),
    )  # fmt: skip
    evaluation = problem.evaluate(keys[None, 1:-1])
    cost, valid = problem.assess(trajectory)
    assert cost == pytest.approx(evaluation.cost[0], rel=1e-9) and valid == evaluation.valid[0]
