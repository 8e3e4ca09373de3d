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

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from imu_calibration.nodes.launch_arguments import given_parameters
from launch import LaunchDescription

CONFIG = PathJoinSubstitution([FindPackageShare('imu_calibration'), 'config'])
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
            DeclareLaunchArgument(
                'table',
                default_value=PathJoinSubstitution([CONFIG, 'table_template.yaml']),
                description=(
                    'table description, YAML; the template is refused; none: no table, by hand'
                ),
            ),
            DeclareLaunchArgument(
                'urdf',
                default_value='',
                description=(
                    'robot description, path (.urdf, or .xacro with '
                    'allow_xacro: true in params); or topic: '
                    'robot_description; with table:=none, or a table with the site of the arm'
                ),
            ),
            DeclareLaunchArgument(
                'imu_link',
                default_value='',
                description='link that carries the IMU; empty: the frame of its messages',
            ),
            DeclareLaunchArgument(
                'params',
                default_value=PathJoinSubstitution([CONFIG, 'calibration_node.yaml']),
                description='parameters of the node, YAML',
            ),
            DeclareLaunchArgument(
                'save_file',
                default_value='',
                description=(
                    'file of ~/save; empty: calibration.yaml in the working directory, by ~/save'
                    ' only'
                ),
            ),
            DeclareLaunchArgument(
                'resume',
                default_value='',
                description='true: continue with the accumulator in the folder of save_file',
            ),
            DeclareLaunchArgument(
                'gravity',
                default_value='',
                description='local gravity, m/s^2; empty: by latitude, table or params',
            ),
            DeclareLaunchArgument(
                'latitude',
                default_value='',
                description='latitude, deg, for the gravity there; as in table, if that states one',
            ),
            DeclareLaunchArgument(
                'noise_file',
                default_value='',
                description='noise.yaml of this IMU, from the verb noise; with a table',
            ),
            DeclareLaunchArgument(
                'namespace', default_value='', description='one per IMU when there are several'
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
                'temperature',
                default_value='imu/temperature',
                description='topic of sensor_msgs/Temperature',
            ),
            DeclareLaunchArgument(
                'respawn', default_value='false', description='start the node again when it ends'
            ),
            DeclareLaunchArgument(
                'use_sim_time', default_value='false', description='use the time of /clock'
            ),
            OpaqueFunction(function=_nodes),
        ]
    )


def _nodes(context):
    """Return the node; a parameter without an argument keeps its value in `params`."""
    parameters = {
        'table_file': ParameterValue(LaunchConfiguration('table'), value_type=str),
        'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool),
    }
    parameters |= given_parameters(context, OPTIONAL_PARAMETERS)
    return [
        Node(
            package='imu_calibration',
            executable='calibration_node',
            namespace=LaunchConfiguration('namespace'),
            output='screen',
            respawn=LaunchConfiguration('respawn'),
            parameters=[LaunchConfiguration('params'), parameters],
            remappings=[
                ('imu/data_raw', LaunchConfiguration('imu')),
                ('joint_states', LaunchConfiguration('joint_states')),
                ('imu/temperature', LaunchConfiguration('temperature')),
            ],
        )
    ]
