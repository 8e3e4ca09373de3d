"""
A simulated table with an IMU on it, calibrated and compensated live.

    ros2 launch imu_calibration demo.launch.py time_factor:=4.0
"""

from launch.substitutions import PathJoinSubstitution

from imu_calibration.nodes.launch_arguments import CONFIG, argument, node, parameter
from launch import LaunchDescription


def generate_launch_description():
    """Describe the simulator and the two nodes that listen to it, all on the simulator's clock."""
    table = {'table_file': parameter('table')}
    simulator = {
        'profile': parameter('profile'),
        'clock': True,
        'wait_for_subscribers': 2,
        'time_factor': parameter('time_factor', float),
    }
    return LaunchDescription(
        [
            argument(
                'table',
                'table description, YAML',
                PathJoinSubstitution([CONFIG, 'table_simulated.yaml']),
            ),
            argument('profile', 'motion of the table', 'quick'),
            argument('time_factor', 'seconds of simulated time per second', '1.0'),
            _node('simulator_node', table, simulator),
            _node('calibration_node', table, {'use_sim_time': True}),
            _node('compensator_node', {'use_sim_time': True}),
        ]
    )


def _node(name, *parameters):
    return node(name, [PathJoinSubstitution([CONFIG, f'{name}.yaml']), *parameters])
