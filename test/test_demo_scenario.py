import math

import numpy as np
import pytest

from sim_bridge.demo.bimanual_push import CAN_AREA, CAN_DISTANCE, KNOCK_AREA, TABLE_CENTRE, can_scenario
from sim_bridge.demo.push_box import box_scenario
from sim_bridge.demo.scenario import DRIFT_SPEED, Area, Knock

TOOL = np.array([0.4, 0.0])
PERIOD = 0.02


def act(scenario, follow, until=400.0, tools=TOOL):
    """Step a scenario; `follow(box, orders)` moves the box. Returns the orders over time."""
    box, now, history = np.array([0.5, 0.0]), 0.0, []
    while not scenario.finished and now < until:
        orders = scenario.step(now, box, tools)
        history.append((now, orders, box.copy()))
        box = follow(box, orders)
        now += PERIOD
    return history


def obedient(box, orders):
    """A box that goes to the target at 0.1 m/s, or where the hand shoves it."""
    if orders.force is not None and orders.force.any():
        return box + PERIOD * 0.2 * orders.force / np.linalg.norm(orders.force)
    step = orders.goal - box
    return box + step * min(1.0, 0.1 * PERIOD / max(np.linalg.norm(step), 1e-9))


def scenario(seed=0, duration=60.0):
    return box_scenario(np.random.default_rng(seed), duration)


@pytest.mark.parametrize("seed", range(8))
def test_a_box_that_obeys_reaches_everything(seed):
    story = scenario(seed)
    act(story, obedient)
    assert story.finished
    names = [phase.name for phase in story.phases]
    assert names == ["target 1", "target 2", "knock", "target 3", "drift", "rest"]
    for phase in story.phases:
        assert phase.start <= phase.end
        if phase.name != "drift":
            assert 0.0 <= phase.time_to_reach < phase.timeout
    assert np.median(story.drift_distances) < 0.005


def test_a_box_that_never_moves_reaches_nothing_and_time_runs_out():
    story = scenario(duration=30.0)
    history = act(story, lambda box, orders: box)
    assert story.finished
    assert history[-1][0] <= 30.0 + 6 * PERIOD
    assert all(math.isnan(phase.reached) for phase in story.phases if phase.name.startswith("target"))


def test_reached_means_within_10_mm_for_a_whole_second():
    story = scenario()
    goal = story.step(0.0, np.array([0.5, 0.0]), TOOL).goal
    near, far = goal + [0.0099, 0.0], goal + [0.0101, 0.0]
    for now in np.arange(1.0, 1.9, 0.1):
        story.step(now, near, TOOL)
    story.step(1.95, far, TOOL)
    for now in np.arange(2.0, 2.95, 0.1):
        story.step(now, near, TOOL)
    assert math.isnan(story.phases[0].reached)
    story.step(3.0, near, TOOL)
    assert story.phases[0].reached == pytest.approx(2.0)


def test_targets_are_in_the_area_and_a_jump_apart():
    area = Area()
    for seed in range(20):
        story = scenario(seed)
        history = act(story, obedient)
        jumps = [0] + [
            i
            for i in range(1, len(history))
            if np.linalg.norm(history[i][1].goal - history[i - 1][1].goal) > 0.02
        ]
        assert len(jumps) == 3
        for index in jumps:
            _, orders, box = history[index]
            assert area.contains(orders.goal)
            assert np.linalg.norm(orders.goal - box) >= 0.1


def test_the_drift_has_its_speed_and_stays_in_the_area():
    story = box_scenario(np.random.default_rng(3), duration=300.0, drift_time=60.0)
    goals = np.array([orders.goal for _, orders, _ in act(story, obedient) if orders.goal_moves])
    speeds = np.linalg.norm(np.diff(goals, axis=0), axis=1) / PERIOD
    assert speeds == pytest.approx(DRIFT_SPEED, rel=1e-6)
    assert all(story.area.contains(goal) for goal in goals)
    assert np.any(np.diff(goals[:, 1]) > 0.0) and np.any(np.diff(goals[:, 1]) < 0.0)


