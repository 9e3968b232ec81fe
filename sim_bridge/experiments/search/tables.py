"""The tables of the search experiment."""

import math
from typing import Any

from sim_bridge.experiments.runs import markdown_table
from sim_bridge.experiments.search.deadline import Punctuality
from sim_bridge.experiments.search.statistics import Rows, Sample
from sim_bridge.experiments.search.variants import Choice


def summaries(rows: Rows) -> list[dict[str, Any]]:
    """One entry per choice, value and problem."""
    return [
        {"choice": choice, "value": value, "problem": problem, **sample.summary()}
        for (choice, value), samples in rows.items()
        for problem, sample in samples.items()
    ]


def sample_table(choices: tuple[Choice, ...], rows: Rows, titles: dict[str, str]) -> str:
    """Median gap to the best known with its 95 % interval, failures, and processor time, by problem."""
    shown = [name for name in titles if any(name in samples for samples in rows.values())]
    body = []
    for choice in choices:
        for value, changes in choice.values.items():
            samples = rows[choice.name, value]
            cells = [_cell(samples[name]) if name in samples else "" for name in shown]
            body.append([choice.name, value if changes else f"**{value}** ({choice.used_by})", *cells])
    return markdown_table(["option", "value", *(titles[name] for name in shown)], body)


def reserve_table(reserves: dict[str, Punctuality], choice: Choice) -> str:
    """What is traded before a deadline."""
    return markdown_table(
        [choice.name, "late (95 % interval)", "p99 overrun", "iterations", "excess over the best known"],
        [
            [
                f"**{name}** ({choice.used_by})" if name == choice.in_use else name,
                f"{100.0 * row.late / row.searches:.1f} % "
                f"({100.0 * row.interval[0]:.1f} to {100.0 * row.interval[1]:.1f})",
                f"{1e3 * row.overrun_p99:.2f} ms",
                f"{row.iterations:.1f}",
                _median(row.cost),
            ]
            for name, row in reserves.items()
        ],
    )


def _median(sample: Sample) -> str:
    middle, low, high = (
        f"{100.0 * value:.2f}" if math.isfinite(value) else "fails" for value in sample.median()
    )
    return f"{middle} % ({low} to {high})"


def _cell(sample: Sample) -> str:
    failed = len(sample.gaps) - sample.successes
    valid = f", {failed} of {len(sample.gaps)} failed" if failed else ""
    return f"{_median(sample)}{valid}; {1e3 * sample.seconds:.1f} ms"
