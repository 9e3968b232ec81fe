"""Comparing samples of costs in which a failure counts as an infinite cost."""

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom, mannwhitneyu

from sim_bridge.experiments.runs import success_interval

CLEARLY_BETTER, POSSIBLY_WORSE = 0.001, 0.05
"""Levels of the one-sided rank tests: dozens of values are compared, so a better one has to be so clearly."""

MATTERS = 0.005
"""Smallest difference of the median gap that counts."""

SLOWER = 1.5
"""Ratio of processor times over all problems from which on the longer one counts as worse."""


@dataclasses.dataclass(frozen=True, eq=False)
class Sample:
    """Results of the same option value on the same problem.

    Attributes:
        gaps: relative excess over the best known cost, inf for a failure, shape (R,).
        evaluations: median number of evaluations.
        seconds: median processor time.
    """

    gaps: NDArray
    evaluations: float
    seconds: float

    @property
    def successes(self) -> int:
        """How many runs did not fail."""
        return int(np.isfinite(self.gaps).sum())

    def median(self) -> tuple[float, float, float]:
        """Median gap and its 95 % confidence interval from order statistics; inf where failures reach."""
        ordered, count = np.sort(self.gaps), len(self.gaps)
        below = max(int(binom.ppf(0.025, count, 0.5)), 1) - 1
        low, high = ordered[below], ordered[count - 1 - below]
        return float(np.median(ordered)), float(low), float(high)

    def summary(self) -> dict[str, Any]:
        """For summary.json; null stands for an infinite number."""
        gap, low, high = (value if math.isfinite(value) else None for value in self.median())
        return {
            "runs": len(self.gaps),
            "success_rate": self.successes / len(self.gaps),
            "success_interval": success_interval(self.successes, len(self.gaps)),
            "gap_p50": gap,
            "gap_interval": [low, high],
            "evaluations_p50": self.evaluations,
            "cpu_ms_p50": 1e3 * self.seconds,
        }


Rows = dict[tuple[str, str], dict[str, Sample]]
"""Samples by problem, by the names of choice and value."""


def lower(first: Sample, second: Sample, level: float) -> bool:
    """Whether the gaps of the first sample are lower than those of the second beyond chance."""
    if np.array_equal(first.gaps, second.gaps):
        return False
    # Ranks need no finite numbers, but inf - inf would be nan.
    largest = max([gap for gap in (*first.gaps, *second.gaps) if math.isfinite(gap)], default=0.0)
    a, b = (np.minimum(sample.gaps, largest + 1.0) for sample in (first, second))
    return float(mannwhitneyu(a, b, alternative="less", method="asymptotic").pvalue) < level


def better(first: Sample, second: Sample) -> bool:
    """Whether the first sample is clearly better, by an amount that matters."""
    difference = second.median()[0] - first.median()[0]
    matters = first.successes > second.successes or not difference <= MATTERS
    return matters and lower(first, second, CLEARLY_BETTER)


def dominates(first: dict[str, Sample], second: dict[str, Sample]) -> bool:
    """Whether one value of an option should replace another.

    It should if it is clearly better on a problem, on none possibly worse, and not slower altogether.

    Args:
        first: samples by problem.
        second: samples by problem, for the same problems.
    """
    if not any(better(first[name], second[name]) for name in first):
        return False
    if any(lower(second[name], first[name], POSSIBLY_WORSE) for name in first):
        return False
    seconds = [sum(sample.seconds for sample in samples.values()) for samples in (first, second)]
    return seconds[0] <= SLOWER * seconds[1]
