"""Documents that were made to exhaust memory or time, or to deceive: one line and exit code 1."""

import csv
import os
import re
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from refusal import refused as expected

from imu_calibration.cli.fleet_run import csv_text, fleet_unit_rows
from imu_calibration.core.documents import from_text
from imu_calibration.core.errors import DocumentError, InputError
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.document.exports.export import export, find_target
from imu_calibration.document.files import make_folder, write_text
from imu_calibration.kinematics.urdf import root_of
from imu_calibration.references.gravity.sample_store import HandStore
from imu_calibration.references.turntable.collector import from_bytes
from imu_calibration.report.figures import draw
from msg_adapters.imu import IMU_TYPE

from worlds.compensation_cases import random_calibration
from worlds.limited import limited, refused, survived
from worlds.small_bags import hostile_calibration, write_small_bag

pytestmark = pytest.mark.live  # each input is read in a process with limits
LAID_OUT = True


@pytest.fixture
def bag(tmp_path):
    """A recording of a second."""
    return write_small_bag(tmp_path / 'bag')


def test_nested_powers_in_a_calibration_are_refused_before_they_are_multiplied_out(tmp_path, bag):
    """
    29 kB took all memory.

    Each level of abs(...)**9 multiplies the text of the compensation by nine.
    """
    (tmp_path / 'calibration.yaml').write_text(hostile_calibration())
    ended = refused(
        'compensate',
        bag,
        '--calibration',
        tmp_path / 'calibration.yaml',
        '--output',
        tmp_path / 'corrected',
    )
    assert '5000' in ended.err and not (tmp_path / 'corrected').exists()


# Places


def test_a_pipe_as_calibration_is_refused_and_not_waited_for(tmp_path, bag):
    os.mkfifo(tmp_path / 'calibration.yaml')
    for path in (tmp_path / 'calibration.yaml', '/dev/zero'):
        ended = refused(
            'compensate', bag, '--calibration', path, '--output', tmp_path / 'corrected'
        )
        assert str(path) in ended.err and not (tmp_path / 'corrected').exists()


def test_a_saved_session_that_grows_a_hundredfold_is_refused():
    """Less than 1 MB becomes 134 MB."""
    for load in (load_accumulator, load_samples):
        ended = limited(load)
        assert ended.code == 'refused' and ended.megabytes < 50, ended


def load_accumulator():
    """Load zeros in place of an accumulator."""
    return _refusal(from_bytes, ('counts', 'header'))


def load_samples():
    """Load zeros in place of samples."""
    return _refusal(HandStore(1000).load, ('stamp_ns', 'force_s', 'rate_s', 'frame_id', 'format'))


