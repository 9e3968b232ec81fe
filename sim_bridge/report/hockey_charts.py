"""The figures of an air-hockey run, drawn with matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim_bridge.hockey import table
from sim_bridge.report.charts import BOX, PLAIN, TARGET, figure
from sim_bridge.report.recording import Recording

SCORED, MISSED = TARGET, "#b91c1c"


def shot_chart(path: Path, shots: Sequence[Mapping[str, Any]]) -> None:
    """The predicted chance of every shot in the colour of its outcome, and the speed of those that scored."""
    canvas, axes = figure()
    index = np.arange(1, len(shots) + 1)
    chances = np.nan_to_num([shot["chance"] for shot in shots])
    axes.bar(index, 100.0 * chances, color=[_colour(shot) for shot in shots], alpha=0.75)
    for colour, name in ((SCORED, "scored"), (MISSED, "did not score")):
        axes.bar([np.nan], [np.nan], color=colour, alpha=0.75, label=name)
    axes.set(xlabel="shot", ylabel="predicted chance [%]", ylim=(0.0, 108.0), xticks=index)
    speeds = axes.twinx()
    speeds.plot(index, [shot["goal_speed_m_s"] for shot in shots], "o", color=BOX, label="goal speed")
    speeds.set(ylabel="speed at the goal line [m/s]", ylim=(0.0, None))
    handles = [axes.get_legend_handles_labels(), speeds.get_legend_handles_labels()]
    marks, names = ([*first, *second] for first, second in zip(*handles, strict=True))
    axes.legend(marks, names, fontsize=8, frameon=False, ncols=3, loc="lower center")
    canvas.savefig(path)


def table_view(path: Path, recording: Recording, shots: Sequence[Mapping[str, Any]]) -> None:
    """The ways of the pucks on the table, seen from above, and where they began."""
    canvas, axes = figure(9.0, 5.4)
    _draw_table(axes)
    for number, shot in enumerate(shots, 1):
        end = shot["end_s"] if np.isfinite(shot["end_s"]) else np.inf
        chosen = (recording.object.time >= shot["start_s"]) & (recording.object.time <= end)
        way = recording.object.pose[chosen, :2]
        if not len(way):
            continue
        axes.plot(way[:, 0], way[:, 1], color=_colour(shot), lw=1.0, alpha=0.8)
        axes.plot(*way[0], "o", color=_colour(shot), ms=5)
        axes.annotate(str(number), way[0], (4, 4), textcoords="offset points", fontsize=8, color=PLAIN)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    canvas.savefig(path)


def _draw_table(axes: Any) -> None:
    """Rims, middle line, goals and the robot's base."""
    corner = np.array([table.HALF_LENGTH, table.HALF_WIDTH])
    (left, low), (right, high) = table.to_base(-corner), table.to_base(corner)
    axes.plot([left, right, right, left, left], [low, low, high, high, low], color=PLAIN, lw=1.5)
    axes.plot([table.TABLE_ORIGIN[0]] * 2, [low, high], color=PLAIN, lw=0.6)
    for end in (left, right):
        axes.plot([end, end], [-table.GOAL_HALF_WIDTH, table.GOAL_HALF_WIDTH], color=TARGET, lw=4.0)
    axes.plot(0.0, 0.0, "s", color=PLAIN, ms=9)
    axes.grid(visible=False)


def _colour(shot: Mapping[str, Any]) -> str:
    return SCORED if shot["outcome"] == "goal" else MISSED
