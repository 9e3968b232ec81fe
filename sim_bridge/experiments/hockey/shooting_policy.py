"""The energy-based shooting policy (5.3.3, 5.3.4) against the direct search whose results it learned.

Every run draws pucks at the touch that training has not seen and asks both for a shot, in the three settings
of 5.4.2: how much of the objective (5.12) the policy's angle reaches, judged by the stochastic model, and how
long both take. An angle that breaks the chance constraint counts as nothing.
"""

import argparse
import functools
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_bridge.experiments.hockey import shooting_policy_figure
from sim_bridge.experiments.runs import (
    Execution,
    markdown_table,
    print_verdict,
    run_trials,
    success_interval,
    write_summary,
)
from sim_bridge.learn.shooting_comparison import Comparison, compare
from vpsto_ros.contact.puck import SHIPPED as MODEL
from vpsto_ros.contact.puck import PuckModel
from vpsto_ros.planning.hockey.shooting_config import SETTINGS, ShootingConfig, Shot
from vpsto_ros.planning.hockey.shooting_policy import SHIPPED, ShootingPolicy
from vpsto_ros.planning.hockey.shooting_search import ShotSearch
from vpsto_ros.planning.hockey.shooting_training import TrainingConfig, states
from vpsto_ros.planning.hockey.strikes import StrikeTable

PUCKS = 10
"""Per run and setting."""
RATIO = 0.95
"""Wanted of the objective, in each setting."""
TIME = 1.0
"""Allowed of a step of inference, and of direct search for a contact time, at the median [ms]."""
_STREAM = 3  # no puck that a policy is trained with, whatever the seed
_CONFIG = TrainingConfig()


def trial(task: tuple[int, str]) -> dict[str, list[Comparison]]:
    """Comparisons for the pucks of a seed, by setting."""
    seed, path = task
    found = {}
    for setting in SETTINGS:
        search, policy = searcher(setting), ShootingPolicy.load(setting, *models(), path)
        rng = np.random.default_rng((_STREAM, seed))
        pucks = states(search, PUCKS, _CONFIG.fastest, rng)
        found[setting] = [compare(search, policy, puck, _CONFIG.covariance, rng) for puck in pucks]
    return found


@functools.cache
def models() -> tuple[PuckModel, StrikeTable]:
    """Those of puck and arm that come with the package."""
    return PuckModel.load(MODEL), StrikeTable.load()


@functools.cache
def searcher(setting: str) -> ShotSearch:
    """Direct search with these."""
    return ShotSearch(*models(), ShootingConfig(objective=SETTINGS[setting]))


def warm_up() -> None:
    """Compile and load what is timed."""
    for setting in SETTINGS:
        searcher(setting).best(0.0, np.array([-0.4, 0.0, 0.0, 0.0]), _CONFIG.covariance)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which policies."""
    parser.add_argument(
        "--policies", default=str(SHIPPED), metavar="FILE",
        help="written by vpsto learn shooting_policy (default: those that come with the package)",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Compare; 0 when the policies are as good and as quick as wanted.

    Raises:
        ConfigurationError: the file holds no policies, or some of other settings, puck or arm.
    """
    policies = {s: ShootingPolicy.load(s, *models(), arguments.policies) for s in SETTINGS}
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    tasks = [(seed, str(arguments.policies)) for seed in seeds]
    runs = run_trials(trial, tasks, Execution.from_arguments(arguments), "shooting_policy", warm_up)
    found = {setting: [c for each in runs for c in each[setting]] for setting in SETTINGS}
    summary = {
        "experiment": "shooting_policy", "seed": arguments.seed, "runs": arguments.runs,
        **summarise(found), "training_s": training_time(policies),
    }  # fmt: skip
    folder = pathlib.Path(arguments.out)
    write_summary(folder, summary)
    text = table(summary)
    (folder / "table.md").write_text(text)
    shooting_policy_figure.write(folder / "shooting_policy.png", {s: searcher(s) for s in SETTINGS}, policies)
    print(f"{text}\nresults in {folder}")
    missed = missed_targets(summary)
    ratios = ", ".join(f"{summary['settings'][s]['objective_ratio']:.3f} ({s})" for s in SETTINGS)
    step, search = summary["inference_ms_p50"], summary["direct_search_ms_p50"]
    times = f"a step takes {step:.2f} ms, direct search {search:.2f} ms"
    good = f"policies reach {ratios} of the objective; {times}"
    return print_verdict(not missed, "; ".join(missed) or good)


