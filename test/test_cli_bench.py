import argparse
import json
import os

import numpy as np
import pytest

from sim_bridge import bench, cli
from sim_bridge.bench import belief_rows, hockey_rows, library_rows, system_rows
from sim_bridge.bench.comparison import compare
from sim_bridge.bench.growth import exponent, growth_tables, in_words
from sim_bridge.bench.measuring import (
    QUICK,
    Cores,
    Effort,
    Row,
    Wanted,
    at_most,
    durations,
    measure_once,
    on_cores,
    statistics,
)
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError


def instant(_cores):
    return lambda: None


def options(**changes):
    given = {"json": None, "only": None, "compare": None, "fail_above": None, "check": False, "quick": True}
    return argparse.Namespace(**given | changes)


def row_entries(name, p50, cores=1, **more):
    return {"name": name, "cores": cores, "p50_ms": p50, "p99_ms": p50, "max_ms": p50, "mean_ms": p50, **more}


def test_rows_have_the_promised_columns(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "usable_cores", lambda: 2)
    monkeypatch.setattr(bench, "ROWS", (Row("first", instant), Row("second", instant)))
    assert bench.run(options(json=str(tmp_path / "bench.json"))) == 0
    rows = json.loads((tmp_path / "bench.json").read_text())
    assert [(row["name"], row["cores"]) for row in rows] == [
        ("first", 1), ("first", 2), ("second", 1), ("second", 2),
    ]  # fmt: skip
    assert set(rows[0]) == {"name", "cores", "p50_ms", "p99_ms", "max_ms", "mean_ms", "noise", "quick"}
    printed = capsys.readouterr().out
    assert [line.split()[:2] for line in printed.splitlines()[1:5]] == [
        ["first", "1"], ["first", "2"], ["second", "1"], ["second", "2"],
    ]  # fmt: skip


def test_on_a_single_core_there_are_no_rows_for_two(monkeypatch, capsys):
    monkeypatch.setattr(bench, "usable_cores", lambda: 1)
    rows = bench.measure_all([Row("first", instant)], QUICK)
    assert [row["cores"] for row in rows] == [1]
    assert "only one core" in capsys.readouterr().out


def test_published_names_stay_and_are_unique():
    names = [row.name for row in bench.ROWS]
    assert len(set(names)) == len(names)
    assert {
        "synthesis_b100_n7_via4_k50", "vpsto_iteration_b64_n7_box", "mpc_step_push_box", "driver",
        "first_plan", "posture_checks", "basis_n7_via4_k50", "evaluate_n7_k1000",
    } <= set(names)  # fmt: skip


def test_an_unknown_row_is_refused_with_those_that_exist():
    with pytest.raises(InvalidInputError, match="synthesis_b100_n7_via4_k50"):
        bench.run(options(only="nothing"))


def test_statistics_are_of_the_durations():
    seconds = list(np.linspace(0.0, 0.1, 101))
    entries = statistics(Row("a", instant), 1, [seconds[:50], seconds[50:]])
    assert entries["p50_ms"] == pytest.approx(50.0)
    assert entries["p99_ms"] == pytest.approx(99.0)
    assert entries["max_ms"] == pytest.approx(100.0)
    assert entries["mean_ms"] == pytest.approx(49.5), "without the slowest percent"


def test_noise_is_what_parts_of_the_measurement_differ_by():
    row = Row("a", instant)
    steady = [[1.0, 1.1, 1.0] * 8] * 3
    assert statistics(row, 1, steady)["noise"] == pytest.approx(0.0)
    drifting = [[1.0] * 24, [1.2] * 24, [1.4] * 24]
    assert statistics(row, 1, drifting)["noise"] == pytest.approx(1.4826 * 0.2 / 1.2)
    disturbed = [[1.0, 1.1, 1.0] * 8, [1.0, 1.1, 1.0] * 8, [9.0] * 6 + [1.0] * 18]
    assert statistics(row, 1, disturbed)["noise"] == pytest.approx(0.0), "one part of twelve"


def test_a_row_derives_further_figures_from_its_median():
    row = Row("a", instant, derived=system_rows.real_time_factor)
    assert statistics(row, 1, [[0.1, 0.1]])["real_time_factor"] == pytest.approx(10.0)
    assert library_rows.checks_per_second(0.001) == {"checks_per_s": pytest.approx(1e6)}


