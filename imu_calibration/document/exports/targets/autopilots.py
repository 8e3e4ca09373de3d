"""
ArduPilot and PX4.

Parameter files with offsets, scale factors and linear temperature calibration of the first IMU.
"""

import math
from collections.abc import Iterable, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from imu_calibration.core.documents import plain
from imu_calibration.core.errors import InputError
from imu_calibration.document.exports.affine import (
    OFFSETS,
    SCALES,
    THERMAL_OFFSETS,
    AffineImu,
    Capability,
    of,
)
from imu_calibration.document.exports.target import (
    AXIS_LETTERS,
    Numbers,
    Page,
    Read,
    Target,
    commented,
    read_parameters,
    refuse_curved,
    vector_of,
)
from imu_calibration.effects.base import SENSORS


def _by_axis(pattern: str, values: Iterable[Any]) -> dict[str, Any]:
    """Return parameters of the three axes, whose letter replaces ``*`` in the name."""
    return {pattern.replace('*', axis): value for axis, value in zip(AXIS_LETTERS, values)}


def _has(parameters: Mapping[str, float], pattern: str) -> bool:
    """Return whether the file has the parameter of at least one axis."""
    return any(name in parameters for name in _by_axis(pattern, AXIS_LETTERS))


def _linear(imu: AffineImu, offset: Mapping[str, str], scale: str) -> dict[str, float]:
    """
    Return the offsets of both sensors, and the scale factors of the accelerometer.

    The programs multiply by their scale factor: it is the inverse of the sensor's.
    """
    parameters = {}
    for sensor in SENSORS:
        parameters |= _by_axis(offset[sensor], imu.bias[sensor])
    return parameters | _by_axis(scale, 1.0 / np.diag(imu.matrix['accelerometer']))


PREFIXES_OF_SENSOR = {
    'accelerometer': ('INS_ACC', 'INS_TCAL1_ACC', 'CAL_ACC', 'TC_A'),
    'gyroscope': ('INS_GYR', 'INS_TCAL1_GYR', 'CAL_GYRO', 'TC_G'),
}
"""Sensor -> beginnings of the names of its parameters."""


def _written(page: Page) -> dict[str, Any]:
    """Return the parameters to write: those of a sensor that was not calibrated are omitted."""
    absent: tuple[str, ...] = ()
    for sensor in page.calibration.absent:
        absent += PREFIXES_OF_SENSOR[sensor]
    return {
        name: value for name, value in plain(page.numbers).items() if not name.startswith(absent)
    }


def _matrix(parameters: Mapping[str, float], scale: str) -> dict[str, np.ndarray]:
    """Return sensor -> matrix, from the scale factors of the accelerometer."""
    factors = vector_of(parameters, scale, 1.0)
    return {'accelerometer': np.diag(1.0 / factors), 'gyroscope': np.eye(3)}


OFFSET = {'accelerometer': 'INS_ACCOFFS_*', 'gyroscope': 'INS_GYROFFS_*'}
SCALE = 'INS_ACCSCAL_*'
CALTEMP = {'accelerometer': 'INS_ACC1_CALTEMP', 'gyroscope': 'INS_GYR1_CALTEMP'}
TCAL = 'INS_TCAL1'
TCAL_SENSORS = {'accelerometer': 'ACC', 'gyroscope': 'GYR'}
PER_PARAMETER = 1e-6
"""Unit of the coefficients of the polynomials."""
ARDUPILOT_RANGE_C = (0.0, 70.0)
"""Degrees Celsius; defaults of TMIN and TMAX."""
NO_TEMPERATURE = -300.0
"""ArduPilot's default of CALTEMP; it is clipped to the range."""
LARGEST_OFFSET = 3.5
"""m/s^2; ArduPilot refuses to arm with a larger offset of the accelerometer."""
SCALES_ALLOWED = (0.8, 1.2)


