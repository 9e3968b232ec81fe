"""What a shot is, what is wanted of it (5.12), and the options of planning one."""

import dataclasses
import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.contact.puck import ShotOutlook
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.planning.hockey.touch import SAME_TIME

_MISSING = 2.0  # price of a missing chance, in units of the objective


class Strikes(Protocol):
    """What the arm can do: largest speeds (5.13) of the mallet along its motion, and the time they need."""

    @property
    def center(self) -> NDArray[np.float64]:
        """Where the table's centre is, in the robot's base frame, shape (2,) [m]."""

    @property
    def x(self) -> NDArray[np.float64]:
        """Uniform grid of the puck's place at the touch, table frame [m]."""

    @property
    def y(self) -> NDArray[np.float64]:
        """Likewise."""

    @property
    def angle(self) -> NDArray[np.float64]:
        """Uniform grid of the direction of the mallet's velocity, from +x [rad]."""

    @property
    def contact_distance(self) -> float:
        """Between the centres of puck and mallet when they touch [m]."""

    def speeds(self, puck: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
        """Largest speeds (B,) [m/s] at places of the puck (B, 2) in directions (B,); 0 where none is."""

    def timely_speeds(
        self, joints: NDArray[np.float64], puck: NDArray[np.float64], angles: NDArray[np.float64],
        available: NDArray[np.float64],
    ) -> NDArray[np.float64]:  # fmt: skip
        """Largest speeds (B,) [m/s] that can be had from a posture at rest (7,) in the times (B,) [s]."""


def middle_strike(strikes: Strikes) -> tuple[NDArray[np.float64], float]:
    """A strike straight ahead as near to the middle of the grid as there is one.

    Returns:
        The puck's place, table frame, shape (2,) [m]; the largest speed of the mallet there [m/s].

    Raises:
        ConfigurationError: the arm can strike straight ahead nowhere.
    """
    places = np.stack(np.meshgrid(strikes.x, strikes.y, indexing="ij"), axis=-1).reshape(-1, 2)
    speeds = strikes.speeds(places, np.zeros(len(places)))
    if not speeds.any():
        raise ConfigurationError("strikes: there is none straight ahead")
    away = np.linalg.norm(places - places.mean(axis=0), axis=1)
    best = int(np.argmin(np.where(speeds > 0.0, away, np.inf)))
    return places[best], float(speeds[best])


@documented
@dataclasses.dataclass(frozen=True)
class ShootingObjective:
    """The trade between scoring and speed, and the chance constraint, (5.12)."""

    lambda1: float = option(1.0, "weight of the probability of scoring", minimum=0.0, maximum=1e3)
    lambda2: float = option(
        0.0, "weight of the expected speed at the goal line", unit="s/m", minimum=0.0, maximum=1e3
    )
    beta: float = option(0.5, "probability of scoring that a shot must exceed", minimum=0.0, maximum=0.999)
    least_banks: int = option(0, "walls that the puck must meet on its way", minimum=0, maximum=10)

    def __post_init__(self) -> None:
        validate(self)
        if self.lambda1 == self.lambda2 == 0.0:
            raise ConfigurationError("ShootingObjective: lambda1 and lambda2 are both 0; nothing is wanted")

    def values(self, outlook: ShotOutlook) -> NDArray[np.float64]:
        """What (5.12) maximises, shape (B,); 0 for shots that do not come to the goal line."""
        return self.lambda1 * outlook.goal + self.lambda2 * np.nan_to_num(outlook.speed)

    def allowed(self, outlook: ShotOutlook) -> NDArray[np.bool_]:
        """Which shots (B,) keep the chance constraint and meet walls enough."""
        return (outlook.goal > self.beta) & (outlook.banks >= self.least_banks)

    def promise(self, outlook: ShotOutlook) -> NDArray[np.float64]:
        """Values (B,) less what is missing of the constraints: how much better an angle nearby may be.

        Between two angles of a grid that both miss the threshold there may be one that exceeds it.
        """
        missing = np.maximum(self.beta - outlook.goal, 0.0)
        few = outlook.banks < self.least_banks
        return self.values(outlook) - _MISSING * (self.lambda1 + self.lambda2) * missing - 10.0 * few

    def scores(self, outlook: ShotOutlook) -> NDArray[np.float64]:
        """Values (B,) of allowed shots; the others rank below all of these, by their chance to score.

        Of those that are not allowed, the ones that meet too few walls come last.
        """
        few = outlook.banks < self.least_banks
        return np.where(self.allowed(outlook), self.values(outlook), outlook.goal - 10.0 - 10.0 * few)


SETTINGS: dict[str, ShootingObjective] = {
    "conservative": ShootingObjective(1.0, 0.0, 0.5),
    "balanced": ShootingObjective(1.0, 0.2, 0.5),
    "aggressive": ShootingObjective(0.0, 1.0, 0.7),
}
"""The three of the thesis's experiments, 5.4.2.

Deviation: the aggressive one of the thesis has beta = 0.5. It takes whatever is fast and just likely enough,
so that with chances that hold it scores about two times in three (the thesis: 0.61).
"""


@dataclasses.dataclass(frozen=True, eq=False)
class Shot:
    """When, where and how the mallet touches the puck.

    Attributes:
        time: of the touch [s].
        puck: expected state (x, y, vx, vy) just before it, table frame, shape (4,) [m, m/s].
        angle: of the mallet's velocity from +x, towards +y [rad]; its centre is behind the puck along it.
        speed: of the mallet [m/s].
        goal: probability of scoring.
        goal_speed: expected speed of the puck at the goal line [m/s].
        banks: walls that it is expected to meet on the way.
        value: objective (5.12).
        contact_distance: between the centres of puck and mallet [m].
    """

    time: float
    puck: NDArray[np.float64]
    angle: float
    speed: float
    goal: float
    goal_speed: float
    banks: int
    value: float
    contact_distance: float

    @property
    def mallet(self) -> NDArray[np.float64]:
        """State of the mallet's centre at the touch, table frame, shape (4,) [m, m/s]."""
        direction = np.array([math.cos(self.angle), math.sin(self.angle)])
        return np.concatenate([self.puck[:2] - self.contact_distance * direction, self.speed * direction])


@documented
@dataclasses.dataclass(frozen=True)
class ShootingConfig:
    """Options of planning shots.

    Attributes:
        objective: what is wanted.

    Raises:
        ConfigurationError: a value is out of range; the message names what is allowed.
    """

    objective: ShootingObjective = SETTINGS["conservative"]
    fallback: bool = option(False, "take the likeliest shot where none keeps the chance constraint")
    angles: int = option(65, "directions of the grid that is searched", minimum=3, maximum=1000)
    refinements: int = option(
        9, "directions that are tried around a good one of the grid, as far as its neighbours", minimum=1,
        maximum=101,
    )  # fmt: skip
    peaks: int = option(3, "how many good directions of a search are refined", minimum=1, maximum=20)
    lower_speed: float = option(
        0.7, "share of the largest speed that is tried, too, around good directions; 1 tries no other",
        minimum=0.1, maximum=1.0,
    )  # fmt: skip
    aim_std: float = option(
        0.0015, "standard deviation of the mallet's place across its motion", unit="m", minimum=0.0,
        maximum=0.05,
    )  # fmt: skip
    speed_std: float = option(
        0.05, "standard deviation of the mallet's speed", unit="m/s", minimum=0.0, maximum=1.0
    )
    time_step: float = option(
        0.05, f"between contact times, more than {SAME_TIME:g}: at less they are one", unit="s",
        minimum=0.005, maximum=1.0,
    )  # fmt: skip
    latest: float = option(2.5, "how far ahead the last contact time is", unit="s", minimum=0.1, maximum=10.0)
    times_per_step: int = option(
        8, "contact times that a step of the planner searches; a round takes several steps", minimum=1,
        maximum=1000,
    )  # fmt: skip
    policy_times_per_step: int = option(
        2, "the same where a policy is used", minimum=1, maximum=1000
    )
    lead_margin: float = option(
        0.1, "time that the arm has beyond what it needs at least", unit="s", minimum=0.0, maximum=2.0
    )
    delay_price: float = option(
        0.05, "objective that a later contact time must gain", unit="1/s", minimum=0.0, maximum=10.0
    )
    slack_price: float = option(
        1.0, "objective that a shot must gain which is slower than (5.13) allows, for all of its speed",
        minimum=0.0, maximum=10.0,
    )  # fmt: skip
    same_place: float = option(
        0.01, "a puck that has moved less is searched for only once", unit="m", minimum=0.0, maximum=0.1
    )
    room: float = option(
        0.003, "between the mallet's rim and a wall", unit="m", minimum=0.0, maximum=0.2
    )
    run_up: float = option(
        0.0, "free way of the mallet behind its place at the touch", unit="m", minimum=0.0, maximum=0.5
    )
    largest_std: float = option(
        0.03, "standard deviation of the puck's place beyond which it is not struck at", unit="m",
        minimum=1e-3, maximum=1.0,
    )  # fmt: skip
    clear_gain: float = option(
        0.1, "objective that another shot must gain to replace the chosen one", minimum=0.0, maximum=10.0
    )
    angle_gain: float = option(
        0.01, "objective that another angle of the chosen shot must gain", minimum=0.0, maximum=10.0
    )
    angle_step: float = option(
        0.04, "how far the chosen angle may turn in a step", unit="rad", minimum=0.0, maximum=0.5
    )
    tolerance: float = option(
        0.1, "probability below beta at which a chosen shot is dropped", minimum=0.0, maximum=1.0
    )
    frozen: float = option(
        0.25, "time before the touch in which the shot only follows the puck", unit="s", minimum=0.0,
        maximum=2.0,
    )  # fmt: skip
    pause: float = option(
        0.1, "time after a touch before another shot is planned: the mallet goes on through it", unit="s",
        minimum=0.0, maximum=2.0,
    )  # fmt: skip
    largest_jump: float = option(
        0.05, "of the place of the touch from step to step, beyond which the shot is dropped", unit="m",
        minimum=1e-3, maximum=1.0,
    )  # fmt: skip
    oldest: float = option(
        0.5, "age of the puck's state beyond which it is of no use", unit="s", minimum=0.0, maximum=10.0
    )
    policy_steps: int = option(
        10, "steps of Algorithm 2 for a contact time, where a policy is used", minimum=1, maximum=200
    )

    def __post_init__(self) -> None:
        validate(self)
        if self.time_step <= SAME_TIME:
            raise ConfigurationError(
                f"ShootingConfig.time_step = {self.time_step!r} is not allowed; expected more than"
                f" {SAME_TIME:g} s, within which contacts count as the same"
            )