def shove(hand, mass, friction, period):
    """Slide a box under a hand that is asked every `period()` seconds and lets go after 40 ms."""
    position, velocity, force = np.zeros(2), np.zeros(2), np.zeros(2)
    now, ask, let_go = 0.0, 0.0, 0.0
    while now < 5.0:
        if now >= ask:
            force, ask, let_go = hand.force(now, position.copy()), now + period(), now + 0.04
        pushing = force if now < let_go else np.zeros(2)
        speed, dry = np.linalg.norm(velocity), friction * mass * 9.81
        if speed > 1e-6:
            resistance = -dry * velocity / speed
        else:
            resistance = -pushing * min(1.0, dry / max(np.linalg.norm(pushing), 1e-9))
        new = velocity + 0.001 * (pushing + resistance) / mass
        # Friction stops a box, it does not turn it round.
        velocity = np.zeros(2) if speed > 0.0 and new @ velocity < 0.0 else new
        position = position + 0.001 * velocity
        now += 0.001
    return position


@pytest.mark.parametrize(("mass", "friction"), [(0.2, 0.2), (0.5, 0.35), (1.0, 0.6)])
def test_the_hand_moves_any_box_by_about_the_distance_asked_for(mass, friction):
    hand = Knock(np.array([3.0, 4.0]), 0.07)
    position = shove(hand, mass, friction, lambda: 0.02)
    assert hand.done
    assert 0.05 <= np.linalg.norm(position) <= 0.10
    assert position / np.linalg.norm(position) == pytest.approx([0.6, 0.8], abs=1e-6)


@pytest.mark.parametrize("seed", range(10))
def test_a_hand_that_is_served_late_moves_the_box_no_farther_than_a_knock(seed):
    rng = np.random.default_rng(seed)
    hand = Knock(np.array([1.0, 0.0]), 0.075)
    position = shove(hand, 0.5, 0.35, lambda: rng.choice([0.02, 0.05, 0.3], p=[0.6, 0.2, 0.2]))
    assert hand.done
    assert 0.05 <= np.linalg.norm(position) <= 0.12


def test_the_knock_leaves_the_box_among_the_targets_and_off_the_tool():
    for seed in range(20):
        history = act(scenario(seed), obedient)
        boxes = np.array([box for _, orders, box in history if orders.force is not None])
        moved = np.linalg.norm(boxes[-1] - boxes[0])
        assert 0.05 <= moved <= 0.10
        assert Area((0.42, 0.62), (-0.27, 0.27)).contains(boxes[-1])
        assert np.linalg.norm(boxes - TOOL, axis=1).min() > 0.03


BALLS = np.array([[0.4, 0.05], [0.4, -0.05]])


@pytest.mark.parametrize("seed", range(8))
def test_a_can_that_obeys_is_brought_back_after_every_knock(seed):
    story = can_scenario(np.random.default_rng(seed), 90.0)
    history = act(story, obedient, tools=BALLS)
    assert story.finished
    assert [phase.name for phase in story.phases] == ["centre", "knock 1", "knock 2", "elsewhere", "knock 3"]
    assert all(phase.judged and 0.0 <= phase.time_to_reach < phase.timeout for phase in story.phases)
    goals = np.unique([orders.goal for _, orders, _ in history], axis=0)
    assert len(goals) == 2 and any(np.allclose(goal, TABLE_CENTRE) for goal in goals)
    assert all(CAN_AREA.contains(goal) for goal in goals)
    assert np.linalg.norm(goals[1] - goals[0]) >= 0.1
    times = np.array([now for now, orders, _ in history if orders.force is not None])
    assert np.count_nonzero(np.diff(times) > 1.0) == 2, "three knocks, one after the other"


def test_a_knock_is_aimed_away_from_both_tools_and_leaves_the_can_in_its_area():
    turned = 0
    for seed in range(30):
        story = can_scenario(np.random.default_rng(seed), 90.0)
        history = act(story, obedient, tools=BALLS)
        forces = [orders.force for _, orders, _ in history if orders.force is not None and orders.force.any()]
        turned += sum(force[0] < 0.0 for force in forces[:1])
        boxes = np.array([box for _, _, box in history])
        assert KNOCK_AREA.x[0] - 0.03 <= boxes[:, 0].min() and boxes[:, 0].max() <= KNOCK_AREA.x[1] + 0.03
    assert turned == 0, "the hand shoves away from the balls"


def test_a_can_is_there_within_its_distance():
    story = can_scenario(np.random.default_rng(0), 90.0)
    for now in np.arange(0.0, 1.05, 0.1):
        story.step(now, np.array(TABLE_CENTRE) + [CAN_DISTANCE - 1e-4, 0.0], BALLS)
    assert story.phases[0].reached == 0.0
