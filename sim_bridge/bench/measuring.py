"""How a row of the benchmark is measured: on so many cores, warmed up, in several passes."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

Action = Callable[[], Any]
BLOCKS = 4
"""Parts of a pass; the scatter of their medians tells how well the median of all is known."""


class Cores:
    """The cores a row may use, and what has to be closed after it.

    Attributes:
        count: number of cores this process is kept on meanwhile.
        cleanup: closed when the row has been measured.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self.cleanup = contextlib.ExitStack()

    def shared(self, work: Callable[[slice], Any], size: int) -> Action:
        """An action that shares `size` independent items out among threads, one per core.

        Args:
            work: does a slice of the items; gains from threads as far as it is compiled code without the GIL.
            size: number of items.
        """
        if self.count == 1:
            return lambda: work(slice(0, size))
        bounds = [size * k // self.count for k in range(self.count + 1)]
        own, *others = (slice(low, high) for low, high in itertools.pairwise(bounds))
        pool = self.cleanup.enter_context(ThreadPoolExecutor(self.count - 1))

        def together() -> None:
            pending = [pool.submit(work, part) for part in others]
            work(own)
            for part in pending:
                part.result()

        return together


@dataclasses.dataclass(frozen=True)
class Wanted:
    """A figure that one core of a machine of today should reach.

    Attributes:
        entry: of the row, for example ``p50_ms``.
        bound: what it is compared with.
        text: the same in words, with the unit.
        at_least: more is better; otherwise less is.
    """

    entry: str
    bound: float
    text: str
    at_least: bool = False

    def reached(self, entries: dict[str, Any]) -> bool:
        """Whether the entries of a row are as good."""
        value = entries[self.entry]
        return bool(value >= self.bound if self.at_least else value <= self.bound)


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of the table.

    Attributes:
        name: by which rows of two versions are compared; it does not change once published.
        prepare: builds what is measured and returns the call to time; whatever it uses of more than one core,
            it gets from its argument.
        calls: per pass; by default as many as fill the time a row may take.
        own_times: the call returns durations [s] instead of being timed as a whole.
        derived: further entries of the row, from the median duration [s].
        wanted: the figure that it should reach on one core, if there is one.
    """

    name: str
    prepare: Callable[[Cores], Action]
    calls: int | None = None
    own_times: bool = False
    derived: Callable[[float], dict[str, float]] | None = None
    wanted: Wanted | None = None


def at_most(milliseconds: float, entry: str = "p50_ms") -> Wanted:
    """A duration that should not be exceeded."""
    return Wanted(entry, milliseconds, f"{entry.removesuffix('_ms')} <= {milliseconds:g} ms")


@dataclasses.dataclass(frozen=True)
class Effort:
    """How thoroughly to measure.

    Attributes:
        passes: how often all rows are gone through; slow changes of the machine show between passes.
        seconds: a row without a fixed number of calls takes about this long per pass [s].
        calls: most calls per pass, also of the rows that have a fixed number of them.
    """

    passes: int = 3
    seconds: float = 0.2
    calls: int = 3000


QUICK = Effort(passes=1, seconds=0.0, calls=4)
"""Just enough to see that every row works."""


def measure_once(row: Row, cores: int, effort: Effort) -> list[float]:
    """Durations of one pass [s], in the order of the calls."""
    place = Cores(cores)
    with on_cores(cores), place.cleanup:
        action = row.prepare(place)
        if row.calls is not None:
            return durations(action, min(row.calls, effort.calls), row.own_times)
        estimate = float(np.median(durations(action, 3, row.own_times)))
        wanted = round(effort.seconds / max(estimate, 1e-7))
        return durations(action, max(4, min(wanted, effort.calls)), row.own_times)


def durations(action: Action, calls: int, own_times: bool = False) -> list[float]:
    """How long each of several calls takes [s]."""
    taken: list[float] = []
    for _ in range(calls):
        began = time.perf_counter()
        own = action()
        passed = time.perf_counter() - began
        taken += own if own_times else [passed]
    return taken


def statistics(row: Row, cores: int, passes: Sequence[Sequence[float]]) -> dict[str, Any]:
    """The entries of a row.

    `noise` is the scatter of the median over parts of the measurement, relative to the median: the median
    absolute deviation, scaled to the standard deviation of a normal distribution. Like the median itself, it
    does not mind a few parts during which other processes had the core. `mean_ms` leaves the slowest percent
    out for the same reason. Rows on one core say what is `wanted` of them, if anything is, and whether it is
    `reached`.

    Args:
        row: what was measured.
        cores: on how many.
        passes: durations [s] of each pass.
    """
    seconds = np.concatenate([np.asarray(durations, dtype=float) for durations in passes])
    blocks = [block for durations in passes for block in np.array_split(durations, BLOCKS) if block.size]
    medians = [np.median(block) for block in blocks]
    scatter = 1.4826 * np.median(np.abs(medians - np.median(medians)))
    p50, p99 = np.percentile(seconds, (50, 99))
    mean = seconds[seconds <= p99].mean()
    entries: dict[str, Any] = {
        "name": row.name,
        "cores": cores,
        "p50_ms": 1e3 * float(p50),
        "p99_ms": 1e3 * float(p99),
        "max_ms": 1e3 * float(seconds.max()),
        "mean_ms": 1e3 * float(mean),
        "noise": float(scatter / p50),
    }
    entries |= row.derived(float(p50)) if row.derived else {}
    if row.wanted is not None and cores == 1:
        entries |= {"wanted": row.wanted.text, "reached": row.wanted.reached(entries)}
    return entries


def usable_cores() -> int:
    """How many cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def on_cores(count: int) -> Iterator[None]:
    """Keep this thread, and the threads and processes it starts, on so many cores where the system can."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, set(sorted(before)[-count:]))
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
