"""Starts the bridge: ros2 launch seese3_bridge bridge.launch.py room:=kitchen image:=/camera/image_raw/compressed"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

# What is given here stands above the file of parameters; what is empty does not.
PARAMETERS = {
    "server": "where the server answers",
    "room": "the room; found among all if nobody names it",
    "adapter": "the adapter; the room's first that can track if nobody names it",
}
TOPICS = {
    "image": "CompressedImage",
    "image_raw": "Image",
    "camera_info": "CameraInfo",
    "wheels": "the wheels' Odometry",
    "imu": "Imu",
}


def bridge(context):
    given = {name: LaunchConfiguration(name).perform(context) for name in PARAMETERS}
    given = {name: ParameterValue(value, value_type=str) for name, value in given.items() if value}
    topics = [(f"~/{name}", LaunchConfiguration(name)) for name in TOPICS]
    return [Node(package="seese3_bridge", executable="bridge", name="seese3", output="screen", respawn=True, respawn_delay=1.0,
                 parameters=[LaunchConfiguration("parameters"), given], remappings=topics)]


def generate_launch_description():
    plain = PathJoinSubstitution([FindPackageShare("seese3_bridge"), "config", "bridge.yaml"])
    arguments = [DeclareLaunchArgument(name, default_value="", description=text) for name, text in PARAMETERS.items()]
    arguments += [DeclareLaunchArgument(name, default_value=f"~/{name}", description=f"the topic of {text}")
                  for name, text in TOPICS.items()]
    arguments.append(DeclareLaunchArgument("parameters", default_value=plain, description="a file of parameters"))
    return LaunchDescription([*arguments, OpaqueFunction(function=bridge)])