def training_time(policies: dict[str, ShootingPolicy]) -> float:
    """How long the training of all took [s], as their file says."""
    return float(sum(p.origin["settings"][s].get("training_s", np.nan) for s, p in policies.items()))


def missed_targets(summary: dict[str, Any]) -> list[str]:
    """What falls short, in words."""
    missed = [
        f"the {setting} policy reaches {row['objective_ratio']:.3f} of the objective, wanted {RATIO:g}"
        for setting, row in summary["settings"].items()
        if not row["objective_ratio"] >= RATIO
    ]
    for key, name in (("inference_ms_p50", "a step of inference"), ("direct_search_ms_p50", "direct search")):
        if not summary[key] <= TIME:
            missed.append(f"{name} takes {summary[key]:.2f} ms at the median, allowed {TIME:g} ms")
    return missed


def summarise(found: dict[str, list[Comparison]]) -> dict[str, Any]:
    """Figures over all settings and by setting."""
    everything = [c for each in found.values() for c in each]
    return {**statistics(everything), "settings": {s: statistics(each) for s, each in found.items()}}


def statistics(found: Sequence[Comparison]) -> dict[str, Any]:
    """Ratio of the objectives with its interval, times, and what both choose where there is a good shot."""
    solved = [c for c in found if c.direct is not None]
    ratios = np.array([c.ratio for c in solved])
    kept = int((ratios > 0.0).sum())
    steps = np.concatenate([c.inference_s for c in found])
    searches = np.array([c.direct_s for c in found])
    return {
        "pucks": len(found),
        "solved": len(solved),
        **_mean(ratios, "objective_ratio"),
        "kept": kept / max(len(solved), 1),
        "kept_interval": success_interval(kept, len(solved)) if solved else (0.0, 1.0),
        "inference_ms_p50": 1e3 * float(np.median(steps)),
        "inference_ms_p99": 1e3 * float(np.quantile(steps, 0.99)),
        "direct_search_ms_p50": 1e3 * float(np.median(searches)),
        "direct_search_ms_p99": 1e3 * float(np.quantile(searches, 0.99)),
        "direct": _shots([c.direct for c in solved]),
        "policy": _shots([c.policy for c in solved]),
    }


def _mean(values: np.ndarray, name: str) -> dict[str, Any]:
    """Mean and its 95 % interval, by the central limit theorem."""
    if not len(values):
        return {name: 0.0, f"{name}_interval": (0.0, 0.0)}
    mean, error = float(values.mean()), float(values.std() / np.sqrt(len(values)))
    return {name: mean, f"{name}_interval": (mean - 1.96 * error, mean + 1.96 * error)}


def _shots(shots: Sequence[Shot | None]) -> dict[str, float]:
    """Means over those that come to the goal line."""
    there = [shot for shot in shots if shot is not None]
    if not there:
        return {}
    return {
        name: float(np.mean([getattr(shot, name) for shot in there]))
        for name in ("goal", "goal_speed", "banks")
    }


def table(summary: dict[str, Any]) -> str:
    """Two rows per setting."""
    header = [
        "setting", "by", "objective", "keeps the constraint", "chance", "speed at the goal", "banks", "time",
    ]  # fmt: skip
    rows = []
    for setting, row in summary["settings"].items():
        low, high = row["objective_ratio_interval"]
        kept = row["kept_interval"]
        direct = ["1", "100 %", *_cells(row["direct"]), f"{row['direct_search_ms_p50']:.2f} ms"]
        policy = [
            f"{row['objective_ratio']:.3f} ({low:.3f}–{high:.3f})",
            f"{100 * row['kept']:.1f} % ({100 * kept[0]:.1f}–{100 * kept[1]:.1f})", *_cells(row["policy"]),
            f"{row['inference_ms_p50']:.3f} ms a step",
        ]  # fmt: skip
        rows += [[setting, "direct search", *direct], ["", "policy", *policy]]
    return markdown_table(header, rows)


def _cells(shots: dict[str, float]) -> list[str]:
    if not shots:
        return ["", "", ""]
    return [f"{shots['goal']:.2f}", f"{shots['goal_speed']:.2f} m/s", f"{shots['banks']:.2f}"]
