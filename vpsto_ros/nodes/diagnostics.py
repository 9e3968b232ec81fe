"""What a node says about itself: statistics, counted complaints, and its status on /diagnostics."""

import collections
import contextlib
import dataclasses
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile

OK, WARN, ERROR, STALE = 0, 1, 2, 3
_LEVELS = (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR, DiagnosticStatus.STALE)


class Durations:
    """Percentiles of the most recent durations and the longest one ever; safe between threads."""

    def __init__(self, window: int = 20_000) -> None:
        self._recent: collections.deque[float] = collections.deque(maxlen=window)
        self.longest = 0.0
        self.count = 0

    @contextlib.contextmanager
    def measured(self) -> Iterator[None]:
        """Record how long the block takes."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.add(time.perf_counter() - begin)

    def add(self, seconds: float) -> None:
        """Record one duration [s]."""
        self._recent.append(seconds)
        self.longest = max(self.longest, seconds)
        self.count += 1

    def milliseconds(self, name: str) -> dict[str, str]:
        """Median, 99th percentile (of the window) and maximum (since the start) as diagnostic values [ms]."""
        recent = np.array(self._recent) if self._recent else np.zeros(1)
        middle, high = np.percentile(recent, (50, 99)) * 1e3
        values = {"p50": middle, "p99": high, "max": self.longest * 1e3}
        return {f"{name}_{key}_ms": f"{value:.3f}" for key, value in values.items()}


class Rate:
    """How often something happens, measured between two looks at it."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._since = clock()
        self._count = 0
        self.total = 0

    def tick(self) -> None:
        """Count one occurrence."""
        self._count += 1
        self.total += 1

    def take(self) -> float:
        """Occurrences per second since the last call [Hz]."""
        now = self._clock()
        rate = self._count / max(now - self._since, 1e-9)
        self._since, self._count = now, 0
        return rate


class Cycles:
    """Counts the cycles of a periodic job, and those that it skipped because it was late."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._last: float | None = None
        self.count = self.skipped = 0

    def pause(self) -> None:
        """The job has nothing to do for now."""
        self._last = None

    def begin(self, now: float, at_work: bool = True) -> int:
        """Begin a cycle at `now` [s]; returns how many periods were skipped before it.

        Args:
            now: the time, by the clock of the job's timer.
            at_work: whether the job has anything to do; otherwise nothing is counted.
        """
        if not at_work:
            self.pause()
            return 0
        gap = self._period if self._last is None else now - self._last
        # More than half a period late; up to that the clock's own steps and jitter are to blame.
        skipped = max(0, math.ceil(gap / self._period - 1.5 - 1e-6))
        self._last = now
        self.count += 1
        self.skipped += skipped
        return skipped


class Pulse:
    """How long ago, by a steady clock, something last happened: which tells when time itself stands."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._seen: Any = None
        self.beat()

    def beat(self) -> None:
        """It happens now."""
        self._last = self._clock()

    def see(self, value: Any) -> None:
        """It happens now if a value is another than at the last look."""
        if value != self._seen:
            self._seen = value
            self.beat()

    @property
    def silence(self) -> float:
        """Time since the last beat [s]."""
        return self._clock() - self._last


class Complaints:
    """Counts what went wrong by kind and logs each kind at most once per period.

    rclpy throttles by the line that logs; messages of different kinds that pass through one line would
    silence each other, hence this.
    """

    def __init__(
        self, warn: Callable[[str], Any], period: float = 2.0, clock: Callable[[], float] = time.monotonic
    ):
        self._warn, self._period, self._clock = warn, period, clock
        self._lock = threading.Lock()
        self._logged: dict[str, float] = {}
        self.counts: collections.Counter[str] = collections.Counter()
        self.latest: tuple[float, str] = (-math.inf, "")

    def add(self, kind: str, message: str) -> None:
        """Count a complaint of a kind (a short key); log its message unless that kind was logged just now."""
        now = self._clock()
        with self._lock:
            self.counts[kind] += 1
            self.latest = (now, message)
            silent = now - self._logged.get(kind, -math.inf) < self._period
            if not silent:
                self._logged[kind] = now
        if not silent:
            self._warn(message)

    def recent(self, within: float = 2.0) -> str:
        """The latest message, if it is not older than `within` seconds; else an empty string."""
        when, message = self.latest
        return message if self._clock() - when <= within else ""

    def values(self) -> dict[str, str]:
        """The counts as diagnostic values."""
        return {f"rejected.{kind}": str(count) for kind, count in sorted(self.counts.copy().items())}


@dataclasses.dataclass(frozen=True)
class Report:
    """One status: level (OK, WARN, ERROR or STALE), message and values to show."""

    level: int = OK
    message: str = "ok"
    values: Mapping[str, Any] = dataclasses.field(default_factory=dict)


class Diagnostics:
    """Publishes a node's report on /diagnostics, by a steady clock: a paused simulation still reports."""

    def __init__(
        self,
        node: Node,
        report: Callable[[], Report],
        *,
        period: float = 1.0,
        hardware: str = "",
        stamp: Callable[[], Time] | None = None,
    ) -> None:
        self._node, self._report, self._hardware = node, report, hardware
        self._stamp = stamp or (lambda: node.get_clock().now().to_msg())
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", QoSProfile(depth=10))
        self._timer = node.create_timer(period, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self) -> None:
        """Publish the present report."""
        message = DiagnosticArray()
        message.header.stamp = self._stamp()
        message.status = [self.status()]
        self._publisher.publish(message)

    def status(self) -> DiagnosticStatus:
        """The present report as a message."""
        report = self._report()
        return DiagnosticStatus(
            level=_LEVELS[report.level],
            name=self._node.get_fully_qualified_name().lstrip("/"),
            message=report.message,
            hardware_id=self._hardware,
            values=[KeyValue(key=key, value=str(value)) for key, value in report.values.items()],
        )

    def destroy(self) -> None:
        """Stop publishing."""
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)
