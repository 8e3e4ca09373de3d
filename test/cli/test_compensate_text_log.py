"""``imu_calibration compensate`` from a text log to a text log."""

import json

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.compensate import compensate_recording
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.core.units import DEG, STANDARD_GRAVITY
from imu_calibration.document.calibration_text import calibration_to_text
from msg_adapters.bag import open_recording
from msg_adapters.csv_log import read_csv, read_logs
from msg_adapters.write import write_session

from worlds.compensation_cases import random_calibration

N, RATE = 1500, 50.0


@pytest.fixture
def calibration(tmp_path):
    """Biases and matrices of an IMU, written as calibration.yaml."""
    found = random_calibration(5, (), (), sd=1e-5)
    (tmp_path / 'calibration.yaml').write_text(calibration_to_text(found))
    return found


def readings():
    """Time (s), force (m/s^2) and rate (rad/s) of quarter turns with rests between."""
    rng = np.random.default_rng(59)
    time = np.arange(N) / RATE
    angle = np.interp(time, np.arange(0.0, 31.0, 1.5), [0.0, *np.tile([0.0, 1.6, 1.6, 0.0], 5)])
    force = 9.8 * np.column_stack([np.sin(angle), np.zeros(N), np.cos(angle)])
    rate = np.zeros((N, 3))
    rate[:, 1] = -np.gradient(angle, time)
    return time, force + rng.normal(0, 0.01, (N, 3)), rate + rng.normal(0, 1e-3, (N, 3))


def clock(time):
    """Times of day, past midnight."""
    seconds = (86_397.0 + time) % 86_400
    return [f'{s // 3600:02.0f}:{s % 3600 // 60:02.0f}:{s % 60:06.3f}' for s in seconds.tolist()]


def comma(text):
    return text.replace('.', ',')


MS2, RADS = 'm/s^2 corrected', 'rad/s corrected'
CASES = {
    # name -> header, delimiter, time, unit of force and of rate, header that is expected
    'si without units': (
        't,ax,ay,az,note,gx,gy,gz',
        ',',
        (1.0, 1.0),
        f't (s),ax ({MS2}),ay ({MS2}),az ({MS2}),note,gx ({RADS}),gy ({RADS}),gz ({RADS})',
    ),
    'g and deg/s': (
        'millis;ax_g;ay_g;az_g;note;gx_dps;gy_dps;gz_dps',
        ';',
        (STANDARD_GRAVITY, DEG),
        f'millis;ax ({MS2});ay ({MS2});az ({MS2});note;gx ({RADS});gy ({RADS});gz ({RADS})',
    ),
    'time of day': (
        'Time\tAccel[0]\tAccel[1]\tAccel[2]\tnote\tGyro[0]\tGyro[1]\tGyro[2]',
        '\t',
        (1.0, 1.0),
        f'Time\tAccel ({MS2})[0]\tAccel ({MS2})[1]\tAccel ({MS2})[2]\tnote'
        f'\tGyro ({RADS})[0]\tGyro ({RADS})[1]\tGyro ({RADS})[2]',
    ),
}


def write_log(path, name):
    """Write a log of `CASES`; return the cells of time."""
    header, delimiter, sizes, _ = CASES[name]
    time, force, rate = readings()
    stamps = [f'{s:.2f}' for s in time]
    if header.startswith('millis'):
        stamps = [f'{1e3 * s:.0f}' for s in time]
    elif header.startswith('Time'):
        stamps = clock(time)
    lines = ['device: 7', header]
    for k in range(N):
        numbers = [f'{v:.9f}' for v in (*force[k] / sizes[0], *rate[k] / sizes[1])]
        if delimiter == ';':
            numbers = [comma(number) for number in numbers]
        lines.append(delimiter.join([stamps[k], *numbers[:3], f'n{k % 7}', *numbers[3:]]))
    path.write_text('\n'.join(lines) + '\n')
    return stamps


