"""Fig. 6.3: the belief over a box on a line after a push, and its variance as a function of the push.

The closed form (6.14) is compared with thousands of particles that follow (6.12), and the deterministic
prediction (6.21) with both. That one assumes noise of zero mean, while the noise of (6.12) is uniform in
[0, alpha]: it is exact when the mean alpha / 2 belongs to the nominal model, and wrong where it does not.
"""

import argparse
import dataclasses
import functools
import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.belief import belief_1d_figure
from sim_bridge.experiments.belief.box_belief import BoxPush
from sim_bridge.experiments.runs import Execution, markdown_table, print_verdict, run_trials, write_summary

PUSH = BoxPush()
STOPS = np.linspace(PUSH.lower, PUSH.upper, 41)
PARTICLES, FEW = 5000, 20
ALLOWED = 4.0
"""Standard errors that the largest of 41 deviations may have: by chance it is above in one call of 400."""


@dataclasses.dataclass(frozen=True, eq=False)
class Estimate:
    """Monte-Carlo at every stop of the hand, with one seed.

    Attributes:
        variance: of thousands of particles, shape (U,).
        mean: of the same, shape (U,).
        few: variance of twenty particles, shape (U,).
        distance: largest distance between the distribution of the particles and the closed form, shape (U,).
    """

    variance: NDArray
    mean: NDArray
    few: NDArray
    distance: NDArray


def simulate(seed: int) -> Estimate:
    """Push the particles."""
    rng = np.random.default_rng(seed)
    samples = np.array([PUSH.sample(u, PARTICLES, rng) for u in STOPS])
    few = np.array([PUSH.sample(u, FEW, rng) for u in STOPS])
    ranks = np.arange(PARTICLES + 1) / PARTICLES
    distance = []
    for u, row in zip(STOPS, np.sort(samples, axis=1), strict=True):
        exact = PUSH.distribution(u, row)
        distance.append(max(np.abs(exact - ranks[1:]).max(), np.abs(exact - ranks[:-1]).max()))
    variance, few_variance = samples.var(axis=1, ddof=1), few.var(axis=1, ddof=1)
    return Estimate(variance, samples.mean(axis=1), few_variance, np.array(distance))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Nothing beyond the options of every experiment."""


def run(arguments: argparse.Namespace) -> int:
    """Compare; 0 when closed form, particles and prediction agree."""
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    found = run_trials(simulate, seeds, Execution.from_arguments(arguments), "belief_1d")
    summary = {"experiment": "belief_1d", "seed": arguments.seed, "runs": arguments.runs, **summarise(found)}
    folder = pathlib.Path(arguments.out)
    write_summary(folder, summary)
    text = table(found)
    (folder / "table.md").write_text(text)
    belief_1d_figure.write(folder / "belief_1d.png", PUSH, STOPS, found)
    print(f"{text}\nresults in {folder}")
    missed = missed_targets(summary)
    return print_verdict(
        not missed,
        "; ".join(missed) or "particles and prediction agree with the closed form within "
        f"{summary['max_deviation_standard_errors']:.1f} standard errors (allowed {ALLOWED:g})",
    )


def missed_targets(summary: dict[str, Any]) -> list[str]:
    """What falls short, in words."""
    variance, mean = summary["max_deviation_standard_errors"], summary["max_mean_deviation_standard_errors"]
    centred = summary["max_prediction_error_centred"]
    checks = {
        f"the particles' variance is {variance:.1f} standard errors off, allowed {ALLOWED:g}":
            variance <= ALLOWED,
        f"the particles' mean is {mean:.1f} standard errors off, allowed {ALLOWED:g}": mean <= ALLOWED,
        f"the prediction with centred noise is {100 * centred:.1g} % off": centred < 1e-9,
    }  # fmt: skip
    return [text for text, good in checks.items() if not good]


def deviations(estimates: NDArray, exact: NDArray) -> NDArray:
    """Deviation of the mean over runs (R, U) from the closed form (U,) in its standard errors."""
    error = estimates.std(axis=0, ddof=1) / np.sqrt(len(estimates))
    return (estimates.mean(axis=0) - exact) / np.maximum(error, 1e-15)


def summarise(found: list[Estimate]) -> dict[str, Any]:
    """Deviations of particles and prediction from the closed form."""
    from scipy.stats import kstwo

    exact = PUSH.variance(STOPS)
    few = np.array([each.few for each in found])
    ratios = {
        name: PUSH.predicted_variance(STOPS, centred=centred) / exact - 1.0
        for name, centred in (("centred", True), ("as_read", False))
    }
    distance = np.array([each.distance for each in found])
    worst = {
        name: float(np.abs(deviations(np.array([getattr(e, entry) for e in found]), reference)).max())
        for name, entry, reference in (("", "variance", exact), ("_mean", "mean", PUSH.mean(STOPS)))
    }
    return {
        "particles": PARTICLES,
        "stops": len(STOPS),
        "max_deviation_standard_errors": worst[""],
        "max_mean_deviation_standard_errors": worst["_mean"],
        "share_of_distributions_rejected_at_5_percent": float((distance > kstwo.ppf(0.95, PARTICLES)).mean()),
        "max_prediction_error_centred": float(np.abs(ratios["centred"]).max()),
        "prediction_error_as_read": [float(ratios["as_read"].min()), float(ratios["as_read"].max())],
        "std_of_variance_from_20_particles": float((few.std(axis=0, ddof=1) / exact).mean()),
        "variance_before_mm2": 1e6 * float(exact[0]),
        "variance_pushed_through_mm2": 1e6 * float(exact[-1]),
        "every_push_reduces_variance": bool((exact[1:] < exact[0]).all()),
    }


def table(found: list[Estimate]) -> str:
    """Variances at some stops of the hand."""
    variance = np.array([each.variance for each in found])
    few = np.array([each.few for each in found])
    half = 1.96 * variance.std(axis=0, ddof=1) / np.sqrt(len(found))
    header = [
        "hand stops at", "touches", "closed form", f"{PARTICLES} particles (95 %)", "deviation",
        f"{FEW} particles, scatter", "prediction, noise centred", "prediction, as read",
    ]  # fmt: skip
    off = deviations(variance, PUSH.variance(STOPS))
    predicted = functools.partial(PUSH.predicted_variance, STOPS)
    columns = (PUSH.variance(STOPS), predicted(centred=True), predicted(centred=False))
    rows = []
    for i in range(0, len(STOPS), 8):
        exact, centred, read = (1e6 * column[i] for column in columns)
        rows.append([
            f"{1e3 * STOPS[i]:.0f} mm", f"{100 * PUSH.contact(STOPS[i]):.0f} %", f"{exact:.1f} mm²",
            f"{1e6 * variance[:, i].mean():.1f} ± {1e6 * half[i]:.1f} mm²", f"{off[i]:+.1f} SE",
            f"± {1e6 * few[:, i].std(ddof=1):.0f} mm²", f"{centred:.1f} mm²", f"{read:.1f} mm²",
        ])  # fmt: skip
    return markdown_table(header, rows)
