"""Running many seeded trials: in this process, in parallel ones or on a cluster; what is finished is kept."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import pathlib
import re
import reprlib
import sys
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import Any

from tqdm import tqdm

from sim_bridge.experiments.runs.store import RunStore, code_digest, fingerprint
from sim_bridge.experiments.runs.workers import (
    Outcome,
    TrialError,
    Work,
    in_processes,
    in_this_process,
    on_cluster,
)
from vpsto_ros.exceptions import InvalidInputError


@dataclasses.dataclass(frozen=True)
class Execution:
    """Where runs are computed and kept.

    Attributes:
        jobs: processes on this machine; 1 runs in this one, 0 uses every core.
        scheduler: address of a Dask scheduler that runs them instead, None for this machine.
        folder: where finished runs are kept as they come, None to keep none.
        resume: take over the finished runs of an earlier, interrupted call from the folder, if the same code
            computed them; those of other code are computed again. Otherwise an old record is replaced.
    """

    jobs: int = 1
    scheduler: str | None = None
    folder: pathlib.Path | None = None
    resume: bool = False
    _opened: set[pathlib.Path] = dataclasses.field(default_factory=set, init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        if isinstance(self.jobs, bool) or not isinstance(self.jobs, int) or self.jobs < 0:
            raise InvalidInputError(f"jobs = {self.jobs!r}: a number of processes, or 0 for every core")
        if self.scheduler is not None and not (isinstance(self.scheduler, str) and self.scheduler.strip()):
            raise InvalidInputError(
                f"scheduler = {self.scheduler!r}: an address such as tcp://10.0.0.1:8786"
            )
        if self.scheduler is not None and self.jobs != 1:
            raise InvalidInputError("a scheduler has workers of its own: give either jobs or a scheduler")
        if self.folder is not None:
            object.__setattr__(self, "folder", pathlib.Path(self.folder))
        elif self.resume:
            raise InvalidInputError("resume needs the folder of the interrupted runs")

    @classmethod
    def from_arguments(cls, arguments: argparse.Namespace) -> Execution:
        """From the options ``--jobs``, ``--scheduler``, ``--resume`` and ``--out`` of an experiment."""
        scheduler, jobs = getattr(arguments, "scheduler", None), getattr(arguments, "jobs", None)
        if jobs is None:
            jobs = 1 if scheduler is not None else 0
        return cls(jobs, scheduler, pathlib.Path(arguments.out), getattr(arguments, "resume", False))

    def store(self, trial: Callable[[Any], Any], label: str) -> RunStore | None:
        """The open record of the runs under a label; a second call with the same label appends to it."""
        if self.folder is None:
            return None
        name = re.sub(r"[^\w.-]+", "_", f"{label}.{trial.__name__}").strip("_")
        path = self.folder / "finished_runs" / name
        store = RunStore(path, keep=self.resume or path in self._opened, code=code_digest(trial))
        self._opened.add(path)
        return store

    def outcomes(
        self, work: Callable[[Any], Any], tasks: Sequence[tuple[int, Any]]
    ) -> Generator[tuple[int, Outcome]]:
        """Outcomes with the indices of their tasks, as they come."""
        if self.scheduler is not None:
            return on_cluster(work, tasks, self.scheduler)
        jobs = min(self.jobs or _cores(), len(tasks))
        return in_this_process(work, tasks) if jobs <= 1 else in_processes(work, tasks, jobs)


def _cores() -> int:
    import joblib

    return joblib.cpu_count()


def run_trials(
    trial: Callable[[Any], Any],
    tasks: Iterable[Any],
    execution: Execution,
    label: str,
    warm_up: Callable[[], Any] | None = None,
) -> list[Any]:
    """Results of `trial(task)` in the order of the tasks; the same wherever they are computed.

    Every finished run is kept in the folder of `execution` at once. When this call ends early, the runs kept
    until then can be resumed from.

    Args:
        trial: a function at module level; its randomness comes from the task's seed alone, and what it does
            depends on nothing but the task.
        tasks: arguments, picklable; each carries its seed.
        execution: where.
        label: what the progress bar says, and the name of the record.
        warm_up: a function at module level that uses what the trials use for a moment. Every process that
            computes runs, this one or a worker, calls it once before its first, so that compiling and
            loading never count in the times that trials measure. It changes no result.

    Raises:
        TrialError: naming the task of the run that failed.
        InvalidInputError: when a task cannot be pickled or the record in the folder is something else.
        ConfigurationError: when the Dask scheduler cannot be used.
    """
    tasks = list(tasks)
    with contextlib.ExitStack() as stack:
        store = execution.store(trial, label)
        keys = [fingerprint(trial, task) for task in tasks] if store is not None else []
        if store is not None:
            stack.enter_context(store)
        results = _taken_over(store, keys, execution, label)
        todo = [(index, task) for index, task in enumerate(tasks) if index not in results]
        bar = stack.enter_context(tqdm(desc=label, total=len(tasks), initial=len(results), disable=None))
        outcomes = stack.enter_context(contextlib.closing(execution.outcomes(Work(trial, warm_up), todo)))
        try:
            for index, outcome in outcomes:
                if outcome.error is not None:
                    raise TrialError(f"{describe(tasks[index])} failed: {outcome.error}")
                results[index] = outcome.result
                if store is not None:
                    store.append(keys[index], outcome.result)
                bar.update()
        except TrialError as error:
            raise TrialError(f"{label}: {error}{_kept(store, results, tasks)}") from error
        except KeyboardInterrupt:
            bar.close()
            print(f"\n{label}: interrupted{_kept(store, results, tasks)}", file=sys.stderr)
            raise
    return [results[index] for index in range(len(tasks))]


def _taken_over(
    store: RunStore | None, keys: Sequence[bytes], execution: Execution, label: str
) -> dict[int, Any]:
    """Results of an earlier call, by index; says how many there are."""
    if store is None or not execution.resume:
        return {}
    if store.outdated is not None:
        notice = "the code has changed since the record was made: all runs are computed again"
        print(f"{label}: {notice} (the old record is now {store.outdated})", flush=True)
        return {}
    results = {index: store.finished[key] for index, key in enumerate(keys) if key in store.finished}
    print(f"{label}: {len(results)} of {len(keys)} runs taken over from {store.path}", flush=True)
    return results


def _kept(store: RunStore | None, results: dict[int, Any], tasks: Sequence[Any]) -> str:
    """What is not lost when runs end early."""
    if store is None:
        return ""
    done = f"{len(results)} of {len(tasks)} runs"
    return f"\n{done} are kept in {store.path}; --resume continues with the others"


def describe(task: Any) -> str:
    """A task in a few words: the names and seeds of what it consists of, or its beginning."""
    if isinstance(task, int):
        return f"seed {task}"
    parts = task if isinstance(task, (tuple, list)) else (task,)
    words = [
        f"{field} {getattr(part, field)}"
        for part in parts
        for field in ("name", "seed")
        if isinstance(getattr(part, field, None), (str, int))
    ]
    if isinstance(task, dict) and "seed" in task:
        words.append(f"seed {task['seed']}")
    return ", ".join(words) or f"task {reprlib.repr(task)}"