@pytest.mark.parametrize("row", library_rows.ROWS, ids=lambda row: row.name)
@pytest.mark.parametrize("cores", [1, 2])
def test_every_row_of_the_library_measures_something(row, cores):
    assert min(measure_once(row, cores, QUICK)) > 0.0


@pytest.mark.parametrize("cores", [1, 2, 3])
@pytest.mark.parametrize("size", [1, 2, 7])
def test_shared_work_is_all_done_once(cores, size):
    place, done = Cores(cores), np.zeros(size, dtype=int)

    def work(part):
        done[part] += 1

    with place.cleanup:
        action = place.shared(work, size)
        action()
        action()
    np.testing.assert_array_equal(done, 2)


def test_an_error_in_another_thread_is_not_lost():
    place = Cores(2)

    def work(part):
        if part.start > 0:
            raise ValueError("second half")

    with place.cleanup, pytest.raises(ValueError, match="second half"):
        place.shared(work, 4)()


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system cannot pin processes")
def test_one_core_means_one_core():
    before = os.sched_getaffinity(0)
    with on_cores(1):
        assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(0) == before


def test_the_number_of_calls():
    assert len(measure_once(Row("a", instant, calls=9), 1, Effort())) == 9
    assert len(measure_once(Row("a", instant, calls=9), 1, QUICK)) == 4
    assert len(measure_once(Row("a", instant), 1, Effort(seconds=0.1, calls=50))) == 50
    assert durations(lambda: [1.0, 2.0], 2, own_times=True) == [1.0, 2.0, 1.0, 2.0]


def test_the_row_of_the_driver_node_is_there_with_ros_and_leaves_no_context():
    rclpy = pytest.importorskip("rclpy")
    (row,) = (row for row in bench.ROWS if row.name == "driver_node")
    assert min(measure_once(row, 1, Effort(calls=1))) > 0.0
    assert not rclpy.ok()


def test_growth_is_fitted_and_missing_rows_leave_the_table_out():
    assert exponent([1, 2, 4], [3.0, 6.0, 12.0]) == pytest.approx(1.0)
    rows = [
        row_entries(f"synthesis_b{b}_n{n}_via4_k50", 1e-3 * n * b**1.5)
        for n in library_rows.DOF
        for b in library_rows.BATCHES
    ]
    *table, powers, _ = growth_tables(rows).splitlines()
    assert "\n".join(table).count("1.50") == len(library_rows.DOF)
    assert powers.count("1.00") == len(library_rows.BATCHES)
    assert growth_tables(rows[1:]) == ""


@pytest.mark.parametrize(
    ("exponents", "words"),
    [
        ([0.9, 1.1], "about linearly (exponents 0.90 to 1.10)"),
        ([1.0], "about linearly (exponent 1.00)"),
        ([0.3, 0.5], "more slowly than linearly (exponents 0.30 to 0.50)"),
        ([0.9, 1.3], "FASTER than linearly (exponents 0.90 to 1.30)"),
    ],
)
def test_growth_in_words(exponents, words):
    assert in_words(exponents) == words


def test_the_sentence_below_a_table_is_about_its_exponents():
    rows = [
        row_entries(f"synthesis_b{b}_n{n}_via4_k50", 1e-3 * n**0.5 * b**2)
        for n in library_rows.DOF
        for b in library_rows.BATCHES
    ] + [
        row_entries(f"{label}_d{d}_m{library_rows.POPULATION}", d**power)
        for label, power in (("sep_cma", 1.0), ("cma", 2.0))
        for d in library_rows.DIMENSIONS
    ]
    words = [text for text in growth_tables(rows).splitlines() if "grows" in text]
    assert words == [
        "cost grows with the joints more slowly than linearly (exponent 0.50), "
        "with the candidates FASTER than linearly (exponent 2.00)",
        "sep-cma grows about linearly (exponent 1.00), cma grows FASTER than linearly (exponent 2.00)",
    ]


def test_growth_of_an_iteration_in_belief_space():
    rows = [row_entries(belief_rows.iteration_name(b, p, k), b * p**0.5 * k) for b, p, k in belief_rows.SIZES]
    *_, words = growth_tables(rows).splitlines()
    assert words == (
        "cost grows with the candidates about linearly (exponent 1.00), with the particles more slowly than "
        "linearly (exponent 0.50), with the steps about linearly (exponent 1.00)"
    )
    assert growth_tables(rows[1:]) == ""


