"""imu_tk: its two files, accelerometer and gyroscope side by side; read only."""

from pathlib import Path

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.document.exports.affine import MATRICES, OFFSETS, AffineImu, of
from imu_calibration.document.exports.target import Read, Target, text_of

ENDINGS = {'accelerometer': '.acc', 'gyroscope': '.gyro'}
COUNT = 21
"""Numbers in a file: misalignment and scale matrices by rows, bias."""


def _parts(found, sensor):
    values = np.asarray(found[sensor], float)
    return values[:9].reshape(3, 3) @ values[9:18].reshape(3, 3), values[18:]


def imu(found: dict) -> AffineImu:
    """Return the IMU of such numbers; a sensor without a file is perfect."""
    matrix, bias = {}, {}
    for sensor in ENDINGS:
        inverse, bias[sensor] = _parts(found, sensor) if sensor in found else (np.eye(3), np.zeros(3))
        matrix[sensor] = np.linalg.inv(inverse)
    return AffineImu(matrix=matrix, bias=bias)


def read(content: bytes, path: str | Path) -> Read:
    """Read the named file and, if present, that of the other sensor in the same folder."""
    path = Path(path)
    own = next((sensor for sensor, ending in ENDINGS.items() if path.suffix == ending), 'accelerometer')
    found = {own: _numbers(content)}
    for sensor, ending in ENDINGS.items():
        beside = path.with_suffix(ending)
        if sensor != own and beside.is_file():
            found[sensor] = _numbers(beside.read_bytes())
    return Read(found, tuple(h for sensor in ENDINGS if sensor not in found for h in of(sensor, OFFSETS + MATRICES)))


def _numbers(content):
    words = text_of(content, 'imu_tk file').split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != COUNT or not np.all(np.isfinite(values)) or not all(
            abs(np.linalg.det(np.reshape(part, (3, 3)))) > 0 for part in (values[:9], values[9:18])):
        raise InputError(f'an imu_tk file must have {COUNT} numbers, misalignment and scale matrices that can be inverted and a bias, got '
                         f'{len(words)} entries; give a different file')
    return values


TARGETS = (Target(
    name='imu-tk', title='imu_tk calibration', formula='calibrated = T K (raw - B)',
    source='A. Pretto, imu_tk, include/imu_tk/calibration.h',
    holds=OFFSETS + MATRICES, read=read, imu=imu, axes='accelerometer_upper_triangular'),)
