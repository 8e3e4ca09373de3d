"""ArduPilot: a parameter file with offsets, scale factors and temperature calibration of the first IMU."""

from pathlib import Path

import numpy as np

from imu_calibration.core.documents import plain
from imu_calibration.core.errors import InputError
from imu_calibration.document.exports.affine import OFFSETS, SCALES, THERMAL_OFFSETS, AffineImu, forward_right_down, of
from imu_calibration.document.exports.target import AXIS_LETTERS, Page, Read, Target, commented, read_parameters, refuse_curved, vector_of
from imu_calibration.effects.base import SENSORS

OFFSET = {'accelerometer': 'INS_ACCOFFS', 'gyroscope': 'INS_GYROFFS'}
SCALE = 'INS_ACCSCAL'
CALTEMP = {'accelerometer': 'INS_ACC1_CALTEMP', 'gyroscope': 'INS_GYR1_CALTEMP'}
TCAL, TCAL_SENSORS = 'INS_TCAL1', {'accelerometer': 'ACC', 'gyroscope': 'GYR'}
PER_PARAMETER = 1e-6
"""Unit of the coefficients of the polynomials."""
ARDUPILOT_RANGE_C = (0.0, 70.0)
NO_TEMPERATURE = -300.0
LARGEST_OFFSET, SCALES_ALLOWED = 3.5, (0.8, 1.2)


def numbers(imu: AffineImu) -> dict:
    """Return parameters; offsets count at the temperature CALTEMP, polynomials without constant are about 35 C."""
    found = {f'{OFFSET[s]}_{a}': value for s in SENSORS for a, value in zip(AXIS_LETTERS, imu.bias[s])}
    found |= {f'{SCALE}_{a}': 1.0 / value for a, value in zip(AXIS_LETTERS, np.diag(imu.matrix['accelerometer']))}
    if any(np.any(imu.thermal[sensor]) for sensor in SENSORS):
        low, high = imu.temperature_range_c or ARDUPILOT_RANGE_C
        found |= {f'{TCAL}_ENABLE': 1, f'{TCAL}_TMIN': low, f'{TCAL}_TMAX': high}
        for sensor in SENSORS:
            found[CALTEMP[sensor]] = imu.temperature_ref_c
            found |= {f'{TCAL}_{TCAL_SENSORS[sensor]}{power}_{a}': float(value) / PER_PARAMETER if power == 1 else 0.0
                      for power in (1, 2, 3) for a, value in zip(AXIS_LETTERS, imu.thermal[sensor])}
    return found


def imu(found: dict) -> AffineImu:
    """Return the IMU of such parameters."""
    on = found.get(f'{TCAL}_ENABLE') == 1
    limits = (found.get(f'{TCAL}_TMIN', ARDUPILOT_RANGE_C[0]), found.get(f'{TCAL}_TMAX', ARDUPILOT_RANGE_C[1])) if on else None
    ref = float(np.clip(found.get(CALTEMP['accelerometer'], NO_TEMPERATURE), *limits)) if limits else 25.0
    thermal = {s: vector_of(found, f'{TCAL}_{TCAL_SENSORS[s]}1_*') * PER_PARAMETER * on for s in SENSORS}
    bias = {s: vector_of(found, OFFSET[s] + '_*') for s in SENSORS}
    if limits:   # both sensors may have been calibrated at temperatures of their own; the document has one
        there = float(np.clip(found.get(CALTEMP['gyroscope'], NO_TEMPERATURE), *limits))
        bias['gyroscope'] = bias['gyroscope'] + thermal['gyroscope'] * (ref - there)
    matrix = {'accelerometer': np.diag(1.0 / vector_of(found, SCALE + '_*', 1.0)), 'gyroscope': np.eye(3)}
    return AffineImu(bias=bias, matrix=matrix, thermal=thermal, temperature_ref_c=ref, temperature_range_c=limits)


def write(page: Page) -> str:
    """Return a parameter file, ``NAME,VALUE``."""
    return commented(page.comments) + ''.join(f'{name},{value!r}\n' for name, value in plain(page.numbers).items())


def read(content: bytes, _path: str | Path) -> Read:
    """Read the parameters of the first IMU."""
    known = (*OFFSET.values(), SCALE, *CALTEMP.values(), TCAL)
    every = read_parameters(content, 'ArduPilot parameter file')
    found = {name: value for name, value in every.items() if name.startswith(known)}
    if not any(name.startswith((*OFFSET.values(), SCALE)) for name in found):
        raise InputError('the ArduPilot parameter file must hold INS_ACCOFFS, INS_ACCSCAL or INS_GYROFFS, it holds none of them; '
                         'give another file')
    if found.get(f'{TCAL}_ENABLE') == 1:
        refuse_curved(found, [f'{TCAL}_{short}{power}' for short in TCAL_SENSORS.values() for power in (2, 3)])
    lacks = tuple(h for s in SENSORS for h in of(s, OFFSETS) if not any(name.startswith(OFFSET[s]) for name in found))
    lacks += () if any(name.startswith(SCALE) for name in found) else of('accelerometer', SCALES)
    return Read(found, lacks)


def ignored(found: dict) -> list[str]:
    """Return the values outside the ranges of ArduPilot."""
    lines = []
    offset, scale = vector_of(found, OFFSET['accelerometer'] + '_*'), vector_of(found, SCALE + '_*', 1.0)
    if np.any(np.abs(offset) > LARGEST_OFFSET):
        lines.append(f'ArduPilot accepts INS_ACCOFFS to {LARGEST_OFFSET:g} m/s^2, here {np.abs(offset).max():.3g}: arming will be refused')
    if np.any((scale < SCALES_ALLOWED[0]) | (scale > SCALES_ALLOWED[1])):
        low, high = SCALES_ALLOWED
        lines.append(f'ArduPilot accepts INS_ACCSCAL from {low:g} to {high:g}, here {scale.min():.3g} to {scale.max():.3g}')
    return [*lines, 'ArduPilot measures the offsets of gyroscopes at each start unless INS_GYR_CAL is 0']


TARGETS = (Target(
    name='ardupilot', title='ArduPilot parameters', suffix='.param',
    formula='(raw - poly(T) + poly(CALTEMP) - OFFS) * SCAL in forward-right-down axes before the turn of the board; gyroscopes: no SCAL\n'
            'poly(T) = 1e-6 (c1 dT + c2 dT^2 + c3 dT^3), dT = T - 35 C, T within TMIN..TMAX',
    source='ArduPilot/ardupilot, libraries/AP_InertialSensor/AP_InertialSensor_Backend.cpp, AP_InertialSensor_tempcal.cpp',
    holds=OFFSETS + of('accelerometer', SCALES) + THERMAL_OFFSETS, placement=forward_right_down, numbers=numbers,
    write=write, read=read, imu=imu, back=forward_right_down, ignored=ignored,
    hint='of the first IMU; the readings must be uncalibrated, in the axes of the vehicle'),)