def numbers_ardupilot(imu: AffineImu) -> Numbers:
    """
    Return the parameters of an IMU.

    Offsets hold at the temperature CALTEMP; the polynomials, without a constant, are about 35 C.
    """
    parameters = _linear(imu, OFFSET, SCALE)
    if not any(np.any(imu.thermal[sensor]) for sensor in SENSORS):
        return parameters

    low, high = imu.temperature_range_c or ARDUPILOT_RANGE_C
    parameters |= {f'{TCAL}_ENABLE': 1, f'{TCAL}_TMIN': low, f'{TCAL}_TMAX': high}
    for sensor in SENSORS:
        parameters[CALTEMP[sensor]] = imu.temperature_ref_c
        # The calibration is linear in temperature: the powers 2 and 3 are zero.
        linear = [float(value) / PER_PARAMETER for value in imu.thermal[sensor]]
        polynomial = f'{TCAL}_{TCAL_SENSORS[sensor]}'
        parameters |= _by_axis(f'{polynomial}1_*', linear)
        parameters |= _by_axis(f'{polynomial}2_*', [0.0] * 3)
        parameters |= _by_axis(f'{polynomial}3_*', [0.0] * 3)
    return parameters


def imu_ardupilot(parameters: Numbers) -> AffineImu:
    """Return the IMU of ArduPilot parameters, as `numbers_ardupilot` makes them."""
    bias = {}
    thermal = {}
    for sensor in SENSORS:
        bias[sensor] = vector_of(parameters, OFFSET[sensor])
        thermal[sensor] = np.zeros(3)
    ref = 25.0
    limits = None
    if parameters.get(f'{TCAL}_ENABLE') == 1:
        for sensor in SENSORS:
            linear = vector_of(parameters, f'{TCAL}_{TCAL_SENSORS[sensor]}1_*')
            thermal[sensor] = linear * PER_PARAMETER
        limits = (
            parameters.get(f'{TCAL}_TMIN', ARDUPILOT_RANGE_C[0]),
            parameters.get(f'{TCAL}_TMAX', ARDUPILOT_RANGE_C[1]),
        )
        ref = float(np.clip(parameters.get(CALTEMP['accelerometer'], NO_TEMPERATURE), *limits))
        # The offsets of the gyroscopes count at another temperature; the document has only one.
        gyro_ref = float(np.clip(parameters.get(CALTEMP['gyroscope'], NO_TEMPERATURE), *limits))
        bias['gyroscope'] = bias['gyroscope'] + thermal['gyroscope'] * (ref - gyro_ref)
    return AffineImu(
        bias=bias,
        matrix=_matrix(parameters, SCALE),
        thermal=thermal,
        temperature_ref_c=ref,
        temperature_range_c=limits,
    )


def write_ardupilot(page: Page) -> str:
    """Return a parameter file, ``NAME,VALUE``."""
    return commented(page.comments) + ''.join(
        f'{name},{value!r}\n' for name, value in _written(page).items()
    )


def read_ardupilot(content: bytes, _path: str | Path) -> Read:
    """Read the parameters of the first IMU."""
    parameters = read_parameters(content, 'ArduPilot parameter file')
    if not any(_has(parameters, pattern) for pattern in (*OFFSET.values(), SCALE)):
        raise InputError(
            'the ArduPilot parameter file must hold INS_ACCOFFS, INS_ACCSCAL or INS_GYROFFS, it'
            ' holds none of them; give another file'
        )
    lacks: tuple[Capability, ...] = ()
    curved = []
    for sensor in SENSORS:
        if not _has(parameters, OFFSET[sensor]):
            lacks += of(sensor, OFFSETS)
        polynomial = f'{TCAL}_{TCAL_SENSORS[sensor]}'
        curved += [f'{polynomial}2', f'{polynomial}3']
    if not _has(parameters, SCALE):
        lacks += of('accelerometer', SCALES)
    if parameters.get(f'{TCAL}_ENABLE') == 1:
        refuse_curved(parameters, curved)
    return Read(numbers=parameters, lacks=lacks)


def ignored_ardupilot(parameters: Numbers) -> list[str]:
    """Return a line for each kind of value outside its range of ArduPilot, and its limits."""
    lines = []
    offset = vector_of(parameters, OFFSET['accelerometer'])
    scale = vector_of(parameters, SCALE, 1.0)
    if np.any(np.abs(offset) > LARGEST_OFFSET):
        lines.append(
            f'ArduPilot accepts INS_ACCOFFS to {LARGEST_OFFSET:g} m/s^2, here'
            f' {np.abs(offset).max():.3g}: arming will be refused'
        )
    if np.any((scale < SCALES_ALLOWED[0]) | (scale > SCALES_ALLOWED[1])):
        low, high = SCALES_ALLOWED
        lines.append(
            f'ArduPilot accepts INS_ACCSCAL from {low:g} to {high:g}, here {scale.min():.3g} to'
            f' {scale.max():.3g}'
        )
    return [
        *lines,
        'ArduPilot measures the offsets of gyroscopes at each start unless INS_GYR_CAL is 0',
    ]


