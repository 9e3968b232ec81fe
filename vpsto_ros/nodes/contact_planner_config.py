"""Parameters of the node that says where to touch the object next."""

import dataclasses

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.nodes.lifecycle import NodeConfig
from vpsto_ros.nodes.robots import PUSHING, TASKS, RobotConfig, check_task
from vpsto_ros.nodes.scene import ModelConfig
from vpsto_ros.nodes.table_frame import PlayingSurfaceConfig
from vpsto_ros.planning.belief_space.config import RobustContactPlannerConfig
from vpsto_ros.planning.contact import ContactPlannerConfig
from vpsto_ros.planning.hockey.shooting_config import SETTINGS, ShootingConfig
from vpsto_ros.planning.workspace import Workspace

OWN_SETTING = "own"


@documented
@dataclasses.dataclass(frozen=True)
class ContactPlannerNodeConfig(NodeConfig):
    """Parameters of the contact planner; ``kind`` says whether planner, robust or shooting counts."""

    kind: str = option(
        PUSHING,
        "what is planned for: pushing, with the rod by object_state; robust_pushing, with the tools of any "
        "robot by object_belief; or shooting, with the mallet of an iiwa by the object_state of a puck",
        choices=TASKS,
    )
    rate: float = option(20.0, "planning rate", unit="Hz", minimum=0.5, maximum=100.0)
    marker_rate: float = option(10.0, "rate of ~/markers", unit="Hz", minimum=0.1, maximum=50.0)
    goal_orientation: str = option("ignore", "whether the yaw of goal_pose counts", choices=("ignore", "use"))
    tool_frame: str = option(
        "fr3_tool", "child_frame_id of contact_plan for pushing; the mallet and other tools have names"
    )
    input_timeout: float = option(
        0.5, "planning pauses when joint states, object states or beliefs are older", unit="s", minimum=0.02,
        maximum=10.0,
    )  # fmt: skip
    setting: str = option(
        "conservative",
        "what is wanted of shots: to score, to score fast, or to be fast; own takes shooting.objective.*",
        choices=(*SETTINGS, OWN_SETTING),
    )
    policy: bool = option(
        False, "whether the trained policy of the setting gives the angles of shots instead of direct search"
    )
    puck_model: str = option("", "file with the learned model of the puck; empty takes the package's")
    robot: RobotConfig = dataclasses.field(default_factory=RobotConfig)
    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    workspace: Workspace = dataclasses.field(default_factory=Workspace)
    planner: ContactPlannerConfig = dataclasses.field(default_factory=ContactPlannerConfig)
    robust: RobustContactPlannerConfig = dataclasses.field(default_factory=RobustContactPlannerConfig)
    shooting: ShootingConfig = dataclasses.field(default_factory=ShootingConfig)
    hockey: PlayingSurfaceConfig = dataclasses.field(default_factory=PlayingSurfaceConfig)

    def __post_init__(self) -> None:
        validate(self)
        check_task(self.kind, self.robot, self.goal_orientation)
        if self.setting != OWN_SETTING and self.shooting.objective != ShootingConfig().objective:
            raise ConfigurationError(
                f"shooting.objective is set, but setting = {self.setting} has an objective of its own; "
                f"it counts with setting = {OWN_SETTING}"
            )
        if self.policy and self.setting == OWN_SETTING:
            raise ConfigurationError(
                f"policy = True needs a setting that a policy was trained for: {', '.join(SETTINGS)}"
            )
