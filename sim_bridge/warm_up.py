"""``vpsto warm-up``: compile every kernel into the disk cache by running the closed loop for a moment."""

from __future__ import annotations

import argparse
import time

import numpy as np

from sim_bridge.experiments.pushing_loop import PushingLoop
from sim_bridge.simulation import Simulation
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.contact.pushing import PushingModel
from vpsto_ros.planning.contact import ContactPlannerConfig, PushContactPlanner
from vpsto_ros.planning.goal import PlanarGoal
from vpsto_ros.planning.pushing import PushingMpc
from vpsto_ros.planning.pushing_config import PushingMpcConfig
from vpsto_ros.robot.kinematics import fr3_pusher


def push_box_loop(goal: PlanarGoal | None = None, seed: int = 0) -> PushingLoop:
    """The demo's closed loop in lock-step: default cell, default planner, compiled and ready.

    Args:
        goal: where the box shall go, by default 11 cm aside.
        seed: of camera and search.
    """
    model = PushingModel(PlanarShape.box(0.12, 0.12), PlanarShape.disc(0.015))
    planner = PushingMpc(PushingMpcConfig(), model, fr3_pusher(), np.random.default_rng(seed))
    planner.warm_up()
    target = goal or PlanarGoal(np.array([0.55, 0.10]), None)
    contact_planner = PushContactPlanner(ContactPlannerConfig(), model)
    return PushingLoop(Simulation(seed=seed), planner, contact_planner, lambda now: target)


def run(_arguments: argparse.Namespace | None = None) -> int:
    """Run the loop until the first plan has reached the simulated arm.

    Returns:
        0.
    """
    began = time.perf_counter()
    loop = push_box_loop()
    loop.advance(0.5)
    print(f"kernels ready after {time.perf_counter() - began:.1f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(run())
