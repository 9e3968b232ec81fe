"""``vpsto bench``: how long the building blocks take on this machine, on one core and on two."""

from __future__ import annotations

import argparse
import json
import pathlib
from collections.abc import Sequence
from typing import Any

from tqdm import tqdm

from sim_bridge.bench import belief_rows, hockey_rows, library_rows, system_rows
from sim_bridge.bench.comparison import compare, comparison_table, place, read_rows
from sim_bridge.bench.growth import growth_tables
from sim_bridge.bench.measuring import QUICK, Effort, Row, measure_once, statistics, usable_cores
from sim_bridge.experiments.runs import print_verdict
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError

ROWS: tuple[Row, ...] = library_rows.ROWS + belief_rows.ROWS + hockey_rows.ROWS + system_rows.ROWS


def run(arguments: argparse.Namespace) -> int:
    """Measure, print tables and write JSON if asked to.

    Args:
        arguments: json (file or None), only (part of a name or None), compare (file or None), fail_above
            (ratio or None), check (bool), quick (bool).

    Returns:
        1 when a row takes more than `fail_above` times as long as in the file to compare with, beyond noise,
        or when `check` is asked for and a row does not reach the figure wanted of it; else 0. Without `check`
        such figures are only shown: machines differ.

    Raises:
        InvalidInputError: when no row has such a name.
        ConfigurationError: when a file cannot be read, has no rows, or cannot be written, or when there is
            nothing to check.
    """
    rows = [row for row in ROWS if not arguments.only or arguments.only in row.name]
    if not rows:
        names = ", ".join(row.name for row in ROWS)
        raise InvalidInputError(f"no row is called {arguments.only!r}; there are {names}")
    if arguments.fail_above is not None and not arguments.compare:
        raise ConfigurationError("--fail-above needs --compare FILE")
    if arguments.check and not any(row.wanted for row in rows):
        raise ConfigurationError("--check: no figure is wanted of these rows")
    old = read_rows(arguments.compare) if arguments.compare else None
    if old is not None and arguments.only:
        old = [row for row in old if arguments.only in row["name"]]
    if arguments.json:
        check_output(arguments.json, rows, arguments.compare)
    measured = measure_all(rows, QUICK if arguments.quick else Effort())
    for row in measured:
        row["quick"] = bool(arguments.quick)
    if arguments.json:
        pathlib.Path(arguments.json).write_text(json.dumps(measured, indent=2) + "\n")
    growth = growth_tables(measured)
    if growth:
        print(f"\n{growth}", end="")
    changed = 0 if old is None else report_changes(old, measured, arguments.fail_above)
    return max(changed, report_wanted(measured) if arguments.check else 0)


def check_output(path: str, rows: Sequence[Row], compare: str | None) -> None:
    """Refuse, before minutes of measuring, a file that cannot be written or whose rows would be lost.

    Raises:
        ConfigurationError: the message says why.
    """
    file = pathlib.Path(path)
    if compare and file.absolute() == pathlib.Path(compare).absolute():
        raise ConfigurationError(f"--json {path}: this is the file to compare with; give another one")
    if file.exists() and file.stat().st_size:
        lost = {row["name"] for row in read_rows(file, "--json")} - {row.name for row in rows}
        if lost:
            raise ConfigurationError(
                f"--json {path}: holds {len(lost)} rows that are not measured now and would be lost, such as "
                f"{min(lost)}; give another file"
            )
    try:
        with file.open("a"):
            pass
    except OSError as error:
        raise ConfigurationError(f"--json {path}: {error.strerror or error}") from error


def measure_all(rows: Sequence[Row], effort: Effort) -> list[dict[str, Any]]:
    """Measure every row on one core and on two, in passes over all of them; print each as it is complete."""
    counts = [count for count in (1, 2) if count <= usable_cores()]
    if counts == [1]:
        print("only one core may be used here: no rows for two")
    places = [(row, cores) for row in rows for cores in counts]
    passes: dict[tuple[str, int], list[list[float]]] = {(row.name, cores): [] for row, cores in places}
    results = []
    times = " ".join(f"{title:>10s}" for title in ("p50 [ms]", "p99 [ms]", "max [ms]"))
    print(f"{'name':38s} {'cores':>5s} {times}   wanted", flush=True)
    with tqdm(total=effort.passes * len(places), disable=None, leave=False) as bar:
        for number in range(effort.passes):
            for row, cores in places:
                bar.set_description(f"{row.name}, {cores} core{'s' if cores > 1 else ''}")
                passes[row.name, cores].append(measure_once(row, cores, effort))
                bar.update()
                if number == effort.passes - 1:
                    results.append(statistics(row, cores, passes[row.name, cores]))
                    bar.write(line(results[-1]))
    return results


def line(row: dict[str, Any]) -> str:
    """One row of the printed table."""
    times = " ".join(f"{row[key]:10.4f}" for key in ("p50_ms", "p99_ms", "max_ms"))
    wanted = f"{row['wanted']}: {'yes' if row['reached'] else 'NO'}" if "wanted" in row else ""
    extra = f"{row['real_time_factor']:.1f} x real time" if "real_time_factor" in row else ""
    if "checks_per_s" in row:
        extra = f"{row['checks_per_s'] / 1e6:.2f} million checks per second"
    return f"{row['name']:38s} {row['cores']:5d} {times}   {wanted:26s} {extra}".rstrip()


def report_wanted(measured: Sequence[dict[str, Any]]) -> int:
    """Print the verdict on the figures wanted; 1 when one is not reached."""
    judged = [row for row in measured if "wanted" in row]
    short = [f"{row['name']} ({row['wanted']})" for row in judged if not row["reached"]]
    found = f"not reached: {', '.join(short)}" if short else f"{len(judged)} figures reached"
    return print_verdict(not short, found)


def report_changes(
    old: Sequence[dict[str, Any]], new: Sequence[dict[str, Any]], fail_above: float | None
) -> int:
    """Print what became faster or slower; 1 when a row became slower by more than is allowed.

    A ratio that may be noise does not fail; that it cannot be judged is said.
    """
    changes = compare(old, new)
    print(f"\n{comparison_table(changes, old, new)}", end="")
    if any(row.get("quick", False) for row in old) != any(row.get("quick", False) for row in new):
        print("one of the two was measured with --quick, whose few repetitions say other things")
    if fail_above is None:
        return 0
    above = [change for change in changes if change["ratio"] > fail_above]
    worse = [place(change) for change in above if change["verdict"] == "slower"]
    unclear = [place(change) for change in above if change["verdict"] != "slower"]
    if unclear:
        print(f"too noisy to be judged, repeat on a quiet machine: {', '.join(unclear)}")
    verdict = f"FAILED: more than {fail_above:g} times as long: {', '.join(worse)}" if worse else "passed"
    print(f"verdict: {verdict}")
    return 1 if worse else 0
