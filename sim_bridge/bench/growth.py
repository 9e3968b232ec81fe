"""How cost grows with degrees of freedom, candidates, particles and steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_bridge.bench.belief_rows import SIZES, iteration_name
from sim_bridge.bench.library_rows import BATCHES, DIMENSIONS, DOF, POPULATION
from sim_bridge.experiments.runs import markdown_table

Entries = dict[str, Any]
TOLERANCE = 0.15
"""Exponents this near to 1 are called linear growth."""


def growth_tables(rows: Sequence[Entries]) -> str:
    """Tables of the rows measured on one core, empty if the rows they need are missing.

    The exponent p is that of a least-squares fit of time ~ size^p on logarithmic scales: 1 is linear growth,
    less means that a part of the time does not depend on the size. A sentence below each table says what
    that means.
    """
    single = [row for row in rows if row["cores"] == 1]
    synthesis = _synthesis({row["name"]: row["p50_ms"] for row in single})
    # CMA-ES decomposes its covariance only every few iterations, which a median does not see.
    search = _search({row["name"]: row["mean_ms"] for row in single})
    belief = _belief({row["name"]: row["mean_ms"] for row in single})
    return "\n".join(table for table in (synthesis, search, belief) if table)


def exponent(sizes: Sequence[float], times: Sequence[float]) -> float:
    """The p of time ~ size^p."""
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def in_words(exponents: Sequence[float]) -> str:
    """What exponents of growth mean: compared with linear growth, and by how much."""
    low, high = min(exponents), max(exponents)
    figures = f"exponent {low:.2f}" if f"{low:.2f}" == f"{high:.2f}" else f"exponents {low:.2f} to {high:.2f}"
    if high > 1.0 + TOLERANCE:
        return f"FASTER than linearly ({figures})"
    return f"{'about linearly' if high >= 1.0 - TOLERANCE else 'more slowly than linearly'} ({figures})"


def _synthesis(times: dict[str, float]) -> str:
    names = {(n, b): f"synthesis_b{b}_n{n}_via4_k50" for n in DOF for b in BATCHES}
    if not all(name in times for name in names.values()):
        return ""
    table = np.array([[times[names[n, b]] for b in BATCHES] for n in DOF])
    rows = []
    candidates = [exponent(BATCHES, row) for row in table]
    joints = [exponent(DOF, column) for column in table.T]
    for n, row, power in zip(DOF, table, candidates, strict=True):
        cells = [
            f"{time:.3f} ms ({1e6 * time / (n * b):.0f} ns)" for time, b in zip(row, BATCHES, strict=True)
        ]
        rows.append([f"{n}", *cells, f"{power:.2f}"])
    rows.append(["exponent in joints", *(f"{power:.2f}" for power in joints), ""])
    header = ["joints", *(f"{b} candidates" for b in BATCHES), "exponent in candidates"]
    words = f"cost grows with the joints {in_words(joints)}, with the candidates {in_words(candidates)}"
    return f"batch synthesis, in brackets per candidate and joint\n{markdown_table(header, rows)}{words}\n"


def _search(times: dict[str, float]) -> str:
    rows, words = [], []
    for label in ("sep_cma", "cma"):
        names = [f"{label}_d{d}_m{POPULATION}" for d in DIMENSIONS]
        if not all(name in times for name in names):
            return ""
        row = [times[name] for name in names]
        cells = [f"{time:.3f} ms" for time in row]
        name, power = label.replace("_", "-"), exponent(DIMENSIONS, row)
        rows.append([name, *cells, f"{power:.2f}"])
        words.append(f"{name} grows {in_words([power])}")
    header = ["search", *(f"{d} variables" for d in DIMENSIONS), "exponent"]
    return f"one iteration of the search, mean\n{markdown_table(header, rows)}{', '.join(words)}\n"


def _belief(times: dict[str, float]) -> str:
    """One size grows, the others stay as plans have them; the times contain what does not grow with it."""
    names = [iteration_name(*size) for size in SIZES]
    if not all(name in times for name in names):
        return ""
    rows, words = [], []
    for place, label in enumerate(("candidates", "particles", "steps")):
        others = [i for i in range(3) if i != place]
        grown = sorted(size for size in SIZES if all(size[i] == SIZES[0][i] for i in others))
        sizes, row = [size[place] for size in grown], [times[iteration_name(*size)] for size in grown]
        power, last = exponent(sizes, row), exponent(sizes[-2:], row[-2:])
        cells = [f"{size}: {time:.3f} ms" for size, time in zip(sizes, row, strict=True)]
        rows.append([label, *cells, f"{power:.2f}", f"{last:.2f}"])
        words.append(f"with the {label} {in_words([power])}")
    header = ["what grows", "as in plans", "4 times", "16 times", "exponent", "from 4 to 16 times"]
    table = markdown_table(header, rows)
    return f"one iteration of BS-VP-STO for 4 coordinates, mean\n{table}cost grows {', '.join(words)}\n"
