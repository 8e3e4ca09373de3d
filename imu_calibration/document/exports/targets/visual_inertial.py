"""
Kalibr, OpenVINS and basalt.

Files of visual-inertial estimators with the intrinsics of their models and noise densities.
"""

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from imu_calibration.core.documents import plain
from imu_calibration.core.errors import InputError, shortened
from imu_calibration.document.exports.affine import (
    ARMS,
    G_SENSITIVITY,
    MATRICES,
    OFFSETS,
    SLOW_OFFSETS,
    THERMAL_OFFSETS,
    AffineImu,
    Placement,
    imu_of_corrections,
    lower_times_rotation,
)
from imu_calibration.document.exports.target import (
    Noise,
    Numbers,
    Page,
    Read,
    Target,
    numbers_at,
    read_json,
    read_yaml,
    section,
    yaml_file,
)
from imu_calibration.effects.base import SENSORS

LEVERS = ('rx_i', 'ry_i', 'rz_i')
"""Keys of the lever arms of the accelerometers x, y and z."""


def numbers_kalibr(imu: AffineImu) -> Numbers:
    """
    Return M, C_gyro_i, A and lever arms of an IMU in the placement `accelerometer_lower_at_x`.

    With the gyroscope's ``matrix = M C`` and ``cross = A C``: Kalibr's A acts on specific force in
    the gyroscope's axes.
    """
    gyro_matrix, rotation = lower_times_rotation(imu.matrix['gyroscope'])
    model = 'scale-misalignment'
    accelerometers = {'M': np.tril(imu.matrix['accelerometer'])}
    if np.any(imu.arms):
        model = 'scale-misalignment-size-effect'
        accelerometers |= dict(zip(LEVERS, imu.arms))
    return {
        'model': model,
        'accelerometers': accelerometers,
        'gyroscopes': {'M': gyro_matrix, 'C_gyro_i': rotation, 'A': imu.cross @ rotation.T},
    }


def imu_kalibr(numbers: Numbers) -> AffineImu:
    """Return the IMU of M, C_gyro_i, A and lever arms."""
    accelerometers = numbers['accelerometers']
    gyroscopes = numbers['gyroscopes']
    rotation = np.asarray(gyroscopes['C_gyro_i'])
    arms = np.zeros((3, 3))
    if LEVERS[0] in accelerometers:
        arms = np.array([accelerometers[name] for name in LEVERS])
    return AffineImu(
        matrix={
            'accelerometer': np.asarray(accelerometers['M']),
            'gyroscope': np.asarray(gyroscopes['M']) @ rotation,
        },
        cross=np.asarray(gyroscopes['A']) @ rotation,
        arms=arms,
    )


def noise_kalibr(noise: Noise) -> Numbers:
    """Return continuous densities."""
    accel, gyro = noise.accelerometer, noise.gyroscope
    return {
        'accelerometer_noise_density': accel.white,
        'accelerometer_random_walk': accel.walk,
        'gyroscope_noise_density': gyro.white,
        'gyroscope_random_walk': gyro.walk,
        'update_rate': noise.rate,
    }


def _sensor_entries(page: Page) -> dict[str, float | np.ndarray | str]:
    """Return the entries of an IMU in addition to its intrinsics."""
    rate_and_noise = {'update_rate': page.rate} if page.rate else {}
    if page.noise is not None:
        rate_and_noise = page.noise
    return {'rostopic': '/imu/data_raw', **rate_and_noise, 'T_i_b': np.eye(4), 'time_offset': 0.0}


def write_kalibr(page: Page) -> str:
    """Return imu.yaml."""
    return yaml_file(page.comments, _sensor_entries(page) | page.numbers)


def read_densities(mapping: dict[str, Any]) -> dict[str, float]:
    """Return {sensor: sd of a sample}, density * sqrt(rate); empty if one of them is missing."""
    rate: Any = mapping.get('update_rate')
    values: dict[str, Any] = {sensor: mapping.get(f'{sensor}_noise_density') for sensor in SENSORS}
    if not all(isinstance(v, (int, float)) and v > 0 for v in (rate, *values.values())):
        return {}
    return {sensor: float(value) * float(rate) ** 0.5 for sensor, value in values.items()}


