"""Figures and verdict of a demo, computed from its recording alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sim_bridge.demo.scenario import DRIFT_MEDIAN_DISTANCE, DRIFT_SPEED, Scenario
from sim_bridge.report.recording import Command, JointSeries, Recording, Status
from vpsto_ros.robot.kinematics import Robot
from vpsto_ros.robot.tool_plane import ToolPlane
from vpsto_ros.trajectory import Limits, Trajectory

DRIVER, PLANNER = "franka_driver", "mpc_planner"
ALLOWED_DEADLINE_MISSES = 0.01
REQUIRED_RATE = 0.99
"""Share of the configured planning rate that has to be kept."""
ALLOWED_HEIGHT_DEVIATION = 0.005
_SILENCE = Status(math.nan, 0, "", {})


@dataclass(frozen=True)
class RunFacts:
    """What the recording cannot tell.

    Attributes:
        seed: of the run.
        first_plan: from the start of the processes to the first plan [s].
        elapsed: wall time while the scenario ran [s].
        trouble: processes that ended early or badly, in words.
        planner_rate: the configured planning rate [Hz].
    """

    seed: int
    first_plan: float
    elapsed: float
    trouble: Sequence[str]
    planner_rate: float


def summarize(
    recording: Recording, scenario: Scenario, tools: ToolPlane, facts: RunFacts, *, strict: bool = False
) -> dict[str, Any]:
    """Everything that ``summary.json`` holds; ``success`` and ``failures`` are the verdict.

    Args:
        recording: the run.
        scenario: as it went.
        tools: the plane in which the robot's tools should have stayed.
        facts: what the recording cannot tell.
        strict: whether contacts of the arms and refused trajectories are failures as well.
    """
    _, distance = recording.distance()
    heights = tools.tool_heights(recording.joints.position)
    start, end = scenario.phases[0].start, scenario.phases[-1].end
    if not math.isfinite(end):
        end = recording.object.time[-1]
    summary: dict[str, Any] = {
        **common_figures(recording, tools.robot, start, end, facts),
        "final_error_m": float(distance[-1]),
        "tool_height_deviation_m": float(np.abs(heights - tools.height).max()),
        "reached_distance_m": scenario.reached_distance,
        "phases": [_phase_figures(phase) for phase in scenario.phases],
        **_drift_figures(scenario),
    }
    found = failures(summary) + (strict_failures(summary) if strict else [])
    summary["failures"] = [*found, *facts.trouble]
    summary["success"] = not summary["failures"]
    return summary


def common_figures(
    recording: Recording, robot: Robot, start: float, end: float, facts: RunFacts
) -> dict[str, Any]:
    """What the summary of every demo holds; success is still open.

    Args:
        recording: the run.
        robot: whose limits count.
        start: when the robot was first given something to do [s].
        end: of all that happened [s].
        facts: what the recording cannot tell.
    """
    limits = limit_violations(recording, robot)
    return {
        "success": False,
        "failures": [],
        "limit_violations": sum(limits.values()),
        "limit_violations_by_kind": limits,
        "mpc": planner_figures(recording, start, end, facts.planner_rate),
        "time_to_first_plan_s": facts.first_plan,
        **driver_counts(recording.diagnostics.get(DRIVER, []), start),
        "seed": facts.seed,
        "simulated_s": float(end - start),
        "real_time_factor": float((end - start) / facts.elapsed) if facts.elapsed > 0.0 else math.nan,
    }


def limit_violations(recording: Recording, robot: Robot) -> dict[str, int]:
    """How often a limit was exceeded, by kind.

    Positions and velocities count per joint state; a published trajectory counts when it exceeds a position,
    velocity or acceleration limit at any instant. What the driver counted at every control cycle is added:
    see :func:`driver_violations`. Measured torques are not looked at: the controller cuts them to their
    limits, so that only the driver knows which torques were asked for.
    """
    joints, limits = recording.joints, robot.limits
    lower, upper = robot.position_range
    return {
        "measured_position": _count(joints, (joints.position < lower) | (joints.position > upper)),
        "measured_velocity": _count(joints, np.abs(joints.velocity) > limits.velocity),
        "published_trajectory": sum(
            bool(command_violations(command, limits)) for command in recording.commands
        ),
        **driver_violations(recording.diagnostics.get(DRIVER, [])),
    }


def driver_violations(statuses: Sequence[Status]) -> dict[str, int]:
    """The driver's ``limit_violations``, split into the kinds ``limit.<kind>.instants``, torque among them.

    ``demand.*`` is no part of it: changes of torque that were asked for too fast and that the controller cut.

    Returns:
        Instants by kind, "driver_other" being what the kinds do not explain; empty when the driver said
        nothing of limits, which :func:`failures` takes for a failure.
    """
    if not statuses or not math.isfinite(statuses[-1].number("limit_violations")):
        return {}
    last = statuses[-1]
    keys = [key for key in last.values if key.startswith("limit.") and key.endswith(".instants")]
    counts = {"driver_" + key.split(".")[1]: int(last.number(key)) for key in keys}
    other = int(last.number("limit_violations")) - sum(counts.values())
    return {**counts, "driver_other": max(other, 0)}


def command_violations(command: Command, limits: Limits) -> list[str]:
    """Which limits a published trajectory exceeds at any instant, in words."""
    trajectory = Trajectory.from_points(
        command.time, command.position, command.velocity, command.acceleration
    )
    # Times travel in whole nanoseconds, which changes derivatives in the ninth digit.
    return trajectory.violations(limits, relative_tolerance=1e-4)


def planner_figures(recording: Recording, start: float, end: float, rate: float) -> dict[str, Any]:
    """How the planner kept its rate and deadlines between two times [s], by its own counters.

    A cycle counts when there was something to plan; ``deadline_misses`` of the planner contains the cycles
    that it skipped as well as those whose plan was late. What was counted before ``start`` is subtracted. If
    the planner's last report is from before ``end``, nothing is assumed to have been planned since.

    Args:
        recording: the run.
        start: when the first target was given.
        end: of the scenario.
        rate: the configured one [Hz].

    Returns:
        Plans ready in time per simulated second, cycles that were due, those missed and skipped, compute
        times since the planner's start; NaN where the planner said nothing.
    """
    statuses = recording.diagnostics.get(PLANNER, [])
    before = [status for status in statuses if status.time <= start]
    within = [status for status in statuses if status.time > start]
    # The first report at or after the end sees all of the scenario and least of what follows.
    last = next((status for status in within if status.time >= end), within[-1] if within else _SILENCE)
    duration = max(last.time, end) - start if within else math.nan

    def counted(key: str) -> float:
        return last.number(key) - (before[-1].number(key) if before else 0.0)

    misses, skipped = counted("deadline_misses"), counted("skipped_cycles")
    due = counted("cycles") + skipped
    return {
        "rate_hz": (due - misses) / duration,
        "configured_rate_hz": rate,
        "duration_s": duration,
        "compute_ms": {key: last.number(f"compute_{key}_ms") for key in ("p50", "p99", "max")},
        "deadline_misses": misses,
        "skipped_cycles": skipped,
        "cycles": due,
        "deadline_miss_fraction": misses / due if due > 0.0 else math.nan,
    }


def planner_failures(mpc: Mapping[str, Any]) -> list[str]:
    """What was wrong with the planner's timing, in words."""
    found = []
    fraction, rate, configured = (
        mpc[key] for key in ("deadline_miss_fraction", "rate_hz", "configured_rate_hz")
    )
    if not fraction <= ALLOWED_DEADLINE_MISSES:
        found.append(f"the planner missed {fraction:.1%} of its deadlines, allowed is 1 %")
    # The first cycle after the first target comes up to a period later.
    if not rate + 1.0 / mpc["duration_s"] >= REQUIRED_RATE * configured:
        found.append(
            f"the planner made {rate:.2f} plans per simulated second, required is 99 % of {configured:g}"
        )
    return found


