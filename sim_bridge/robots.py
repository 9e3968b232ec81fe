"""The robots that can be simulated: models, tools, planes, and what MuJoCo has to know beyond the MJCF."""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from vpsto_ros.robot import kinematics as fr3
from vpsto_ros.robot.kinds import ROD_RADIUS, TOOL_KINDS, ToolKind
from vpsto_ros.robot.kinematics import Robot
from vpsto_ros.robot.tool_plane import ToolPlane

# Collision bits, contype and conaffinity. Links have LINK in both. A tool meets links, other tools and the
# table; objects it meets by explicit pairs only.
LINK, ROD, TOOL, CUBE = 1, 4, 8, 16

# Friction and damping of the real joints that is left after the maker's compensation; no controller here
# knows them.
_JOINT_FRICTION = (0.3, 0.3, 0.3, 0.3, 0.15, 0.1, 0.1)  # [Nm]
_JOINT_DAMPING = (0.5, 0.5, 0.5, 0.5, 0.2, 0.1, 0.005)  # [Nm s/rad]


@dataclass(frozen=True)
class Arm:
    """Names in the model that belong to one arm.

    Attributes:
        prefix: of its bodies, joints and its site ``tool_tip``.
        tool: the geom that is meant to touch objects.
        frame: what messages call the tool.
    """

    prefix: str
    tool: str
    frame: str


@dataclass(frozen=True)
class RobotKind:
    """A robot that can be simulated.

    Attributes:
        model_path: its MJCF.
        tools: its model for controllers, and its tools.
        arms: its arms, in the order of the joints.
        nominal: plane point at which the damping of the controller is designed.
        round_tool: whether joint 7 turns a round tool about its own axis.
    """

    model_path: Path
    tools: ToolKind
    arms: tuple[Arm, ...]
    nominal: tuple[float, ...]
    round_tool: bool = False

    def load(self) -> Robot:
        """Its model for controllers."""
        return self.tools.load()

    def plane(self, robot: Robot, height: float) -> ToolPlane:
        """The plane of its tools at a height [m]."""
        return self.tools.plane(robot, height)


def _arms(kind: str, *names: tuple[str, str]) -> tuple[Arm, ...]:
    """Arms from prefixes and tools; messages call the tools as planners do."""
    return tuple(Arm(*pair, frame) for pair, frame in zip(names, TOOL_KINDS[kind].frames, strict=True))


KINDS = {
    "rod": RobotKind(
        fr3.MODEL_PATH, TOOL_KINDS["rod"], _arms("rod", ("", "rod")), (0.5, 0.0), round_tool=True
    ),
    "hand": RobotKind(
        fr3.HAND_MODEL_PATH, TOOL_KINDS["hand"], _arms("hand", ("", "hand")), (0.5, 0.0, 0.0)
    ),
    "two_balls": RobotKind(
        fr3.BIMANUAL_MODEL_PATH,
        TOOL_KINDS["two_balls"],
        _arms("two_balls", ("left_", "left_ball"), ("right_", "right_ball")),
        (0.5, 0.08, 0.5, -0.08),
    ),
}


def robot_spec(kind: RobotKind, friction: float, damping: float) -> mujoco.MjSpec:
    """The robot with torque motors.

    Args:
        kind: which one.
        friction: scale of the joints' dry friction.
        damping: scale of the joints' viscous friction.
    """
    spec, robot = mujoco.MjSpec.from_file(str(kind.model_path)), kind.load()
    dry, viscous = _JOINT_FRICTION * len(kind.arms), _JOINT_DAMPING * len(kind.arms)
    for name, limit, loss, drag in zip(robot.joint_names, robot.torque_limits, dry, viscous, strict=True):
        joint = spec.joint(name)
        joint.frictionloss = loss * friction
        joint.damping = np.array([drag * damping, 0.0, 0.0])
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        motor.ctrlrange = [-limit, limit]
    if kind.round_tool:
        _add_rod(spec)
    return spec


def _add_rod(spec: mujoco.MjSpec) -> None:
    # A capsule meets boxes in MuJoCo's exact, fast routine; above its round end (1.5 cm) it is the rod.
    spec.body("tool").add_geom(
        name="rod",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[0, 0, 0.05, 0, 0, fr3.TOOL_LENGTH - ROD_RADIUS],
        size=[ROD_RADIUS, 0, 0],
        mass=0.0,
        group=3,
        contype=ROD,
        conaffinity=0,
    )
