"""Figures of model-predictive control in the cluttered plane."""

import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.clutter.mpc_runs import START_SPREAD, Result
from sim_bridge.experiments.clutter.mppi import MppiConfig
from sim_bridge.experiments.clutter.world import CLUTTER, GOAL, LIMITS, STARTS, draw_world

SHOWN = 5
"""Runs per controller in the figure; the thesis shows as many."""

FRAME = 0.1
"""Time between two pictures of the animation [s]."""

CONTROLLERS = ("vpsto", "mppi")


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

    figure, grid = plt.subplots(len(STARTS), 2, figsize=(10, 8.8), layout="constrained", squeeze=False)
    drawn = [groups[f"{name}/{start}"][:SHOWN] for name in CONTROLLERS for start in STARTS]
    shown = [result for results in drawn for result in results]
    end, kept = _end(shown), all(result.time_to_goal is not None for result in shown)
    for row, start in zip(grid, STARTS, strict=True):
        for axes, name in zip(row, CONTROLLERS, strict=True):
            results = groups[f"{name}/{start}"]
            draw_world(axes)
            for result in results[:SHOWN]:
                lines = _draw_path(axes, result, end)
            axes.plot(*STARTS[start], "ko", ms=5, zorder=4)
            axes.plot(*GOAL, "k*", ms=9, zorder=4)
            reached = sum(result.success for result in results)
            title = f"{_title(results[0])}, from {_place(start)}"
            axes.set_title(f"{title}:\n{reached} of {len(results)} at the goal (star)", fontsize=10)
    label = "time [s]" if kept else "time [s]; runs that do not arrive go on"
    figure.colorbar(lines, ax=grid, label=label, shrink=0.6, extend="neither" if kept else "max")
    figure.suptitle(f"Executed paths, at most {SHOWN} runs each; starts vary by {1e3 * START_SPREAD:g} mm")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _title(result: Result) -> str:
    """The controller of a run, in words."""
    config = result.task.controller
    return f"MPPI, horizon {config.horizon:g} s" if isinstance(config, MppiConfig) else "online VP-STO"


def _place(start: str) -> str:
    return f"({STARTS[start][0]:.2f} m, {STARTS[start][1]:.2f} m)"


def _end(results: list[Result]) -> float:
    """When the last of those has arrived that do [s], or all have ended if none does."""
    arrived = [result.time_to_goal for result in results if result.time_to_goal is not None]
    return max(arrived or [result.motion.end_time for result in results])


def _draw_path(axes: Any, result: Result, end: float) -> Any:
    from matplotlib.collections import LineCollection

    times = np.linspace(0.0, result.motion.end_time, 400)
    points = result.motion(times)
    lines = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)), array=times[:-1], cmap="viridis", lw=1.5, zorder=3
    )
    lines.set_clim(0.0, end)
    return axes.add_collection(lines)


def _profiles(path: pathlib.Path, groups: dict[str, list[Result]]) -> None:
    """Velocity and acceleration with their limits, the right of Fig. 4.5."""
    import matplotlib.pyplot as plt

    figure, grid = plt.subplots(4, 2, figsize=(10, 8.6), layout="constrained", sharex=True, sharey="row")
    start = next(iter(STARTS))
    shown = {name: groups[f"{name}/{start}"][:SHOWN] for name in CONTROLLERS}
    end = _end([result for results in shown.values() for result in results])
    for column, results in enumerate(shown.values()):
        for result in results:
            times = np.linspace(0.0, min(result.motion.end_time, end), 1500)
            for order, axis in ((1, 0), (1, 1), (2, 0), (2, 1)):
                grid[2 * (order - 1) + axis, column].plot(times, result.motion(times, order)[:, axis], lw=0.8)
        grid[0, column].set_title(_title(results[0]), fontsize=10)
        grid[3, column].set_xlabel("time [s]")
    bounds = {"velocity [m/s]": LIMITS.velocity, "acceleration [m/s²]": LIMITS.acceleration}
    rows = [(quantity, bound[axis]) for quantity, bound in bounds.items() for axis in range(2)]
    for row, (quantity, limit) in enumerate(rows):
        for axes in grid[row]:
            bounding = axes.axhline(limit, color="k", ls="--", lw=1.0)
            axes.axhline(-limit, color="k", ls="--", lw=1.0)
            axes.grid(alpha=0.3)
        grid[row, 0].set_ylabel(f"{'xy'[row % 2]} {quantity}")
    figure.suptitle(f"From {_place(start)}, one colour per run")
    figure.legend([bounding], ["limits"], loc="outside lower center")
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
    from matplotlib.patches import Circle, Patch

    figure, axes = plt.subplots(figsize=(6.0, 6.8), layout="constrained")
    figure.suptitle("Online VP-STO among moving discs,\nwhich pass over the fixed obstacles", fontsize=12)
    draw_world(axes, CLUTTER)
    axes.plot(*GOAL, "k*", ms=11, ls="none", label="goal")
    discs = [Circle(tuple(d.state(0.0)[0]), d.radius, color="tab:orange") for d in result.discs]
    for patch in discs:
        axes.add_patch(patch)
    (trail,) = axes.plot([], [], color="tab:blue", lw=1.8, label="its path")
    (robot,) = axes.plot([], [], "o", color="tab:blue", ms=7, label="robot (a point)")
    fixed = Patch(facecolor="0.8", edgecolor="0.5", label="fixed obstacle")
    moving = Patch(color="tab:orange", label="moving disc")
    handles = [robot, trail, *axes.lines[:1], fixed, moving]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=10)

    def show(time: float) -> list[Any]:
        for patch, disc in zip(discs, result.discs, strict=True):
            patch.set_center(tuple(disc.state(time)[0]))
        past: NDArray = result.motion(np.linspace(0.0, time, 200))
        trail.set_data(*past.T)
        robot.set_data(*past[-1:].T)
        axes.set_title(f"seed {result.task.seed}: {time:.1f} s", fontsize=11)
        return [*discs, trail, robot]

    frames = np.append(np.arange(0.0, result.motion.end_time, FRAME), [result.motion.end_time] * 10)
    FuncAnimation(figure, show, frames=frames).save(path, PillowWriter(fps=round(1.0 / FRAME)), dpi=100)
    plt.close(figure)
