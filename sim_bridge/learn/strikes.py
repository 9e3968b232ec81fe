"""``vpsto learn strikes``: search the postures in which the iiwa strikes a puck fastest, (5.13)."""

import argparse
import pathlib
import time

import numpy as np
from tqdm import tqdm

from sim_bridge.cli import count
from sim_bridge.hockey.recordings import TABLE
from sim_bridge.verdict import print_verdict
from vpsto_ros.planning.hockey.strike_tabulation import tabulate
from vpsto_ros.planning.hockey.strikes import StrikeTable

X = np.linspace(-0.75, -0.10, 14)
Y = np.linspace(-0.44, 0.44, 17)
ANGLE = np.deg2rad(np.linspace(-75.0, 75.0, 21))
_IN_FRONT = np.deg2rad(30.0)  # shots that are nearly straight [rad]
_ENOUGH = 0.9  # share of the places from which such a shot must be possible


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "example: vpsto learn strikes --effort 1000 --out strikes.npz"
    parser.add_argument(
        "--effort", type=count, default=5_000, metavar="N",
        help="postures that are tried per place and direction (default 5000)",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Search and write; 0 when nearly every place can be shot from."""
    began = time.perf_counter()
    table = tabulate(
        X, Y, ANGLE, TABLE.contact_distance, np.random.default_rng(arguments.seed), effort=arguments.effort,
        progress=lambda entries: tqdm(entries, desc="searching postures", disable=None),
    )  # fmt: skip
    path = pathlib.Path(arguments.out)
    path.parent.mkdir(parents=True, exist_ok=True)
    command = f"vpsto learn strikes --effort {arguments.effort} --seed {arguments.seed}"
    table.save(path, command=command, seed=arguments.seed, duration_s=round(time.perf_counter() - began, 1))
    print(describe(table))
    print(f"wrote {path}")
    share = reachable(table)
    return print_verdict(share >= _ENOUGH, f"from {share:.0%} of the places a straight shot is possible")


def reachable(table: StrikeTable) -> float:
    """Share of the places from which some nearly straight shot is possible."""
    straight = np.abs(table.angle) <= _IN_FRONT
    return float((table.speed[..., straight].max(axis=(0, 3)) > 0.0).mean())


def describe(table: StrikeTable) -> str:
    """Speeds along the middle of the table, in words."""
    angles = (-60.0, -30.0, 0.0, 30.0, 60.0)
    lines = ["largest mallet speeds [m/s] at y = 0; angle " + "".join(f"{a:+8.0f}°" for a in angles)]
    for x in table.x[::2]:
        speeds = table.speeds(np.tile([x, 0.0], (5, 1)), np.deg2rad(angles))
        lines.append(f"{f'puck at x = {x:.2f} m':>44}" + "".join(f"{v:9.2f}" for v in speeds))
    return "\n".join(lines)