def read_kalibr(content: bytes, _path: str | Path) -> Read:
    """Read files of kalibr_calibrate_imu_camera (``imu0: ...``) and of `write_kalibr`."""
    what = 'Kalibr result'
    mapping = read_yaml(content, what)
    if 'imu0' in mapping:
        mapping = section(mapping, 'imu0', what)
    if 'accelerometers' not in mapping:
        model = shortened(str(mapping.get('model', 'calibrated')))
        raise InputError(
            f"the {what} must come of a model with intrinsics, its model is '{model}'; run Kalibr"
            ' with scale-misalignment'
        )
    accelerometers = section(mapping, 'accelerometers', what)
    gyroscopes = section(mapping, 'gyroscopes', what)
    arms = {}
    for name in LEVERS:
        if name in accelerometers:
            arms[name] = numbers_at(accelerometers, name, (3,), what=what)
    accel_matrix = numbers_at(accelerometers, 'M', (3, 3), what=what)
    gyro_matrices = {}
    for name in ('M', 'C_gyro_i', 'A'):
        gyro_matrices[name] = numbers_at(gyroscopes, name, (3, 3), what=what)
    numbers = {
        'model': mapping.get('model'),
        'accelerometers': {'M': accel_matrix, **arms},
        'gyroscopes': gyro_matrices,
    }
    return Read(numbers=numbers, lacks=() if arms else ARMS, sample_sd=read_densities(mapping))


def accelerometer_lower_at_x(imu: AffineImu) -> Placement:
    """
    Return the placement with a lower triangular accelerometer matrix.

    Its origin is the sensitive point of the x accelerometer.
    """
    _, rotation = lower_times_rotation(imu.matrix['accelerometer'])
    return Placement(mat_ts=rotation, origin_s=imu.arms[0])


def at_the_mean(imu: AffineImu) -> Placement:
    """Return our placement: the same axes, the origin in the mean of the sensitive points."""
    return Placement(origin_s=imu.arms.mean(axis=0))


KALIBR = (
    Target(
        name='kalibr',
        title='Kalibr imu.yaml',
        formula=(
            'a_m = M (f + [W r]) + b with (W r)_i of the arm r_i of axis i, W = [alpha x] + [w'
            ' x]^2\nw_m = M C_gyro_i w + A C_gyro_i f + b; M lower triangular; rx_i = 0: the origin'
            ' is the x accelerometer'
        ),
        source=(
            'ethz-asl/kalibr, kalibr_imu_camera_calibration/IccSensors.py and'
            ' kalibr_common/ConfigReader.py'
        ),
        holds=MATRICES + G_SENSITIVITY + ARMS,
        estimates=SLOW_OFFSETS,
        placement=accelerometer_lower_at_x,
        numbers=numbers_kalibr,
        noise=noise_kalibr,
        noise_is=(
            'continuous: N in m/s^2/sqrt(Hz), rad/s/sqrt(Hz), K in m/s^3/sqrt(Hz), rad/s^2/sqrt(Hz)'
        ),
        write=write_kalibr,
        read=read_kalibr,
        imu=imu_kalibr,
        back=at_the_mean,
        axes='accelerometer_lower_triangular',
        hint=(
            'Kalibr reads the topic, the rate and the noise, and estimates all other values; its'
            ' intrinsics have the format of its output'
        ),
    ),
)


_REVERSAL = np.eye(3)[::-1]
"""Reverses the order of rows (from the left) or columns (from the right)."""


