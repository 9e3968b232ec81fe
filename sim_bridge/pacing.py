"""Simulated time against the clock on the wall."""

import time
from collections.abc import Callable

_LONGEST_LAG = 0.2  # a longer one is not caught up with: planners would see time race [s of wall time]


class Pacer:
    """Lets simulated time pass at a constant factor of real time.

    A host that was busy is caught up with, step by step; after a long interruption (a suspended machine)
    simulated time goes on from where it was. Either way no step is left out.
    """

    def __init__(
        self,
        factor: float = 1.0,
        *,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Prepare.

        Args:
            factor: simulated seconds per real second.
            clock: wall time [s].
            sleep: waits for a time [s].
        """
        self.factor = factor
        self._clock, self._sleep = clock, sleep
        self.delayed = 0.0
        self.start(0.0)

    def start(self, simulated: float) -> None:
        """Begin, or go on after a pause: simulated time [s] is now."""
        self._simulated, self._wall = simulated, self._clock()

    def behind(self, simulated: float) -> float:
        """How much later than due simulated time [s] is reached, 0 if it is early [s of wall time]."""
        return max(self._clock() - self._wall - (simulated - self._simulated) / self.factor, 0.0)

    def wait(self, simulated: float) -> None:
        """Return when simulated time [s] is due; at once if that has passed."""
        due = self._wall + (simulated - self._simulated) / self.factor
        ahead = due - self._clock()
        if ahead > 0.0:
            self._sleep(ahead)
        elif ahead < -_LONGEST_LAG:
            self.delayed -= ahead
            self.start(simulated)


class Ticker:
    """Says when something that happens at a rate is due."""

    def __init__(self, rate: float) -> None:
        self._period = 1.0 / rate
        self._next = 0.0

    def due(self, now: float) -> bool:
        """Whether it is due at `now` [s]; once per period, however late it is asked."""
        if now < self._next - 1e-9:
            return False
        self._next += self._period * max(1, int((now - self._next) / self._period + 1e-6) + 1)
        return True
