"""Running many seeded trials and saying what they show: parallel processes, confidence intervals, tables."""

import concurrent.futures
import json
import multiprocessing
import pathlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest
from tqdm import tqdm


def run_trials(trial: Callable[[Any], Any], tasks: Sequence[Any], jobs: int, label: str) -> list[Any]:
    """Results of `trial(task)` in the order of the tasks; the same for every number of jobs.

    Args:
        trial: a function at module level; its randomness comes from the task's seed alone.
        tasks: arguments, picklable.
        jobs: number of processes; 1 runs in this one.
        label: what the progress bar says.
    """
    if jobs == 1:
        return [trial(task) for task in tqdm(tasks, label, disable=None)]
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(jobs, mp_context=context) as pool:
        return list(tqdm(pool.map(trial, tasks), label, len(tasks), disable=None))


def success_interval(successes: int, runs: int) -> tuple[float, float]:
    """Wilson's 95 % confidence interval of a success rate."""
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
        return (
            "| "
            + " | ".join(str(cell).ljust(width) for cell, width in zip(cells, widths, strict=True))
            + " |"
        )

    return "\n".join([line(header), line(["-" * width for width in widths]), *map(line, rows)]) + "\n"
