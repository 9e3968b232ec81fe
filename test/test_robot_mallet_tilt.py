"""How the mallet swings on its joint, against Pinocchio, SciPy's integrator, MuJoCo and a pendulum's laws."""

import math

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sim_bridge.hockey.mallet import Mallet
from sim_bridge.hockey.scene import MALLET_JOINTS, AirHockeyScene, build
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.planning.hockey.rules import PlayRules
from vpsto_ros.planning.hockey.strikes import StrikeTable
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


def stiffening(q):
    """A: the unit matrix, but stiffer across the horizontal part of the first hinge's axis, the rod's y."""
    axis = ROBOT.forward(q)[1][:2, 1]
    aside = np.array([-axis[1], axis[0]]) / np.linalg.norm(axis)
    return np.eye(2) + (1.0 / (axis @ axis) - 1.0) * np.outer(aside, aside)


def swing(trajectory, t, state, tilt, stiffer=stiffening):
    """I tau'' = -(k A + m c g) tau - d A (tau' - r) - m c a, r and a of Pinocchio and of differences."""
    q, qd = trajectory(t), trajectory(t, 1)
    turning = ROBOT.jacobian(q)[3:] @ qd
    lower_end = np.cross(turning, [0.0, 0.0, -1.0])[:2]
    # Ahead and back along the Taylor polynomial, so that ends of the motion are no ends of the difference.
    h, qdd = 1e-4, trajectory(t, 2)
    places = [ROBOT.forward(q + s * qd + 0.5 * s * s * qdd)[0] for s in (-h, 0.0, h)]
    a = (places[0] - 2.0 * places[1] + places[2])[:2] / h**2
    spring = tilt.stiffness * state[:2] + tilt.damping * (state[2:] - lower_end)
    torque = -stiffer(q) @ spring - tilt.moment * (9.81 * state[:2] + a)
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


# Against the two hinges of the simulated mallet, with their controller, under an arm that moves as told.

PLANT = build(AirHockeyScene())


class Hinges:
    """The exact motion of the two hinges, of which the tilt is a linear model."""

    def __init__(self, trajectory):
        self.trajectory, self.data = trajectory, mujoco.MjData(PLANT)
        self.mallet = Mallet(PLANT, self.data)
        joint = PLANT.joint(MALLET_JOINTS[0])
        self.q, self.v = slice(joint.qposadr[0], joint.qposadr[0] + 2), joint.dofadr[0]
        self.motor = PLANT.actuator(MALLET_JOINTS[0]).id

    def displacement(self, end):
        """Place (2,) of the mallet's centre relative to the joint, from hanging at rest at the start."""
        start = self.trajectory.start_time
        self._put(start, np.zeros(4))
        begin = np.concatenate([self.mallet.vertical(), np.zeros(2)])
        found = solve_ivp(self._rate, (start, end), begin, rtol=1e-7, atol=1e-9, max_step=0.02)
        self._put(end, found.y[:, -1])
        state = self.mallet.state()
        return (state.position - state.joint_position)[:2]

    def _put(self, t, state):
        self.data.qpos[:7], self.data.qvel[:7] = self.trajectory(t), self.trajectory(t, 1)
        self.data.qpos[self.q], self.data.qvel[self.v : self.v + 2] = state[:2], state[2:]
        mujoco.mj_forward(PLANT, self.data)

    def _rate(self, t, state):
        """The rows of the hinges in M q'' + c = tau, with the arm's q'' as prescribed."""
        self._put(t, state)
        self.mallet.control()
        hinges, torque = slice(self.v, self.v + 2), self.data.ctrl[self.motor : self.motor + 2]
        forces = torque + self.data.qfrc_passive[hinges] - self.data.qfrc_bias[hinges]
        units, inertia = np.zeros((3, PLANT.nv)), np.zeros((3, PLANT.nv))
        units[0, self.v] = units[1, self.v + 1] = 1.0
        units[2, :7] = self.trajectory(t, 2)
        for unit, column in zip(units, inertia, strict=True):
            mujoco.mj_mulM(PLANT, self.data, column, unit)
        return np.concatenate([state[2:], np.linalg.solve(inertia[:2, hinges], forces - inertia[2, hinges])])


