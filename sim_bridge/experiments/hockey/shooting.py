"""Shooting (5.4): how often, how fast and over how many rims the iiwa scores in the simulated world.

Three settings of the agent as in the thesis, one that must use a rim, and moving pucks; beside them planners
that take the expected way of the puck for certain, with the same filter, the same MPC and the same knowledge
of the mallet's swing. The camera is noisy, late and loses frames. Drag, rims, mallet and the arm's friction
differ from shot to shot from what the models were learned with; `--nominal` repeats all shots without that.

Whatever the arm does counts: pucks that it does not strike are misses. So are shots that go in after a second
touch. The places of the pucks are the same for all players that are compared.
"""

import argparse
import pathlib
from collections.abc import Sequence
from typing import Any

from sim_bridge.experiments.hockey import shooting_figures
from sim_bridge.experiments.hockey.shooting_players import BASELINES, PLAYERS, player
from sim_bridge.experiments.hockey.shooting_starts import SPREAD, ShotTask, world_of
from sim_bridge.experiments.hockey.shooting_summary import missed_targets, summarise, table
from sim_bridge.experiments.hockey.shooting_trials import ShotResult, trial
from sim_bridge.experiments.runs import Execution, print_verdict, run_trials, write_summary


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Who shoots, and where."""
    parser.add_argument(
        "--players", nargs="+", choices=PLAYERS, default=list(PLAYERS), metavar="NAME",
        help=f"of {', '.join(PLAYERS)} (default: all, which the verdict asks for)",
    )  # fmt: skip
    parser.add_argument(
        "--nominal", action="store_true",
        help="shoot once more in the world that the models were learned in",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Shoot; 0 when all targets are met."""
    execution = Execution.from_arguments(arguments)
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    found = shots(arguments.players, seeds, execution)
    summary = {
        "experiment": "shooting", "seed": arguments.seed, "runs": arguments.runs,
        "spread": {"largest_share": SPREAD, "drawn": "uniformly for every shot"}, **summarise(found),
    }  # fmt: skip
    text = table(summary)
    if arguments.nominal:
        summary["nominal"] = summarise(shots(arguments.players, seeds, execution, nominal=True))
        text += f"\nIn the world that the models were learned in:\n\n{table(summary['nominal'])}"
    folder = pathlib.Path(arguments.out)
    write_summary(folder, summary)
    (folder / "table.md").write_text(text)
    shooting_figures.write(folder, found)
    print(f"{text}\nresults in {folder}")
    missed = missed_targets(summary, arguments.players)
    return print_verdict(not missed, "; ".join(missed) or _in_short(summary))


def shots(
    players: Sequence[str], seeds: Sequence[int], execution: Execution, *, nominal: bool = False
) -> list[ShotResult]:
    """What came of a shot of every player with every seed."""
    tasks = [ShotTask(name, seed, nominal) for name in dict.fromkeys(players) for seed in seeds]
    label = "shooting nominal" if nominal else "shooting"
    return run_trials(trial, tasks, execution, label, warm_up)


def warm_up() -> None:
    """Compile and load what shots use."""
    task = ShotTask(PLAYERS[0], 0, nominal=True)
    world_of(task).advance(0.01)
    for name in (PLAYERS[0], *BASELINES):
        player(name, 0)


def _in_short(summary: dict[str, Any]) -> str:
    rows = [name for name in PLAYERS if name in summary]
    return ", ".join(f"{name} {100 * summary[name]['score']:.0f} %" for name in rows)
