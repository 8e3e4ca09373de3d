"""The readers of untrusted input, each with small valid inputs."""

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from fuzz import attacks
from fuzz.mutation import mutated, mutated_archive, mutated_document
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from imu_calibration.allan.document import counts, noise_from_text, noise_to_text, rows
from imu_calibration.allan.identify import figures_of, identify_noise
from imu_calibration.api.inspect import imu_topics_of
from imu_calibration.api.recordings import Topics
from imu_calibration.compensation.stream import CompensationStream
from imu_calibration.core.documents import from_text
from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import ImuSamples, JointSamples, SampleBlock, TemperatureSamples
from imu_calibration.document import files, trust
from imu_calibration.document.calibration_text import calibration_from_text, calibration_to_text
from imu_calibration.document.comparison import compare
from imu_calibration.document.exports.export import all_targets, export
from imu_calibration.document.exports.loss import import_file
from imu_calibration.document.outcome import parameter_count
from imu_calibration.kinematics.table import Table
from imu_calibration.kinematics.urdf import root_of, table_from_urdf
from imu_calibration.nodes.message_compensation import LiveCompensation
from imu_calibration.references.gravity.sample_store import HandStore
from imu_calibration.references.turntable.collector import from_bytes, to_bytes
from imu_calibration.references.turntable.live_windows import LiveCalibration
from msg_adapters.bag import STRING_TYPE, TF_TYPE, description_in, open_recording, static_transforms
from msg_adapters.csv_log import read_csv
from msg_adapters.decode import Decoder, JointDecoder
from msg_adapters.definitions import deserializer, is_standard, standard_definition
from msg_adapters.imu import IMU_TYPE, TEMPERATURE_TYPE
from msg_adapters.joint_state import JOINT_STATE_TYPE
from msg_adapters.layout import Packed
from msg_adapters.write import encode_imu, encode_joints, encode_temperature, write_session

from worlds.arms import SIX_AXES
from worlds.compensation_cases import random_calibration
from worlds.live_sessions import make_session

WRITERS = [target for _, target in sorted(all_targets().items()) if target.write]
ROOT = Path(__file__).resolve().parents[2]
STEP_NS = 5_000_000
IMU = random_calibration(0, ())


@dataclass(frozen=True)
class Reader:
    """A function that reads untrusted bytes."""

    seeds: Callable[[Path], list[bytes]]
    """Folder for files -> valid inputs."""
    read: Callable[[bytes, Path], Any]
    """
    Read an input, with a folder in which to put it; raises ImuCalibrationError for one that is
    refused.
    """
    text: bool = False
    """Whether tokens and lines are changed as well as bytes."""
    mutate: Callable = mutated
    attack: bool = False
    """Whether all inputs may be refused."""


def small_session(n=60):
    """Return an IMU, joints and temperatures of 0.3 s."""
    stamp_ns, wave = 1_700_000_000_000_000_000 + STEP_NS * np.arange(n), 1e-3 * np.sin(np.arange(n))
    imu = ImuSamples(
        stamp_ns,
        np.column_stack([wave, -wave, 9.81 + wave]),
        np.column_stack([wave, wave, -wave]),
        'imu_link',
    )
    return (
        imu,
        JointSamples(stamp_ns, wave[:, None], wave[:, None], ('outer',)),
        TemperatureSamples(stamp_ns[::20], 30.0 + wave[::20]),
    )


def _bags(folder, name, suffix, **options):
    imu, joints, temperature = small_session()
    write_session(folder / name, imu, joints, temperature=temperature, **options)
    (path,) = (folder / name).glob(f'*{suffix}')
    return path.read_bytes()


