"""The agent with an arm that follows its references exactly, and whatever a camera may deliver."""

import itertools
import math
import re
import shutil

import numpy as np
import pytest

from vpsto_ros.contact.puck import SHIPPED as PUCK_MODEL
from vpsto_ros.contact.puck import PuckModel
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.planning.hockey.agent import HockeyAgent, HockeyAgentConfig, Observation, PuckSighting
from vpsto_ros.planning.hockey.rules import PlayRules
from vpsto_ros.planning.hockey.strikes import SHIPPED as STRIKES
from vpsto_ros.planning.hockey.strikes import StrikeTable
from vpsto_ros.robot.iiwa import iiwa14
from vpsto_ros.robot.iiwa_kinematics import arm_points

RULES, ROBOT = PlayRules(), iiwa14()
HOME = np.array(RULES.home)
PERIOD = HockeyAgentConfig().period


@pytest.fixture(scope="module")
def agent():
    """One agent for all tests: making one takes seconds."""
    return HockeyAgent(seed=1)


class Play:
    """An agent, and an arm that is where its references say.

    Attributes:
        answers: what the agent gave, in order.
        now: time of the next observation [s].
    """

    def __init__(self, agent, joints=HOME, at=5.0):
        self.agent, self.answers, self.now = agent, [], at
        self.joints, self.rates = np.array(joints, dtype=float), np.zeros(7)
        agent.reset()

    def observe(self, *sightings):
        """One cycle; places of the puck (x, y) in the table frame are stamped with the time."""
        seen = tuple(
            one if isinstance(one, PuckSighting) else PuckSighting(self.now, np.array(one) + RULES.table)
            for one in sightings
        )
        answer = self.agent.act(Observation(self.now, self.joints, self.rates, seen))
        self.answers.append(answer)
        self.joints, self.rates = answer.position[-1], answer.velocity[-1]
        self.now += PERIOD
        return answer

    def watch(self, place, duration=2.0):
        """A puck that rests at a place (2,), table frame."""
        for _ in range(round(duration / PERIOD)):
            answer = self.observe(place)
        return answer

    def shots(self):
        return [answer.shot for answer in self.answers if answer.shot is not None]

    def messages(self):
        return " | ".join(dict.fromkeys(answer.message for answer in self.answers))


def assert_safe(play):
    """References join as tightly as numbers allow, and keep limits and places."""
    for before, after in itertools.pairwise(play.answers):
        np.testing.assert_allclose(after.times[0], before.times[-1], atol=1e-9)
        np.testing.assert_allclose(after.position[0], before.position[-1], atol=1e-6)
        np.testing.assert_allclose(after.velocity[0], before.velocity[-1], atol=1e-5)
    q = np.concatenate([answer.position for answer in play.answers])
    qd = np.concatenate([answer.velocity for answer in play.answers])
    qdd = np.concatenate([answer.acceleration for answer in play.answers])
    assert np.isfinite(q).all()
    assert np.all(np.abs(qd) <= 0.95 * ROBOT.limits.velocity)
    assert np.all(np.abs(qdd) <= ROBOT.limits.acceleration)
    points = arm_points(q)
    assert np.abs(points[:, 3, 2] - 0.1645).max() < 0.02
    assert points[:, 3, 0].min() > 0.584 and np.abs(points[:, 3, 1]).max() < 0.47085
    assert points[:, 1:3, 2].min() > 0.25


def assert_stays_home(play):
    assert play.shots() == []
    for answer in play.answers:
        np.testing.assert_allclose(answer.position, np.tile(HOME, (len(answer.times), 1)), atol=1e-6)
        np.testing.assert_allclose(answer.velocity, 0.0, atol=1e-6)


def test_references_cover_the_period_and_are_consistent(agent):
    play = Play(agent)
    play.watch([-0.5, 0.05], 2.5)
    assert play.shots()
    for answer in play.answers:
        np.testing.assert_allclose(np.diff(answer.times), 1e-3)
        assert answer.times[-1] - answer.times[0] == pytest.approx(PERIOD)
        h = 1e-3
        # Of a piecewise cubic, up to a knot in between.
        between = 0.5 * h * (answer.velocity[1:] + answer.velocity[:-1])
        np.testing.assert_allclose(np.diff(answer.position, axis=0), between, atol=3e-5)
    assert_safe(play)


def test_a_puck_at_rest_is_shot_at_and_the_arm_comes_home(agent):
    play = Play(agent)
    play.watch([-0.5, 0.05], 1.0)
    shot = play.shots()[-1]
    np.testing.assert_allclose(shot.puck[:2], [-0.5, 0.05], atol=0.01)
    while play.now < shot.time:
        shot = play.observe([-0.5, 0.05]).shot or shot
    # Then it is gone, and nothing is seen any more.
    for _ in range(150):
        play.observe()
    assert_safe(play)
    np.testing.assert_allclose(play.joints, HOME, atol=1e-3)
    assert "not seen" in play.answers[-1].message or "no puck" in play.answers[-1].message
    # The arm was where the shot needs it, when it needs it.
    times = np.concatenate([answer.times for answer in play.answers])
    q = np.concatenate([answer.position for answer in play.answers])
    place = ROBOT.forward(q[np.argmin(np.abs(times - shot.time))])[0][:2] - RULES.table
    np.testing.assert_allclose(place, shot.mallet[:2], atol=0.015)  # the mallet's swing makes up the rest


