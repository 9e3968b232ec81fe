"""Everything a demo leaves in its folder besides summary and bag: charts, replay, report, video."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.demo.settings import Settings
from sim_bridge.report.charts import compute_chart, distance_chart, joint_chart, top_view
from sim_bridge.report.page import demo_tables, write_page
from sim_bridge.report.recording import Recording
from sim_bridge.report.summary import PLANNER
from sim_bridge.report.video import write_video
from sim_bridge.report.view import Frame, replay_page
from sim_bridge.scene import build
from vpsto_ros.robot.kinematics import forward_kinematics_batch, fr3_pusher

FRAME_RATE = 20.0


def write_artifacts(
    out: Path, recording: Recording, summary: Mapping[str, Any], settings: Settings, verdict: str
) -> list[str]:
    """Write charts, report and video.

    Args:
        out: folder.
        recording: the run.
        summary: its figures.
        settings: scene and planner rate.
        verdict: plain sentence for the report.

    Returns:
        Sentences for the user about what could not be made.
    """
    robot = fr3_pusher()
    tool = forward_kinematics_batch(recording.joints.position)[:, :2]
    shape = settings.scene.plant.shape
    charts = [
        (
            out / "distance.png",
            "Distance between box and target. Vertical lines: the target jumps, the knock, the drift.",
        ),
        (
            out / "top_view.png",
            "Seen from above: paths of box, target and tool; box at the start (faint) and at the end.",
        ),
        (out / "joints.png", "Joint velocities and torques as shares of their limits."),
        (out / "compute.png", "Compute time of a planning step as the planner reports it."),
    ]
    distance_chart(charts[0][0], recording, summary["phases"])
    top_view(charts[1][0], recording, tool, shape.transform(np.zeros(3)))
    joint_chart(charts[2][0], recording, robot.limits, robot.torque_limits)
    compute_chart(charts[3][0], recording, PLANNER)
    frames = replay_frames(recording, summary["phases"][0]["start_s"])
    page = replay_page(build(settings.scene), robot.joint_names, frames, FRAME_RATE)
    title = "A simulated FR3 pushes a box to a moving target"
    write_page(out / "report.html", title, verdict, summary["success"], demo_tables(summary), charts, page)
    note = write_video(out / "video.mp4", settings.scene, robot.joint_names, frames, FRAME_RATE)
    return [note] if note else []


def replay_frames(recording: Recording, start: float) -> list[Frame]:
    """What is seen at each instant of the run, at :data:`FRAME_RATE`, from a time [s] on."""
    joints = recording.joints
    end = min(joints.time[-1], recording.object.time[-1])
    times = np.arange(start, end, 1.0 / FRAME_RATE)
    columns = [np.interp(times, joints.time, column) for column in joints.position.T]
    poses, goals = recording.object.at(times), recording.goal.held(times)
    plans = planned_paths(recording, times)
    rows = zip(np.stack(columns, axis=-1), poses, goals[:, :2], plans, strict=True)
    return [Frame(position, pose, goal, plan) for position, pose, goal, plan in rows]


def planned_paths(recording: Recording, times: NDArray[np.float64]) -> list[NDArray[np.float64] | None]:
    """Paths of the tool's tip (P, 2) [m] ahead in the newest trajectory at each time; None without any."""
    received = np.array([command.received for command in recording.commands])
    newest = np.searchsorted(received, times, side="right") - 1
    paths: list[NDArray[np.float64] | None] = []
    for time, index in zip(times, newest, strict=True):
        command = recording.commands[index] if index >= 0 else None
        ahead = command.position[command.time > time] if command is not None else np.empty((0, 7))
        path = forward_kinematics_batch(ahead)[:, :2] if len(ahead) > 1 else None
        moving = path is not None and np.ptp(path, axis=0).max() > 1e-3
        paths.append(path if moving else None)
    return paths
