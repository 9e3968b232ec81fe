"""Whether shots score as often as the puck model says (5.2.4).

Every run is a number of shots of the simulated arm (:mod:`sim_bridge.experiments.hockey.goal_shots`). Shots
with similar predicted probabilities are taken together: as many of them must score as was predicted, within
0.07, in every tenth with at least 30 shots, for all shots, for direct ones, and for those by way of walls.
Beside that, the probability is compared with many trajectories of the stochastic model itself.

What is judged is predicted as a planner has to: from states at the touch that are 1 mm and 10 mm/s off, which
the model is told. Predictions from the true states are shown as well. There a direct shot scatters by some
millimetres at the goal, and what is left is no chance but the tilt of the mallet, which the model does not
know: it depends on how the arm strikes.

Shares scatter too. A bin misses when 95 % of what its number of shots allows for (Wilson's interval) is more
than 0.07 from the prediction; the gaps themselves are in the table and the summary.
"""

import argparse
import dataclasses
import math
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_bridge.experiments.hockey import goal_monte_carlo, goal_probability_figure
from sim_bridge.experiments.hockey.goal_shots import Shot, shoot
from sim_bridge.experiments.runs import (
    Execution,
    markdown_table,
    print_verdict,
    run_trials,
    success_interval,
    write_summary,
)
from sim_bridge.hockey.world import AirHockeyWorld
from vpsto_ros.contact.puck import SHIPPED, PuckModel

BINS = 10
LEAST_SHOTS = 30
"""In a bin that counts."""
ALLOWED_GAP = 0.07
ALLOWED_MONTE_CARLO_GAP = 0.02
"""Between the mass of the Gaussians and the model's own trajectories, mean over shots with so many banks."""
TRIES = 60
"""Shots of a run, of which not all can be struck."""
_STREAM = 3  # no episode that a model is learned from, whatever the seed


@dataclasses.dataclass(frozen=True)
class Run:
    """The shots of one seed, and how many could not be struck."""

    shots: tuple[Shot, ...]
    left_out: int


def trial(task: tuple[int, str]) -> Run:
    """Shots of a seed, predicted by the model in a file."""
    seed, path = task
    model, world, rng = PuckModel.load(path), AirHockeyWorld(), np.random.default_rng([_STREAM, seed])
    shots = [shoot(world, model, rng) for _ in range(TRIES)]
    return Run(tuple(shot for shot in shots if shot is not None), shots.count(None))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which model."""
    parser.add_argument(
        "--model", default=str(SHIPPED), metavar="FILE",
        help="written by vpsto learn puck_model (default: the one that comes with the package)",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Shoot; 0 when the probabilities are right.

    Raises:
        ConfigurationError: the file is no puck model.
    """
    model = PuckModel.load(arguments.model)
    tasks = [(seed, arguments.model) for seed in range(arguments.seed, arguments.seed + arguments.runs)]
    runs = run_trials(trial, tasks, Execution.from_arguments(arguments), "goal_probability")
    shots = [shot for each in runs for shot in each.shots]
    rng = np.random.default_rng([_STREAM, arguments.seed])
    agreements = goal_monte_carlo.compare(model, rng)
    summary = {
        "experiment": "goal_probability", "seed": arguments.seed, "runs": arguments.runs,
        "left_out": sum(each.left_out for each in runs), **summarise(shots),
        "monte_carlo_gap": goal_monte_carlo.largest_gap(agreements),
        "monte_carlo": goal_monte_carlo.summarise(agreements),
    }  # fmt: skip
    folder = pathlib.Path(arguments.out)
    write_summary(folder, summary)
    text = table(summary)
    (folder / "table.md").write_text(text)
    goal_probability_figure.write(folder / "goal_probability.png", summary, agreements)
    print(f"{text}\nresults in {folder}")
    missed = missed_targets(summary)
    return print_verdict(
        not missed,
        "; ".join(missed)
        or f"of {summary['shots']} shots as many score as predicted; largest gap of a bin "
        f"{summary['worst_gap']:.3f}, {summary['monte_carlo_gap']:.3f} from the model's own trajectories",
    )


