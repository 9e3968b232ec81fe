"""The figure of predicted pucks: where they were expected, where they were, and how often that fits."""

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_bridge.experiments.hockey.predictions import KINDS, Prediction
from sim_bridge.hockey.recordings import TABLE

COLOURS = {"floating": "tab:green", "wall": "tab:blue", "hit": "tab:orange", "hit_wall": "tab:red"}
SHOWN, HORIZON = 12, 0.5


def write(path: pathlib.Path, found: Sequence[Prediction]) -> None:
    """Draw into a PNG file.

    Args:
        path: of the file.
        found: predictions of all runs.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(14, 5.2), layout="constrained", width_ratios=[1.7, 1])
    _places(panels[0], found)
    _coverage(panels[1], found)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower left", ncols=len(KINDS))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _places(axes: Any, found: Sequence[Prediction]) -> None:
    """Some predictions of each kind over the longest horizon, with their ellipses of 90 %."""
    from matplotlib.patches import Rectangle

    x, y = TABLE.half_length, TABLE.half_width
    axes.add_patch(Rectangle((-x, -y), 2 * x, 2 * y, fill=False, color="0.4"))
    for end in (-x, x):
        axes.plot([end] * 2, [-0.5 * TABLE.goal_width, 0.5 * TABLE.goal_width], "g", lw=4)
    for kind in KINDS:
        chosen = [p for p in found if p.kind == kind and p.horizon == HORIZON][:SHOWN]
        for index, prediction in enumerate(chosen):
            _one(axes, prediction, COLOURS[kind], kind.replace("_", ", then ") if index == 0 else None)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.set_title(f"expected (+) and true (•) places after {HORIZON:g} s, ellipses of 90 %")


def _one(axes: Any, prediction: Prediction, colour: str, label: str | None) -> None:
    from matplotlib.patches import Ellipse

    values, vectors = np.linalg.eigh(prediction.covariance)
    width, height = 2.0 * np.sqrt(np.maximum(values, 0.0) * -2.0 * np.log(0.1))
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    axes.add_patch(Ellipse(tuple(prediction.mean), width, height, angle=angle, color=colour, alpha=0.25))
    axes.plot(*np.array([prediction.start, prediction.truth]).T, color=colour, lw=0.5, alpha=0.5)
    axes.plot(*prediction.mean, "+", color=colour, ms=6)
    axes.plot(*prediction.truth, ".", color=colour, ms=6, label=label)


def _coverage(axes: Any, found: Sequence[Prediction]) -> None:
    """Share of the true places in ellipses of every probability."""
    levels = np.linspace(0.01, 0.999, 200)
    for kind in KINDS[1:]:
        distances = np.array([p.distance for p in found if p.kind == kind])
        if distances.size:
            shares = (distances[:, None] < -2.0 * np.log(1.0 - levels)).mean(axis=0)
            axes.plot(levels, shares, color=COLOURS[kind], label=kind.replace("_", ", then "))
    axes.plot([0, 1], [0, 1], "k--", lw=0.8, label="calibrated")
    axes.set(xlabel="probability of the ellipse", ylabel="share of true places inside")
    axes.set(xlim=(0, 1), ylim=(0, 1), title="calibration")
    axes.legend(fontsize=8, loc="lower right")
    axes.grid(alpha=0.3)
