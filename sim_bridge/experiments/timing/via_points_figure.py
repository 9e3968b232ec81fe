"""The figure of the via-point study: duration and iterations over the number of via-points, and profiles."""

import pathlib

import numpy as np

from vpsto_ros.trajectory import Limits, Trajectory


def write(
    path: pathlib.Path,
    rows: dict[str, dict[str, float]],
    profiles: dict[int, Trajectory],
    bang_bang: float,
    limits: Limits,
) -> None:
    """Write the figure in the manner of Fig. 4.6.

    Args:
        path: PNG file.
        rows: summaries of the one-dimensional cases by name, ``1d_<N>``.
        profiles: one solution for every N.
        bang_bang: duration of the optimal solution without via-points [s].
        limits: of the one degree of freedom.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    counts = list(profiles)
    column = {key: np.array([rows[f"1d_{n}"][key] for n in counts]) for key in rows[f"1d_{counts[0]}"]}
    figure, axes = plt.subplots(2, 2, figsize=(10, 6.6), layout="constrained")
    figure.suptitle("One joint from rest to rest over a distance of 1, with N free via-points")
    _durations(axes[0, 0], counts, column, bang_bang)
    _iterations(axes[1, 0], counts, column)
    _profiles(axes[:, 1], profiles, limits)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _durations(axes, counts, column, bang_bang) -> None:
    axes.plot(counts, column["optimum_s"], "_", color="black", ms=14, label="optimum (linear program)")
    axes.plot(counts, column["duration_s_p50"], "o", color="tab:blue", label="VP-STO, uniform phases")
    axes.plot(counts, column["free_timing_s"], "x", color="tab:green", label="with free timing")
    axes.axhline(bang_bang, color="black", ls="--", lw=1, label=f"bang-bang, {bang_bang:g} s")
    axes.set(ylabel="duration [s]", xticks=counts)
    axes.legend()


def _iterations(axes, counts, column) -> None:
    middle = column["iterations_p50"]
    spread = [middle - column["iterations_p10"], column["iterations_p90"] - middle]
    axes.errorbar(counts, middle, spread, fmt="o", color="tab:blue", capsize=3)
    label = "iterations to converge\n(median, p10 to p90)"
    axes.set(xlabel="free via-points N", ylabel=label, xticks=counts, ylim=(0, None))
    axes.set_title("VP-STO, uniform phases", fontsize=10)


def _profiles(axes, profiles: dict[int, Trajectory], limits: Limits) -> None:
    import matplotlib.pyplot as plt

    colours = plt.get_cmap("viridis")(np.linspace(0.0, 0.95, len(profiles)))
    for (n, motion), colour in zip(profiles.items(), colours, strict=True):
        times = np.linspace(motion.start_time, motion.end_time, 800)
        for order in (1, 2):
            axes[order - 1].plot(times, motion(times, order)[:, 0], color=colour, lw=1.2, label=f"N = {n}")
    for axis, limit, label in zip(
        axes,
        (limits.velocity[0], limits.acceleration[0]),
        ("velocity [1/s]", "acceleration [1/s²]"),
        strict=True,
    ):
        for sign in (-1.0, 1.0):
            axis.axhline(sign * limit, color="black", ls="--", lw=1)
        axis.set(ylabel=label)
    axes[0].set(ylim=(-0.1 * limits.velocity[0], 1.1 * limits.velocity[0]))
    axes[0].set_title("solutions with uniform phases, and the limits (dashed)", fontsize=10)
    axes[1].set(xlabel="time [s]")
    axes[0].legend(ncols=3, fontsize="x-small", loc="lower left", bbox_to_anchor=(0.14, 0.05))