def missed_targets(summary: dict[str, Any]) -> list[str]:
    """What falls short, in words."""
    missed = []
    for name in ("all", "direct", "bank"):
        part = summary if name == "all" else summary[name]
        for row in part["bins"]:
            low, high = row["interval"]
            beyond = max(low - row["predicted"], row["predicted"] - high)
            if row["shots"] >= LEAST_SHOTS and beyond > ALLOWED_GAP:
                missed.append(
                    f"{name} shots predicted {row['predicted']:.2f} score {row['observed']:.2f} "
                    f"+- {row['standard_error']:.2f} of {row['shots']}"
                )
        if not any(row["shots"] >= LEAST_SHOTS for row in part["bins"]):
            missed.append(f"too few {name} shots to say anything; more with --runs")
    gap = summary["monte_carlo_gap"]
    if gap > ALLOWED_MONTE_CARLO_GAP:
        missed.append(f"{gap:.3f} from the model's own trajectories, allowed {ALLOWED_MONTE_CARLO_GAP}")
    return missed


def summarise(shots: Sequence[Shot]) -> dict[str, Any]:
    """Calibration of all shots, of direct ones and of those by way of walls; also from true states."""
    truly = [
        dataclasses.replace(shot, predicted=shot.predicted_truly, banks=shot.banks_truly) for shot in shots
    ]
    return {**split(shots), "from_true_states": split(truly)}


def split(shots: Sequence[Shot]) -> dict[str, Any]:
    """Calibration of all shots, of direct ones and of those by way of walls."""
    parts = {
        "direct": [shot for shot in shots if shot.banks == 0],
        "bank": [shot for shot in shots if shot.banks > 0],
    }  # fmt: skip
    return {**calibration(shots), **{name: calibration(part) for name, part in parts.items()}}


def calibration(shots: Sequence[Shot]) -> dict[str, Any]:
    """Bins of the predicted probability, the worst gap of those that count, and the mean squared error."""
    predicted = np.array([shot.predicted for shot in shots])
    scored = np.array([shot.scored for shot in shots], dtype=float)
    bins: list[dict[str, Any]] = []
    place = np.minimum((predicted * BINS).astype(int), BINS - 1)
    for index in range(BINS):
        inside = place == index
        count, goals = int(inside.sum()), int(scored[inside].sum())
        if count:
            share = float(predicted[inside].mean())
            bins.append({
                "predicted": share, "observed": goals / count, "shots": count, "goals": goals,
                "standard_error": math.sqrt(share * (1.0 - share) / count),
                "interval": success_interval(goals, count),
            })  # fmt: skip
    gaps = [abs(row["predicted"] - row["observed"]) for row in bins if row["shots"] >= LEAST_SHOTS]
    return {
        "bins": bins, "worst_gap": max(gaps, default=0.0), "shots": len(shots),
        "brier": float(((predicted - scored) ** 2).mean()) if len(shots) else 0.0,
    }  # fmt: skip


def table(summary: dict[str, Any]) -> str:
    """One row per bin for each part, and the comparison with trajectories."""
    header = ["shots", "predicted", "observed", "95 %", "number", "gap in standard errors"]
    rows, true = [], summary["from_true_states"]
    parts = {"all": summary, "direct": summary["direct"], "bank": summary["bank"]}
    parts |= {"direct, from true states": true["direct"], "bank, from true states": true["bank"]}
    for name, part in parts.items():
        for row in part["bins"]:
            low, high = row["interval"]
            off = (row["observed"] - row["predicted"]) / max(row["standard_error"], 1e-9)
            cells = [f"{row['predicted']:.3f}", f"{row['observed']:.3f}", f"{low:.2f}-{high:.2f}"]
            rows.append([name, *cells, str(row["shots"]), f"{off:+.1f}"])
    text = markdown_table(header, rows)
    header = ["banks", "shots", "mass: mean gap", "bias", "largest", "(5.11): mean gap"]
    keys = ("mean_gap", "bias", "worst_gap", "sampled_mean_gap")
    rows = [
        [banks, str(row["shots"]), *(f"{row[key]:.3f}" for key in keys)]
        for banks, row in summary["monte_carlo"].items()
    ]
    return f"{text}\n{markdown_table(header, rows)}"
