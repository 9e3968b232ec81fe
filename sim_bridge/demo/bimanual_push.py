"""``vpsto demo bimanual_push``: two arms push a can that is hardly known, and that a hand moves away."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from sim_bridge.demo import running
from sim_bridge.demo.pushing import PushingDemo
from sim_bridge.demo.scenario import Area, Phase, Scenario

CAN_DISTANCE = 0.015
"""How near a can has to be: the planner rests within 8 mm of its estimate and resumes beyond 12 mm, and the
estimate of a noisy, late camera errs by some millimetres [m]."""
CAN_AREA, KNOCK_AREA = Area((0.45, 0.56), (-0.13, 0.13)), Area((0.41, 0.6), (-0.2, 0.2))
"""Where targets are, and where knocks may leave the can: inside the planner's default workspace."""
TABLE_CENTRE = (0.5, 0.0)
"""Of the part of the table that both arms reach [m]."""


def can_scenario(rng: np.random.Generator, duration: float = 90.0) -> Scenario:
    """To the centre of the table, knocked away twice; to another place, knocked away once more."""
    each = duration / 5.0
    return Scenario(
        rng,
        [
            Phase("centre", each, goal=np.array(TABLE_CENTRE)),
            Phase("knock 1", each, "knock"),
            Phase("knock 2", each, "knock"),
            Phase("elsewhere", each),
            Phase("knock 3", each, "knock"),
        ],
        CAN_AREA,
        CAN_DISTANCE,
        jump=0.1,
        knock_area=KNOCK_AREA,
    )


def success(summary: dict[str, Any]) -> str:
    """What a good run achieved."""
    longest = max(phase["time_to_reach_s"] for phase in summary["phases"])
    near, left = 1e3 * summary["reached_distance_m"], 1e3 * summary["final_error_m"]
    return (
        f"the can came to rest within {near:.0f} mm of every target, and after every knock, within "
        f"{longest:.1f} s, and ended {left:.1f} mm from it; the arms never touched each other"
    )


DEMO = PushingDemo(
    "bimanual_push", "Two simulated FR3 push a can by a belief over where it is", can_scenario, success,
    strict=True,
)  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Run the demo, see :func:`sim_bridge.demo.running.run`."""
    return running.run(DEMO, arguments)
