"""The shooting planner: it commits, follows, does not thrash, and says why there is no shot."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from strikes_bench import START, StandInStrikes

from vpsto_ros.contact.puck import SHIPPED, PuckModel
from vpsto_ros.estimation.puck_filter import PuckState
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.planning.hockey import shooting
from vpsto_ros.planning.hockey.shooting import SETTINGS, ShootingConfig, ShootingPlanner
from vpsto_ros.planning.hockey.shooting_config import middle_strike
from vpsto_ros.planning.hockey.shooting_policy import EnergyModel, ShootingPolicy
from vpsto_ros.planning.hockey.strikes import StrikeTable
from vpsto_ros.planning.hockey.touch import SAME_TIME, same_touch

MODEL = PuckModel.load(SHIPPED)
NOISE = np.array([7e-4, 7e-4, 5e-3, 5e-3])
PERIOD = 0.02


def planner(setting="conservative", strikes=None, **options):
    config = ShootingConfig(objective=SETTINGS[setting], **options)
    return ShootingPlanner(MODEL, strikes or StandInStrikes(), config)


def state(stamp, mean, std=NOISE, touching=""):
    return PuckState(stamp, np.array(mean, dtype=float), np.diag((std**2).real), 0, touching)


def course(start, steps):
    """A puck without noise, step by step."""
    states = [np.array(start, dtype=float)]
    for _ in range(steps):
        states.append(MODEL.step(states[-1], 1e-12 * np.eye(4))[0])
    return states


def run(agent, states, rng=None, begin=0.0):
    """The shot of every step."""
    shots = []
    for k, mean in enumerate(states):
        seen = mean if rng is None else mean + NOISE * rng.standard_normal(4)
        shots.append(agent.plan(begin + PERIOD * k, state(begin + PERIOD * k, seen), START))
    return shots


def first(shots):
    return next(k for k, shot in enumerate(shots) if shot is not None)


@pytest.mark.parametrize("setting", SETTINGS)
def test_a_resting_puck_is_shot_at_the_earliest_good_time(setting):
    agent = planner(setting)
    shots = run(agent, course([-0.4, 0.1, 0.0, 0.0], 20))
    k = first(shots)
    shot = shots[k]
    assert k <= 5 and agent.reason == "" and agent.committed is shots[-1]
    lead = StandInStrikes().lead(START, shot.puck[None, :2], np.array([shot.angle]))[0]
    least = PERIOD * k + lead
    assert least <= shot.time <= least + agent.config.lead_margin + 0.1
    np.testing.assert_allclose(shot.puck, [-0.4, 0.1, 0.0, 0.0], atol=1e-9)
    assert shot.goal > 0.5 and {s.time for s in shots[k:]} == {shot.time}


def test_strikes_with_another_mallet_are_refused_before_any_shot():
    strikes = StandInStrikes()
    strikes.contact_distance += 0.01
    with pytest.raises(ConfigurationError, match="apart at a touch"):
        planner(strikes=strikes)


def test_a_moving_puck_is_shot_where_it_will_be():
    agent, states = planner(), course([-0.5, 0.3, 0.1, -0.4], 60)
    shots = run(agent, states[:40])
    shot = shots[-1]
    at = round(shot.time / PERIOD)
    np.testing.assert_allclose(shot.puck, states[at], atol=1e-2)
    assert abs(shot.puck[1] - 0.3) > 0.1


def test_a_shot_ends_with_the_touch_and_another_is_planned():
    agent = planner()
    shots = run(agent, course([-0.4, 0.1, 0.0, 0.0], 100))
    times = [shot.time for shot in shots if shot is not None]
    assert len(set(times)) >= 2
    for k, shot in enumerate(shots):
        assert shot is None or shot.time > PERIOD * k


def test_no_shot_is_planned_while_the_mallet_goes_through_the_touch():
    agent, states = planner(), course([-0.4, 0.1, 0.0, 0.0], 60)
    shots = run(agent, states)
    touch = shots[first(shots)].time
    for k, shot in enumerate(shots):
        if 0.0 <= PERIOD * k - touch < agent.config.pause - 1e-9:
            assert shot is None
    assert any(shot is not None and shot.time > touch for shot in shots)


def test_a_clock_that_is_set_back_begins_anew():
    agent, states = planner(), course([-0.4, 0.1, 0.0, 0.0], 10)
    run(agent, states, begin=1e6)
    assert agent.committed.time > 1e6
    shots = run(agent, states, begin=5.0)
    assert 5.0 < shots[-1].time < 7.0


def test_clocks_that_count_from_long_ago_do_not_matter():
    early, late = planner(), planner()
    states = course([-0.45, -0.2, 0.05, 0.1], 10)
    shots, others = run(early, states), run(late, states, begin=1.7e9)
    assert first(shots) == first(others)
    assert others[-1].time - 1.7e9 == pytest.approx(shots[-1].time, abs=1e-5)
    assert others[-1].angle == pytest.approx(shots[-1].angle, abs=1e-6)


@pytest.mark.parametrize("setting", SETTINGS)
def test_noise_does_not_make_it_thrash(setting):
    """Unfiltered noise of 0.7 mm and 5 mm/s, which moves the place of the touch by a centimetre."""
    changes, turns, failures = 0, [], 0
    for seed in range(1000, 1012):
        rng = np.random.default_rng(seed)
        start = [*rng.uniform([-0.55, -0.25], [-0.35, 0.25]), *rng.normal(0.0, 0.05, 2)]
        agent = planner(setting)
        shots = run(agent, course(start, 34), rng)
        chosen = shots[first(shots) :]
        failures += any(shot is None for shot in chosen)
        chosen = [shot for shot in chosen if shot is not None]
        pairs = list(itertools.pairwise(chosen))
        changes += sum(a.time != b.time for a, b in pairs)
        turns.append(sum(abs(a.angle - b.angle) for a, b in pairs if a.time == b.time))
    assert failures == 0 and changes <= 1, "in 12 shots"
    assert np.median(turns) < 0.1 and max(turns) < 0.3


def test_shortly_before_the_touch_it_only_follows_the_puck():
    agent = planner()
    states = course([-0.4, 0.1, 0.03, -0.04], 80)
    rng = np.random.default_rng(1000)
    shots = run(agent, states, rng)
    shot = shots[first(shots)]
    same = [(k, s) for k, s in enumerate(shots) if s is not None and s.time == shot.time]
    last = [s for k, s in same if s.time - PERIOD * k <= 0.25]
    assert len(last) >= 10
    assert len({s.angle for s in last[1:]}) == len({s.speed for s in last[1:]}) == 1
    assert len({s.puck[0] for s in last}) == len(last)
    np.testing.assert_allclose(last[-1].puck[:2], states[round(shot.time / PERIOD)][:2], atol=2e-3)


def test_the_angle_follows_a_puck_that_changes_its_way():
    agent = planner()
    run(agent, course([-0.4, 0.1, 0.0, 0.0], 10))
    before = agent.committed
    for k in range(11, 21):  # drawn aside, a little in every step
        agent.plan(PERIOD * k, state(PERIOD * k, [-0.4, 0.1 + 0.012 * (k - 10), 0.0, 0.0]), START)
    after = agent.committed
    assert after is not None and after.time == before.time
    assert after.puck[1] == pytest.approx(0.22, abs=0.01) and after.angle < before.angle - 0.05
    assert after.goal > 0.8


def test_only_a_clear_gain_replaces_the_shot():
    """The arm turns out to be faster: an earlier touch saves the price of waiting."""
    for gain, switched in ((0.6, False), (0.05, True)):
        slow, fast = StandInStrikes(lead=2.0), StandInStrikes(lead=0.5)
        agent = planner(strikes=slow, clear_gain=gain)
        run(agent, course([-0.4, 0.1, 0.0, 0.0], 6))
        before = agent.committed
        agent.search.strikes = fast
        run(agent, course([-0.4, 0.1, 0.0, 0.0], 12), begin=0.14)
        assert (agent.committed.time < before.time - 0.5) == switched


def test_a_later_time_has_its_price():
    """A puck that rolls to where the arm is faster: for speed it pays to wait, unless waiting is dear."""
    times = []
    for price in (0.0, 2.0):
        agent = planner("aggressive", delay_price=price)
        shots = run(agent, course([-0.3, 0.0, -0.15, 0.0], 15))
        times.append(shots[-1].time)
    assert times[1] < times[0]


class PatientStrikes(StandInStrikes):
    """Most of the speed is soon to be had, all of it takes longer."""

    def timely_speeds(self, joints, puck, angles, available):
        lead = self.lead(joints, puck, angles)
        share = np.where(available >= lead + 0.6, 1.0, np.where(available >= lead, 0.75, 0.0))
        return share * self.speeds(puck, angles)


def test_speed_that_takes_time_is_worth_its_price_or_not():
    """A direction that has been searched is searched again when the arm can be faster."""
    for price, share in ((0.02, 1.0), (3.0, 0.75)):
        agent = planner("aggressive", strikes=PatientStrikes(), delay_price=price, lower_speed=1.0)
        shots = run(agent, course([-0.4, 0.1, 0.0, 0.0], 12))
        shot = shots[-1]
        largest = agent.search.speeds(shot.puck[None, :2], np.array([shot.angle]))[0]
        assert shot.speed == pytest.approx(share * largest, rel=1e-6)
        assert (shot.time > 1.2) == (share == 1.0)


def test_a_refused_shot_is_not_chosen_again():
    agent, states = planner(), course([-0.4, 0.1, 0.0, 0.0], 30)
    run(agent, states[:6])
    refused = agent.committed
    agent.refuse()
    assert agent.committed is None
    shots = run(agent, states[:12], begin=0.14)
    assert shots[-1] is not None
    assert not any(same_touch(s.time, s.mallet, refused.time, refused.mallet) for s in shots if s)


def given_way():
    """A planner whose shot has just given way to an earlier one, the shot of before, and the time."""
    agent = planner(strikes=StandInStrikes(lead=2.0), clear_gain=0.05)
    run(agent, course([-0.4, 0.1, 0.0, 0.0], 6))
    agent.search.strikes = StandInStrikes(lead=0.5)
    for k in range(7, 30):
        before = agent.committed
        agent.plan(PERIOD * k, state(PERIOD * k, [-0.4, 0.1, 0.0, 0.0]), START)
        if before is not None and agent.committed.time < before.time - 0.5:
            return agent, before, PERIOD * k
    raise AssertionError("no shot gave way")


def test_when_the_better_shot_is_refused_the_one_before_comes_back():
    agent, before, _ = given_way()
    better = agent.committed
    agent.refuse()
    assert agent.committed.time == before.time and agent.committed.time > better.time
    # Refused as well, it is not brought back by itself, nor is the better one.
    agent.refuse()
    assert agent.committed is None
    agent.refuse()
    assert agent.committed is None


def test_a_shot_that_is_over_does_not_come_back():
    agent, before, now = given_way()
    while now < before.time + 0.1:  # the better one is put off, as far as that
        now += PERIOD
        agent.committed = dataclasses.replace(agent.committed, time=now + 0.4)
        agent.plan(now, state(now, [-0.4, 0.1, 0.0, 0.0]), START)
        assert agent.committed is not None
    agent.refuse()
    assert agent.committed is None


def test_a_shot_that_was_rejected_in_a_choice_does_not_come_back(monkeypatch):
    """The best of a round turns out to be impossible, the next is chosen: refused, there is none before."""
    agent, follow, rejected = planner(), ShootingPlanner._follow, []

    def once(self, shot, now, puck):
        if not rejected:
            rejected.append(shot)
            return "the puck will be elsewhere than where the shot was planned"
        return follow(self, shot, now, puck)

    monkeypatch.setattr(ShootingPlanner, "_follow", once)
    for k in range(10):
        if agent.plan(PERIOD * k, state(PERIOD * k, [-0.4, 0.1, 0.0, 0.0]), START) is not None:
            break
    assert rejected and agent.committed.time != rejected[0].time
    agent.refuse()
    assert agent.committed is None


def test_as_many_refused_shots_are_remembered_as_promised():
    agent = planner()
    for k in range(60):
        agent.plan(PERIOD * k, state(PERIOD * k, [-0.4, 0.1, 0.0, 0.0]), START)
        if agent.committed is not None:
            agent.refuse()
    assert len(agent._barred) == shooting._REMEMBERED


def test_refusals_make_it_ask_for_later_and_slower_shots_until_it_forgets():
    agent, states = planner(), course([-0.4, 0.1, 0.0, 0.0], 30)
    first = run(agent, states[:12])[-1]
    agent.forget()
    for k in range(60):
        agent.plan(PERIOD * k, state(PERIOD * k, [-0.4, 0.1, 0.0, 0.0]), START)
        if agent.committed is not None:
            last = agent.committed, PERIOD * k
            agent.refuse()
    assert last[0].speed < 0.95 * first.speed and last[0].time - last[1] > 1.2 * first.time
    agent.forget()
    again = run(agent, states[:12])[-1]
    assert (again.time, again.speed, again.angle) == (first.time, first.speed, first.angle)


def test_the_same_touch_is_so_in_time_place_and_direction():
    mallet = np.array([-0.5, 0.1, 1.0, 0.2])
    turned = np.array([-0.5, 0.1, 1.0, -0.4])
    aside = mallet + [0.0, 0.08, 0.0, 0.0]
    assert same_touch(1.0, mallet, 1.01, mallet + [0.01, -0.02, 0.1, 0.05])
    for time, other in ((1.0 + SAME_TIME, mallet), (1.0, turned), (1.0, aside)):
        assert not same_touch(1.0, mallet, time, other) and not same_touch(time, other, 1.0, mallet)
    # Directions are compared across the seam at 180 degrees.
    back = mallet * [1.0, 1.0, -1.0, 0.05]
    assert same_touch(1.0, back, 1.0, back * [1.0, 1.0, 1.0, -1.0])


def test_contact_times_are_farther_apart_than_those_of_the_same_touch():
    with pytest.raises(ConfigurationError, match=r"time_step.*more than 0\.02"):
        ShootingConfig(time_step=SAME_TIME)
    assert ShootingConfig(time_step=1.01 * SAME_TIME).time_step > SAME_TIME


def test_searching_in_parts_finds_what_a_whole_round_finds():
    states = course([-0.55, 0.2, 0.1, -0.25], 30)
    whole, parts = planner(times_per_step=1000), planner(times_per_step=4)
    shots, others = run(whole, states), run(parts, states)
    assert first(shots) == 0 and first(others) > 2
    assert others[-1].value - 0.05 * others[-1].time > shots[-1].value - 0.05 * shots[-1].time - 0.05


def test_a_shot_is_dropped_when_the_puck_is_taken_away():
    agent = planner()
    run(agent, course([-0.4, 0.1, 0.0, 0.0], 10))
    assert agent.committed is not None
    assert agent._follow(agent.committed, 0.22, state(0.22, [-0.55, -0.2, 0.0, 0.0])) != ""
    agent.plan(0.22, state(0.22, [0.5, -0.2, 0.0, 0.0]), START)
    assert agent.committed is None and "reach" in agent.reason
    run(agent, course([-0.4, 0.1, 0.0, 0.0], 10), begin=0.3)
    agent.plan(0.52, None, START)
    assert agent.committed is None and agent.reason == "no puck is known"


def test_a_shot_is_dropped_when_its_chance_falls_below_the_tolerance():
    agent = planner()
    shots = run(agent, course([-0.4, 0.1, 0.0, 0.0], 10))
    unsure = np.array([6e-3, 6e-3, 0.03, 0.03])
    for tolerance, kept in ((0.1, False), (0.5, True)):
        config = dataclasses.replace(agent.config, tolerance=tolerance)
        twin = ShootingPlanner(MODEL, StandInStrikes(), config)
        twin.committed = shots[-1]
        reason = twin._follow(shots[-1], 0.22, state(0.22, [-0.4, 0.1, 0.0, 0.0], unsure))
        assert (reason == "") == kept and ("chance" in reason) != kept


def test_forget_forgets():
    agent = planner()
    run(agent, course([-0.4, 0.1, 0.0, 0.0], 10))
    agent.forget()
    assert agent.committed is None and agent.reason != ""
    again = run(agent, course([-0.4, 0.1, 0.0, 0.0], 10), begin=1.0)
    assert again[-1].time > 1.0


# No shot, and why.


@pytest.mark.parametrize(
    ("mean", "std", "reason"),
    [
        ([-0.5, 0.487, 0.0, 0.0], NOISE, "side wall"),
        ([-0.5, -0.45, 0.0, 0.0], NOISE, "side wall"),
        ([-0.9, 0.0, 0.0, 0.0], NOISE, "behind"),
        ([0.5, 0.0, 0.0, 0.0], NOISE, "out of the arm's reach"),
        ([0.0, 0.05, 1.2, 0.0], NOISE, "moves away"),
        ([-0.3, 0.05, 1.2, 0.0], NOISE, "moves away"),
        ([-0.9, 0.0, -1.5, 0.0], NOISE, "leaving the table"),
        ([-1.1, 0.0, -1.0, 0.0], NOISE, "has left the table"),
        ([math.nan, 0.0, 0.0, 0.0], NOISE, "not finite"),
        ([-0.4, 0.0, 0.0, math.inf], NOISE, "not finite"),
        ([-0.4, 0.0, 0.0, 0.0], np.array([1e-3, 1e-3, 1e-3, 1e-3j]), "negative variance"),
        ([-0.45, 0.0, 0.0, 0.0], np.array([0.05, 0.05, 0.1, 0.1]), "uncertain by"),
        ([-0.45, 0.0, 0.0, 0.0], np.array([2e-3, 2e-3, 0.4, 0.4]), "uncertain by"),
    ],
)
def test_without_a_shot_it_says_why(mean, std, reason):
    agent = planner()
    for k in range(12):
        assert agent.plan(PERIOD * k, state(PERIOD * k, mean, std), START) is None
        if k == 0:
            early = agent.reason
    assert reason in early or reason in agent.reason


def test_a_puck_behind_the_mallet_is_not_struck():
    stretched = np.array([0.0, 0.6, 0.0, -1.2, 0.0, 0.9, 0.0])  # the mallet is beyond the puck
    agent = planner()
    for k in range(12):
        assert agent.plan(PERIOD * k, state(PERIOD * k, [-0.6, 0.0, 0.0, 0.0]), stretched) is None
    assert agent.reason == "the puck is behind the mallet"


def test_an_arm_that_is_too_slow_says_so():
    agent = planner(strikes=StandInStrikes(lead=9.0))
    run(agent, course([-0.4, 0.1, 0.0, 0.0], 12))
    assert agent.committed is None and agent.reason == "the arm cannot be there in time"


def test_a_constraint_that_nothing_keeps_is_told_with_the_best_chance():
    strict = dataclasses.replace(SETTINGS["conservative"], beta=0.999)
    for fallback in (False, True):
        agent = ShootingPlanner(MODEL, StandInStrikes(), ShootingConfig(objective=strict, fallback=fallback))
        shots = run(agent, course([-0.55, 0.1, 0.0, 0.0], 12))
        assert (shots[-1] is not None) == fallback
        if not fallback:
            assert "wanted 0.999" in agent.reason and "0.9" in agent.reason
    banks = dataclasses.replace(SETTINGS["conservative"], least_banks=9)
    agent = ShootingPlanner(MODEL, StandInStrikes(), ShootingConfig(objective=banks))
    run(agent, course([-0.55, 0.1, 0.0, 0.0], 12))
    assert agent.committed is None and "meets 9 walls" in agent.reason


def test_a_bank_shot_can_be_demanded():
    objective = dataclasses.replace(SETTINGS["conservative"], least_banks=1, beta=0.3)
    agent = ShootingPlanner(MODEL, StandInStrikes(), ShootingConfig(objective=objective))
    shots = run(agent, course([-0.45, 0.1, 0.0, 0.0], 25), np.random.default_rng(1000))
    assert all(shot.banks >= 1 for shot in shots if shot is not None) and shots[-1] is not None


@pytest.mark.parametrize(
    ("now", "stamp", "joints", "reason"),
    [
        (math.nan, 0.0, START, "time is not finite"),
        (0.0, math.inf, START, "time is not finite"),
        (2.0, 0.0, START, "2.00 s old"),
        (0.0, 0.0, START[:6], "seven finite"),
        (0.0, 0.0, np.full(7, math.nan), "seven finite"),
    ],
)
def test_bad_times_and_postures_give_no_shot(now, stamp, joints, reason):
    agent = planner()
    assert agent.plan(now, state(stamp, [-0.4, 0.1, 0.0, 0.0]), joints) is None
    assert reason in agent.reason


def test_states_of_other_shapes_give_no_shot():
    agent = planner()
    odd = PuckState(0.0, np.zeros(3), np.eye(4), 0, "")
    assert agent.plan(0.0, odd, START) is None and "shapes" in agent.reason


def test_what_touches_the_puck_changes_nothing():
    """A puck's state that comes as a message does not tell it; the planner pauses after its own touches."""
    means, shots = course([-0.4, 0.1, 0.05, 0.0], 12), []
    for touching in ("", "mallet"):
        agent = planner()
        seen = [state(PERIOD * k, mean, touching=touching) for k, mean in enumerate(means)]
        shots.append([agent.plan(puck.stamp, puck, START) for puck in seen][-1])
    assert shots[0] is not None and shots[0].mallet == pytest.approx(shots[1].mallet)


