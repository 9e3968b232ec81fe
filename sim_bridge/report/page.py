"""The HTML report: verdict, figures, charts and the replay in one file that needs nothing else."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1f2937; }
body { max-width: 1040px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: .4rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
.verdict { padding: .7rem 1rem; border-radius: 6px; border-left: 6px solid; }
.good { background: #ecfdf3; border-color: #2a9d4a; } .bad { background: #fef2f2; border-color: #b91c1c; }
table { border-collapse: collapse; }
td, th { padding: .25rem 1.2rem .25rem 0; text-align: left; border-bottom: 1px solid #e5e7eb; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; }
iframe { width: 100%; height: 560px; border: 1px solid #e5e7eb; border-radius: 6px; }
img { width: 100%; } figure { margin: 1rem 0; } figcaption { color: #6b7280; font-size: .9rem; }
"""


Table = tuple[str, list[list[str]]]
"""A heading and rows; the first row names the columns."""


def write_page(
    path: Path,
    title: str,
    verdict: str,
    success: bool,
    tables: Sequence[Table],
    charts: Sequence[tuple[Path, str]],
    replay: str | None,
) -> None:
    """Write the report.

    Args:
        path: file to write.
        title: heading.
        verdict: one or a few plain sentences.
        success: colours the verdict.
        tables: a heading and the rows of each; the first row names the columns.
        charts: PNG files, which are embedded, and their captions.
        replay: a complete HTML page with the 3-D replay, which is embedded; None when there is none.
    """
    body = [f"<h1>{html.escape(title)}</h1>"]
    body.append(f'<p class="verdict {"good" if success else "bad"}">{html.escape(verdict)}</p>')
    if replay is not None:
        body.append("<h2>Replay</h2><p>Drag to turn, scroll to zoom, move the slider to any instant.</p>")
        body.append(f'<iframe title="3-D replay" srcdoc="{html.escape(replay, quote=True)}"></iframe>')
    for heading, rows in tables:
        body.append(f"<h2>{html.escape(heading)}</h2>{_table(rows)}")
    body.append("<h2>Figures</h2>")
    body.extend(_figure(file, caption) for file, caption in charts)
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{_STYLE}</style>'
    path.write_text(f"<!doctype html><html lang='en'><head>{head}</head><body>{''.join(body)}</body></html>")


def push_tables(summary: Mapping[str, Any]) -> list[Table]:
    """The tables of a pushing demo's report from its summary."""
    figures = [
        ["figure", "value"],
        ["final distance to the target", number(summary["final_error_m"], 1e3, "mm", 1)],
        *_drift_row(summary),
        ["limit violations", str(summary["limit_violations"])],
        *_contact_row(summary),
        ["trajectories that the controller refused", count(summary["refused_trajectories"])],
        ["largest deviation of a tool's height", number(summary["tool_height_deviation_m"], 1e3, "mm", 2)],
        *planning_rows(summary),
    ]
    phases = [["phase", "began at", "time to reach"]]
    begin = summary["phases"][0]["start_s"]
    for phase in summary["phases"]:
        reach = number(phase["time_to_reach_s"], 1.0, "s", 1) if phase["judged"] else "–"
        phases.append([phase["name"], number(phase["start_s"] - begin, 1.0, "s", 1), reach])
    return [("What was measured", figures), ("What happened", phases)]


def planning_rows(summary: Mapping[str, Any]) -> list[list[str]]:
    """How the planner kept its time, in every demo."""
    mpc = summary["mpc"]
    compute = mpc["compute_ms"]
    times = " / ".join(number(compute[key], 1.0, "", 1) for key in compute)
    missed, cycles = (number(mpc[key], 1.0, "", 0) for key in ("deadline_misses", "cycles"))
    return [
        ["plans per simulated second", number(mpc["rate_hz"], 1.0, "Hz", 1)],
        ["compute time p50 / p99 / max", f"{times} ms"],
        ["deadlines missed", f"{missed} of {cycles}"],
        ["from start to the first plan", number(summary["time_to_first_plan_s"], 1.0, "s", 1)],
        ["simulated time", number(summary["simulated_s"], 1.0, "s", 1)],
    ]


def _drift_row(summary: Mapping[str, Any]) -> list[list[str]]:
    if "drift" not in summary:
        return []
    median = number(summary["drift"]["median_distance_m"], 1e3, "mm", 1)
    return [["median distance while the target drifts at 2 cm/s", median]]


def _contact_row(summary: Mapping[str, Any]) -> list[list[str]]:
    contacts = summary["contacts"] or {}
    names = {"arms": "arms", "table": "table", "object": "object, not by a tool"}
    shown = [f"{names.get(kind, kind)}: {steps} ms" for kind, steps in contacts.items()]
    return [["what arms touched that they should not", ", ".join(shown) or "unknown"]]


def count(value: int | None) -> str:
    """A number of things for people, "unknown" when nobody counted."""
    return "unknown" if value is None else str(value)


def number(value: float, scale: float, unit: str, digits: int) -> str:
    """A value in a unit for people, "never" when it is not finite."""
    if not math.isfinite(value):
        return "never"
    return f"{value * scale:.{digits}f} {unit}".strip()


def _table(rows: Sequence[Sequence[str]]) -> str:
    lines = []
    for index, row in enumerate(rows):
        tag = "td" if index else "th"
        cells = (
            f"<{tag}{' class=number' if column else ''}>{html.escape(cell)}</{tag}>"
            for column, cell in enumerate(row)
        )
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return f"<table>{''.join(lines)}</table>"


def _figure(file: Path, caption: str) -> str:
    data = base64.b64encode(file.read_bytes()).decode("ascii")
    text = html.escape(caption)
    image = f'<img alt="{text}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{text}</figcaption></figure>"
