"""Arguments that every verb on recordings shares, and the choices that they make."""

from argparse import ArgumentParser, Namespace, _ArgumentGroup
from typing import cast

from imu_calibration.segmentation.window_settings import WindowSettings
from imu_calibration.settings import describe
from imu_calibration.use_cases.choices import Choices
from imu_calibration.use_cases.stand import Arm, Stand


def add_topic_arguments(parser: ArgumentParser) -> None:
    """Add the options that choose topics."""
    group = parser.add_argument_group('topics', 'default name, else the only topic of that type')
    group.add_argument('--imu-topic', metavar='TOPIC', help='sensor_msgs/Imu, default /imu/data_raw')
    group.add_argument('--joint-topic', metavar='TOPIC', help='sensor_msgs/JointState, default /joint_states')
    group.add_argument('--temperature-topic', metavar='TOPIC', help='sensor_msgs/Temperature, default /imu/temperature')


def add_stand_arguments(parser: ArgumentParser, without: str) -> None:
    """Add the options of the table or arm that moves the IMU; `without` says what happens without any, or why it is needed."""
    group = parser.add_argument_group('table or arm', without)
    group.add_argument('--table', metavar='TABLE', help='table description (YAML); beside a robot description: where the robot '
                       'stands (up, gravity, latitude, mount, limits of joints by name)')
    group.add_argument('--urdf', metavar='FILE', help='description (.urdf, or .xacro with --allow-xacro) of the robot that carries the IMU')
    group.add_argument('--allow-xacro', action='store_true', help='expand a .xacro file, which is a program: its expressions '
                       'can execute any Python code; only for files whose author you trust')
    group.add_argument('--imu-link', metavar='LINK', help='link that carries the IMU, default the frame_id of its messages; '
                       'without --urdf: of the description on /robot_description in the recording')
    group.add_argument('--up', type=float, nargs=3, metavar=('X', 'Y', 'Z'),
                       help="up in the frame of the robot's root, default as in TABLE, else from /tf_static, else z")


def stand_of(options: Namespace) -> Stand | None:
    """Return the table or arm that parsed arguments name."""
    if options.urdf is None and options.imu_link is None:
        return options.table
    return Arm(options.urdf, options.imu_link, options.table, options.up, options.allow_xacro)


def add_model_arguments(parser: ArgumentParser) -> _ArgumentGroup:
    """Add the options that choose what is estimated; return their group."""
    group = parser.add_argument_group('model')
    group.add_argument('--accelerometer-model', metavar='MODEL', help='a named model or effect names joined by +; default bias+matrix, '
                       'and accel_size_effect when the recording holds rotation that shows it')
    group.add_argument('--gyroscope-model', metavar='MODEL', help='the same for the gyroscope; default bias+matrix')
    group.add_argument('--reference-model', metavar='MODEL', help="effects of table and clock joined by +, or 'none'; default table_tilt, "
                       'and earth_rate when only the azimuth is unknown')
    add_effects_argument(group)
    group.add_argument('--tolerances', metavar='FILE', help='standard deviations up to which a parameter counts as determined')
    group.add_argument('--nominal', metavar='FILE', help='YAML with accelerometer_offset, accelerometer_scale, gyroscope_offset, '
                       'gyroscope_scale for recordings in volts or counts')
    group.add_argument('--noise', metavar='FILE', help='noise.yaml of this IMU, from the verb noise: how its biases move; needs a table')
    group.add_argument('--setting', metavar='NAME=VALUE', action='append', default=[],
                       help='how windows are found; may be repeated: '
                       + ', '.join(f'{d.name} [{d.unit}]' for d in describe(WindowSettings)))
    return group


def add_effects_argument(group: ArgumentParser | _ArgumentGroup) -> None:
    """Add the option of effects that the catalogue does not have."""
    group.add_argument('--effects', dest='catalogue', metavar='FILE', help='effects of your own beside the catalogue: YAML with effects: '
                       'NAME: {sensor, column, unit, tolerance, text}, or a calibration.yaml that has some')


def choices_of(options: Namespace) -> Choices:
    """Return the choices that parsed arguments make."""
    return cast(Choices, {name: value for name, value in vars(options).items() if name in Choices.__annotations__})
