"""Text logs as programs and devices write them: decorated lines, names, stamps and ticks."""

import numpy as np
import pytest
from refusal import refused

from imu_calibration.core.errors import InputError
from msg_adapters.csv_lines import ECHO_NAMES
from msg_adapters.csv_log import read_csv

from worlds.physics_hand import hold_and_turn

RATE = 80.0
G = 9.80665


@pytest.fixture(scope='module')
def motion():
    """Time (s), force (m/s^2) and rate (rad/s) of holds and turns."""
    imu, _, _ = hold_and_turn(4, rate_hz=RATE, n_poses=10)
    time = np.arange(len(imu)) / RATE
    return time, imu.force_s, imu.rate_s


def rows(*columns, mark=','):
    return [mark.join(map(str, row)) for row in zip(*columns, strict=True)]


def readings(force, rate, mark=','):
    return rows(*np.round(force, 6).T, *np.round(rate, 7).T, mark=mark)


def written(path, *lines):
    path.write_text('\n'.join(lines) + '\n', encoding='utf-8')
    return path


def assert_read(log, motion):
    time, force, rate = motion
    read = (log.imu.stamp_ns - log.imu.stamp_ns[0]) * 1e-9
    np.testing.assert_allclose(read, time, atol=1.1e-3)
    np.testing.assert_allclose(log.imu.force_s, force, atol=1e-2)
    np.testing.assert_allclose(log.imu.rate_s, rate, atol=1e-3)


def clock(time, form):
    """Times of day from 22:59:58."""
    whole = np.floor(time + 1e-9).astype(int) + 22 * 3600 + 59 * 60 + 58
    milliseconds = np.round((time - np.floor(time + 1e-9)) * 1e3).astype(int)
    texts = []
    for second, ms in zip(whole, milliseconds, strict=True):
        hour, minute = second // 3600, second // 60 % 60
        part = f'{hour:02}:{minute:02}:{second % 60:02}'
        if form == 'half day':
            texts.append(f'{hour % 12:02}:{part[3:]}.{ms:03} PM')
        elif form == 'colon':
            texts.append(f'{part}:{ms:03}')
        else:
            texts.append(f'{part}.{ms:03}')
    return texts


def test_the_clock_of_a_serial_monitor_is_the_time(tmp_path, motion):
    time, force, rate = motion
    lines = [f'{c} -> {row}' for c, row in zip(clock(time, ''), readings(force, rate), strict=True)]
    path = written(tmp_path / 'monitor.txt', '22:59:57.990 -> ax,ay,az,gx,gy,gz', *lines)
    assert_read(read_csv(path), motion)


def test_labelled_numbers_have_a_header(tmp_path, motion):
    time, force, rate = motion
    labels = ['millis', 'ax', 'ay', 'az', 'gx', 'gy', 'gz']
    lines = ['MPU found']
    for ms, row in zip(np.round(time * 1e3).astype(int), readings(force, rate), strict=True):
        cells = zip(labels, [str(ms), *row.split(',')], strict=True)
        lines.append('\t'.join(f'{label}:{cell}' for label, cell in cells))
    assert_read(read_csv(written(tmp_path / 'plotter.txt', *lines)), motion)


@pytest.mark.parametrize('form', ['half day', 'colon'])
def test_times_of_day_of_spreadsheets_and_phones(tmp_path, motion, form):
    time, force, rate = motion
    lines = [
        f'{c},{row}' for c, row in zip(clock(time, form), readings(force / G, rate), strict=True)
    ]
    path = written(tmp_path / 'phone.csv', 'time,gFx,gFy,gFz,wx,wy,wz', *lines)
    log = read_csv(path)
    assert_read(log, motion)
    assert log.columns[1].unit == 'g'


def test_the_output_of_ros2_topic_echo_has_no_header(tmp_path, motion):
    time, force, rate = motion
    stamp_ns = 1_771_000_000_000_000_000 + np.round(time * 1e9).astype(np.int64)
    zero = np.zeros((9, len(time)))
    lines = rows(
        stamp_ns // 10**9,
        stamp_ns % 10**9,
        ['imu'] * len(time),
        *zero[:4],
        *zero,
        *np.round(rate, 7).T,
        *zero,
        *np.round(force, 6).T,
        *zero,
    )
    log = read_csv(written(tmp_path / 'echo.csv', *lines))
    assert_read(log, motion)
    assert log.imu.stamp_ns[0] == stamp_ns[0]
    assert log.columns[0].names == ECHO_NAMES[:2]


