"""Everything a demo leaves in its folder besides summary and bag: charts, replay, report, video."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sim_bridge.demo.settings import Settings
from sim_bridge.demo.verdict import Demo, verdict
from sim_bridge.report.page import write_page
from sim_bridge.report.recording import Recording
from sim_bridge.report.video import write_video
from sim_bridge.report.view import Frame, replay_page

FRAME_RATE = 20.0


def write_artifacts(
    out: Path, demo: Demo, recording: Recording, summary: dict[str, Any], settings: Settings, start: float
) -> list[str]:
    """Write charts, report and video.

    Args:
        out: folder.
        demo: which.
        recording: the run.
        summary: its figures.
        settings: of the demo.
        start: from when on the run is shown [s].

    Returns:
        Sentences for the user about what could not be made.
    """
    stage, sentence = demo.stage(settings), verdict(demo, summary)
    charts = demo.charts(out, recording, summary, settings)
    frames = replay_frames(recording, start)
    page = replay_page(stage, frames, FRAME_RATE)
    write_page(
        out / "report.html", demo.title, sentence, summary["success"], demo.tables(summary), charts, page
    )
    note = write_video(out / "video.mp4", stage, frames, FRAME_RATE)
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
