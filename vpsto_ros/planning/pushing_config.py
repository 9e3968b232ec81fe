"""Options of the pushing planner."""

import dataclasses

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.planning.mpc import OnlineConfig
from vpsto_ros.planning.workspace import Workspace


@documented
@dataclasses.dataclass(frozen=True)
class PushingCosts:
    """Weights and limits of the pushing objective."""

    error: float = option(
        60.0, "seconds that one metre of remaining error is worth", unit="s/m", minimum=0.0, maximum=1e4
    )
    rotation: float = option(
        0.5,
        "seconds that one radian of rotation is worth if the goal has no orientation",
        unit="s/rad",
        minimum=0.0,
        maximum=1e3,
    )
    smoothness: float = option(
        0.0, "weight of the squared acceleration, per limit squared and second", minimum=0.0, maximum=1e3
    )
    horizon: float = option(
        6.0, "longest trajectory that counts as valid", unit="s", minimum=0.5, maximum=60.0
    )
    minimum_gain: float = option(
        0.0005,
        "smallest reduction of the error that makes a candidate valid",
        unit="m",
        minimum=0.0,
        maximum=1.0,
    )
    regress: float = option(
        2.0, "how much more an increase of the error on the way costs than error at the end",
        minimum=0.0, maximum=100.0,
    )  # fmt: skip
    pressure_spread: float = option(
        0.0,
        "relative spread of the pressure radius in the three models over which costs are averaged",
        minimum=0.0,
        maximum=0.9,
    )
    friction_spread: float = option(
        0.0,
        "relative spread of the tool's friction in those models; both 0: one model",
        minimum=0.0,
        maximum=1.0,
    )
    samples: int = option(64, "samples along a trajectory", minimum=8, maximum=1000)
    end_point: str = option(
        "free",
        "where trajectories end: free, or at the object's centre as in the thesis",
        choices=("free", "object"),
    )

    def __post_init__(self) -> None:
        validate(self)


@documented
@dataclasses.dataclass(frozen=True)
class PushingMpcConfig:
    """Options of the pushing planner."""

    lead: float = option(
        0.05,
        "time between the start of planning and the moment the plan takes over",
        unit="s",
        minimum=0.005,
        maximum=1.0,
    )
    speed: float = option(0.35, "largest tool speed in x and in y", unit="m/s", minimum=0.01, maximum=2.0)
    acceleration: float = option(
        1.8, "largest tool acceleration in x and in y", unit="m/s^2", minimum=0.05, maximum=20.0
    )
    tool_height: float = option(
        0.02, "height of the tool's tip above the table", unit="m", minimum=0.002, maximum=0.5
    )
    hold_distance: float = option(
        0.002, "the goal counts as reached, and the arm rests, within", unit="m", minimum=1e-4, maximum=0.5
    )
    resume_distance: float = option(
        0.004,
        "a resting arm resumes when the object is farther off than",
        unit="m",
        minimum=1e-4,
        maximum=0.5,
    )
    seeds: int = option(
        3, "straight pushes from different sides offered as first guesses", minimum=1, maximum=32
    )
    contacts: int = option(24, "touch points tried along the outline for those", minimum=8, maximum=400)
    seed_separation: float = option(
        0.03, "distance between the touch points of those", unit="m", minimum=0.0, maximum=1.0
    )
    joint_tolerance: float = option(
        0.06,
        "the plan is begun anew when a joint is farther from its reference",
        unit="rad",
        minimum=1e-3,
        maximum=1.0,
    )
    object_timeout: float = option(
        0.5, "the arm stops when the object's state is older", unit="s", minimum=0.02, maximum=10.0
    )
    costs: PushingCosts = dataclasses.field(default_factory=PushingCosts)
    workspace: Workspace = dataclasses.field(default_factory=Workspace)
    online: OnlineConfig = dataclasses.field(default_factory=OnlineConfig)

    def __post_init__(self) -> None:
        validate(self)
        if self.resume_distance < self.hold_distance:
            raise ConfigurationError(
                f"resume_distance = {self.resume_distance} is below hold_distance = {self.hold_distance}"
            )
