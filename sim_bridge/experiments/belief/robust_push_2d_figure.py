"""The figure of a rectangle that pushes a disc into a region, in a single horizon and in many."""

import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from sim_bridge.experiments.belief.contact_prior_figure import speed_lines
from sim_bridge.experiments.belief.variance_gain_figure import draw_effectors

PARTICLES, SAMPLES = 150, 60


def write(path: pathlib.Path, plans: Mapping[str, Any], model: str, seed: int) -> None:
    """Draw the plans of one seed into a PNG file.

    Args:
        path: of the file.
        plans: robust plans by way of planning.
        model: name of the belief model.
        seed: of the plans.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.colors import Normalize

    from sim_bridge.experiments.belief.models import MODELS

    figure, grid = plt.subplots(2, 4, figsize=(16, 8.8), layout="constrained", sharex=True, sharey=True)
    figure.suptitle(
        f"A rectangle pushes a disc into a region, {MODELS[model].title} (Figs. 6.8 and 6.9), seed {seed}"
    )
    norm = Normalize(0.0, 0.17)
    _single(grid[0], plans["single_horizon"], model, norm)
    lines = _receding(grid[1], plans["receding"], model, norm)
    for axes in grid.flat:
        axes.set(xlim=(0.15, 0.95), ylim=(-0.3, 0.5), aspect="equal")
    for axes in grid[1]:
        axes.set_xlabel("x [m]")
    grid[0, 0].set_ylabel("single horizon\ny [m]")
    grid[1, 0].set_ylabel("receding horizon\ny [m]")
    figure.colorbar(lines, ax=grid, label="speed of the rectangle's centre [m/s]", shrink=0.5)
    figure.legend(handles=_explained(), loc="outside lower center", ncols=6)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _explained() -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return [
        Line2D([], [], marker=".", ls="none", color="tab:orange", label="particles at the beginning"),
        Line2D([], [], marker=".", ls="none", color="tab:red", label="after the shown motion, with noise"),
        Patch(facecolor="tab:green", alpha=0.25, label="region"),
        Patch(facecolor="none", edgecolor="0.5", label="rectangle at the beginning"),
        Patch(facecolor="0.35", label="at the end"),
        Line2D([], [], color="0.75", label="other candidates"),
    ]


def _scenery(axes: Any) -> None:
    from matplotlib.patches import Circle

    from sim_bridge.experiments.belief.robust_push_2d import GOAL, REGION

    axes.add_patch(Circle((GOAL[0], GOAL[1]), REGION, facecolor="tab:green", alpha=0.25))


def _dots(axes: Any, poses: Any, colour: str) -> None:
    axes.plot(*poses[:, :2].T, ".", ms=3, color=colour, zorder=3)


def _single(row: Any, plan: Any, model: str, norm: Any) -> None:
    from sim_bridge.experiments.belief.robust_push_2d import (
        HAND,
        SHOWN,
        START,
        Task,
        belief,
        planner,
        sampled_times,
    )
    from vpsto_ros.trajectory import OptimalBasis, synthesize_batch

    rng = np.random.default_rng(0)
    pusher = planner(Task("single_horizon", model, True, 0), rng)
    for index, (axes, count) in enumerate(zip(row, SHOWN, strict=True)):
        _scenery(axes)
        prior = belief(PARTICLES, rng)
        if index < len(plan.samples):
            points = plan.samples[index]
            keys = np.concatenate([np.broadcast_to(START, (len(points), 1, 3)), points], axis=1)
            batch = synthesize_batch(
                OptimalBasis.uniform(points.shape[1] - 1), keys, np.zeros(3), np.zeros(3),
                pusher.space.limits, SAMPLES, derivatives=False,
            )  # fmt: skip
            for path in batch.position:
                axes.plot(*path[:, :2].T, color="0.75", lw=0.7, zorder=1)
        draw_effectors(axes, HAND, START, facecolor="none", edgecolor="0.5")
        _dots(axes, prior.poses, "tab:orange")
        motion, share = plan.trajectories[index], plan.success[index]
        title = f"after {count} iteration{'s' if count > 1 else ''}: "
        if motion is None:
            axes.set_title(f"{title}nothing valid")
            continue
        times = sampled_times(motion)
        path = motion(times)
        speed = np.linalg.norm(motion(times, 1)[:, :2], axis=1)
        speed_lines(axes, path[:, :2], speed, norm, lw=2.2, zorder=2)
        draw_effectors(axes, HAND, path[-1], facecolor="0.35", alpha=0.6)
        _dots(axes, pusher.dynamics.simulate(prior, path, rng).belief.poses, "tab:red")
        axes.set_title(f"{title}{100 * share:.0f} % in the region")


def _receding(row: Any, plan: Any, model: str, norm: Any) -> Any:
    """Four parts of equal duration of one long plan, with the particles at their beginnings and ends."""
    from sim_bridge.experiments.belief.robust_push_2d import HAND, Task, belief, planner, sampled_times

    rng = np.random.default_rng(0)
    pusher = planner(Task("receding", model, True, 0), rng)
    motion, lines = plan.trajectories[-1], None
    times, prior = sampled_times(motion), belief(PARTICLES, rng)
    bounds = np.linspace(0, len(times) - 1, len(row) + 1).astype(int)
    for axes, begin, end in zip(row, bounds[:-1], bounds[1:], strict=True):
        _scenery(axes)
        part = times[begin : end + 1]
        path = motion(part)
        speed = np.linalg.norm(motion(part, 1)[:, :2], axis=1)
        lines = speed_lines(axes, path[:, :2], speed, norm, lw=2.2, zorder=2)
        draw_effectors(axes, HAND, path[0], facecolor="none", edgecolor="0.5")
        draw_effectors(axes, HAND, path[-1], facecolor="0.35", alpha=0.6)
        _dots(axes, prior.poses, "tab:orange")
        prior = pusher.dynamics.simulate(prior, path, rng).belief
        _dots(axes, prior.poses, "tab:red")
        axes.set_title(f"{part[0]:.1f} to {part[-1]:.1f} s")
    row[-1].set_title(f"to {times[-1]:.1f} s: {100 * plan.success[-1]:.1f} % in the region")
    return lines
