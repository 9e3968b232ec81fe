import argparse
import json

import numpy as np
import pytest

from sim_bridge import bench
from vpsto_ros.exceptions import InvalidInputError


def test_rows_have_the_promised_columns(tmp_path, monkeypatch, capsys):
    fast = {
        "first": lambda: bench.statistics([0.001, 0.003], cores=1),
        "second": lambda: bench.statistics([0.5], cores=2),
    }
    monkeypatch.setattr(bench, "BENCHMARKS", fast)
    assert bench.run(argparse.Namespace(json=str(tmp_path / "bench.json"), only=None)) == 0
    rows = json.loads((tmp_path / "bench.json").read_text())
    assert [row["name"] for row in rows] == ["first", "second"]
    assert set(rows[0]) == {"name", "cores", "p50_ms", "p99_ms", "max_ms"}
    assert rows[0]["p50_ms"] == pytest.approx(2.0)
    assert rows[0]["max_ms"] == pytest.approx(3.0)
    assert "first" in capsys.readouterr().out


def test_an_unknown_row_is_refused_with_those_that_exist():
    with pytest.raises(InvalidInputError, match="synthesis_b100_n7_via4_k50"):
        bench.run(argparse.Namespace(json=None, only="nothing"))


def test_percentiles_are_of_the_durations():
    seconds = list(np.linspace(0.0, 0.1, 101))
    row = bench.statistics(seconds, cores=1)
    assert row["p50_ms"] == pytest.approx(50.0)
    assert row["p99_ms"] == pytest.approx(99.0)
    assert row["max_ms"] == pytest.approx(100.0)


def test_every_row_measures_something(monkeypatch):
    monkeypatch.setattr(
        bench, "repeat", lambda action, times: bench.statistics(bench.measure(action, 2), cores=1)
    )
    for measure in (bench.synthesis, bench.vpsto_iteration):
        assert measure()["p50_ms"] > 0.0


def test_the_row_of_the_driver_node_is_there_with_ros_and_leaves_no_context():
    rclpy = pytest.importorskip("rclpy")
    row = bench.BENCHMARKS["driver_node"]()
    assert row["p50_ms"] > 0.0
    assert row["real_time_factor"] == pytest.approx(1e3 / row["p50_ms"])
    assert not rclpy.ok()
