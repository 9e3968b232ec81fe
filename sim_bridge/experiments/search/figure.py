"""The figure of the search experiment: gap to the best known over the values of every option."""

import pathlib
from collections.abc import Sequence

import numpy as np

from sim_bridge.experiments.search.statistics import Rows
from sim_bridge.experiments.search.variants import Choice

COLUMNS = 5


def draw(
    path: pathlib.Path,
    choices: Sequence[Choice],
    rows: Rows,
    titles: dict[str, str],
) -> None:
    """One panel per option: median and 95 % interval per value and problem; the value in use is marked.

    Args:
        path: image file to write.
        choices: options in the order of the panels.
        rows: samples by problem, by the names of choice and value.
        titles: of the problems.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    lines = -(-len(choices) // COLUMNS)
    figure = Figure(figsize=(4.0 * COLUMNS, 4.2 * lines), layout="constrained")
    colours = {name: f"C{i}" for i, name in enumerate(titles)}
    for number, choice in enumerate(choices):
        axes = figure.add_subplot(lines, COLUMNS, number + 1)
        shown = [name for name in titles if name in rows[choice.name, next(iter(choice.values))]]
        for k, name in enumerate(shown):
            medians = np.array([rows[choice.name, value][name].median() for value in choice.values])
            percent = 100.0 * np.where(np.isfinite(medians), medians, np.nan)
            x = np.arange(len(percent)) + 0.12 * (k - 0.5 * (len(shown) - 1))
            axes.vlines(x, percent[:, 1], percent[:, 2], color=colours[name], lw=1.0)
            axes.plot(x, percent[:, 0], "o-", ms=3.5, lw=0.7, color=colours[name], label=titles[name])
        marked = list(choice.values).index(choice.in_use)
        axes.axvspan(marked - 0.45, marked + 0.45, color="0.9", zorder=0)
        axes.set_xticks(range(len(choice.values)), list(choice.values), rotation=25, ha="right", fontsize=8)
        axes.set_yscale("symlog", linthresh=0.1)
        axes.set_ylim(bottom=0.0)
        axes.set_title(choice.name, fontsize=10)
        axes.set_ylabel("excess over the best known [%]", fontsize=8)
    handles = [Line2D([], [], color=colours[name], marker="o", ms=3.5, lw=0.7) for name in titles]
    figure.legend(handles, titles.values(), loc="outside lower center", ncols=len(titles), fontsize=8)
    figure.savefig(path, dpi=120)
