"""Two measurements of the same rows: which became faster, which slower, and what is only noise."""

from __future__ import annotations

import json
import math
import pathlib
from collections.abc import Sequence
from typing import Any

from sim_bridge.experiments.runs import markdown_table
from vpsto_ros.exceptions import ConfigurationError

Entries = dict[str, Any]
SMALLEST_BAND = 0.05
"""Differences of the median below this are never called a change: another layout of memory makes them."""
BAND_WIDTH = 3.0
"""Standard deviations of the difference that count as noise."""


def read_rows(path: str | pathlib.Path, option: str = "--compare") -> list[Entries]:
    """Rows written by ``vpsto bench --json``, also by an older version that had fewer or other entries.

    Args:
        path: of the file.
        option: that named it, for messages.

    Raises:
        ConfigurationError: when the file is missing or does not hold such rows.
    """
    try:
        rows = json.loads(pathlib.Path(path).read_text())
    except OSError as error:
        raise ConfigurationError(f"{option} {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise ConfigurationError(f"{option} {path}: not JSON ({error})") from error
    if not isinstance(rows, list) or not rows or not all(map(_is_row, rows)):
        raise ConfigurationError(f"{option} {path}: not a file written by `vpsto bench --json`")
    return rows


def _is_row(row: Any) -> bool:
    if not isinstance(row, dict) or not isinstance(row.get("name"), str):
        return False
    p50, noise = row.get("p50_ms"), row.get("noise", 0.0)
    positive = isinstance(p50, int | float) and math.isfinite(p50) and p50 > 0.0
    known = isinstance(noise, int | float) and math.isfinite(noise) and noise >= 0.0
    return positive and known and isinstance(row.get("cores", 1), int)


def compare(old: Sequence[Entries], new: Sequence[Entries]) -> list[Entries]:
    """The change of every row that both have: ratio of the medians, noise band and verdict.

    The band is three standard deviations of the difference, as measured within both runs (an old file without
    that figure is taken to be as noisy as the new run), and at least 5 %. A ratio within 1 / (1 + band) ..
    1 + band is "same".
    """
    before = {(row["name"], row.get("cores", 1)): row for row in old}
    changes = []
    for row in new:
        earlier = before.get((row["name"], row["cores"]))
        if earlier is None:
            continue
        noise = math.hypot(row["noise"], earlier["noise"] if "noise" in earlier else row["noise"])
        band = max(SMALLEST_BAND, BAND_WIDTH * noise)
        ratio = row["p50_ms"] / earlier["p50_ms"]
        verdict = "slower" if ratio > 1.0 + band else "faster" if ratio * (1.0 + band) < 1.0 else "same"
        changes.append(
            {
                "name": row["name"], "cores": row["cores"], "old_ms": earlier["p50_ms"],
                "new_ms": row["p50_ms"], "ratio": ratio, "band": band, "verdict": verdict,
            }
        )  # fmt: skip
    return changes


def comparison_table(changes: Sequence[Entries], old: Sequence[Entries], new: Sequence[Entries]) -> str:
    """The changes as a table, and the rows that only one side has."""
    header = ["row", "cores", "old p50", "new p50", "new / old", "noise", "verdict"]
    rows = [
        [
            change["name"], f"{change['cores']}", f"{change['old_ms']:.4g} ms", f"{change['new_ms']:.4g} ms",
            f"{change['ratio']:.2f}", f"{100.0 * change['band']:.0f} %", change["verdict"],
        ]
        for change in changes
    ]  # fmt: skip
    text = markdown_table(header, rows) if rows else "no row is in both measurements\n"
    known, measured = (list(map(place, side)) for side in (old, new))
    for label, side, other in (("only new", measured, known), ("only old", known, measured)):
        missing = [place for place in side if place not in other]
        if missing:
            text += f"{label}: {', '.join(missing)}\n"
    return text


def place(row: Entries) -> str:
    """Name of a row with the number of cores it was measured on."""
    cores = row.get("cores", 1)
    return f"{row['name']} ({cores} core{'s' if cores > 1 else ''})"
