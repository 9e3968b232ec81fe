"""``vpsto bench``: how long the building blocks take on this machine."""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sim_bridge.simulation import Simulation
from sim_bridge.warm_up import push_box_loop
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.contact.pushing import PushingModel, rollout
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.optimization.cma import make_strategy
from vpsto_ros.planning.goal import PlanarGoal
from vpsto_ros.priors.smoothness import smoothness_prior
from vpsto_ros.robot.inverse_kinematics import TableMap
from vpsto_ros.robot.kinematics import forward_kinematics_batch, fr3_pusher
from vpsto_ros.trajectory import OptimalBasis, synthesize_batch

Row = dict[str, Any]


def run(arguments: argparse.Namespace) -> int:
    """Measure, print a table and write JSON if asked to.

    Args:
        arguments: json (file or None) and only (part of a name or None).

    Returns:
        0.

    Raises:
        InvalidInputError: when no row has such a name.
    """
    wanted = {
        name: measure for name, measure in BENCHMARKS.items() if not arguments.only or arguments.only in name
    }
    if not wanted:
        raise InvalidInputError(f"no row is called {arguments.only!r}; there are {', '.join(BENCHMARKS)}")
    rows = []
    print(f"{'name':34s} {'cores':>5s} {'p50 [ms]':>10s} {'p99 [ms]':>10s} {'max [ms]':>10s}")
    for name, measure in wanted.items():
        row = {"name": name, **measure()}
        rows.append(row)
        extra = f"   {row['real_time_factor']:.1f} x real time" if "real_time_factor" in row else ""
        times = " ".join(f"{row[key]:10.3f}" for key in ("p50_ms", "p99_ms", "max_ms"))
        print(f"{name:34s} {row['cores']:5d} {times}{extra}", flush=True)
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(rows, indent=2) + "\n")
    return 0


def synthesis() -> Row:
    """100 trajectories of 7 joints through 4 via-points with minimal duration, 50 samples each."""
    robot, rng, basis = fr3_pusher(), np.random.default_rng(0), OptimalBasis.uniform(4)
    keys = rng.uniform(*robot.position_range, (100, 6, 7))
    rest = np.zeros(7)
    return repeat(lambda: synthesize_batch(basis, keys, rest, rest, robot.limits, 50), 2000)


def vpsto_iteration() -> Row:
    """One iteration for 7 joints: 64 candidates sampled, synthesised and rolled out on a box."""
    robot, basis = fr3_pusher(), OptimalBasis.uniform(3)
    rest = np.zeros(7)
    start, end = TableMap(robot, 0.02).joints([(0.38, 0.0), (0.55, 0.05)])
    keys = np.empty((64, 5, 7))
    keys[:, 0] = start
    prior = smoothness_prior(basis, start, rest, None, rest, 2.0, scale=0.1)
    mean = np.concatenate([start + share * (end - start) for share in np.linspace(0.25, 1.0, 4)])
    search = make_strategy("sep-cma", mean.size, 64, np.random.default_rng(0))
    model = PushingModel(PlanarShape.box(0.12, 0.12), PlanarShape.disc(0.015))
    box, goal = np.array([0.47, 0.0, 0.0]), np.array([0.6, 0.05])

    def iterate() -> None:
        samples = search.ask()
        keys[:, 1:] = (mean + samples @ prior.cholesky.T).reshape(64, 4, 7)
        batch = synthesize_batch(basis, keys, rest, rest, robot.limits, 50)
        tips = forward_kinematics_batch(batch.position.reshape(-1, 7)).reshape(64, 50, 3)
        poses = rollout(model, box, np.ascontiguousarray(tips[:, :, :2])).object_pose
        search.tell(samples, batch.duration + 60.0 * np.linalg.norm(poses[:, -1, :2] - goal, axis=1))

    return repeat(iterate, 500)


def mpc_step() -> Row:
    """Replanning as in the demo, ten seconds of closed loop, a goal that jumps every two; processor time."""
    goals = [
        PlanarGoal(np.array(point), None) for point in ((0.55, 0.12), (0.48, -0.12), (0.58, 0.0), (0.45, 0.1))
    ]
    with one_core():
        loop = push_box_loop()
        loop.goal = lambda now: goals[int(now / 2.0) % len(goals)]
        loop.advance(10.0)
    planned = [
        time
        for time, mode in zip(loop.recording.compute, loop.recording.mode, strict=True)
        if mode not in ("wait", "hold")
    ]
    return statistics(planned, cores=1)


def driver() -> Row:
    """One simulated second without ROS: controller, physics, camera and limits at 1 kHz."""
    with one_core():
        simulation = Simulation()
        seconds = measure(lambda: simulation.advance(1.0), 10)
    row = statistics(seconds, cores=1)
    return {**row, "real_time_factor": 1e3 / row["p50_ms"]}


def driver_node() -> Row:
    """One simulated second of the driver's node, which publishes at its rates, as fast as it can."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.parameter import Parameter

    from sim_bridge.demo.processes import private_network
    from sim_bridge.franka_driver import SLICE, FrankaDriver

    with one_core():
        rclpy.init(domain_id=int(private_network()["ROS_DOMAIN_ID"]))
        node = FrankaDriver("franka_driver", parameter_overrides=[Parameter("real_time_factor", value=100.0)])
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        thread = threading.Thread(target=executor.spin, daemon=True)

        def second() -> None:
            for _ in range(round(1.0 / SLICE)):
                node.advance()

        try:
            node.start()
            thread.start()
            seconds = measure(second, 5)
        finally:
            executor.shutdown(timeout_sec=2.0)
            thread.join(timeout=2.0)
            node.destroy_node()
            rclpy.try_shutdown()
    row = statistics(seconds, cores=1)
    return {**row, "real_time_factor": 1e3 / row["p50_ms"]}


def first_plan() -> Row:
    """From the start of a fresh process until its first plan has reached the simulated arm, without ROS.

    What the four nodes take from their start to the first plan, the demo measures and prints.
    """
    command = [sys.executable, "-m", "sim_bridge.warm_up"]
    with one_core():
        seconds = measure(lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL), 3)
    return statistics(seconds, cores=1)


BENCHMARKS: dict[str, Callable[[], Row]] = {
    "synthesis_b100_n7_via4_k50": synthesis,
    "vpsto_iteration_b64_n7_box": vpsto_iteration,
    "mpc_step_push_box": mpc_step,
    "driver": driver,
    "first_plan": first_plan,
}
if importlib.util.find_spec("rclpy"):
    BENCHMARKS["driver_node"] = driver_node


def repeat(action: Callable[[], object], times: int) -> Row:
    """Statistics of an action on one core, after it has been compiled."""
    with one_core():
        measure(action, max(times // 20, 3))
        return statistics(measure(action, times), cores=1)


def measure(action: Callable[[], object], times: int) -> list[float]:
    """How long each of several calls takes [s]."""
    durations = []
    for _ in range(times):
        began = time.perf_counter()
        action()
        durations.append(time.perf_counter() - began)
    return durations


def statistics(seconds: list[float], *, cores: int) -> Row:
    """A row's numbers from durations [s]."""
    p50, p99 = np.percentile(seconds, (50, 99)) * 1e3
    return {"cores": cores, "p50_ms": float(p50), "p99_ms": float(p99), "max_ms": float(max(seconds) * 1e3)}


@contextlib.contextmanager
def one_core() -> Iterator[None]:
    """Keep this process and its children on a single core, where the operating system can do that."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
