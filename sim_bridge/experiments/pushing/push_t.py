"""Pushing a T of two 4 x 12 cm bars to a goal pose, position and orientation, closed loop.

Half turns and long shifts among the runs: pushing sequences come out of replanning, there is no value
function. The T's mass, friction and
centre of mass vary and are unknown to the planner.
"""

import argparse
import dataclasses

import numpy as np

from sim_bridge.experiments.pushing.experiment import PushingExperiment, Targets, Variant
from sim_bridge.experiments.pushing.trials import Trial, random_plant
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.optimization.vpsto import VpstoConfig
from vpsto_ros.planning.goal import wrap_angle
from vpsto_ros.planning.mpc import OnlineConfig
from vpsto_ros.planning.pushing_config import PushingCosts, PushingMpcConfig

CONFIG = PushingMpcConfig(
    seeds=6,
    costs=PushingCosts(horizon=5.0),
    online=OnlineConfig(search=VpstoConfig(population=24, iterations=5, starts=3)),
)


def random_trial(seed: int) -> Trial:
    """Start and goal anywhere, turned by anything; at least 5 cm or 30 degrees apart; 60 s, no knock."""
    rng = np.random.default_rng([seed, 1])
    shape = PlanarShape.tee()
    plant = random_plant(shape, np.array([0.06, 0.08]), rng)
    start, goal = _poses(rng)
    while np.hypot(*(goal - start)[:2]) < 0.05 and abs(wrap_angle(goal[2] - start[2])) < np.radians(30.0):
        start, goal = _poses(rng)
    return Trial(seed, plant, start, goal, None, 0.0, 60.0, yaw_tolerance=float(np.radians(5.0)))


def _poses(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform([0.47, -0.18, -np.pi], [0.59, 0.18, np.pi], (2, 3))


THREE_MODELS = dataclasses.replace(CONFIG.costs, pressure_spread=0.25, friction_spread=0.6)
NO_WARM_START = dataclasses.replace(CONFIG.online, warm_start=False)

VARIANTS = (
    Variant("vpsto", "VP-STO, three starts", CONFIG),
    Variant(
        "one_start", "one start of the same budget",
        dataclasses.replace(CONFIG, online=OnlineConfig(search=VpstoConfig(population=72, iterations=5))),
    ),
    Variant(
        "three_models", "averaged over three contact models", dataclasses.replace(CONFIG, costs=THREE_MODELS)
    ),
    Variant("no_warm_start", "without warm start", dataclasses.replace(CONFIG, online=NO_WARM_START)),
)  # fmt: skip

EXPERIMENT = PushingExperiment(
    name="push_t",
    title="Push a T: within 10 mm and 5 degrees, held 1 s, within 60 s",
    random_trial=random_trial,
    variants=VARIANTS,
    targets=Targets(success_rate=0.95, replan_p99=0.040),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options beyond those that every experiment has."""
    EXPERIMENT.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the experiment; 0 when the planner meets its goals."""
    return EXPERIMENT.run(arguments)
