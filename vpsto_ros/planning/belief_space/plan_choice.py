"""Choosing among open-loop plans: searches are random, and what is played blind is rehearsed first."""

import math
from collections.abc import Callable
from typing import TypeVar

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.planning.belief_space.receding_horizon import RobustPlan

_Verdict = TypeVar("_Verdict")


def best_plan(
    make: Callable[[], RobustPlan],
    judge: Callable[[RobustPlan], _Verdict],
    score: Callable[[_Verdict], float],
    attempts: int,
    *,
    enough: float = math.inf,
) -> tuple[RobustPlan, _Verdict]:
    """The best of some plans; one that reaches its target beats all that do not.

    Args:
        make: plans once, with fresh randomness each time.
        judge: rehearses a plan, by noisy rollouts.
        score: of a verdict, more is better.
        attempts: how many plans are made at most.
        enough: score of a plan that reaches its target from which on no more plans are made.

    Raises:
        InvalidInputError: fewer than one attempt.
    """
    if attempts < 1:
        raise InvalidInputError(f"at least one plan has to be made, got attempts = {attempts}")
    best: tuple[tuple[bool, float], RobustPlan, _Verdict] | None = None
    for _ in range(attempts):
        plan = make()
        verdict = judge(plan)
        rank = (plan.reached, score(verdict))
        if best is None or rank > best[0]:
            best = rank, plan, verdict
        if best[0][0] and best[0][1] >= enough:
            break
    assert best is not None, "there was at least one attempt"
    return best[1], best[2]
