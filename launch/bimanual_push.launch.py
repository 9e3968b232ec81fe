"""Start the nodes of the bimanual demo on a ROS 2 installation: those of push_box with other parameters.

    ros2 launch vpsto_ros bimanual_push.launch.py
    ros2 launch vpsto_ros bimanual_push.launch.py simulation:=false    # beside two real FR3

Then give it a goal, for example with RViz's "2D Goal Pose", or

    ros2 topic pub --once /goal_pose geometry_msgs/msg/PoseStamped \
      "{header: {frame_id: fr3_link0}, pose: {position: {x: 0.5, y: 0.0}, orientation: {w: 1.0}}}"
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription


def generate_launch_description():
    """The launch arguments and what they start; what `ros2 launch` looks for."""
    share = Path(get_package_share_directory("vpsto_ros"))
    arguments = {
        "params_file": (str(share / "config" / "bimanual_push.yaml"), "parameters of the nodes"),
        "namespace": ("", "namespace of all nodes and topics"),
        "simulation": ("true", "false beside real robots"),
    }
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=value, description=text)
                for name, (value, text) in arguments.items()
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(str(share / "launch" / "push_box.launch.py")),
                launch_arguments=[(name, LaunchConfiguration(name)) for name in arguments],
            ),
        ]
    )
