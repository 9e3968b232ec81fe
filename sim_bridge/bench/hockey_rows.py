"""Rows of contact planning at the air-hockey table: a step of the planner, a contact time, the policy.

They count the processor time of their one thread, as the rows of planning in belief space do.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import partial

import numpy as np

from sim_bridge.bench.belief_rows import processor_time
from sim_bridge.bench.measuring import Action, Cores, Row, at_most
from vpsto_ros.contact.puck import SHIPPED, PuckModel
from vpsto_ros.estimation.puck_filter import PuckState
from vpsto_ros.planning.hockey.shooting import SETTINGS, ShootingConfig, ShootingPlanner
from vpsto_ros.planning.hockey.shooting_policy import ShootingPolicy
from vpsto_ros.planning.hockey.shooting_search import ShotSearch
from vpsto_ros.planning.hockey.shooting_training import TrainingConfig, states
from vpsto_ros.planning.hockey.strikes import StrikeTable

PERIOD, SHOT_TIME = 0.02, 1.6
"""Of the planner [s]; how long a puck lies or rolls about before the next one comes."""
_NOISE = np.array([7e-4, 7e-4, 5e-3, 5e-3])  # of estimates [m, m/s]


def planning(policy: bool, _cores: Cores) -> Action:
    """A step of the planner: pucks that lie still or roll, with noise, until they would have been shot."""
    model, strikes = PuckModel.load(SHIPPED), StrikeTable.load()
    config = ShootingConfig(objective=SETTINGS["balanced"])
    trained = ShootingPolicy.load("balanced", model, strikes) if policy else None
    planner = ShootingPlanner(model, strikes, config, trained)
    home, rng = np.array(strikes.rules.home), np.random.default_rng(0)
    pucks = states(planner.search, 200, 0.5, rng)

    def steps() -> Iterator[None]:
        for puck in itertools.cycle(pucks):
            planner.forget()
            times = np.arange(0.0, SHOT_TIME, PERIOD)
            course, _ = model.predict(puck, 1e-9 * np.eye(4), times)
            for time, mean in zip(times, course + _NOISE * rng.standard_normal((len(times), 4)), strict=True):
                planner.plan(float(time), PuckState(float(time), mean, np.diag(_NOISE**2), 0, ""), home)
                yield

    return processor_time(steps().__next__)


def contact_time(_cores: Cores) -> Action:
    """Direct search of angle and speed at one contact time."""
    search = _search("aggressive")
    config = TrainingConfig()
    pucks = itertools.cycle(states(search, 200, config.fastest, np.random.default_rng(0)))

    def find() -> None:
        search.best(0.0, next(pucks), config.covariance)

    return processor_time(find)


def policy_step(_cores: Cores) -> Action:
    """A step of Algorithm 2, 25 of them from uniform samples for each puck."""
    policy = ShootingPolicy.load("aggressive", PuckModel.load(SHIPPED), StrikeTable.load())
    rng = np.random.default_rng(0)
    pucks = states(_search("aggressive"), 200, TrainingConfig().fastest, rng)

    def steps() -> Iterator[None]:
        for puck in itertools.cycle(pucks):
            samples = None
            for _ in range(25):
                _, samples = policy.infer(puck, samples, rng)
                yield

    return processor_time(steps().__next__)


def _search(setting: str) -> ShotSearch:
    return ShotSearch(
        PuckModel.load(SHIPPED), StrikeTable.load(), ShootingConfig(objective=SETTINGS[setting])
    )


ROWS = (
    Row(
        "shot_planning_step", partial(planning, False), calls=2400, own_times=True,
        wanted=at_most(3.0, "p99_ms"),
    ),
    Row(
        "shot_planning_step_policy", partial(planning, True), calls=2400, own_times=True,
        wanted=at_most(3.0, "p99_ms"),
    ),
    Row("shot_search_contact_time", contact_time, own_times=True, wanted=at_most(1.0)),
    Row("shooting_policy_step", policy_step, own_times=True, wanted=at_most(1.0)),
)  # fmt: skip