def upper_times_rotation(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (U, Q) with ``matrix = U @ Q``: U upper triangular with positive diagonal, Q a rotation.
    """
    lower, rotation = lower_times_rotation(_REVERSAL @ matrix @ _REVERSAL)
    upper = _REVERSAL @ lower @ _REVERSAL
    return upper, _REVERSAL @ rotation @ _REVERSAL


SHAPES = {'lower': lower_times_rotation, 'upper': upper_times_rotation}
"""Shape of a triangular matrix -> factorisation (matrix) -> (triangular matrix, rotation)."""
MATRIX_KEYS = ('Tw', 'R_IMUtoGYRO', 'Ta', 'R_IMUtoACC', 'Tg')


def numbers_openvins(imu: AffineImu, shape: str) -> Numbers:
    """
    Return triangular matrices and the rotations to them; `shape` is a key of `SHAPES`.

    The IMU's axes are unchanged, so that no extrinsic changes.
    """
    ta, to_acc = SHAPES[shape](imu.matrix['accelerometer'])
    tw, to_gyro = SHAPES[shape](imu.matrix['gyroscope'])
    return {'Tw': tw, 'R_IMUtoGYRO': to_gyro, 'Ta': ta, 'R_IMUtoACC': to_acc, 'Tg': imu.cross}


def imu_openvins(numbers: Numbers) -> AffineImu:
    """
    Return the IMU of a chain: ``a_m = Ta R_IMUtoACC f``, ``w_m = Tw R_IMUtoGYRO w + Tg f``.
    """
    tw, to_gyro, ta, to_acc, tg = (np.asarray(numbers[name]) for name in MATRIX_KEYS)
    return AffineImu(matrix={'accelerometer': ta @ to_acc, 'gyroscope': tw @ to_gyro}, cross=tg)


def write_openvins(page: Page, model: str) -> str:
    """Return kalibr_imu_chain.yaml."""
    return yaml_file(
        page.comments,
        {'imu0': _sensor_entries(page) | {'model': model} | page.numbers},
        head='%YAML:1.0\n',
    )


def read_openvins(content: bytes, _path: str | Path) -> Read:
    """Read a chain; missing entries are the identity, or zero, as in OpenVINS."""
    what = 'OpenVINS chain'
    chain = section(read_yaml(content, what), 'imu0', what)
    numbers = {}
    for name in MATRIX_KEYS:
        if name in chain:
            numbers[name] = numbers_at(chain, name, (3, 3), what=what)
        else:
            numbers[name] = np.zeros((3, 3)) if name == 'Tg' else np.eye(3)
    return Read(numbers=numbers, sample_sd=read_densities(chain))


def _target(name: str, model: str, shape: str) -> Target:
    """Return the target for a model of OpenVINS, whose matrices have a shape of `SHAPES`."""
    return Target(
        name=name,
        title=f'OpenVINS kalibr_imu_chain.yaml, model {model}',
        formula=(
            "f = R_IMUtoACC' Ta^-1 (a_m - b); w = R_IMUtoGYRO' Tw^-1 (w_m - b - Tg f)\n"
            f'Ta and Tw {shape} triangular: the other half is not read by the model {model}'
        ),
        source=(
            'rpng/open_vins, ov_msckf/src/core/VioManagerOptions.h, state/Propagator.cpp,'
            ' state/State.h'
        ),
        holds=MATRICES + G_SENSITIVITY,
        estimates=SLOW_OFFSETS,
        numbers=partial(numbers_openvins, shape=shape),
        noise=noise_kalibr,
        noise_is='continuous, as Kalibr',
        write=partial(write_openvins, model=model),
        read=read_openvins,
        imu=imu_openvins,
        hint=(
            'the file named by relative_config_imu; set calib_imu_intrinsics and'
            ' calib_imu_g_sensitivity to false to keep these numbers'
        ),
    )


OPENVINS = (_target('openvins', 'kalibr', 'lower'), _target('openvins-rpng', 'rpng', 'upper'))


LOWER_BY_COLUMNS = ((0, 0), (1, 0), (2, 0), (1, 1), (2, 1), (2, 2))
"""(row, column) of the entries of a lower triangle, in the order of the file."""


def numbers_basalt(imu: AffineImu) -> Numbers:
    """
    Return b and S of both sensors, with ``calibrated = (I + S) raw - b``.

    Hence ``I + S = matrix^-1`` and ``b = matrix^-1 @ bias``. The file has S by columns: for the
    accelerometer its lower triangle (6 numbers), for the gyroscope all of it (9).
    """
    b = {}
    s = {}
    for sensor in SENSORS:
        inverse = np.linalg.inv(imu.matrix[sensor])
        b[sensor] = inverse @ imu.bias[sensor]
        s[sensor] = inverse - np.eye(3)
    lower_triangle = [s['accelerometer'][entry] for entry in LOWER_BY_COLUMNS]
    return {
        'calib_accel_bias': np.array([*b['accelerometer'], *lower_triangle]),
        'calib_gyro_bias': np.array([*b['gyroscope'], *s['gyroscope'].T.ravel()]),
    }


def imu_basalt(numbers: Numbers) -> AffineImu:
    """Return the IMU of b and S, as `numbers_basalt` makes them."""
    accel = np.asarray(numbers['calib_accel_bias'])
    gyro = np.asarray(numbers['calib_gyro_bias'])
    accel_matrix = np.eye(3)
    for entry, value in zip(LOWER_BY_COLUMNS, accel[3:]):
        accel_matrix[entry] += value
    gyro_matrix = np.eye(3) + gyro[3:].reshape(3, 3).T
    return imu_of_corrections(
        {'accelerometer': (accel_matrix, accel[:3]), 'gyroscope': (gyro_matrix, gyro[:3])}
    )


def noise_basalt(noise: Noise) -> Numbers:
    """Return continuous standard deviations, one for each axis."""
    accel, gyro = noise.accelerometer, noise.gyroscope
    return {
        'imu_update_rate': noise.rate,
        'accel_noise_std': [accel.white] * 3,
        'gyro_noise_std': [gyro.white] * 3,
        'accel_bias_std': [accel.walk] * 3,
        'gyro_bias_std': [gyro.walk] * 3,
    }


def accelerometer_lower(imu: AffineImu) -> Placement:
    """Return the placement in which the accelerometer's matrix is lower triangular."""
    _, rotation = lower_times_rotation(imu.matrix['accelerometer'])
    return Placement(mat_ts=rotation)


def write_basalt(page: Page) -> str:
    """Return the JSON; comments follow the content, where basalt does not read."""
    values = {**page.numbers, **(page.noise or {})}
    document = plain({'value0': values, 'comments': page.comments})
    return json.dumps(document, indent=2) + '\n'


def read_basalt(content: bytes, _path: str | Path) -> Read:
    """Read a calibration JSON of basalt."""
    what = 'basalt calibration'
    values = section(read_json(content, what), 'value0', what)
    numbers = {
        'calib_accel_bias': numbers_at(values, 'calib_accel_bias', (9,), what=what),
        'calib_gyro_bias': numbers_at(values, 'calib_gyro_bias', (12,), what=what),
    }
    rate = values.get('imu_update_rate')
    sample_sd = {}
    if isinstance(rate, (int, float)) and rate > 0:
        for sensor, name in (('accelerometer', 'accel_noise_std'), ('gyroscope', 'gyro_noise_std')):
            if name in values:
                densities = numbers_at(values, name, (3,), what=what)
                sample_sd[sensor] = float(np.max(densities) * np.sqrt(rate))
    return Read(numbers=numbers, sample_sd=sample_sd)


BASALT = (
    Target(
        name='basalt',
        title='basalt calibration JSON',
        formula=(
            'calibrated = (I + S) raw - b, the bias after the matrix\n'
            'accelerometer: b and the lower triangle of S, gyroscope: b and the full S, by columns'
        ),
        source='VladyslavUsenko/basalt-headers, calibration/calib_bias.hpp and calibration.hpp',
        holds=OFFSETS + MATRICES,
        estimates=THERMAL_OFFSETS,
        placement=accelerometer_lower,
        numbers=numbers_basalt,
        noise=noise_basalt,
        noise_is='continuous, per axis',
        suffix='.json',
        write=write_basalt,
        read=read_basalt,
        imu=imu_basalt,
        axes='accelerometer_lower_triangular',
        hint=(
            "put these entries into the 'value0' of your calibration.json; the camera entries there"
            ' must refer to the frame named above'
        ),
    ),
)


TARGETS = KALIBR + OPENVINS + BASALT