def failures(summary: Mapping[str, Any]) -> list[str]:
    """What keeps a run from being a success, in words; empty when nothing does."""
    found = []
    near = f"within {summary['reached_distance_m'] * 1e3:.0f} mm for one second"
    for phase in summary["phases"]:
        if phase["judged"] and not math.isfinite(phase["time_to_reach_s"]):
            found.append(f"{phase['name']}: the object was not at the target ({near}) in time")
    if "drift" in summary:
        drift, most = summary["drift"]["median_distance_m"], DRIFT_MEDIAN_DISTANCE
        if not drift <= most:
            found.append(f"drift: median distance {drift * 1e3:.0f} mm, allowed are {most * 1e3:.0f} mm")
    found.extend(common_failures(summary))
    deviation = summary["tool_height_deviation_m"]
    if not deviation <= ALLOWED_HEIGHT_DEVIATION:
        found.append(f"the tool left its height by {deviation * 1e3:.1f} mm, allowed are 5 mm")
    return found


def common_failures(summary: Mapping[str, Any]) -> list[str]:
    """What keeps a run of any demo from being a success: limits that were broken, a planner that was late."""
    found = []
    if summary["limit_violations"]:
        kinds = [kind for kind, count in summary["limit_violations_by_kind"].items() if count]
        found.append(f"{summary['limit_violations']} limit violations ({', '.join(kinds)})")
    if "driver_other" not in summary["limit_violations_by_kind"]:
        found.append("the driver did not say whether it saw limits violated")
    found.extend(planner_failures(summary["mpc"]))
    return found