def test_whatever_the_puck_does_nothing_is_raised():
    rng, agent = np.random.default_rng(1000), planner("aggressive")
    for k in range(400):
        mean = rng.uniform([-1.2, -0.7, -3.0, -3.0], [1.2, 0.7, 3.0, 3.0])
        shot = agent.plan(PERIOD * k, state(PERIOD * k, mean), START)
        assert (shot is None) == (agent.reason != "")


# With a policy.


def wedge(angle):
    """An energy model with its minimum at an angle, whatever the state."""
    strikes = StandInStrikes()
    low = np.array([strikes.x[0], strikes.y[0], -1.0, -1.0, strikes.angle[0]])
    high = np.array([strikes.x[-1], strikes.y[-1], 1.0, 1.0, strikes.angle[-1]])
    model = EnergyModel.random(low, high, 0, np.random.default_rng(0))
    weights = {name: np.zeros_like(array) for name, array in model.weights.items()}
    weights["first"][4, :2] = [1.0, -1.0]
    weights["first_bias"][:2] = np.array([-1.0, 1.0]) * angle / strikes.angle[-1]
    weights["second"][:2, 0] = 1.0
    weights["last"][0] = 50.0
    return dataclasses.replace(model, weights=weights)


def test_the_angle_comes_from_the_policy_where_there_is_one():
    best = planner().search.best(0.0, np.array([-0.4, 0.1, 0.0, 0.0]), np.diag(NOISE**2)).angle
    wanted = best + 0.02  # good, but not what direct search would find
    agent = ShootingPlanner(MODEL, StandInStrikes(), None, ShootingPolicy(wedge(wanted)))
    shots = run(agent, course([-0.4, 0.1, 0.0, 0.0], 25))
    assert shots[-1] is not None and shots[-1].angle == pytest.approx(wanted, abs=0.015)


