"""Springs and dampers that act at the end of the control cycle: as others for short cycles, and stable."""

import numpy as np
import pytest

from sim_bridge.hockey.world import AirHockeyWorld, ArmGains
from sim_bridge.impedance import JointController
from vpsto_ros.planning.hockey.rules import PlayRules
from vpsto_ros.robot.iiwa import iiwa14

HOME, ROBOT, GAINS = np.array(PlayRules().home), iiwa14(), ArmGains()
UPRIGHT = HOME * (1, 0, 1, 1, 1, 1, 1)
"""Joint 2 at 0."""
ZERO = np.zeros(7)


def controller(period, implicit):
    return JointController(ROBOT, GAINS.stiffness, np.diag(GAINS.damping), period=period, implicit=implicit)


def acceleration(period, implicit, q, q_des, qd=ZERO, qd_des=ZERO, qdd_des=ZERO):
    """What the arm does under the torques of a cycle; small enough errors that no limit cuts them."""
    control = controller(period, implicit)
    torque = control.torque(q, qd, q_des, qd_des, qdd_des)
    assert control.saturated.sum() == 0
    return np.linalg.solve(ROBOT.mass_matrix(q), torque - ROBOT.inverse_dynamics(q, qd, ZERO))


def spectral_radius(period, implicit, q):
    """Of the map of errors from cycle to cycle, linear in small ones: v' = v + h a, e' = e + h v'."""
    columns, size = [], 1e-6
    for k in range(14):
        e, v = np.split(size * np.eye(14)[k], 2)
        # The gravity that the error changes is compensated, like everything else of the model.
        after = v + period * acceleration(period, implicit, q + e, q, v)
        columns.append(np.concatenate([e + period * after, after]) / size)
    return np.abs(np.linalg.eigvals(np.stack(columns, axis=1))).max()


@pytest.mark.parametrize("seed", range(1080, 1084))
def test_the_shorter_the_cycle_the_less_they_differ(seed):
    rng = np.random.default_rng(seed)
    q, q_des = HOME + 1e-3 * rng.standard_normal((2, 7))
    qd, qd_des, qdd_des = rng.standard_normal((3, 7)) * [[1e-2], [1e-2], [1.0]]
    differences = []
    for period in (1e-4, 1e-5, 1e-6):
        rows = [acceleration(period, implicit, q, q_des, qd, qd_des, qdd_des) for implicit in (True, False)]
        differences.append(np.abs(rows[0] - rows[1]).max() / np.abs(rows[1]).max())
    assert differences[2] < 1e-2
    # In proportion to the period, once it is short.
    assert differences[1] < 0.3 * differences[0] and differences[2] < 0.15 * differences[1]


def test_the_errors_at_the_end_of_the_cycle_are_what_springs_and_dampers_act_on():
    period, rng = 1e-3, np.random.default_rng(1084)
    e, v = 1e-3 * rng.standard_normal(7), 1e-2 * rng.standard_normal(7)
    a = acceleration(period, True, HOME + e, HOME, v)
    after = v + period * a
    force = -np.array(GAINS.stiffness) * (e + period * after) - np.array(GAINS.damping) * after
    np.testing.assert_allclose(ROBOT.mass_matrix(HOME + e) @ a, force, atol=1e-8)


@pytest.mark.parametrize("q", [HOME, UPRIGHT, UPRIGHT + [0, 0, 0.5, 0.3, -0.4, 0.3, 1.0]])
def test_without_errors_there_is_only_the_model(q):
    rng = np.random.default_rng(1085)
    qd, qdd = rng.standard_normal((2, 7))
    for implicit in (True, False):
        torque = controller(1e-3, implicit).torque(q, qd, q, qd, qdd)
        np.testing.assert_allclose(torque, ROBOT.inverse_dynamics(q, qd, qdd), atol=1e-9)


def test_stiff_dampers_shake_a_light_arm_unless_they_act_at_the_end_of_the_cycle():
    assert spectral_radius(1e-3, False, UPRIGHT) > 1.05
    assert spectral_radius(1e-3, True, UPRIGHT) < 1.0
    # It is the cycle that is too long: D h must stay below 2 M.
    assert spectral_radius(1e-5, False, UPRIGHT) < 1.0
    mass = np.linalg.eigvals(np.linalg.solve(ROBOT.mass_matrix(UPRIGHT), np.diag(GAINS.damping))).real.max()
    assert mass * 1e-3 > 2.0 > mass * 1e-5


@pytest.mark.parametrize("seed", range(1086, 1092))
def test_they_are_stable_in_any_posture_and_for_any_cycle(seed):
    lower, upper = ROBOT.position_range
    q = np.random.default_rng(seed).uniform(0.9 * lower, 0.9 * upper)
    for period in (1e-4, 1e-3, 1e-2):
        assert spectral_radius(period, True, q) < 1.0


def test_the_simulated_arm_stands_still_with_joint_2_at_0():
    world = AirHockeyWorld()
    world.reset(puck=(2.0, 0.0, 0.0), joints=UPRIGHT)
    world._qd[5] = 0.05  # a nudge
    world.advance(1.5)
    assert np.abs(world.joint_velocity).max() < 1e-3
    np.testing.assert_allclose(world.joint_position, UPRIGHT, atol=1e-3)