@pytest.mark.parametrize("row", belief_rows.ROWS, ids=lambda row: row.name)
def test_every_row_in_belief_space_works(row):
    (first, *_) = measure_once(row, 1, Effort(calls=1))
    assert first > 0.0


@pytest.mark.parametrize("row", hockey_rows.ROWS, ids=lambda row: row.name)
def test_every_row_of_air_hockey_works(row):
    assert min(measure_once(row, 1, Effort(calls=3))) > 0.0


def test_the_figures_wanted():
    wanted = {row.name: (row.wanted.entry, row.wanted.bound) for row in bench.ROWS if row.wanted is not None}
    assert wanted == {
        "basis_n7_via4_k50": ("p50_ms", 0.3),
        "evaluate_n7_k1000": ("p50_ms", 0.3),
        "synthesis_b100_n7_via4_k50": ("p50_ms", 0.4),
        "vpsto_iteration_b64_n7_box": ("p50_ms", 2.0),
        "posture_checks": ("checks_per_s", 1e6),
        "solve_clutter_2d": ("p50_ms", 100.0),
        "belief_iteration_4dof_b30_p20_k50": ("p50_ms", 0.4),
        "belief_iteration_4dof_b30_p20_k50_rich": ("p50_ms", 0.8),
        "belief_iteration_14dof_b30_p20_k50": ("p50_ms", 1.0),
        "robust_circle_plan": ("p50_ms", 500.0),
        "robust_circle_plan_rich": ("p50_ms", 1500.0),
        "shot_planning_step": ("p99_ms", 3.0),
        "shot_planning_step_policy": ("p99_ms", 3.0),
        "shot_search_contact_time": ("p50_ms", 1.0),
        "shooting_policy_step": ("p50_ms", 1.0),
        "mpc_step_push_box": ("p99_ms", 16.0),
        "driver": ("real_time_factor", 20.0),
    }
    more_is_better = [row.name for row in bench.ROWS if row.wanted and row.wanted.at_least]
    assert more_is_better == ["posture_checks", "driver"]


@pytest.mark.parametrize(("milliseconds", "reached"), [(10.0, True), (200.0, False)])
def test_a_wanted_figure_is_judged_in_its_own_direction(milliseconds, reached):
    wanted = at_most(100.0)
    faster = Wanted("real_time_factor", 10.0, ">= 10 x real time", at_least=True)
    for figure in (wanted, faster):
        row = Row("a", instant, derived=system_rows.real_time_factor, wanted=figure)
        entries = statistics(row, 1, [[1e-3 * milliseconds] * 2])
        assert (entries["wanted"], entries["reached"]) == (figure.text, reached)
        assert f"{figure.text}: {'yes' if reached else 'NO'}" in bench.line(entries)
    assert wanted.text == "p50 <= 100 ms"
    assert "wanted" not in statistics(row, 2, [[1.0, 1.0]]), "figures are those of one core"


@pytest.mark.parametrize(
    ("bound", "arguments", "status"), [(1.0, [], 0), (1.0, ["--check"], 1), (3.0, ["--check"], 0)]
)
def test_wanted_figures_decide_only_when_asked(monkeypatch, capsys, bound, arguments, status):
    row = Row("only", lambda cores: lambda: [0.002], own_times=True, wanted=at_most(bound))
    monkeypatch.setattr(bench, "ROWS", (row, Row("free", instant)))
    assert cli.main(["bench", "--quick", *arguments]) == status
    printed = capsys.readouterr().out
    assert f"p50 <= {bound:g} ms: {'yes' if bound > 2.0 else 'NO'}" in printed
    assert ("verdict: FAILED: not reached: only (p50 <= 1 ms)" in printed) == (status == 1)
    assert ("verdict: passed: 1 figures reached" in printed) == (arguments != [] and status == 0)


def test_a_check_without_anything_to_check_is_refused(monkeypatch):
    monkeypatch.setattr(bench, "measure_all", None)
    with pytest.raises(ConfigurationError, match="no figure is wanted"):
        bench.run(options(only="evaluate_state", check=True))


def verdicts(old, new):
    return {change["name"]: change["verdict"] for change in compare(old, new)}


