"""The figure of the puck's filter: velocity errors after contacts, and the innovations."""

import math
import pathlib

import numpy as np

from sim_bridge.experiments.hockey.puck_filters import AFTER, BOUNCE, HIT, PIECEWISE, Comparison

_BIN = 0.01


def write(path: pathlib.Path, found: list[Comparison]) -> None:
    """Draw errors after bounces, after hits, and the distribution of the innovations into a PNG file."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(14, 4.2), layout="constrained")
    for axis, code, title in ((axes[0], BOUNCE, "bounce"), (axes[1], HIT, "hit")):
        for name, colour, label in (
            (PIECEWISE, "tab:blue", "piecewise-linear"),
            (f"constant_velocity_{title}", "tab:orange", "constant velocity, tuned for this"),
        ):
            axis.plot(*_after(found, name, code), color=colour, label=label, drawstyle="steps-mid")
        axis.set(title=f"after a {title}", xlabel="time since its end [ms]", yscale="log")
        axis.grid(alpha=0.3, which="both")
        axis.legend()
    axes[0].set_ylabel("mean error of the velocity [m/s]")
    _draw_innovations(axes[2], found)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _after(found: list[Comparison], name: str, code: int) -> tuple[np.ndarray, np.ndarray]:
    """Middle of each 10 ms after a contact [ms] and the mean error there [m/s]."""
    since = np.concatenate([c.since[c.phase == code] for c in found])
    errors = np.concatenate([c.errors[name][c.phase == code] for c in found])
    place = np.floor(since / _BIN + 1e-9).astype(int)
    bins = [k for k in range(round(AFTER / _BIN)) if (place == k).any()]
    return 1e3 * _BIN * (np.array(bins) + 0.5), np.array([errors[place == k].mean() for k in bins])


def _draw_innovations(axis, found: list[Comparison]) -> None:
    values = np.concatenate([c.innovations for c in found])
    edges = np.linspace(0.0, 16.0, 65)
    axis.hist(values, edges, density=True, color="tab:blue", alpha=0.5, label="piecewise-linear filter")
    middle = 0.5 * (edges[1:] + edges[:-1])
    label = "chi-squared, 2 degrees of freedom"
    axis.plot(middle, [0.5 * math.exp(-0.5 * x) for x in middle], color="black", label=label)
    axis.set(title="innovations", xlabel="normalised innovation squared", ylabel="density", yscale="log")
    axis.grid(alpha=0.3, which="both")
    axis.legend()
