"""PX4: a parameter file for QGroundControl, with linear thermal compensation where the calibration has it."""

from pathlib import Path

import numpy as np

from imu_calibration.core.documents import plain
from imu_calibration.core.errors import InputError
from imu_calibration.document.exports.affine import OFFSETS, SCALES, THERMAL_OFFSETS, AffineImu, forward_right_down, of
from imu_calibration.document.exports.target import AXIS_LETTERS, Page, Read, Target, commented, read_parameters, refuse_curved, vector_of
from imu_calibration.effects.base import SENSORS

CAL = {'accelerometer': 'CAL_ACC0', 'gyroscope': 'CAL_GYRO0'}
TC = {'accelerometer': 'TC_A', 'gyroscope': 'TC_G'}
PX4_RANGE_C = (0.0, 100.0)
"""Degrees Celsius; PX4's own range of thermal compensation."""
UNNOTICED = 0.01
"""Norm up to which PX4 ignores a change of an offset (m/s^2, rad/s) or a scale; 0.001 in older versions."""
INTEGER, REAL = 6, 9
"""Types of MAVLink."""


def numbers(imu: AffineImu) -> dict:
    """Return parameters; the coefficient of power p of axis a is called ``X{p}_{a}``."""
    found: dict[str, float] = {}
    for sensor in SENSORS:
        found |= {f'{CAL[sensor]}_{a}OFF': value for a, value in zip(AXIS_LETTERS, imu.bias[sensor])}
    found |= {f'{CAL["accelerometer"]}_{a}SCALE': 1.0 / value for a, value in zip(AXIS_LETTERS, np.diag(imu.matrix['accelerometer']))}
    low, high = imu.temperature_range_c or PX4_RANGE_C
    for sensor in SENSORS:
        if np.any(imu.thermal[sensor]):
            short = TC[sensor]
            found |= {f'{short}_ENABLE': 1, f'{short}0_TREF': imu.temperature_ref_c, f'{short}0_TMIN': low, f'{short}0_TMAX': high}
            found |= {f'{short}0_X{power}_{axis}': float(value) if power == 1 else 0.0
                      for power in range(4) for axis, value in enumerate(imu.thermal[sensor])}
    return found


def imu(found: dict) -> AffineImu:
    """Return the IMU of such parameters; thermal offsets beyond the first power are refused by `read`."""
    bias, thermal, ref, limits = {}, {}, 25.0, None
    for sensor in SENSORS:
        short = f'{TC[sensor]}0'
        on = bool(found.get(f'{TC[sensor]}_ENABLE'))
        bias[sensor] = vector_of(found, f'{CAL[sensor]}_*OFF')
        thermal[sensor] = np.array([found.get(f'{short}_X1_{axis}', 0.0) if on else 0.0 for axis in range(3)])
        if on:
            bias[sensor] = bias[sensor] + [found.get(f'{short}_X0_{axis}', 0.0) for axis in range(3)]
            ref, limits = found[f'{short}_TREF'], (found[f'{short}_TMIN'], found[f'{short}_TMAX'])
    matrix = {'accelerometer': np.diag(1.0 / vector_of(found, f'{CAL["accelerometer"]}_*SCALE', 1.0)), 'gyroscope': np.eye(3)}
    return AffineImu(bias=bias, matrix=matrix, thermal=thermal, temperature_ref_c=ref, temperature_range_c=limits)


def write(page: Page) -> str:
    """Return a parameter file: vehicle, component, name, value, type."""
    lines = [f'1\t1\t{name}\t{value!r}\t{INTEGER if isinstance(value, int) else REAL}' for name, value in plain(page.numbers).items()]
    return commented([*page.comments, '', 'Vehicle-Id Component-Id Name Value Type']) + '\n'.join(lines) + '\n'


def read(content: bytes, _path: str | Path) -> Read:
    """Read the parameters of the first accelerometer and gyroscope."""
    every = read_parameters(content, 'PX4 parameter file')
    found = {name: value for name, value in every.items() if name.startswith((*CAL.values(), *TC.values()))}
    if not any(name.startswith('CAL_') for name in found):
        raise InputError('the PX4 parameter file must hold CAL_ACC0 or CAL_GYRO0, it holds none of them; give another file')
    refuse_curved(found, [f'{short}0_X{power}' for short in TC.values() for power in (2, 3)])
    absent = [sensor for sensor in SENSORS if not any(name.startswith(CAL[sensor]) for name in found)]
    lacks = tuple(capability for sensor in absent for capability in of(sensor, OFFSETS + SCALES))
    return Read(found, lacks)


def ignored(found: dict) -> list[str]:
    """Return the changes that PX4 ignores."""
    lines = []
    for sensor, ending, nominal in (('accelerometer', 'OFF', 0.0), ('accelerometer', 'SCALE', 1.0), ('gyroscope', 'OFF', 0.0)):
        change = float(np.linalg.norm(vector_of(found, f'{CAL[sensor]}_*{ending}', nominal) - nominal))
        if 0 < change <= UNNOTICED:
            lines.append(f'PX4 ignores a change of {CAL[sensor]}_*{ending} if the three together change by {UNNOTICED:g} or less (older '
                         f'versions 0.001), here they change by {change:.2g} from {nominal:g}: check that your version accepts them')
    return lines


TARGETS = (Target(
    name='px4', title='PX4 parameters', suffix='.params',
    formula='(raw - thermal - OFF) * SCALE in forward-right-down axes; gyroscopes: no SCALE\n'
            'thermal = X0 + X1 (T - TREF) + ..., T within TMIN..TMAX',
    source='PX4/PX4-Autopilot, src/lib/sensor_calibration/Accelerometer.{hpp,cpp}, Gyroscope.hpp, temperature_compensation',
    holds=OFFSETS + of('accelerometer', SCALES) + THERMAL_OFFSETS, placement=forward_right_down, numbers=numbers,
    write=write, read=read, imu=imu, back=forward_right_down, ignored=ignored,
    hint='set CAL_ACC0_ID and CAL_GYRO0_ID (TC_A0_ID, TC_G0_ID) to the device ids of these sensors, or PX4 ignores them;'
         ' the readings must be uncalibrated'),)
