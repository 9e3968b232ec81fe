"""What the simulated driver publishes, made from the simulation."""

import math
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from visualization_msgs.msg import MarkerArray

from sim_bridge.arm_world import ArmWorld
from sim_bridge.camera import CameraFrame
from sim_bridge.scene import CUBE_SIDE
from sim_bridge.simulation import Simulation
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.estimation.object_state import ObjectState, wrap_angle
from vpsto_ros.nodes import markers
from vpsto_ros.nodes.conversions import SIMULATED, observation_message, state_message
from vpsto_ros.nodes.joint_conversions import joint_state_message
from vpsto_ros.robot.tip_kinematics import BALL_RADIUS, HAND_HALF_SIZE


def measured_joints(simulation: ArmWorld, frame: str) -> JointState:
    """Measured positions, velocities and torques."""
    position, velocity = simulation.joint_position, simulation.joint_velocity
    names, stamp = simulation.robot.joint_names, SIMULATED.stamp(simulation.time)
    return joint_state_message(names, position, velocity, simulation.joint_torque, stamp, frame)


def desired_joints(simulation: ArmWorld, frame: str) -> JointState:
    """The reference that the controller follows."""
    position, velocity, _ = simulation.follower.reference(simulation.time)
    names, stamp = simulation.robot.joint_names, SIMULATED.stamp(simulation.time)
    return joint_state_message(names, position, velocity, np.zeros(0), stamp, frame)


def external_wrench(simulation: Simulation, frame: str) -> WrenchStamped:
    """The force that the object exerts on the tool, or on all tools together, along the axes of the base."""
    message = WrenchStamped()
    message.header.stamp, message.header.frame_id = SIMULATED.stamp(simulation.time), frame
    force = message.wrench.force
    force.x, force.y, force.z = (-simulation.tool_contact_force()).tolist()
    return message


def seen_object(simulation: ArmWorld, seen: CameraFrame, frame: str) -> PoseWithCovarianceStamped:
    """What the camera saw."""
    stamp, height = SIMULATED.stamp(seen.stamp), simulation.surface
    return observation_message(seen.pose, seen.covariance, stamp, frame, height)


def true_object(simulation: ArmWorld, frame: str) -> Odometry:
    """Where the object really is."""
    pose, twist = simulation.object_pose(), simulation.object_twist()
    pose[2] = wrap_angle(pose[2])
    state = ObjectState(simulation.time, pose, twist, np.zeros((6, 6)))
    return state_message(state, SIMULATED, frame, height=simulation.surface)


def true_tools(simulation: Simulation, frame: str) -> list[Odometry]:
    """Where the tip of each tool is and how it moves, along the axes of the base, one message per tool."""
    found = []
    for tool, arm in enumerate(simulation.scene.kind.arms):
        message = Odometry(child_frame_id=arm.frame)
        message.header.stamp, message.header.frame_id = SIMULATED.stamp(simulation.time), frame
        position, velocity = message.pose.pose.position, message.twist.twist.linear
        position.x, position.y, position.z = simulation.tool_position(tool).tolist()
        velocity.x, velocity.y, velocity.z = simulation.tool_velocity(tool).tolist()
        message.pose.pose.orientation.w = 1.0
        found.append(message)
    if simulation.scene.robot == "hand":
        _turn(found[0], simulation)
    return found


def _turn(message: Odometry, simulation: Simulation) -> None:
    """Add the yaw of the hand and its rate."""
    q, qd = simulation.joint_position, simulation.joint_velocity
    yaw = float(simulation.plane.tool(q)[2])
    orientation = message.pose.pose.orientation
    orientation.z, orientation.w = math.sin(0.5 * yaw), math.cos(0.5 * yaw)
    message.twist.twist.angular.z = float(simulation.plane.tool_velocity(q, qd)[2])


def scene_markers(simulation: Simulation, frame: str) -> MarkerArray:
    """Arms, tools that are not rods, object and cubes."""
    make, plant = markers.MarkerFactory(frame, SIMULATED.stamp(simulation.time)), simulation.scene.plant
    arms, pose = simulation.scene.kind.arms, simulation.object_pose()
    drawn = [
        make.line(f"{arm.prefix}robot", points, markers.ROBOT, 0.03)
        for arm, points in zip(arms, simulation.arm_points(), strict=True)
    ]
    drawn += [
        make.shape("object", plant.shape, pose, markers.OBJECT, plant.height),
        make.shape("object_foot", plant.shape, pose, markers.OBJECT),
    ]
    if simulation.scene.robot == "hand":
        length, width = 2.0 * np.array(HAND_HALF_SIZE)
        tool = simulation.plane.tool(simulation.joint_position)
        hand = PlanarShape.box(length, width)
        drawn.append(make.shape("hand", hand, tool, markers.ROBOT, simulation.plane.height))
    if simulation.scene.robot == "two_balls":
        tips = simulation.plane.tips(simulation.joint_position)
        drawn.append(make.spheres("balls", tips, markers.ROBOT, 2.0 * BALL_RADIUS))
    if simulation.scene.cubes:
        drawn.append(make.spheres("cubes", simulation.cube_positions(), markers.OBJECT, CUBE_SIDE))
    return MarkerArray(markers=drawn)


def figures(simulation: ArmWorld) -> dict[str, Any]:
    """What the diagnostics say about limits and tracking."""
    controller = simulation.controller
    values: dict[str, Any] = {
        "simulated_time_s": f"{simulation.time:.3f}",
        "steps": simulation.steps,
        "limit_violations": simulation.limits.violations,
        "torque_saturations": int(controller.saturated.sum()),
        "torque_rate_saturations": int(controller.rate_limited.sum()),
    }
    for kind, seen in simulation.limits.report().items():
        # The controller ramps torques, so that their rate says what was asked for, not what the arm saw.
        group = "demand" if kind == "torque_rate" else "limit"
        values[f"{group}.{kind}.instants"] = seen.instants
        values[f"{group}.{kind}.worst"] = f"{seen.worst:.4f}"
    return values
