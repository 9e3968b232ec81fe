"""Parameters of the node that says where to touch the object next."""

import dataclasses

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.nodes.lifecycle import NodeConfig
from vpsto_ros.nodes.robots import PUSHING, TASKS, RobotConfig, check_task
from vpsto_ros.nodes.scene import ModelConfig
from vpsto_ros.planning.belief_space.config import RobustContactPlannerConfig
from vpsto_ros.planning.contact import ContactPlannerConfig
from vpsto_ros.planning.workspace import Workspace


@documented
@dataclasses.dataclass(frozen=True)
class ContactPlannerNodeConfig(NodeConfig):
    """Parameters of the contact planner; ``kind`` says whether ``planner`` or ``robust`` counts."""

    kind: str = option(
        PUSHING,
        "what is planned for: pushing, with the rod by object_state, or robust_pushing, with the tools of "
        "any robot by object_belief",
        choices=TASKS,
    )
    rate: float = option(20.0, "planning rate", unit="Hz", minimum=0.5, maximum=100.0)
    marker_rate: float = option(10.0, "rate of ~/markers", unit="Hz", minimum=0.1, maximum=50.0)
    goal_orientation: str = option("ignore", "whether the yaw of goal_pose counts", choices=("ignore", "use"))
    tool_frame: str = option(
        "fr3_tool", "child_frame_id of contact_plan for kind = pushing; other robots' tools have names"
    )
    input_timeout: float = option(
        0.5, "planning pauses when joint states, object states or beliefs are older", unit="s", minimum=0.02,
        maximum=10.0,
    )  # fmt: skip
    robot: RobotConfig = dataclasses.field(default_factory=RobotConfig)
    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    workspace: Workspace = dataclasses.field(default_factory=Workspace)
    planner: ContactPlannerConfig = dataclasses.field(default_factory=ContactPlannerConfig)
    robust: RobustContactPlannerConfig = dataclasses.field(default_factory=RobustContactPlannerConfig)

    def __post_init__(self) -> None:
        validate(self)
        check_task(self.kind, self.robot, self.goal_orientation)
