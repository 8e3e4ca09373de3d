"""Accelerometer and gyroscope in logs of their own, or in rows of their own, and one alone."""

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.api.recordings import name_of
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.preprocessing.sensor_join import (
    SensorStream,
    finite_stream,
    gyroscope_delay,
    interpolated,
    join_sensors,
)
from msg_adapters.bag import open_recording
from msg_adapters.csv_log import read_csv, read_logs

from worlds.small_hand import ACCELEROMETER, GYROSCOPE, hand_motion

LATE = 0.021
"""s; stamps of the gyroscope minus the time of its readings."""
START_NS = 1_730_000_000_123_000_000


@pytest.fixture(scope='module')
def streams():
    """Accelerometer at 80 Hz and gyroscope at 128 Hz of one motion, with stamps that are late."""
    motion, generator = hand_motion(hz=640.0, n_poses=14, seed=51), np.random.default_rng(51)
    slow, fast = slice(None, None, 8), slice(None, None, 5)
    force = ACCELEROMETER.read(motion.force[slow], generator)
    rate = GYROSCOPE.read(motion.rate[fast], generator)
    stamps = START_NS + np.round(motion.time * 1e9).astype(np.int64)
    late = round(LATE * 1e9)
    return SensorStream(stamps[slow], force), SensorStream(stamps[fast] + late, rate)


def test_the_slower_stamps_are_kept_and_the_delay_is_estimated(streams):
    joined = join_sensors(*streams)
    assert joined.slower == 'accelerometer'
    assert set(joined.imu.stamp_ns) <= set(streams[0].stamp_ns)
    assert 0 < joined.delay.sd < 5e-3
    assert abs(joined.delay.delay - LATE) < 4 * joined.delay.sd
    # Exchanged names of the axes and another unit do not change a delay.
    turned = SensorStream(streams[1].stamp_ns, -57.3 * streams[1].values[:, [1, 0, 2]])
    assert gyroscope_delay(streams[0], turned).delay == pytest.approx(joined.delay.delay, abs=1e-4)


@pytest.mark.parametrize('late', [-2.4, 0.4, 1.3])
def test_a_delay_of_seconds_is_found_and_readings_of_another_motion_have_none(streams, late):
    """Logs whose sensors count from their own start."""
    moved = SensorStream(streams[1].stamp_ns + round((late - LATE) * 1e9), streams[1].values)
    found = gyroscope_delay(streams[0], moved)
    assert abs(found.delay - late) < 4 * found.sd < 0.02
    backwards = SensorStream(streams[1].stamp_ns, streams[1].values[::-1])
    assert gyroscope_delay(streams[0], backwards) is None
    # Among many delays one fits the few turns of another time.
    few = SensorStream(streams[0].stamp_ns[:1600], streams[0].values[:1600])
    rates = streams[1].values[2200:4760]
    assert gyroscope_delay(few, SensorStream(streams[1].stamp_ns[:2560], rates)) is None


def test_without_rotation_there_is_no_delay():
    generator, n = np.random.default_rng(52), 4000
    stamps = START_NS + np.arange(n) * 10_000_000
    force = np.array([0, 0, 9.8]) + 0.01 * generator.standard_normal((n, 3))
    rate = 0.001 * generator.standard_normal((n, 3))
    assert gyroscope_delay(SensorStream(stamps, force), SensorStream(stamps, rate)) is None


def test_nothing_is_interpolated_across_gaps_and_ends():
    stamps = np.array([0, 10, 20, 30, 130, 140, 150]) * 1_000_000
    values = np.outer(stamps * 1e-6, [1.0, 2.0, -1.0])
    wanted = np.array([-5, 5, 30, 80, 135, 151]) * 1_000_000
    found, known = interpolated(SensorStream(stamps, values), wanted)
    assert known.tolist() == [False, True, True, False, True, False]
    assert np.allclose(found[known], np.outer([5.0, 30.0, 135.0], [1.0, 2.0, -1.0]))


def test_streams_of_different_times_are_refused(streams):
    later = SensorStream(streams[1].stamp_ns + 10**12, streams[1].values)
    with refused(InputError, 'no_overlap', 0):
        join_sensors(streams[0], later)


def write(path, stream, header='time,z,y,x', scale=1.0):
    rows = [
        f'{stamp},' + ','.join(f'{value:.9f}' for value in scale * values[::-1])
        for stamp, values in zip(stream.stamp_ns, stream.values, strict=True)
    ]
    path.write_text('\n'.join([header, *rows]) + '\n')


