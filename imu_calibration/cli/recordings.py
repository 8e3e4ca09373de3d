"""Options that every verb on recordings shares, and what they open."""

from contextlib import closing
from functools import partial
from pathlib import Path

from imu_calibration import files
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.cli.progress import progress_bar
from imu_calibration.errors import InputError
from imu_calibration.resources import config_file
from imu_calibration.samples import NominalScaling
from imu_calibration.segmentation.window_settings import WindowSettings
from imu_calibration.settings import describe, override
from msg_adapters.bag import open_recording
from msg_adapters.read_ahead import read_ahead


def add_topic_arguments(parser):
    """Add the options that choose topics."""
    group = parser.add_argument_group('topics', 'default name, else the only topic of that type')
    group.add_argument('--imu-topic', metavar='TOPIC', help='sensor_msgs/Imu, default /imu/data_raw')
    group.add_argument('--joint-topic', metavar='TOPIC', help='sensor_msgs/JointState, default /joint_states')
    group.add_argument('--temperature-topic', metavar='TOPIC', help='sensor_msgs/Temperature, default /imu/temperature')


def add_model_arguments(parser):
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
                       help='how windows are found; may be repeated: ' + ', '.join(f'{d[0]} [{d[2]}]' for d in describe(WindowSettings)))


def calibration_options(options):
    """Return CalibrationOptions from parsed arguments."""
    tolerances = files.read_tolerances(options.tolerances or config_file('tolerances.yaml'))
    return CalibrationOptions(options.accelerometer_model, options.gyroscope_model, options.reference_model, tolerances,
                              window_settings(options.setting), nominal_of(options.nominal))


def window_settings(pairs):
    """Return the window settings with NAME=VALUE pairs applied."""
    values = {}
    for pair in pairs:
        name, _, text = pair.partition('=')
        try:
            values[name] = float(text)
        except ValueError as error:
            raise InputError(f"--setting must be NAME=NUMBER, got '{pair}'; write for example --setting settling=1.0") from error
    return override(WindowSettings(), values)


def nominal_of(path):
    """Return the nominal scaling in a file, or None."""
    if path is None:
        return None
    mapping = files.read_mapping(path, 'nominal scaling')
    known = NominalScaling.__dataclass_fields__
    strange = sorted(set(mapping) - set(known))
    if strange:
        raise InputError(f"{path} may name {', '.join(known)}; it names {', '.join(strange)}; correct it")
    return NominalScaling(**{name: float(value) for name, value in mapping.items()})


def existing(path):
    """Return the path of a bag that is there."""
    if not Path(path).exists():
        raise InputError(f'the bag {path} must exist, there is nothing there; correct the path')
    return path


def open_bag(path, options, want_joints=True, imu_topic=None, want_temperature=True):
    """Open a recording with the topics that the options name."""
    return open_recording(existing(path), *_topics(options, imu_topic), want_joints=want_joints, want_temperature=want_temperature)


def _topics(options, imu_topic):
    """Return the names of the topics that the options choose: IMU, joints, temperature."""
    return imu_topic or options.imu_topic, getattr(options, 'joint_topic', None), getattr(options, 'temperature_topic', None)


def read_blocks(path, topics, joint_names, want_joints, label, quiet=False):
    """Yield the blocks of a recording with a progress bar, unless `quiet`; a plain function, so that another process can run it."""
    recording = open_recording(path, *topics, want_joints=want_joints)
    with recording, progress_bar(label, 0 if quiet else recording.message_counts.get(recording.imu_topic, 0)) as advance:
        with closing(read_ahead(recording.blocks(joint_names) if want_joints else recording.blocks())) as blocks:
            for block in blocks:
                if block.imu is not None:
                    advance(len(block.imu))
                yield block
        yield from lost_block(recording)


def lost_block(recording):
    """Yield a block that carries the counts of what could not be read."""
    from imu_calibration.samples import SampleBlock
    if recording.lost:
        yield SampleBlock(dropped=recording.lost)


def source_of(path, options, joint_names=None, want_joints=True, imu_topic=None, quiet=False):
    """Return a callable that yields the blocks of a recording, each time anew."""
    return partial(read_blocks, str(path), _topics(options, imu_topic), joint_names, want_joints, Path(path).name, quiet)


def provenance_of(paths, options):
    """Return bag names, hashes and options for a document: nothing that changes from run to run."""
    kept = {name: value for name, value in sorted(vars(options).items())
            if name in ('accelerometer_model', 'gyroscope_model', 'reference_model', 'imu_topic', 'joint_topic', 'temperature_topic', 'setting') and value}
    return {'bags': [{'name': Path(path).name, 'sha256': files.hash_of(path)} for path in paths], 'options': kept}


def temperatures(path, options):
    """Return all temperatures of a recording, or None."""
    parts = []
    with open_bag(path, options, want_joints=False) as recording:
        if recording.temperature_topic:
            parts = [block.temperature for block in recording.blocks() if block.temperature is not None and len(block.temperature)]
    return type(parts[0]).concatenate(parts) if parts else None
