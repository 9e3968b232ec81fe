"""What shots amount to: scores, speeds, banks, how well chances were known, rules, step times."""

import collections
import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from sim_bridge.experiments.hockey.shooting_players import BASELINES, PLAYERS
from sim_bridge.experiments.hockey.shooting_trials import ShotResult
from sim_bridge.experiments.runs import markdown_table, success_interval

SCORES = {"conservative": 0.97, "balanced": 0.92, "aggressive": 0.80, "forced_bank": 0.65, "moving": 0.90}
"""Shares of shots that are to score, by player.

There is none for "aggressive_thesis", which takes shots that are just likely enough: it is there to
compare with.
"""
SPEEDS = {"conservative": 1.3, "balanced": 1.44, "aggressive": 1.6, "forced_bank": 1.3}
"""Mean speeds at the goal line that are to be reached [m/s]."""
STEP_P99, STEP_MAX = 10.0, 20.0
"""Processor time that 99 % of the agent's steps may take, and that every one may [ms]."""
_SHOWN = 20  # misses that are listed by seed and player


def summarise(found: Sequence[ShotResult]) -> dict[str, Any]:
    """A row for every player, and what holds for all of them."""
    names = [name for name in PLAYERS if any(shot.task.name == name for shot in found)]
    rows = {name: _row([shot for shot in found if shot.task.name == name]) for name in names}
    moving = {"moving_conservative_score": rows["moving"]["score"]} if "moving" in rows else {}
    return {
        **rows, **moving,
        "constraint_violations": sum(row["violations"] for row in rows.values()),
        "violations_by_kind": dict(_violations(found)),
        **_times([shot for shot in found if shot.task.name not in BASELINES] or found),
        "step_time": "processor time of the agent's steps, all of them, with gc.freeze() before each shot; "
        "step_wall_ms_*: by the clock, which what else runs on the machine adds to",
    }  # fmt: skip


def _row(found: Sequence[ShotResult]) -> dict[str, Any]:
    """Of one player."""
    goals = [shot for shot in found if shot.scored]
    speeds = np.array([shot.goal_speed for shot in goals])
    predicted = np.array([shot.predicted for shot in found])
    known = predicted[np.isfinite(predicted)]
    committed = [shot.scored for shot in found if np.isfinite(shot.predicted)]
    return {
        "shots": len(found),
        "score": len(goals) / len(found),
        "score_interval": success_interval(len(goals), len(found)),
        "speed_mean": _mean(speeds),
        "speed_std": float(speeds.std()) if len(goals) else None,
        "banks_mean": _mean(shot.banks for shot in goals),
        "predicted_mean": _mean(known),
        "observed_of_predicted": _mean(committed),
        "reliability": reliability(found),
        "touched": sum(shot.mallet is not None for shot in found) / len(found),
        "mallet_along_rms": _rms(shot.mallet_error[0] for shot in found),
        "mallet_across_rms": _rms(shot.mallet_error[1] for shot in found),
        "mallet_speed_error_rms": _rms(shot.mallet_error[2] for shot in found),
        "mallet_speed_mean": _mean(shot.shot.speed for shot in found if shot.shot is not None),
        "violations": sum(sum(shot.violations.values()) for shot in found),
        "shots_with_violations": [shot.task.seed for shot in found if shot.violations],
        "refused": sum(shot.refused for shot in found),
        "misses": {str(shot.task.seed): shot.end for shot in found if not shot.scored},
        **_times(found),
    }


BINS = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0)
"""Edges of the chances that are compared with what happened."""


def reliability(found: Sequence[ShotResult]) -> list[dict[str, Any]]:
    """Predicted and observed shares of goals, by predicted chance."""
    rows = []
    for low, high in itertools.pairwise(BINS):
        last = high == BINS[-1]
        chosen = [shot for shot in found if low <= shot.predicted < high or (last and shot.predicted == high)]
        if chosen:
            goals = sum(shot.scored for shot in chosen)
            rows.append({
                "from": low, "to": high, "shots": len(chosen),
                "predicted": _mean(shot.predicted for shot in chosen), "observed": goals / len(chosen),
                "interval": success_interval(goals, len(chosen)),
            })  # fmt: skip
    return rows


