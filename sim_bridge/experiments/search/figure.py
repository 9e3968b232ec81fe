"""The figure of the search experiment: gap to the best known over the values of every option."""

import itertools
import pathlib
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.search.statistics import Rows
from sim_bridge.experiments.search.variants import Choice

COLUMNS = 3
COLOURS = (*(f"C{i}" for i in range(10)), "black", "gold", "navy", "lime")
LINEAR = 0.1
"""Excess [%] below which the axis is linear, so that it has a zero."""

NAMES = {
    "clutter_plain": "plane with obstacles, plain setting",
    "clutter_long": "plane with obstacles, four times the budget",
    "arm_long": "seven joints, free, nine via-points",
    "standing": "replanning among obstacles that stand",
    "moving": "replanning among obstacles and moving discs",
    "cells_stop": "arm in random cells, until enough rounds are valid",
}
"""What problems are called where they do not stand next to each other as the columns of a table do."""


def draw(
    path: pathlib.Path,
    choices: Sequence[Choice],
    rows: Rows,
    titles: dict[str, str],
) -> None:
    """One panel per option: median and 95 % interval per value and problem; the value in use is marked.

    Where half of the runs fail or more, there is no median; a cross at the top says so. All panels have the
    same scale.

    Args:
        path: image file to write.
        choices: options in the order of the panels.
        rows: samples by problem, by the names of choice and value.
        titles: of the problems.
    """
    from matplotlib.figure import Figure

    lines = -(-len(choices) // COLUMNS)
    entries = -(-(len(titles) + 3) // 2)
    height, legend = 3.3 * lines, 0.24 * entries + 0.7
    figure = Figure(figsize=(4.0 * COLUMNS, height + legend))
    figure.subplots_adjust(
        left=0.07, right=0.985, bottom=0.9 / (height + legend), top=height / (height + legend),
        wspace=0.2, hspace=0.5,
    )  # fmt: skip
    colours = dict(zip(titles, itertools.cycle(COLOURS), strict=False))
    top = _top(rows)
    for number, choice in enumerate(choices):
        axes = figure.add_subplot(lines, COLUMNS, number + 1)
        shown = [name for name in titles if name in rows[choice.name, next(iter(choice.values))]]
        for k, name in enumerate(shown):
            percent = 100.0 * np.array([rows[choice.name, value][name].median() for value in choice.values])
            x = np.arange(len(percent)) + 0.12 * (k - 0.5 * (len(shown) - 1))
            _draw_problem(axes, x, percent, top, colours[name])
        _dress(axes, choice, top)
        if number % COLUMNS == 0:
            axes.set_ylabel("excess over the best known [%]", fontsize=9)
    handles = _explained({NAMES.get(name, title): colours[name] for name, title in titles.items()})
    figure.legend(handles=handles, loc="upper center", ncols=2, fontsize=10)
    figure.savefig(path, dpi=100)


def _top(rows: Rows) -> float:
    """The power of ten [%] above everything that is finite."""
    gaps = np.array([sample.median() for samples in rows.values() for sample in samples.values()])
    largest = np.max(gaps, where=np.isfinite(gaps), initial=0.01)
    return float(10.0 ** np.ceil(np.log10(100.0 * largest) + 0.05))


def _draw_problem(axes: Any, x: NDArray, percent: NDArray, top: float, colour: str) -> None:
    """Medians and intervals of one problem; what is infinite ends at the top."""
    reached = np.minimum(percent, top)
    axes.vlines(x, reached[:, 1], reached[:, 2], color=colour, lw=1.2)
    failed = ~np.isfinite(percent[:, 0])
    axes.plot(x, np.where(failed, np.nan, percent[:, 0]), "o-", ms=4, lw=0.8, color=colour)
    axes.plot(x[failed], reached[failed, 0], "X", ms=7, color=colour, clip_on=False, zorder=3)


def _dress(axes: Any, choice: Choice, top: float) -> None:
    """Scale, title, names of the values, and the mark of the value in use."""
    marked = list(choice.values).index(choice.in_use)
    axes.axvspan(marked - 0.45, marked + 0.45, color="0.9", zorder=0)
    names = ["\n".join(textwrap.wrap(value, 18)) for value in choice.values]
    steep = max(map(len, choice.values)) * len(names) > 36
    style: dict[str, Any] = {"fontsize": 9}
    if steep:
        style = {"fontsize": 8, "rotation": 20, "ha": "right", "rotation_mode": "anchor"}
    axes.set_xticks(range(len(names)), names, **style)
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.set_yscale("symlog", linthresh=LINEAR)
    ticks = [0.0, *10.0 ** np.arange(np.log10(LINEAR), np.log10(top) + 0.5)]
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks], fontsize=9)
    axes.set_ylim(0.0, top)
    axes.grid(axis="y", alpha=0.3)
    used_by = "" if choice.used_by == "default" else f"\n({choice.used_by})"
    axes.set_title(f"{choice.name}{used_by}", fontsize=10)


def _explained(colours: dict[str, str]) -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    dot: dict[str, Any] = {"color": "0.3", "marker": "o", "ms": 4}
    cross: dict[str, Any] = {"color": "0.3", "marker": "X", "ms": 7}
    return [
        *(Line2D([], [], **dot | {"color": colour}, lw=0.8, label=name) for name, colour in colours.items()),
        Line2D([], [], **dot, lw=0, label="median of the runs; bar: its 95 % interval"),
        Line2D([], [], **cross, lw=0, label="half of the runs or more fail: no median"),
        Patch(color="0.9", label="value in use (title: by which experiment, if not the default)"),
    ]
