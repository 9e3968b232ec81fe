"""The figures of a run, drawn with matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.report.recording import Recording
from vpsto_ros.trajectory.timing import Limits

TARGET, BOX, TOOL, PLAIN = "#2a9d4a", "#d97706", "#0f6e84", "#6b7280"
TOOLS = (TOOL, "#9d4edd")


def figure(width: float = 9.0, height: float = 3.6) -> tuple[Any, Any]:
    """A figure and its axes that need no display."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(width, height), dpi=130, layout="constrained")
    axes = canvas.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    return canvas, axes


def distance_chart(
    path: Path, recording: Recording, phases: Sequence[dict[str, Any]], reached: float
) -> None:
    """How far the object is from the target over time, with the scenario's phases marked."""
    canvas, axes = figure()
    time, distance = recording.distance()
    start = _start(recording)
    axes.semilogy(time - start, np.maximum(distance, 3e-4) * 1e3, color=BOX, lw=1.4)
    near = 1e3 * reached
    axes.axhline(near, color=TARGET, lw=1.0, ls="--")
    axes.annotate(
        f"reached: {near:.0f} mm", (0.0, near), (3, 3), textcoords="offset points", color=TARGET, fontsize=8
    )
    for phase in phases:
        begin = phase["start_s"]
        axes.axvline(begin - start, color=PLAIN, lw=0.7)
        axes.text(
            begin - start,
            1.02,
            " " + phase["name"],
            transform=axes.get_xaxis_transform(),
            fontsize=8,
            color=PLAIN,
        )
    axes.set(xlabel="time [s]", ylabel="distance to target [mm]")
    canvas.savefig(path)


def top_view(
    path: Path,
    recording: Recording,
    tips: NDArray[np.float64],
    corners: Sequence[NDArray[np.float64]],
    bases: NDArray[np.float64],
) -> None:
    """Paths of object, target and tools on the table, seen from above.

    Args:
        path: file to write.
        recording: the run.
        tips: positions (K, tools, 3) at the times of the joint states [m].
        corners: polygons (P, 2) of the object in its own frame [m].
        bases: where the arms stand, shape (arms, 3) [m].
    """
    canvas, axes = figure(7.0, 6.5)
    pose, goal = recording.object.pose, recording.goal.pose
    names = ("tool",) if tips.shape[1] == 1 else ("left tool", "right tool")
    for tool, (name, colour) in enumerate(zip(names, TOOLS, strict=False)):
        axes.plot(tips[:, tool, 1], tips[:, tool, 0], color=colour, lw=0.7, alpha=0.6, label=name)
    axes.plot(pose[:, 1], pose[:, 0], color=BOX, lw=1.6, label="object")
    axes.plot(goal[:, 1], goal[:, 0], ".", color=TARGET, ms=2.5)
    stops = (
        goal[np.r_[True, np.linalg.norm(np.diff(goal[:, :2], axis=0), axis=1) > 0.03]] if len(goal) else goal
    )
    axes.plot(stops[:, 1], stops[:, 0], "+", color=TARGET, ms=14, mew=2.2, label="target")
    for index, alpha in ((0, 0.35), (-1, 1.0)):
        if len(pose):
            _outline(axes, pose[index], corners, alpha)
    axes.plot(bases[:, 1], bases[:, 0], "s", color=PLAIN, ms=9, ls="none", label="robot base")
    axes.set(xlabel="y [m]", ylabel="x [m]", aspect="equal")
    axes.invert_xaxis()
    axes.legend(loc="lower center", fontsize=8, frameon=False)
    canvas.savefig(path)


def _outline(
    axes: Any, pose: NDArray[np.float64], corners: Sequence[NDArray[np.float64]], alpha: float
) -> None:
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    for polygon in corners:
        world = polygon @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]
        closed = np.vstack((world, world[:1]))
        axes.plot(closed[:, 1], closed[:, 0], color=BOX, lw=1.8, alpha=alpha)


def joint_chart(path: Path, recording: Recording, limits: Limits, torque_limits: NDArray[np.float64]) -> None:
    """Velocity and torque of every joint as shares of their limits; a second arm is dashed."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(9.0, 4.6), dpi=130, layout="constrained")
    upper, lower = canvas.subplots(2, 1, sharex=True)
    joints, start = recording.joints, _start(recording)
    for axes, values, allowed, name in (
        (upper, joints.velocity, limits.velocity, "velocity"),
        (lower, joints.effort, torque_limits, "torque"),
    ):
        for joint, share in enumerate((100.0 * values / allowed).T):
            style = "-" if joint < 7 else "--"
            axes.plot(joints.time - start, share, style, color=f"C{joint % 7}", lw=0.8)
        for bound in (-100.0, 100.0):
            axes.axhline(bound, color=PLAIN, lw=1.0, ls="--")
        axes.set(ylabel=f"{name} [% of limit]", ylim=(-110, 110))
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
    count = joints.position.shape[1]
    arms = ("",) if count <= 7 else ("left ", "right ")
    names = [f"{arms[i // 7]}joint {i % 7 + 1}" for i in range(count)]
    upper.legend(names, ncols=7, fontsize=7 if count <= 7 else 5.5, frameon=False)
    lower.set_xlabel("time [s]")
    canvas.savefig(path)


def compute_chart(path: Path, recording: Recording, node: str) -> None:
    """Compute time of replanning since the start as the planner reports it, against its deadline."""
    canvas, axes = figure()
    start = _start(recording)
    statuses = recording.diagnostics.get(node, [])
    time = np.array([status.time for status in statuses]) - start
    for key, style in (("p50", "-"), ("p99", "--"), ("max", ":")):
        values = [status.number(f"compute_{key}_ms") for status in statuses]
        axes.plot(time, values, style, color=TOOL, lw=1.4, label=key)
    if statuses:
        deadline = statuses[-1].number("deadline_ms")
        axes.axhline(deadline, color="#b91c1c", lw=1.0, ls="--", label=f"deadline ({deadline:.0f} ms)")
    axes.set(xlabel="time [s]", ylabel="compute time of a step [ms]", ylim=(0.0, None))
    axes.legend(fontsize=8, frameon=False, ncols=4)
    canvas.savefig(path)


def _start(recording: Recording) -> float:
    """The time that figures count from: when the first target was given."""
    return float(recording.goal.time[0]) if len(recording.goal.time) else float(recording.joints.time[0])
