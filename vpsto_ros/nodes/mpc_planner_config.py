"""Parameters of the node that moves the arm, and what they must satisfy together."""

import dataclasses

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.nodes.lifecycle import NodeConfig
from vpsto_ros.nodes.robots import (
    PUSHING,
    ROBUST_PUSHING,
    SHOOTING,
    TASKS,
    BeliefModelConfig,
    RobotConfig,
    check_task,
)
from vpsto_ros.nodes.scene import ModelConfig
from vpsto_ros.nodes.table_frame import PlayingSurfaceConfig
from vpsto_ros.optimization.vpsto import VpstoConfig
from vpsto_ros.planning.belief_space.config import RobustMpcConfig
from vpsto_ros.planning.hockey.strike_mpc_config import StrikeMpcConfig
from vpsto_ros.planning.pushing_config import PushingMpcConfig

TRANSPORT = 0.004
"""What is left at least for the way from here to the controller [s]."""
_CYCLE_SHARE, _LEAD_SHARE = 0.9, 0.7  # of the cycle and of the lead that the automatic deadline takes


@documented
@dataclasses.dataclass(frozen=True)
class MpcPlannerConfig(NodeConfig):
    """Parameters of the planner; ``kind`` says whether ``planner``, ``robust`` or ``strike`` counts."""

    kind: str = option(
        PUSHING,
        "what to do: pushing, with the rod by an estimate of the object (planner.*); robust_pushing, with "
        "the tools of any robot by a belief over the object (robust.*, belief.*); or shooting, with the "
        "mallet of an iiwa as contact_plan says (strike.*, hockey.*)",
        choices=TASKS,
    )
    rate: float = option(20.0, "planning rate", unit="Hz", minimum=1.0, maximum=50.0)
    deadline: float = option(
        0.0,
        "a plan not ready so long after the start of its cycle is dropped; 0 takes the smaller of 0.9 cycles "
        "and 0.7 of the lead (planner.lead, robust.lead or strike.lead)",
        unit="s",
        minimum=0.0,
        maximum=1.0,
    )
    reserve: float = option(
        0.006,
        "part of the deadline that is kept for what follows the search",
        unit="s",
        minimum=0.0,
        maximum=0.5,
    )
    joint_timeout: float = option(
        0.1, "nothing is published when joint_states are older", unit="s", minimum=0.02, maximum=10.0
    )
    contact_timeout: float = option(
        0.0,
        "a contact_plan received longer ago is not used; 0 takes 0.1 s for shooting, where it comes anew in "
        "every cycle, and 0.5 s else",
        unit="s",
        minimum=0.0,
        maximum=10.0,
    )
    goal_orientation: str = option("ignore", "whether the yaw of goal_pose counts", choices=("ignore", "use"))
    marker_rate: float = option(10.0, "rate of ~/markers", unit="Hz", minimum=0.1, maximum=50.0)
    seed: int = option(0, "seed of the search, and of what is drawn for every belief", minimum=0)
    robot: RobotConfig = dataclasses.field(default_factory=RobotConfig)
    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    belief: BeliefModelConfig = dataclasses.field(default_factory=BeliefModelConfig)
    planner: PushingMpcConfig = dataclasses.field(default_factory=PushingMpcConfig)
    robust: RobustMpcConfig = dataclasses.field(default_factory=RobustMpcConfig)
    strike: StrikeMpcConfig = dataclasses.field(default_factory=StrikeMpcConfig)
    hockey: PlayingSurfaceConfig = dataclasses.field(default_factory=PlayingSurfaceConfig)

    def __post_init__(self) -> None:
        validate(self)
        check_task(self.kind, self.robot, self.goal_orientation)
        deadline, latest = self.deadline_in_force, self.lead - TRANSPORT
        name = f"deadline = {deadline:g} s" if self.deadline else f"deadline = 0 (here {deadline:g} s)"
        if deadline > 1.0 / self.rate + 1e-9:
            raise ConfigurationError(
                f"{name} is longer than a cycle of {1.0 / self.rate:g} s (rate = {self.rate:g} Hz); lower "
                "it, or set it to 0 for one that fits"
            )
        if deadline > latest + 1e-9:
            raise ConfigurationError(
                f"{name} is more than {self._lead_name} = {self.lead:g} s less {TRANSPORT:g} s for the "
                "way to the controller, so every plan would come late; lower it, set it to 0 "
                f"or raise {self._lead_name}"
            )
        if self.reserve >= deadline:
            raise ConfigurationError(
                f"reserve = {self.reserve:g} s must be below {name}: nothing would be left for the search "
                f"({self._lead_name} = {self.lead:g} s, rate = {self.rate:g} Hz)"
            )

    @property
    def _group(self) -> str:
        return {PUSHING: "planner", ROBUST_PUSHING: "robust", SHOOTING: "strike"}[self.kind]

    @property
    def lead(self) -> float:
        """Time between the start of planning and the moment a plan takes over [s]."""
        return getattr(self, self._group).lead

    @property
    def contact_timeout_in_force(self) -> float:
        """The timeout of contact_plan as given, or the automatic one [s]."""
        return self.contact_timeout or (0.1 if self.kind == SHOOTING else 0.5)

    @property
    def joint_tolerance(self) -> float:
        """How far a joint may be from its reference [rad]."""
        return getattr(self, self._group).joint_tolerance

    @property
    def searches(self) -> dict[str, VpstoConfig]:
        """Options of the searches that plan, by their names."""
        return {
            PUSHING: {"planner.online.search": self.planner.online.search},
            ROBUST_PUSHING: {"robust.planning.search": self.robust.planning.search},
            SHOOTING: {
                "strike.approach.search": self.strike.approach.search,
                "strike.home.search": self.strike.home.search,
            },
        }[self.kind]

    @property
    def _lead_name(self) -> str:
        return f"{self._group}.lead"

    @property
    def deadline_in_force(self) -> float:
        """The deadline as given, or the automatic one [s]."""
        return self.deadline or min(_CYCLE_SHARE / self.rate, _LEAD_SHARE * self.lead, self.lead - TRANSPORT)