@pytest.mark.parametrize('name', CASES)
def test_a_text_log_gives_a_text_log(name, calibration, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    log, out = tmp_path / 'log.csv', tmp_path / 'new/corrected.csv'
    stamps = write_log(log, name)
    delimiter, expected_header = CASES[name][1], CASES[name][3]
    verb = ['compensate', 'log.csv', '--calibration', 'calibration.yaml']
    code = main([*verb, '--output', str(out), '--json'])
    result = json.loads(capsys.readouterr().out)
    assert result['result']['count'] == N and result['result']['topic'] == ''

    # Columns, time and other cells as they were, units in the header.
    header, *rows = out.read_text().splitlines()
    assert header == expected_header
    cells = [row.split(delimiter) for row in rows]
    assert [row[0] for row in cells] == stamps
    assert [row[4] for row in cells] == [f'n{k % 7}' for k in range(N)]

    # The readings are those that are corrected in memory, and a bag has the same exit code.
    read = read_csv(out)
    expected = compensate_recording(read_csv(log).imu, calibration).imu
    np.testing.assert_allclose(read.imu.force_s, expected.force_s, atol=1e-7)
    np.testing.assert_allclose(read.imu.rate_s, expected.rate_s, atol=1e-8)
    assert np.abs(read.imu.force_s - read_csv(log).imu.force_s).max() > 0.01
    assert main([*verb, '--output', 'bag']) == code


def test_columns_by_number_give_the_same_columns(calibration, tmp_path, monkeypatch):
    """A log without a header, with a date and a time of day."""
    monkeypatch.chdir(tmp_path)
    time, force, rate = readings()
    stamps = clock(time)
    numbers = np.column_stack([force / STANDARD_GRAVITY * 1e3, rate / DEG]).tolist()
    rows = [f'03/04/2025,{t},' + ','.join(map(str, v)) for t, v in zip(stamps, numbers)]
    (tmp_path / 'log.csv').write_text('logger on\n' + '\n'.join(rows))
    stated = ['--columns', 'time=1,2', 'force=3,4,5:mg', 'rate=6,7,8:deg/s']
    verb = ['compensate', 'log.csv', '--calibration', 'calibration.yaml', '--output', 'out.csv']
    assert main([*verb, *stated]) == 0
    expected = compensate_recording(read_csv('log.csv', stated[1:]).imu, calibration).imu
    written = [line.split(',') for line in (tmp_path / 'out.csv').read_text().splitlines()[1:]]
    assert [row[1] for row in written] == stamps
    np.testing.assert_allclose(np.array(written)[:, 2:5].astype(float), expected.force_s, atol=1e-7)
    np.testing.assert_allclose(np.array(written)[:, 5:8].astype(float), expected.rate_s, atol=1e-8)
    # The unit of the force is stated once; a bag has no columns.
    with refused(InputError, 'unit_twice', 'mg'):
        compensate_recording(
            'log.csv', calibration, columns=stated[1:], accelerometer_unit='g', output='other.csv'
        )
    write_session('bag', read_csv('log.csv', stated[1:]).imu)
    with refused(InputError, 'columns', 'time=1,2'):
        compensate_recording('bag', calibration, columns=stated[1:])


@pytest.mark.parametrize('fast', ['accelerometer', 'gyroscope'])
def test_a_folder_of_logs_gives_one_log(fast, calibration, tmp_path, monkeypatch):
    """The rows are those of the slower sensor; the output may be in the folder."""
    monkeypatch.chdir(tmp_path)
    time, force, rate = readings()
    for name, values in (('Accelerometer', force), ('Gyroscope', rate)):
        step = 1 if name.lower() == fast else 2
        columns = np.column_stack([1e3 * time, values[:, ::-1]])[::step]
        np.savetxt(f'{name}.csv', columns, delimiter=',', header='t_ms,z,y,x', comments='')
    expected = compensate_recording(read_logs(['.']).imu, calibration).imu
    verb = ['compensate', '.', '--calibration', 'calibration.yaml', '--output', 'corrected.csv']
    assert main(verb) == 0
    read = read_csv('corrected.csv').imu
    assert len(read) == len(time) // 2
    np.testing.assert_array_equal(np.diff(read.stamp_ns), np.diff(expected.stamp_ns))
    np.testing.assert_allclose(read.force_s, expected.force_s, atol=1e-7)
    np.testing.assert_allclose(read.rate_s, expected.rate_s, atol=1e-8)
    assert len(read_logs(['.']).imu) == len(read)


def test_readings_in_the_unit_of_the_calibration_become_si(tmp_path, monkeypatch):
    """Counts that calibration.yaml describes."""
    monkeypatch.chdir(tmp_path)
    found = random_calibration(5, (), (), sd=1e-5)
    text = calibration_to_text(found)
    (tmp_path / 'calibration.yaml').write_text(text)
    time, force, rate = readings()
    columns = np.column_stack([time, force / STANDARD_GRAVITY * 2048, rate])
    np.savetxt('log.csv', columns, delimiter=',', header='t,ax,ay,az,gx,gy,gz', comments='')
    verb = ['compensate', 'log.csv', '--calibration', 'calibration.yaml', '--output', 'out.csv']
    main([*verb, '--accelerometer-unit', 'counts:2048/g'])
    expected = compensate_recording(
        read_csv('log.csv', ['force=ax,ay,az:counts:2048/g']).imu, found
    ).imu
    np.testing.assert_allclose(read_csv('out.csv').imu.force_s, expected.force_s, atol=1e-6)


def test_rows_of_one_sensor_each_are_joined(calibration, tmp_path, monkeypatch):
    """A table with empty cells: the rows of the slower sensor get readings of both."""
    monkeypatch.chdir(tmp_path)
    time, force, rate = readings()
    lines = ['t,ax,ay,az,gx,gy,gz']
    for k in range(N):
        if k % 2 == 0:
            lines.append(','.join([f'{time[k]:.3f}', *(f'{v:.9f}' for v in force[k]), '', '', '']))
        lines.append(
            ','.join([f'{time[k] + 0.003:.3f}', '', '', '', *(f'{v:.9f}' for v in rate[k])])
        )
    (tmp_path / 'log.csv').write_text('\n'.join(lines))
    verb = ['compensate', 'log.csv', '--calibration', 'calibration.yaml', '--output', 'out.csv']
    assert main(verb) in (0, 3)
    log, read = read_csv('log.csv'), read_csv('out.csv')
    expected = compensate_recording(log.imu, calibration).imu
    assert log.joined.slower == 'accelerometer' and len(read.imu) == len(log.imu)
    np.testing.assert_array_equal(np.diff(read.imu.stamp_ns), np.diff(log.imu.stamp_ns))
    np.testing.assert_allclose(read.imu.rate_s, expected.rate_s, atol=1e-8)


@pytest.mark.parametrize(
    ('case', 'code'),
    [('bag', 'output_kind'), ('exists', 'exists_already'), ('force unit', 'force_unit')],
)
def test_refusals_write_nothing(case, code, calibration, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_log(tmp_path / 'log.csv', 'si without units')
    source, options = 'log.csv', []
    if case == 'bag':
        write_session('bag', read_csv('log.csv').imu)
        source = 'bag'
    elif case == 'exists':
        (tmp_path / 'out.csv').write_text('mine')
    else:
        options = ['--accelerometer-unit', 'g']
    before = sorted(path.name for path in tmp_path.iterdir())
    verb = ['compensate', source, '--calibration', 'calibration.yaml', '--output', 'out.csv']
    assert main([*verb, *options, '--json']) == 1
    assert json.loads(capsys.readouterr().out)['error']['code'] == code
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    assert case != 'exists' or (tmp_path / 'out.csv').read_text() == 'mine'


def test_a_corrected_log_is_not_corrected_again(tmp_path, calibration):
    write_log(tmp_path / 'log.csv', next(iter(CASES)))
    first, second = tmp_path / 'first.csv', tmp_path / 'second.csv'
    compensate_recording(tmp_path / 'log.csv', calibration, output=first)
    for output in (second, tmp_path / 'bag', None):
        with refused(InputError, 'corrected_already'):
            compensate_recording(first, calibration, output=output)
    assert not second.exists() and not (tmp_path / 'bag').exists()
    # Other verbs read it: the word after the unit changes nothing.
    assert [each.unit for each in read_csv(first).columns[1:3]] == ['m/s^2', 'rad/s']


def test_excluded_times_have_no_corrected_readings(tmp_path, calibration):
    write_log(tmp_path / 'log.csv', next(iter(CASES)))
    whole = compensate_recording(tmp_path / 'log.csv', calibration).imu
    seconds = (whole.stamp_ns - whole.stamp_ns[0]) * 1e-9
    inside = (seconds >= 1.0) & (seconds < 2.5)
    output = tmp_path / 'part.csv'
    compensate_recording(tmp_path / 'log.csv', calibration, output=output, exclude='1:2.5')
    empty = np.array([line.count(',,') >= 2 for line in output.read_text().splitlines()[1:]])
    assert np.array_equal(empty, inside)
    bag = tmp_path / 'bag'
    compensate_recording(tmp_path / 'log.csv', calibration, output=bag, exclude='1:2.5')
    with open_recording(bag, '/imu/data_corrected', want_joints=False) as recording:
        stamps = np.concatenate([block.imu.stamp_ns for block in recording.blocks() if block.imu])
    assert np.array_equal(stamps, whole.stamp_ns[~inside])
    with refused(InputError, 'exclude_outside'):
        compensate_recording(tmp_path / 'log.csv', calibration, exclude='900:901')


@pytest.mark.parametrize('corrected_name', ['Accelerometer', 'Gyroscope'])
def test_a_corrected_log_of_one_sensor_in_a_folder_is_found(tmp_path, calibration, corrected_name):
    """The export of a phone in which one of two logs was corrected by itself."""
    time, force, rate = readings()
    folder = tmp_path / 'export'
    (tmp_path / 'raw').mkdir()
    folder.mkdir()
    for name, values, unit in (('Accelerometer', force, 'm/s^2'), ('Gyroscope', rate, 'rad/s')):
        columns = np.column_stack([1e3 * time, values])
        header = f't_ms,x ({unit}),y ({unit}),z ({unit})'
        for place in (tmp_path / 'raw', folder):
            path = place / f'{name}.csv'
            np.savetxt(path, columns, delimiter=',', header=header, comments='')
    (folder / 'Annotation.csv').write_text('time,text\n1,start\n')
    (folder / f'{corrected_name}.csv').unlink()
    raw_log = tmp_path / f'raw/{corrected_name}.csv'
    compensate_recording(raw_log, calibration, output=folder / f'{corrected_name}.csv')
    for output in (tmp_path / 'again.csv', tmp_path / 'bag', None):
        with refused(InputError, 'corrected_already', f'{corrected_name}.csv'):
            compensate_recording(folder, calibration, output=output)
    assert not (tmp_path / 'again.csv').exists() and not (tmp_path / 'bag').exists()
