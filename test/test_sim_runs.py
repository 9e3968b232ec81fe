"""Many runs: the same results wherever they are computed, and nothing finished is lost."""

import argparse
import importlib
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from sim_bridge.experiments.runs import Execution, describe, run_trials, store
from sim_bridge.experiments.runs.store import RunStore, fingerprint
from sim_bridge.experiments.runs.workers import TrialError
from vpsto_ros import sources
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError

ROOT = Path(__file__).resolve().parents[1]


def random_sum(seed):
    """Its last bits depend on how BLAS splits the product."""
    rng = np.random.default_rng(seed)
    return seed, float((rng.standard_normal((300, 300)) @ rng.standard_normal((300, 300))).sum())


def spoils_its_task(task):
    task += 1.0
    return float(task.sum())


def logged(task):
    """Writes down that it ran; fails as long as a file with its seed's name is there."""
    folder, seed = task
    with open(os.path.join(folder, "log"), "a") as log:
        log.write(f"{seed}\n")
    if os.path.exists(os.path.join(folder, f"fail_{seed}")):
        raise ValueError("not today")
    return seed * seed


def dies_once(task):
    """Takes its process along the first time that seed 3 is run."""
    folder, seed = task
    marker = os.path.join(folder, "died")
    if seed == 3 and not os.path.exists(marker):
        Path(marker).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return random_sum(seed)


WARM_UPS = []


def warms_up():
    WARM_UPS.append(os.getpid())


def fails_to_warm_up():
    raise ValueError("no compiler")


def number_of_warm_ups(task):
    """In this process, as of now."""
    return os.getpid(), WARM_UPS.count(os.getpid()), task


def ran(folder):
    """The seeds that were run since this was asked last, sorted."""
    log = folder / "log"
    seeds = sorted(int(line) for line in log.read_text().split()) if log.exists() else []
    log.unlink(missing_ok=True)
    return seeds


@pytest.fixture(scope="module")
def scheduler():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50
    ) as cluster:
        yield cluster.scheduler_address


def test_the_number_of_processes_changes_no_bit():
    alone = run_trials(random_sum, range(6), Execution(), "alone")
    assert [seed for seed, _ in alone] == list(range(6))
    assert run_trials(random_sum, range(6), Execution(jobs=2), "two") == alone
    assert run_trials(random_sum, range(6), Execution(jobs=0), "all cores") == alone


def test_a_cluster_gives_the_same_results(scheduler):
    alone = run_trials(random_sum, range(6), Execution(), "alone")
    assert run_trials(random_sum, range(6), Execution(scheduler=scheduler), "cluster") == alone


def test_every_process_warms_up_once_before_its_first_run(scheduler):
    for execution in (Execution(), Execution(jobs=2), Execution(scheduler=scheduler)):
        for label in ("first", "second"):
            told = run_trials(number_of_warm_ups, range(6), execution, label, warm_up=warms_up)
            assert [task for *_, task in told] == list(range(6))
            assert {warmed for _, warmed, _ in told} == {1}, execution
            assert (os.getpid() in {process for process, *_ in told}) == (execution == Execution())


def test_without_a_run_nothing_is_warmed_up(tmp_path):
    assert run_trials(random_sum, [], Execution(), "none", warm_up=fails_to_warm_up) == []
    expected = run_trials(random_sum, [1], Execution(folder=tmp_path), "one")
    resumed = Execution(folder=tmp_path, resume=True)
    assert run_trials(random_sum, [1], resumed, "one", warm_up=fails_to_warm_up) == expected


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_warm_up_that_fails_is_an_error_of_the_run(jobs):
    with pytest.raises(TrialError, match=r"(?s)seed \d failed: ValueError: no compiler.*in fails_to_warm_up"):
        run_trials(random_sum, range(2), Execution(jobs=jobs), "a", warm_up=fails_to_warm_up)


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_trial_that_writes_into_its_task_spoils_no_other(jobs):
    shared = np.zeros(3)
    assert run_trials(spoils_its_task, [shared, shared], Execution(jobs=jobs), "shared") == [3.0, 3.0]
    assert not shared.any()


def test_a_killed_worker_of_a_cluster_loses_no_run(scheduler, tmp_path):
    tasks = [(str(tmp_path), seed) for seed in range(10)]
    results = run_trials(dies_once, tasks, Execution(scheduler=scheduler), "killed")
    assert (tmp_path / "died").exists()
    assert results == [random_sum(seed) for seed in range(10)]


