"""Runs a demo: four nodes in processes of their own, a scenario, a verdict and pictures."""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import signal
import sys
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.signals import SignalHandlerOptions
from tqdm import tqdm

from sim_bridge.demo.artifacts import write_artifacts
from sim_bridge.demo.live_view import live_view
from sim_bridge.demo.observer import Activity, NodeThread, Observer
from sim_bridge.demo.processes import ProcessGroup, private_network
from sim_bridge.demo.scenario import Phase, Scenario
from sim_bridge.demo.settings import Settings
from sim_bridge.demo.verdict import Demo, Outcome, give_up, verdict, write_summary
from sim_bridge.report.bag import BagRecorder
from sim_bridge.report.recording import Recording
from sim_bridge.report.summary import DRIVER, PLANNER, RunFacts, summarize
from vpsto_ros.exceptions import VpstoError
from vpsto_ros.robot.tool_plane import ToolPlane

NODES = {
    "franka_driver": "sim_bridge.franka_driver",
    "state_estimator": "vpsto_ros.nodes.state_estimator",
    "contact_planner": "vpsto_ros.nodes.contact_planner",
    "mpc_planner": "vpsto_ros.nodes.mpc_planner",
}
START_PATIENCE = 180.0
"""How long the nodes may take to become active [s]; without a kernel cache they compile first."""
REPORT_PATIENCE = 3.0
"""How long to wait for the nodes' last diagnostics [s]; they come once a second."""
SHORTEST_RUN = 0.2
"""A shorter recording [s] cannot be drawn."""


def run(demo: Demo, arguments: argparse.Namespace) -> int:
    """Run a demo.

    Args:
        demo: which.
        arguments: seed, duration [s], out, viewer and real_time_factor, as the command line gives them.

    Returns:
        0 when everything went as it should, else 1.

    Raises:
        VpstoError: when the nodes did not start.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    out = Path(arguments.out)
    out.mkdir(parents=True, exist_ok=True)
    settings = Settings.load(demo.name, arguments.seed, arguments.real_time_factor)
    bag = BagRecorder(out / "bag")
    try:
        outcome = _run_nodes(demo, arguments, settings, bag, out)
    finally:
        bag.close()
    recording = Recording.from_bag(out / "bag", settings.scene.plant.height)
    if recording.duration() < SHORTEST_RUN or math.isnan(outcome.scenario.phases[0].start):
        return give_up(out, arguments.seed, outcome)
    trouble = (outcome.first_plan, outcome.elapsed, outcome.trouble)
    facts = RunFacts(arguments.seed, *trouble, settings.planner_rate)
    summary = summarize(recording, outcome.scenario, settings.tools, facts, strict=demo.strict)
    write_summary(out, summary)
    print("making pictures, replay and video ...", flush=True)
    sentence = verdict(demo, summary)
    notes = write_artifacts(out, recording, summary, settings, sentence, demo.title)
    print(sentence)
    for note in notes:
        print(note)
    print(f"report: {out / 'report.html'}   bag for Foxglove: {out / 'bag'}")
    return 0 if summary["success"] else 1


def _run_nodes(
    demo: Demo, arguments: argparse.Namespace, settings: Settings, bag: BagRecorder, out: Path
) -> Outcome:
    """From the first process to the last."""
    scenario = demo.scenario(np.random.default_rng(arguments.seed), arguments.duration)
    outcome = Outcome(scenario)
    environment = private_network()
    began = time.monotonic()
    with ProcessGroup(out / "logs", environment) as processes:
        for name, module in NODES.items():
            code = f"import sys; from {module} import main; sys.exit(main())"
            processes.start(name, [sys.executable, "-c", code, *settings.ros_arguments(name)])
        # Whoever watches and records must not take time from those who plan and drive.
        os.nice(5)
        with _observer(bag, scenario, settings.tools, environment) as (observer, spinning):
            _wait_until_active(observer, spinning, processes)
            with live_view(arguments.viewer, settings) as show:
                started = time.monotonic()
                observer.begin()
                patience = 60.0 + 4.0 * arguments.duration / min(arguments.real_time_factor, 1.0)
                _watch(observer, spinning, processes, scenario, show, started + patience)
            outcome.elapsed = time.monotonic() - started
            _await_reports(observer, scenario)
            if observer.first_plan is not None:
                outcome.first_plan = observer.first_plan - began
            ended = processes.ended()
        if not scenario.finished and not ended:
            outcome.trouble.append("the simulation did not get to the end of the scenario in time")
        processes.stop()
    outcome.trouble += _trouble(processes, ended)
    return outcome


def _trouble(processes: ProcessGroup, ended: Collection[str]) -> list[str]:
    """What is to be said about stopped processes, those that ended by themselves among them."""
    found = []
    for name, code in processes.exit_codes.items():
        if name not in ended and code == 0:
            continue
        what = f"ended during the run with status {code}" if name in ended else f"exited with status {code}"
        log = f"the last lines of {processes.log_path(name)}:\n{processes.last_lines(name)}\n"
        found.append(f"{name} {what}, {log}")
    return found


@contextlib.contextmanager
def _observer(
    bag: BagRecorder, scenario: Scenario, tools: ToolPlane, environment: dict[str, str]
) -> Iterator[tuple[Observer, NodeThread]]:
    # Signals are ours: Ctrl-C must reach the code that stops the processes.
    rclpy.init(domain_id=int(environment["ROS_DOMAIN_ID"]), signal_handler_options=SignalHandlerOptions.NO)
    observer = Observer(bag, scenario, tools)
    try:
        with NodeThread(observer) as spinning:
            yield observer, spinning
    finally:
        observer.destroy_node()
        rclpy.try_shutdown()


def _wait_until_active(observer: Observer, spinning: NodeThread, processes: ProcessGroup) -> None:
    print("starting the nodes; the first time they compile for half a minute ...", flush=True)
    activity = Activity(observer, tuple(NODES))
    deadline = time.monotonic() + START_PATIENCE
    # A planner that is told of a goal before it knows of the object would seem to miss its first cycles.
    while not (
        activity.poll()
        and observer.subscribers_of_goal() >= 2
        and observer.object_pose() is not None
        and observer.informed(PLANNER)
    ):
        spinning.check()
        for name in processes.ended():
            log = f"the last lines of {processes.log_path(name)}:\n{processes.last_lines(name)}"
            raise VpstoError(f"{name} ended while starting; {log}")
        if time.monotonic() > deadline:
            waiting = ", ".join(sorted(activity.waiting)) or "their topics"
            raise VpstoError(f"the nodes were not ready after {START_PATIENCE:.0f} s, waiting for {waiting}")
        time.sleep(0.02)


def _await_reports(observer: Observer, scenario: Scenario) -> None:
    """Wait for the diagnostics that see all of the scenario, but not for a node that hangs."""
    deadline = time.monotonic() + REPORT_PATIENCE
    end = scenario.phases[-1].end if scenario.finished else -math.inf
    while not all(observer.reported_since(name, end) for name in (DRIVER, PLANNER)):
        if time.monotonic() > deadline:
            return
        time.sleep(0.02)


def _watch(
    observer: Observer,
    spinning: NodeThread,
    processes: ProcessGroup,
    scenario: Scenario,
    show: Any,
    deadline: float,
) -> None:
    """Show progress until the scenario is over, a process has ended or the deadline has passed.

    Raises:
        VpstoError: the observer failed.
    """
    announced: set[str] = set()
    with tqdm(total=100, disable=None, bar_format="{desc} |{bar}| {elapsed}") as bar:
        while not scenario.finished and not processes.ended() and time.monotonic() < deadline:
            time.sleep(0.05)
            spinning.check()
            show(observer)
            _announce(scenario, announced)
            pose, goal = observer.object_pose(), observer.goal()
            if pose is not None and goal is not None:
                distance = float(np.linalg.norm(pose[:2] - goal)) * 1e3
                bar.set_description_str(
                    f"{scenario.phase.name:9s} {distance:5.0f} mm to target", refresh=False
                )
            bar.n = round(100 * scenario.progress)
            bar.refresh()
    spinning.check()
    _announce(scenario, announced)


def _announce(scenario: Scenario, announced: set[str]) -> None:
    for phase in scenario.phases:
        if math.isfinite(phase.end) and phase.name not in announced:
            announced.add(phase.name)
            tqdm.write(_sentence(phase, scenario))


def _sentence(phase: Phase, scenario: Scenario) -> str:
    if not phase.judged:
        median = float(np.median(scenario.drift_distances)) * 1e3
        return f"  {phase.name:9s}  the target moved at 2 cm/s; median distance {median:.0f} mm"
    if math.isnan(phase.reached):
        return f"  {phase.name:9s}  NOT reached within {phase.timeout:.0f} s"
    return f"  {phase.name:9s}  reached after {phase.time_to_reach:.1f} s"


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt
