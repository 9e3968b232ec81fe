"""SIGINT and SIGTERM for a process that ends in order: the first is a wish, the second an order."""

import signal
import threading
from types import TracebackType

NUMBERS = (signal.SIGINT, signal.SIGTERM)


class StopSignals:
    """Handles both signals while a block is executed.

    rclpy's own handlers take the context away while an executor still works with it, which now and then ends
    in compiled code. Here the first signal interrupts what runs, as Ctrl-C does in any Python program, or,
    after :meth:`wait_for_loop`, is only noted for the loop that looks at :attr:`requested`. The next one ends
    the process at once, whatever it does.

    Attributes:
        requested: whether the process shall end.
    """

    def __init__(self) -> None:
        self.requested = False
        self._interrupts = True
        self._before: dict[int, object] = {}

    def wait_for_loop(self) -> None:
        """From now on a loop looks at `requested`; nothing is interrupted any more."""
        self._interrupts = False

    def _take(self, _number: int, _frame: object) -> None:
        # A plain flag: this runs between any two instructions, also of whoever holds a lock.
        self.requested = True
        for number in self._before:
            signal.signal(number, signal.SIG_DFL)
        if self._interrupts:
            raise KeyboardInterrupt

    def __enter__(self) -> "StopSignals":
        if threading.current_thread() is threading.main_thread():  # no other may have handlers
            for number in NUMBERS:
                self._before[number] = signal.signal(number, self._take)
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _at: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._before.clear()