ARDUPILOT = (
    Target(
        name='ardupilot',
        title='ArduPilot parameters',
        suffix='.param',
        formula=(
            '(raw - poly(T) + poly(CALTEMP) - OFFS) * SCAL in forward-right-down axes before the'
            ' turn of the board; gyroscopes: no SCAL\npoly(T) = 1e-6 (c1 dT + c2 dT^2 + c3 dT^3),'
            ' dT = T - 35 C, T within TMIN..TMAX'
        ),
        source=(
            'ArduPilot/ardupilot, libraries/AP_InertialSensor/AP_InertialSensor_Backend.cpp,'
            ' AP_InertialSensor_tempcal.cpp'
        ),
        holds=OFFSETS + of('accelerometer', SCALES) + THERMAL_OFFSETS,
        forward_right_down=True,
        numbers=numbers_ardupilot,
        write=write_ardupilot,
        read=read_ardupilot,
        imu=imu_ardupilot,
        ignored=ignored_ardupilot,
        hint='of the first IMU; the readings must be uncalibrated, in the axes of the vehicle',
    ),
)


CAL_OFFSET = {'accelerometer': 'CAL_ACC0_*OFF', 'gyroscope': 'CAL_GYRO0_*OFF'}
CAL_SCALE = 'CAL_ACC0_*SCALE'
TC = {'accelerometer': 'TC_A', 'gyroscope': 'TC_G'}
PX4_REFERENCE_C = 25.0
"""Degrees Celsius; PX4's default of TC_*_TREF."""
PX4_RANGE_C = (0.0, 100.0)
"""Degrees Celsius; PX4's own range of thermal compensation: defaults of TC_*_TMIN and _TMAX."""
UNNOTICED = 0.01
"""
Norm up to which PX4 ignores a change of an offset (m/s^2, rad/s) or a scale; 0.001 in older
versions.
"""
INTEGER, REAL = 6, 9
"""Types of MAVLink."""


def numbers_px4(imu: AffineImu) -> Numbers:
    """Return the parameters of an IMU; the coefficient of power p of axis a is ``X{p}_{a}``."""
    parameters = _linear(imu, CAL_OFFSET, CAL_SCALE)
    low, high = imu.temperature_range_c or PX4_RANGE_C
    for sensor in SENSORS:
        if np.any(imu.thermal[sensor]):
            short = TC[sensor]
            parameters |= {
                f'{short}_ENABLE': 1,
                f'{short}0_TREF': imu.temperature_ref_c,
                f'{short}0_TMIN': low,
                f'{short}0_TMAX': high,
            }
            # The calibration is linear in temperature: the other powers are zero.
            for power, axis in product(range(4), range(3)):
                value = float(imu.thermal[sensor][axis]) if power == 1 else 0.0
                parameters[f'{short}0_X{power}_{axis}'] = value
    return parameters