def strikes(count, seed):
    """Motions from home into fast strikes, with inclined rods, each with joint 7 at several angles."""
    table, rng = StrikeTable.load(), np.random.default_rng(seed)
    cells = np.argwhere(table.speed > 1.0)
    for cell in map(tuple, rng.choice(cells, count, replace=False)):
        for seven in (-0.8, 0.0, 0.8):
            keys = np.stack([HOME, table.start(cell), table.posture[cell]])
            rates = np.stack([np.zeros(7), np.zeros(7), table.rates[cell]])
            keys[:, 6], rates[:, 6] = seven, 0.0
            yield Trajectory.from_points([0.0, 0.8, 1.0], keys, rates)


def test_it_swings_as_the_two_hinges_under_an_inclined_rod():
    """The place of the centre within 0.3 mm, where a spring towards the vertical alone is beside it by more.

    The tilt is linear, the hinges are not: of what is left the most is with the axis of the first one steep.
    """
    errors, without, leans = [], [], []
    for trajectory in strikes(14, 1041):
        exact = Hinges(trajectory).displacement(1.0)
        found = TILT.displacement(TILT.along(trajectory, 1.0))[0]
        alike = solve_ivp(
            lambda t, state, motion=trajectory: swing(motion, t, state, TILT, lambda _: np.eye(2)),
            (0.0, 1.0), np.zeros(4), rtol=1e-5, atol=1e-7, max_step=0.02,
        ).y[:, -1]  # fmt: skip
        errors.append(np.linalg.norm(found - exact))
        without.append(np.linalg.norm(TILT.displacement(alike)[0] - exact))
        leans.append(np.linalg.norm(ROBOT.forward(trajectory(1.0))[1][:2, 1]))
    assert min(leans) < 0.9, "some axes of the first hinge are steep"
    assert np.sqrt(np.mean(np.square(errors))) < 2e-4 and np.quantile(errors, 0.9) < 3.5e-4
    assert max(errors) < 7e-4
    assert np.sqrt(np.mean(np.square(without))) > 2.0 * np.sqrt(np.mean(np.square(errors)))
    assert max(without) > 1e-3


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
    tilt = MalletTilt(stiffness=4.0, damping=0.1, inertia=0.006, moment=0.0)
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
    np.testing.assert_allclose(found[:2], 0.31 / 4.0 * lower_end, atol=1e-4)


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


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.5, -1.9])
def test_the_mallet_touches_with_the_edge_that_is_ahead(angle):
    """The lower edge of the puck where its lower end is ahead, else the upper one, and in between upright."""
    along = np.array([math.cos(angle), math.sin(angle)])
    aside, (upper, lower) = np.array([-along[1], along[0]]), TILT.puck
    for lean, height in ((0.03, lower), (0.01, lower), (-0.01, upper), (-0.03, upper)):
        for sideways in (0.0, 0.02, -0.05):
            tilt = lean * along + sideways * aside
            place = TILT.touching(np.concatenate([tilt, [0.3, -0.2]]), along)
            np.testing.assert_allclose(place, height * np.tan(tilt), atol=1e-12)
    np.testing.assert_array_equal(TILT.touching(np.array([0.0, 0.0, 0.5, 0.5]), along), 0.0)
    still = TILT.touching(np.zeros(4), along)
    np.testing.assert_array_equal(still, TILT.displacement(np.zeros(4))[0])


def test_where_it_touches_changes_without_a_jump():
    leans = np.linspace(-0.02, 0.02, 2001)
    along, (upper, lower) = np.array([1.0, 0.0]), TILT.puck
    places = np.array([TILT.touching(np.array([lean, 0.03, 0.0, 0.0]), along) for lean in leans])
    assert np.abs(np.diff(places, axis=0)).max() < 1e-5, "a hundredth of a millimetre for 0.02 mrad"
    heights = places[:, 1] / math.tan(0.03)
    assert (np.diff(heights) >= -1e-12).all()
    assert heights[0] == pytest.approx(upper) and heights[-1] == pytest.approx(lower)
    # Near the vertical, wherever in between the edges that is, it is next to the centre.
    for lean in (-1e-4, 1e-4):
        state = np.array([lean, -lean, 0.0, 0.0])
        np.testing.assert_allclose(TILT.touching(state, along), TILT.displacement(state)[0], atol=2e-6)


def test_there_is_no_way_back_in_time():
    with pytest.raises(InvalidInputError, match="back"):
        TILT.along(motion(1030), 1.2, 1.3)
    np.testing.assert_array_equal(TILT.along(motion(1030), 1.3, 1.3, np.ones(4)), np.ones(4))


def test_options_out_of_range_are_named():
    for name in ("stiffness", "inertia", "step"):
        with pytest.raises(ConfigurationError, match=name):
            MalletTilt(**{name: 0.0})
