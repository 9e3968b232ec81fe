"""What a search is given and gives back: evaluations of candidates, the best of them, and time."""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

RESERVES = ("longest", "last", "none")


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Costs of a batch of candidates, shape (B,), and which of them satisfy all constraints, shape (B,) bool.

    Candidates are ranked by cost alone (4.3.3), so constraints need a cost as well, as in (4.16).
    """

    cost: np.ndarray
    valid: np.ndarray


class Iteration(NamedTuple):
    """What one iteration saw.

    Attributes:
        best_cost: lowest cost in this iteration, valid or not.
        best_valid_cost: lowest cost of a valid candidate so far, inf if there was none.
        valid_count: how many candidates of this iteration were valid.
        sigma: step size of the first start.
    """

    best_cost: float
    best_valid_cost: float
    valid_count: int
    sigma: float


@dataclasses.dataclass(frozen=True)
class SearchResult:
    """Outcome of a search.

    Attributes:
        points: best valid points, shape (P, n), or None if there are none.
        cost: their cost, inf if there are none.
        valid: whether there are any.
        best_any_points: points of the lowest finite cost, valid or not, shape (P, n), or None if no cost was
            finite.
        best_any_cost: their cost, inf if there are none.
        iterations, evaluations, restarts: how often each happened.
        non_finite: number of candidates whose cost was not finite.
        status: "converged", "iterations" (all of them done), "deadline" or "no valid plan".
        history: one entry per iteration.
    """

    points: np.ndarray | None
    cost: float
    valid: bool
    best_any_points: np.ndarray | None
    best_any_cost: float
    iterations: int
    evaluations: int
    restarts: int
    non_finite: int
    status: str
    history: tuple[Iteration, ...]


class Incumbents:
    """The best candidates so far."""

    def __init__(self) -> None:
        self.points: np.ndarray | None = None
        self.cost = math.inf
        self.any_points: np.ndarray | None = None
        self.any_cost = math.inf
        self.evaluations = 0
        self.non_finite = 0

    @property
    def valid(self) -> bool:
        """Whether there are valid ones."""
        return self.points is not None

    def update(self, points: np.ndarray, evaluation: Evaluation) -> int:
        """Take in a batch; returns how many of it are valid."""
        cost, valid = evaluation.cost, evaluation.valid
        self.evaluations += len(cost)
        self.non_finite += int(np.count_nonzero(cost == math.inf))
        lowest = int(cost.argmin())
        best_cost = float(cost[lowest])
        if best_cost < self.any_cost:
            self.any_cost, self.any_points = best_cost, points[lowest].copy()
        count = int(np.count_nonzero(valid))
        if count:
            lowest = int(np.where(valid, cost, math.inf).argmin())
            if cost[lowest] < self.cost:
                self.cost, self.points = float(cost[lowest]), points[lowest].copy()
        return count

    def result(self, history: list[Iteration], restarts: int, status: str) -> SearchResult:
        """What the search returns."""
        return SearchResult(
            points=self.points,
            cost=self.cost,
            valid=self.valid,
            best_any_points=self.any_points,
            best_any_cost=self.any_cost,
            iterations=len(history),
            evaluations=self.evaluations,
            restarts=restarts,
            non_finite=self.non_finite,
            status=status if self.valid else "no valid plan",
            history=tuple(history),
        )


class Timer:
    """Tells when the next iteration would end too late.

    Args:
        deadline: time of the clock by which to be back, None if there is none.
        clock: reads the time.
        reserve: how long the next iteration is taken to last: as the "longest" so far, as the "last" one, or
            "none": then the deadline alone counts, and the iteration that crosses it is finished.
    """

    def __init__(self, deadline: float | None, clock: Callable[[], float], reserve: str) -> None:
        self._deadline, self._clock, self._reserve = deadline, clock, reserve
        self._previous: float | None = None
        self._needed = 0.0

    def expired(self) -> bool:
        """To be asked before every iteration."""
        if self._deadline is None:
            return False
        now = self._clock()
        if self._previous is not None and self._reserve != "none":
            took = now - self._previous
            self._needed = max(self._needed, took) if self._reserve == "longest" else took
        self._previous = now
        return now + self._needed >= self._deadline
