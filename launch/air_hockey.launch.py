"""Start the nodes of the air-hockey demo on a ROS 2 installation: those of push_box with other parameters.

    ros2 launch vpsto_ros air_hockey.launch.py

Then bring pucks, one after the other:

    ros2 service call /franka_driver/new_puck std_srvs/srv/Trigger
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
        "params_file": (str(share / "config" / "air_hockey.yaml"), "parameters of the nodes"),
        "namespace": ("", "namespace of all nodes and topics"),
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
