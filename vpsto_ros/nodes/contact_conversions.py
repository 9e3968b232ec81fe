"""Between contact plans of several end effectors and messages: one Odometry for each of them."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from std_msgs.msg import Header

from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.nodes.conversions import (
    TimeBase,
    planar_pose,
    read_planar_covariance,
    read_pose,
    require_frame,
    spread_covariance,
)
from vpsto_ros.planning.belief_space.contact_plan import RobustContactPlan


@dataclasses.dataclass(frozen=True)
class EffectorContact:
    """Where one end effector shall touch.

    Attributes:
        tool: its frame.
        stamp: of the plan that it belongs to [s].
        mean: its plane coordinates: (x, y), with a yaw for a rectangle.
        covariance: of these.
    """

    tool: str
    stamp: float
    mean: NDArray
    covariance: NDArray


def contact_messages(
    plan: RobustContactPlan,
    effectors: EndEffectors,
    tool_frames: Sequence[str],
    time_base: TimeBase,
    frame: str,
) -> list[Odometry]:
    """A contact plan, one message per end effector with its frame as child_frame_id; one stamp for all.

    How the places of two end effectors are correlated has no place in the messages and is lost.
    """
    messages = []
    for tool, columns, pose in zip(tool_frames, _columns(effectors), effectors.poses(plan.mean), strict=True):
        message = Odometry(header=Header(stamp=time_base.stamp(plan.stamp), frame_id=frame))
        message.child_frame_id = tool
        message.pose.pose = planar_pose(pose)
        covariance, size = np.zeros((3, 3)), len(columns)
        covariance[:size, :size] = plan.covariance[np.ix_(columns, columns)]
        message.pose.covariance = spread_covariance(covariance)
        message.twist.twist.linear.x, message.twist.twist.linear.y = map(float, plan.velocity)
        messages.append(message)
    return messages


def read_effector_contact(
    message: Odometry, time_base: TimeBase, frame: str, effectors: EndEffectors, tool_frames: Sequence[str]
) -> EffectorContact:
    """Where one of a robot's end effectors shall touch.

    Raises:
        InvalidInputError: wrong frame, an end effector that the robot does not have, broken numbers, or a
            covariance that is not positive definite.
    """
    require_frame(message.header, frame)
    tool = message.child_frame_id
    if tool not in tool_frames:
        names = ", ".join(map(repr, tool_frames))
        raise InvalidInputError(f"no end effector {tool!r} (child_frame_id); this robot has {names}")
    size = len(_columns(effectors)[tool_frames.index(tool)])
    mean = read_pose(message.pose.pose).pose[:size]
    given = read_planar_covariance(message.pose.covariance)[:size, :size]
    covariance = 0.5 * (given + given.T)  # what rounding leaves of asymmetry would stop the planner
    if not np.allclose(given, covariance) or np.linalg.eigvalsh(covariance).min() <= 0.0:
        raise InvalidInputError(f"the covariance of {tool!r} is not positive definite")
    return EffectorContact(tool, time_base.seconds(message.header.stamp), mean, covariance)


def gather_contacts(
    plans: Mapping[str, EffectorContact], effectors: EndEffectors, tool_frames: Sequence[str]
) -> tuple[NDArray, NDArray] | None:
    """Mean (m,) and covariance (m, m) of all plane coordinates; None unless all are of one plan.

    Which end effector goes where is decided for all together: half of one plan and half of another could
    send both to the same place.
    """
    if len({plan.stamp for plan in plans.values()}) != 1 or not all(tool in plans for tool in tool_frames):
        return None
    mean, covariance = np.zeros(effectors.dof), np.zeros((effectors.dof, effectors.dof))
    for tool, columns in zip(tool_frames, _columns(effectors), strict=True):
        mean[columns] = plans[tool].mean
        covariance[np.ix_(columns, columns)] = plans[tool].covariance
    return mean, covariance


def _columns(effectors: EndEffectors) -> list[NDArray]:
    """Columns of each end effector's plane coordinates."""
    ends = [*effectors.columns[1:], effectors.dof]
    return [np.arange(begin, end) for begin, end in zip(effectors.columns, ends, strict=True)]
