"""
Text logs: columns and units from header and values, and refusals.

A log, its bag and arrays give the same result.
"""

import gzip

import numpy as np
import pytest
from refusal import refused

import imu_calibration
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.core.units import DEG, STANDARD_GRAVITY
from msg_adapters import csv_log
from msg_adapters.bag import open_recording
from msg_adapters.csv_log import read_csv

from worlds.hand_sessions import simulate

PLAIN = 'time,ax,ay,az,gx,gy,gz'


@pytest.fixture(scope='module')
def imu():
    """A session by hand at 50 Hz."""
    return simulate(3)[0]


def write(path, header, *columns, delimiter=','):
    """Write columns as text."""
    np.savetxt(
        path, np.column_stack(columns), delimiter=delimiter, header=header, comments='', fmt='%.12g'
    )
    return path


def seconds(imu):
    """Time since the first sample, s."""
    return (imu.stamp_ns - imu.stamp_ns[0]) * 1e-9


def assert_read(log, imu):
    """The samples are those that were written."""
    read = log.imu
    np.testing.assert_allclose(
        read.stamp_ns - read.stamp_ns[0], imu.stamp_ns - imu.stamp_ns[0], atol=1e3
    )
    np.testing.assert_allclose(read.force_s, imu.force_s, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(read.rate_s, imu.rate_s, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    'name', ('imu{}_a{}', 'a{1}{0}', 'acc{}_{}', 'sensor_{}_accel_{}', 'a{1}_{0}')
)
def test_numbered_columns_of_two_imus_are_named(tmp_path, name):
    sets = [[name.format(number, axis) for axis in 'xyz'] for number in (1, 2)]
    rows = np.random.default_rng(8112).normal(0.0, 0.1, (50, 6)) + [0, 0, 9.8, 0, 0, 9.8]
    lines = [','.join(['time', *sets[0], *sets[1], 'wx', 'wy', 'wz'])]
    for k, row in enumerate(rows):
        lines.append(','.join(map(str, [0.01 * k, *row, 0.1, 0.2, -0.1])))
    path = tmp_path / 'log.csv'
    path.write_text('\n'.join(lines))
    with refused(InputError, 'several_sets', ', '.join(sets[0]), ', '.join(sets[1])) as caught:
        read_csv(path)
    assert caught.value.key == 'columns'
    # One of the sets is read.
    columns = [f'force={",".join(sets[1])}:m/s^2', 'rate=wx,wy,wz:rad/s']
    assert read_csv(path, columns).imu.force_s == pytest.approx(rows[:, 3:])


@pytest.mark.parametrize(
    ('force_size', 'force_unit'),
    [(1.0, 'm/s^2'), (STANDARD_GRAVITY, 'g'), (1e-3 * STANDARD_GRAVITY, 'mg')],
)
@pytest.mark.parametrize(
    ('rate_size', 'rate_unit'), [(1.0, 'rad/s'), (DEG, 'deg/s'), (1e-3 * DEG, 'mdeg/s')]
)
@pytest.mark.parametrize(
    ('time_size', 'time_unit'), [(1.0, 's'), (1e-3, 'ms'), (1e-6, 'us'), (1e-9, 'ns')]
)
def test_units_follow_from_the_values(
    tmp_path, imu, force_size, force_unit, rate_size, rate_unit, time_size, time_unit
):
    log = read_csv(
        write(
            tmp_path / 'log.csv',
            PLAIN,
            seconds(imu) / time_size,
            imu.force_s / force_size,
            imu.rate_s / rate_size,
        )
    )
    assert [(each.quantity, each.unit, each.origin) for each in log.columns] == [
        ('time', time_unit, 'values'),
        ('force', force_unit, 'values'),
        ('rate', rate_unit, 'values'),
    ]
    assert_read(log, imu)


@pytest.mark.parametrize(
    ('header', 'force_size', 'rate_size', 'time_size', 'delimiter'),
    [
        (
            'Timestamp (ms);AccX [g];AccY [g];AccZ [g];GyroX [deg/s];GyroY [deg/s];GyroZ [deg/s]',
            STANDARD_GRAVITY,
            DEG,
            1e-3,
            ';',
        ),
        (
            (
                'loggingTime(s),accelerometerAccelerationX(G),accelerometerAccelerationY(G),accelerometerAccelerationZ(G),gyroRotationX(rad/s),'
                'gyroRotationY(rad/s),gyroRotationZ(rad/s)'
            ),
            STANDARD_GRAVITY,
            1.0,
            1.0,
            ',',
        ),
        (
            (
                '__time\t/imu/linear_acceleration/x\t/imu/linear_acceleration/y\t/imu/linear_acceleration/z\t/imu/angular_velocity/x\t'
                '/imu/angular_velocity/y\t/imu/angular_velocity/z'
            ),
            1.0,
            1.0,
            1.0,
            '\t',
        ),
        (
            '# t_us acc_x_mg acc_y_mg acc_z_mg gyro_x_dps gyro_y_dps gyro_z_dps',
            1e-3 * STANDARD_GRAVITY,
            DEG,
            1e-6,
            ' ',
        ),
        (
            'Time since start in ms ,X_accel,Y_accel,Z_accel,X_gyro,Y_gyro,Z_gyro',
            1.0,
            1.0,
            1e-3,
            ',',
        ),
    ],
    ids=['brackets', 'camel case', 'paths', 'suffixes', 'axis first'],
)
def test_headers_name_columns_and_units(
    tmp_path, imu, header, force_size, rate_size, time_size, delimiter
):
    path = write(
        tmp_path / 'log.csv',
        header,
        seconds(imu) / time_size,
        imu.force_s / force_size,
        imu.rate_s / rate_size,
        delimiter=delimiter,
    )
    assert_read(read_csv(path), imu)


def test_columns_in_another_order_with_rate_first_and_a_row_of_units(tmp_path, imu):
    header = (
        'timestamp,w_RS_S_x,w_RS_S_y,w_RS_S_z,a_RS_S_x,a_RS_S_y,a_RS_S_z,temp\nns,rad s^-1,rad'
        ' s^-1,rad s^-1,m s^-2,m s^-2,m s^-2,C'
    )
    log = read_csv(
        write(
            tmp_path / 'log.csv',
            header,
            imu.stamp_ns,
            imu.rate_s,
            imu.force_s,
            np.full(len(imu), 31.5),
        )
    )
    assert_read(log, imu)
    assert np.all(log.temperature.temperature_c == 31.5)


def test_dates_and_decimal_commas_and_empty_cells(tmp_path, imu):
    stamps = np.datetime_as_string(
        (imu.stamp_ns // 1000 * 1000).astype('datetime64[ns]'), unit='us'
    )
    rows = [
        ';'.join([stamp.replace('T', ' '), *(f'{value:.12g}'.replace('.', ',') for value in row)])
        for stamp, row in zip(stamps, np.column_stack([imu.force_s, imu.rate_s]).tolist())
    ]
    rows[5] = ';'.join([rows[5].split(';')[0], '', *rows[5].split(';')[2:]])
    (tmp_path / 'log.csv').write_text('\n'.join([PLAIN.replace(',', ';'), *rows]))
    read = read_csv(tmp_path / 'log.csv').imu
    np.testing.assert_allclose(read.stamp_ns, imu.stamp_ns, atol=1000)
    assert np.isnan(read.force_s[5]).tolist() == [True, False, False]
    np.testing.assert_allclose(read.force_s[6:], imu.force_s[6:], rtol=1e-9)


def test_given_columns_replace_the_guess(tmp_path, imu):
    path = write(
        tmp_path / 'log.csv',
        'when,p,q,r,gx,gy,gz,enc',
        seconds(imu),
        -imu.force_s,
        imu.rate_s,
        np.full(len(imu), 90.0),
    )
    log = read_csv(path, ['time=when:s', 'force=-2,-q,-r', 'joint.shaft=enc:deg'])
    assert_read(log, imu)
    assert log.joints.names == ('shaft',)
    np.testing.assert_allclose(log.joints.position, np.pi / 2)


@pytest.mark.parametrize(
    ('header', 'columns', 'words'),
    [
        ('foo,ax,ay,az,gx,gy,gz', [], ('time',)),
        (PLAIN, ['force=ax,ay'], ("'force=ax,ay'",)),
        (PLAIN, ['force=ax,ay,az:ft/s^2'], ("'ft/s^2'",)),
        (PLAIN, ['force=ax,ay,up'], ("'up'",)),
    ],
)
def test_what_is_missing_or_wrong_is_refused(tmp_path, imu, header, columns, words):
    path = write(tmp_path / 'log.csv', header, seconds(imu), imu.force_s, imu.rate_s)
    with pytest.raises(InputError) as error:
        read_csv(path, columns)
    assert all(word in str(error.value) for word in words) and '\n' not in str(error.value)


def test_two_accelerometers_and_a_rate_without_turns_are_ambiguous(tmp_path, imu):
    two = write(
        tmp_path / 'two.csv',
        PLAIN + ',acc_x,acc_y,acc_z',
        seconds(imu),
        imu.force_s,
        imu.rate_s,
        imu.force_s,
    )
    still = write(
        tmp_path / 'still.csv',
        PLAIN,
        seconds(imu),
        np.tile([0, 0, 9.81], (len(imu), 1)),
        np.full((len(imu), 3), 0.01),
    )
    for path in (two, still):
        with pytest.raises(InputError):
            open_recording(path)
    assert read_csv(still, ['rate=gx,gy,gz:deg/s']).imu.rate_s[0, 0] == pytest.approx(0.01 * DEG)


@pytest.mark.parametrize(
    'content', [b'', b'\x00\x01\x02' * 50, b'one\ntwo\nthree\n', b'time,ax,ay,az,gx,gy,gz\n']
)
def test_files_that_are_no_logs_end_with_one_line(tmp_path, capsys, content):
    (tmp_path / 'log.csv').write_bytes(content)
    assert main(['inspect', str(tmp_path / 'log.csv')]) == 1
    assert capsys.readouterr().err.count('\n') == 1


def test_verbs_read_logs_and_convert_writes_the_same_bag(tmp_path, imu, capsys):
    path = write(tmp_path / 'log.csv', PLAIN, seconds(imu), imu.force_s, imu.rate_s)
    assert main(['convert', str(path), '--output', str(tmp_path / 'bag')]) == 0
    assert 'ax,ay,az' in capsys.readouterr().out
    from_log = imu_calibration.calibrate(
        path, gravity=STANDARD_GRAVITY, model_as_asked=True
    ).calibration
    from_bag = imu_calibration.calibrate(
        tmp_path / 'bag', gravity=STANDARD_GRAVITY, model_as_asked=True
    ).calibration
    from_arrays = imu_calibration.calibrate(
        time=seconds(imu),
        force=imu.force_s,
        rate=imu.rate_s,
        gravity=STANDARD_GRAVITY,
        model_as_asked=True,
    ).calibration
    for other in (from_bag, from_arrays):
        np.testing.assert_allclose(other.values, from_log.values, rtol=1e-6, atol=1e-9)


def test_arrays_of_other_shapes_are_refused():
    with pytest.raises(InputError):
        SampleBlock.from_arrays(np.arange(5.0), np.zeros((4, 3)), np.zeros((5, 3)))
    with pytest.raises(InputError):
        imu_calibration.calibrate(time=np.arange(5.0))


def test_an_unchanged_log_is_converted_once_and_its_bag_removed_with_its_last_user(
    tmp_path, imu, monkeypatch
):
    path = write(tmp_path / 'log.csv', PLAIN, seconds(imu), imu.force_s, imu.rate_s)
    reads = []
    monkeypatch.setattr(
        csv_log,
        'read_csv',
        lambda path, *given, **named: reads.append(path) or read_csv(path, *given, **named),
    )
    imu_calibration.calibrate(path, gravity=STANDARD_GRAVITY, model_as_asked=True)
    assert len(reads) == 1
    bag = csv_log._converted(
        path, path.stat().st_mtime_ns, path.stat().st_size, csv_log.LogOptions()
    ).bag
    assert bag.exists()
    csv_log._converted.cache_clear()
    assert not bag.exists()


@pytest.mark.parametrize('time', [(5, ''), ('', 5), (5, 1e300)])
def test_a_row_without_seconds_or_nanoseconds_is_refused_with_their_number(tmp_path, time):
    lines = [
        'header.stamp.secs,header.stamp.nsecs,ax [g],ay [g],az [g],gx [deg/s],gy [deg/s],gz [deg/s]'
    ]
    for k in range(400):
        seconds, nanoseconds = time if k == 200 else (1 + k // 100, 10_000_000 * (k % 100))
        lines.append(f'{seconds},{nanoseconds},0,0,1,0,0,0')
    path = tmp_path / 'two.csv'
    path.write_text('\n'.join(lines) + '\n')
    with refused(InputError, 'csv_time', 'got 1 '):
        read_csv(path)


@pytest.mark.parametrize('number', ['1e300', '1e10', 'nan', ''])
def test_times_beyond_64_bits_are_refused_without_a_warning(tmp_path, number):
    rows = [(0.005 * k, 0.0, 0.0, 9.81, 1e308, 0.0, 0.0) for k in range(40)]
    lines = [','.join(map(str, row)) for row in rows] + [f'{number},0,0,9.81,0,0,0', 'short']
    (tmp_path / 'x.csv').write_text(
        '\n'.join(['time [s],ax [g],ay [g],az [g],gx [deg/s],gy [deg/s],gz [deg/s]', *lines]) + '\n'
    )
    with refused(InputError, 'csv_time', '4e+09', 1):
        read_csv(tmp_path / 'x.csv')


def two_instances(path, imu):
    """Write the readings of two IMUs in alternation, with a column of the instance."""
    second = np.array([0.3, -0.2, 0.15]), np.array([0.02, -0.01, 0.015])
    with path.open('w') as file:
        file.write('time,unit,ax,ay,az,gx,gy,gz\n')
        for stamp, force, rate in zip(seconds(imu), imu.force_s, imu.rate_s):
            for unit, added in (('3', 0), ('7', 1)):
                cells = [stamp, unit, *(force + added * second[0]), *(rate + added * second[1])]
                file.write(','.join(str(cell) for cell in cells) + '\n')
    return path


def test_one_of_two_instances_is_selected(tmp_path, imu):
    path = two_instances(tmp_path / 'two.csv', imu)
    with refused(InputError, 'one_source', '50 %'):
        read_csv(path)
    assert_read(read_csv(path, where=['unit=3']), imu)
    other = read_csv(path, where=['unit=7.0']).imu
    np.testing.assert_allclose(
        other.force_s - imu.force_s, np.tile([0.3, -0.2, 0.15], (len(imu), 1))
    )
    with refused(InputError, 'where', 'unit=5', '3, 7'):
        read_csv(path, where=['unit=5'])
    with refused(InputError, 'where', "'unit'"):
        read_csv(path, where=['unit'])
    arguments = ['convert', str(path), '--output', str(tmp_path / 'bag')]
    assert main(arguments) == 1 and not (tmp_path / 'bag').exists()
    assert main([*arguments, '--where', 'unit=7']) == 0
    with open_recording(tmp_path / 'bag', want_joints=False) as recording:
        assert recording.message_counts[recording.imu_topic] == len(imu)


def clock_text(time_s, start_s=86_390.0):
    """Return times of day with three decimals; midnight is 10 s after the start."""
    texts = []
    for time in np.round(time_s + start_s, 3):
        minutes, seconds = divmod(time % 86_400, 60)
        texts.append(f'{int(minutes) // 60:02d}:{int(minutes) % 60:02d}:{seconds:06.3f}')
    return texts


def test_times_of_day_pass_midnight(tmp_path, imu):
    lines = ['recorder started', 'tag:,left', 'rtcDate,rtcTime,aX,aY,aZ,gX,gY,gZ,']
    for clock, force, rate in zip(clock_text(seconds(imu)), imu.force_s, imu.rate_s):
        cells = ['02/28/2021', clock, *force.astype(str), *rate.astype(str)]
        lines.append(','.join(cells) + ',')
    path = tmp_path / 'clock.csv'
    path.write_text('\n'.join(lines) + '\n')
    log = read_csv(path)
    assert log.imu.stamp_ns[0] == 86_390 * 10**9
    np.testing.assert_allclose(np.diff(log.imu.stamp_ns), np.diff(imu.stamp_ns), atol=1.1e6)
    np.testing.assert_allclose(log.imu.force_s, imu.force_s)
    assert log.unused == ('rtcDate',)


@pytest.mark.parametrize(
    'header',
    [
        'Zeit [s],ax,ay,az,gx,gy,gz',
        'since_boot_timestamp (s),a_x_raw,a_y_raw,a_z_raw,g_x_raw,g_y_raw,g_z_raw',
        'TimeStartup (s),UncompAccX,UncompAccY,UncompAccZ,UncompGyroX,UncompGyroY,UncompGyroZ',
    ],
)
@pytest.mark.parametrize('encoding', ['utf-8', 'utf-16'])
def test_names_and_encodings_of_other_programs(tmp_path, imu, header, encoding):
    path = write(tmp_path / 'log.csv', header, seconds(imu), imu.force_s, imu.rate_s)
    path.write_bytes(path.read_text().encode(encoding))
    assert_read(read_csv(path), imu)


def test_a_date_with_the_day_first_is_read_as_the_time_of_day(tmp_path, imu):
    """The only column with times of day is the time, whatever its name is."""
    lines = ['Aufnahme;ax;ay;az;gx;gy;gz']
    for clock, force, rate in zip(clock_text(seconds(imu)), imu.force_s, imu.rate_s):
        day = '28.02.2021' if clock.startswith('23') else '01.03.2021'
        lines.append(';'.join([f'{day} {clock}', *force.astype(str), *rate.astype(str)]))
    path = tmp_path / 'clock.csv'
    path.write_text('\n'.join(lines) + '\n')
    log = read_csv(path)
    assert log.imu.stamp_ns[0] == 86_390 * 10**9
    np.testing.assert_allclose(np.diff(log.imu.stamp_ns), np.diff(imu.stamp_ns), atol=1.1e6)


def test_dates_with_a_zone_after_a_space(tmp_path, imu):
    lines = ['time,ax,ay,az,gx,gy,gz']
    start = np.datetime64('2024-05-06T07:08:09', 'ns')
    for time_ns, force, rate in zip(imu.stamp_ns - imu.stamp_ns[0], imu.force_s, imu.rate_s):
        date = str(start + np.timedelta64(int(time_ns), 'ns')).replace('T', ' ') + ' +0200'
        lines.append(','.join([date, *force.astype(str), *rate.astype(str)]))
    path = tmp_path / 'zone.csv'
    path.write_text('\n'.join(lines) + '\n')
    assert_read(read_csv(path), imu)


def test_a_compressed_log_is_named(tmp_path, imu):
    path = write(tmp_path / 'log.csv', PLAIN, seconds(imu), imu.force_s, imu.rate_s)
    path.write_bytes(gzip.compress(path.read_bytes()))
    with refused(InputError, 'csv_compressed', 'gzip'):
        read_csv(path)


@pytest.mark.parametrize('name', ['imu{}_linear_acceleration_{}', 'imu{}.linear_acceleration.{}'])
def test_columns_of_two_imus_are_never_mixed(tmp_path, imu, name):
    """Numbers in names distinguish sensors; before, the last one was read without a word."""
    names = ['time']
    for k in (1, 2):
        names += [name.format(k, axis) for axis in 'xyz']
    rates = ['gx', 'gy', 'gz']
    header = ','.join([*names, *rates])
    path = write(
        tmp_path / 'two.csv', header, seconds(imu), imu.force_s, imu.force_s + 0.4, imu.rate_s
    )
    with pytest.raises(InputError) as caught:
        read_csv(path)
    assert caught.value.key == 'columns' and names[1] in str(caught.value)
    log = read_csv(
        path, ['time=time:s', f'force={",".join(names[4:7])}:m/s^2', 'rate=gx,gy,gz:rad/s']
    )
    np.testing.assert_allclose(log.imu.force_s, imu.force_s + 0.4, atol=1e-8)


@pytest.mark.parametrize('delimiter', [';', '\t'])
def test_decimal_commas(tmp_path, imu, delimiter):
    rows = np.column_stack([seconds(imu), imu.force_s, imu.rate_s])
    rows[0] = np.round(rows[0])  # the first row has no decimals
    lines = [PLAIN.replace(',', delimiter)]
    for row in rows:
        lines.append(delimiter.join(f'{cell:.12g}' for cell in row).replace('.', ','))
    path = tmp_path / 'comma.csv'
    path.write_text('\n'.join(lines) + '\n')
    np.testing.assert_allclose(read_csv(path).imu.force_s, rows[:, 1:4], atol=1e-9)


@pytest.mark.parametrize(
    ('header', 'units'),
    [
        ('millis,ax_g,ay_g,az_g,gx_dps,gy_dps,gz_dps', ('ms', 'g', 'deg/s')),
        ('micros,AcX,AcY,AcZ,GyX,GyY,GyZ', ('us', 'mg', 'deg/s')),
        (
            'timestamp,accelerometer_m_s2[0],accelerometer_m_s2[1],accelerometer_m_s2[2],'
            'gyro_rad[0],gyro_rad[1],gyro_rad[2]',
            ('us', 'm/s^2', 'rad/s'),
        ),
        (
            'time (us),accSmooth[0],accSmooth[1],accSmooth[2],gyroADC[0],gyroADC[1],gyroADC[2]',
            ('us', 'g', 'deg/s'),
        ),
        ('SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z', ('us', 'm/s^2', 'deg/s')),
    ],
)
def test_names_of_common_loggers(tmp_path, imu, header, units):
    sizes = [csv_log.COLUMN_UNITS[q][u] for q, u in zip(('time', 'force', 'rate'), units)]
    path = write(
        tmp_path / 'log.csv',
        header,
        seconds(imu) / sizes[0],
        imu.force_s / sizes[1],
        imu.rate_s / sizes[2],
    )
    log = read_csv(path)
    assert tuple(columns.unit for columns in log.columns) == units
    np.testing.assert_allclose(log.imu.force_s, imu.force_s, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(log.imu.rate_s, imu.rate_s, rtol=1e-9, atol=1e-9)


def test_an_unknown_format_of_time_is_named(tmp_path, imu):
    path = tmp_path / 'day.csv'
    lines = [PLAIN]
    for force, rate in zip(imu.force_s[:50], imu.rate_s[:50]):
        lines.append(','.join(['noon+1', *force.astype(str), *rate.astype(str)]))
    path.write_text('\n'.join(lines) + '\n')
    with refused(InputError, 'csv_format', 'noon+1'):
        read_csv(path, ['time=time:s'])


def test_dropped_lines_are_counted(tmp_path, imu, capsys):
    path = write(tmp_path / 'log.csv', PLAIN, seconds(imu), imu.force_s, imu.rate_s)
    lines = path.read_text().splitlines()
    lines[10] = lines[10][:12]
    lines[20] = 'restarted'
    path.write_text('\n'.join(lines) + '\n')
    log = read_csv(path)
    assert (log.n_dropped, len(log.imu)) == (2, len(imu) - 2)
    assert main(['convert', str(path), '--output', str(tmp_path / 'bag')]) == 0
    assert 'dropped: 2' in capsys.readouterr().out


def test_the_guess_is_printed_when_a_log_is_read_directly(tmp_path, imu, capsys):
    path = write(tmp_path / 'guess.csv', PLAIN, seconds(imu), imu.force_s, imu.rate_s)
    main(['inspect', str(path)])
    printed = capsys.readouterr().err.replace('\n', ' ')
    for columns in read_csv(path).columns:
        assert str(columns) in printed


def dated(tmp_path, imu, *, bad=(), day='2024-05-06'):
    """Write a log with dates; the rows `bad` have a date that no calendar has."""
    lines = [PLAIN]
    for k, (force, rate) in enumerate(zip(imu.force_s[:400], imu.rate_s[:400])):
        date = f'{day}T10:{k // 3000:02d}:{(k / 50) % 60:09.6f}'
        if k in bad:
            date = date.replace('-05-', '-13-')
        lines.append(','.join([date, *force.astype(str), *rate.astype(str)]))
    path = tmp_path / 'dated.csv'
    path.write_text('\n'.join(lines) + '\n')
    return path


def test_a_bad_date_is_refused_in_one_line(tmp_path, imu):
    units = ['force=ax,ay,az:m/s^2', 'rate=gx,gy,gz:rad/s']
    assert len(read_csv(dated(tmp_path, imu), units).imu) == 400
    with refused(InputError, 'csv_time', 'got 2 '):
        read_csv(dated(tmp_path, imu, bad=(7, 9)), units)


def test_a_cell_beyond_the_limit_of_csv_is_refused_in_one_line(tmp_path, imu):
    path = dated(tmp_path, imu)
    path.write_text(path.read_text() + '"' + 'x' * 140_000 + '",1,2,3,4,5,6\n')
    with refused(InputError, 'csv_cell', '131072'):
        read_csv(path, ['force=ax,ay,az:m/s^2', 'rate=gx,gy,gz:rad/s'])


def test_a_long_name_of_a_column_is_refused(tmp_path, imu):
    path = write(tmp_path / 'x.csv', f'{PLAIN},{"(" * 300}', seconds(imu), imu.force_s, imu.rate_s)
    path.write_text(path.read_text().replace('\n', ',0\n')[: 1 << 15])
    path.write_text(path.read_text().replace(f'{"(" * 300},0\n', f'{"(" * 300}\n'))
    with refused(InputError, 'csv_header', '300'):
        read_csv(path)


@pytest.mark.parametrize(
    ('name', 'unit'),
    [
        ('temp', 'values'),
        ('Temperature', 'values'),
        ('imu_temp', 'values'),
        ('gyroTemp', 'values'),
        ('TempC', 'header'),
        ('tempDegC', 'header'),
        ('T_degC', 'header'),
        ('T (°C)', 'header'),
        ('T [degC]', 'header'),
        ('imu_temperature_celsius', 'header'),
        ('temp_deg_c', 'header'),
        ('Temp (F)', None),
        ('temp_raw', None),
        ('T [K]', None),
    ],
)
def test_names_of_temperature_columns(name, unit, tmp_path, imu):
    """The time remains the time; other units are not read as degrees Celsius."""
    degrees = 20 + 0.1 * seconds(imu)
    path = tmp_path / 'log.csv'
    np.savetxt(
        path,
        np.column_stack([degrees, seconds(imu), imu.force_s, imu.rate_s]),
        delimiter=',',
        header=f'{name},{PLAIN}',
        comments='',
        encoding='utf-8',
    )
    log = read_csv(path)
    assert_read(log, imu)
    if unit is None:
        assert log.temperature is None and log.unused == (name,)
        return
    np.testing.assert_allclose(log.temperature.temperature_c, degrees, atol=1e-9)
    (column,) = [each for each in log.columns if each.quantity == 'temperature']
    assert (column.names, column.unit, column.origin) == ((name,), 'C', unit)
