"""
Move a table or an arm automatically until the IMU on it is calibrated.

There is no motion before ~/start.

    ros2 launch imu_calibration drive.launch.py table:=/path/to/table.yaml
    joint_trajectory:=/joint_trajectory_controller/joint_trajectory

    ros2 launch imu_calibration drive.launch.py table:=none urdf:=topic
    joint_trajectory:=/joint_trajectory_controller/joint_trajectory

    ros2 service call /planner_node/start std_srvs/srv/Trigger
"""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

CONFIG = PathJoinSubstitution([FindPackageShare('imu_calibration'), 'config'])


def generate_launch_description():
    """Describe calibration_node and planner_node, for the same table."""
    table = {
        'table_file': ParameterValue(LaunchConfiguration('table'), value_type=str),
        'urdf_file': ParameterValue(LaunchConfiguration('urdf'), value_type=str),
        'imu_link': ParameterValue(LaunchConfiguration('imu_link'), value_type=str),
        'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool),
    }
    save = {'save_file': ParameterValue(LaunchConfiguration('save_file'), value_type=str)}
    topics = [
        ('imu/data_raw', LaunchConfiguration('imu')),
        ('joint_states', LaunchConfiguration('joint_states')),
        ('joint_trajectory', LaunchConfiguration('joint_trajectory')),
    ]
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
            _node('calibration_node', topics, table, save),
            _node('planner_node', topics, table),
        ]
    )


def _node(name, topics, *parameters):
    return Node(
        package='imu_calibration',
        executable=name,
        output='screen',
        remappings=topics,
        parameters=[PathJoinSubstitution([CONFIG, f'{name}.yaml']), *parameters],
    )
