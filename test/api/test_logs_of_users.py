"""
Text logs as loggers, phones and autopilots write them: the readings are those that were measured.

The log of an autopilot in forward-right-down axes is also calibrated and exported.
"""

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.api.compensate import compensate_recording
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.document.exports.export import export, find_target
from msg_adapters.csv_log import read_csv

from worlds.compensation_cases import random_calibration
from worlds.small_hand import ACCELEROMETER, GRAVITY, GYROSCOPE, hand_motion

G0 = 9.80665


@pytest.fixture(scope='module')
def readings():
    """Time in s, specific force and rates of a session at 50 Hz."""
    motion, generator = hand_motion(hz=50.0, n_poses=12, seed=93), np.random.default_rng(93)
    force = ACCELEROMETER.read(motion.force, generator)
    return motion.time, force, GYROSCOPE.read(motion.rate, generator)


def numbers(values):
    """Return a column as text with nine decimals."""
    return [f'{value:.9f}' for value in values]


def affine(calibration, sensor):
    """Return bias and matrix of a sensor."""
    bias = calibration.values[calibration.model.slices[sensor, 'bias']]
    matrix = calibration.values[calibration.model.slices[sensor, 'matrix']]
    return bias, matrix.reshape(3, 3)


def whole(values):
    """Return a column as text without decimals."""
    return [str(round(value)) for value in values]


def axes(values, text=numbers):
    """Return the columns of a vector as text."""
    return [text(column) for column in values.T]


def clock(time, start):
    """Return times of day in ms, after midnight too."""
    texts = []
    for second in time:
        whole_ms = round(1e3 * (start + second)) % 86_400_000
        hours, rest = divmod(whole_ms, 3_600_000)
        minutes, rest = divmod(rest, 60_000)
        texts.append(f'{hours:02}:{minutes:02}:{rest // 1000:02}.{rest % 1000:03}')
    return texts


def decimal_commas(time, force, rate):
    columns = [numbers(time), *axes(force), *axes(np.degrees(rate))]
    rows = [';'.join(row).replace('.', ',') for row in zip(*columns, strict=True)]
    header = 'Zeit [s];aX [m/s²];aY [m/s²];aZ [m/s²];gX [°/s];gY [°/s];gZ [°/s]'
    return '\n'.join([header, *rows])


def joined(header, columns, delimiter=',', end=''):
    """Return the text of a log."""
    rows = [delimiter.join(row) + end for row in zip(*columns, strict=True)]
    return '\n'.join([header, *rows])


def day_first(time, force, rate):
    stamps = [f'07.11.2023 {text}' for text in clock(time, 86_390.0)]
    return joined('Messung;ax;ay;az;gx;gy;gz', [stamps, *axes(force), *axes(rate)], ';')


def quoted(time, force, rate):
    columns = [numbers(time), *axes(force), *axes(rate)]
    columns = [[f'"{cell}"' for cell in column] for column in columns]
    return joined('\ufeff"time","acc_x","acc_y","acc_z","gyr_x","gyr_y","gyr_z"', columns, end=',')


def counter_24(time, force, rate):
    ticks = [f'{(16_000_000 + round(1e6 * second)) % 2**24}' for second in time]
    return joined('micros,ax,ay,az,gx,gy,gz', [ticks, *axes(force), *axes(rate)])


def counter_16(time, force, rate):
    ticks = [f'{(64_000 + round(1e3 * second)) % 2**16}' for second in time]
    return joined('ms\tax\tay\taz\tgx\tgy\tgz', [ticks, *axes(force), *axes(rate)], '\t')


def epoch_ns(time, force, rate):
    stamps = [f'{1_688_000_000 * 10**9 + round(1e9 * second)}' for second in time]
    names = 'w_x [rad s^-1],w_y [rad s^-1],w_z [rad s^-1],a_x [m s^-2],a_y [m s^-2],a_z [m s^-2]'
    return joined(f'#timestamp [ns],{names}', [stamps, *axes(rate), *axes(force)])


def second_row(time, force, rate):
    header = 'Time;AccX;AccY;AccZ;GyrX;GyrY;GyrZ\nms;mg;mg;mg;deg/s;deg/s;deg/s'
    columns = [numbers(1e3 * time), *axes(1e3 * force / G0), *axes(np.degrees(rate))]
    return joined(header, columns, ';')


