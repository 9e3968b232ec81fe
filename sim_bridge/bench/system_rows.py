"""Rows of the running system: planner, simulated cell, driver node, start of a process."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import numpy as np

from sim_bridge.bench.measuring import Action, Cores, Row, Wanted, at_most
from sim_bridge.experiments.pushing.loop import push_box_loop
from sim_bridge.simulation import Simulation
from vpsto_ros.planning.goal import PlanarGoal

FIRST_PLAN = "from sim_bridge.experiments.pushing.loop import push_box_loop; push_box_loop().advance(0.5)"
GOALS = ((0.55, 0.12), (0.48, -0.12), (0.58, 0.0), (0.45, 0.1))


def mpc_step(_cores: Cores) -> Action:
    """Replanning as in the demo, two seconds of closed loop, then a new goal; processor time of each plan."""
    goals = [PlanarGoal(np.array(point), None) for point in GOALS]
    loop = push_box_loop()
    loop.goal = lambda now: goals[int(now / 2.0) % len(goals)]

    def planned() -> list[float]:
        record = loop.recording
        first = len(record.compute)
        loop.advance(2.0)
        steps = zip(record.compute[first:], record.mode[first:], strict=True)
        return [seconds for seconds, mode in steps if mode not in ("wait", "hold")]

    return planned


def driver(_cores: Cores) -> Action:
    """One simulated second without ROS: controller, physics, camera and limits at 1 kHz."""
    simulation = Simulation()
    return lambda: simulation.advance(1.0)


def driver_node(cores: Cores) -> Action:
    """One simulated second of the driver's node, which publishes at its rates, as fast as it can."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.parameter import Parameter

    from sim_bridge.demo.processes import private_network
    from sim_bridge.franka_driver import SLICE, FrankaDriver
    from sim_bridge.spinning import Spinning

    rclpy.init(domain_id=int(private_network()["ROS_DOMAIN_ID"]))
    cores.cleanup.callback(rclpy.try_shutdown)
    node = FrankaDriver("franka_driver", parameter_overrides=[Parameter("real_time_factor", value=100.0)])
    cores.cleanup.callback(node.destroy_node)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    cores.cleanup.callback(executor.shutdown, timeout_sec=2.0)
    node.start()
    cores.cleanup.enter_context(Spinning(executor))

    def second() -> None:
        for _ in range(round(1.0 / SLICE)):
            node.advance()

    return second


def real_time_factor(seconds: float) -> dict[str, float]:
    """How much faster than reality one simulated second is."""
    return {"real_time_factor": 1.0 / seconds}


def first_plan(_cores: Cores) -> Action:
    """From the start of a fresh process until its first plan has reached the simulated arm, without ROS.

    What the four nodes take from their start to the first plan, the demo measures and prints.
    """
    command = [sys.executable, "-c", FIRST_PLAN]
    return lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


REAL_TIME = Wanted("real_time_factor", 20.0, ">= 20 x real time", at_least=True)
ROWS: tuple[Row, ...] = (
    Row("mpc_step_push_box", mpc_step, calls=4, own_times=True, wanted=at_most(16.0, "p99_ms")),
    Row("driver", driver, calls=4, derived=real_time_factor, wanted=REAL_TIME),
    Row("first_plan", first_plan, calls=1),
)
if importlib.util.find_spec("rclpy"):
    ROWS += (Row("driver_node", driver_node, calls=2, derived=real_time_factor),)
