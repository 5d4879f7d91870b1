"""Starts the bridge: ros2 launch seese3_bridge bridge.launch.py room:=kitchen image:=/camera/image_raw/compressed"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "server": ("127.0.0.1:50051", "where the server answers"),
    "room": ("", "the room; found among all if empty"),
    "adapter": ("", "the adapter; the room's first that can track if empty"),
    "image": ("~/image", "the topic of CompressedImage"),
    "image_raw": ("~/image_raw", "the topic of Image"),
    "camera_info": ("~/camera_info", "the topic of CameraInfo"),
    "wheels": ("~/wheels", "the topic of the wheels' Odometry"),
    "imu": ("~/imu", "the topic of Imu"),
}


def generate_launch_description():
    plain = PathJoinSubstitution([FindPackageShare("seese3_bridge"), "config", "bridge.yaml"])
    declared = [DeclareLaunchArgument(name, default_value=value, description=text)
                for name, (value, text) in ARGUMENTS.items()]
    declared.append(DeclareLaunchArgument("parameters", default_value=plain, description="a file of parameters"))

    given = {name: LaunchConfiguration(name) for name in ("server", "room", "adapter")}
    topics = [(f"~/{name}", LaunchConfiguration(name)) for name in ("image", "image_raw", "camera_info", "wheels", "imu")]
    bridge = Node(package="seese3_bridge", executable="bridge", name="seese3", output="screen",
                  parameters=[LaunchConfiguration("parameters"), given], remappings=topics)
    return LaunchDescription([*declared, bridge])
