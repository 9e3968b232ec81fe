"""The figure of the timing of key positions: one set in the plane, equally spaced and with optimal timing."""

import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.trajectory import Limits, OptimalBasis, TimedKeys, Trajectory, synthesize

COLOURS = ("tab:gray", "tab:blue")
AXES = ("v0", "v1"), ("a0", "a1")


def write(path: pathlib.Path, keys: NDArray[np.float64], limits: Limits, timed: TimedKeys) -> None:
    """Draw the two paths through the same key positions, and the profiles with the limits, into a PNG file.

    Args:
        path: of the file.
        keys: positions from start to end, shape (N + 2, 2) [m].
        limits: of the two axes.
        timed: the key positions with the durations in between that make the motion shortest.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    still = np.zeros(limits.dof)
    equal = synthesize(OptimalBasis.uniform(len(keys) - 2), keys, still, still, limits)
    motions = (equal, timed.trajectory)
    figure, axes = _panels(motions)
    figure.suptitle(f"Random set of {len(keys)} key positions in the plane, passed in two timings")
    labels = f"equal spacing: {equal.duration:.2f} s", f"optimal timing: {timed.duration:.2f} s"
    for motion, colour, label in zip(motions, COLOURS, labels, strict=True):
        _draw_motion(axes, motion, colour, label)
    axes["path"].plot(*keys.T, "o", color="black", zorder=3, label="key positions (dots: when passed)")
    axes["path"].plot(*keys[0], "s", color="black", ms=9, zorder=3, label="start")
    axes["path"].set(xlabel="x [m]", ylabel="y [m]", title="paths")
    axes["path"].set_aspect("equal", adjustable="datalim")
    axes["path"].margins(0.1)
    axes["path"].grid(alpha=0.3)
    _draw_limits(axes, limits)
    figure.legend(*_legend(axes), loc="outside lower center", ncols=5, fontsize=9)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _panels(motions: tuple[Trajectory, Trajectory]) -> tuple[Any, dict[str, Any]]:
    """Axes by name: high paths stand at the left of the profiles, wide ones lie above them."""
    import matplotlib.pyplot as plt

    paths = [motion(np.linspace(motion.start_time, motion.end_time, 200)) for motion in motions]
    width, height = np.ptp(np.vstack(paths), axis=0)
    if height > 0.7 * width:
        share = float(np.clip(1.4 * width / height, 0.6, 1.8))
        return plt.subplot_mosaic(
            [["path", *row] for row in AXES], figsize=(12, 5.8), width_ratios=(share, 1.0, 1.0),
            layout="constrained",
        )  # fmt: skip
    share = float(np.clip(2.4 * height / width, 0.8, 2.0))
    below: list[Any] = [list(row) for row in AXES]
    return plt.subplot_mosaic(
        [["path", "path"], *below], figsize=(10, 5.6 + 2.4 * share),
        height_ratios=(share, 1.0, 1.0), layout="constrained",
    )  # fmt: skip


def _draw_motion(axes: dict[str, Any], motion: Trajectory, colour: str, label: str) -> None:
    times = np.linspace(motion.start_time, motion.end_time, 1000)
    axes["path"].plot(*motion(times).T, color=colour, label=label)
    for order, names in enumerate(AXES, start=1):
        for j, name in enumerate(names):
            axes[name].plot(times, motion(times, order)[:, j], color=colour)
            axes[name].plot(motion.times, motion(motion.times, order)[:, j], ".", color=colour, ms=6)


def _draw_limits(axes: dict[str, Any], limits: Limits) -> None:
    quantities = ("velocity [m/s]", limits.velocity), ("acceleration [m/s²]", limits.acceleration)
    for names, (quantity, most) in zip(AXES, quantities, strict=True):
        for j, name in enumerate(names):
            for sign in (-1.0, 1.0):
                axes[name].axhline(sign * most[j], color="black", ls="--", lw=1, label="limit")
            axes[name].set(ylabel=f"{'xy'[j]} {quantity}", xlabel="time [s]")
            axes[name].grid(alpha=0.3)


def _legend(axes: dict[str, Any]) -> tuple[list[Any], list[str]]:
    handles, labels = axes["path"].get_legend_handles_labels()
    limits, names = axes["v0"].get_legend_handles_labels()
    return [*handles, limits[0]], [*labels, names[0]]
