"""The figure of the offline search in the clutter: all motions in the world, and their profiles over time."""

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_bridge.experiments.clutter.world import draw_world
from vpsto_ros.optimization.costs import JointSpaceProblem

COLOURS = {"LR": "tab:blue", "R": "tab:red", "LTR": "tab:green"}
OTHER, INVALID = "tab:purple", "gold"
QUANTITIES = ("position [m]", "velocity [m/s]", "acceleration [m/s²]")


def write(path: pathlib.Path, problem: JointSpaceProblem, outcomes: Sequence[Any]) -> None:
    """Draw the outcomes of searches from one start into a PNG file, coloured by class.

    Args:
        path: of the file.
        problem: what was searched.
        outcomes: with `points`, `valid`, `letters` and `duration` each.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(13, 6.3), layout="constrained")
    start, (via, _) = problem.start, np.shape(outcomes[0].points)
    figure.suptitle(
        f"{len(outcomes)} searches from ({start[0]:.2f} m, {start[1]:.2f} m) with {via} free via-points"
    )
    grid: Any = figure.subfigures(1, 2, width_ratios=(1.0, 1.15))
    left, right = grid
    _paths(left.subplots(), problem, outcomes)
    _profiles(right.subplots(3, 2, sharex=True), problem, [each for each in outcomes if each.valid])
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _colour(outcome: Any) -> str:
    return COLOURS.get(outcome.letters, OTHER) if outcome.valid else INVALID


def _paths(axes: Any, problem: JointSpaceProblem, outcomes: Sequence[Any]) -> None:
    draw_world(axes)
    labels = [_way(each.letters) if each.valid else "in collision or out of limits" for each in outcomes]
    told = set()
    for outcome, label in zip(outcomes, labels, strict=True):
        trajectory = problem.trajectory(outcome.points)
        path = trajectory(np.linspace(0.0, trajectory.duration, 300))
        legend = None if label in told else f"{label} (runs: {labels.count(label)})"
        axes.plot(*path.T, color=_colour(outcome), lw=0.8, alpha=0.6, label=legend, zorder=2)
        told.add(label)
    goal = problem.start if problem.goal is None else problem.goal
    axes.plot(*problem.start, "ko", ls="none", zorder=3, label="start")
    axes.plot(*goal, "k*", ms=12, ls="none", zorder=3, label="goal")
    legend = axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.11), ncols=2, fontsize=9)
    for line in legend.get_lines():
        line.set(alpha=1.0, lw=1.5 if line.get_marker() == "None" else 0.0)


def _way(letters: str) -> str:
    """The obstacles that a path passes above, in words."""
    if letters == "-":
        return "passes below all obstacles"
    others, last = letters[:-1], letters[-1]
    return f"passes above {', '.join(others)}{' and ' if others else ''}{last}"


def _profiles(grid: Any, problem: JointSpaceProblem, outcomes: Sequence[Any]) -> None:
    limits = problem.limits
    for outcome in outcomes:
        trajectory = problem.trajectory(outcome.points)
        times = np.linspace(0.0, trajectory.duration, 300)
        for order in range(3):
            values = trajectory(times, order)
            for axis in range(2):
                grid[order, axis].plot(times, values[:, axis], color=_colour(outcome), lw=0.7, alpha=0.5)
    for order, quantity in enumerate(QUANTITIES):
        for axis in range(2):
            axes = grid[order, axis]
            if order:
                most = (limits.velocity, limits.acceleration)[order - 1][axis]
                axes.axhline(most, color="k", ls="--", lw=0.8)
                axes.axhline(-most, color="k", ls="--", lw=0.8)
            axes.grid(alpha=0.3)
            axes.set_ylabel(quantity if axis == 0 else "")
            axes.set_title(f"{'xy'[axis]} (dashed: limits)" if order == 0 else "")
            axes.set_xlabel("time [s]" if order == 2 else "")
