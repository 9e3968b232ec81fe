"""Which options of the search are compared, and with which values: one at a time, round the default."""

import dataclasses
from typing import Any

from vpsto_ros.optimization.cma import STRATEGIES
from vpsto_ros.optimization.vpsto import VpstoConfig
from vpsto_ros.planning.joint_space import JointSpaceMpcConfig

SEARCH = VpstoConfig()
"""The default of a single search; the number of iterations follows from the budget."""

ONLINE = JointSpaceMpcConfig()
"""The default when replanning."""

SHORT = ("clutter", "arm", "line", "walls")
ALL = ("clutter", "clutter_long", "arm", "line", "walls")
CONVERGED = {"restart": "converged", "restarts": 100, "tolerance": 1e-3, "patience": 8}
STEP_EVALUATIONS = ONLINE.online.search.population * ONLINE.online.search.iterations


@dataclasses.dataclass(frozen=True)
class Choice:
    """One option and the values it is given.

    Attributes:
        name: of the option, in words.
        values: what differs from the default, by the name of the value; the default's own value included,
            with nothing that differs.
        problems: names of the problems it is compared on; none when replanning.
    """

    name: str
    values: dict[str, dict[str, Any]]
    problems: tuple[str, ...] = ()


def _values(option: str, default: Any, others: tuple[Any, ...]) -> dict[str, dict[str, Any]]:
    values = sorted({default, *others}) if not isinstance(default, str) else [default, *others]
    return {str(value): {} if value == default else {option: value} for value in values}


OFFLINE = (
    Choice("population", _values("population", SEARCH.population, (8, 16, 24, 48, 64, 128)), ALL),
    Choice(
        "covariance adaptation",
        _values("strategy", SEARCH.strategy, tuple(s for s in STRATEGIES if s != SEARCH.strategy)),
        SHORT,
    ),
    Choice("step size", _values("sigma", SEARCH.sigma, (0.25, 0.5, 2.0)), SHORT),
    Choice("starts side by side", _values("starts", SEARCH.starts, (2, 4)), ALL),
    Choice(
        "restarts",
        {
            "1 while invalid": {},
            "none": {"restarts": 0},
            "4 while invalid": {"restarts": 4},
            "when converged": CONVERGED,
            "when converged, population doubled": {**CONVERGED, "population_growth": 2.0},
        },
        ALL,
    ),
)

REPLANNING = (
    Choice("start from the last plan", {"yes": {}, "no": {"warm_start": False}}),
    Choice(
        "step size from the last plan", _values("warm_sigma", ONLINE.online.warm_sigma, (0.05, 0.1, 0.5, 1.0))
    ),
    Choice(
        "via-points per second (0: always N_max)",
        _values("via_rate", ONLINE.online.via_rate, (0.0, 0.5, 2.0)),
    ),
    Choice("N_max", _values("n_via", ONLINE.online.n_via, (3, 8))),
    Choice(
        f"population at {STEP_EVALUATIONS} evaluations per step",
        {
            str(size): {}
            if size == ONLINE.online.search.population
            else {"population": size, "iterations": STEP_EVALUATIONS // size}
            for size in (10, 25, 50, 125)
        },
    ),
)

RESERVES = Choice("time kept free before a deadline", _values("reserve", SEARCH.reserve, ("last", "none")))


def search_config(changes: dict[str, Any]) -> VpstoConfig:
    """The default search with some options changed."""
    return dataclasses.replace(SEARCH, **changes)


def online_config(changes: dict[str, Any]) -> JointSpaceMpcConfig:
    """The default replanning with some options changed, of itself or of its search."""
    of_search = {field.name for field in dataclasses.fields(VpstoConfig)}
    inner = {name: value for name, value in changes.items() if name in of_search}
    outer = {name: value for name, value in changes.items() if name not in of_search}
    search = dataclasses.replace(ONLINE.online.search, **inner)
    return dataclasses.replace(ONLINE, online=dataclasses.replace(ONLINE.online, search=search, **outer))
