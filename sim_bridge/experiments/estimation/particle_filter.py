"""The particle filter of an object, with touch and without, against a filter that does not know the robot.

Two arms in MuJoCo push a can along a scripted path. Its mass, friction, centre of mass and support vary and
are unknown to the filters. The camera is noisy and late, loses single pictures, sees nothing for a second
twice, and shows something else now and then; in blind pushes there is one bad picture and no more.
"""

import argparse
import pathlib

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.estimation import particle_filter_figure
from sim_bridge.experiments.estimation.episodes import Episode
from sim_bridge.experiments.estimation.filters import VARIANTS, Comparison, compare
from sim_bridge.experiments.runs import Execution, markdown_table, print_verdict, run_trials, write_summary

KINDS = {"two_balls": "two balls", "one_ball": "one ball", "blind": "two balls, one bad picture"}
LATENCY = 0.04
"""Pictures arrive for so long after a drop-out has begun, and come again so long after its end [s]."""
MOST = {"particles_to_kalman": 0.2, "touch_blind": 0.5}
"""Largest ratios of mean errors, upper ends of intervals, at which knowing the robot and feeling pay."""
COVERED = 0.85
"""Least share of the time for which the can is to be within the 95 % ellipse."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Nothing beyond the options of every experiment."""


def run(arguments: argparse.Namespace) -> int:
    """Run all episodes and print the table; 0 when knowing the robot, and feeling, pay as they should."""
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    episodes = [Episode(kind, seed) for kind in KINDS for seed in seeds]
    found = run_trials(
        compare, episodes, Execution.from_arguments(arguments), "particle_filter", particle_filter_warm_up
    )
    rows = [
        {"kind": kind, "variant": variant, **summarise([c for c in found if c.episode.kind == kind], variant)}
        for kind in KINDS
        for variant in VARIANTS
    ]
    ratios = {
        f"{kind}: {one} to {other}": _ratio(found, kind, one, other)
        for kind in KINDS
        for one, other in (("particles", "kalman"), ("touch", "particles"), ("touch_sum", "particles"))
    }
    summary = {
        "experiment": "particle_filter", "seed": arguments.seed, "runs": arguments.runs, "rows": rows,
        "ratios": ratios,
    }  # fmt: skip
    folder = pathlib.Path(arguments.out)
    write_summary(folder, summary)
    table = _table(rows)
    (folder / "table.md").write_text(table)
    particle_filter_figure.write(folder / "particle_filter.png", found)
    print(f"{table}\nresults in {folder}")
    return verdict(summary)


def particle_filter_warm_up() -> None:
    """Compile what the runs use."""
    compare(Episode("blind", 0))


def unseen(comparison: Comparison) -> NDArray[np.bool_]:
    """When no picture arrives after the can has been touched, shape (K,)."""
    times, blind = comparison.times, np.zeros(len(comparison.times), dtype=bool)
    for begin, end in comparison.dropouts:
        blind |= (times > begin + LATENCY) & (times < end + LATENCY)
    return blind & (times >= comparison.touched)


def mean_unseen_error(comparison: Comparison, variant: str) -> float:
    """Mean error of one filter while the can is pushed and not seen [m]."""
    return float(np.nanmean(comparison.tracks[variant].error[unseen(comparison)]))


def summarise(comparisons: list[Comparison], variant: str) -> dict[str, object]:
    """Errors [m] of a filter over the episodes of one kind, with bootstrapped 95 % intervals of the means."""
    blind = np.array([mean_unseen_error(c, variant) for c in comparisons])
    seen, worst, inside = [], [], []
    for c in comparisons:
        track, touched, dark = c.tracks[variant], c.times >= c.touched, unseen(c)
        worst.append(float(np.nanmax(track.error[dark])))
        inside.append(float(track.inside[touched].mean()))
        if c.episode.kind != "blind":
            seen.append(float(np.nanmean(track.error[touched & ~dark])))
    return {
        "unseen_mean": float(blind.mean()), "unseen_interval": interval(blind),
        "unseen_median": float(np.median(blind)), "worst_median": float(np.median(worst)),
        "worst_p90": float(np.quantile(worst, 0.9)), "seen_mean": float(np.mean(seen)) if seen else None,
        "seen_interval": interval(np.array(seen)) if seen else None, "covered": float(np.mean(inside)),
        "covered_interval": interval(np.array(inside)),
    }  # fmt: skip


def interval(values: NDArray, resamples: int = 2000) -> tuple[float, float]:
    """Bootstrapped 95 % interval of a mean over episodes."""
    rng = np.random.default_rng(0)
    means = values[rng.integers(len(values), size=(resamples, len(values)))].mean(axis=1)
    return float(np.quantile(means, 0.025)), float(np.quantile(means, 0.975))


def _ratio(found: list[Comparison], kind: str, one: str, other: str) -> tuple[float, float, float]:
    """Mean error of one filter over that of another on the same episodes, with its bootstrapped interval."""
    pairs = np.array([
        [mean_unseen_error(c, one), mean_unseen_error(c, other)] for c in found if c.episode.kind == kind
    ])  # fmt: skip
    rows = np.random.default_rng(0).integers(len(pairs), size=(2000, len(pairs)))
    means = pairs[rows].mean(axis=1)
    low, high = np.quantile(means[:, 0] / means[:, 1], [0.025, 0.975])
    mean = pairs.mean(axis=0)
    return float(mean[0] / mean[1]), float(low), float(high)


def verdict(summary: dict) -> int:
    """Print what knowing the robot and feeling are worth; 0 when both pay and the belief tells the truth."""
    ratios = summary["ratios"]
    known = [ratios[f"{kind}: particles to kalman"] for kind in ("two_balls", "one_ball")]
    felt = ratios["blind: touch to particles"]
    covered = min(row["covered"] for row in summary["rows"] if row["variant"] != "kalman")
    good = (
        max(high for _, _, high in known) <= MOST["particles_to_kalman"]
        and felt[2] <= MOST["touch_blind"]
        and covered >= COVERED
    )
    names = ("two balls through drop-outs", "one ball through drop-outs")
    text = ", ".join(f"{_between(value)} {name}" for value, name in zip(known, names, strict=True))
    text += f", of that of Kalman filters; with touch {_between(felt)} of that without, blind"
    return print_verdict(good, f"error {text}; least share within 95 % ellipses {100 * covered:.0f} %")


def _between(value: tuple[float, float, float]) -> str:
    return "{:.2f} ({:.2f}-{:.2f})".format(*value)


def _table(rows: list[dict]) -> str:
    header = [
        "push", "filter", "error while pushed and unseen, mean (95 %)", "median", "worst, median / p90",
        "while seen (95 %)", "within 95 % ellipse",
    ]  # fmt: skip
    return markdown_table(header, [
        [
            KINDS[r["kind"]], VARIANTS[r["variant"]], _millimetres(r["unseen_mean"], r["unseen_interval"]),
            _millimetres(r["unseen_median"]),
            f"{1e3 * r['worst_median']:.1f} / {_millimetres(r['worst_p90'])}",
            "-" if r["seen_mean"] is None else _millimetres(r["seen_mean"], r["seen_interval"]),
            f"{100 * r['covered']:.0f} %",
        ]
        for r in rows
    ])  # fmt: skip


def _millimetres(value: float, between: tuple[float, float] | None = None) -> str:
    bounds = "" if between is None else f" ({1e3 * between[0]:.1f}-{1e3 * between[1]:.1f})"
    return f"{1e3 * value:.1f}{bounds} mm"