def test_a_killed_process_of_this_machine_is_an_error_and_can_be_resumed_from(tmp_path):
    tasks = [(str(tmp_path), seed) for seed in range(8)]
    with pytest.raises(TrialError, match=r"(?s)worker process died.*of 8 runs are kept.*--resume"):
        run_trials(dies_once, tasks, Execution(jobs=2, folder=tmp_path), "killed")
    again = run_trials(dies_once, tasks, Execution(jobs=2, folder=tmp_path, resume=True), "killed")
    assert again == [random_sum(seed) for seed in range(8)]


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_failed_run_is_named_and_the_finished_ones_are_taken_over(tmp_path, capsys, jobs):
    tasks = [(str(tmp_path), seed) for seed in range(6)]
    (tmp_path / "fail_4").touch()
    with pytest.raises(TrialError) as failure:
        run_trials(logged, tasks, Execution(jobs, folder=tmp_path), "squares")
    message = str(failure.value)
    assert "ValueError: not today" in message and "in logged" in message and ", 4)" in message
    kept = int(message.split(" of 6 runs are kept")[0].split()[-1])
    # A second process may have finished others meanwhile; those before the failure were out by then.
    assert 3 <= kept <= 5
    ran(tmp_path)
    (tmp_path / "fail_4").unlink()
    again = run_trials(logged, tasks, Execution(jobs, folder=tmp_path, resume=True), "squares")
    assert again == [0, 1, 4, 9, 16, 25]
    rest = ran(tmp_path)
    assert len(rest) == 6 - kept and 4 in rest
    assert f"squares: {kept} of 6 runs taken over" in capsys.readouterr().out


def test_only_the_same_task_is_taken_over(tmp_path):
    first = [(str(tmp_path), seed) for seed in range(3)]
    run_trials(logged, first, Execution(folder=tmp_path), "a")
    ran(tmp_path)
    resume = Execution(folder=tmp_path, resume=True)
    assert run_trials(logged, [first[1], (str(tmp_path), 7), first[0]], resume, "a") == [1, 49, 0]
    assert ran(tmp_path) == [7]
    run_trials(logged, [*first, (str(tmp_path), 7)], resume, "a")
    assert ran(tmp_path) == []


def trial_of_a_file(folder, text, monkeypatch):
    """`trial` of a module with this text, as after an edit and a new start of the process."""
    (folder / "an_experiment.py").write_text(text)
    monkeypatch.syspath_prepend(str(folder))
    sys.modules.pop("an_experiment", None)
    sources._content.cache_clear()
    importlib.invalidate_caches()
    sys.dont_write_bytecode, before = True, sys.dont_write_bytecode
    module = importlib.import_module("an_experiment")
    sys.dont_write_bytecode = before
    return module.trial


def test_results_of_other_code_are_computed_again_and_it_is_said(tmp_path, monkeypatch, capsys):
    text = "LIMIT = {}\ndef trial(seed): return seed < LIMIT\n"
    first = trial_of_a_file(tmp_path, text.format(2), monkeypatch)
    run_trials(first, range(4), Execution(folder=tmp_path), "a")
    resume = Execution(folder=tmp_path, resume=True)
    same = trial_of_a_file(tmp_path, text.format(2), monkeypatch)
    assert run_trials(same, range(4), resume, "a") == [True, True, False, False]
    assert "a: 4 of 4 runs taken over" in capsys.readouterr().out
    changed = trial_of_a_file(tmp_path, text.format(4), monkeypatch)
    assert run_trials(changed, range(4), resume, "a") == [True] * 4
    said = capsys.readouterr().out
    assert "a: the code has changed since the record was made: all runs are computed again" in said
    assert "taken over" not in said and (tmp_path / "finished_runs" / "a.trial.other_code").exists()
    assert run_trials(changed, range(4), resume, "a") == [True] * 4
    assert "a: 4 of 4 runs taken over" in capsys.readouterr().out


@pytest.mark.parametrize("file", ["sim_bridge/simulation.py", "vpsto_ros/robot/models/fr3_pusher.xml"])
def test_every_source_and_model_counts_as_code(monkeypatch, file):
    before, read = store.code_digest(random_sum), sources._content
    changed = {ROOT / file: read(ROOT / file) + b" "}
    monkeypatch.setattr(sources, "_content", lambda path: changed.get(path) or read(path))
    assert store.code_digest(random_sum) != before


