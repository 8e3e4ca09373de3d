"""Arguments that every verb on recordings shares, and the choices that they make."""

from argparse import ArgumentParser, Namespace
from typing import cast

from imu_calibration.segmentation.window_settings import WindowSettings
from imu_calibration.settings import describe
from imu_calibration.use_cases.choices import Choices


def add_topic_arguments(parser: ArgumentParser) -> None:
    """Add the options that choose topics."""
    group = parser.add_argument_group('topics', 'default name, else the only topic of that type')
    group.add_argument('--imu-topic', metavar='TOPIC', help='sensor_msgs/Imu, default /imu/data_raw')
    group.add_argument('--joint-topic', metavar='TOPIC', help='sensor_msgs/JointState, default /joint_states')
    group.add_argument('--temperature-topic', metavar='TOPIC', help='sensor_msgs/Temperature, default /imu/temperature')


def add_model_arguments(parser: ArgumentParser) -> None:
    """Add the options that choose what is estimated."""
    group = parser.add_argument_group('model')
    group.add_argument('--accelerometer-model', metavar='MODEL', help='a named model or effect names joined by +; default bias+matrix, '
                       'and accel_size_effect when the recording holds rotation that shows it')
    group.add_argument('--gyroscope-model', metavar='MODEL', help='the same for the gyroscope; default bias+matrix')
    group.add_argument('--reference-model', metavar='MODEL', help="effects of table and clock joined by +, or 'none'; default table_tilt, "
                       'and earth_rate when latitude or azimuth is unknown')
    group.add_argument('--tolerances', metavar='FILE', help='standard deviations up to which a parameter counts as determined')
    group.add_argument('--nominal', metavar='FILE', help='YAML with accelerometer_offset, accelerometer_scale, gyroscope_offset, '
                       'gyroscope_scale for recordings in volts or counts')
    group.add_argument('--setting', metavar='NAME=VALUE', action='append', default=[],
                       help='how windows are found; may be repeated: '
                       + ', '.join(f'{d.name} [{d.unit}]' for d in describe(WindowSettings)))


def choices_of(options: Namespace) -> Choices:
    """Return the choices that parsed arguments make."""
    return cast(Choices, {name: value for name, value in vars(options).items() if name in Choices.__annotations__})
