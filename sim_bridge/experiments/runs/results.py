"""What many runs show: confidence intervals, quantiles, tables, the summary and the verdict."""

import json
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np


def success_interval(successes: int, runs: int) -> tuple[float, float]:
    """Wilson's 95 % confidence interval of a success rate."""
    from scipy.stats import binomtest  # takes a second to load, which every worker would spend

    interval = binomtest(successes, runs).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def quantile(values: Iterable[float | None], q: float) -> float | None:
    """A quantile of the finite values, None if there are none."""
    finite = [value for value in values if value is not None and np.isfinite(value)]
    return float(np.quantile(finite, q)) if finite else None


def write_summary(folder: pathlib.Path, summary: dict[str, Any]) -> pathlib.Path:
    """Write summary.json into a folder, making it if need be."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "summary.json"
    path.write_text(json.dumps(summary, indent=2) + "\n")
    return path


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table that reads well both raw and rendered."""
    widths = [max(len(str(cell)) for cell in column) for column in zip(header, *rows, strict=True)]

    def line(cells: Sequence[str]) -> str:
        padded = (str(cell).ljust(width) for cell, width in zip(cells, widths, strict=True))
        return f"| {' | '.join(padded)} |"

    return "\n".join([line(header), line(["-" * width for width in widths]), *map(line, rows)]) + "\n"