def test_a_record_of_an_older_format_counts_as_other_code(tmp_path):
    (tmp_path / "record").write_bytes(b"vpsto runs 1\n" + bytes(40))
    with RunStore(tmp_path / "record", keep=True) as record:
        assert record.finished == {} and record.outdated == tmp_path / "record.other_code"


def test_without_resume_everything_is_run_again_and_the_old_record_goes(tmp_path):
    tasks = [(str(tmp_path), seed) for seed in range(3)]
    run_trials(logged, tasks, Execution(folder=tmp_path), "a")
    run_trials(logged, tasks[:1], Execution(folder=tmp_path), "a")
    assert ran(tmp_path) == [0, 0, 1, 2]
    run_trials(logged, tasks, Execution(folder=tmp_path, resume=True), "a")
    assert ran(tmp_path) == [1, 2], "only seed 0 was in the new record"


def test_two_calls_of_one_experiment_under_the_same_label_are_both_kept(tmp_path):
    execution = Execution(folder=tmp_path)
    for seed in (1, 2):
        run_trials(logged, [(str(tmp_path), seed)], execution, "a")
    ran(tmp_path)
    resumed = Execution(folder=tmp_path, resume=True)
    assert run_trials(logged, [(str(tmp_path), seed) for seed in (2, 1)], resumed, "a") == [4, 1]
    assert ran(tmp_path) == []


def test_fingerprints_depend_on_the_value_of_the_task_alone():
    task = {"seed": 1, "start": np.array([0.1, 0.2]), "options": (1, "a")}
    same = {"options": (1, "".join(["a"])), "start": np.array([0.1, 0.2]), "seed": 1}
    other = {**task, "start": np.array([0.1, 0.2 + 1e-16 * 2])}
    assert fingerprint(logged, task) == fingerprint(logged, same)
    assert fingerprint(logged, task) != fingerprint(logged, other)
    assert fingerprint(logged, task) != fingerprint(random_sum, task)
    with pytest.raises(InvalidInputError, match="random_sum cannot be pickled"):
        fingerprint(random_sum, lambda: None)


def test_a_torn_record_costs_one_run_wherever_it_is_torn(tmp_path):
    path, ends = tmp_path / "record", []
    with RunStore(path, keep=False) as store:
        for key in (b"a" * 16, b"b" * 16, b"c" * 16):
            store.append(key, 1.5)
            ends.append(path.stat().st_size)
    whole = path.read_bytes()
    for length in range(len(whole) + 1):
        path.write_bytes(whole[:length])
        with RunStore(path, keep=True) as store:
            assert len(store.finished) == sum(end <= length for end in ends)
            store.append(b"d" * 16, "new")
        with RunStore(path, keep=True) as store:
            assert store.finished[b"d" * 16] == "new"


def test_a_damaged_last_record_is_dropped(tmp_path):
    path = tmp_path / "record"
    with RunStore(path, keep=False) as store:
        store.append(b"a" * 16, 1)
        store.append(b"b" * 16, "something long enough")
    data = bytearray(path.read_bytes())
    data[-5] ^= 1
    path.write_bytes(data)
    with RunStore(path, keep=True) as store:
        assert store.finished == {b"a" * 16: 1}


def test_a_foreign_file_is_not_taken_for_a_record(tmp_path):
    (tmp_path / "record").write_text("my thesis")
    with pytest.raises(InvalidInputError, match=r"record is not a record of runs; choose another --out"):
        RunStore(tmp_path / "record", keep=True)
    assert (tmp_path / "record").read_text() == "my thesis"


SCRIPT = """
    import os, pathlib, sys, time
    from sim_bridge import cli
    from sim_bridge.experiments.runs import Execution, run_trials

    def waits(task):
        folder, seed = task
        while seed >= 4 and not os.path.exists(os.path.join(folder, "go")):
            time.sleep(0.02)
        return seed

    def run(arguments):
        folder = pathlib.Path(arguments.out)
        tasks = [(str(folder), seed) for seed in range(8)]
        print("results", run_trials(waits, tasks, Execution.from_arguments(arguments), "waits"))
        return 0

    cli._load = lambda module: sys.modules["interrupted"]
    def add_arguments(parser): pass
"""