def _violations(found: Sequence[ShotResult]) -> collections.Counter[str]:
    """Control cycles beyond limits and against rules, by kind."""
    total: collections.Counter[str] = collections.Counter()
    for shot in found:
        total.update(shot.violations)
    return total


def _times(found: Sequence[ShotResult]) -> dict[str, float]:
    """Of the agent's steps [ms]."""
    computing = 1e3 * np.concatenate([shot.computing for shot in found])
    elapsed = 1e3 * np.concatenate([shot.elapsed for shot in found])
    return {
        "step_ms_median": float(np.median(computing)),
        "step_ms_p99": float(np.quantile(computing, 0.99)),
        "step_ms_max": float(computing.max()),
        "step_wall_ms_p99": float(np.quantile(elapsed, 0.99)),
        "step_wall_ms_max": float(elapsed.max()),
    }


def _finite(values: Iterable[float]) -> np.ndarray:
    array = np.array(list(values), dtype=float)
    return array[np.isfinite(array)]


def _mean(values: Iterable[float]) -> float | None:
    finite = _finite(values)
    return float(finite.mean()) if finite.size else None


def _rms(values: Iterable[float]) -> float | None:
    finite = _finite(values)
    return float(np.sqrt(np.mean(finite**2))) if finite.size else None


def missed_targets(summary: dict[str, Any], asked: Sequence[str] = PLAYERS) -> list[str]:
    """What falls short, in words; a player that was asked to shoot and did not falls short, too."""
    checks = {}
    for name, least in SCORES.items():
        if name not in asked:
            continue
        row = summary.get(name)
        if row is None:
            checks[f"{name} did not shoot"] = False
            continue
        low, high = row["score_interval"]
        of = f"{100 * row['score']:.1f} % ({100 * low:.0f}-{100 * high:.0f}) of {row['shots']}"
        checks[f"{name} scores in {of} shots, wanted {100 * least:g} %"] = row["score"] >= least
        if name in SPEEDS:
            speed = row["speed_mean"] or 0.0
            text = f"{name} shoots at {speed:.2f} m/s, wanted {SPEEDS[name]:g}"
            checks[text] = speed >= SPEEDS[name]
    broken = summary["constraint_violations"]
    kinds = ", ".join(f"{kind} {count}" for kind, count in summary["violations_by_kind"].items())
    checks[f"limits or rules are broken in {broken} cycles ({kinds})"] = broken == 0
    refused = sum(row["refused"] for name, row in summary.items() if name in PLAYERS)
    checks[f"the arm's controller refused {refused} trajectories"] = refused == 0
    for key, most in (("p99", STEP_P99), ("max", STEP_MAX)):
        value = summary[f"step_ms_{key}"]
        checks[f"the agent's steps take {value:.1f} ms ({key}), allowed {most:g}"] = value <= most
    return [text for text, good in checks.items() if not good]


def table(summary: dict[str, Any]) -> str:
    """A row for every player, and misses to be looked at."""
    header = [
        "player", "shots", "score", "speed m/s", "banks", "predicted", "mallet across, along",
        "broken", "step p99, max",
    ]  # fmt: skip
    names = [name for name in PLAYERS if name in summary]
    text = markdown_table(header, [[name, *_cells(summary[name])] for name in names])
    misses = [f"{name} {seed}: {end}" for name in names for seed, end in summary[name]["misses"].items()]
    if misses:
        more = f" and {len(misses) - _SHOWN} more" if len(misses) > _SHOWN else ""
        text += f"\nMisses by seed: {'; '.join(misses[:_SHOWN])}{more}.\n"
    return text


def _cells(row: dict[str, Any]) -> list[str]:
    low, high = row["score_interval"]
    cells = [str(row["shots"]), f"{row['score']:.2f} ({low:.2f}-{high:.2f})"]
    cells.append("" if row["speed_mean"] is None else f"{row['speed_mean']:.2f} ± {row['speed_std']:.2f}")
    cells += ["" if row[key] is None else f"{row[key]:.2f}" for key in ("banks_mean", "predicted_mean")]
    errors = [row["mallet_across_rms"], row["mallet_along_rms"]]
    cells.append("" if errors[0] is None else ", ".join(f"{1e3 * error:.1f} mm" for error in errors))
    return [*cells, str(row["violations"]), f"{row['step_ms_p99']:.1f}, {row['step_ms_max']:.1f} ms"]
