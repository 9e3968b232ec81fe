"""Callbacks in a thread of their own, beside whatever the main thread does."""

import threading
from types import TracebackType
from typing import Self

from rclpy.executors import Executor

_LOOK = 0.1  # the thread looks so often whether it shall end [s]


class Spinning:
    """Runs an executor's callbacks in a thread while a block is executed.

    The thread ends before the executor is touched: shutting an executor down under a thread that waits in it
    takes away what the thread is about to use.

    Attributes:
        failure: what a callback raised; no other is executed after it.
    """

    def __init__(self, executor: Executor) -> None:
        """Prepare to spin this executor."""
        self.failure: BaseException | None = None
        self._executor = executor
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._spin, name="ros", daemon=True)

    @property
    def alive(self) -> bool:
        """Whether callbacks are executed."""
        return self._thread.is_alive()

    def _spin(self) -> None:
        try:
            while not self._ended.is_set():
                self._executor.spin_once(timeout_sec=_LOOK)
        except BaseException as error:  # for whoever looks at `failure` in the main thread
            self.failure = error

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _at: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join(timeout=5.0)
