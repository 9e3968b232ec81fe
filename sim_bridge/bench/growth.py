"""How cost grows with the degrees of freedom and with the number of candidates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_bridge.bench.library_rows import BATCHES, DIMENSIONS, DOF, POPULATION
from sim_bridge.experiments.runs import markdown_table

Entries = dict[str, Any]


def growth_tables(rows: Sequence[Entries]) -> str:
    """Tables of the rows measured on one core, empty if the rows they need are missing.

    The exponent p is that of a least-squares fit of time ~ size^p on logarithmic scales: 1 is linear growth,
    less means that a part of the time does not depend on the size.
    """
    single = [row for row in rows if row["cores"] == 1]
    synthesis = _synthesis({row["name"]: row["p50_ms"] for row in single})
    # CMA-ES decomposes its covariance only every few iterations, which a median does not see.
    search = _search({row["name"]: row["mean_ms"] for row in single})
    return "\n".join(table for table in (synthesis, search) if table)


def exponent(sizes: Sequence[float], times: Sequence[float]) -> float:
    """The p of time ~ size^p."""
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def _synthesis(times: dict[str, float]) -> str:
    names = {(n, b): f"synthesis_b{b}_n{n}_via4_k50" for n in DOF for b in BATCHES}
    if not all(name in times for name in names.values()):
        return ""
    table = np.array([[times[names[n, b]] for b in BATCHES] for n in DOF])
    rows = []
    for n, row in zip(DOF, table, strict=True):
        cells = [
            f"{time:.3f} ms ({1e6 * time / (n * b):.0f} ns)" for time, b in zip(row, BATCHES, strict=True)
        ]
        rows.append([f"{n}", *cells, f"{exponent(BATCHES, row):.2f}"])
    powers = [f"{exponent(DOF, column):.2f}" for column in table.T]
    rows.append(["exponent in joints", *powers, ""])
    header = ["joints", *(f"{b} candidates" for b in BATCHES), "exponent in candidates"]
    return f"batch synthesis, in brackets per candidate and joint\n{markdown_table(header, rows)}"


def _search(times: dict[str, float]) -> str:
    rows = []
    for label in ("sep_cma", "cma"):
        names = [f"{label}_d{d}_m{POPULATION}" for d in DIMENSIONS]
        if not all(name in times for name in names):
            return ""
        row = [times[name] for name in names]
        cells = [f"{time:.3f} ms" for time in row]
        rows.append([label.replace("_", "-"), *cells, f"{exponent(DIMENSIONS, row):.2f}"])
    header = ["search", *(f"{d} variables" for d in DIMENSIONS), "exponent"]
    return f"one iteration of the search, mean\n{markdown_table(header, rows)}"
