"""What the hand's plans look like, and how long the object stays with them."""

import pathlib

import numpy as np

from sim_bridge.experiments.robust_pushing import single_hand
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.robot.tip_kinematics import HAND_HALF_SIZE

_HAND = PlanarShape.box(2.0 * HAND_HALF_SIZE[0], 2.0 * HAND_HALF_SIZE[1])


def write(
    folder: pathlib.Path,
    plan_tasks: list[single_hand.PlanTask],
    plans: list[single_hand.PlanResult],
    tasks: list[single_hand.RepeatTask],
    results: list[single_hand.RepeatResult],
) -> pathlib.Path:
    """Write pushes.png: the hand's motion of every plan above, errors after each push below."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, grid = plt.subplots(
        2, len(plans), figsize=(3.2 * len(plans), 7.0), layout="constrained", sharey="row", squeeze=False
    )
    for task, plan, (above, below) in zip(plan_tasks, plans, grid.T, strict=True):
        mine = [
            r for t, r in zip(tasks, results, strict=True) if t.robust == task.robust and t.plan == task.seed
        ]
        name = "robust plan" if task.robust else "baseline plan"
        above.set_title(f"{name} {task.seed}, {plan.motion.duration:.0f} s", fontsize=10)
        _motion(above, plan, mine)
        for result in mine:
            lost = result.pushes < single_hand.MOST_PUSHES
            below.plot(
                np.arange(1, len(result.errors) + 1), 1e3 * result.errors, lw=0.9,
                color="#c1121f" if lost else "#3a7d44",
            )  # fmt: skip
        below.axhline(1e3 * single_hand.LOST, color="0.3", ls="--", lw=0.8)
        kept = sum(r.pushes == single_hand.MOST_PUSHES for r in mine)
        below.set(xlabel="push", title=f"kept {kept} of {len(mine)} times", ylim=(0.0, 80.0))
    grid[0, 0].set_ylabel("x [m]")
    grid[1, 0].set_ylabel("error after the push [mm]")
    figure.suptitle(
        "above: the hand's motion (blue, early to late) and the object's first paths (orange); below: "
        "distance of the object from where it should be after each push; dashed: lost",
        fontsize=10,
    )
    path = folder / "pushes.png"
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def _motion(axes, plan: single_hand.PlanResult, mine: list[single_hand.RepeatResult]) -> None:
    import matplotlib.pyplot as plt

    shades = plt.get_cmap("Blues")(np.linspace(0.25, 1.0, 14))
    for t, shade in zip(np.linspace(plan.motion.start_time, plan.motion.end_time, 14), shades, strict=True):
        for corners in _HAND.transform(plan.motion(t)):
            closed = np.vstack([corners, corners[:1]])
            axes.plot(closed[:, 1], closed[:, 0], color=shade, lw=0.8)
    for result in mine:
        axes.plot(result.paths[0][:, 1], result.paths[0][:, 0], color="#e07b1a", lw=1.0)
    for place, colour in ((single_hand.BEGIN, "#e07b1a"), (single_hand.END, "#3a7d44")):
        angle = np.linspace(0.0, 2.0 * np.pi, 60)
        axes.plot(
            place[1] + single_hand.RADIUS * np.sin(angle), place[0] + single_hand.RADIUS * np.cos(angle),
            color=colour,
        )  # fmt: skip
    axes.set_aspect("equal")
    axes.set_xlabel("y [m]")