@pytest.mark.parametrize(
    ('names', 'units'),
    [
        ('xacc,yacc,zacc,xgyro,ygyro,zgyro', ''),
        ('xAccel [g],yAccel [g],zAccel [g],xAngRate [deg/s],yAngRate [deg/s],zAngRate [deg/s]', ''),
        ('x-axis (g),y-axis (g),z-axis (g),x-axis (deg/s),y-axis (deg/s),z-axis (deg/s)', ''),
        ('lin_acc_x,lin_acc_y,lin_acc_z,ang_vel_x,ang_vel_y,ang_vel_z', ''),
        ('x_accl_out,y_accl_out,z_accl_out,x_gyro_out,y_gyro_out,z_gyro_out', ''),
        (
            'Shimmer_B_Accel_LN_X_CAL,Shimmer_B_Accel_LN_Y_CAL,Shimmer_B_Accel_LN_Z_CAL,'
            'Shimmer_B_Gyro_X_CAL,Shimmer_B_Gyro_Y_CAL,Shimmer_B_Gyro_Z_CAL',
            'ms,m/(s^2),m/(s^2),m/(s^2),deg/s,deg/s,deg/s',
        ),
    ],
)
def test_names_of_devices(tmp_path, motion, names, units):
    time, force, rate = motion
    if '[g]' in names or '(g)' in names:
        force = force / G
    if 'deg/s' in names + units:
        rate = np.degrees(rate)
    lines = [f'{ms},{row}' for ms, row in zip(time * 1e3, readings(force, rate), strict=True)]
    header = [f'timestamp,{names}']
    if units:
        header.append(units)
    assert_read(read_csv(written(tmp_path / 'device.csv', *header, *lines)), motion)


def test_a_header_may_have_numbers_and_is_repeated(tmp_path, motion):
    time, force, rate = motion
    lines = [f'{t:.4f},{row},1,2,3' for t, row in zip(time, readings(force, rate), strict=True)]
    header = 'time,ax,ay,az,gx,gy,gz,1,2,3'
    log = read_csv(written(tmp_path / 'again.csv', header, *lines[:70], header, *lines[70:]))
    assert_read(log, motion)
    assert log.n_dropped == 1


TICKS = [('39.0625us', 39.0625e-6), ('1/32768s', 1 / 32768), ('25us', 25e-6), ('100us', 1e-4)]


@pytest.mark.parametrize(('tick', 'size'), TICKS)
def test_ticks_read_as_a_unit_of_time_are_refused_and_read_when_stated(
    tmp_path, motion, tick, size
):
    time, force, rate = motion
    counter = np.round(time / size).astype(int)
    lines = [
        f'{count},{row}'
        for count, row in zip(counter, readings(force, np.degrees(rate)), strict=True)
    ]
    header = 'timestamp,ax,ay,az,' + ','.join(f'g{axis} (deg/s)' for axis in 'xyz')
    path = written(tmp_path / 'ticks.csv', header, *lines)
    with refused(InputError, 'time_ticks', 'time=timestamp:', tick) as caught:
        read_csv(path)
    assert caught.value.key == 'columns'
    assert_read(read_csv(path, [f'time=timestamp:{tick}']), motion)


def test_a_counter_of_ticks_that_overflows_is_undone(tmp_path, motion):
    time, force, rate = motion
    counter = (np.round(time / 39.0625e-6).astype(int) + 2**24 - 150_000) % 2**24
    lines = [f'{count},{row}' for count, row in zip(counter, readings(force, rate), strict=True)]
    path = written(tmp_path / 'sensortime.csv', 'sensortime,ax,ay,az,gx,gy,gz', *lines)
    log = read_csv(path, ['time=sensortime:39.0625us', 'rate=gx,gy,gz:rad/s'])
    assert_read(log, motion)
    assert log.n_overflows == 1


@pytest.mark.parametrize(('size', 'unit'), [(1e-4, '100us'), (1e-6, 'us')])
def test_sample_time_fine_has_ticks_of_the_device(tmp_path, motion, size, unit):
    time, force, rate = motion
    counter = np.round(time / size).astype(int)
    lines = [
        f'{count}\t{row}' for count, row in zip(counter, readings(force, rate, '\t'), strict=True)
    ]
    header = 'SampleTimeFine\tAcc_X\tAcc_Y\tAcc_Z\tGyr_X\tGyr_Y\tGyr_Z'
    log = read_csv(written(tmp_path / 'mti.txt', '// Update Rate: 80.0Hz', header, *lines))
    assert_read(log, motion)
    assert log.columns[0].unit == unit


@pytest.mark.parametrize('unit', ['0us', '1/0s', '5parsec', 'us25'])
def test_other_units_of_time_are_refused(tmp_path, motion, unit):
    time, force, rate = motion
    lines = [f'{t:.4f},{row}' for t, row in zip(time, readings(force, rate), strict=True)]
    path = written(tmp_path / 'log.csv', 'time,ax,ay,az,gx,gy,gz', *lines)
    with pytest.raises(InputError) as caught:
        read_csv(path, [f'time=time:{unit}'])
    assert caught.value.key == 'columns'


@pytest.mark.parametrize('header', ['', 'day,clock,aX,aY,aZ,gX,gY,gZ'])
def test_a_date_and_a_time_of_day_by_number_are_the_time(tmp_path, motion, header):
    time, force, rate = motion
    in_mg = readings(-1e3 * force / G, np.degrees(rate))
    lines = [f'31.12.2024,{c},{row}' for c, row in zip(clock(time, ''), in_mg, strict=True)]
    path = written(tmp_path / 'card.csv', 'card ready', *([header] if header else []), *lines)
    columns = ['time=1,2', 'force=-3,-4,-5:mg', 'rate=6,7,8:deg/s']
    log = read_csv(path, columns)
    assert_read(log, motion)
    assert log.unused == ('day' if header else '1',)
