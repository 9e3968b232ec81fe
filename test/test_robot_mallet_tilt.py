"""How the mallet swings on its joint, against Pinocchio, SciPy's integrator and the laws of a pendulum."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.planning.hockey.rules import PlayRules
from vpsto_ros.robot.iiwa import iiwa14
from vpsto_ros.robot.mallet_tilt import MalletTilt
from vpsto_ros.trajectory import Trajectory

HOME = np.array(PlayRules().home)
ROBOT, TILT = iiwa14(), MalletTilt()


def motion(seed, scale=0.3, duration=0.5):
    """A cubic that begins and ends in motion."""
    rng = np.random.default_rng(seed)
    ends = HOME + scale * rng.standard_normal((2, 7))
    return Trajectory.from_points([1.0, 1.0 + duration], ends, rng.standard_normal((2, 7)))


def swing(trajectory, t, state, tilt):
    """I tau'' = -k tau - d (tau' - r) - m c a, with r and a of Pinocchio and of differences."""
    q, qd = trajectory(t), trajectory(t, 1)
    turning = ROBOT.jacobian(q)[3:] @ qd
    lower_end = np.cross(turning, [0.0, 0.0, -1.0])[:2]
    # Ahead and back along the Taylor polynomial, so that ends of the motion are no ends of the difference.
    h, qdd = 1e-4, trajectory(t, 2)
    places = [ROBOT.forward(q + s * qd + 0.5 * s * s * qdd)[0] for s in (-h, 0.0, h)]
    a = (places[0] - 2.0 * places[1] + places[2])[:2] / h**2
    torque = -tilt.stiffness * state[:2] - tilt.damping * (state[2:] - lower_end) - tilt.moment * a
    return np.concatenate([state[2:], torque / tilt.inertia])


@pytest.mark.parametrize("seed", range(1021, 1027))
def test_the_swing_is_what_scipy_integrates(seed):
    trajectory = motion(seed)
    begin = np.array([0.02, -0.03, 0.2, 0.1])
    for start, end in ((1.0, 1.5), (1.13, 1.31)):
        solution = solve_ivp(
            lambda t, state: swing(trajectory, t, state, TILT), (start, end), begin, rtol=1e-8, atol=1e-10,
            max_step=0.02,
        )  # fmt: skip
        found = TILT.along(trajectory, end, start, begin)
        expected = solution.y[:, -1]
        np.testing.assert_allclose(found[:2], expected[:2], atol=2e-5)
        np.testing.assert_allclose(found[2:], expected[2:], atol=1e-3)
        assert np.abs(expected[:2]).max() > 0.01


def test_in_pieces_it_is_the_same():
    trajectory = motion(1027)
    state, now = np.zeros(4), 1.0
    for end in (1.02, 1.04, 1.21, 1.21, 1.5):
        state, now = TILT.along(trajectory, end, now, state), end
    np.testing.assert_allclose(state, TILT.along(trajectory, 1.5), atol=1e-5)


def test_the_state_that_is_given_is_left_as_it_is():
    state = np.array([0.01, 0.0, 0.0, 0.1])
    TILT.along(motion(1028), 1.3, 1.0, state)
    np.testing.assert_array_equal(state, [0.01, 0.0, 0.0, 0.1])


def test_an_arm_at_rest_leaves_a_hanging_mallet_in_peace():
    still = Trajectory.from_points([0.0, 1.0], np.stack([HOME, HOME]), np.zeros((2, 7)))
    np.testing.assert_array_equal(TILT.along(still, 1.0), 0.0)


def test_it_swings_back_as_a_damped_oscillator():
    """Without motion of the arm there is a closed form."""
    still = Trajectory.from_points([0.0, 1.0], np.stack([HOME, HOME]), np.zeros((2, 7)))
    tilt = MalletTilt(stiffness=4.0, damping=0.1, inertia=0.006)
    decay, pace = 0.1 / 0.012, math.sqrt(4.0 / 0.006 - (0.1 / 0.012) ** 2)
    for t in (0.05, 0.11, 0.3):
        shape = math.exp(-decay * t) * (math.cos(pace * t) + decay / pace * math.sin(pace * t))
        found = tilt.along(still, t, 0.0, np.array([0.1, -0.05, 0.0, 0.0]))
        np.testing.assert_allclose(found[:2], [0.1 * shape, -0.05 * shape], atol=1e-4)


def test_while_the_rod_turns_the_mallet_is_dragged_along():
    """At a steady rate its tilt is damping / stiffness times that rate; joint 6 alone turns the rod here."""
    rate, tilt = 0.2, MalletTilt(moment=0.0)
    rows = np.stack([HOME, HOME])
    rows[0, 5] -= 0.5 * rate
    rows[1, 5] += 0.5 * rate
    steady = Trajectory.from_points([0.0, 1.0], rows, np.tile(np.eye(7)[5] * rate, (2, 1)))
    lower_end = np.cross(ROBOT.jacobian(HOME)[3:, 5] * rate, [0.0, 0.0, -1.0])[:2]
    assert np.abs(lower_end).max() == pytest.approx(rate)
    found = tilt.along(steady, 1.0)
    np.testing.assert_allclose(found[:2], 0.31 / 4.19 * lower_end, atol=1e-4)


def test_its_weight_lags_behind_an_acceleration():
    """Joints that speed up towards +x leave the lower end behind, towards -x."""
    way = np.linalg.pinv(ROBOT.jacobian(HOME)[:3]) @ [1.0, 0.0, 0.0]
    times = [0.0, 0.2]
    rush = Trajectory.from_points(times, [HOME, HOME + 0.5 * 4.0 * 0.04 * way], [0.0 * way, 4.0 * 0.2 * way])
    tilt = MalletTilt(damping=0.0)
    light = MalletTilt(damping=0.0, moment=0.0)
    assert tilt.along(rush, 0.1)[0] < -0.01
    np.testing.assert_allclose(light.along(rush, 0.1), 0.0, atol=1e-12)


def test_smaller_steps_change_next_to_nothing():
    trajectory = motion(1029)
    fine = MalletTilt(step=2e-4).along(trajectory, 1.5)
    np.testing.assert_allclose(TILT.along(trajectory, 1.5), fine, atol=2e-4)
    # Runge and Kutta's rule is of fourth order.
    errors = [np.abs(MalletTilt(step=step).along(trajectory, 1.5) - fine).max() for step in (0.02, 0.01)]
    assert errors[1] < errors[0] / 8.0


def test_the_displacement_is_the_offsets_and_its_rate_the_derivative():
    state = np.array([0.3, -0.2, 0.5, 1.0])
    place, velocity = TILT.displacement(state)
    np.testing.assert_allclose(place, TILT.offset * np.sin([0.3, -0.2]))
    ahead = TILT.displacement(state + 1e-6 * np.array([0.5, 1.0, 0.0, 0.0]))[0]
    np.testing.assert_allclose(velocity, (ahead - place) / 1e-6, rtol=1e-5)


def test_there_is_no_way_back_in_time():
    with pytest.raises(InvalidInputError, match="back"):
        TILT.along(motion(1030), 1.2, 1.3)
    np.testing.assert_array_equal(TILT.along(motion(1030), 1.3, 1.3, np.ones(4)), np.ones(4))


def test_options_out_of_range_are_named():
    for name in ("stiffness", "inertia", "step"):
        with pytest.raises(ConfigurationError, match=name):
            MalletTilt(**{name: 0.0})
