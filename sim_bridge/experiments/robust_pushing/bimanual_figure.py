"""Figures like 6.12: plans of the two balls, rolled-out and simulated paths of the object."""

import pathlib

import numpy as np

from sim_bridge.experiments.robust_pushing import bimanual

_LEFT, _RIGHT, _OBJECT, _PATH = "#1a1a1a", "#1f5fbf", "#e07b1a", "#8bd17c"


def write(
    folder: pathlib.Path,
    plans: dict[tuple[str, float, int], bimanual.PlanResult],
    tasks: list[bimanual.RunTask],
    runs: list[bimanual.RunResult],
) -> pathlib.Path:
    """Write plans.png: rollouts above, runs on the simulated arms below, a column per planner and radius."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    seed = min(seed for _, _, seed in plans)
    columns = [(v, r) for v in reversed(bimanual.VARIANTS) for r in (0.05, 0.03)]
    figure, grid = plt.subplots(
        2, len(columns), figsize=(3.3 * len(columns), 5.6), layout="constrained", sharex=True, sharey=True
    )
    for (variant, radius), (above, below) in zip(columns, grid.T, strict=True):
        plan = plans[variant.name, radius, seed]
        _plan(above, plan)
        share = 100 * plan.success[variant.model]
        above.set_title(f"{variant.title}\nr = {100 * radius:.0f} cm: {share:.1f} % of rollouts", fontsize=9)
        for path in plan.shown.transpose(1, 0, 2):
            above.plot(path[:, 1], path[:, 0], color=_OBJECT, alpha=0.08, lw=0.7)
        _plan(below, plan)
        mine = [
            run for task, run in zip(tasks, runs, strict=True)
            if task.variant == variant and bimanual.OBJECTS[task.name] == radius and task.plan == seed
        ]  # fmt: skip
        for run in mine:
            colour = _OBJECT if run.success else "#c1121f"
            below.plot(run.path[:, 1], run.path[:, 0], color=colour, lw=1.2)
        below.set_title(f"on the arms: {sum(run.success for run in mine)} of {len(mine)}", fontsize=9)
    for axes in grid[1]:
        axes.set_xlabel("y [m]")
    for axes in grid[:, 0]:
        axes.set_ylabel("x [m]")
    grid[0, 0].invert_xaxis()
    figure.legend(*_legend(), loc="outside lower center", ncols=5)
    path = folder / "plans.png"
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path


def _plan(axes, plan: bimanual.PlanResult) -> None:
    circle = bimanual.target().points
    axes.plot(circle[:, 1], circle[:, 0], color=_PATH, lw=6, alpha=0.7, zorder=0)
    times = np.linspace(plan.motion.start_time, plan.motion.end_time, 600)
    balls = plan.motion(times)
    axes.plot(balls[:, 1], balls[:, 0], color=_LEFT, lw=0.8)
    axes.plot(balls[:, 3], balls[:, 2], color=_RIGHT, lw=0.8)
    axes.set_aspect("equal")


def _legend():
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=_PATH, lw=6), Line2D([], [], color=_LEFT), Line2D([], [], color=_RIGHT),
        Line2D([], [], color=_OBJECT), Line2D([], [], color="#c1121f"),
    ]  # fmt: skip
    return handles, ["target path", "left ball", "right ball", "object", "object, failed run on the arms"]
