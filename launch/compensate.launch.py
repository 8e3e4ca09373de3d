"""
Correct an IMU's messages with a calibration, live.

Optionally feed robot_localization with the corrected messages.

    ros2 launch imu_calibration compensate.launch.py calibration:=/path/to/calibration.yaml
    imu:=/imu/data_raw

    ros2 launch imu_calibration compensate.launch.py calibration:=/path/to/calibration.yaml
    corrected:=imu/data ekf:=true

Subscribers of imu/data, the usual topic, receive corrected readings with corrected:=imu/data and a
driver on imu/data_raw. An empty argument has no effect on `params`.
"""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

from imu_calibration.nodes.launch_arguments import given_parameters
from launch import LaunchDescription

CONFIG = PathJoinSubstitution([FindPackageShare('imu_calibration'), 'config'])
USE_SIM_TIME = {
    'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)
}
"""Parameter of both nodes."""
OPTIONAL_PARAMETERS = {
    'calibration': ('calibration_file', str),
    'adopt': ('adopt', str),
    'target_frame': ('target_frame', str),
    'anyway': ('anyway', bool),
    'gravity': ('gravity', float),
    'latitude': ('latitude', float),
    'noise_file': ('noise_file', str),
}
"""Launch argument, empty by default -> parameter that it sets, and the type of its value."""


def generate_launch_description():
    """Describe compensator_node, robot_localization's filter, and the names they can be given."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'calibration',
                default_value='',
                description='calibration.yaml; empty: wait for the latched topic imu/calibration',
            ),
            DeclareLaunchArgument(
                'adopt',
                default_value='',
                description=(
                    'source of calibrations: file (in the field), topic (replaces the file),'
                    ' file_then_topic (the default of the node)'
                ),
            ),
            DeclareLaunchArgument(
                'target_frame',
                default_value='',
                description=(
                    'frame to move the readings to, by the transforms on /tf_static; empty: that of'
                    ' the sensor'
                ),
            ),
            DeclareLaunchArgument(
                'anyway',
                default_value='',
                description='true: also correct a sensor whose decision is unproven',
            ),
            DeclareLaunchArgument(
                'gravity',
                default_value='',
                description='gravity at the site of the robot, m/s^2, for the test at stops',
            ),
            DeclareLaunchArgument(
                'latitude',
                default_value='',
                description='latitude of the robot, deg, from which gravity follows',
            ),
            DeclareLaunchArgument(
                'noise_file',
                default_value='',
                description='noise.yaml of this IMU, from the verb noise, for the covariances',
            ),
            DeclareLaunchArgument(
                'respawn', default_value='false', description='start the node again when it ends'
            ),
            DeclareLaunchArgument(
                'params',
                default_value=PathJoinSubstitution([CONFIG, 'compensator_node.yaml']),
                description='parameters of the node, YAML',
            ),
            DeclareLaunchArgument(
                'namespace', default_value='', description='one per IMU when there are several'
            ),
            DeclareLaunchArgument(
                'imu', default_value='imu/data_raw', description='topic of sensor_msgs/Imu'
            ),
            DeclareLaunchArgument(
                'corrected',
                default_value='imu/data_corrected',
                description='topic of the corrected messages',
            ),
            DeclareLaunchArgument(
                'ekf',
                default_value='false',
                description="start robot_localization's ekf_node on the corrected messages",
            ),
            DeclareLaunchArgument(
                'ekf_params',
                default_value=PathJoinSubstitution([CONFIG, 'robot_localization_ekf.yaml']),
                description='its parameters, YAML',
            ),
            DeclareLaunchArgument(
                'frame_prefix',
                default_value=PythonExpression(
                    ["'", LaunchConfiguration('namespace'), "/'.lstrip('/')"]
                ),
                description='prefix of the frames in ekf_params; default: the namespace and /',
            ),
            DeclareLaunchArgument(
                'use_sim_time', default_value='false', description='use the time of /clock'
            ),
            OpaqueFunction(function=_nodes),
            Node(
                package='robot_localization',
                executable='ekf_node',
                name='ekf_filter_node',
                namespace=LaunchConfiguration('namespace'),
                output='screen',
                condition=IfCondition(LaunchConfiguration('ekf')),
                parameters=[
                    # the file contains $(var frame_prefix)
                    ParameterFile(LaunchConfiguration('ekf_params'), allow_substs=True),
                    USE_SIM_TIME,
                ],
                remappings=[('imu/data', LaunchConfiguration('corrected'))],
            ),
        ]
    )


def _nodes(context):
    """Return the node; a parameter without an argument keeps its value in `params`."""
    parameters = USE_SIM_TIME | given_parameters(context, OPTIONAL_PARAMETERS)
    return [
        Node(
            package='imu_calibration',
            executable='compensator_node',
            namespace=LaunchConfiguration('namespace'),
            output='screen',
            respawn=LaunchConfiguration('respawn'),
            parameters=[LaunchConfiguration('params'), parameters],
            remappings=[
                ('imu/data_raw', LaunchConfiguration('imu')),
                ('imu/data_corrected', LaunchConfiguration('corrected')),
            ],
        )
    ]
