"""Figures of model-predictive control in the cluttered plane."""

import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.clutter.mpc_runs import Result
from sim_bridge.experiments.clutter.world import CLUTTER, GOAL, LIMITS, STARTS, draw_world

SHOWN = 5
"""Runs per controller in the figure; the thesis shows as many."""

FRAME = 0.1
"""Time between two pictures of the animation [s]."""

TITLES = {"vpsto": "online VP-STO", "mppi": "MPPI, short horizon"}


def write(folder: pathlib.Path, groups: dict[str, list[Result]], *, animation: bool = True) -> None:
    """Write paths.png, profiles.png and moving_discs.gif."""
    import matplotlib

    matplotlib.use("Agg")
    _paths(folder / "paths.png", groups)
    _profiles(folder / "profiles.png", groups)
    if animation:
        _animation(folder / "moving_discs.gif", _liveliest(groups["vpsto/moving"]))


def _paths(path: pathlib.Path, groups: dict[str, list[Result]]) -> None:
    """Executed paths with the time as colour, the left of Fig. 4.5."""
    import matplotlib.pyplot as plt

    figure, grid = plt.subplots(len(STARTS), 2, figsize=(9, 8.2), layout="constrained", squeeze=False)
    for row, start in zip(grid, STARTS, strict=True):
        for axes, (name, title) in zip(row, TITLES.items(), strict=True):
            results = groups[f"{name}/{start}"]
            draw_world(axes)
            for result in results[:SHOWN]:
                shown = _draw_path(axes, result)
            axes.plot(*STARTS[start], "ko", ms=5, zorder=4)
            axes.plot(*GOAL, "k*", ms=9, zorder=4)
            reached = sum(result.success for result in results)
            axes.set_title(f"{title}: {reached} of {len(results)} at the goal", fontsize=10)
    figure.colorbar(shown, ax=grid, label="time [s]", shrink=0.6)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _draw_path(axes: Any, result: Result) -> Any:
    from matplotlib.collections import LineCollection

    times = np.linspace(0.0, result.motion.end_time, 400)
    points = result.motion(times)
    lines = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)), array=times[:-1], cmap="viridis", lw=1.5, zorder=3
    )
    lines.set_clim(0.0, 6.0)
    return axes.add_collection(lines)


def _profiles(path: pathlib.Path, groups: dict[str, list[Result]]) -> None:
    """Velocity and acceleration with their limits, the right of Fig. 4.5."""
    import matplotlib.pyplot as plt

    figure, grid = plt.subplots(4, 2, figsize=(10, 8), layout="constrained", sharex="col")
    start = next(iter(STARTS))
    for column, (name, title) in enumerate(TITLES.items()):
        for result in groups[f"{name}/{start}"][:SHOWN]:
            times = np.linspace(0.0, min(result.motion.end_time, 8.0), 1500)
            for order, axis in ((1, 0), (1, 1), (2, 0), (2, 1)):
                grid[2 * (order - 1) + axis, column].plot(times, result.motion(times, order)[:, axis], lw=0.8)
        grid[0, column].set_title(title, fontsize=10)
        grid[3, column].set_xlabel("time [s]")
    bounds = {"velocity [m/s]": LIMITS.velocity, "acceleration [m/s²]": LIMITS.acceleration}
    rows = [(quantity, bound[axis]) for quantity, bound in bounds.items() for axis in range(2)]
    for row, (quantity, limit) in enumerate(rows):
        for axes in grid[row]:
            axes.axhline(limit, color="tab:red", ls="--", lw=0.8)
            axes.axhline(-limit, color="tab:red", ls="--", lw=0.8)
            axes.grid(alpha=0.3)
        grid[row, 0].set_ylabel(f"{'xy'[row % 2]} {quantity}")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _liveliest(results: list[Result]) -> Result:
    """The successful run that took longest: the one in which discs were in the way most."""
    done = [result for result in results if result.success] or results
    return max(done, key=lambda result: result.motion.end_time)


def _animation(path: pathlib.Path, result: Result) -> None:
    """One run among moving discs."""
    import matplotlib.pyplot as plt
    from matplotlib.animation import FuncAnimation, PillowWriter
    from matplotlib.patches import Circle

    figure, axes = plt.subplots(figsize=(4.2, 4.2), layout="constrained")
    draw_world(axes, CLUTTER)
    axes.plot(*GOAL, "k*", ms=9)
    discs = [Circle(tuple(d.state(0.0)[0]), d.radius, color="tab:orange") for d in result.discs]
    for patch in discs:
        axes.add_patch(patch)
    (trail,) = axes.plot([], [], color="tab:blue", lw=1.5)
    (robot,) = axes.plot([], [], "o", color="tab:blue", ms=5)

    def show(time: float) -> list[Any]:
        for patch, disc in zip(discs, result.discs, strict=True):
            patch.set_center(tuple(disc.state(time)[0]))
        past: NDArray = result.motion(np.linspace(0.0, time, 200))
        trail.set_data(*past.T)
        robot.set_data(*past[-1:].T)
        axes.set_title(f"seed {result.task.seed}: {time:.1f} s", fontsize=9)
        return [*discs, trail, robot]

    frames = np.append(np.arange(0.0, result.motion.end_time, FRAME), [result.motion.end_time] * 10)
    FuncAnimation(figure, show, frames=frames).save(path, PillowWriter(fps=round(1.0 / FRAME)), dpi=80)
    plt.close(figure)
