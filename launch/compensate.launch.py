"""
Correct an IMU's messages with a calibration, live.

Optionally feed robot_localization with the corrected messages.

    ros2 launch imu_calibration compensate.launch.py calibration:=/path/to/calibration.yaml
    imu:=/imu/data_raw ros2 launch imu_calibration compensate.launch.py
    calibration:=/path/to/calibration.yaml corrected:=imu/data ekf:=true

Subscribers of imu/data, the usual topic, receive corrected readings with corrected:=imu/data and a
driver on imu/data_raw.
"""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

CONFIG = PathJoinSubstitution([FindPackageShare('imu_calibration'), 'config'])


def generate_launch_description():
    """Describe compensator_node, robot_localization's filter, and the names they can be given."""
    use_sim_time = {
        'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'calibration',
                default_value='',
                description='calibration.yaml; empty: wait for the latched topic imu/calibration',
            ),
            DeclareLaunchArgument(
                'adopt',
                default_value='file_then_topic',
                description=(
                    'source of calibrations: file (in the field), topic (replaces the file),'
                    ' file_then_topic'
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
                'use_sim_time', default_value='false', description='use the time of /clock'
            ),
            Node(
                package='imu_calibration',
                executable='compensator_node',
                namespace=LaunchConfiguration('namespace'),
                output='screen',
                respawn=LaunchConfiguration('respawn'),
                parameters=[
                    LaunchConfiguration('params'),
                    {
                        'calibration_file': ParameterValue(
                            LaunchConfiguration('calibration'), value_type=str
                        ),
                        'adopt': LaunchConfiguration('adopt'),
                        'target_frame': ParameterValue(
                            LaunchConfiguration('target_frame'), value_type=str
                        ),
                        **use_sim_time,
                    },
                ],
                remappings=[
                    ('imu/data_raw', LaunchConfiguration('imu')),
                    ('imu/data_corrected', LaunchConfiguration('corrected')),
                ],
            ),
            Node(
                package='robot_localization',
                executable='ekf_node',
                name='ekf_filter_node',
                namespace=LaunchConfiguration('namespace'),
                output='screen',
                condition=IfCondition(LaunchConfiguration('ekf')),
                parameters=[LaunchConfiguration('ekf_params'), use_sim_time],
                remappings=[('imu/data', LaunchConfiguration('corrected'))],
            ),
        ]
    )
