"""What the simulated driver publishes of an air-hockey world."""

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from visualization_msgs.msg import Marker, MarkerArray

from sim_bridge.hockey import table
from sim_bridge.hockey.contact_log import PuckContact
from sim_bridge.hockey.world import AirHockeyWorld, Goal
from vpsto_ros.nodes import markers
from vpsto_ros.nodes.conversions import SIMULATED, planar_pose

MALLET_FRAME = "mallet"
RIM = (0.45, 0.5, 0.56, 1.0)
PUCK = (0.86, 0.16, 0.16, 1.0)
MALLET = (0.13, 0.3, 0.62, 1.0)


def goal_event(goal: Goal, frame: str) -> Odometry:
    """A goal: the puck as it passes the line, in the axes of the base; child_frame_id is far or near."""
    message = Odometry(child_frame_id=goal.end)
    message.header.stamp, message.header.frame_id = SIMULATED.stamp(goal.time), frame
    message.pose.pose = planar_pose(np.append(goal.position, 0.0), table.TABLE_ORIGIN[2])
    message.twist.twist.linear.x, message.twist.twist.linear.y = map(float, goal.velocity)
    return message


def touch_event(contact: PuckContact, frame: str) -> Odometry:
    """A touch of the mallet: where the puck was hit, and how it moves afterwards, in the axes of the base."""
    message = Odometry(child_frame_id=MALLET_FRAME)
    message.header.stamp, message.header.frame_id = SIMULATED.stamp(contact.end), frame
    message.pose.pose = planar_pose(contact.pose, table.TABLE_ORIGIN[2])
    message.twist.twist.linear.x, message.twist.twist.linear.y = map(float, contact.velocity_after[:2])
    return message


def true_mallet(world: AirHockeyWorld, frame: str) -> Odometry:
    """The mallet's centre, its tilt, and its velocity along the axes of the base."""
    state = world.mallet_state()
    message = Odometry(child_frame_id=MALLET_FRAME)
    message.header.stamp, message.header.frame_id = SIMULATED.stamp(world.time), frame
    position, velocity = message.pose.pose.position, message.twist.twist.linear
    position.x, position.y, position.z = state.position.tolist()
    velocity.x, velocity.y, velocity.z = state.velocity.tolist()
    # The shortest turn from the vertical to the mallet's axis.
    x, y, z = _axis(state.tilt).tolist()
    turn = np.array([y, -x, 0.0, 1.0 - z])
    orientation = message.pose.pose.orientation
    values = (turn / np.linalg.norm(turn)).tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = values
    return message


def _axis(tilt: NDArray) -> NDArray:
    """Unit vector (3,) from the universal joint down to the mallet, from its tilt (2,) [rad]."""
    axis = np.array([*np.tan(tilt), -1.0])
    return axis / np.linalg.norm(axis)


def scene_markers(world: AirHockeyWorld, frame: str) -> MarkerArray:
    """Arm, mallet, puck and table."""
    make = markers.MarkerFactory(frame, SIMULATED.stamp(world.time), table.TABLE_ORIGIN[2])
    puck, mallet = world.puck_pose()[None, :2], world.mallet_state().position[None, :2]
    return MarkerArray(
        markers=[
            *(make.line("robot", points, markers.ROBOT, 0.04) for points in world.arm_points()),
            make.circles("puck", puck, np.array([table.PUCK_RADIUS]), PUCK),
            make.circles("mallet", mallet, np.array([table.MALLET_RADIUS]), MALLET),
            *table_markers(make),
        ]
    )


def table_markers(make: markers.MarkerFactory) -> list[Marker]:
    """Inner edges of the rims, the middle line, and the goals: "rims", "goals"."""
    x, y, goal = table.HALF_LENGTH, table.HALF_WIDTH, table.GOAL_HALF_WIDTH
    rims = [((-x, -y), (x, -y)), ((-x, y), (x, y)), ((0.0, -y), (0.0, y))]
    rims += [((end, side * goal), (end, side * y)) for end in (-x, x) for side in (-1.0, 1.0)]
    goals = [((end, -goal), (end, goal)) for end in (-x, x)]
    return [
        make.segments("rims", table.to_base(np.array(rims)).reshape(-1, 2), RIM),
        make.segments("goals", table.to_base(np.array(goals)).reshape(-1, 2), markers.GOAL),
    ]
