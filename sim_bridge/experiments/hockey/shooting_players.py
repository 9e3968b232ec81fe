"""Who shoots in the experiment: the agent with each of its settings, and planners without chances."""

import dataclasses
import functools

import numpy as np
from numpy.typing import NDArray

from sim_bridge.hockey.recordings import TABLE
from vpsto_ros.contact.linear_gaussian import LinearGaussian
from vpsto_ros.contact.puck import SHIPPED, PuckModel, ShotOutlook
from vpsto_ros.planning.hockey.agent import HockeyAgent, HockeyAgentConfig
from vpsto_ros.planning.hockey.shooting import ShootingPlanner
from vpsto_ros.planning.hockey.shooting_config import SETTINGS, ShootingConfig, ShootingObjective
from vpsto_ros.planning.hockey.strikes import StrikeTable

_CERTAIN = 1e-12  # variance of a model that is sure [m²/s²]


@dataclasses.dataclass(frozen=True)
class Middle(ShootingObjective):
    """Straight at the middle of the goal, as planners do that know only where the puck is expected.

    By way of a rim only where nothing else is possible.
    """

    def values(self, outlook: ShotOutlook) -> NDArray[np.float64]:
        """1 in the middle of the goal, 0 at its posts, less 2 for shots that meet rims, shape (B,)."""
        off = np.nan_to_num(np.abs(outlook.offset[:, 0]), nan=np.inf) / (0.5 * TABLE.goal_width)
        return 1.0 - off - 2.0 * (outlook.banks > 0)

    def allowed(self, outlook: ShotOutlook) -> NDArray[np.bool_]:
        """Shots (B,) that meet no rim and are expected in the goal."""
        return super().allowed(outlook) & (outlook.banks == 0)


OBJECTIVES: dict[str, ShootingObjective] = {
    **SETTINGS,
    "aggressive_thesis": dataclasses.replace(SETTINGS["aggressive"], beta=0.5),
    "forced_bank": dataclasses.replace(SETTINGS["aggressive"], least_banks=1),
    "moving": SETTINGS["conservative"],
}
"""What the agent wants in each of its settings."""
BASELINES: dict[str, ShootingObjective] = {
    "baseline": Middle(),
    "baseline_fastest": ShootingObjective(0.0, 1.0, 0.5),
}
"""Of planners that take the expected way of the puck for certain.

"baseline": straight at the middle of the goal at full speed and soon, as conventional planners do.
"baseline_fastest": whatever is expected to get in fastest, banks and posts included: what is left of the
aggressive setting without its chance constraint.
"""
PLAYERS = (*OBJECTIVES, *BASELINES)


@functools.cache
def puck_model() -> PuckModel:
    """The model that comes with the package."""
    return PuckModel.load(SHIPPED)


@functools.cache
def strike_table() -> StrikeTable:
    """The strikes that come with the package."""
    return StrikeTable.load()


def certain(model: PuckModel) -> PuckModel:
    """The same expectations without any scatter, and without lively bounces."""
    floating, wall, mallet = _certain(model.floating), _certain(model.wall), _certain(model.mallet)
    return dataclasses.replace(
        model, floating=floating, wall=wall, mallet=mallet, lively=None, lively_share=0.0
    )


def _certain(mode: LinearGaussian) -> LinearGaussian:
    return LinearGaussian(mode.matrix, mode.offset, _CERTAIN * np.eye(len(mode.offset)))


def config(name: str) -> ShootingConfig:
    """Options of the planner of a player.

    For a planner that is certain, a chance above 0.5 says no more than that the expected way is in the goal:
    all that is uncertain to it is what the filter does not know of the puck.
    """
    if name in OBJECTIVES:
        return ShootingConfig(objective=OBJECTIVES[name])
    return ShootingConfig(objective=BASELINES[name], aim_std=0.0, speed_std=0.0, lower_speed=1.0)


def player(name: str, seed: int) -> HockeyAgent:
    """The agent, ready to play; filter, strikes, MPC and the model of the mallet's swing are common to all.

    Only the planner of a baseline is certain; its filter is not.
    """
    agent = HockeyAgent(
        HockeyAgentConfig(shooting=config(name)), model=puck_model(), strikes=strike_table(), seed=seed
    )
    if name in BASELINES:
        agent.planner = ShootingPlanner(certain(puck_model()), strike_table(), config(name))
    return agent