def interrupted(folder, *options):
    """A process of its own that runs the script above as `vpsto experiment`."""
    (folder / "interrupted.py").write_text(textwrap.dedent(SCRIPT))
    code = "import sys, interrupted; sys.exit(interrupted.cli.main(sys.argv[1:]))"
    path = os.pathsep.join([str(ROOT), str(folder)])
    return subprocess.Popen(
        [sys.executable, "-c", code, "experiment", "push_box", "--out", str(folder), *options],
        env={**os.environ, "PYTHONPATH": path}, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_control_c_keeps_what_is_finished(tmp_path, jobs):
    first = interrupted(tmp_path, "--jobs", jobs)
    record = tmp_path / "finished_runs" / "waits.waits"
    deadline = time.monotonic() + 60.0
    while first.poll() is None and time.monotonic() < deadline:
        if record.exists() and record.read_bytes().count(b"\x80\x05") == 4:  # pickles
            break
        time.sleep(0.05)
    os.killpg(first.pid, signal.SIGINT)
    out, errors = first.communicate(timeout=180.0)
    assert first.returncode == 130, errors
    assert "4 of 8 runs are kept" in errors and "--resume" in errors and "Traceback" not in errors
    (tmp_path / "go").touch()
    second = interrupted(tmp_path, "--jobs", jobs, "--resume")
    out, errors = second.communicate(timeout=180.0)
    assert second.returncode == 0, errors
    assert "waits: 4 of 8 runs taken over" in out
    assert "results [0, 1, 2, 3, 4, 5, 6, 7]" in out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"jobs": -1}, "jobs = -1"),
        ({"jobs": 2.0}, "jobs = 2.0"),
        ({"jobs": True}, "jobs = True"),
        ({"scheduler": " "}, "an address such as tcp"),
        ({"scheduler": "tcp://127.0.0.1:8786", "jobs": 2}, "either jobs or a scheduler"),
        ({"resume": True}, "needs the folder"),
    ],
)
def test_executions_that_make_no_sense_are_refused(options, message):
    with pytest.raises(InvalidInputError, match=message):
        Execution(**options)


def test_an_execution_from_the_command_line(tmp_path):
    common = {"out": str(tmp_path), "resume": True}
    here = Execution.from_arguments(argparse.Namespace(jobs=None, scheduler=None, **common))
    assert (here.jobs, here.folder, here.resume) == (0, tmp_path, True)
    there = Execution.from_arguments(argparse.Namespace(jobs=None, scheduler="tcp://a:1", **common))
    assert (there.jobs, there.scheduler) == (1, "tcp://a:1")


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense"])
def test_a_scheduler_that_does_not_answer_is_named(address, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("sim_bridge.experiments.runs.workers.CONNECT_SECONDS", 0.5)
    with pytest.raises(ConfigurationError, match=f"no Dask scheduler answers at {address} within 0.5 s"):
        run_trials(random_sum, range(2), Execution(scheduler=address), "nobody")


def test_workers_of_another_version_are_refused(scheduler, monkeypatch):
    monkeypatch.setattr("sim_bridge.experiments.runs.workers.__version__", "99.0")
    with pytest.raises(ConfigurationError, match=r"has vpsto_ros .*, here it is 99\.0"):
        run_trials(random_sum, range(2), Execution(scheduler=scheduler), "other version")


def test_workers_with_other_code_are_refused(scheduler, monkeypatch):
    monkeypatch.setattr("sim_bridge.experiments.runs.workers.digest", lambda files: "another")
    with pytest.raises(ConfigurationError, match=r"vpsto_ros .*\(code \w{12}\), here it is .*code another"):
        run_trials(random_sum, range(2), Execution(scheduler=scheduler), "other code")


def test_tasks_are_named_by_their_seed():
    named = argparse.Namespace(name="vpsto", seed=7)
    assert describe(5) == "seed 5"
    assert describe(named) == "name vpsto, seed 7"
    assert describe((argparse.Namespace(name="a"), argparse.Namespace(seed=3))) == "name a, seed 3"
    assert describe({"seed": 4, "start": 1.0}) == "seed 4"
    assert describe(("LR", 3)) == "task ('LR', 3)"
    assert len(describe("x" * 10000)) < 100
