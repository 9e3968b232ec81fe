"""``vpsto demo air_hockey``: an iiwa with a mallet shoots pucks at a goal."""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim_bridge.demo import running
from sim_bridge.demo.settings import Settings
from sim_bridge.demo.shots import GOAL, ShootingScript, Shot
from sim_bridge.demo.verdict import Chart, Demo
from sim_bridge.hockey.rules import KINDS
from sim_bridge.report.charts import compute_chart, joint_chart
from sim_bridge.report.hockey_charts import shot_chart, table_view
from sim_bridge.report.page import Table, count, number, planning_rows
from sim_bridge.report.recording import Recording, Status
from sim_bridge.report.stage import AirHockeyStage, Stage
from sim_bridge.report.summary import DRIVER, PLANNER, RunFacts, common_failures, common_figures
from vpsto_ros.robot.iiwa import iiwa14

REQUIRED_SHARE = 0.8
"""Share of the pucks that has to end in the goal."""


@dataclasses.dataclass(frozen=True)
class AirHockeyDemo(Demo):
    """Ten pucks, one after the other."""

    def script(self, settings: Settings, rng: np.random.Generator, duration: float) -> ShootingScript:
        """Pucks that the driver puts where its own seed says."""
        return ShootingScript(duration)

    def stage(self, settings: Settings) -> Stage:
        """Table and robot."""
        return AirHockeyStage(settings.driver.hockey.scene)

    def summarize(
        self, recording: Recording, script: ShootingScript, settings: Settings, facts: RunFacts
    ) -> dict[str, Any]:
        """Everything that ``summary.json`` holds."""
        end = script.end if script.finished else float(recording.object.time[-1])
        summary = {
            **common_figures(recording, iiwa14(), script.start, end, facts),
            **shot_figures(script.shots, script.count),
            "rule_violations": rule_violations(recording.diagnostics.get(DRIVER, [])),
        }
        summary["failures"] = [*failures(summary), *facts.trouble]
        summary["success"] = not summary["failures"]
        return summary

    def success(self, summary: dict[str, Any]) -> str:
        """What a good run achieved."""
        return (
            f"{summary['scored']} of {summary['pucks']} pucks ended in the goal, predicted were "
            f"{summary['predicted']:.1f}, at {summary['goal_speed_m_s']:.1f} m/s on average; every rule of "
            "play was kept"
        )

    def tables(self, summary: dict[str, Any]) -> list[Table]:
        """Figures, and a row for each shot."""
        broken = summary["rule_violations"]
        rules = "unknown" if broken is None else ", ".join(f"{k}: {n} ms" for k, n in broken.items() if n)
        figures = [
            ["figure", "value"],
            ["pucks that ended in the goal", f"{summary['scored']} of {summary['pucks']}"],
            ["sum of the predicted chances", number(summary["predicted"], 1.0, "", 1)],
            ["mean speed at the goal line", number(summary["goal_speed_m_s"], 1.0, "m/s", 2)],
            ["rules that were broken", rules or "none"],
            ["limit violations", str(summary["limit_violations"])],
            ["trajectories that the controller refused", count(summary["refused_trajectories"])],
            *planning_rows(summary),
        ]
        shots = [["shot", "outcome", "predicted", "speed after the touch", "at the goal", "took"]]
        for index, shot in enumerate(summary["shots"], 1):
            speeds = [number(shot[key], 1.0, "m/s", 2) for key in ("speed_m_s", "goal_speed_m_s")]
            chance, took = number(shot["chance"], 100.0, "%", 0), number(shot["took_s"], 1.0, "s", 1)
            shots.append([str(index), shot["outcome"], chance, *speeds, took])
        return [("What was measured", figures), ("What happened", shots)]

    def charts(
        self, out: Path, recording: Recording, summary: dict[str, Any], settings: Settings
    ) -> list[Chart]:
        """Shots, the ways of the pucks, joints and compute times."""
        robot = iiwa14()
        charts = [
            (out / "shots.png", "Predicted chance of each shot; its speed at the goal line if it scored."),
            (out / "table.png", "The table from above: where pucks were put, and how they went on."),
            (out / "joints.png", "Joint velocities and torques as shares of their limits."),
            (out / "compute.png", "Compute time of a planning step as the planner reports it."),
        ]
        shot_chart(charts[0][0], summary["shots"])
        table_view(charts[1][0], recording, summary["shots"])
        joint_chart(charts[2][0], recording, robot.limits, robot.torque_limits)
        compute_chart(charts[3][0], recording, PLANNER)
        return charts


def shot_figures(shots: Sequence[Shot], pucks: int) -> dict[str, Any]:
    """How many shots scored, what was predicted, and each of them."""
    scored = [shot for shot in shots if shot.outcome == GOAL]
    chances = [shot.chance for shot in shots if math.isfinite(shot.chance)]
    return {
        "pucks": pucks,
        "scored": len(scored),
        "predicted": float(sum(chances)),
        "goal_speed_m_s": float(np.mean([shot.goal_speed for shot in scored])) if scored else math.nan,
        "shots": [
            {
                "outcome": shot.outcome or "not over",
                "start_s": shot.start,
                "end_s": shot.end,
                "took_s": shot.end - shot.start,
                "place_m": [float(value) for value in shot.place],
                "chance": shot.chance,
                "speed_m_s": shot.speed,
                "goal_speed_m_s": shot.goal_speed,
            }
            for shot in shots
        ],
    }


def rule_violations(statuses: Sequence[Status]) -> dict[str, int] | None:
    """In how many control cycles each rule of play was broken; None when the driver said nothing of it."""
    if not statuses:
        return None
    counts = {kind: statuses[-1].number(f"rule.{kind}.instants") for kind in KINDS}
    return {kind: int(n) for kind, n in counts.items()} if all(map(math.isfinite, counts.values())) else None


def failures(summary: dict[str, Any]) -> list[str]:
    """What keeps a run from being a success, in words; empty when nothing does."""
    found, pucks, least = [], summary["pucks"], math.ceil(REQUIRED_SHARE * summary["pucks"])
    if summary["scored"] < least:
        found.append(f"{summary['scored']} of {pucks} pucks ended in the goal, required are {least}")
    broken = summary["rule_violations"]
    if broken is None:
        found.append("the driver did not say whether the rules of play were kept")
    else:
        found += [f"the rule '{kind}' was broken for {n} ms" for kind, n in broken.items() if n]
    return [*found, *common_failures(summary)]


DEMO = AirHockeyDemo("air_hockey", "A simulated KUKA iiwa shoots pucks at a goal")


def run(arguments: argparse.Namespace) -> int:
    """Run the demo, see :func:`sim_bridge.demo.running.run`."""
    return running.run(DEMO, arguments)
