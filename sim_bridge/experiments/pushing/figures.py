"""Figures of the pushing experiments."""

import pathlib

import numpy as np

from sim_bridge.experiments.pushing.trials import Trial, TrialResult


def write(
    folder: pathlib.Path, titles: dict[str, str], trials: list[Trial], results: dict[str, list[TrialResult]]
) -> None:
    """Write times.png (how many runs are done by when) and paths.png (what happened on the table)."""
    import matplotlib

    matplotlib.use("Agg")
    _times(folder / "times.png", titles, results)
    _paths(folder / "paths.png", trials, next(iter(results.values())))


def _times(path: pathlib.Path, titles: dict[str, str], results: dict[str, list[TrialResult]]) -> None:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    for name, runs in results.items():
        times = np.sort([run.time_to_goal for run in runs if run.success])
        axes.step(
            np.append(0.0, times), np.arange(len(times) + 1) / len(runs), where="post", label=titles[name]
        )
    axes.set(
        xlabel="time to goal [s]", ylabel="share of runs at the goal", ylim=(0.0, 1.02), xlim=(0.0, None)
    )
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _paths(path: pathlib.Path, trials: list[Trial], runs: list[TrialResult]) -> None:
    import matplotlib.pyplot as plt

    order = np.argsort([-run.times[-1] for run in runs])
    shown = np.unique(np.concatenate([order[:3], order[len(order) // 2 :][:3]])) if len(runs) > 6 else order
    figure, grid = plt.subplots(2, 3, figsize=(12, 8), layout="constrained", squeeze=False)
    for axes, index in zip(grid.flat, shown, strict=False):
        _path(axes, trials[index], runs[index])
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    grid.flat[0].legend(loc="best", fontsize=8)
    figure.suptitle("object and tool seen from above: the slowest and some ordinary runs")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _path(axes, trial: Trial, run: TrialResult) -> None:
    for outline in trial.plant.shape.transform(run.object_path[0]):
        axes.fill(*outline.T, color="0.8")
    for outline in trial.plant.shape.transform(run.object_path[-1]):
        axes.fill(*outline.T, color="tab:orange", alpha=0.7)
    axes.plot(*run.object_path[:, :2].T, color="tab:orange", label="object")
    axes.plot(*run.tool_path[:, :2].T, color="tab:blue", lw=0.8, label="tool")
    axes.plot(*trial.goal[:2], "g+", ms=14, label="goal")
    outcome = f"{run.time_to_goal:.1f} s to the goal" if run.success else "not reached"
    axes.set_title(f"run {run.seed}: {outcome}", fontsize=9)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.grid(alpha=0.3)