def further_columns(time, force, rate):
    between = [numbers(np.linspace(20.0, 60.0, len(time)))] * 3
    header = 'time,roll,pitch,yaw,acc_x,acc_y,acc_z,mag_x,mag_y,mag_z,gyr_x,gyr_y,gyr_z'
    return joined(header, [numbers(time), *between, *axes(force), *between, *axes(rate)])


def zone(time, force, rate):
    stamps = [f'2022-05-01 {text} +0530' for text in clock(time, 43_000.0)]
    header = (
        'loggingTime(txt),userAccelerationX(G),userAccelerationY(G),userAccelerationZ(G),'
        'accelerometerAccelerationX(G),accelerometerAccelerationY(G),accelerometerAccelerationZ(G),'
        'gyroRotationX(rad/s),gyroRotationY(rad/s),gyroRotationZ(rad/s)'
    )
    user = axes(np.zeros_like(force))
    return joined(header, [stamps, *user, *axes(force / G0), *axes(rate)])


def uncompensated(time, force, rate):
    header = 'TimeStartup,UncompAccX,UncompAccY,UncompAccZ,UncompGyroX,UncompGyroY,UncompGyroZ'
    return joined(header, [whole(1e9 * time), *axes(force), *axes(rate)])


def spaces(time, force, rate):
    header = '# t(s) ax(g) ay(g) az(g) gx(mrad/s) gy(mrad/s) gz(mrad/s)'
    return joined(header, [numbers(time), *axes(force / G0), *axes(1e3 * rate)], '  ')


def counts(time, force, rate):
    header = 't_us,acc_x_raw,acc_y_raw,acc_z_raw,gyro_x_raw,gyro_y_raw,gyro_z_raw'
    of_force, of_rate = axes(2730.0 * force / G0, whole), axes(43.7 * np.degrees(rate), whole)
    return joined(header, [whole(1e6 * time), *of_force, *of_rate])


OF_COUNTS = (
    'force=acc_x_raw,acc_y_raw,acc_z_raw:counts:2730/g',
    'rate=gyro_x_raw,gyro_y_raw,gyro_z_raw:counts:43.7/dps',
)


def two_imus(time, force, rate):
    header = 'time,imu1_accel_x,imu1_accel_y,imu1_accel_z,imu2_accel_x,imu2_accel_y,imu2_accel_z'
    columns = [numbers(time), *axes(force), *axes(force + 0.5), *axes(rate)]
    return joined(f'{header},gx,gy,gz', columns)


CORRECTED_FIRST = ('force=2,3,4:m/s^2', 'rate=8,9,10:rad/s')
OF_FIRST = ('force=imu1_accel_x,imu1_accel_y,imu1_accel_z:m/s^2', 'rate=gx,gy,gz:rad/s')


def quoted_commas(time, force, rate):
    """A comma is the delimiter and, within quotes, the decimal sign; some cells are empty."""
    columns = [numbers(time), *axes(force), *axes(rate), numbers(0.1 * time)]
    columns = [[f'"{cell}"'.replace('.', ',') for cell in column] for column in columns]
    columns[-1][7] = '""'
    return joined('"t","ax","ay","az","gx","gy","gz","note"', columns)


def errors_of_spreadsheets(time, force, rate):
    """Cells without a number, in a column that is not read, and a comment behind a row."""
    notes = numbers(0.1 * time)
    notes[20:24] = ['#N/A', 'null', '#DIV/0!', '-nan(ind)']
    columns = [numbers(time), *axes(force), notes, *axes(rate)]
    columns[-1][30] += ' # knocked'
    return joined('t,ax,ay,az,note,gx,gy,gz', columns)


def date_and_time(time, force, rate):
    """A date and a time of day in two columns, past midnight."""
    day = ['08/30/2021'] * len(time)
    columns = [day, clock(time, 86_391.0), *axes(1e3 * force / G0), *axes(np.degrees(rate))]
    return joined('rtcDate,rtcTime,aX,aY,aZ,gX,gY,gZ,', columns, end=',')


