"""Arguments and nodes of the launch files."""

from collections.abc import Mapping
from typing import Any

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

CONFIG = PathJoinSubstitution([FindPackageShare('imu_calibration'), 'config'])
SHARED_ARGUMENTS = {
    'imu_link': ('link that carries the IMU; empty: the frame of its messages', ''),
    'namespace': ('one per IMU when there are several', ''),
    'imu': ('topic of sensor_msgs/Imu', 'imu/data_raw'),
    'joint_states': ('topic of sensor_msgs/JointState', 'joint_states'),
    'respawn': ('start the node again when it ends', 'false'),
    'use_sim_time': ('use the time of /clock', 'false'),
}
"""Argument of several launch files -> its description and default."""


def argument(name: str, description: str, default: Any = '') -> DeclareLaunchArgument:
    """Return the declaration of a launch argument."""
    return DeclareLaunchArgument(name, default_value=default, description=description)


def shared_arguments(*names: str) -> list[DeclareLaunchArgument]:
    """Return the declarations of some of `SHARED_ARGUMENTS`."""
    return [argument(name, *SHARED_ARGUMENTS[name]) for name in names]


def parameter(argument_name: str, kind: type = str) -> ParameterValue:
    """Return the value of a launch argument as a parameter of type `kind`."""
    return ParameterValue(LaunchConfiguration(argument_name), value_type=kind)


def given_parameters(
    context: Any, optional: Mapping[str, tuple[str, type]]
) -> dict[str, ParameterValue]:
    """
    Return the parameters of a node that launch arguments set.

    A parameter without an argument keeps its value in the parameter file.

    Parameters
    ----------
    context : LaunchContext
    optional : mapping
        Launch argument, empty by default -> parameter that it sets, and the type of its value.

    """
    parameters = {}
    for name, (parameter_name, kind) in optional.items():
        if LaunchConfiguration(name).perform(context):
            parameters[parameter_name] = parameter(name, kind)
    return parameters


def node(
    executable: str, parameters: list, remapped: Mapping[str, str] | None = None, **options: Any
) -> Node:
    """
    Return a node of this package that logs to the screen.

    Parameters
    ----------
    executable : str
    parameters : list
        Files and mappings; the later ones have priority.
    remapped : mapping, optional
        Topic of the node -> launch argument with its name.
    options
        Further arguments of the node -> launch arguments with their values.

    """
    return Node(
        package='imu_calibration',
        executable=executable,
        output='screen',
        parameters=parameters,
        remappings=[(topic, LaunchConfiguration(name)) for topic, name in (remapped or {}).items()],
        **{option: LaunchConfiguration(name) for option, name in options.items()},
    )