def test_the_commitment_is_kept_under_noise(agent):
    play, rng = Play(agent), np.random.default_rng(1070)
    while not play.shots() or play.now < play.shots()[-1].time - 0.1:
        play.observe([-0.5, 0.0] + 7e-4 * rng.standard_normal(2))
        assert play.now < 9.0
    # Shots that the arm refuses are told, but do not count.
    times = [answer.shot.time for answer in play.answers if answer.shot is not None and answer.step.valid]
    assert len(set(np.round(times, 6))) <= 2
    assert_safe(play)


def test_without_a_puck_it_waits_at_home(agent):
    play = Play(agent)
    for _ in range(50):
        answer = play.observe()
    assert_stays_home(play)
    assert answer.puck is None and answer.message == "no puck is known"


def test_from_elsewhere_it_goes_home_first(agent):
    table = StrikeTable.load()
    q, _ = table.contact(table.cell([-0.6, 0.1, 1.0, 0.0], HOME), RULES.table + [-0.6, 0.1], [1.0, 0.0])
    play = Play(agent, joints=q)
    for _ in range(150):
        play.observe()
    np.testing.assert_allclose(play.joints, HOME, atol=1e-4)
    assert_safe(play)


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ((-0.5, 0.487), "wall"),
        ((-0.5, -0.4873), "wall"),
        ((0.5, 0.1), "out of the arm's reach"),
        ((-0.93, 0.1), "behind"),
        ((-0.86, 0.0), "behind"),
        ((-0.94, 0.487), "wall|behind"),
    ],
)
def test_a_puck_that_cannot_be_shot_is_told_and_the_arm_stays_home(agent, place, words):
    play = Play(agent)
    answer = play.watch(place, 1.5)
    assert_stays_home(play)
    assert answer.puck is not None
    assert re.search(words, answer.message), answer.message


def test_a_puck_that_leaves_the_table_is_told(agent):
    play, x = Play(agent), 0.6
    while x < 1.05:
        play.observe([x, 0.02])
        x += 1.5 * PERIOD
    for _ in range(10):
        answer = play.observe()
    assert_stays_home(play)
    assert answer.message in ("no puck is known",) or "left" in answer.message


def test_a_puck_that_is_gone_before_the_touch_leaves_the_arm_safe(agent):
    play = Play(agent)
    play.watch([-0.5, 0.05], 1.0)
    assert play.shots()
    for _ in range(150):
        answer = play.observe()
    assert answer.shot is None and answer.puck is None
    np.testing.assert_allclose(play.joints, HOME, atol=1e-3)
    assert_safe(play)


@pytest.mark.parametrize("after", [0.3, 0.9, 1.3])
def test_a_puck_that_is_put_elsewhere_is_followed_there(agent, after):
    """A new episode: the puck, but not the arm, is suddenly somewhere else."""
    play = Play(agent)
    play.watch([-0.5, 0.1], after)
    for _ in range(150):
        answer = play.observe([-0.45, -0.15])
        if answer.shot is not None and answer.shot.puck[1] < -0.1 and play.now > answer.shot.time - 0.1:
            break
    assert answer.shot is not None
    np.testing.assert_allclose(answer.shot.puck[:2], [-0.45, -0.15], atol=0.01)
    np.testing.assert_allclose(answer.puck.mean[:2], [-0.45, -0.15], atol=0.01)
    assert_safe(play)


@pytest.mark.parametrize(
    ("sighting", "words"),
    [
        (lambda now: PuckSighting(now, [math.nan, 0.0]), "position"),
        (lambda now: PuckSighting(now, [1.0, math.inf]), "position"),
        (lambda now: PuckSighting(math.nan, [1.0, 0.0]), "stamp"),
        (lambda now: PuckSighting(now, [1.0, 0.0], np.full((2, 2), math.nan)), "covariance"),
        (lambda now: PuckSighting(now, [1.0, 0.0], -np.eye(2)), "covariance"),
        (lambda now: PuckSighting(now, [5.0, 0.0]), "outside the table"),
        (lambda now: PuckSighting(now - 60.0, [1.0, 0.0]), "stamp jumps"),
        (lambda now: PuckSighting(now + 60.0, [1.0, 0.0]), "stamp jumps"),
        (lambda now: PuckSighting(now, [1.0]), "position"),
        (lambda now: PuckSighting(now, []), "position"),
        (lambda now: PuckSighting(now, None), "position"),
        (lambda now: PuckSighting(now, "here"), "position"),
        (lambda now: PuckSighting(now, [[1.0, 0.0], [0.0, 1.0]]), "position"),
        (lambda now: PuckSighting(None, [1.0, 0.0]), "stamp"),
        (lambda now: PuckSighting(now, [1.0, 0.0], 3.0), "covariance"),
    ],
    ids=range(15),
)
def test_what_is_wrong_with_a_sighting_is_told_and_nothing_else_happens(agent, sighting, words):
    play = Play(agent)
    play.observe([-0.5, 0.05])
    play.observe([-0.5, 0.05])
    answer = play.observe(sighting(play.now))
    assert "puck not used" in answer.message and words in answer.message
    np.testing.assert_allclose(answer.puck.mean[:2], [-0.5, 0.05], atol=0.02)
    # It goes on as if that had not been there.
    play.watch([-0.5, 0.05], 1.5)
    assert play.shots()
    assert_safe(play)


