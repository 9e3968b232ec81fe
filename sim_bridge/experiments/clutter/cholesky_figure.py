"""The figure of the search with and without the prior: first candidates, results, costs over iterations."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sim_bridge.experiments.clutter.world import draw_world

SHOWN = 60
COLOURS = {"with_prior": "tab:blue", "without_prior": "tab:orange"}


def write(path: pathlib.Path, outcomes: Mapping[tuple[str, str], Sequence[Any]]) -> None:
    """Draw into a PNG file.

    Args:
        path: of the file.
        outcomes: by strategy and prior, with `points` (or None) and `means` each.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from sim_bridge.experiments.clutter.cholesky import STRATEGIES

    figure, grid = plt.subplots(2, 3, figsize=(13, 8.6), layout="constrained")
    figure.suptitle("Search around one obstacle, with and without the smoothness prior")
    for row, strategy in zip(grid, STRATEGIES, strict=True):
        for axes, start in zip(row, ("without_prior", "with_prior"), strict=False):
            _paths(axes, start, outcomes[strategy, start])
            axes.set_title(f"{STRATEGIES[strategy]}, {start.replace('_', ' ')}", fontsize=10)
        _costs(row[2], {start: outcomes[strategy, start] for start in COLOURS})
        row[2].set_title(f"{STRATEGIES[strategy]}: cost of the mean", fontsize=10)
    figure.legend(handles=_explained(), loc="outside lower center", ncols=3, fontsize=10)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _explained() -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    blue, orange = COLOURS["with_prior"], COLOURS["without_prior"]
    return [
        Line2D([], [], color="0.6", label="candidates of a first population"),
        Line2D([], [], color="k", ls="--", label="straight from start to goal"),
        Line2D([], [], color=blue, label="with prior: paths found; median cost"),
        Line2D([], [], color=orange, label="without prior: paths found; median cost"),
        Patch(color=blue, alpha=0.2, label="with prior: costs of the middle 90 % of the runs"),
        Patch(color=orange, alpha=0.2, label="without prior: costs of the middle 90 % of the runs"),
    ]


def _paths(axes: Any, start: str, runs: Sequence[Any]) -> None:
    """Candidates of a first population, and what the runs found."""
    from sim_bridge.experiments.clutter.cholesky import WORLD, prior, problem

    draw_world(axes, WORLD)
    plan = problem()
    first = prior(start).sample(np.random.default_rng(0), SHOWN // 2)
    found = [run.points for run in runs[:SHOWN] if run.points is not None]
    for points, style in (
        *((each, {"color": "0.6", "lw": 0.6}) for each in first),
        *((each, {"color": COLOURS[start], "lw": 0.8, "alpha": 0.6}) for each in found),
    ):
        trajectory = plan.trajectory(points)
        axes.plot(*trajectory(np.linspace(0.0, trajectory.duration, 300)).T, **style, zorder=2)
    axes.plot(*np.array([plan.start, plan.goal]).T, "k--", lw=1.0, zorder=3)


def _costs(axes: Any, runs: Mapping[str, Sequence[Any]]) -> None:
    """Median and the middle 90 % over the runs; a run that has settled keeps its last cost."""
    longest = max(len(run.means) for each in runs.values() for run in each)
    for start, each in runs.items():
        costs = np.array([np.pad(run.means, (0, longest - len(run.means)), "edge") for run in each])
        low, middle, high = np.quantile(costs, [0.05, 0.5, 0.95], axis=0)
        iterations = np.arange(1, longest + 1)
        axes.fill_between(iterations, low, high, color=COLOURS[start], alpha=0.2)
        axes.plot(iterations, middle, color=COLOURS[start])
    axes.set(xscale="log", yscale="log", xlabel="iteration", ylabel="duration + 100 x time in collision [s]")
    axes.grid(alpha=0.3)