def driver_counts(statuses: Sequence[Status], start: float) -> dict[str, Any]:
    """What the driver counted from a time [s] on: contacts that should not be, and what it refused.

    Contacts are steps of 1 ms by kind: "arms" (two arms, or an arm and itself), "table", "object" (an arm
    other than by its tool). Without any report of the driver, there is nothing of all this.
    """
    if not statuses:
        return {"contacts": None, "refused_trajectories": None}
    before, last = [status for status in statuses if status.time <= start], statuses[-1]

    def since(key: str) -> int:
        return int(last.number(key) - (before[-1].number(key) if before and key in before[-1].values else 0))

    kinds = [key.split(".")[1] for key in last.values if key.startswith("contact.")]
    refused = [key for key in last.values if key.startswith("rejected.joint_trajectory")]
    return {
        "contacts": {kind: since(f"contact.{kind}.steps") for kind in kinds},
        "refused_trajectories": sum(since(key) for key in refused),
    }


def strict_failures(summary: Mapping[str, Any]) -> list[str]:
    """Contacts that should not have been, and plans that the controller could not take, in words."""
    contacts, refused = summary["contacts"], summary["refused_trajectories"]
    if not contacts or "arms" not in contacts:
        return ["the driver did not say what the arms touched"]
    what = {"arms": "the arms touched each other", "table": "an arm touched the table"}
    found = [
        f"{what.get(kind, 'an arm touched the object other than by its tool')} for {steps} ms"
        for kind, steps in contacts.items()
        if steps
    ]
    if refused:
        found.append(f"the controller refused {refused} trajectories")
    return found


def _drift_figures(scenario: Scenario) -> dict[str, Any]:
    """How near the object stayed to a drifting target, if the scenario has one."""
    if all(phase.judged for phase in scenario.phases):
        return {}
    distances = scenario.drift_distances
    median = float(np.median(distances)) if distances else math.nan
    return {"drift": {"speed_m_s": DRIFT_SPEED, "median_distance_m": median}}


def _phase_figures(phase: Any) -> dict[str, Any]:
    return {
        "name": phase.name,
        "judged": phase.judged,
        "start_s": phase.start,
        "end_s": phase.end,
        "time_to_reach_s": phase.time_to_reach,
    }


def _count(joints: JointSeries, broken: Any) -> int:
    return int(np.count_nonzero(broken.any(axis=1))) if len(joints.time) else 0
