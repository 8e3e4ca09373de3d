"""
A simulated table with an IMU on it, calibrated and compensated live.

    ros2 launch imu_calibration demo.launch.py time_factor:=4.0
"""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

CONFIG = PathJoinSubstitution([FindPackageShare('imu_calibration'), 'config'])


def generate_launch_description():
    """Describe the simulator and the two nodes that listen to it, all on the simulator's clock."""
    table = {'table_file': ParameterValue(LaunchConfiguration('table'), value_type=str)}
    simulator = {
        'profile': ParameterValue(LaunchConfiguration('profile'), value_type=str),
        'clock': True,
        'wait_for_subscribers': 2,
        'time_factor': ParameterValue(LaunchConfiguration('time_factor'), value_type=float),
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'table',
                default_value=PathJoinSubstitution([CONFIG, 'table_simulated.yaml']),
                description='table description, YAML',
            ),
            DeclareLaunchArgument(
                'profile', default_value='quick', description='motion of the table'
            ),
            DeclareLaunchArgument(
                'time_factor',
                default_value='1.0',
                description='seconds of simulated time per second',
            ),
            _node('simulator_node', table, simulator),
            _node('calibration_node', table, {'use_sim_time': True}),
            _node('compensator_node', {'use_sim_time': True}),
        ]
    )


def _node(name, *parameters):
    return Node(
        package='imu_calibration',
        executable=name,
        output='screen',
        parameters=[PathJoinSubstitution([CONFIG, f'{name}.yaml']), *parameters],
    )
