"""Start the nodes of the pushing demo on a ROS 2 installation.

    ros2 launch vpsto_ros push_box.launch.py
    ros2 launch vpsto_ros push_box.launch.py namespace:=cell_1
    ros2 launch vpsto_ros push_box.launch.py simulation:=false    # beside a real FR3, see config/

Then give it a goal, for example with RViz's "2D Goal Pose", or

    ros2 topic pub --once /goal_pose geometry_msgs/msg/PoseStamped \
      "{header: {frame_id: fr3_link0}, pose: {position: {x: 0.56, y: 0.1}, orientation: {w: 1.0}}}"
"""

from pathlib import Path

import yaml
from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

PLANNING = ("state_estimator", "contact_planner", "mpc_planner")
# Where a stock joint_trajectory_controller listens.
REAL_ROBOT = [
    ("joint_trajectory", "/joint_trajectory_controller/joint_trajectory"),
    ("joint_states", "/joint_states"),
]


def parameters(file, node, simulated):
    """The parameters of one node. Passed as values rather than as a file, they apply in every namespace."""
    content = yaml.safe_load(Path(file).read_text())
    found = {}
    for name in ("/**", node):
        found.update(content.get(name, {}).get("ros__parameters", {}))
    if node in PLANNING:
        found["use_sim_time"] = simulated
    return found


def nodes(context):
    """The nodes to start, once the launch arguments are known."""
    file = LaunchConfiguration("params_file").perform(context)
    simulated = LaunchConfiguration("simulation").perform(context).lower() in ("true", "1", "yes")
    names = (*PLANNING, "franka_driver") if simulated else PLANNING
    return [
        Node(
            package="vpsto_ros",
            executable=name,
            name=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[parameters(file, name, simulated)],
            remappings=[] if simulated else REAL_ROBOT,
            output="screen",
        )
        for name in names
    ]


def generate_launch_description():
    """The launch arguments and what they start; what `ros2 launch` looks for."""
    default_file = Path(get_package_share_directory("vpsto_ros")) / "config" / "push_box.yaml"
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params_file", default_value=str(default_file), description="parameters of the nodes"
            ),
            DeclareLaunchArgument(
                "namespace", default_value="", description="namespace of all nodes and topics"
            ),
            DeclareLaunchArgument(
                "simulation", default_value="true", description="false beside a real robot"
            ),
            OpaqueFunction(function=nodes),
        ]
    )
