"""The strike planner in lock-step with an arm that follows its references: contacts are met, rules kept."""

import itertools
import math

import numpy as np
import pytest

from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.planning.hockey.strike_mpc import StrikeMpc
from vpsto_ros.planning.hockey.strike_mpc_config import StrikeMpcConfig
from vpsto_ros.planning.hockey.strikes import StrikeTable
from vpsto_ros.planning.hockey.touch import MalletContact
from vpsto_ros.robot.iiwa import iiwa14
from vpsto_ros.robot.iiwa_kinematics import arm_points
from vpsto_ros.trajectory import Limits

TABLE, ROBOT = StrikeTable.load(), iiwa14()
RULES = TABLE.rules
HOME = np.array(RULES.home)
PERIOD = 0.02
ALLOWED = Limits(
    0.95 * ROBOT.limits.velocity, ROBOT.limits.acceleration, 0.95 * ROBOT.position_range[0],
    0.95 * ROBOT.position_range[1],
)  # fmt: skip
"""What the rules of play allow."""


def contact_at(time, x=-0.5, y=0.0, degrees=0.0, share=0.85):
    """A contact with a puck there, at a share of the mallet's largest speed."""
    angle = np.deg2rad(degrees)
    along = np.array([math.cos(angle), math.sin(angle)])
    speed = share * TABLE.speeds([[x, y]], [angle])[0]
    assert speed > 0.0, "there is a strike"
    return MalletContact(time, np.concatenate([[x, y] - TABLE.contact_distance * along, speed * along]))


CONTACTS = [
    (-0.5, 0.0, 0.0), (-0.45, 0.1, -20.0), (-0.55, -0.15, 30.0), (-0.4, 0.05, 10.0), (-0.6, 0.2, -45.0),
]  # fmt: skip
"""Of the puck: x, y, and the angle of the shot in degrees."""


class Arm:
    """A planner and an arm whose joints are where the reference says.

    Attributes:
        mpc: the planner.
        now: time [s].
        steps: what was planned, in order.
    """

    def __init__(self, seed=0, joints=HOME, at=10.0, config=None):
        self.mpc, self.now, self.steps = StrikeMpc(TABLE, config, seed=seed), at, []
        self.joints = np.array(joints, dtype=float)

    def state(self):
        if self.mpc.reference is None:
            return self.joints, np.zeros(7)
        return self.mpc.reference(self.now), self.mpc.reference(self.now, 1)

    def cycle(self, contact=None):
        step = self.mpc.step(self.now, *self.state(), contact)
        self.mpc.accept(step)
        self.steps.append((self.now, step))
        self.now += PERIOD
        return step

    def run(self, until, contact=None):
        while self.now < until - 1e-9:
            self.cycle(contact)
        return self.steps[-1][1]

    def strike(self, contact):
        """Until the arm is home again; the motion as it was carried out."""
        self.run(contact.time + 0.02, contact)
        self.run(contact.time + 2.5)
        return self.executed()

    def executed(self):
        """Joint positions (T, 7) at times (T,), 1 ms apart, from what ran from cycle to cycle."""
        times, rows = [], []
        for begin, step in self.steps:
            fine = begin + np.arange(0.0, PERIOD - 1e-9, 1e-3)
            times.append(fine)
            rows.append(step.trajectory(fine))
        return np.concatenate(times), np.concatenate(rows)


def assert_rules(trajectory):
    """Limits at every instant, places every 2 ms, rest at home at the end, no jump on the way."""
    assert trajectory.violations(ALLOWED) == []
    fine = trajectory(np.arange(trajectory.start_time, trajectory.end_time, 2e-3))
    assert_places(fine)
    np.testing.assert_allclose(trajectory(trajectory.end_time), HOME, atol=1e-6)
    np.testing.assert_allclose(trajectory.state(trajectory.end_time)[1], 0.0, atol=1e-7)
    assert np.abs(np.concatenate(trajectory.jumps())).max() < 1e-6


