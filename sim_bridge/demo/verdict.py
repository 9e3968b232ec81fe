"""What tells demos from each other, how a run went, and the words for it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sim_bridge.demo.scenario import Scenario


@dataclass(frozen=True)
class Demo:
    """What tells one demo from another.

    Attributes:
        name: of its file in ``config``.
        title: of its report.
        scenario: what happens, from a source of randomness and the longest it may take [s].
        success: what a good run achieved, in words, from its summary.
        strict: whether contacts of the arms and refused trajectories are failures as well.
    """

    name: str
    title: str
    scenario: Callable[[np.random.Generator, float], Scenario]
    success: Callable[[dict[str, Any]], str]
    strict: bool = False


@dataclass
class Outcome:
    """What the run itself leaves for the summary.

    Attributes:
        scenario: with the phases as they went.
        first_plan: from the start of the processes to the first plan [s].
        elapsed: wall time of the scenario [s].
        trouble: what went wrong with the processes, in words.
    """

    scenario: Scenario
    first_plan: float = math.nan
    elapsed: float = math.nan
    trouble: list[str] = field(default_factory=list)


def give_up(out: Path, seed: int, outcome: Outcome) -> int:
    """The verdict on a run that ended before there was anything to draw."""
    trouble = [*outcome.trouble, "the run ended before the arm could do anything"]
    summary = {
        "success": False,
        "failures": trouble,
        "time_to_first_plan_s": outcome.first_plan,
        "seed": seed,
    }
    write_summary(out, summary)
    print(failed(summary))
    print(f"logs of the nodes: {out / 'logs'}")
    return 1


def write_summary(out: Path, summary: dict[str, Any]) -> None:
    """Write ``summary.json``."""
    (out / "summary.json").write_text(json.dumps(_plain(summary), indent=2) + "\n")


def verdict(demo: Demo, summary: dict[str, Any]) -> str:
    """The outcome in plain words."""
    if not summary["success"]:
        return failed(summary)
    mpc = summary["mpc"]
    return (
        f"SUCCESS: {demo.success(summary)}; no limit was violated, "
        f"{mpc['deadline_misses']:.0f} of {mpc['cycles']:.0f} deadlines were missed at "
        f"{mpc['rate_hz']:.1f} plans per second; {_first_plan(summary)}."
    )


def failed(summary: dict[str, Any]) -> str:
    """What went wrong."""
    return "FAILED: " + "; ".join([*summary["failures"], _first_plan(summary)])


def _first_plan(summary: dict[str, Any]) -> str:
    first = summary["time_to_first_plan_s"]
    if not math.isfinite(first):
        return "no plan that moves came"
    return f"the first plan that moves came {first:.1f} s after the start"


def _plain(value: Any) -> Any:
    """The same with None for what JSON cannot hold: numbers that are not finite."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
