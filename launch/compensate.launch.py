"""
Correct an IMU's messages with a calibration, live.

    ros2 launch imu_calibration compensate.launch.py calibration:=/path/to/calibration.yaml imu:=/imu/data_raw
"""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

CONFIG = PathJoinSubstitution([FindPackageShare('imu_calibration'), 'config'])


def generate_launch_description():
    """Describe compensator_node and the names it can be given."""
    return LaunchDescription([
        DeclareLaunchArgument('calibration', default_value='',
                              description='calibration.yaml; empty: wait for the latched topic imu/calibration'),
        DeclareLaunchArgument('adopt', default_value='file_then_topic',
                              description='where calibrations come from: file, topic (displaces the file), file_then_topic'),
        DeclareLaunchArgument('params', default_value=PathJoinSubstitution([CONFIG, 'compensator_node.yaml']),
                              description='parameters of the node, YAML'),
        DeclareLaunchArgument('namespace', default_value='', description='one per IMU when there are several'),
        DeclareLaunchArgument('imu', default_value='imu/data_raw', description='topic of sensor_msgs/Imu'),
        DeclareLaunchArgument('corrected', default_value='imu/data_corrected', description='topic of the corrected messages'),
        DeclareLaunchArgument('use_sim_time', default_value='false', description='take the time from /clock'),
        Node(
            package='imu_calibration', executable='compensator_node', namespace=LaunchConfiguration('namespace'), output='screen',
            parameters=[LaunchConfiguration('params'), {
                'calibration_file': ParameterValue(LaunchConfiguration('calibration'), value_type=str),
                'adopt': LaunchConfiguration('adopt'),
                'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)}],
            remappings=[('imu/data_raw', LaunchConfiguration('imu')), ('imu/data_corrected', LaunchConfiguration('corrected'))],
        ),
    ])
