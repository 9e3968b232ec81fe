"""Everything a demo leaves in its folder besides summary and bag: charts, replay, report, video."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sim_bridge.demo.settings import Settings
from sim_bridge.report.charts import compute_chart, distance_chart, joint_chart, top_view
from sim_bridge.report.page import demo_tables, write_page
from sim_bridge.report.recording import Recording
from sim_bridge.report.summary import PLANNER
from sim_bridge.report.video import write_video
from sim_bridge.report.view import Frame, replay_page
from sim_bridge.scene import build
from vpsto_ros.nodes.markers import arm_bases

FRAME_RATE = 20.0


def write_artifacts(
    out: Path, recording: Recording, summary: Mapping[str, Any], settings: Settings, verdict: str, title: str
) -> list[str]:
    """Write charts, report and video.

    Args:
        out: folder.
        recording: the run.
        summary: its figures.
        settings: scene and planner rate.
        verdict: plain sentence for the report.
        title: of the report.

    Returns:
        Sentences for the user about what could not be made.
    """
    tools, scene = settings.tools, settings.scene
    robot = tools.robot
    marks = ", ".join(dict.fromkeys(phase["name"] for phase in summary["phases"]))
    charts = [
        (
            out / "distance.png",
            f"Distance between object and target. Vertical lines: {marks}.",
        ),
        (
            out / "top_view.png",
            "Seen from above: paths of object, target and tools; object at the start (faint) and at the end.",
        ),
        (out / "joints.png", "Joint velocities and torques as shares of their limits."),
        (out / "compute.png", "Compute time of a planning step as the planner reports it."),
    ]
    distance_chart(charts[0][0], recording, summary["phases"], summary["reached_distance_m"])
    tips, corners = tools.tips(recording.joints.position), scene.plant.shape.transform(np.zeros(3))
    top_view(charts[1][0], recording, tips, corners, arm_bases(tools))
    joint_chart(charts[2][0], recording, robot.limits, robot.torque_limits)
    compute_chart(charts[3][0], recording, PLANNER)
    frames = replay_frames(recording, summary["phases"][0]["start_s"])
    page = replay_page(build(scene), robot.joint_names, frames, FRAME_RATE)
    write_page(out / "report.html", title, verdict, summary["success"], demo_tables(summary), charts, page)
    note = write_video(out / "video.mp4", scene, robot.joint_names, frames, FRAME_RATE)
    return [note] if note else []


def replay_frames(recording: Recording, start: float) -> list[Frame]:
    """What is seen at each instant of the run, at :data:`FRAME_RATE`, from a time [s] on."""
    joints = recording.joints
    end = min(joints.time[-1], recording.object.time[-1])
    times = np.arange(start, end, 1.0 / FRAME_RATE)
    columns = [np.interp(times, joints.time, column) for column in joints.position.T]
    poses, goals = recording.object.at(times), recording.goal.held(times)
    rows = zip(times, np.stack(columns, axis=-1), poses, goals[:, :2], strict=True)
    return [Frame(position, pose, goal, recording.overlays(time)) for time, position, pose, goal in rows]
