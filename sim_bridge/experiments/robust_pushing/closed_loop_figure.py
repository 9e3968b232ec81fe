"""Times to the goal of both planners, pair by pair, and the distance from the goal in some runs."""

import pathlib

import numpy as np

from sim_bridge.experiments.robust_pushing import bimanual_closed_loop as closed

_ROBUST, _PLAIN = "#3a7d44", "#c1121f"


def write(
    folder: pathlib.Path, robust: list[closed.TrialResult], plain: list[closed.TrialResult]
) -> pathlib.Path:
    """Write times.png."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(14, 4.4), layout="constrained")
    for runs, colour, name in ((robust, _ROBUST, "robust"), (plain, _PLAIN, "deterministic")):
        ways = np.sort(np.concatenate([run.ways for run in runs]))
        shares = np.arange(1, len(ways) + 1) / len(ways)
        left.step(ways, shares, where="post", color=colour, label=name)
    left.set(xlabel="time of a way to the goal [s]", ylabel="share of ways at the goal", ylim=(0.0, 1.02))
    left.legend(loc="lower right")
    left.grid(alpha=0.3)
    sums = np.array([[sum(run.ways) for run in runs] for runs in (plain, robust)])
    middle.plot(*sums, "o", ms=4, color="0.3")
    ends = 0.9 * sums.min(), 1.1 * sums.max()
    middle.plot(ends, ends, color="0.6", lw=0.8)
    middle.set(
        xlabel="deterministic: three ways [s]", ylabel="robust: three ways [s]",
        xscale="log", yscale="log", xlim=ends, ylim=ends,
        title="a point per pair; below the line robust is faster",
    )  # fmt: skip
    for run, colour in ((robust[0], _ROBUST), (plain[0], _PLAIN)):
        distance = np.linalg.norm(run.poses[:, :2] - closed.GOAL, axis=1)
        right.plot(run.times, 1e3 * distance, color=colour, lw=1.0)
    right.axhline(1e3 * closed.TOLERANCE, color="0.4", ls="--", lw=0.8)
    right.set(xlabel="time [s]", ylabel="distance from the goal [mm]", title="the first pair", ylim=(0, None))
    path = folder / "times.png"
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path
