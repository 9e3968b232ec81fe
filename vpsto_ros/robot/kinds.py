"""The robots that are known by name: an arm with a rod, an arm with a hand, two arms with balls."""

import dataclasses
from collections.abc import Callable

from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.robot.bimanual_plane import BimanualPlane
from vpsto_ros.robot.hand_plane import HandPlane
from vpsto_ros.robot.inverse_kinematics import TableMap
from vpsto_ros.robot.kinematics import Robot, fr3_bimanual, fr3_hand_pusher, fr3_pusher
from vpsto_ros.robot.tip_kinematics import BALL_RADIUS, HAND_HALF_SIZE
from vpsto_ros.robot.tool_plane import ToolPlane

ROD_RADIUS = 0.015  # [m]


@dataclasses.dataclass(frozen=True)
class ToolKind:
    """A robot and what it touches with.

    Attributes:
        load: its model.
        plane: the plane of its tools at a height [m].
        height: at which its tools usually are above the table [m].
        effectors: its tools seen from above.
        frames: what messages call the tools, in the order of their plane coordinates.
        two_arms: whether each of two tools is on an arm of its own.
    """

    load: Callable[[], Robot]
    plane: Callable[[Robot, float], ToolPlane]
    height: float
    effectors: EndEffectors
    frames: tuple[str, ...]
    two_arms: bool = False


TOOL_KINDS = {
    "rod": ToolKind(fr3_pusher, TableMap, 0.02, EndEffectors.discs(ROD_RADIUS), ("fr3_tool",)),
    "hand": ToolKind(
        fr3_hand_pusher, HandPlane, 0.05,
        EndEffectors.rectangle(2.0 * HAND_HALF_SIZE[0], 2.0 * HAND_HALF_SIZE[1]), ("fr3_tool",),
    ),
    "two_balls": ToolKind(
        fr3_bimanual, BimanualPlane, 0.035, EndEffectors.discs(BALL_RADIUS, 2),
        ("left_fr3_tool", "right_fr3_tool"), two_arms=True,
    ),
}  # fmt: skip
