"""The figure of success rates over the iterations per horizon."""

import pathlib
from collections.abc import Mapping
from typing import Any

COLOURS = {"prior": "tab:blue", "no_prior": "tab:orange", "dof14": "tab:green"}


def write(path: pathlib.Path, rows: Mapping[str, Mapping[int, Mapping[str, Any]]]) -> None:
    """Draw into a PNG file.

    Args:
        path: of the file.
        rows: summaries by curve and iterations.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from sim_bridge.experiments.belief.belief_ablation import CURVES

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(16, 5.6), layout="constrained")
    figure.suptitle(
        "Two balls push a disc along a circle: iterations per horizon, contact prior, joints (Fig. 6.13)"
    )
    for shift, (curve, title) in zip((-0.03, 0.0, 0.03), CURVES.items(), strict=True):
        iterations, style = list(rows[curve]), {"color": COLOURS[curve], "marker": "o", "ms": 4}
        places = [m * 2.0**shift for m in iterations]
        for axes, name in ((left, "success"), (middle, "success_without_violation")):
            values = [100.0 * rows[curve][m][name] for m in iterations]
            bounds = [[100.0 * b for b in rows[curve][m][f"{name}_interval"]] for m in iterations]
            below = [max(value - low, 0.0) for value, (low, _) in zip(values, bounds, strict=True)]
            above = [max(high - value, 0.0) for value, (_, high) in zip(values, bounds, strict=True)]
            axes.errorbar(places, values, [below, above], capsize=3, label=title, **style)
        share = [100.0 * rows[curve][m]["violating_share"] for m in iterations]
        right.plot(places, share, label=title, **style)
    left.set(title="plan reaches the goal (mean within 1 cm, 500 horizons)", ylabel="share of the runs [%]")
    middle.set(title="and every horizon has a valid candidate", ylabel="share of the runs [%]")
    right.set(title="horizons without a valid candidate", ylabel="share of the horizons [%]")
    for axes in (left, middle, right):
        axes.set_xscale("log", base=2)
        axes.set_xticks(iterations, [f"{m}" for m in iterations])
        axes.set(xlabel="iterations per horizon M")
        axes.grid(alpha=0.3)
    for axes in (left, middle):
        axes.set_ylim(-4.0, 104.0)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.savefig(path, dpi=100)
    plt.close(figure)