def assert_places(q):
    points = arm_points(q)
    joint = points[:, 3]
    assert np.abs(joint[:, 2] - 0.1645).max() < 0.02
    assert joint[:, 0].min() > 0.584
    assert np.abs(joint[:, 1]).max() < 0.47085
    assert points[:, 1:3, 2].min() > 0.25


def assert_joined(steps):
    """From one plan to the next the reference does not jump, until the new one takes over it is the same."""
    for (_, before), (now, after) in itertools.pairwise(steps):
        assert after.trajectory.start_time <= now + 1e-9
        for t in (now, now + 0.5 * PERIOD, now + PERIOD):
            np.testing.assert_allclose(after.trajectory(t), before.trajectory(t), atol=1e-6)
            # The new motion takes over at the end of the cycle: its velocity joins, too.
            np.testing.assert_allclose(after.trajectory(t, 1), before.trajectory(t, 1), atol=1e-5)


def swing_at(arm, time):
    """Tilt and rates (4,) of the mallet, from what was carried out."""
    tilt, state = arm.mpc.config.tilt, np.zeros(4)
    for (begin, motion), end in zip(arm.steps, [*(t for t, _ in arm.steps[1:]), np.inf], strict=True):
        if begin < time:
            state = tilt.along(motion.trajectory, min(end, time), begin, state)
    return state


def mallet_at(arm, contact):
    """State (4,) of the mallet at the touch, table frame, from what was carried out and its swing.

    Its place is where its axis is at the height at which it touches.
    """
    times, rows = arm.executed()
    # The whole of what ran before the touch is one trajectory: the last one planned before it and its past.
    reference = next(step.trajectory for begin, step in reversed(arm.steps) if begin <= contact.time - 0.06)
    q, qd, _ = reference.state(contact.time)
    np.testing.assert_allclose(rows[np.searchsorted(times, contact.time - 5e-4)], q, atol=2e-3)
    tilt, state = arm.mpc.config.tilt, swing_at(arm, contact.time)
    along = contact.mallet[2:] / np.hypot(*contact.mallet[2:])
    aside, rate = tilt.touching(state, along), tilt.displacement(state)[1]
    velocity = ROBOT.jacobian(q)[:2] @ qd
    return np.concatenate([ROBOT.forward(q)[0][:2] + aside - RULES.table, velocity + rate])


@pytest.mark.parametrize("where", CONTACTS, ids=str)
def test_the_mallet_meets_the_contact_in_place_velocity_and_time(where):
    arm, contact = Arm(), contact_at(11.4, *where)
    arm.strike(contact)
    state = mallet_at(arm, contact)
    np.testing.assert_allclose(state[:2], contact.mallet[:2], atol=1e-3)
    np.testing.assert_allclose(state[2:], contact.mallet[2:], atol=0.05)
    assert all(step.valid for _, step in arm.steps)


@pytest.mark.parametrize("where", CONTACTS, ids=str)
def test_every_trajectory_keeps_the_rules_and_ends_at_rest_at_home(where):
    arm, contact = Arm(seed=1), contact_at(11.3, *where)
    arm.strike(contact)
    for _, step in arm.steps:
        if step.mode != "hold":
            assert_rules(step.trajectory)
    assert_joined(arm.steps)
    assert_places(arm.executed()[1])
    last = arm.steps[-1][1]
    assert last.mode == "hold" and arm.mpc.contact is None
    np.testing.assert_allclose(last.trajectory(arm.now), HOME, atol=1e-3)


def struck(contact, arm=None):
    """A strike, and the trajectory of its touch."""
    arm = arm or Arm()
    arm.strike(contact)
    return arm, next(step.trajectory for t, step in reversed(arm.steps) if t <= contact.time - 0.06)


@pytest.mark.parametrize("where", CONTACTS, ids=str)
def test_while_the_touch_lasts_the_joint_goes_straight_on_at_its_speed(where):
    contact = contact_at(11.4, *where, share=0.7)
    _, trajectory = struck(contact)
    at = contact.time + np.linspace(0.0, 0.044, 12)
    places, velocity = arm_points(trajectory(at))[:, 3], ROBOT.jacobian(trajectory(contact.time))[:3]
    velocity = velocity @ trajectory(contact.time, 1)
    even = places[0] + (at - contact.time)[:, None] * velocity
    assert np.abs(velocity[2]) < 1e-6
    np.testing.assert_allclose(places, even, atol=4e-4)
    np.testing.assert_allclose(places[:5], even[:5], atol=5e-5)


