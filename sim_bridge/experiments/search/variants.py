"""Which options are compared, and with which values: one at a time, round the setting in use."""

import dataclasses
from typing import Any

from sim_bridge.experiments.clutter import clutter_2d, clutter_2d_mpc
from sim_bridge.experiments.timing import via_points
from vpsto_ros.optimization.cma import STRATEGIES
from vpsto_ros.optimization.costs import CostWeights
from vpsto_ros.optimization.vpsto import VpstoConfig
from vpsto_ros.planning.joint_space import JointSpaceMpcConfig
from vpsto_ros.planning.mpc import OnlineConfig
from vpsto_ros.planning.reaching import ReachConfig

SEARCH = VpstoConfig()
"""The default of a single search; the number of iterations follows from the budget."""

TIME_OPTIMAL, TIME_OPTIMAL_LONG = (case.config for case in via_points.cases()[1])
"""What via_points searches with; iterations and tolerance give way to the budget."""

ONLINE = clutter_2d_mpc.VPSTO
"""The setting of clutter_2d_mpc."""

REACH = ReachConfig()
"""The default when reaching."""

SHORT = ("clutter", "arm", "line", "walls")
ALL = ("clutter", "clutter_long", "arm", "line", "walls")
WORLDS = ("standing", "moving")
CONVERGED = {"restart": "converged", "restarts": 100, "tolerance": 1e-3, "patience": 8}
STEP_EVALUATIONS = ONLINE.online.search.population * ONLINE.online.search.iterations
ROUND_EVALUATIONS = REACH.search.population * REACH.search.starts * REACH.search.iterations


@dataclasses.dataclass(frozen=True)
class Choice:
    """One option and the values it is given.

    Attributes:
        name: of the option, in words.
        values: what differs from the setting in use, by the name of the value; the value in use included,
            with nothing that differs.
        problems: names of the problems it is compared on.
        base: the setting in use: the default, or that of an experiment.
        used_by: whose setting it is.
    """

    name: str
    values: dict[str, dict[str, Any]]
    problems: tuple[str, ...]
    base: VpstoConfig | JointSpaceMpcConfig | ReachConfig = SEARCH
    used_by: str = "default"

    @property
    def in_use(self) -> str:
        """The name of the value in use."""
        return next(name for name, changes in self.values.items() if not changes)


def _values(option: str, used: Any, others: tuple[Any, ...]) -> dict[str, dict[str, Any]]:
    values = sorted({used, *others}) if not isinstance(used, str) else [used, *others]
    return {str(value): {} if value == used else {option: value} for value in values}


OFFLINE = (
    Choice("population", _values("population", SEARCH.population, (8, 16, 24, 48, 64, 128)), ALL),
    Choice(
        "covariance adaptation",
        _values("strategy", SEARCH.strategy, tuple(s for s in STRATEGIES if s != SEARCH.strategy)),
        SHORT,
    ),
    Choice("first step size", _values("sigma", SEARCH.sigma, (0.25, 0.5, 2.0)), SHORT),
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
    Choice(
        "wider at a restart",
        _values("restart_widening", SEARCH.restart_widening, (1.0, 4.0)),
        ("clutter", "walls"),
    ),
    Choice(
        "plain setting: covariance adaptation",
        _values("strategy", clutter_2d.PLAIN.strategy, ("sep-cma",)),
        ("clutter_plain",),
        clutter_2d.PLAIN,
        "clutter_2d",
    ),
    Choice(
        "plain setting: spread of the prior [m]",
        _values("spread", clutter_2d.SPREAD, (0.03, 0.2, 0.4)),
        ("clutter_plain",),
        clutter_2d.PLAIN,
        "clutter_2d",
    ),
    Choice(
        "time-optimal: covariance adaptation",
        _values("strategy", TIME_OPTIMAL.strategy, ("sep-cma",)),
        ("line", "arm", "arm_long"),
        TIME_OPTIMAL,
        "via_points",
    ),
    Choice(
        "time-optimal: population, four via-points",
        _values("population", TIME_OPTIMAL.population, (16, 64)),
        ("arm", "line"),
        TIME_OPTIMAL,
        "via_points",
    ),
    Choice(
        "time-optimal: population, nine via-points",
        _values("population", TIME_OPTIMAL_LONG.population, (32, 128)),
        ("arm_long",),
        TIME_OPTIMAL_LONG,
        "via_points",
    ),
)


