"""imu_calib (ROS 1, and its ports to ROS 2): the YAML file of the accelerometer."""

from pathlib import Path

import numpy as np

from imu_calibration.document.exports.affine import MATRICES, OFFSETS, AffineImu, of
from imu_calibration.document.exports.target import Page, Read, Target, numbers_at, read_yaml, yaml_file


def numbers(imu: AffineImu) -> dict:
    """Return SM by rows and the bias, which is subtracted after the matrix."""
    inverse = np.linalg.inv(imu.matrix['accelerometer'])
    return {'SM': inverse.ravel(), 'bias': inverse @ imu.bias['accelerometer']}


def _parts(found):
    return np.reshape(found['SM'], (3, 3)), np.asarray(found['bias'])


def imu(found: dict) -> AffineImu:
    """Return the IMU of such numbers."""
    inverse = np.linalg.inv(_parts(found)[0])
    return AffineImu(bias={'accelerometer': inverse @ _parts(found)[1], 'gyroscope': np.zeros(3)},
                     matrix={'accelerometer': inverse, 'gyroscope': np.eye(3)})


def write(page: Page) -> str:
    """Return the YAML file."""
    return yaml_file(page.comments, page.numbers)


def read(content: bytes, _path: str | Path) -> Read:
    """Read the YAML file."""
    what = 'imu_calib file'
    mapping = read_yaml(content, what)
    return Read({'SM': numbers_at(mapping, 'SM', (9,), what=what), 'bias': numbers_at(mapping, 'bias', (3,), what=what)})


TARGETS = (Target(
    name='imu-calib', title='imu_calib YAML (ROS 1 and ROS 2)',
    formula='corrected = SM raw - bias of the accelerometer, SM by rows; the gyroscopes lose the mean of their first readings',
    source='dpkoch/imu_calib, src/accel_calib.cpp', holds=of('accelerometer', OFFSETS + MATRICES), estimates=of('gyroscope', OFFSETS),
    numbers=numbers, write=write, read=read, imu=imu,
    hint='set calibrate_gyros to true and keep the robot still at the start'),)