def test_the_mallet_moves_as_asked_for_in_the_middle_of_the_contact():
    """It swings on: its velocity is right when half of the contact is over, its place at the touch."""
    contact, errors = contact_at(11.4, -0.6, 0.2, -45.0), {}
    for middle in (0.0, 0.009):
        arm, trajectory = struck(contact, Arm(config=StrikeMpcConfig(middle=middle)))
        tilt = arm.mpc.config.tilt
        for after in (0.0, 0.009):
            state = swing_at(arm, contact.time)
            state = tilt.along(trajectory, contact.time + after, contact.time, state)
            q, qd, _ = trajectory.state(contact.time + after)
            velocity = (ROBOT.jacobian(q) @ qd)[:2] + tilt.displacement(state)[1]
            errors[middle, after] = np.linalg.norm(velocity - contact.mallet[2:])
    assert errors[0.009, 0.009] < 0.25 * errors[0.0, 0.009]
    assert errors[0.0, 0.0] < 0.25 * errors[0.009, 0.0]


def test_a_mallet_that_can_almost_be_so_fast_is_a_little_slower():
    """Up to a tenth; beyond that the contact is refused, with how much could be had."""
    fast = contact_at(11.4, share=1.05)
    arm, trajectory = struck(fast)
    assert all(step.valid for _, step in arm.steps)
    speed = np.linalg.norm((ROBOT.jacobian(trajectory(fast.time)) @ trajectory(fast.time, 1))[:2])
    assert 0.85 < speed / np.hypot(*fast.mallet[2:]) < 1.0
    assert_rules(trajectory)
    strict = Arm(config=StrikeMpcConfig(slower=0.0))
    strict.run(10.04)
    step = strict.cycle(contact_at(11.4, share=1.12))
    assert not step.valid and "cannot be that fast" in step.message and "%" in step.message


def test_a_contact_that_is_told_anew_by_millimetres_does_not_make_it_thrash():
    arm, rng = Arm(), np.random.default_rng(1060)
    contact, planned = contact_at(11.4, -0.5, 0.05, 10.0), []
    while arm.now < contact.time - 0.1:
        noise = np.array([1e-3, 1e-3, 0.01, 0.01]) * rng.standard_normal(4)
        told = MalletContact(contact.time + 1e-3 * rng.standard_normal(), contact.mallet + noise)
        planned.append(arm.cycle(told))
    assert all(step.valid for step in planned)
    assert [step.mode for step in planned].count("explore") <= 1 + (arm.mpc.config.first_rounds > 1)
    arm.strike(told)
    np.testing.assert_allclose(mallet_at(arm, told)[:2], told.mallet[:2], atol=1.5e-3)
    assert_joined(arm.steps)
    # What runs is much as long as one that was told once: the joints do not go to and fro.
    still = Arm()
    still.strike(contact)
    ways = [np.abs(np.diff(each.executed()[1], axis=0)).sum() for each in (arm, still)]
    assert ways[0] < 1.6 * ways[1]


@pytest.mark.parametrize("before", [0.9, 0.5, 0.3, 0.16])
def test_a_contact_that_is_withdrawn_leads_home(before):
    arm, contact = Arm(), contact_at(11.4)
    arm.run(contact.time - before, contact)
    step = arm.cycle(None)
    assert step.valid and arm.mpc.contact is None
    assert "called off" in step.message
    for _ in range(120):
        step = arm.cycle(None)
        assert step.mode == "hold" or np.abs(step.trajectory(step.trajectory.end_time) - HOME).max() < 1e-6
    assert step.mode == "hold"
    assert_joined(arm.steps)
    assert_places(arm.executed()[1])