def tabs_and_time_of_day(time, force, rate):
    header = 'Time(s)\tax(g)\tay(g)\taz(g)\twx(deg/s)\twy(deg/s)\twz(deg/s)'
    columns = [clock(time, 86_385.0), *axes(force / G0), *axes(np.degrees(rate))]
    return joined(header, columns, '\t')


def counter_32(time, force, rate):
    """Metadata, then a counter of microseconds that overflows; each row ends with a comma."""
    ticks = [f'{(2**32 - 5_000_000 + round(1e6 * second)) % 2**32}' for second in time]
    header = 'sep=,\nDeviceTag:,left\n\nSampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z,'
    return joined(header, [ticks, *axes(force), *axes(np.degrees(rate))], end=',')


def blackbox(time, force, rate):
    names = [f' {sensor}[{k}]' for sensor in ('gyroADC', 'accSmooth') for k in range(3)]
    header = f'loopIteration, time (us),{",".join(names)}, motor[0]'
    count = whole(np.arange(len(time)))
    of_force = axes(2048.0 * force / G0, whole)
    return joined(
        header, [count, whole(1e6 * time), *axes(np.degrees(rate)), *of_force, count], ', '
    )


OF_BLACKBOX = ('force=accSmooth[0],accSmooth[1],accSmooth[2]:counts:2048/g',)


def phone_table(time, force, rate):
    """Rows of both sensors, axes in the order z, y, x."""
    names = [f'{sensor}_{axis}' for sensor in ('totalacceleration', 'gyroscope') for axis in 'zyx']
    stamps = [f'{1_718_030_736_872_695_300 + round(1e9 * second)}' for second in time]
    header = f'time,seconds_elapsed,{",".join(names)}'
    return joined(header, [stamps, numbers(time), *axes(force)[::-1], *axes(rate)[::-1]])


@pytest.mark.parametrize(
    ('log', 'encoding', 'columns', 'force_step', 'rate_step'),
    [
        (decimal_commas, 'cp1252', (), 1e-8, 1e-8),
        (quoted_commas, 'utf-8', (), 1e-8, 1e-8),
        (errors_of_spreadsheets, 'utf-8', (), 1e-8, 1e-8),
        (date_and_time, 'utf-8', (), 1e-8, 1e-8),
        (tabs_and_time_of_day, 'utf-8', (), 1e-7, 1e-8),
        (counter_32, 'utf-8', (), 1e-8, 1e-8),
        (blackbox, 'utf-8', OF_BLACKBOX, G0 / 2048.0, 1e-8),
        (phone_table, 'utf-8', (), 1e-8, 1e-8),
        (decimal_commas, 'utf-8', (), 1e-8, 1e-8),
        (decimal_commas, 'utf-16', (), 1e-8, 1e-8),
        (day_first, 'utf-8', (), 1e-8, 1e-8),
        (quoted, 'utf-8', (), 1e-8, 1e-8),
        (counter_24, 'utf-8', (), 1e-8, 1e-8),
        (counter_16, 'utf-8', (), 1e-8, 1e-8),
        (epoch_ns, 'utf-8', (), 1e-8, 1e-8),
        (second_row, 'utf-8', (), 1e-8, 1e-8),
        (further_columns, 'utf-8', (), 1e-8, 1e-8),
        (zone, 'utf-8', (), 1e-7, 1e-8),
        (uncompensated, 'utf-8', (), 1e-8, 1e-8),
        (spaces, 'utf-8', (), 1e-7, 1e-8),
        (counts, 'utf-8', OF_COUNTS, G0 / 2730.0, np.radians(1 / 43.7)),
        (two_imus, 'utf-8', OF_FIRST, 1e-8, 1e-8),
    ],
)
def test_the_readings_are_those_of_the_log(
    tmp_path, readings, log, encoding, columns, force_step, rate_step
):
    """
    Also those of the corrected log, after the inverse of the calibration.

    `force_step`, `rate_step`: rounding of the text in SI.
    """
    time, force, rate = readings
    path = tmp_path / 'log.csv'
    path.write_bytes(log(time, force, rate).encode(encoding))
    imu = read_csv(path, columns).imu
    seconds = 1e-9 * (imu.stamp_ns - imu.stamp_ns[0])
    np.testing.assert_allclose(seconds, time - time[0], atol=1e-3)  # stamps in whole ms
    np.testing.assert_allclose(imu.force_s, force, atol=force_step)
    np.testing.assert_allclose(imu.rate_s, rate, atol=rate_step)

    calibration = random_calibration(5, (), (), sd=1e-5)
    output = tmp_path / 'corrected.csv'
    compensate_recording(path, calibration, columns=columns, output=output)
    # The header of two IMUs names two sets; its units are those of the corrected columns.
    written = read_csv(output, CORRECTED_FIRST if columns == OF_FIRST else ()).imu
    np.testing.assert_array_equal(
        written.stamp_ns - written.stamp_ns[0], imu.stamp_ns - imu.stamp_ns[0]
    )
    bias, matrix = affine(calibration, 'accelerometer')
    np.testing.assert_allclose(bias + written.force_s @ matrix.T, force, atol=force_step + 1e-7)
    bias, matrix = affine(calibration, 'gyroscope')
    np.testing.assert_allclose(bias + written.rate_s @ matrix.T, rate, atol=rate_step + 1e-7)


