"""
A simulated table with an IMU on it, calibrated and compensated live.

    ros2 launch imu_calibration demo.launch.py
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

CONFIG = PathJoinSubstitution([FindPackageShare('imu_calibration'), 'config'])


def generate_launch_description():
    """Describe the simulator and the two nodes that listen to it."""
    table = {'table_file': ParameterValue(LaunchConfiguration('table'), value_type=str)}
    return LaunchDescription([
        DeclareLaunchArgument('table', default_value=PathJoinSubstitution([CONFIG, 'table_three_axis.yaml']),
                              description='table description, YAML'),
        _node('simulator_node', table),
        _node('calibration_node', table),
        _node('compensator_node'),
    ])


def _node(name, *parameters):
    return Node(package='imu_calibration', executable=name, output='screen',
                parameters=[PathJoinSubstitution([CONFIG, f'{name}.yaml']), *parameters])
