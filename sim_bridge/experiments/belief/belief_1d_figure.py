"""The figure of the box on a line: beliefs before and after a push, and the variance over the push."""

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.belief.box_belief import BoxPush

SHOWN_STOP = 0.06
"""Where the hand stops in the left panel [m]."""


def write(path: pathlib.Path, push: BoxPush, stops: NDArray, found: Sequence[Any]) -> None:
    """Draw into a PNG file.

    Args:
        path: of the file.
        push: the example.
        stops: of the hand, shape (U,) [m].
        found: Monte-Carlo estimates with `variance` and `few`, shape (U,) each.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.8), layout="constrained")
    figure.suptitle("A box on a line is pushed by a hand that comes from the left (Fig. 6.3)")
    _densities(left, push)
    _variances(right, push, stops, found)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _densities(axes: Any, push: BoxPush) -> None:
    u = SHOWN_STOP
    x = np.linspace(push.lower - 0.01, push.upper + push.noise + 0.01, 2000)
    before = ((x >= push.lower) & (x <= push.upper)) / (push.upper - push.lower)
    samples = push.sample(u, 20_000, np.random.default_rng(0))
    axes.fill_between(1e3 * x, before / 1e3, color="tab:blue", alpha=0.2, label="belief before the push")
    axes.hist(
        1e3 * samples, bins=60, density=True, color="tab:orange", alpha=0.45,
        label="after it: 20000 particles, eq. (6.12)",
    )  # fmt: skip
    axes.plot(1e3 * x, push.density(u, x) / 1e3, color="tab:blue", label="after it: closed form, eq. (6.14)")
    axes.axvline(1e3 * u, color="k", ls="--", lw=1.0, label=f"the hand stops at {1e3 * u:.0f} mm")
    axes.set(
        xlabel="position of the box [mm]", ylabel="probability density [1/mm]",
        title=f"Belief, noise uniform in 0 .. {1e3 * push.noise:.0f} mm", ylim=(0.0, 0.065),
    )  # fmt: skip
    axes.legend(fontsize=9, loc="upper left")


def _variances(axes: Any, push: BoxPush, stops: NDArray, found: Sequence[Any]) -> None:
    few, many = (np.array([getattr(each, name) for each in found]) for name in ("few", "variance"))
    low, high = np.quantile(few, [0.05, 0.95], axis=0)
    axes.fill_between(
        1e3 * stops, 1e6 * low, 1e6 * high, color="tab:orange", alpha=0.2,
        label="20 particles: middle 90 % of the runs",
    )  # fmt: skip
    fine = np.linspace(push.lower, push.upper, 400)
    axes.plot(1e3 * fine, 1e6 * push.variance(fine), color="tab:blue", label="closed form, of eq. (6.14)")
    axes.plot(1e3 * stops, 1e6 * many.mean(axis=0), "o", color="tab:orange", ms=3.5,
              label="thousands of particles, mean of the runs")  # fmt: skip
    for centred, style, label in (
        (True, "k:", "prediction (6.21), mean of the noise in f"),
        (False, "r--", "prediction (6.21), noise taken for zero-mean"),
    ):
        predicted = 1e6 * push.predicted_variance(fine, centred=centred)
        axes.plot(1e3 * fine, predicted, style, lw=1.4, label=label)
    axes.set(
        xlabel="where the hand stops, u [mm]", ylabel="variance of the position [mm²]", ylim=(0.0, None),
        title="Variance after the push",
    )  # fmt: skip
    axes.legend(fontsize=9)
    axes.grid(alpha=0.3)
