"""Running many seeded trials and saying what they show."""

from sim_bridge.experiments.runs.execution import Execution, describe, run_trials
from sim_bridge.experiments.runs.results import (
    markdown_table,
    quantile,
    success_interval,
    write_summary,
)
from sim_bridge.verdict import print_verdict

__all__ = [
    "Execution",
    "describe",
    "markdown_table",
    "print_verdict",
    "quantile",
    "run_trials",
    "success_interval",
    "write_summary",
]
