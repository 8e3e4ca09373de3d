"""
Calibrate an IMU on a table, live.

    ros2 launch imu_calibration calibrate.launch.py table:=/path/to/table.yaml imu:=/imu/data_raw

    # on the arm of robot_description
    ros2 launch imu_calibration calibrate.launch.py table:=none urdf:=topic imu:=/imu/data_raw

    # by hand, without a table
    ros2 launch imu_calibration calibrate.launch.py table:=none imu:=/imu/data_raw

Several IMUs: one launch each with its own `namespace` and `save_file`. An empty argument has no
effect on `params`.
"""

from launch.actions import OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution

from imu_calibration.nodes.launch_arguments import (
    CONFIG,
    argument,
    given_parameters,
    node,
    parameter,
    shared_arguments,
)
from launch import LaunchDescription

OPTIONAL_PARAMETERS = {
    'urdf': ('urdf_file', str),
    'imu_link': ('imu_link', str),
    'save_file': ('save_file', str),
    'resume': ('resume', bool),
    'gravity': ('gravity', float),
    'latitude': ('latitude', float),
    'noise_file': ('noise_file', str),
}
"""Launch argument, empty by default -> parameter that it sets, and the type of its value."""


def generate_launch_description():
    """Describe calibration_node and the names it can be given."""
    return LaunchDescription(
        [
            argument(
                'table',
                'table description, YAML; the template is refused; none: no table, by hand',
                PathJoinSubstitution([CONFIG, 'table_template.yaml']),
            ),
            argument(
                'urdf',
                'robot description, path (.urdf, or .xacro with '
                'allow_xacro: true in params); or topic: '
                'robot_description; with table:=none, or a table with the site of the arm',
            ),
            *shared_arguments('imu_link'),
            argument(
                'params',
                'parameters of the node, YAML',
                PathJoinSubstitution([CONFIG, 'calibration_node.yaml']),
            ),
            argument(
                'save_file',
                'file of ~/save; empty: calibration.yaml in the working directory, by ~/save only',
            ),
            argument('resume', 'true: continue with the accumulator in the folder of save_file'),
            argument('gravity', 'local gravity, m/s^2; empty: by latitude, table or params'),
            argument(
                'latitude',
                'latitude, deg, for the gravity there; as in table, if that states one',
            ),
            argument('noise_file', 'noise.yaml of this IMU, from the verb noise; with a table'),
            *shared_arguments('namespace', 'imu', 'joint_states'),
            argument('temperature', 'topic of sensor_msgs/Temperature', 'imu/temperature'),
            *shared_arguments('respawn', 'use_sim_time'),
            OpaqueFunction(function=_nodes),
        ]
    )


def _nodes(context):
    """Return the node; a parameter without an argument keeps its value in `params`."""
    parameters = {
        'table_file': parameter('table'),
        'use_sim_time': parameter('use_sim_time', bool),
        **given_parameters(context, OPTIONAL_PARAMETERS),
    }
    topics = {
        'imu/data_raw': 'imu',
        'joint_states': 'joint_states',
        'imu/temperature': 'temperature',
    }
    return [
        node(
            'calibration_node',
            [LaunchConfiguration('params'), parameters],
            topics,
            namespace='namespace',
            respawn='respawn',
        )
    ]
