"""Where trials run: in this process, in processes of this machine (joblib), or on a Dask cluster.

Each of the three is a generator of ``(index, Outcome)`` in the order in which runs finish. A worker does one
trial at a time with one BLAS thread, so that the place changes no result; before its first, it warms up.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import pickle
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from multiprocessing import resource_tracker
from typing import Any

from vpsto_ros import __version__
from vpsto_ros.exceptions import ConfigurationError, VpstoError
from vpsto_ros.sources import digest, package_files

CONNECT_SECONDS = 5.0
"""A scheduler that has not answered after this time is not there."""
WORKER_SECONDS = 30.0
"""A scheduler may wait so long for its first worker."""


_WARM: set[tuple[str, str]] = set()
"""Warm-ups that this process has done, by module and name: a function may come here as several copies."""


class TrialError(VpstoError):
    """A run of an experiment failed; the message names it."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What came out of a trial: a result, or an error in words (with the traceback if nobody expected it)."""

    result: Any = None
    error: str | None = None


@dataclasses.dataclass(frozen=True)
class Work:
    """What a worker does with each task.

    Attributes:
        trial: the function that turns a task into a result.
        warm_up: called once in every process before its first task, so that compiling and loading do not
            count in the time a trial measures; None for nothing.
    """

    trial: Callable[[Any], Any]
    warm_up: Callable[[], Any] | None = None

    def __call__(self, task: Any) -> Any:
        """The result of a task."""
        if self.warm_up is not None:
            name = self.warm_up.__module__, self.warm_up.__qualname__
            if name not in _WARM:
                self.warm_up()
                _WARM.add(name)
        return self.trial(task)


def attempt(work: Callable[[Any], Any], task: Any) -> Outcome:
    """Do a task and turn an exception into words, which travel between processes and machines."""
    try:
        return Outcome(work(task))
    except VpstoError as error:
        return Outcome(error=f"{type(error).__name__}: {error}")
    except Exception as error:
        return Outcome(error=f"{type(error).__name__}: {error}\n{traceback.format_exc()}")


def in_this_process(
    work: Callable[[Any], Any], tasks: Sequence[tuple[int, Any]]
) -> Generator[tuple[int, Outcome]]:
    """One after the other; each gets a copy of its task, as a worker would."""
    for index, task in tasks:
        yield index, attempt(work, pickle.loads(pickle.dumps(task)))


def in_processes(
    work: Callable[[Any], Any], tasks: Sequence[tuple[int, Any]], jobs: int
) -> Generator[tuple[int, Outcome]]:
    """In `jobs` processes of this machine.

    Raises:
        TrialError: when a worker process dies.
    """
    import joblib
    from joblib.externals.loky.process_executor import BrokenProcessPool

    here = os.getpid()
    calls = (joblib.delayed(_in_worker)(work, index, task, here) for index, task in tasks)
    with joblib.parallel_config("loky", inner_max_num_threads=1):
        # Arrays are sent, not mapped from a shared file: a trial may write into its task.
        parallel = joblib.Parallel(
            n_jobs=jobs, batch_size=1, max_nbytes=None, return_as="generator_unordered"
        )
        with _interrupts_wait():
            outcomes = parallel(calls)  # starts the workers
        try:
            yield from outcomes
        except BrokenProcessPool as error:
            raise TrialError(f"a worker process died (killed, or out of memory?): {error}") from error
        finally:
            outcomes.close()


@contextlib.contextmanager
def _interrupts_wait() -> Iterator[None]:
    """Ctrl-C comes after this block, and never to processes started in it: they inherit what is blocked."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # would be started with the first worker, and then end the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _in_worker(work: Callable[[Any], Any], index: int, task: Any, parent: int) -> tuple[int, Outcome]:
    # Ctrl-C reaches the whole process group; the parent decides what to do about it. The parent itself, where
    # joblib falls back to it, must go on hearing it.
    if os.getpid() != parent:
        with contextlib.suppress(ValueError):  # not the main thread
            signal.signal(signal.SIGINT, signal.SIG_IGN)
    return index, attempt(work, task)


def on_cluster(
    work: Callable[[Any], Any], tasks: Sequence[tuple[int, Any]], scheduler: str
) -> Generator[tuple[int, Outcome]]:
    """On the workers of a Dask scheduler; what a dead worker was doing is done again by another.

    Args:
        work: what is done with a task.
        tasks: with their indices.
        scheduler: address such as ``tcp://10.0.0.1:8786``.

    Raises:
        ConfigurationError: when Dask is missing, nothing answers at the address, there are no workers, or
            they have another version or other code of this package.
    """
    client = _connect(scheduler)
    try:
        _check_workers(client, scheduler)
        yield from _collect(client, work, tasks)
    finally:
        with contextlib.suppress(OSError, TimeoutError):
            client.close()


def _connect(scheduler: str) -> Any:
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigurationError(
            "--scheduler needs Dask; install it: pip install 'vpsto_ros[cluster]'"
        ) from error
    try:
        return Client(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ConfigurationError(
            f"no Dask scheduler answers at {scheduler} within {CONNECT_SECONDS:g} s ({error}); "
            "start one with `dask scheduler` and give the address it prints"
        ) from error


def _check_workers(client: Any, scheduler: str) -> None:
    """Refuse a cluster without workers, or whose workers would compute something else."""
    try:
        client.wait_for_workers(1, timeout=WORKER_SECONDS)
    except TimeoutError as error:
        raise ConfigurationError(
            f"the scheduler at {scheduler} has no workers; start some: dask worker {scheduler}"
        ) from error
    try:
        versions = client.run(package_version)
    except Exception as error:  # whatever the worker could not import
        raise ConfigurationError(f"the workers of {scheduler} cannot load vpsto_ros: {error}") from error
    here = package_version()
    for worker, version in versions.items():
        if version != here:
            raise ConfigurationError(f"worker {worker} has vpsto_ros {version}, here it is {here}")


def package_version() -> str:
    """The version of this package and of its code, asked of a worker."""
    return f"{__version__} (code {digest(package_files())[:12]})"


def _collect(
    client: Any, work: Callable[[Any], Any], tasks: Sequence[tuple[int, Any]]
) -> Generator[tuple[int, Outcome]]:
    from distributed import as_completed

    indices = {}
    for index, task in tasks:
        # Impure: the scheduler must not take an older result of the same call for this one.
        indices[client.submit(_alone, work, task, pure=False)] = index
    try:
        for future in as_completed(list(indices), loop=client.loop):
            yield indices[future], _result(future)
    finally:
        with contextlib.suppress(Exception):  # the scheduler may be what was lost
            client.cancel(list(indices))


def _result(future: Any) -> Outcome:
    try:
        return future.result()  # computed anew if the worker that had it has died meanwhile
    except Exception as error:  # several workers have died of this task, or the scheduler is gone
        return Outcome(error=f"on the cluster, {type(error).__name__}: {error}")


_ONE_AT_A_TIME = threading.Lock()


def _alone(work: Callable[[Any], Any], task: Any) -> Outcome:
    """A trial in a worker that may have several threads: trials take turns there, they share a process."""
    with _ONE_AT_A_TIME:
        return attempt(work, task)