@pytest.fixture(scope='module')
def folder(streams, tmp_path_factory):
    """The export of a phone: a file per sensor, with columns z, y, x."""
    path = tmp_path_factory.mktemp('phone')
    force, rate = streams
    write(path / 'TotalAcceleration.csv', force)
    write(path / 'Gyroscope.csv', rate)
    write(path / 'Magnetometer.csv', SensorStream(force.stamp_ns, 30 + 0 * force.values))
    linear = SensorStream(force.stamp_ns, force.values - [0.31, -0.12, 9.98] + 0 * force.values)
    write(path / 'Gravity.csv', SensorStream(force.stamp_ns, force.values - linear.values))
    # Without gravity, and with the unit in the header.
    header = 'time,z (m/s^2),y (m/s^2),x (m/s^2)'
    shaken = SensorStream(force.stamp_ns, 0.03 * force.values[:, ::-1])
    write(path / 'Linear Acceleration.csv', shaken, header)
    return path


def test_two_logs_and_a_folder_are_one_recording(folder, streams):
    pair = read_logs([folder / 'Gyroscope.csv', folder / 'TotalAcceleration.csv'])
    whole = read_logs([folder])
    assert np.array_equal(pair.imu.force_s, whole.imu.force_s)
    assert [each.quantity for each in pair.columns] == ['time', 'force', 'time', 'rate']
    # x, y, z by name, although the columns are z, y, x; stamps of 19 digits lose 256 ns
    at = np.searchsorted(streams[0].stamp_ns, pair.imu.stamp_ns[0] - 1000)
    assert np.allclose(pair.imu.force_s[0], streams[0].values[at], atol=1e-8)
    assert abs(pair.joined.delay.delay - LATE) < 4 * pair.joined.delay.sd


def test_convert_writes_them(folder, tmp_path, capsys):
    assert main(['convert', str(folder), '--output', str(tmp_path / 'bag')]) == 0
    assert f'{1e3 * read_logs([folder]).joined.delay.delay:.1f}' in capsys.readouterr().out
    with open_recording(tmp_path / 'bag', want_joints=False) as recording:
        samples = next(recording.blocks()).imu
    assert np.isfinite(samples.force_s).all() and np.isfinite(samples.rate_s).all()


def test_every_verb_reads_a_folder_of_logs_directly(folder, tmp_path):
    with open_recording(folder, want_joints=False) as recording:
        samples = next(recording.blocks()).imu
    whole = read_logs([folder]).imu
    assert samples.force_s == pytest.approx(whole.force_s[: len(samples)])
    assert samples.rate_s == pytest.approx(whole.rate_s[: len(samples)])
    assert main(['inspect', str(folder)]) != 1
    # A folder without any log is no recording.
    with pytest.raises(InputError):
        open_recording(tmp_path, want_joints=False)


def test_the_folder_may_be_the_working_directory(folder, tmp_path, monkeypatch):
    (folder / 'inner').mkdir()
    (tmp_path / 'link').symlink_to(folder)
    for place, path in ((folder, '.'), (folder / 'inner', '..'), (tmp_path, 'link/')):
        monkeypatch.chdir(place)
        with open_recording(path, want_joints=False) as recording:
            assert recording.message_counts[recording.imu_topic] > 1000
    monkeypatch.chdir(folder / 'inner')
    assert name_of('..') == folder.name


def test_the_overflow_of_a_counter_in_two_logs_is_undone(streams, tmp_path):
    """Stamps of 32 bits in microseconds; the readings after the overflow were left out."""
    overflow_us = 2**32
    start_us = overflow_us - 15_000_000
    paths = []
    for name, stream, head in (
        ('a.csv', streams[0], 'time (us),ax (m/s^2),ay (m/s^2),az (m/s^2)'),
        ('g.csv', streams[1], 'time (us),gx (rad/s),gy (rad/s),gz (rad/s)'),
    ):
        time_us = start_us + (stream.stamp_ns - START_NS) // 1000
        paths.append(tmp_path / name)
        write(paths[-1], SensorStream(time_us % overflow_us, stream.values[:, ::-1]), head)
    log = read_logs(paths)
    assert log.n_overflows == 2
    assert len(log.imu) > 0.95 * len(streams[0].stamp_ns)
    assert np.ptp(log.imu.stamp_ns) > 0.95 * np.ptp(streams[0].stamp_ns)


