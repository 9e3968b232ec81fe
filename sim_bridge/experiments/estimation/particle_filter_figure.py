"""The figure of the particle filter: errors over time, median and tenth to ninetieth percentile."""

import pathlib

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.estimation.filters import VARIANTS, Comparison

_TITLES = {
    "two_balls": "two balls; the camera is off twice for 1 s",
    "one_ball": "one ball; the camera is off twice for 1 s",
    "blind": "two balls; one bad picture at the start, then none",
}
_COLOURS = {
    "touch": "tab:green", "touch_sum": "tab:olive", "particles": "tab:blue", "kalman": "tab:gray",
}  # fmt: skip


def write(path: pathlib.Path, comparisons: list[Comparison]) -> None:
    """Draw one panel for each kind of push into a PNG file."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(_TITLES), figsize=(15, 4.6), sharey=True, layout="constrained")
    for axis, (kind, title) in zip(axes, _TITLES.items(), strict=True):
        chosen = [c for c in comparisons if c.episode.kind == kind]
        length = min(len(c.times) for c in chosen)
        times = chosen[0].times[:length]
        for variant, label in VARIANTS.items():
            errors = 1e3 * np.array([c.tracks[variant].error[:length] for c in chosen])
            known = np.isfinite(errors).all(axis=0)
            low, middle, high = np.quantile(errors[:, known], [0.1, 0.5, 0.9], axis=0)
            axis.plot(times[known], middle, color=_COLOURS[variant], label=label)
            axis.fill_between(times[known], low, high, color=_COLOURS[variant], alpha=0.15, lw=0)
        off = np.mean([_dark(c, times) for c in chosen], axis=0)
        axis.fill_between(times, 0.1, 0.1 * 10 ** (0.3 * off), color="black", alpha=0.3, lw=0)
        touched = np.median([c.touched for c in chosen])
        axis.axvline(touched, color="black", lw=1, ls=":", label="first contact, median")
        axis.set(title=title, xlabel="time [s]", yscale="log", ylim=(0.1, 300.0))
        axis.grid(alpha=0.3, which="both")
    axes[0].set_ylabel("distance of the estimate from the can [mm]")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    figure.suptitle(f"{len(comparisons) // len(_TITLES)} pushes each; at the bottom: share without camera")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _dark(comparison: Comparison, times: np.ndarray) -> NDArray[np.bool_]:
    dropouts = comparison.dropouts
    return np.any((times[:, None] >= dropouts[:, 0]) & (times[:, None] < dropouts[:, 1]), axis=1)
