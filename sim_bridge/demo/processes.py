"""Child processes: start them with their own log files, notice when one ends, stop them all."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path


def private_network() -> dict[str, str]:
    """A ROS domain of our own on this machine: other ROS programs neither disturb the demo nor hear it.

    Returns:
        What was put into the environment of this process and belongs into that of others.
    """
    environment = {
        # Linux leaves room for 102 domains below its ephemeral ports.
        "ROS_DOMAIN_ID": str(random.SystemRandom().randrange(1, 102)),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONUNBUFFERED": "1",
    }
    os.environ.update(environment)
    return environment


@contextlib.contextmanager
def signals_wait() -> Iterator[None]:
    """Let SIGINT and SIGTERM wait until the block is left; only the main thread gets any."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    caught: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)

    def note(number: int, _frame: object) -> None:
        caught.append(number)

    before = {number: signal.signal(number, note) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for waiting in caught:
            signal.raise_signal(waiting)


class ProcessGroup:
    """Processes that live and end together.

    Use it as a context manager: leaving the block stops whatever still runs.
    """

    def __init__(self, log_folder: Path, environment: Mapping[str, str]) -> None:
        """Prepare.

        Args:
            log_folder: gets one file per process with all that it prints; created when missing.
            environment: added to the environment of every process.
        """
        self.log_folder = log_folder
        self.environment = dict(environment)
        self.exit_codes: dict[str, int] = {}
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        log_folder.mkdir(parents=True, exist_ok=True)

    def start(self, name: str, command: Sequence[str]) -> None:
        """Start a process under a name."""
        # A signal between the start of a child and its being noted down would leave the child behind.
        with open(self.log_path(name), "wb") as log, signals_wait():
            # In a session of its own: Ctrl-C in the terminal reaches only the parent, which stops them all.
            self._processes[name] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **self.environment},
                start_new_session=True,
            )

    def log_path(self, name: str) -> Path:
        """Where the output of a process goes."""
        return self.log_folder / f"{name}.log"

    def ended(self) -> list[str]:
        """Names of the processes that are no longer running."""
        return [name for name, process in self._processes.items() if process.poll() is not None]

    def last_lines(self, name: str, count: int = 5) -> str:
        """The end of a process's output."""
        return "\n".join(self.log_path(name).read_text(errors="replace").strip().splitlines()[-count:])

    def stop(self, patience: float = 5.0) -> dict[str, int]:
        """Stop all processes: first SIGINT as Ctrl-C would, then SIGTERM, then SIGKILL.

        Args:
            patience: how long to wait after each signal [s].

        Returns:
            Exit codes by name; negative where a signal ended the process.
        """
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            running = [process for process in self._processes.values() if process.poll() is None]
            for process in running:
                process.send_signal(number)
            deadline = time.monotonic() + patience
            while any(process.poll() is None for process in running) and time.monotonic() < deadline:
                time.sleep(0.02)
        self.exit_codes = {name: process.wait() for name, process in self._processes.items()}
        return self.exit_codes

    def __enter__(self) -> ProcessGroup:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
