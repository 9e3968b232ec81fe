"""Figures and verdict of a demo, computed from its recording alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sim_bridge.demo.scenario import DRIFT_MEDIAN_DISTANCE, DRIFT_SPEED, Scenario
from sim_bridge.report.recording import Command, JointSeries, Recording, Status
from vpsto_ros.robot.kinematics import Robot, forward_kinematics_batch
from vpsto_ros.trajectory import Limits, Trajectory

DRIVER, PLANNER = "franka_driver", "mpc_planner"
TORQUE_RATE = "limit.torque_rate.instants"
ALLOWED_DEADLINE_MISSES = 0.01
ALLOWED_HEIGHT_DEVIATION = 0.005


@dataclass(frozen=True)
class RunFacts:
    """What the recording cannot tell.

    Attributes:
        seed: of the run.
        first_plan: from the start of the processes to the first plan [s].
        elapsed: wall time while the scenario ran [s].
        trouble: processes that ended early or badly, in words.
        tool_height: nominal height of the tool's tip above the table [m].
    """

    seed: int
    first_plan: float
    elapsed: float
    trouble: Sequence[str]
    tool_height: float


def summarize(recording: Recording, scenario: Scenario, robot: Robot, facts: RunFacts) -> dict[str, Any]:
    """Everything that ``summary.json`` holds; ``success`` and ``failures`` are the verdict."""
    _, distance = recording.distance()
    limits = limit_violations(recording, robot)
    heights = forward_kinematics_batch(recording.joints.position)[:, 2]
    start, end = scenario.phases[0].start, recording.object.time[-1]
    summary: dict[str, Any] = {
        "success": False,
        "failures": [],
        "final_error_m": float(distance[-1]),
        "limit_violations": sum(limits.values()),
        "limit_violations_by_kind": limits,
        "mpc": planner_figures(recording, start, end),
        "time_to_first_plan_s": facts.first_plan,
        "tool_height_deviation_m": float(np.abs(heights - facts.tool_height).max()),
        "phases": [_phase_figures(phase) for phase in scenario.phases],
        "drift": {
            "speed_m_s": DRIFT_SPEED,
            "median_distance_m": float(np.median(scenario.drift_distances))
            if scenario.drift_distances
            else math.nan,
        },
        "seed": facts.seed,
        "simulated_s": float(end - start),
        "real_time_factor": float((end - start) / facts.elapsed) if facts.elapsed > 0.0 else math.nan,
    }
    summary["failures"] = [*failures(summary), *facts.trouble]
    summary["success"] = not summary["failures"]
    return summary


def limit_violations(recording: Recording, robot: Robot) -> dict[str, int]:
    """How often a limit was exceeded, by kind.

    Positions, velocities and torques count per joint state; a published trajectory counts when it
    exceeds a position, velocity or acceleration limit at any instant. What the driver counted is added, not
    changes of torque that were asked for too fast: the controller cuts those before they reach the arm.
    """
    joints, limits = recording.joints, robot.limits
    lower, upper = robot.position_range
    counts = {
        "measured_position": _count(joints, (joints.position < lower) | (joints.position > upper)),
        "measured_velocity": _count(joints, np.abs(joints.velocity) > limits.velocity),
        "measured_torque": _count(joints, np.abs(joints.effort) > robot.torque_limits),
        "published_trajectory": sum(
            bool(command_violations(command, limits)) for command in recording.commands
        ),
    }
    statuses = recording.diagnostics.get(DRIVER, [])
    if statuses:
        for key in statuses[-1].values:
            if key.startswith("limit.") and key.endswith(".instants") and key != TORQUE_RATE:
                counts["driver_" + key.split(".")[1]] = int(statuses[-1].number(key))
    return counts


def command_violations(command: Command, limits: Limits) -> list[str]:
    """Which limits a published trajectory exceeds at any instant, in words."""
    trajectory = Trajectory.from_points(
        command.time, command.position, command.velocity, command.acceleration
    )
    # Times travel in whole nanoseconds, which changes derivatives in the ninth digit.
    return trajectory.violations(limits, relative_tolerance=1e-4)


def planner_figures(recording: Recording, start: float, end: float) -> dict[str, Any]:
    """Rate, compute time and deadline misses of the planner between two times [s]."""
    received = np.array([command.received for command in recording.commands])
    count = int(np.count_nonzero((received >= start) & (received <= end)))
    statuses = [status for status in recording.diagnostics.get(PLANNER, []) if status.time >= start]
    last = statuses[-1] if statuses else Status(math.nan, 0, "", {})
    misses, cycles = last.number("deadline_misses"), last.number("cycles")
    return {
        "rate_hz": count / (end - start),
        "compute_ms": {key: last.number(f"compute_{key}_ms") for key in ("p50", "p99", "max")},
        "deadline_misses": misses,
        "cycles": cycles,
        "deadline_miss_fraction": misses / cycles if cycles else math.nan,
    }


def failures(summary: Mapping[str, Any]) -> list[str]:
    """What keeps a run from being a success, in words; empty when nothing does."""
    found = []
    for phase in summary["phases"]:
        if phase["name"] != "drift" and not math.isfinite(phase["time_to_reach_s"]):
            found.append(
                f"{phase['name']}: the box was not at the target (within 10 mm for one second) in time"
            )
    drift = summary["drift"]["median_distance_m"]
    if not drift <= DRIFT_MEDIAN_DISTANCE:
        found.append(
            f"drift: median distance {drift * 1e3:.0f} mm, allowed are {DRIFT_MEDIAN_DISTANCE * 1e3:.0f} mm"
        )
    if summary["limit_violations"]:
        kinds = [kind for kind, count in summary["limit_violations_by_kind"].items() if count]
        found.append(f"{summary['limit_violations']} limit violations ({', '.join(kinds)})")
    fraction = summary["mpc"]["deadline_miss_fraction"]
    if not fraction <= ALLOWED_DEADLINE_MISSES:
        found.append(f"the planner missed {fraction:.1%} of its deadlines, allowed is 1 %")
    deviation = summary["tool_height_deviation_m"]
    if not deviation <= ALLOWED_HEIGHT_DEVIATION:
        found.append(f"the tool left its height by {deviation * 1e3:.1f} mm, allowed are 5 mm")
    return found


def _phase_figures(phase: Any) -> dict[str, Any]:
    return {
        "name": phase.name,
        "start_s": phase.start,
        "end_s": phase.end,
        "time_to_reach_s": phase.time_to_reach,
    }


def _count(joints: JointSeries, broken: Any) -> int:
    return int(np.count_nonzero(broken.any(axis=1))) if len(joints.time) else 0
