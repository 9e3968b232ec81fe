"""Pushing boxes of unknown mass, friction and centre of mass to a goal, closed loop (4.5.2).

Every run draws a box, a start, a goal and one knock by hand. The planner knows the outline of the box and
what a camera says; it has a
contact model with uniform pressure and one friction value. The same runs are repeated with the thesis's end
point, without warm start and
with a scripted straight push.
"""

import argparse
import dataclasses

import numpy as np

from sim_bridge.experiments.pushing.experiment import PushingExperiment, Targets, Variant
from sim_bridge.experiments.pushing.straight_push import StraightPushScript
from sim_bridge.experiments.pushing.trials import Trial, random_knock, random_plant
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.planning.mpc import OnlineConfig
from vpsto_ros.planning.pushing_config import PushingCosts, PushingMpcConfig

CONFIG = PushingMpcConfig()


def random_trial(seed: int) -> Trial:
    """Box sides 8-16 cm, start and goal at least 8 cm apart, a knock of 5-10 cm at 4-6 s, 30 s in all."""
    rng = np.random.default_rng([seed, 0])
    sides = rng.uniform(0.08, 0.16, 2)
    plant = random_plant(PlanarShape.box(*sides), 0.5 * sides, rng)
    start, goal = _poses(rng)
    while np.hypot(*(goal - start)[:2]) < 0.08:
        start, goal = _poses(rng)
    return Trial(seed, plant, start, goal, random_knock(rng), float(rng.uniform(4.0, 6.0)), 30.0)


def _poses(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform([0.46, -0.22, -np.pi], [0.60, 0.22, np.pi], (2, 3))


THREE_MODELS = dataclasses.replace(CONFIG.costs, pressure_spread=0.25, friction_spread=0.6)

VARIANTS = (
    Variant("vpsto", "VP-STO, free end point", CONFIG),
    Variant(
        "thesis_end_point",
        "end point at the box centre",
        dataclasses.replace(CONFIG, costs=PushingCosts(end_point="object")),
    ),
    Variant(
        "three_models", "averaged over three contact models", dataclasses.replace(CONFIG, costs=THREE_MODELS)
    ),
    Variant("no_contact_plan", "without the contact planner", CONFIG, contact_planner=False),
    Variant(
        "no_warm_start",
        "without warm start",
        dataclasses.replace(CONFIG, online=OnlineConfig(warm_start=False)),
    ),
    Variant("straight_push", "scripted straight push", CONFIG, StraightPushScript),
)

EXPERIMENT = PushingExperiment(
    name="push_box",
    title="Push a box: within 10 mm, held 1 s, within 30 s",
    random_trial=random_trial,
    variants=VARIANTS,
    targets=Targets(success_rate=0.98, median_time_to_goal=4.0),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options beyond those that every experiment has."""
    EXPERIMENT.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the experiment; 0 when the planner meets its goals."""
    return EXPERIMENT.run(arguments)
