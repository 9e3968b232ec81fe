"""The figure of three pushes: particles before and after, and their gains."""

import dataclasses
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import Disc

SHOWN = 150
COLOURS = {"thesis": "tab:blue", "friction": "tab:orange"}


def draw_effectors(axes: Any, effectors: EndEffectors, point: NDArray, **style: Any) -> None:
    """Draw end effectors at plane coordinates (m,)."""
    from matplotlib.patches import Circle, Polygon

    for shape, pose in zip(effectors.shapes, effectors.poses(point), strict=True):
        if isinstance(shape, Disc):
            axes.add_patch(Circle(pose[:2], shape.radius, **style))
            continue
        c, s = np.cos(pose[2]), np.sin(pose[2])
        corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * shape.half_size
        axes.add_patch(Polygon(corners @ np.array([[c, s], [-s, c]]) + pose[:2], closed=True, **style))


def write(path: pathlib.Path, found: Sequence[Mapping[tuple[str, str], Any]]) -> None:
    """Draw into a PNG file.

    Args:
        path: of the file.
        found: gains by push and model, one mapping per run.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from sim_bridge.experiments.belief.variance_gain import PUSHES

    figure, panels = plt.subplots(1, 4, figsize=(15, 4.9), layout="constrained", width_ratios=[1, 1, 1, 1.5])
    figure.suptitle("Variance gain of one push to the right, from the same belief (Fig. 6.5)")
    for axes, push in zip(panels, PUSHES, strict=False):
        _push(axes, push)
        gain = np.mean([each[push.name, "thesis"].predicted for each in found])
        axes.set_title(f"{push.title}: γ = {gain:.2f}", fontsize=11)
    panels[0].set_ylabel("y [mm]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower left", ncols=4, fontsize=9)
    _gains(panels[3], found)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _push(axes: Any, push: Any) -> None:
    """Particles (centres of the disc) before and after, thesis model, with perturbations."""
    from sim_bridge.experiments.belief.models import THESIS
    from sim_bridge.experiments.belief.variance_gain import ADVANCE, PERTURBATION, RADIUS, belief

    rng = np.random.default_rng(0)
    prior = belief(SHOWN, rng)
    noisy = dataclasses.replace(THESIS.dynamics(RADIUS, push.effectors), step_variance=PERTURBATION)
    after = noisy.simulate(prior, push.path, rng).belief.poses
    scale = 1e3
    axes.scatter(*(scale * prior.poses[:, :2].T), s=8, color="tab:blue", alpha=0.6, label="centres before")
    axes.scatter(*(scale * after[:, :2].T), s=8, color="tab:orange", alpha=0.7, label="centres after, noisy")
    circle = np.linspace(0.0, 2.0 * np.pi, 200)
    axes.plot(
        scale * (RADIUS * np.cos(circle) + ADVANCE), scale * RADIUS * np.sin(circle), color="0.5", lw=1.0,
        label="the disc in the middle",
    )  # fmt: skip
    _outline(axes, push.effectors, push.path[1], scale)
    axes.set(xlim=(-85, 65), ylim=(-75, 75), xlabel="x [mm]", aspect="equal")


def _outline(axes: Any, effectors: EndEffectors, point: NDArray, scale: float) -> None:
    """Filled end effectors, in millimetres."""
    from matplotlib.transforms import Affine2D

    before = len(axes.patches)
    draw_effectors(axes, effectors, point, facecolor="0.35", edgecolor="none", zorder=0)
    for patch in axes.patches[before:]:
        patch.set_transform(Affine2D().scale(scale) + axes.transData)
    axes.patches[before].set_label("what pushes, at the end")


def _gains(axes: Any, found: Sequence[Mapping[tuple[str, str], Any]]) -> None:
    from sim_bridge.experiments.belief.models import MODELS
    from sim_bridge.experiments.belief.variance_gain import PUSHES

    places = np.arange(len(PUSHES))
    for offset, model in zip((-0.2, 0.2), MODELS.values(), strict=True):
        rows = [[each[push.name, model.name] for each in found] for push in PUSHES]
        for shift, entry, marker, label in (
            (-0.1, "predicted", "s", "predicted"),
            (0.0, "sampled", "o", "Monte-Carlo of (6.18)"),
            (0.1, "dynamics", "^", "noisy dynamics"),
        ):
            means = [np.mean([getattr(each, entry) for each in runs]) for runs in rows]
            axes.plot(
                places + offset + shift, means, marker, color=COLOURS[model.name], ms=6, ls="none",
                label=f"{label}, {model.title.split(',')[0]}",
            )  # fmt: skip
        few = np.array([[each.few for each in runs] for runs in rows])
        low, middle, high = np.quantile(few, [0.05, 0.5, 0.95], axis=1)
        axes.errorbar(
            places + offset - 0.1, middle, [middle - low, high - middle], fmt="none", alpha=0.5, capsize=3,
            color=COLOURS[model.name], label="the same from 20 particles, middle 90 % of runs",
        )  # fmt: skip
    axes.axhline(1.0, color="k", lw=0.8, ls="--")
    axes.set_xticks(places, [push.title for push in PUSHES])
    axes.set(ylabel="variance gain γ", title="gains, mean of the runs", ylim=(0.0, None))
    axes.legend(fontsize=7.5, loc="lower left")
    axes.grid(alpha=0.3, axis="y")
