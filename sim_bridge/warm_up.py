"""``vpsto warm-up``: compile every kernel into the disk cache by using everything for a moment.

Processes that start together would each compile what the cache lacks.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from sim_bridge.bench.library_rows import cell
from sim_bridge.experiments.belief import belief_ablation, bimanual, robust_push_2d, variance_gain
from sim_bridge.experiments.clutter.mpc_runs import Task, run_task
from sim_bridge.experiments.clutter.mppi import MppiConfig
from sim_bridge.experiments.clutter.world import CLUTTER, GOAL, LIMITS, STARTS
from sim_bridge.experiments.pushing.loop import push_box_loop
from sim_bridge.hockey.world import AirHockeyWorld
from sim_bridge.scene import Scene
from sim_bridge.simulation import Simulation
from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.collision.arm import ArmCollision
from vpsto_ros.collision.arm_cost import ArmPathCost
from vpsto_ros.collision.planar_discs import MovingDisc
from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.contact.puck import SHIPPED, PuckModel
from vpsto_ros.contact.pushing import PushingModel, push_directions
from vpsto_ros.estimation.particle_filter import ObjectParticleFilter
from vpsto_ros.estimation.particle_filter_config import ParticleFilterConfig
from vpsto_ros.estimation.puck_filter import PuckFilter
from vpsto_ros.optimization.costs import JointSpaceProblem
from vpsto_ros.optimization.terms import position_extrema
from vpsto_ros.optimization.vpsto import VpstoConfig, search
from vpsto_ros.planning.hockey.shooting import ShootingPlanner
from vpsto_ros.planning.hockey.strike_mpc import StrikeMpc
from vpsto_ros.planning.hockey.strike_tabulation import tabulate
from vpsto_ros.planning.hockey.strikes import StrikeTable
from vpsto_ros.planning.joint_space_problem import JointSpaceMpcConfig
from vpsto_ros.robot.kinematics import fr3_pusher
from vpsto_ros.robot.mallet_observer import MalletObserver
from vpsto_ros.trajectory import Limits, OptimalBasis, Trajectory, synthesize_batch
from vpsto_ros.trajectory.key_timing import time_key_positions


def run(_arguments: argparse.Namespace | None = None) -> int:
    """Push a box, track a can, predict and shoot a puck, evaluate trajectories, plan among obstacles.

    Returns:
        0.
    """
    began = time.perf_counter()
    pushing = push_a_box, move_two_arms, track_a_pushed_can, push_by_a_belief
    hockey = predict_a_puck, play_air_hockey
    for use in (*pushing, *hockey, evaluate_a_trajectory, plan_in_clutter, plan_in_a_cell):
        use()
    print(f"kernels ready after {time.perf_counter() - began:.1f} s")
    return 0


def push_a_box() -> None:
    """Contact, estimation, replanning and the simulated arm, until the first plan has reached it."""
    push_box_loop().advance(0.5)
    model = PushingModel(PlanarShape.box(0.12, 0.12), PlanarShape.disc(0.015))
    push_directions(model, np.array([[-0.075, 0.0]]), np.array([[1.0, 0.0]]))


def move_two_arms() -> None:
    """Kinematics and simulation of the balls."""
    simulation = Simulation(Scene(robot="two_balls"))
    simulation.advance(0.01)
    simulation.tool_velocity()


def track_a_pushed_can() -> None:
    """Particles that are pushed, seen and felt."""
    for shape in (PlanarShape.disc(0.05), PlanarShape.box(0.1, 0.1)):
        dynamics = BeliefDynamics(shape, EndEffectors.discs(0.03, 2), friction=True, way_variance=1e-5)
        tracker = ObjectParticleFilter(ParticleFilterConfig(), dynamics, np.random.default_rng(0))
        for step in range(5):
            x = 0.42 + 0.002 * step
            tracker.predict(0.01 * step, [x, 0.04, x, -0.04])
            tracker.update(0.01 * step, np.array([0.5, 0.0, 0.0]), 1e-6 * np.eye(3))
            tracker.touch(0.01 * step, np.array([-2.0, 0.0]), 0.1)
        tracker.state(0.05)


def push_by_a_belief() -> None:
    """Robust plans of two arms and of a rectangle, the variance gain of a push, a box among two balls."""
    belief_ablation.warm_up()
    robust_push_2d.warm_up()
    variance_gain.measure(0)
    prior = bimanual.belief(2, np.random.default_rng(0))
    path = np.tile(bimanual.START, (1, 2, 1))
    BeliefDynamics(PlanarShape.box(0.1, 0.1), bimanual.BALLS).predict(prior, path)


def predict_a_puck() -> None:
    """The learned model of an air-hockey puck, and its filter."""
    model, start, spread = PuckModel.load(SHIPPED), np.array([0.0, 0.4, 1.0, 1.5]), 1e-6 * np.eye(4)
    model.step(start, spread)
    model.predict(start, spread, np.array([0.1, 0.9]))
    model.outlook(start[None], spread[None])
    model.shots(start, spread, start[None] - [model.table.contact_distance, 0.0, 0.0, 0.0])
    model.goal_window(0.1)
    model.simulate(start[None], 3, np.random.default_rng(0))
    PuckFilter(model).warm_up()


def play_air_hockey() -> None:
    """Shots are chosen, the arm strikes, in the simulated world rules and mallet are watched."""
    strikes = StrikeTable.load()
    home = np.array(strikes.rules.home)
    ShootingPlanner(PuckModel.load(SHIPPED), strikes).warm_up(home)
    StrikeMpc(strikes).warm_up()
    observer = MalletObserver()
    for step in range(3):
        observer.observe(0.01 * step, home + 0.001 * step, np.full(7, 0.1))
    AirHockeyWorld().advance(0.05)
    grids = np.array([-0.6, -0.5]), np.array([-0.1, 0.1]), np.array([-0.1, 0.1])
    tabulate(*grids, contact_distance=0.0798, rng=np.random.default_rng(0), effort=50)


def evaluate_a_trajectory() -> None:
    """All that a trajectory can be asked for."""
    limits = Limits(np.ones(2), np.ones(2))
    keys = np.array([[0.0, 0.0], [0.3, 0.1], [1.0, 0.5]])
    trajectory = time_key_positions(keys, limits).trajectory
    times = np.linspace(0.0, trajectory.duration, 5)
    trajectory(times), trajectory(0.1), trajectory.state(0.1)
    trajectory.violations(limits)
    trajectory.clipped(0.1, trajectory.duration)
    rest = np.zeros(2)
    position_extrema(synthesize_batch(OptimalBasis.uniform(1), keys, rest, rest, limits, 5))


def plan_in_clutter() -> None:
    """A point among polygons, with a disc that moves."""
    world = CLUTTER.with_discs((MovingDisc(np.array([0.05, 0.45]), 0.02, np.array([0.01, 0.0])),))
    ends = STARTS["start_0.10_0.20"], GOAL
    trajectory = _search(JointSpaceProblem(OptimalBasis.uniform(2), LIMITS, *ends, terms=(world.term(),)))
    world.clearance(trajectory(np.linspace(0.0, trajectory.duration, 5)))
    world.inside(ends[0])
    world.explain(trajectory)
    for controller in (JointSpaceMpcConfig(), MppiConfig()):
        run_task(Task(controller, "warm-up", "start_0.10_0.20", True, seed=0, longest=0.15))


def plan_in_a_cell() -> None:
    """The arm among boxes, capsules, spheres and half-spaces."""
    checker = ArmCollision(obstacles=cell(), margin=0.01)
    middle = np.mean(fr3_pusher().limits.position_range, axis=0)
    ends, limits = (middle, middle + 0.1), fr3_pusher().limits
    problem = JointSpaceProblem(OptimalBasis.uniform(1), limits, *ends, terms=(ArmPathCost(checker),))
    trajectory = _search(problem)
    checker.in_collision(middle)
    checker.distance(middle)
    checker.free_along(trajectory)
    checker.explain(trajectory)
    checker.capsules(middle)


def _search(problem: JointSpaceProblem) -> Trajectory:
    config = VpstoConfig(population=4, iterations=2)
    result = search(problem.prior(), problem.evaluate, config, np.random.default_rng(0))
    assert result.best_any_points is not None, "every candidate has a finite cost"
    return problem.trajectory(result.best_any_points)


if __name__ == "__main__":
    raise SystemExit(run())