def test_two_logs_of_too_few_digits_are_refused(streams, tmp_path):
    paths = []
    for name, stream, unit in (('a', streams[0], 'm/s^2'), ('g', streams[1], 'rad/s')):
        head = 'time (s)' + ''.join(f',{name}{axis} ({unit})' for axis in 'xyz')
        paths.append(tmp_path / f'{name}.csv')
        write(paths[-1], SensorStream(0 * stream.stamp_ns + 1_730_000_000, stream.values), head)
    with refused(InputError, 'stamps_equal', len(streams[0].stamp_ns)):
        read_logs(paths)


def test_two_logs_of_one_sensor_are_refused(folder):
    with refused(InputError, 'several_logs', 'Gyroscope.csv'):
        read_logs([folder / 'Gyroscope.csv', folder / 'Gyroscope.csv'])


def test_a_table_with_empty_cells_is_read_as_two_streams(streams, tmp_path):
    rows = []
    for stream, empty in zip(streams, (('', ',,,'), (',,,', '')), strict=True):
        for stamp, values in zip(stream.stamp_ns, stream.values, strict=True):
            text = ','.join(f'{value:.9f}' for value in values)
            seconds = (stamp - START_NS) * 1e-9
            rows.append((seconds, f'{seconds:.6f},{empty[0]}{text}{empty[1]}'))
    path = tmp_path / 'joined.csv'
    lines = [text for _, text in sorted(rows)]
    path.write_text('\n'.join(['time (s),ax,ay,az,gx,gy,gz', *lines]) + '\n')
    log = read_csv(path)
    assert log.joined.slower == 'accelerometer'
    assert abs(log.joined.delay.delay - LATE) < 4 * log.joined.delay.sd
    assert np.isfinite(log.imu.rate_s).all()
    assert len(log.imu) > 0.95 * len(streams[0].stamp_ns)


