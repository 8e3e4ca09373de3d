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

from launch.actions import OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile

from imu_calibration.nodes.launch_arguments import (
    CONFIG,
    argument,
    given_parameters,
    node,
    parameter,
    shared_arguments,
)
from launch import LaunchDescription

USE_SIM_TIME = {'use_sim_time': parameter('use_sim_time', bool)}
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
            argument(
                'calibration',
                'calibration.yaml; empty: wait for the latched topic imu/calibration',
            ),
            argument(
                'adopt',
                'source of calibrations: file (in the field), topic (replaces the file),'
                ' file_then_topic (the default of the node)',
            ),
            argument(
                'target_frame',
                'frame to move the readings to, by the transforms on /tf_static; empty: that of'
                ' the sensor',
            ),
            argument('anyway', 'true: also correct a sensor whose decision is unproven'),
            argument('gravity', 'gravity at the site of the robot, m/s^2, for the test at stops'),
            argument('latitude', 'latitude of the robot, deg, from which gravity follows'),
            argument(
                'noise_file', 'noise.yaml of this IMU, from the verb noise, for the covariances'
            ),
            *shared_arguments('respawn'),
            argument(
                'params',
                'parameters of the node, YAML',
                PathJoinSubstitution([CONFIG, 'compensator_node.yaml']),
            ),
            *shared_arguments('namespace', 'imu'),
            argument('corrected', 'topic of the corrected messages', 'imu/data_corrected'),
            argument(
                'ekf', "start robot_localization's ekf_node on the corrected messages", 'false'
            ),
            argument(
                'ekf_params',
                'its parameters, YAML',
                PathJoinSubstitution([CONFIG, 'robot_localization_ekf.yaml']),
            ),
            argument(
                'frame_prefix',
                'prefix of the frames in ekf_params; default: the namespace and /',
                PythonExpression(["'", LaunchConfiguration('namespace'), "/'.lstrip('/')"]),
            ),
            *shared_arguments('use_sim_time'),
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
        node(
            'compensator_node',
            [LaunchConfiguration('params'), parameters],
            {'imu/data_raw': 'imu', 'imu/data_corrected': 'corrected'},
            namespace='namespace',
            respawn='respawn',
        )
    ]