def test_one_instance_of_an_autopilot_is_corrected_by_itself(tmp_path, readings):
    """Rows of two IMUs: those of the selected one are written, with its readings corrected."""
    time, force, rate = readings
    rows = []
    for k, second in enumerate(time):
        for number, shift in ((0, 0.0), (1, 0.4)):
            vectors = (*(rate[k] + 0.1 * shift), *(force[k] + shift))
            cells = [str(round(1e6 * second + 4e7)), str(number), *numbers(vectors)]
            rows.append(','.join(cells))
    path, output = tmp_path / 'log.csv', tmp_path / 'corrected.csv'
    path.write_text('\n'.join(['TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ', *rows]))
    calibration = random_calibration(5, (), (), sd=1e-5)
    with refused(InputError, 'one_source'):
        compensate_recording(path, calibration, output=output)
    compensate_recording(path, calibration, where=['I=1'], output=output)
    assert {row.split(',')[1] for row in output.read_text().splitlines()[1:]} == {'1'}
    bias, matrix = affine(calibration, 'accelerometer')
    written = read_csv(output).imu
    np.testing.assert_allclose(bias + written.force_s @ matrix.T, force + 0.4, atol=1e-7)


def test_the_log_of_an_autopilot_is_exported_with_the_signs_of_the_vehicle(
    tmp_path, readings, capsys
):
    """Offsets and scales of PX4 and ArduPilot are those of the forward-right-down readings."""
    time, force, rate = readings
    header = 'TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ'
    columns = [whole(1e6 * time + 4e7), ['0'] * len(time), *axes(rate), *axes(force)]
    path = tmp_path / 'log.csv'
    path.write_text(joined(header, columns))
    assert main(['inspect', str(path)]) in (0, 3)
    assert '--axes frd' in capsys.readouterr().out
    found = calibrate_recordings(path, axes='frd', gravity=GRAVITY, model_as_asked=True).calibration
    sd = {
        sensor: found.sd[found.model.slices[sensor, 'bias']]
        for sensor in ('accelerometer', 'gyroscope')
    }
    names = {
        'px4': ('CAL_ACC0_{}OFF', 'CAL_GYRO0_{}OFF', 'CAL_ACC0_{}SCALE'),
        'ardupilot': ('INS_ACCOFFS_{}', 'INS_GYROFFS_{}', 'INS_ACCSCAL_{}'),
    }
    for program, (offset, gyroscope_offset, scale) in names.items():
        exported = export(found, find_target(program)).numbers
        for k, letter in enumerate('XYZ'):
            # 4 reported sd of the true biases; the scale to half of its difference from 1
            error = exported[offset.format(letter)] - ACCELEROMETER.bias[k]
            assert abs(error) < 4 * sd['accelerometer'][k]
            error = exported[gyroscope_offset.format(letter)] - GYROSCOPE.bias[k]
            assert abs(error) < 4 * sd['gyroscope'][k]
            true_scale = 1 / ACCELEROMETER.matrix[k, k]
            tolerance = 0.5 * abs(true_scale - 1.0)
            assert exported[scale.format(letter)] == pytest.approx(true_scale, abs=tolerance)