def test_a_log_of_an_accelerometer_is_read_with_an_absent_gyroscope(streams, tmp_path):
    path = tmp_path / 'log.csv'
    seconds = SensorStream((streams[0].stamp_ns - START_NS) // 1000, streams[0].values / 9.80665)
    write(path, seconds, 'time (us),acc_z (g),acc_y (g),acc_x (g)')
    log = read_csv(path)
    assert np.isnan(log.imu.rate_s).all()
    assert np.allclose(log.imu.force_s, streams[0].values, atol=1e-7)
    with open_recording(path, want_joints=False) as recording:
        samples = next(recording.blocks()).imu
    assert np.isnan(samples.rate_s).all() and np.isfinite(samples.force_s).all()
    result = tmp_path / 'result'
    given = ['--gravity', '9.80665', '--output', str(result), '--no-report']
    assert main(['calibrate', str(path), *given]) == 0
    # Three further columns may be those of the gyroscope: they are not ignored without a word.
    wide = tmp_path / 'wide.csv'
    lines = path.read_text().splitlines()
    head = lines[0] + ',p,q,r'
    wide.write_text('\n'.join([head, *[line + ',1,2,3' for line in lines[1:]]]) + '\n')
    with pytest.raises(InputError, match='rate'):
        read_csv(wide)


def test_finite_streams_advance():
    stamps = np.array([3, 1, 2, 4, 4, 5])
    values = np.ones((6, 3))
    values[3] = np.nan
    found = finite_stream(stamps, values)
    assert found.stamp_ns.tolist() == [3, 4, 5]


@pytest.mark.parametrize('late_s', [0.0, 0.055, -0.035])
def test_a_late_gyroscope_of_one_stream_is_named_with_its_value(streams, late_s):
    """Both sensors in one message, by a driver that filters the rates longer or not at all."""
    accelerometer, gyroscope = streams
    shift = round((LATE - late_s) * 1e9)
    moved = SensorStream(gyroscope.stamp_ns - shift, gyroscope.values)
    imu = join_sensors(accelerometer, moved).imu
    found = calibrate_recordings(SampleBlock(imu), gravity=9.81, model_as_asked=True).calibration
    stored = found.statistics['gyroscope_delay']
    assert abs(stored['delay'] - late_s) < 4 * stored['sd'] + 1e-3
    named = [each['check'] for each in found.statistics['preflight']]
    assert ('gyroscope_delay' in named) == (late_s != 0.0)


OTHER_ROWS = [f'Magnetometer,{START_NS + k * 10**8},1,2,3' for k in range(20)]


def sensor_rows(streams, names, *, start_ns=0, unit_ns=1, force_scale=1.0, rate_scale=1.0):
    """Return rows NAME,time,x,y,z of both sensors in order of their names."""
    rows = []
    for name, stream, scale in zip(names, streams, (force_scale, rate_scale), strict=True):
        for stamp, values in zip(stream.stamp_ns, scale * stream.values, strict=True):
            numbers = ','.join(f'{value:.9f}' for value in values)
            rows.append(f'{name},{(stamp - start_ns) / unit_ns if start_ns else stamp},{numbers}')
    return rows


@pytest.mark.parametrize(
    ('names', 'header', 'options'),
    [
        (('Accelerometer', 'Gyroscope'), 'sensor,time,x,y,z', {}),
        # One unit in the header; the other sensor has another one, by its values.
        (('ACCE', 'GYRO'), 'type,time,x (m/s^2),y (m/s^2),z (m/s^2)', {'rate_scale': 180 / np.pi}),
        # Times since the start of the phone, both of which must keep their difference.
        (
            ('android.sensor.accelerometer', 'android.sensor.gyroscope'),
            'sensor,time (ms),X,Y,Z',
            {'start_ns': START_NS - 10**13, 'unit_ns': 10**6, 'force_scale': 1 / 9.80665},
        ),
    ],
)
def test_a_log_with_a_row_per_sensor_is_split_by_their_names(
    streams, tmp_path, names, header, options
):
    path = tmp_path / 'log.csv'
    rows = sensor_rows(streams, names, **options)
    path.write_text('\n'.join([header, *OTHER_ROWS * (not options), *rows]) + '\n')
    log = read_csv(path)
    assert len(log.row_names) == 2 and all(map(str.endswith, log.row_names, names))
    expected = join_sensors(*streams)
    assert len(log.imu) == len(expected.imu)
    np.testing.assert_allclose(log.imu.force_s, expected.imu.force_s, atol=1e-7)
    # Stamps of 19 digits lose 256 ns, in turns with up to 20 rad/s^2.
    np.testing.assert_allclose(log.imu.rate_s, expected.imu.rate_s, atol=1e-5)
    assert log.joined.delay.delay == pytest.approx(expected.delay.delay, abs=1e-6)
    with refused(InputError, 'sensor_rows'):
        read_csv(path, ['temperature=3:C'])


def test_names_of_sensors_decide_and_can_be_selected(streams, tmp_path):
    path = tmp_path / 'log.csv'
    names = ('acc', 'gyro left')
    rows = sensor_rows(streams, names)
    other = [row.replace('left', 'right') for row in rows if 'left' in row]
    path.write_text('\n'.join(['sensor,time,x,y,z', *rows, *other]) + '\n')
    with refused(InputError, 'sensor_rows', 'left', 'right'):
        read_csv(path)
    both = read_csv(path, where=['sensor=acc,gyro left'])
    assert np.isfinite(both.imu.rate_s).all()
    one = read_csv(path, where=['sensor=acc'])
    assert np.isnan(one.imu.rate_s).all() and len(one.imu) == len(streams[0].stamp_ns)
    # Numbers name no sensor, and columns without a header need a statement.
    path.write_text('\n'.join(['sensor,time,x,y,z', *(f'{len(row) % 2}{row[3:]}' for row in rows)]))
    with pytest.raises(InputError, match='x, y, z name no sensor'):
        read_csv(path)
    path.write_text('\n'.join(rows) + '\n')
    with refused(InputError, 'sensor_rows', '1=acc'):
        read_csv(path)
    stated = read_csv(path, ['time=2:ns', 'force=3,4,5:m/s^2', 'rate=3,4,5:rad/s'])
    np.testing.assert_array_equal(stated.imu.force_s, both.imu.force_s)


def test_two_logs_that_count_from_one_origin_keep_their_difference(streams, tmp_path):
    force, rate = streams
    rate = SensorStream(rate.stamp_ns[400:], rate.values[400:])  # it begins 3 s later
    for name, stream in (('acc', force), ('gyro', rate)):
        seconds = [f'{(stamp - START_NS) * 1e-9 + 77.0:.9f}' for stamp in stream.stamp_ns]
        lines = [
            ','.join([time, *(f'{value:.9f}' for value in values)])
            for time, values in zip(seconds, stream.values, strict=True)
        ]
        header = ','.join(['time (s)', *(f'{name}_{axis}' for axis in 'xyz')])
        (tmp_path / f'{name}.csv').write_text('\n'.join([header, *lines]) + '\n')
    joined = read_logs([tmp_path / 'acc.csv', tmp_path / 'gyro.csv']).joined
    expected = join_sensors(force, rate)
    assert len(joined.imu) == len(expected.imu)
    assert joined.delay.delay == pytest.approx(expected.delay.delay, abs=1e-5)
