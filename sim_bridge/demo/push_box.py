"""``vpsto demo push_box``: an arm with a rod pushes a box to a target that jumps and drifts."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from sim_bridge.demo import running
from sim_bridge.demo.pushing import PushingDemo
from sim_bridge.demo.scenario import Phase, Scenario


def box_scenario(rng: np.random.Generator, duration: float = 90.0, drift_time: float = 12.0) -> Scenario:
    """Three jumps of the target with one knock in between, a drift, and a standing target at the end.

    Args:
        rng: chooses the targets and the knock.
        duration: the longest the scenario may take [s].
        drift_time: how long the target drifts [s], but at most a fifth of the duration.
    """
    drift = min(drift_time, 0.2 * duration)
    jump = (duration - drift) / 5.0
    return Scenario(
        rng,
        [
            Phase("target 1", jump),
            Phase("target 2", jump),
            Phase("knock", jump, "knock"),
            Phase("target 3", jump),
            Phase("drift", drift, "drift"),
            Phase("rest", jump, "rest"),
        ],
    )


def success(summary: dict[str, Any]) -> str:
    """What a good run achieved."""
    times = [phase["time_to_reach_s"] for phase in summary["phases"] if phase["judged"]]
    return (
        f"the box came to rest at every target within {max(times):.1f} s, kept "
        f"{summary['drift']['median_distance_m'] * 1e3:.0f} mm to the drifting one (median) and ended "
        f"{summary['final_error_m'] * 1e3:.1f} mm from it"
    )


DEMO = PushingDemo("push_box", "A simulated FR3 pushes a box to a moving target", box_scenario, success)


def run(arguments: argparse.Namespace) -> int:
    """Run the demo, see :func:`sim_bridge.demo.running.run`."""
    return running.run(DEMO, arguments)
