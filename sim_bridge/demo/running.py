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
from sim_bridge.demo.script import Script
from sim_bridge.demo.settings import Settings
from sim_bridge.demo.verdict import Demo, Outcome, give_up, verdict, write_summary
from sim_bridge.report.bag import BagRecorder
from sim_bridge.report.recording import Recording
from sim_bridge.report.summary import DRIVER, PLANNER, RunFacts
from vpsto_ros.exceptions import VpstoError

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
    for stale in ("report.html", "summary.json", "video.mp4"):
        (out / stale).unlink(missing_ok=True)  # of an earlier run, should this one fail
    settings = Settings.load(demo.name, arguments.seed, arguments.real_time_factor)
    bag = BagRecorder(out / "bag")
    try:
        outcome = _run_nodes(demo, arguments, settings, bag, out)
    finally:
        bag.close()
    script = outcome.script
    recording = Recording.from_bag(out / "bag", demo.stage(settings).height)
    if recording.duration(script.start) < SHORTEST_RUN:
        return give_up(out, arguments.seed, outcome)
    trouble = (outcome.first_plan, outcome.elapsed, outcome.trouble)
    facts = RunFacts(arguments.seed, *trouble, settings.planner_rate)
    summary = demo.summarize(recording, script, settings, facts)
    write_summary(out, summary)
    print("making pictures, replay and video ...", flush=True)
    notes = write_artifacts(out, demo, recording, summary, settings, script.start)
    print(verdict(demo, summary))
    for note in notes:
        print(note)
    print(f"report: {out / 'report.html'}   bag for Foxglove: {out / 'bag'}")
    return 0 if summary["success"] else 1


def _run_nodes(
    demo: Demo, arguments: argparse.Namespace, settings: Settings, bag: BagRecorder, out: Path
) -> Outcome:
    """From the first process to the last."""
    script = demo.script(settings, np.random.default_rng(arguments.seed), arguments.duration)
    outcome = Outcome(script)
    environment = private_network()
    began = time.monotonic()
    with ProcessGroup(out / "logs", environment) as processes:
        for name, module in NODES.items():
            code = f"import sys; from {module} import main; sys.exit(main())"
            processes.start(name, [sys.executable, "-c", code, *settings.ros_arguments(name)])
        # Whoever watches and records must not take time from those who plan and drive.
        os.nice(5)
        with _observer(bag, script, environment) as (observer, spinning):
            _wait_until_active(observer, spinning, processes, script)
            with live_view(arguments.viewer, demo.stage(settings), lambda: demo.target(script)) as show:
                started = time.monotonic()
                observer.begin()
                patience = 60.0 + 4.0 * arguments.duration / min(arguments.real_time_factor, 1.0)
                _watch(observer, spinning, processes, script, show, started + patience)
            outcome.elapsed = time.monotonic() - started
            _await_reports(observer, script)
            if observer.first_plan is not None:
                outcome.first_plan = observer.first_plan - began
            ended = processes.ended()
        if not script.finished and not ended:
            outcome.trouble.append("the simulation did not get to the end in time")
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
    bag: BagRecorder, script: Script, environment: dict[str, str]
) -> Iterator[tuple[Observer, NodeThread]]:
    # Signals are ours: Ctrl-C must reach the code that stops the processes.
    rclpy.init(domain_id=int(environment["ROS_DOMAIN_ID"]), signal_handler_options=SignalHandlerOptions.NO)
    observer = Observer(bag, script)
    try:
        with NodeThread(observer) as spinning:
            yield observer, spinning
    finally:
        observer.destroy_node()
        rclpy.try_shutdown()


def _wait_until_active(
    observer: Observer, spinning: NodeThread, processes: ProcessGroup, script: Script
) -> None:
    print("starting the nodes; the first time they compile for half a minute ...", flush=True)
    activity = Activity(observer, tuple(NODES))
    deadline = time.monotonic() + START_PATIENCE
    # A planner that is given a task before it knows of the object would seem to miss its first cycles.
    while not (
        activity.poll()
        and script.ready()
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


def _await_reports(observer: Observer, script: Script) -> None:
    """Wait for the diagnostics that see all that happened, but not for a node that hangs."""
    deadline = time.monotonic() + REPORT_PATIENCE
    end = script.end if script.finished else -math.inf
    while not all(observer.reported_since(name, end) for name in (DRIVER, PLANNER)):
        if time.monotonic() > deadline:
            return
        time.sleep(0.02)


def _watch(
    observer: Observer,
    spinning: NodeThread,
    processes: ProcessGroup,
    script: Script,
    show: Any,
    deadline: float,
) -> None:
    """Show progress until the script is over, a process has ended or the deadline has passed.

    Raises:
        VpstoError: the observer failed.
    """
    with tqdm(total=100, disable=None, bar_format="{desc} |{bar}| {elapsed}") as bar:
        while not script.finished and not processes.ended() and time.monotonic() < deadline:
            time.sleep(0.05)
            spinning.check()
            show(observer)
            _tell(script)
            bar.set_description_str(script.label(), refresh=False)
            bar.n = round(100 * script.progress)
            bar.refresh()
    spinning.check()
    _tell(script)


def _tell(script: Script) -> None:
    for sentence in script.news():
        tqdm.write(sentence)


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt
