"""Options that verbs on recordings share, and the choices that they make."""

from __future__ import annotations

from argparse import Namespace, _ArgumentGroup
from collections.abc import Callable, Sequence
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from imu_calibration.cli.parser import OneLineParser

if TYPE_CHECKING:
    from imu_calibration.use_cases.choices import Choices
    from imu_calibration.use_cases.stand import Stand

BAG = 'rosbag2 folder, .db3, .mcap, ROS 1 .bag, text (.csv)'


def add_topic_arguments(parser: OneLineParser, *, joints: bool = True) -> None:
    """Add the options that choose topics."""
    common, expert = parser.common.add_argument, parser.expert.add_argument
    common('--imu-topic', metavar='TOPIC', help='default /imu/data_raw, else the only Imu topic')
    expert('--frame-id', metavar='FRAME', help='frame_id of the Imu messages; for a topic with several')
    if joints:
        common('--joint-topic', metavar='TOPIC', help='default /joint_states, else the only JointState topic')
    expert('--temperature-topic', metavar='TOPIC', help='default /imu/temperature, else the only one')


def add_stand_arguments(parser: OneLineParser, without: str) -> None:
    """Add the options of the table or arm that moves the IMU; `without` describes the case without them."""
    common, expert = parser.common.add_argument, parser.expert.add_argument
    common('--table', metavar='TABLE', help=f'description of the table (YAML); {without}')
    common('--urdf', metavar='FILE', help='robot description in place of a table; --table adds up, gravity, mount, limits')
    common('--imu-link', metavar='LINK', help='link with the IMU, default its frame_id; without --urdf: of /robot_description in the bag')
    expert('--allow-xacro', action='store_true', help='expand a .xacro file; it is a program: only from authors you trust')
    expert('--up', type=float, nargs=3, metavar=('X', 'Y', 'Z'), help='up in the root frame; default TABLE, /tf_static or z')


def stand_of(options: Namespace) -> Stand | None:
    """Return the table or arm of parsed arguments."""
    if options.urdf is None and options.imu_link is None:
        return options.table
    from imu_calibration.use_cases.stand import Arm
    return Arm(options.urdf, options.imu_link, options.table, options.up, options.allow_xacro)


def add_gravity_arguments(parser: OneLineParser) -> None:
    """Add the options of local gravity: its value, or the place."""
    common = parser.common.add_argument
    common('--gravity', type=float, help='local gravity, m/s^2, by hand or with --urdf; default 9.80665')
    common('--latitude', metavar='DEG', type=float, help='gravity from the latitude (WGS 84)')
    common('--height', metavar='M', type=float, help='and height above the ellipsoid, default 0 m')


def add_result_arguments(parser: OneLineParser) -> None:
    """Add the options of the written result."""
    parser.common.add_argument('--serial', metavar='TEXT', help='serial number of the IMU, for calibration.yaml')
    parser.common.add_argument('--operator', metavar='TEXT', help='name of the operator, likewise')
    parser.common.add_argument('--force', action='store_true', help='overwrite the result of another verb or other inputs')


def require_place(options: Namespace, verb: str, bags: Sequence[str]) -> None:
    """Refuse an output folder with the result of another verb or of other inputs, except with --force."""
    if not options.force and (Path(options.output) / 'calibration.yaml').exists():
        from imu_calibration.use_cases.provenance import provenance_with, require_same_inputs
        require_same_inputs(options.output, provenance_with(verb, bags, choices_of(options), stand=stand_of(options)))


def add_model_arguments(parser: OneLineParser, *, searched: bool = True) -> None:
    """Add the options that choose the parameters to estimate; `searched`: and the option that omits the search for effects."""
    group = parser.expert
    expert = group.add_argument
    expert('--accelerometer-model', metavar='MODEL', help='effects joined by +; default bias+matrix, and accel_size_effect if observable')
    expert('--gyroscope-model', metavar='MODEL', help='likewise; default bias+matrix')
    expert('--reference-model', metavar='MODEL', help="effects of table and clock, or 'none'; default table_tilt")
    add_effects_argument(group)
    expert('--tolerances', metavar='FILE', help='largest sd of a determined parameter, by effect')
    expert('--nominal', metavar='FILE', help='offsets and scales of recordings in volts or counts')
    expert('--noise', metavar='FILE', help='noise.yaml of this IMU: model of its biases (table only)')
    expert('--setting', metavar='NAME=VALUE', action='append', default=[],
           help='of the window detection; an unknown name lists all')
    if searched:
        expert('--model-as-asked', action='store_true', help='add no effect to the requested model')


def add_effects_argument(group: _ArgumentGroup) -> None:
    """Add the option of effects in addition to the catalogue."""
    group.add_argument('--effects', dest='catalogue', metavar='FILE', help='YAML or calibration.yaml with additional effects')


def named_as(function: Callable, options: Namespace) -> dict[str, Any]:
    """Return the parsed arguments that have the names of parameters of a function."""
    return {name: value for name, value in vars(options).items() if name in signature(function).parameters}


def choices_of(options: Namespace) -> Choices:
    """Return the choices of parsed arguments."""
    from imu_calibration.use_cases.choices import Choices
    return cast(Choices, {name: value for name, value in vars(options).items() if name in Choices.__annotations__})
