"""ros2 launch bmask_slam_ros bmask_slam.launch.py [params:=FILE] [rviz:=true]"""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

NAME = "bmask_slam_ros"


def generate_launch_description() -> LaunchDescription:
    """The node, and RViz where it is asked for."""
    share = get_package_share_directory(NAME)
    slam = Node(
        package=NAME,
        executable="bmask_slam",
        name="bmask_slam",
        parameters=[LaunchConfiguration("params")],
        output="screen",
        sigterm_timeout="120",  # the run is saved at the end
        sigkill_timeout="120",
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", f"{share}/rviz/bmask_slam.rviz"],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", default_value=f"{share}/config/params.yaml"),
            DeclareLaunchArgument("rviz", default_value="false"),
            slam,
            rviz,
        ]
    )
