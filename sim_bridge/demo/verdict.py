"""What tells demos from each other, how a run went, and the words for it."""

from __future__ import annotations

import abc
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.demo.script import Script
from sim_bridge.demo.settings import Settings
from sim_bridge.report.page import Table
from sim_bridge.report.recording import Recording
from sim_bridge.report.stage import Stage
from sim_bridge.report.summary import RunFacts

Chart = tuple[Path, str]
"""A picture and its caption."""


@dataclass(frozen=True)
class Demo(abc.ABC):
    """What tells one demo from another.

    Attributes:
        name: of its file in ``config``.
        title: of its report.
    """

    name: str
    title: str

    @abc.abstractmethod
    def script(self, settings: Settings, rng: np.random.Generator, duration: float) -> Script:
        """What happens within a time [s]."""

    @abc.abstractmethod
    def stage(self, settings: Settings) -> Stage:
        """What the run is drawn on."""

    @abc.abstractmethod
    def summarize(
        self, recording: Recording, script: Any, settings: Settings, facts: RunFacts
    ) -> dict[str, Any]:
        """Everything that ``summary.json`` holds."""

    @abc.abstractmethod
    def success(self, summary: dict[str, Any]) -> str:
        """What a good run achieved, in words."""

    @abc.abstractmethod
    def tables(self, summary: dict[str, Any]) -> list[Table]:
        """The report's tables."""

    @abc.abstractmethod
    def charts(
        self, out: Path, recording: Recording, summary: dict[str, Any], settings: Settings
    ) -> list[Chart]:
        """Draw the report's charts into a folder."""

    def target(self, script: Any) -> NDArray[np.float64] | None:
        """Where the object is to go (2,) [m], for the live view; None where there is no such place."""
        return None


@dataclass
class Outcome:
    """What the run itself leaves for the summary.

    Attributes:
        script: with what happened.
        first_plan: from the start of the processes to the first plan [s].
        elapsed: wall time of the script [s].
        trouble: what went wrong with the processes, in words.
    """

    script: Script
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
