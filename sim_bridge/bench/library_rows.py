"""Rows of the library alone: basis, synthesis, evaluation, search and collision checks."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import partial

import numpy as np

from sim_bridge.bench.measuring import Action, Cores, Row, Wanted, at_most
from sim_bridge.experiments.clutter.world import CLUTTER, GOAL, LIMITS, STARTS
from vpsto_ros.collision.arm import ArmCollision
from vpsto_ros.collision.arm_cost import ArmPathCost
from vpsto_ros.collision.shapes import Box, Capsule, HalfSpace, Shape, Sphere
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.contact.pushing import PushingModel, rollout
from vpsto_ros.optimization.cma import make_strategy
from vpsto_ros.optimization.costs import JointSpaceProblem
from vpsto_ros.optimization.vpsto import VpstoConfig, search
from vpsto_ros.priors.smoothness import smoothness_prior
from vpsto_ros.robot.inverse_kinematics import TableMap
from vpsto_ros.robot.kinematics import forward_kinematics_batch, fr3_pusher
from vpsto_ros.trajectory import Limits, OptimalBasis, synthesize, synthesize_batch
from vpsto_ros.trajectory.key_timing import time_key_positions

DOF = (2, 4, 7, 14)
BATCHES = (64, 256, 1000)
DIMENSIONS = (6, 14, 28, 56)
POPULATION = 25
POSTURES = 1000


def basis(_cores: Cores) -> Action:
    """A new basis for 4 via-points and its matrices Phi, Phi', Phi'' at 50 phases; the same for any DoF."""
    phases, s = np.arange(1, 6) / 5.0, np.linspace(0.0, 1.0, 50)

    def build() -> None:
        fresh = OptimalBasis(phases)
        for order in range(3):
            fresh(s, order)

    return build


def cached_basis(_cores: Cores) -> Action:
    """The basis for 4 via-points when it has been asked for before."""
    return lambda: OptimalBasis.uniform(4)


def synthesis(n: int, batch: int, cores: Cores) -> Action:
    """Trajectories of n joints through 4 via-points with minimal duration, 50 samples with derivatives."""
    basis, rest = OptimalBasis.uniform(4), np.zeros(n)
    limits = Limits(np.full(n, 2.0), np.full(n, 10.0))
    keys = np.random.default_rng(0).uniform(-2.0, 2.0, (batch, 6, n))
    return cores.shared(lambda part: synthesize_batch(basis, keys[part], rest, rest, limits, 50), batch)


def arm_synthesis(cores: Cores) -> Action:
    """100 trajectories of the arm through 4 via-points with minimal duration, 50 samples each."""
    robot, basis, rest = fr3_pusher(), OptimalBasis.uniform(4), np.zeros(7)
    keys = np.random.default_rng(0).uniform(*robot.position_range, (100, 6, 7))
    return cores.shared(lambda part: synthesize_batch(basis, keys[part], rest, rest, robot.limits, 50), 100)


def evaluation(orders: int, cores: Cores) -> Action:
    """A trajectory of 7 joints through 4 via-points and so many of its derivatives, at 1000 times."""
    rng, rest = np.random.default_rng(0), np.zeros(7)
    limits = fr3_pusher().limits
    trajectory = synthesize(OptimalBasis.uniform(4), rng.uniform(-1.0, 1.0, (6, 7)), rest, rest, limits)
    times = np.linspace(trajectory.start_time, trajectory.end_time, 1000)
    return cores.shared(lambda part: [trajectory(times[part], order) for order in range(orders)], 1000)


def search_step(name: str, dimension: int, _cores: Cores) -> Action:
    """One ask and one tell with random costs; a new search after 200, before the distribution collapses."""
    rng = np.random.default_rng(0)
    costs = itertools.cycle(rng.standard_normal((200, POPULATION)))

    def steps() -> Iterator[None]:
        while True:
            strategy = make_strategy(name, dimension, POPULATION, rng)
            for _ in range(200):
                strategy.tell(strategy.ask(), next(costs))
                yield

    return steps().__next__


def vpsto_iteration(cores: Cores) -> Action:
    """One iteration for 7 joints: 64 candidates sampled, synthesised and rolled out on a box."""
    robot, basis = fr3_pusher(), OptimalBasis.uniform(3)
    rest = np.zeros(7)
    start, end = TableMap(robot, 0.02).joints([(0.38, 0.0), (0.55, 0.05)])
    keys = np.empty((64, 5, 7))
    keys[:, 0] = start
    prior = smoothness_prior(basis, start, rest, None, rest, 2.0, scale=0.1)
    direct = start + np.linspace(0.25, 1.0, 4)[:, None] * (end - start)
    shift = direct - prior.to_points(np.zeros((1, prior.dimension)))
    strategy = make_strategy("sep-cma", prior.dimension, 64, np.random.default_rng(0))
    model = PushingModel(PlanarShape.box(0.12, 0.12), PlanarShape.disc(0.015))
    box, goal = np.array([0.47, 0.0, 0.0]), np.array([0.6, 0.05])
    cost = np.empty(64)

    def evaluate(part: slice) -> None:
        batch = synthesize_batch(basis, keys[part], rest, rest, robot.limits, 50)
        tips = forward_kinematics_batch(batch.position.reshape(-1, 7)).reshape(-1, 50, 3)
        poses = rollout(model, box, np.ascontiguousarray(tips[:, :, :2])).object_pose
        cost[part] = batch.duration + 60.0 * np.linalg.norm(poses[:, -1, :2] - goal, axis=1)

    evaluate_all = cores.shared(evaluate, 64)

    def iterate() -> None:
        samples = strategy.ask()
        keys[:, 1:] = shift + prior.to_points(samples)
        evaluate_all()
        strategy.tell(samples, cost)

    return iterate


