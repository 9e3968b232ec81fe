import signal
import subprocess
import sys
import time

import pytest

from sim_bridge.demo.processes import ProcessGroup

OBEDIENT = """
import time
try:
    print('here')
    time.sleep(60)
except KeyboardInterrupt:
    print('bye')
"""
STUBBORN = """
import signal, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
print('here')
time.sleep(60)
"""
DEAF = STUBBORN.replace("print", "signal.signal(signal.SIGTERM, signal.SIG_IGN)\nprint")


def start(group, name, code):
    group.start(name, [sys.executable, "-u", "-c", code])
    deadline = time.monotonic() + 20.0
    while "here" not in group.last_lines(name) and not group.ended():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_an_interrupt_ends_a_process_in_its_own_way(tmp_path):
    with ProcessGroup(tmp_path / "logs", {}) as group:
        start(group, "one", OBEDIENT)
        assert group.stop() == {"one": 0}
    assert group.log_path("one").read_text() == "here\nbye\n"


@pytest.mark.parametrize(("code", "number"), [(STUBBORN, signal.SIGTERM), (DEAF, signal.SIGKILL)])
def test_stronger_signals_follow(tmp_path, code, number):
    with ProcessGroup(tmp_path, {}) as group:
        start(group, "one", code)
        assert group.stop(patience=0.3) == {"one": -number}


def test_nothing_survives_an_exception(tmp_path):
    with pytest.raises(RuntimeError), ProcessGroup(tmp_path, {}) as group:
        start(group, "one", OBEDIENT)
        raise RuntimeError
    assert group.exit_codes == {"one": 0}


def test_a_process_that_ends_is_noticed_with_its_last_words(tmp_path):
    with ProcessGroup(tmp_path, {"GREETING": "hello"}) as group:
        group.start(
            "one", [sys.executable, "-c", "import os, sys; print(os.environ['GREETING']); sys.exit(3)"]
        )
        deadline = time.monotonic() + 20.0
        while not group.ended() and time.monotonic() < deadline:
            time.sleep(0.01)
        assert group.ended() == ["one"]
        assert group.last_lines("one") == "hello"
    assert group.exit_codes == {"one": 3}


def test_a_signal_during_a_start_leaves_no_child_behind(tmp_path, monkeypatch):
    started = []
    popen = subprocess.Popen

    def interrupted(*arguments, **options):
        started.append(popen(*arguments, **options))
        signal.raise_signal(signal.SIGINT)
        return started[-1]

    monkeypatch.setattr("sim_bridge.demo.processes.subprocess.Popen", interrupted)
    with pytest.raises(KeyboardInterrupt), ProcessGroup(tmp_path, {}) as group:
        group.start("sleeper", [sys.executable, "-c", "import time; time.sleep(60)"])
    assert started[0].poll() is not None