def imu_px4(parameters: Numbers) -> AffineImu:
    """
    Return the IMU of PX4 parameters, as `numbers_px4` makes them.

    Thermal offsets beyond the first power are refused by `read_px4`.
    """
    bias = {}
    thermal = {}
    ref: float | None = None
    lowest, highest = -math.inf, math.inf
    for sensor in SENSORS:
        short = f'{TC[sensor]}0'
        bias[sensor] = vector_of(parameters, CAL_OFFSET[sensor])
        thermal[sensor] = np.zeros(3)
        if parameters.get(f'{TC[sensor]}_ENABLE'):
            # Parameter files omit parameters that have the autopilot's default.
            sensor_ref = parameters.get(f'{short}_TREF', PX4_REFERENCE_C)
            if ref is None:
                ref = sensor_ref
            # The reference of each sensor is its own, that of a calibration is common:
            #   X0 + X1 (T - TREF) = X0 + X1 (ref - TREF) + X1 (T - ref)
            constant = [parameters.get(f'{short}_X0_{axis}', 0.0) for axis in range(3)]
            linear = np.array([parameters.get(f'{short}_X1_{axis}', 0.0) for axis in range(3)])
            bias[sensor] = bias[sensor] + constant + linear * (ref - sensor_ref)
            thermal[sensor] = linear
            lowest = np.maximum(lowest, parameters.get(f'{short}_TMIN', PX4_RANGE_C[0]))
            highest = np.minimum(highest, parameters.get(f'{short}_TMAX', PX4_RANGE_C[1]))
    if ref is not None and not -math.inf < lowest < highest < math.inf:
        raise InputError(
            'the temperatures from TMIN to TMAX of a PX4 parameter file must be a range that the'
            f' sensors share, got {lowest:g} to {highest:g}; correct them'
        )
    return AffineImu(
        bias=bias,
        matrix=_matrix(parameters, CAL_SCALE),
        thermal=thermal,
        temperature_ref_c=PX4_REFERENCE_C if ref is None else ref,
        temperature_range_c=None if ref is None else (float(lowest), float(highest)),
    )


def write_px4(page: Page) -> str:
    """Return a parameter file: vehicle, component, name, value, type."""
    lines = [
        f'1\t1\t{name}\t{value!r}\t{INTEGER if isinstance(value, int) else REAL}'
        for name, value in _written(page).items()
    ]
    return (
        commented([*page.comments, '', 'Vehicle-Id Component-Id Name Value Type'])
        + '\n'.join(lines)
        + '\n'
    )


def read_px4(content: bytes, _path: str | Path) -> Read:
    """Read the parameters of the first accelerometer and gyroscope."""
    parameters = read_parameters(content, 'PX4 parameter file')
    present = {sensor: _has(parameters, CAL_OFFSET[sensor]) for sensor in SENSORS}
    present['accelerometer'] |= _has(parameters, CAL_SCALE)
    if not any(present.values()):
        raise InputError(
            'the PX4 parameter file must hold CAL_ACC0 or CAL_GYRO0, it holds none of them; give'
            ' another file'
        )
    curved = []
    lacks: tuple[Capability, ...] = ()
    for sensor in SENSORS:
        curved += [f'{TC[sensor]}0_X2', f'{TC[sensor]}0_X3']
        if not present[sensor]:
            lacks += of(sensor, OFFSETS + SCALES)
    refuse_curved(parameters, curved)
    return Read(numbers=parameters, lacks=lacks)


def ignored_px4(parameters: Numbers) -> list[str]:
    """Return a line for each group of three parameters whose change PX4 ignores as small."""
    lines = []
    for pattern, nominal in (
        (CAL_OFFSET['accelerometer'], 0.0),
        (CAL_SCALE, 1.0),
        (CAL_OFFSET['gyroscope'], 0.0),
    ):
        change = float(np.linalg.norm(vector_of(parameters, pattern, nominal) - nominal))
        if 0 < change <= UNNOTICED:
            lines.append(
                f'PX4 ignores a change of {pattern} if the three together change by {UNNOTICED:g}'
                f' or less (older versions 0.001), here they change by {change:.2g} from'
                f' {nominal:g}: check that your version accepts them'
            )
    return lines


PX4 = (
    Target(
        name='px4',
        title='PX4 parameters',
        suffix='.params',
        formula=(
            '(raw - thermal - OFF) * SCALE in forward-right-down axes; gyroscopes: no SCALE\n'
            'thermal = X0 + X1 (T - TREF) + ..., T within TMIN..TMAX'
        ),
        source=(
            'PX4/PX4-Autopilot, src/lib/sensor_calibration/Accelerometer.{hpp,cpp}, Gyroscope.hpp,'
            ' temperature_compensation'
        ),
        holds=OFFSETS + of('accelerometer', SCALES) + THERMAL_OFFSETS,
        forward_right_down=True,
        numbers=numbers_px4,
        write=write_px4,
        read=read_px4,
        imu=imu_px4,
        ignored=ignored_px4,
        hint=(
            'set CAL_ACC0_ID and CAL_GYRO0_ID (TC_A0_ID, TC_G0_ID) to the device ids of these'
            ' sensors, or PX4 ignores them; the readings must be uncalibrated'
        ),
    ),
)


TARGETS = ARDUPILOT + PX4
