"""
Move a table or an arm automatically until the IMU on it is calibrated.

There is no motion before ~/start.

    ros2 launch imu_calibration drive.launch.py table:=/path/to/table.yaml
    joint_trajectory:=/joint_trajectory_controller/joint_trajectory

    ros2 launch imu_calibration drive.launch.py table:=none urdf:=topic
    joint_trajectory:=/joint_trajectory_controller/joint_trajectory

    ros2 service call /planner_node/start std_srvs/srv/Trigger

An empty argument has no effect on the parameter files in config/.
"""

from launch.actions import OpaqueFunction
from launch.substitutions import PathJoinSubstitution

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
    'save_file': ('save_file', str),
    'gravity': ('gravity', float),
    'latitude': ('latitude', float),
    'noise_file': ('noise_file', str),
}
"""Argument, empty by default -> parameter of calibration_node that it sets, and its type."""


def generate_launch_description():
    """Describe calibration_node and planner_node, for the same table."""
    return LaunchDescription(
        [
            argument(
                'table',
                'table description with the limits of its joints, YAML; the template is refused',
                PathJoinSubstitution([CONFIG, 'table_template.yaml']),
            ),
            argument(
                'urdf',
                'robot description (.urdf), path; or topic: '
                'robot_description; with table:=none, or a table with the site of the arm',
            ),
            *shared_arguments('imu_link'),
            argument(
                'save_file',
                'where ~/save of calibration_node writes; empty: calibration.yaml in the'
                ' working directory',
            ),
            argument('gravity', 'local gravity, m/s^2, for the calibration; empty: that of table'),
            argument(
                'latitude',
                'latitude, deg, for the gravity there; as in table, if that states one',
            ),
            argument('noise_file', 'noise.yaml of this IMU, from the verb noise'),
            argument(
                'respawn',
                'start a node again when it ends; motion only after ~/start',
                'false',
            ),
            *shared_arguments('imu', 'joint_states'),
            argument('joint_trajectory', 'topic of the controller', 'joint_trajectory'),
            *shared_arguments('use_sim_time'),
            OpaqueFunction(function=_nodes),
        ]
    )


def _nodes(context):
    """Return both nodes; a parameter without an argument keeps its value."""
    table = {
        'table_file': parameter('table'),
        'urdf_file': parameter('urdf'),
        'imu_link': parameter('imu_link'),
        'use_sim_time': parameter('use_sim_time', bool),
    }
    parameters = given_parameters(context, OPTIONAL_PARAMETERS)
    noise = {name: value for name, value in parameters.items() if name == 'noise_file'}
    return [_node('calibration_node', table, parameters), _node('planner_node', table, noise)]


def _node(name, *parameters):
    topics = {
        'imu/data_raw': 'imu',
        'joint_states': 'joint_states',
        'joint_trajectory': 'joint_trajectory',
    }
    files = [PathJoinSubstitution([CONFIG, f'{name}.yaml']), *parameters]
    return node(name, files, topics, respawn='respawn')