def test_what_the_policy_proposes_must_keep_the_chance_constraint():
    agent = ShootingPlanner(MODEL, StandInStrikes(), None, ShootingPolicy(wedge(0.35)))
    shots = run(agent, course([-0.4, 0.1, 0.0, 0.0], 40))
    assert all(shot is None for shot in shots) and "scores with probability" in agent.reason


@pytest.mark.parametrize("strikes", [StandInStrikes(), StrikeTable.load()])
def test_a_warm_up_chooses_a_shot_and_forgets_it(strikes, monkeypatch):
    agent, shots = planner(strikes=strikes), []
    plan = ShootingPlanner.plan
    monkeypatch.setattr(ShootingPlanner, "plan", lambda *arguments: shots.append(plan(*arguments)))
    agent.warm_up(START)
    assert shots[-1] is not None and shots[-1].goal > 0.5
    assert agent.committed is None and agent.reason


def test_an_arm_that_strikes_nowhere_straight_ahead_says_so():
    strikes = StandInStrikes(slowest=0.0)
    with pytest.raises(ConfigurationError, match="straight ahead"):
        middle_strike(strikes)
    place, speed = middle_strike(StandInStrikes())
    np.testing.assert_allclose(place, [-0.45, 0.0])
    assert speed == pytest.approx(1.2 * 0.875)