def mcap_seeds(folder):
    """Uncompressed, zstd and lz4 chunks, and a recording with a robot description."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(folder / 'described', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, kind, data in (
            ('/imu/data_raw', IMU_TYPE, encode_imu(small_session(1)[0])[0].tobytes()),
            *_general_messages(),
        ):
            writer.write(writer.add_connection(topic, kind, typestore=store), 1, data)
    (described,) = (folder / 'described').glob('*.mcap')
    return [
        _bags(folder, 'plain', '.mcap', storage='mcap', compression=''),
        _bags(folder, 'zstd', '.mcap', storage='mcap', compression='zstd'),
        _bags(folder, 'lz4', '.mcap', storage='mcap', compression='lz4'),
        described.read_bytes(),
    ]


def _general_messages():
    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = store.types
    stamp = kinds['builtin_interfaces/msg/Time'](1, 2)
    header = kinds['std_msgs/msg/Header'](stamp, 'tool')
    turn = kinds['geometry_msgs/msg/Transform'](
        kinds['geometry_msgs/msg/Vector3'](0.0, 0.0, 0.1),
        kinds['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0),
    )
    transforms = kinds[TF_TYPE](
        [kinds['geometry_msgs/msg/TransformStamped'](header, 'imu_link', turn)]
    )
    for topic, kind, message in (
        ('/robot_description', STRING_TYPE, kinds[STRING_TYPE](SIX_AXES)),
        ('/tf_static', TF_TYPE, transforms),
    ):
        yield topic, kind, bytes(store.serialize_cdr(message, kind))


def read_bag(path):
    """Read everything of a recording that a verb may need."""
    with open_recording(path, want_joints='optional', want_temperature='optional') as recording:
        assert recording.duration is not None
        for _ in recording.blocks():
            pass
        assert isinstance(recording.lost, dict)
    static_transforms(path)
    try:
        description_in(path)
    except InputError as error:
        if error.code != 'description_missing':
            raise


def _file_reader(name, read):
    def with_file(data, folder):
        path = folder / name
        path.write_bytes(data)
        read(path)

    return with_file


def ros1_seeds(folder):
    """A ROS 1 bag with plain chunks and one with bz2."""
    store, found = get_typestore(Stores.ROS1_NOETIC), []
    kinds = store.types
    vector, zeros = kinds['geometry_msgs/msg/Vector3'](0.0, 0.1, 9.8), np.zeros(9)
    for compression in (None, Ros1Writer.CompressionFormat.BZ2):
        path = folder / f'{compression}.bag'
        writer = Ros1Writer(path)
        if compression:
            writer.set_compression(compression)
        with writer:
            topic = writer.add_connection('/imu/data_raw', IMU_TYPE, typestore=store)
            for k in range(40):
                header = kinds['std_msgs/msg/Header'](
                    k, kinds['builtin_interfaces/msg/Time'](1, STEP_NS * k), 'imu_link'
                )
                message = kinds[IMU_TYPE](
                    header,
                    kinds['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0),
                    zeros,
                    vector,
                    zeros,
                    vector,
                    zeros,
                )
                writer.write(topic, 10**9 + STEP_NS * k, store.serialize_ros1(message, IMU_TYPE))
        found.append(path.read_bytes())
    return found


def metadata_seeds(folder):
    """The metadata of an sqlite3 bag."""
    _bags(folder, 'bag', '.db3')
    return [(folder / 'bag' / 'metadata.yaml').read_bytes()]


def read_metadata(data, folder):
    """Read a bag with this metadata."""
    if not (folder / 'bag').exists():
        _bags(folder, 'bag', '.db3')
    (folder / 'bag' / 'metadata.yaml').write_bytes(data)
    read_bag(folder / 'bag')


def cdr_seeds(_folder):
    """One message of each type."""
    imu, joints, temperature = small_session(1)
    return [
        encode(samples)[0].tobytes()
        for encode, samples in (
            (encode_imu, imu),
            (encode_joints, joints),
            (encode_temperature, temperature),
        )
    ] + [data for _, _, data in _general_messages()]


def read_cdr(data, _folder):
    """Decode a message as every type, by layout and by definition."""
    for kind in (IMU_TYPE, JOINT_STATE_TYPE, TEMPERATURE_TYPE):
        for general in (None, _general(kind)):
            decoder = (
                JointDecoder(None, general) if kind == JOINT_STATE_TYPE else Decoder(kind, general)
            )
            decoder.decode(Packed.join([data, data]))
            decoder.decode(Packed.join([data, b'']), lambda: np.array([1, 2]))


@cache
def _general(kind):
    return deserializer(kind, {})


def definition_seeds(_folder):
    """The definitions of the types that are read."""
    return [
        standard_definition(kind).text.encode()
        for kind in (IMU_TYPE, JOINT_STATE_TYPE, TEMPERATURE_TYPE)
    ]


@cache
def _messages():
    return cdr_seeds(None)


def read_definition(data, _folder):
    """Decode messages by a definition."""
    text = data.decode(errors='replace')
    is_standard(IMU_TYPE, 'ros2msg', text)
    try:
        general = deserializer(IMU_TYPE, {IMU_TYPE: ('ros2msg', text)})
    except Exception:  # `Recording.deserializer` makes one line of each
        return
    Decoder(IMU_TYPE, general).decode(Packed.join(_messages()))


def accumulator_seeds(_folder):
    """A saved session of a table."""
    live = LiveCalibration(
        Table.from_mapping(yaml.safe_load((ROOT / 'config' / 'table_simulated.yaml').read_text()))
    )
    imu, joints, *_ = make_session(1, 25.0, seconds=60.0)
    live.push(SampleBlock(imu, joints, None))
    return [to_bytes(live.gathered(pending=True), live.model)]


def read_accumulator(data, _folder):
    """Read a saved session."""
    from_bytes(data)


def samples_seeds(_folder):
    """Saved samples of a session by hand."""
    store = HandStore(1000)
    store.add([(0, small_session()[0])])
    return [store.to_bytes()]


def csv_seeds(_folder):
    """Logs with commas and with semicolons."""
    rows = [(0.005 * k, 0.01, 0.02, 9.81 + 1e-3 * k, 0.1, 0.2, 0.3, 25.0) for k in range(40)]
    return [
        (
            delimiter.join(names)
            + '\n'
            + ''.join(delimiter.join(f'{value:.6g}' for value in row) + '\n' for row in rows)
        ).encode()
        for delimiter, names in (
            (
                ',',
                [
                    'time [s]',
                    *(f'acc_{a} [m/s^2]' for a in 'xyz'),
                    *(f'gyr_{a} [rad/s]' for a in 'xyz'),
                    'temperature [C]',
                ],
            ),
            (
                ';',
                [
                    'time [ms]',
                    *(f'acc_{a} [g]' for a in 'xyz'),
                    *(f'gyr_{a} [deg/s]' for a in 'xyz'),
                    'temperature [K]',
                ],
            ),
        )
    ]


def noise_seeds(_folder):
    """Noise of a record of 24 s at rest."""
    rng, n = np.random.default_rng(0), 1200
    readings = np.array([0.0, 0.0, 9.81, 0.0, 0.0, 0.0]) + rng.normal(
        0, [2e-3] * 3 + [1e-4] * 3, (n, 6)
    )
    imu = ImuSamples(
        10**9 + 20_000_000 * np.arange(n), readings[:, :3], readings[:, 3:], 'imu_link'
    )
    return [
        noise_to_text(figures_of(identify_noise([SampleBlock(imu, None, None)])), 3600.0).encode()
    ]


def calibration_seeds(_folder):
    """A plain calibration and one with further effects."""
    return [
        calibration_to_text(calibration).encode()
        for calibration in (
            IMU,
            random_calibration(1, ('accel_size_effect',), ('gyro_g_sensitivity',)),
        )
    ]


def read_calibration(data, _folder):
    """Read a calibration, and do with it what `compensator_node`, `compare` and `export` do."""
    calibration = calibration_from_text(data.decode(errors='replace'))
    CompensationStream(calibration)
    calibration_to_text(calibration)
    trust.caveats(calibration)
    parameter_count(calibration)
    for other in (calibration, IMU):
        with suppress(InputError):
            compare(calibration, other)
    with suppress(InputError):
        export(calibration, WRITERS[len(data) % len(WRITERS)], rate=200.0)
    if not list(trust.refused_sensors(calibration, live=True)):
        live = LiveCompensation(calibration, check_frame=False, correct_stamps=True)
        live.set_temperature(26.0)
        for message in _imu_messages():
            live(message)


@cache
def _imu_messages():
    return [row.tobytes() for row in encode_imu(small_session(5)[0])]


def read_noise(data, _folder):
    """Read noise.yaml, and compute what exports and nodes use of it."""
    figures = noise_from_text(data.decode(errors='replace'))
    counts(figures)
    rows(figures)
    noise_to_text(figures)


def _text_of(function):
    return lambda data, _folder: function(data.decode(errors='replace'))


def _import_reader(target):
    def seeds(_folder):
        content = export(IMU, target, rate=200.0).content
        return [content.encode() if isinstance(content, str) else content]

    return Reader(
        seeds,
        lambda data, folder: import_file(target, data, folder / 'absent', frame_id='imu_link'),
        text=target.name != 'mat',
    )


def _document_reader(seeds, read):
    return Reader(seeds, read, text=True, mutate=mutated_document)


def _attack(draw, read):
    return Reader(attacks.seeds_of(draw), read, mutate=attacks.mutation_of(draw), attack=True)


def list_imus(path):
    """List the Imu topics and frames of a recording as `inspect` does, and read it."""
    imu_topics_of(path, Topics())
    read_bag(path)


READINGS = (
    b'accelerometer: {unit: counts, scale: 415, offset: [1.0, 2.0, 3.0]}\n'
    b"gyroscope: {unit: 'counts:4770/(rad/s)', offset: 32000}\naxes: frd\n"
)
FLAT_READINGS = b'accelerometer_scale: 400.0\ngyroscope_offset: [1.0, 2.0, 3.0]\n'
EFFECTS = (
    b"effects:\n  mine: {sensor: accelerometer, column: 'f_x * abs(f_x)', unit: 's^2/m', tolerance:"
    b" 0.001, text: 'mine'}\n"
)
READERS = {
    'mcap': Reader(mcap_seeds, _file_reader('x.mcap', read_bag)),
    'sqlite3': Reader(
        lambda folder: [_bags(folder, 'bag', '.db3')], _file_reader('x.db3', read_bag)
    ),
    'ROS 1 bag': Reader(ros1_seeds, _file_reader('x.bag', read_bag)),
    'metadata': _document_reader(metadata_seeds, read_metadata),
    'CDR': Reader(cdr_seeds, read_cdr),
    'definition': Reader(definition_seeds, read_definition, text=True),
    'CSV': Reader(csv_seeds, _file_reader('x.csv', read_csv), text=True),
    'npz of a session': Reader(accumulator_seeds, read_accumulator, mutate=mutated_archive),
    'npz of samples': Reader(
        samples_seeds, lambda data, _folder: HandStore(1000).load(data), mutate=mutated_archive
    ),
    'URDF': Reader(
        lambda _folder: [SIX_AXES.encode()],
        _text_of(lambda text: (root_of(text), table_from_urdf(text, 'imu_link'))),
        text=True,
    ),
    'YAML of a table': _document_reader(
        lambda _folder: [
            re.sub(rb'(?m)^gravity:.*', b'gravity: 9.81', path.read_bytes())
            for path in sorted((ROOT / 'config').glob('table_*.yaml'))
        ],
        _text_of(lambda text: Table.from_mapping(from_text(text))),
    ),
    'YAML of a calibration': _document_reader(calibration_seeds, read_calibration),
    'YAML of noise': _document_reader(noise_seeds, read_noise),
    'YAML of effects': _document_reader(
        lambda _folder: [EFFECTS], _file_reader('x.yaml', files.read_effects)
    ),
    'YAML of readings': _document_reader(
        lambda _folder: [READINGS, FLAT_READINGS],
        _text_of(lambda text: RawReadings.from_mapping(from_text(text))),
    ),
    'YAML of tolerances': _document_reader(
        lambda _folder: [(ROOT / 'config' / 'tolerances.yaml').read_bytes()],
        _file_reader('x.yaml', files.read_tolerances),
    ),
    **{
        f'import from {target.name}': _import_reader(target)
        for target in all_targets().values()
        if target.read and target.write
    },
    'rows that share pages': _attack(attacks.draw_shared_pages, _file_reader('x.db3', read_bag)),
    'repeated index entries': _attack(attacks.draw_index_entries, _file_reader('x.bag', read_bag)),
    'overlapping chunks': _attack(
        attacks.draw_overlapping_chunks, _file_reader('x.mcap', read_bag)
    ),
    'thousands of Imu topics': _attack(attacks.draw_many_imus, _file_reader('x.mcap', list_imus)),
    'empty arrays in a session': _attack(attacks.draw_empty_arrays, read_accumulator),
    'long cells': _attack(attacks.draw_long_cells, _file_reader('x.csv', read_csv)),
    'own effects': _attack(attacks.draw_own_effects, read_calibration),
    'formulas in units.csv': _attack(attacks.draw_formula, attacks.read_name),
}