@pytest.mark.parametrize(
    ("velocity", "covariance"),
    [([math.nan, 0.0], None), ([1.0], None), ("fast", None), ([0.0, 0.0], -np.eye(2))],
)
def test_a_measured_velocity_that_is_none_is_told(agent, velocity, covariance):
    play = Play(agent)
    play.observe([-0.5, 0.05])
    seen = PuckSighting(play.now, np.array([-0.5, 0.05]) + RULES.table, None, velocity, covariance)
    answer = play.observe(seen)
    assert "velocity" in answer.message
    np.testing.assert_allclose(answer.puck.mean[:2], [-0.5, 0.05], atol=0.02)


def test_stamps_that_go_back_by_little_are_stale_and_do_no_harm(agent):
    play = Play(agent)
    for _ in range(75):
        late = PuckSighting(play.now - 0.03, np.array([-0.5, 0.05]) + RULES.table)
        answer = play.observe([-0.5, 0.05], late)
    assert play.shots() and "puck not used" not in answer.message
    assert_safe(play)


def test_a_measured_velocity_is_used(agent):
    play = Play(agent)
    moving = np.array([0.3, -0.1])
    place = np.array([-0.5, 0.05])
    for k in range(2):
        seen = PuckSighting(
            play.now, place + k * PERIOD * moving + RULES.table, velocity=moving,
            velocity_covariance=1e-6 * np.eye(2),
        )  # fmt: skip
        answer = play.observe(seen)
    np.testing.assert_allclose(answer.puck.mean[2:], moving, atol=0.01)


@pytest.mark.parametrize(
    ("time", "q", "qd"),
    [
        (math.nan, HOME, np.zeros(7)),
        (5.0, HOME[:6], np.zeros(7)),
        (5.0, HOME, np.full(7, math.nan)),
        (5.0, [HOME], np.zeros(7)),
    ],
)
def test_an_arm_without_a_state_is_an_error(agent, time, q, qd):
    agent.reset()
    with pytest.raises(InvalidInputError, match="7 joint positions"):
        agent.act(Observation(time, q, qd))


def test_an_arm_that_moves_by_itself_is_left_alone_until_it_stands(agent):
    agent.reset()
    swinging = agent.act(Observation(5.0, HOME, 0.5 * np.ones(7)))
    assert swinging.step.mode == "wait" and not swinging.step.valid
    assert swinging.message
    np.testing.assert_array_equal(swinging.position, np.tile(HOME, (len(swinging.times), 1)))
    np.testing.assert_array_equal(swinging.velocity, 0.0)
    standing = agent.act(Observation(5.02, HOME, np.zeros(7)))
    assert standing.step.valid


def test_reset_forgets_all_of_the_last_episode(agent):
    play = Play(agent)
    play.watch([-0.5, 0.05], 1.0)
    first = [answer.position for answer in play.answers]
    play = Play(agent, at=2.0)  # time goes back, as after a restart of the simulator
    answer = play.observe()
    assert answer.puck is None and answer.shot is None and answer.message == "no puck is known"
    play.watch([-0.5, 0.05], 1.0)
    assert play.shots() and len(first) == 50
    assert_safe(play)


def test_the_same_seed_plays_the_same_game():
    games = []
    for _ in range(2):
        play = Play(HockeyAgent(seed=4))
        play.watch([-0.5, 0.05], 1.2)
        games.append(np.concatenate([answer.position for answer in play.answers]))
    np.testing.assert_array_equal(*games)


@pytest.mark.parametrize("module", ["strikes", "puck"])
def test_missing_and_damaged_models_are_errors_with_a_remedy(tmp_path, module):
    shipped, load = {"strikes": (STRIKES, StrikeTable.load), "puck": (PUCK_MODEL, PuckModel.load)}[module]
    with pytest.raises(ConfigurationError, match="vpsto learn"):
        load(tmp_path / shipped.name)
    path = tmp_path / shipped.name
    shutil.copy(shipped, path)
    load(path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(ConfigurationError, match=path.name):
        load(path)


def test_a_package_without_its_models_says_so_when_the_agent_is_made(monkeypatch, tmp_path):
    missing = tmp_path / "puck.json"
    monkeypatch.setattr("vpsto_ros.planning.hockey.agent.PUCK_MODEL", missing)
    with pytest.raises(ConfigurationError, match=r"puck\.json.*vpsto learn"):
        HockeyAgent()


def test_options_out_of_range_are_named():
    with pytest.raises(ConfigurationError, match="period"):
        HockeyAgentConfig(period=0.0)
