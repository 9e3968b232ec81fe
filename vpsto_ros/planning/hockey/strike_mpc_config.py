"""Options of the MPC that drives the mallet."""

import dataclasses

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.optimization.vpsto import VpstoConfig
from vpsto_ros.planning.mpc import OnlineConfig
from vpsto_ros.robot.mallet_tilt import MalletTilt


@documented
@dataclasses.dataclass(frozen=True)
class StrikeMpcConfig:
    """Options of the planner.

    Raises:
        ConfigurationError: a value is out of range; the message names what is allowed.
    """

    lead: float = option(
        0.02, "time from the start of planning to the moment a plan takes over", unit="s", minimum=0.0,
        maximum=0.2,
    )  # fmt: skip
    longest: float = option(
        1.6, "a motion into a touch begins at most so long before it", unit="s", minimum=0.2, maximum=5.0
    )
    least: float = option(
        0.04, "so shortly before the touch the motion is not planned anew", unit="s", minimum=0.0, maximum=0.5
    )
    final: float = option(
        0.1, "so shortly before the touch the motion is not called off", unit="s", minimum=0.0, maximum=1.0
    )
    enter_share: float = option(
        0.15, "share of the planned velocity limits at which the arm moves outside the plane of play",
        minimum=0.01, maximum=1.0,
    )  # fmt: skip
    joint_tolerance: float = option(
        0.1, "how far a joint may be from its reference before the arm counts as lost", unit="rad",
        minimum=1e-3, maximum=1.0,
    )  # fmt: skip
    middle: float = option(
        0.009, "when in a contact the mallet is to move as asked for: it swings on meanwhile", unit="s",
        minimum=0.0, maximum=0.05,
    )  # fmt: skip
    slower: float = option(
        0.1, "share by which the mallet may be slower at the touch than asked for", minimum=0.0, maximum=0.9
    )
    tilt: MalletTilt = dataclasses.field(default_factory=MalletTilt)
    first_rounds: int = option(
        2, "how often a new motion is planned with the swing of the mallet that the one before makes",
        minimum=1, maximum=10,
    )  # fmt: skip
    approach: OnlineConfig = dataclasses.field(
        default_factory=lambda: OnlineConfig(
            n_via=4, via_rate=5.0, stop_duration=0.18, warm_sigma=0.2,
            search=VpstoConfig(population=16, iterations=4),
        )
    )  # fmt: skip
    home: OnlineConfig = dataclasses.field(
        default_factory=lambda: OnlineConfig(
            n_via=3, stop_duration=0.0, warm_sigma=0.2, search=VpstoConfig(population=12, iterations=2)
        )
    )
    attempts: int = option(
        4, "cycles in which a motion into a new contact is searched before it is refused", minimum=1,
        maximum=100,
    )  # fmt: skip
    first_iterations: int = option(
        8, "iterations of a search that has nothing to start from", minimum=1, maximum=1000
    )

    def __post_init__(self) -> None:
        validate(self)