def cell() -> list[Shape]:
    """Ten obstacles around the arm: a table, shelves, posts, a pipe and things on the table."""
    return [
        HalfSpace(np.array([0.0, 0.0, 1.0]), -0.01, name="table"),
        Box(np.array([0.75, 0.0, 0.55]), np.array([0.15, 0.40, 0.015]), name="upper shelf"),
        Box(np.array([0.75, 0.0, 0.25]), np.array([0.15, 0.40, 0.015]), name="lower shelf"),
        Box(np.array([0.75, 0.42, 0.40]), np.array([0.15, 0.015, 0.40]), name="side of the shelf"),
        Box(np.array([0.0, -0.6, 0.3]), np.array([0.20, 0.10, 0.30]), name="cabinet"),
        Capsule(np.array([0.4, 0.5, 0.0]), np.array([0.4, 0.5, 1.0]), 0.05, name="post"),
        Capsule(np.array([-0.5, -0.5, 0.9]), np.array([0.6, -0.5, 0.9]), 0.04, name="pipe"),
        Sphere(np.array([0.45, -0.25, 0.10]), 0.08, name="ball"),
        Sphere(np.array([0.3, 0.3, 0.7]), 0.06, name="lamp"),
        Sphere(np.array([-0.4, 0.3, 0.5]), 0.10, name="head"),
    ]


def posture_checks(cores: Cores) -> Action:
    """1000 random postures of the arm checked against ten obstacles and against itself."""
    checker, limits = ArmCollision(obstacles=cell()), fr3_pusher().limits
    postures = np.random.default_rng(0).uniform(*limits.position_range, (POSTURES, 7))
    return cores.shared(lambda part: checker.in_collision(postures[part]), POSTURES)


def arm_paths(cores: Cores) -> Action:
    """64 motions of the arm checked against the same obstacles, valid ones at every instant."""
    checker, basis, rest = ArmCollision(obstacles=cell()), OptimalBasis.uniform(3), np.zeros(7)
    term, limits = ArmPathCost(checker), fr3_pusher().limits
    middle = np.mean(limits.position_range, axis=0)
    keys = middle + np.cumsum(np.random.default_rng(0).uniform(-0.2, 0.2, (64, 5, 7)), axis=1)
    batches = [
        synthesize_batch(basis, part, rest, rest, limits, 50, derivatives=False)
        for part in np.array_split(keys, cores.count)
    ]
    return cores.shared(lambda part: [term(batch) for batch in batches[part]], cores.count)


def planar_paths(cores: Cores) -> Action:
    """64 paths of a point checked against the three polygons of Fig. 4.4 at every instant."""
    basis, rest = OptimalBasis.uniform(3), np.zeros(2)
    keys = np.random.default_rng(0).uniform(0.05, 0.45, (64, 5, 2))
    batches = [
        synthesize_batch(basis, part, rest, rest, LIMITS, 50) for part in np.array_split(keys, cores.count)
    ]
    return cores.shared(lambda part: [CLUTTER.time_in_collision(b) for b in batches[part]], cores.count)


def clutter_solve(_cores: Cores) -> Action:
    """A whole search through these polygons: 3 via-points, population 25, at most 200 iterations."""
    start = STARTS["start_0.10_0.20"]
    problem = JointSpaceProblem(OptimalBasis.uniform(3), LIMITS, start, GOAL, terms=(CLUTTER.term(),))
    prior, config = problem.prior(), VpstoConfig(population=25, iterations=200)
    seeds = itertools.count()

    def solve() -> None:
        search(prior, problem.evaluate, config, np.random.default_rng(next(seeds)))

    return solve


def key_timing(_cores: Cores) -> Action:
    """Optimal timing of 4 given via-points of 7 joints."""
    keys = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 7))
    limits = fr3_pusher().limits
    return lambda: time_key_positions(keys, limits)


def checks_per_second(seconds: float) -> dict[str, float]:
    """The rate that :func:`posture_checks` stands for."""
    return {"checks_per_s": POSTURES / seconds}


MILLION_CHECKS = Wanted("checks_per_s", 1e6, ">= 1 million checks/s", at_least=True)
ROWS = (
    Row("basis_n7_via4_k50", basis, wanted=at_most(0.3)),
    Row("basis_n7_via4_cached", cached_basis),
    *(Row(f"synthesis_b{b}_n{n}_via4_k50", partial(synthesis, n, b)) for n in DOF for b in BATCHES),
    Row("synthesis_b100_n7_via4_k50", arm_synthesis, wanted=at_most(0.4)),
    Row("evaluate_n7_k1000", partial(evaluation, 1), wanted=at_most(0.3)),
    Row("evaluate_state_n7_k1000", partial(evaluation, 3)),
    *(Row(f"sep_cma_d{d}_m{POPULATION}", partial(search_step, "sep-cma", d)) for d in DIMENSIONS),
    *(Row(f"cma_d{d}_m{POPULATION}", partial(search_step, "cma", d)) for d in DIMENSIONS),
    Row("vpsto_iteration_b64_n7_box", vpsto_iteration, wanted=at_most(2.0)),
    Row("posture_checks", posture_checks, derived=checks_per_second, wanted=MILLION_CHECKS),
    Row("arm_paths_b64", arm_paths),
    Row("planar_paths_b64", planar_paths),
    Row("solve_clutter_2d", clutter_solve, wanted=at_most(100.0)),
    Row("key_timing_n7_via4", key_timing),
)
