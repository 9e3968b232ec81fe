"""The agent at the simulated table: the mallet swings as it thinks, and a shot scores."""

import math

import numpy as np
import pytest

from sim_bridge.hockey import table
from sim_bridge.hockey.world import AirHockeyWorld
from sim_bridge.trajectory_follower import TrajectoryCommand
from vpsto_ros.contact.puck import SHIPPED, PuckModel
from vpsto_ros.planning.hockey.agent import HockeyAgent, Observation, PuckSighting
from vpsto_ros.planning.hockey.strike_mpc import StrikeMpc
from vpsto_ros.planning.hockey.strikes import StrikeTable
from vpsto_ros.planning.hockey.touch import MalletContact
from vpsto_ros.robot.iiwa import JOINT_NAMES

TABLE, MODEL = StrikeTable.load(), PuckModel.load(SHIPPED)


@pytest.fixture(scope="module")
def world():
    return AirHockeyWorld(seed=1200)


@pytest.mark.parametrize(("x", "y", "degrees"), [(-0.5, 0.0, 0.0), (-0.5, 0.15, -30.0), (-0.4, -0.1, 25.0)])
def test_along_a_strike_the_mallet_swings_as_predicted(world, x, y, degrees):
    """The place of its centre at the touch within a millimetre, where the swing itself is many."""
    world.reset(puck=(2.2, 0.3, 0.0), joints=TABLE.rules.home)
    mpc, angle = StrikeMpc(TABLE, seed=5), np.deg2rad(degrees)
    along = np.array([np.cos(angle), np.sin(angle)])
    speed = 0.85 * TABLE.speeds([[x, y]], [angle])[0]
    begin, touch = world.time, world.time + 1.3
    contact = MalletContact(touch, np.concatenate([[x, y] - TABLE.contact_distance * along, speed * along]))
    for _ in range(100):
        step = mpc.step(world.time, world.joint_position, world.joint_velocity, contact)
        mpc.accept(step)
        assert step.valid, step.message
        world.follower.accept(TrajectoryCommand.of(step.trajectory, JOINT_NAMES), world.time)
        world.advance(min(0.02, touch - world.time))
        if world.time > touch - 5e-4:
            break
    state = world.mallet_state()
    swing = (state.position - state.joint_position)[:2]
    tilt = mpc.config.tilt
    predicted = tilt.displacement(tilt.along(mpc.reference, touch, begin))
    assert np.linalg.norm(swing) > 2e-3
    np.testing.assert_allclose(predicted[0], swing, atol=1e-3)
    np.testing.assert_allclose(predicted[1], (state.velocity - state.joint_velocity)[:2], atol=0.05)
    # So the mallet is where it was asked for, but for what the joints are late.
    np.testing.assert_allclose(table.to_table(state.position[:2]), contact.mallet[:2], atol=3e-3)
    np.testing.assert_allclose(state.velocity[:2], contact.mallet[2:], atol=0.1)


def test_a_puck_at_rest_is_shot_into_the_goal(world):
    """Seen by the noisy camera, from any of three places; every command keeps the driver's rules."""
    agent, scored = HockeyAgent(seed=6), []
    for place in ((-0.5, 0.05), (-0.45, -0.12), (-0.55, 0.15)):
        world.reset(puck=(*table.to_base(place), 0.0), joints=TABLE.rules.home)
        agent.reset()
        before, last = world.limits.violations, world.time + 5.0
        while world.goal is None and world.time < last:
            seen = tuple(PuckSighting(frame.stamp, frame.pose[:2]) for frame in world.camera_frames())
            answer = agent.act(Observation(world.time, world.joint_position, world.joint_velocity, seen))
            # With points up to where the next command takes over, and a little more to end on.
            command = TrajectoryCommand.of(answer.step.trajectory, JOINT_NAMES)
            world.follower.accept(command, world.time)
            world.advance(0.02)
        scored.append(world.goal is not None and world.goal.end == "far")
        assert world.height_deviation < 0.02
        assert world.limits.violations == before
        assert any(contact.surface == "mallet" for contact in world.contacts)
    assert sum(scored) >= 2, scored


def leaves(world, place, angle, share, seed):
    """Strike a puck that lies there: the model's direction of its way for the contact, and the true one."""
    world.reset(puck=(*table.to_base(place), 0.0), joints=TABLE.rules.home)
    mpc, along = StrikeMpc(TABLE, seed=seed), np.array([np.cos(angle), np.sin(angle)])
    speed, touch = share * TABLE.speeds([place], [angle])[0], world.time + 1.4
    contact = MalletContact(touch, np.concatenate([place - TABLE.contact_distance * along, speed * along]))
    while not any(each.surface == "mallet" for each in world.contacts) and world.time < touch + 0.3:
        step = mpc.step(world.time, world.joint_position, world.joint_velocity, contact)
        assert step.valid, step.message
        mpc.accept(step)
        world.follower.accept(TrajectoryCommand.of(step.trajectory, JOINT_NAMES), world.time)
        world.advance(0.02)
    hit = next(each for each in world.contacts if each.surface == "mallet")
    told = MODEL.hit([[*place, 0.0, 0.0]], contact.mallet[None])[0][0, 2:]
    return math.atan2(told[1], told[0]), math.atan2(hit.velocity_after[1], hit.velocity_after[0])


def test_a_puck_leaves_in_the_direction_that_the_model_has_for_the_contact(world):
    """Within a degree, though the mallet swings, leans and turns while it pushes: on average within half."""
    rng, off = np.random.default_rng(1210), []
    while len(off) < 10:
        place, angle = rng.uniform([-0.65, -0.2], [-0.4, 0.2]), np.deg2rad(rng.uniform(-40.0, 40.0))
        if TABLE.speeds([place], [angle])[0] < 1.0:
            continue
        told, found = leaves(world, place, angle, rng.uniform(0.7, 0.95), seed=len(off))
        off.append(np.degrees(found - told))
    assert np.abs(off).max() < 1.0, off
    assert np.abs(off).mean() < 0.5, off
