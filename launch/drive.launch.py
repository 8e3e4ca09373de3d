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

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from imu_calibration.nodes.launch_arguments import given_parameters
from launch import LaunchDescription

CONFIG = PathJoinSubstitution([FindPackageShare('imu_calibration'), 'config'])
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
            DeclareLaunchArgument(
                'table',
                default_value=PathJoinSubstitution([CONFIG, 'table_template.yaml']),
                description=(
                    'table description with the limits of its joints, YAML; the template is refused'
                ),
            ),
            DeclareLaunchArgument(
                'urdf',
                default_value='',
                description=(
                    'robot description (.urdf), path; or topic: '
                    'robot_description; with table:=none, or a table with the site of the arm'
                ),
            ),
            DeclareLaunchArgument(
                'imu_link',
                default_value='',
                description='link that carries the IMU; empty: the frame of its messages',
            ),
            DeclareLaunchArgument(
                'save_file',
                default_value='',
                description=(
                    'where ~/save of calibration_node writes; empty: calibration.yaml in the'
                    ' working directory'
                ),
            ),
            DeclareLaunchArgument(
                'gravity',
                default_value='',
                description='local gravity, m/s^2, for the calibration; empty: that of table',
            ),
            DeclareLaunchArgument(
                'latitude',
                default_value='',
                description='latitude, deg, for the gravity there; as in table, if that states one',
            ),
            DeclareLaunchArgument(
                'noise_file',
                default_value='',
                description='noise.yaml of this IMU, from the verb noise',
            ),
            DeclareLaunchArgument(
                'respawn',
                default_value='false',
                description='start a node again when it ends; motion only after ~/start',
            ),
            DeclareLaunchArgument(
                'imu', default_value='imu/data_raw', description='topic of sensor_msgs/Imu'
            ),
            DeclareLaunchArgument(
                'joint_states',
                default_value='joint_states',
                description='topic of sensor_msgs/JointState',
            ),
            DeclareLaunchArgument(
                'joint_trajectory',
                default_value='joint_trajectory',
                description='topic of the controller',
            ),
            DeclareLaunchArgument(
                'use_sim_time', default_value='false', description='use the time of /clock'
            ),
            OpaqueFunction(function=_nodes),
        ]
    )


def _nodes(context):
    """Return both nodes; a parameter without an argument keeps its value."""
    table = {
        'table_file': ParameterValue(LaunchConfiguration('table'), value_type=str),
        'urdf_file': ParameterValue(LaunchConfiguration('urdf'), value_type=str),
        'imu_link': ParameterValue(LaunchConfiguration('imu_link'), value_type=str),
        'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool),
    }
    parameters = given_parameters(context, OPTIONAL_PARAMETERS)
    noise = {name: value for name, value in parameters.items() if name == 'noise_file'}
    return [_node('calibration_node', table, parameters), _node('planner_node', table, noise)]


def _node(name, *parameters):
    return Node(
        package='imu_calibration',
        executable=name,
        output='screen',
        respawn=LaunchConfiguration('respawn'),
        remappings=[
            ('imu/data_raw', LaunchConfiguration('imu')),
            ('joint_states', LaunchConfiguration('joint_states')),
            ('joint_trajectory', LaunchConfiguration('joint_trajectory')),
        ],
        parameters=[PathJoinSubstitution([CONFIG, f'{name}.yaml']), *parameters],
    )
