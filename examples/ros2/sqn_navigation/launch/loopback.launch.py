"""The node in a simulated world without Gazebo: nav2's loopback simulator makes scans of a map.

ros2 launch sqn_navigation loopback.launch.py map:=/path/my_map.yaml policy:=/path/best_policy

Set where the robot is with "2D Pose Estimate" in RViz, then the goal with "2D Goal Pose".
"""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    """The map, the simulator, the place of its sensor, and the node."""
    share = get_package_share_directory("sqn_navigation")
    return LaunchDescription(
        [
            DeclareLaunchArgument("map", description="YAML file of map_server"),
            DeclareLaunchArgument("policy", description="folder from sqn export"),
            DeclareLaunchArgument("params", default_value=f"{share}/config/sqn_navigation.yaml"),
            Node(
                package="nav2_map_server",
                executable="map_server",
                parameters=[{"yaml_filename": LaunchConfiguration("map")}],
            ),
            Node(
                package="nav2_lifecycle_manager",
                executable="lifecycle_manager",
                parameters=[{"autostart": True, "node_names": ["map_server"]}],
            ),
            Node(
                package="nav2_loopback_sim",
                executable="loopback_simulator",
                parameters=[
                    {
                        "base_frame_id": "base_link",
                        "scan_frame_id": "base_scan",
                        "publish_map_odom_tf": True,
                        "enable_stamped_cmd_vel": False,
                        "scan_range_min": 0.05,
                        "scan_range_max": 12.0,
                        "scan_use_inf": True,
                    }
                ],
            ),
            Node(
                package="tf2_ros",
                executable="static_transform_publisher",
                arguments=["--frame-id", "base_link", "--child-frame-id", "base_scan"],
            ),
            Node(
                package="sqn_navigation",
                executable="navigator",
                output="screen",
                parameters=[
                    LaunchConfiguration("params"),
                    {"policy": LaunchConfiguration("policy"), "stamped": False},
                ],
            ),
        ]
    )