def test_a_change_counts_when_it_is_beyond_the_noise():
    noisy = [row_entries("a", 1.0, noise=0.1), row_entries("b", 1.0, noise=0.001)]
    later = [row_entries("a", 1.3, noise=0.1), row_entries("b", 1.3, noise=0.001)]
    assert verdicts(noisy, later) == {"a": "same", "b": "slower"}
    assert verdicts(later, noisy) == {"a": "same", "b": "faster"}
    assert verdicts(noisy, noisy) == {"a": "same", "b": "same"}


def test_a_difference_of_a_few_percent_is_never_a_change():
    old = [row_entries("a", 1.0, noise=0.0)]
    assert verdicts(old, [row_entries("a", 1.04, noise=0.0)]) == {"a": "same"}
    assert verdicts(old, [row_entries("a", 1.06, noise=0.0)]) == {"a": "slower"}


def test_old_files_without_noise_or_rows_are_compared_as_far_as_they_go():
    old = [row_entries("a", 1.0), row_entries("gone", 1.0)]
    new = [row_entries("a", 2.0, noise=0.4), row_entries("a", 2.0, cores=2, noise=0.0)]
    (change,) = compare(old, new)
    assert (change["name"], change["cores"], change["ratio"]) == ("a", 1, 2.0)
    assert change["verdict"] == "same" and change["band"] == pytest.approx(3.0 * np.hypot(0.4, 0.4))


@pytest.fixture
def one_row(monkeypatch):
    monkeypatch.setattr(bench, "ROWS", (Row("only", lambda cores: lambda: [0.002], own_times=True),))


@pytest.mark.parametrize(
    ("old_ms", "arguments", "status"),
    [(1.0, [], 0), (1.0, ["--fail-above", "1.5"], 1), (1.95, ["--fail-above", "1.5"], 0)],
)
def test_comparison_from_the_command_line(tmp_path, capsys, one_row, old_ms, arguments, status):
    old = [row_entries("only", old_ms), row_entries("gone", 1.0)]
    (tmp_path / "old.json").write_text(json.dumps(old))
    command = ["bench", "--quick", "--compare", str(tmp_path / "old.json"), *arguments]
    assert cli.main(command) == status
    printed = capsys.readouterr().out
    assert f"{2.0 / old_ms:.2f}" in printed and ("| slower" in printed) == (old_ms == 1.0)
    assert "one of the two was measured with --quick" in printed
    assert "only old: gone (1 core)" in printed
    assert ("FAILED: more than 1.5 times as long: only" in printed) == (status == 1)


def test_noise_does_not_fail_but_is_named(capsys):
    old, new = [row_entries("a", 1.0, noise=0.5)], [row_entries("a", 2.0, noise=0.5)]
    assert bench.report_changes(old, new, 1.5) == 0
    assert "too noisy to be judged, repeat on a quiet machine: a" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "No such file"),
        ("{", "not JSON"),
        ("[]", "not a file written by"),
        ('{"name": "a"}', "not a file written by"),
        ('[{"name": "a", "p50_ms": 0.0}]', "not a file written by"),
        ('[{"name": "a", "p50_ms": "1"}]', "not a file written by"),
        ('[{"name": "a", "p50_ms": NaN}]', "not a file written by"),
    ],
)
def test_what_cannot_be_compared_with_is_refused_before_measuring(tmp_path, content, message, monkeypatch):
    monkeypatch.setattr(bench, "measure_all", None)
    path = tmp_path / "old.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ConfigurationError, match=f"old.json.*{message}"):
        bench.run(options(compare=str(path)))


def test_options_that_cannot_work_are_refused_before_measuring(tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "measure_all", None)
    with pytest.raises(ConfigurationError, match="--fail-above needs --compare"):
        bench.run(options(fail_above=1.5))
    with pytest.raises(ConfigurationError, match=r"--json .*bench\.json: No such file or directory"):
        bench.run(options(json=str(tmp_path / "nowhere" / "bench.json")))
    full = tmp_path / "full.json"
    full.write_text(json.dumps([row_entries("driver", 1.0), row_entries("first_plan", 1.0)]))
    with pytest.raises(ConfigurationError, match="holds 1 rows that are not measured now and would be lost"):
        bench.run(options(only="first_plan", json=str(full)))
    with pytest.raises(ConfigurationError, match="this is the file to compare with"):
        bench.run(options(json=str(full), compare=str(full)))