def _replanning(
    name: str, values: dict[str, dict[str, Any]], problems: tuple[str, ...] = WORLDS
) -> Choice:
    return Choice(name, values, problems, ONLINE, "clutter_2d_mpc")


REPLANNING = (
    _replanning("start from the last plan", {"yes": {}, "no": {"warm_start": False}}),
    _replanning(
        "step size from the last plan", _values("warm_sigma", ONLINE.online.warm_sigma, (0.05, 0.1, 0.5, 1.0))
    ),
    _replanning(
        "via-points per second (0: always N_max)",
        _values("via_rate", ONLINE.online.via_rate, (0.0, 0.5, 2.0)),
    ),
    _replanning("N_max", _values("n_via", ONLINE.online.n_via, (3, 8))),
    _replanning(
        f"population at {STEP_EVALUATIONS} evaluations per step",
        {
            str(size): {}
            if size == ONLINE.online.search.population
            else {"population": size, "iterations": STEP_EVALUATIONS // size}
            for size in (10, 25, 50, 125)
        },
    ),
    _replanning("weight of smoothness", _values("smoothness", ONLINE.weights.smoothness, (0.0, 0.001, 0.1))),
    _replanning("spread of the prior [m]", _values("spread", ONLINE.spread, (0.05, 0.15, 0.3))),
    _replanning(
        "motion clear ahead without a plan [s]",
        _values("lookahead", ONLINE.lookahead, (0.5, 3.0)),
        ("moving",),
    ),
    _replanning("short motions out of danger", _values("escapes", ONLINE.escapes, (1, 128)), ("moving",)),
)


def _reaching(
    name: str, values: dict[str, dict[str, Any]], problems: tuple[str, ...] = ("cells",)
) -> Choice:
    return Choice(name, values, problems, REACH, "reach_clutter")


REACHING = (
    _reaching("guesses per round", _values("guesses", REACH.guesses, (0, 300))),
    _reaching("share of guesses near the line", _values("near", REACH.near, (0.0, 1.0))),
    _reaching("spread of these [rad]", _values("near_spread", REACH.near_spread, (0.3,))),
    _reaching("reaching: spread of the prior [rad]", _values("spread", REACH.spread, (0.3, 1.2))),
    _reaching(
        f"starts at {ROUND_EVALUATIONS} evaluations per round",
        {
            str(starts): {}
            if starts == REACH.search.starts
            else {"starts": starts, "iterations": REACH.search.iterations * REACH.search.starts // starts}
            for starts in (1, 2, 4, 8)
        },
    ),
    _reaching(
        f"reaching: population at {ROUND_EVALUATIONS} evaluations per round",
        {
            str(size): {}
            if size == REACH.search.population
            else {"population": size, "iterations": REACH.search.iterations * REACH.search.population // size}
            for size in (12, 24, 48)
        },
    ),
    _reaching("iterations per round", _values("iterations", REACH.search.iterations, (20, 80))),
    _reaching("reaching: covariance adaptation", _values("strategy", REACH.search.strategy, ("cma",))),
    _reaching("valid rounds", _values("valid_rounds", REACH.valid_rounds, (1, 4)), ("cells_stop",)),
)

RESERVES = Choice(
    "time kept free before a deadline", _values("reserve", SEARCH.reserve, ("last", "none")), ("clutter",)
)


def changed(config: Any, changes: dict[str, Any]) -> Any:
    """A configuration with some options changed, wherever in it they are."""
    own = {field.name for field in dataclasses.fields(config)}
    now = {name: value for name, value in changes.items() if name in own}
    rest = {name: value for name, value in changes.items() if name not in own}
    for name in own:
        inner = getattr(config, name)
        if isinstance(inner, (VpstoConfig, OnlineConfig, CostWeights)):
            of_inner = {key: value for key, value in rest.items() if _belongs(inner, key)}
            rest = {key: value for key, value in rest.items() if key not in of_inner}
            now[name] = changed(inner, of_inner)
    assert not rest, f"{type(config).__name__} has no {', '.join(rest)}"
    return dataclasses.replace(config, **now)


def _belongs(config: Any, name: str) -> bool:
    """Whether an option is one of a configuration or of the search within it."""
    names = {field.name for field in dataclasses.fields(config)}
    return name in names or ("search" in names and _belongs(config.search, name))
