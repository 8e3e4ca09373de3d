"""Exports with fixed axes from calibrations of readings in stated axes (log of an autopilot)."""

from dataclasses import replace

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.exporting import import_calibration
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import RawReadings
from imu_calibration.document.calibration_text import calibration_from_text, calibration_to_text
from imu_calibration.document.exports.export import export, find_target
from msg_adapters.csv_log import autopilot_of

from worlds.compensation_cases import random_calibration

PARAMETERS = {
    'px4': ('CAL_ACC0_{}OFF', 'CAL_ACC0_{}SCALE'),
    'ardupilot': ('INS_ACCOFFS_{}', 'INS_ACCSCAL_{}'),
}
"""Autopilot -> parameter of an offset and of a scale, by letter of the axis."""
FORWARD_RIGHT_DOWN = {
    'flu': ((0, 1), (1, -1), (2, -1)),
    'frd': ((0, 1), (1, 1), (2, 1)),
    '-x,y,-z': ((0, -1), (1, -1), (2, 1)),
    'y,-x,z': ((1, 1), (0, 1), (2, -1)),
}
"""Axes -> (axis of the source, sign) of forward, right and down, by hand."""


def calibration_in(axes):
    return replace(random_calibration(6, ()), readings=RawReadings(axes=axes))


@pytest.mark.parametrize('name', PARAMETERS)
@pytest.mark.parametrize('axes', FORWARD_RIGHT_DOWN)
def test_offsets_and_scales_have_the_axes_of_the_vehicle(name, axes):
    calibration = calibration_in(axes)
    bias = calibration.value('accelerometer', 'bias')
    matrix = np.diag(calibration.value('accelerometer', 'matrix'))
    found = export(calibration, find_target(name)).numbers
    for letter, (index, sign) in zip('XYZ', FORWARD_RIGHT_DOWN[axes], strict=True):
        offset, scale = PARAMETERS[name]
        assert found[offset.format(letter)] == pytest.approx(sign * bias[index], rel=1e-12)
        assert found[scale.format(letter)] == pytest.approx(1 / matrix[index], rel=1e-12)


@pytest.mark.parametrize('name', PARAMETERS)
@pytest.mark.parametrize('axes', FORWARD_RIGHT_DOWN)
def test_a_file_that_is_imported_and_exported_again_keeps_its_numbers(tmp_path, name, axes):
    first = export(calibration_in(axes), find_target(name))
    (tmp_path / 'file').write_bytes(first.content)
    read = import_calibration(tmp_path / 'file', name)
    assert read.readings.axes == 'flu'
    read = calibration_from_text(calibration_to_text(read))
    again = export(read, find_target(name))
    for key, value in first.numbers.items():
        assert again.numbers[key] == pytest.approx(value, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize('name', PARAMETERS)
def test_an_export_without_stated_axes_is_refused(tmp_path, name, capsys):
    with refused(InputError, 'axes_missing', 'flu', 'frd') as caught:
        export(calibration_in(''), find_target(name))
    assert caught.value.key == 'axes'
    (tmp_path / 'c.yaml').write_text(calibration_to_text(calibration_in('')))
    output = tmp_path / 'file'
    command = ['export', str(tmp_path / 'c.yaml'), '--to', name, '--output', str(output)]
    assert main(command) == 1 and not output.exists()
    assert '(--axes)' in capsys.readouterr().err
    assert main([*command, '--axes=frd']) == 0 and output.exists()


def test_other_programs_need_no_axes():
    assert export(calibration_in(''), find_target('imu-calib')).content


@pytest.mark.parametrize(
    ('header', 'autopilot'),
    [
        ('TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ', 'ArduPilot'),
        ('timestamp,gyro_rad[0],gyro_rad[1],gyro_rad[2],accelerometer_m_s2[0],b,c', 'PX4'),
        ('time_boot_ms,xacc,yacc,zacc,xgyro,ygyro,zgyro', 'MAVLink'),
        ('timestamp,RAW_IMU.xacc,RAW_IMU.yacc,RAW_IMU.zacc,RAW_IMU.xgyro', 'MAVLink'),
        ('time,gyroADC[0],gyroADC[1],gyroADC[2],accSmooth[0],accSmooth[1],accSmooth[2]', ''),
    ],
)
def test_the_header_of_an_autopilot_is_recognised(tmp_path, header, autopilot):
    row = ','.join(['1'] * (header.count(',') + 1))
    (tmp_path / 'log.csv').write_text('\n'.join([header, row, row]) + '\n')
    assert autopilot_of(tmp_path / 'log.csv') == autopilot