def test_shortly_before_the_touch_nothing_is_called_off():
    arm, contact = Arm(), contact_at(11.4)
    arm.run(contact.time - 0.06, contact)
    running = arm.steps[-1][1].trajectory
    arm.run(contact.time + 0.2)
    times = np.linspace(contact.time - 0.05, contact.time + 0.04, 20)
    np.testing.assert_allclose(arm.mpc.reference(times), running(times), atol=1e-9)


def test_another_contact_later_takes_over():
    arm = Arm()
    arm.run(10.4, contact_at(11.4, -0.5, 0.1, 0.0))
    other = contact_at(11.7, -0.45, -0.1, 20.0)
    arm.strike(other)
    np.testing.assert_allclose(mallet_at(arm, other)[:2], other.mallet[:2], atol=1e-3)
    assert_joined(arm.steps)


@pytest.mark.parametrize(
    "contact",
    [
        MalletContact(11.4, np.array([0.4, 0.0, 1.0, 0.0])),
        MalletContact(11.4, np.array([-0.5, 0.9, 1.0, 0.0])),
        MalletContact(11.4, np.array([-0.5, 0.0, -1.0, 0.0])),
        MalletContact(11.4, np.array([-0.55, 0.0, 9.0, 0.0])),
        contact_at(10.1),
        contact_at(10.25, -0.55, -0.15, 30.0),
    ],
    ids=["beyond", "outside", "backwards", "too fast", "too soon", "too soon as well"],
)
def test_what_cannot_be_done_is_refused_with_a_reason(contact):
    arm = Arm()
    arm.run(10.04)
    step = arm.cycle(contact)
    assert not step.valid and step.message
    assert arm.mpc.contact is None
    np.testing.assert_allclose(step.trajectory(step.trajectory.end_time), HOME, atol=1e-9)
    # It is as if it had never been asked for: the next one is met.
    good = contact_at(11.6)
    arm.strike(good)
    np.testing.assert_allclose(mallet_at(arm, good)[:2], good.mallet[:2], atol=1e-3)


def test_while_a_contact_is_refused_the_one_before_goes_on():
    arm, contact = Arm(), contact_at(11.4)
    arm.run(11.0, contact)
    running = arm.steps[-1][1].trajectory
    step = arm.cycle(MalletContact(11.5, np.array([0.4, 0.0, 1.0, 0.0])))
    assert not step.valid and "no strike" in step.message
    times = np.linspace(arm.now, running.end_time, 40)
    np.testing.assert_allclose(step.trajectory(times), running(times), atol=1e-6)


def test_a_contact_that_is_over_or_imminent_changes_nothing():
    arm = Arm()
    arm.run(10.1)
    for time in (9.0, arm.now + 0.03):
        step = arm.cycle(contact_at(time))
        assert step.mode == "hold" and arm.mpc.contact is None


def test_an_arm_that_is_elsewhere_is_taken_over_where_it_is():
    arm, contact = Arm(), contact_at(11.4)
    arm.run(11.0, contact)
    elsewhere = arm.mpc.reference(arm.now) + 0.15 * np.eye(7)[0]
    moving = arm.mpc.step(arm.now, elsewhere, 0.5 * np.ones(7), contact)
    assert moving.trajectory is None and moving.mode == "wait" and not moving.valid
    assert "does not follow" in moving.message
    arm.mpc.accept(moving)
    standing = arm.mpc.step(arm.now, elsewhere, np.zeros(7), contact)
    np.testing.assert_allclose(standing.trajectory(arm.now), elsewhere, atol=1e-9)
    np.testing.assert_allclose(standing.trajectory(standing.trajectory.end_time), HOME, atol=1e-6)
    assert standing.trajectory.violations(ALLOWED) == []


@pytest.mark.parametrize(
    "change", [(0.3, -0.2, 0.0, 0.1, 0.0, 0.0, 0.0), (0.0, -0.4, 0.3, 0.2, 0.2, -0.3, 1.0)]
)
def test_from_any_posture_the_arm_goes_home_within_its_limits(change):
    start = HOME + change
    assert ROBOT.forward(start)[0][2] > 0.1645 + 0.03, "above the plane of play"
    arm = Arm(joints=start)
    step = arm.cycle()
    assert step.mode == "enter" and step.valid
    np.testing.assert_allclose(step.trajectory(step.trajectory.start_time), start, atol=1e-9)
    np.testing.assert_allclose(step.trajectory.state(step.trajectory.start_time)[1], 0.0, atol=1e-9)
    assert step.trajectory.violations(ALLOWED) == []
    arm.run(arm.now + step.trajectory.duration + 0.1)
    np.testing.assert_allclose(arm.state()[0], HOME, atol=1e-6)
    assert_joined(arm.steps)


