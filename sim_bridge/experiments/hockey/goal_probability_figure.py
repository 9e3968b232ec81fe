"""The figure of predicted and observed goals: a reliability diagram, and the model's own trajectories."""

import pathlib
from collections.abc import Sequence
from typing import Any

from sim_bridge.experiments.hockey.goal_monte_carlo import BANKS, Agreement

_COLOURS = {"direct": "tab:green", "bank": "tab:red"}


def write(path: pathlib.Path, summary: dict[str, Any], agreements: Sequence[Agreement]) -> None:
    """Draw into a PNG file.

    Args:
        path: of the file.
        summary: of the experiment.
        agreements: with the model's own trajectories.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(11, 5.2), layout="constrained")
    for axes in panels:
        axes.plot([0, 1], [0, 1], color="0.6", lw=1)
        axes.set(aspect="equal", xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    _reliability(panels[0], summary)
    _trajectories(panels[1], agreements)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _reliability(axes: Any, summary: dict[str, Any]) -> None:
    axes.fill_between([0, 1], [-0.07, 0.93], [0.07, 1.07], color="0.93", label="± 0.07")
    for name, colour in _COLOURS.items():
        bins = summary[name]["bins"]
        x, y = [row["predicted"] for row in bins], [row["observed"] for row in bins]
        errors = [
            [max(row["observed"] - row["interval"][0], 0.0) for row in bins],
            [max(row["interval"][1] - row["observed"], 0.0) for row in bins],
        ]
        label = f"{name} shots ({summary[name]['shots']})"
        axes.errorbar(x, y, errors, fmt="o-", color=colour, capsize=3, label=label)
    axes.set(xlabel="predicted probability of a goal", ylabel="share that scored")
    axes.set_title("struck by the simulated arm, bars 95 %")
    axes.legend(loc="upper left")


def _trajectories(axes: Any, agreements: Sequence[Agreement]) -> None:
    for banks in BANKS:
        chosen = [each for each in agreements if each.banks == banks]
        axes.plot(
            [each.mass for each in chosen], [each.simulated for each in chosen], "o", ms=4, alpha=0.7,
            label=f"{banks} banks",
        )  # fmt: skip
    axes.set(xlabel="mass of the Gaussians, (5.10)", ylabel="share of the model's own trajectories")
    axes.set_title("against Monte-Carlo of the stochastic model")
    axes.legend(loc="upper left")
