"""basalt: the IMU's part of its calibration JSON."""

import json
from pathlib import Path

import numpy as np

from imu_calibration.core.documents import plain
from imu_calibration.document.exports.affine import MATRICES, OFFSETS, THERMAL_OFFSETS, AffineImu, Placement, lower_times_rotation
from imu_calibration.document.exports.target import Noise, Page, Read, Target, numbers_at, read_json, section

LOWER_BY_COLUMNS = ((0, 0), (1, 0), (2, 0), (1, 1), (2, 1), (2, 2))


def numbers(imu: AffineImu) -> dict:
    """Return biases (after the matrix) and matrices minus identity, by columns: a lower triangle; the full matrix for the gyroscope."""
    inverse = {sensor: np.linalg.inv(matrix) for sensor, matrix in imu.matrix.items()}
    bias = {sensor: inverse[sensor] @ imu.bias[sensor] for sensor in inverse}
    extra = {sensor: matrix - np.eye(3) for sensor, matrix in inverse.items()}
    return {'calib_accel_bias': np.array([*bias['accelerometer'], *(extra['accelerometer'][at] for at in LOWER_BY_COLUMNS)]),
            'calib_gyro_bias': np.array([*bias['gyroscope'], *extra['gyroscope'].T.ravel()])}


def _parts(found):
    """Return {sensor: (I + S, b)}."""
    accel, gyro = np.asarray(found['calib_accel_bias']), np.asarray(found['calib_gyro_bias'])
    lower = np.eye(3)
    for at, value in zip(LOWER_BY_COLUMNS, accel[3:]):
        lower[at] += value
    return {'accelerometer': (lower, accel[:3]), 'gyroscope': (np.eye(3) + gyro[3:].reshape(3, 3).T, gyro[:3])}


def imu(found: dict) -> AffineImu:
    """Return the IMU of such numbers."""
    matrix = {sensor: np.linalg.inv(turn) for sensor, (turn, _) in _parts(found).items()}
    return AffineImu(matrix=matrix, bias={sensor: matrix[sensor] @ bias for sensor, (_, bias) in _parts(found).items()})


def noise(found: Noise) -> dict:
    """Return continuous standard deviations, one for each axis."""
    accel, gyro = found.accelerometer, found.gyroscope
    return {'imu_update_rate': found.rate, 'accel_noise_std': [accel.white] * 3, 'gyro_noise_std': [gyro.white] * 3,
            'accel_bias_std': [accel.walk] * 3, 'gyro_bias_std': [gyro.walk] * 3}


def accelerometer_lower(imu: AffineImu) -> Placement:
    """Return the placement in which the accelerometer's matrix is lower triangular."""
    return Placement(mat_ts=lower_times_rotation(imu.matrix['accelerometer'])[1])


def write(page: Page) -> str:
    """Return the JSON; comments follow the content, where basalt does not read."""
    return json.dumps(plain({'value0': {**page.numbers, **(page.noise or {})}, 'comments': page.comments}), indent=2) + '\n'


def read(content: bytes, _path: str | Path) -> Read:
    """Read a calibration JSON of basalt."""
    what = 'basalt calibration'
    values = section(read_json(content, what), 'value0', what)
    found = {name: numbers_at(values, name, (size,), what=what) for name, size in (('calib_accel_bias', 9), ('calib_gyro_bias', 12))}
    rate, sample_sd = values.get('imu_update_rate'), {}
    if isinstance(rate, (int, float)) and rate > 0:
        for sensor, name in (('accelerometer', 'accel_noise_std'), ('gyroscope', 'gyro_noise_std')):
            if name in values:
                sample_sd[sensor] = float(np.max(numbers_at(values, name, (3,), what=what)) * np.sqrt(rate))
    return Read(found, (), sample_sd)


TARGETS = (Target(
    name='basalt', title='basalt calibration JSON',
    formula='calibrated = (I + S) raw - b, the bias after the matrix\n'
            'accelerometer: b and the lower triangle of S, gyroscope: b and the full S, by columns',
    source='VladyslavUsenko/basalt-headers, calibration/calib_bias.hpp and calibration.hpp',
    holds=OFFSETS + MATRICES, estimates=THERMAL_OFFSETS, placement=accelerometer_lower, numbers=numbers, noise=noise,
    noise_is='continuous, per axis', suffix='.json', write=write, read=read, imu=imu, axes='accelerometer_lower_triangular',
    hint="put these entries into the 'value0' of your calibration.json; the camera entries there must refer to the frame named above"),)