def _refusal(load, names):
    """Load an archive of empty arrays and, last, the zeros: what is read first of it."""
    import io

    target = io.BytesIO()
    head = io.BytesIO()
    np.save(head, np.zeros(0))
    with zipfile.ZipFile(target, 'w', zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in names[:-1]:
            archive.writestr(f'{name}.npy', head.getvalue())
        with archive.open(f'{names[-1]}.npy', 'w') as member:
            member.write(head.getvalue().replace(b'(0,)', b'(%d,)' % (1 << 24)))
            for _ in range(1 << 4):
                member.write(bytes(8 << 20))
    try:
        load(target.getvalue())
    except DocumentError as error:
        # With the bytes that are needed, more than those of the file.
        numbers = [int(number) for number in re.findall(r'\d+', str(error))]
        return 'refused' if max(numbers) > 1 << 27 else str(error)


@pytest.mark.parametrize('damage', [b'', b'PK', b'(' * 5000])
def test_damaged_sessions_are_one_line(damage):
    import io

    target = io.BytesIO()
    with zipfile.ZipFile(target, 'w') as archive:
        archive.writestr(
            'header.npy', b'\x93NUMPY\1\0' + len(damage).to_bytes(2, 'little') + damage
        )
    for data in (damage, target.getvalue()):
        with pytest.raises(DocumentError):
            from_bytes(data)


def test_a_link_under_a_guessable_name_is_not_followed(tmp_path):
    """In a shared folder anybody can place a link under the name of a temporary file."""
    import zlib

    victim = tmp_path / 'victim'
    victim.write_text('untouched')
    for name in (f'.{os.getpid()}.{zlib.crc32(b"result.yaml"):08x}', f'.write_test_{os.getpid()}'):
        os.symlink(victim, tmp_path / name)
    write_text(tmp_path / 'result.yaml', 'new')
    make_folder(tmp_path)
    assert victim.read_text() == 'untouched' and (tmp_path / 'result.yaml').read_text() == 'new'
    mask = os.umask(0o022)
    os.umask(mask)
    assert (tmp_path / 'result.yaml').stat().st_mode & 0o777 == 0o666 & ~mask


# Names


def test_a_name_is_neither_a_formula_nor_mathematics(tmp_path):
    def paint(figure):
        figure.add_subplot().set_title('$\\bad{$')

    assert 'bad' in draw('x', (2, 2), paint, label='x')
    result = UnitResult('=cmd|calc!A1')
    assert (
        list(csv.reader(csv_text(fleet_unit_rows([result])).splitlines()))[1][0] == "'=cmd|calc!A1"
    )


class UnitResult:
    """A unit that was refused."""

    calibration, verdict, verdicts, exit_code, error = (
        None,
        '',
        {'accelerometer': '', 'gyroscope': ''},
        1,
        'refused',
    )

    def __init__(self, name):
        self.name = name


def test_saved_samples_of_another_shape_are_refused():
    import io

    good = {
        'format': np.array('imu_calibration/hand_samples/1'),
        'frame_id': np.array('imu'),
        'stamp_ns': np.arange(4),
        'force_s': np.ones((4, 3)),
        'rate_s': np.ones((4, 3)),
    }
    for change in (
        {},
        {'stamp_ns': np.array(1)},
        {'force_s': np.ones((4, 2))},
        {'rate_s': np.ones((5, 3))},
        {'force_s': np.ones((4, 3), int)},
    ):
        target = io.BytesIO()
        np.savez(target, **good | change)
        if change:
            with expected(DocumentError, 'samples_damaged'):
                HandStore(1000).load(target.getvalue())
        else:
            HandStore(1000).load(target.getvalue())


# Text that breaks its parser


def test_damaged_files_of_other_programs_are_one_line(tmp_path):
    """A byte more in a struct of a .mat file ended the process by a segmentation fault in scipy."""
    content = export(random_calibration(0, ()), find_target('mat')).content
    at = content.index(b'\x10\0\0\0\x14\0\0\0accelerometer.bias.x')
    (tmp_path / 'x.mat').write_bytes(content[:at] + b'\0' + content[at:])
    refused('import', tmp_path / 'x.mat', '--from', 'mat', '--output', tmp_path / 'out.yaml')
    text = export(random_calibration(0, ()), find_target('autoware'), rate=200.0).content.decode()
    for value in ('0.9{', '.', '1e999'):
        (tmp_path / 'x.yaml').write_text(re.sub(r'\{x: [^,]*', '{x: ' + value, text))
        refused(
            'import', tmp_path / 'x.yaml', '--from', 'autoware', '--output', tmp_path / 'out.yaml'
        )


def test_deep_and_long_texts_are_one_line(tmp_path, bag):
    (tmp_path / 'deep.json').write_text('[' * 100_000)
    refused('import', tmp_path / 'deep.json', '--from', 'basalt', '--output', tmp_path / 'out.yaml')
    (tmp_path / 'digits.json').write_text(
        '{"value0": {"calib_accel_bias": [' + '9' * 4000 + ', 0, 0]}}'
    )
    refused(
        'import', tmp_path / 'digits.json', '--from', 'basalt', '--output', tmp_path / 'out.yaml'
    )
    (tmp_path / 'table.yaml').write_text(
        'joints: [{name: outer, axis: [0, 0, 1]}]\ngravity: ' + '9' * 4000
    )
    assert 'digits' in refused(
        'calibrate', bag, '--table', tmp_path / 'table.yaml', '--output', tmp_path / 'out'
    ).err.replace('characters', 'digits')
    (tmp_path / 'arm.urdf').write_text(
        '<robot name="x"><joint name="j" type="fixed">'
        + '<origin>' * 5000
        + '</origin>' * 5000
        + '</joint></robot>'
    )
    refused('plan', '--urdf', tmp_path / 'arm.urdf', '--output', tmp_path / 'out')


@pytest.mark.parametrize(
    'text',
    [
        '',
        '<robot>',
        '<robot/>',
        '<robot name="a"><link name="x&#10;&#27;[2J"/></robot>',
        'x' * 3_000_000,
        '<robot name="a"><joint name="j" type="fixed">'
        + '<origin>' * 256
        + '</origin>' * 256
        + '</joint></robot>',
    ],
)
def test_descriptions_are_refused_or_have_clean_names(text):
    try:
        assert root_of(text).isprintable()
    except InputError as error:
        assert '\n' not in str(error)


def test_a_damaged_description_in_a_recording_is_left_out(tmp_path):
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = [
            writer.add_connection(topic, kind, typestore=store)
            for topic, kind in (
                ('/imu/data_raw', IMU_TYPE),
                ('/robot_description', 'std_msgs/msg/String'),
                ('/tf_static', 'tf2_msgs/msg/TFMessage'),
            )
        ]
        for topic in topics[1:]:
            for data in (
                b'',
                b'\0\1',
                b'\0\1\0\0\xff\xff\xff\x7f',
                b'\0\1\0\0\xff\xff\xff\xff' + b'x' * 99,
            ):
                writer.write(topic, 1, data)
    refused('calibrate', tmp_path / 'bag', '--imu-link', 'imu_link', '--output', tmp_path / 'out')
    assert (
        '/robot_description' in refused('inspect', tmp_path / 'bag', '--imu-link', 'imu_link').err
    )


@pytest.mark.parametrize(
    'language, change',
    [
        ('ros2msg', lambda text: text.replace('float64', 'string')),
        ('ros2msg', lambda text: text.replace('float64 x', 'float64[3] x')),
        ('ros2msg', lambda text: text.replace('int32 sec', 'float64 sec')),
        ('ros2msg', lambda text: 'int32 x\n'),
        ('ros2msg', lambda text: text + '\n@!'),
        ('ros2idl', lambda text: text),
        (
            'ros2idl',
            lambda text: 'module sensor_msgs { module msg { struct Imu { double x; }; }; };',
        ),
        ('x', lambda text: text),
    ],
)
def test_definitions_of_another_kind_are_one_line(tmp_path, language, change):
    """An IDL definition ended `inspect` with KeyError 'imu'."""
    import sqlite3

    bag = write_small_bag(tmp_path / 'bag')
    connection = sqlite3.connect(bag / 'bag_0.db3')
    for number, text in connection.execute(
        'SELECT id, encoded_message_definition FROM message_definitions'
    ).fetchall():
        connection.execute(
            'UPDATE message_definitions SET encoding = ?, encoded_message_definition = ? WHERE'
            ' id = ?',
            (language, change(text), number),
        )
    connection.commit()
    connection.close()
    survived('inspect', bag)


@pytest.mark.parametrize(
    'text, code, values',
    [
        ('a: 1\nb: 2\na: 3\n', 'key_repeated', ['a', 'line 3']),
        ('x: {a: 1, a: 2}', 'key_repeated', ['line 1']),
        ('- a\n', 'not_a_mapping', ['list']),
        ('<<: {a: 1}', 'key_repeated', ['<<', 'line 1']),
    ],
)
def test_a_repeated_key_is_an_error(text, code, values):
    with expected(InputError, code, *values):
        from_text(text)
    assert from_text(
        'a: {a: 1}\nb: [{a: 1}, {a: 2}]\n? [1]\n: a'.replace('? [1]\n: a', 'c: a')
    ) == {'a': {'a': 1}, 'b': [{'a': 1}, {'a': 2}], 'c': 'a'}


# Ends


def compensate_on_a_small_disk(arguments):
    """Run a verb that cannot write more than 20 kB into a file."""
    import resource

    from imu_calibration.cli.main import main

    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
    return main(arguments)


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path, storage):
    bag = write_small_bag(tmp_path / 'bag', storage=storage)
    write_text(tmp_path / 'calibration.yaml', calibration_to_text(random_calibration(0, ())))
    before = sorted(path.name for path in tmp_path.iterdir())
    for arguments in (
        ['compensate', str(bag), '--calibration', str(tmp_path / 'calibration.yaml'), '--anyway'],
        ['simulate'],
    ):
        ended = limited(compensate_on_a_small_disk, [*arguments, '--output', str(tmp_path / 'out')])
        assert ended.code == 1 and ended.err.count('\n') == 1, ended
        assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_what_was_decompressed_is_removed_on_sigterm(tmp_path):
    from msg_adapters.compression import zstd

    bag, temporary = write_small_bag(tmp_path / 'bag'), tmp_path / 'temporary'
    temporary.mkdir()
    database = next(bag.glob('*.db3'))
    Path(f'{database}.zstd').write_bytes(zstd().compress(database.read_bytes()))
    database.unlink()
    (bag / 'metadata.yaml').unlink()
    program = (
        'import time, msg_adapters.sqlite_file as f\nold = f.SqliteFile.count\nf.SqliteFile.count'
        ' = lambda self: (print("decompressed", flush=True),'
        ' [time.sleep(0.1) for _ in range(600)], old(self))[2]\nimport'
        ' sys\nfrom imu_calibration.__main__ import main\nsys.argv[1:] = ["inspect",'
        f' {str(bag)!r}]\nraise SystemExit(main())'
    )
    process = subprocess.Popen(
        [sys.executable, '-c', program],
        env={**os.environ, 'TMPDIR': str(temporary)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == 'decompressed\n' and list(
        temporary.glob('imu_calibration_*/*')
    )
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert process.returncode not in (0, -signal.SIGTERM) and 'Traceback' not in err
    assert not list(temporary.iterdir())