def test_from_within_the_plane_the_rules_hold_on_the_way_home():
    q, _ = TABLE.contact(TABLE.cell([-0.6, 0.1, 1.0, 0.0], HOME), RULES.table + [-0.6, 0.1], [1.0, 0.0])
    arm = Arm(joints=q)
    step = arm.cycle()
    assert step.mode == "return"
    assert_rules(step.trajectory)


def test_it_waits_at_home():
    arm = Arm()
    for _ in range(10):
        step = arm.cycle()
        assert step.valid
        np.testing.assert_allclose(arm.mpc.reference(arm.now), HOME, atol=1e-9)
    assert step.mode == "hold" and "home" in step.message


def test_the_same_seed_gives_the_same_plans():
    contact, ends = contact_at(11.2), []
    for _ in range(2):
        arm = Arm(seed=3)
        arm.run(11.0, contact)
        ends.append(arm.mpc.reference(np.linspace(10.9, 11.6, 30)))
    np.testing.assert_array_equal(*ends)


@pytest.mark.parametrize(
    ("now", "q", "qd"),
    [
        (10.0, HOME[:6], np.zeros(7)),
        (10.0, HOME, np.zeros(6)),
        (10.0, HOME * np.nan, np.zeros(7)),
        (10.0, HOME, np.full(7, np.inf)),
        (math.nan, HOME, np.zeros(7)),
        (10.0, HOME[None], np.zeros(7)),
    ],
)
def test_a_state_that_is_none_is_refused(now, q, qd):
    with pytest.raises(InvalidInputError, match="7 finite"):
        StrikeMpc(TABLE).step(now, q, qd)


@pytest.mark.parametrize(
    ("time", "mallet"),
    [(math.nan, [0, 0, 1, 0]), (1.0, [0, 0, 1]), (1.0, [0, math.inf, 1, 0]), (1.0, [0.5, 0.1, 0.0, 0.0])],
)
def test_contacts_that_are_none_are_refused(time, mallet):
    with pytest.raises(InvalidInputError, match="contact"):
        MalletContact(time, np.array(mallet, dtype=float))


def test_a_contact_told_anew_is_the_same_one():
    contact = contact_at(11.0, degrees=170.0 - 170.0)
    turned = MalletContact(11.01, contact.mallet + [0.002, 0.0, 0.0, 0.1])
    assert turned.continues(contact) and not turned.continues(None)
    assert not MalletContact(11.1, contact.mallet).continues(contact)
    assert not MalletContact(11.0, contact.mallet * [1, 1, 0.5, 1] + [0, 0, 0, 1.0]).continues(contact)
    assert not MalletContact(11.0, contact.mallet + [0.0, 0.08, 0.0, 0.0]).continues(contact)
    # Directions are compared across the seam at 180 degrees.
    back = [MalletContact(0.0, np.array([0.0, 0.0, -1.0, side])) for side in (0.01, -0.01)]
    assert back[0].continues(back[1])


def test_options_out_of_range_are_named():
    with pytest.raises(ConfigurationError, match="longest"):
        StrikeMpcConfig(longest=0.0)


def test_a_warm_up_strikes_goes_home_and_leaves_nothing(monkeypatch):
    mpc, wanted = StrikeMpc(StrikeTable.load()), []
    accept = StrikeMpc.accept

    def watched(self, step):
        accept(self, step)
        wanted.append(self.contact)

    monkeypatch.setattr(StrikeMpc, "accept", watched)
    mpc.warm_up()
    assert wanted[0] is None and wanted[1] is not None and wanted[-1] is None
    assert mpc.contact is None and mpc.reference is None
