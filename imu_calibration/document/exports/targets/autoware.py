"""Autoware: parameters of imu_corrector, and the scale factors that it subscribes to."""

import re
from pathlib import Path

import numpy as np

from imu_calibration.core.errors import InputError, shortened
from imu_calibration.document.exports.affine import OFFSETS, SCALES, AffineImu, of
from imu_calibration.document.exports.target import Noise, Page, Read, Target, numbers_at, read_yaml, section, yaml_file
from imu_calibration.effects.base import AXES

SCALE_KEY = 'gyro_scale_input'


def numbers(imu: AffineImu) -> dict:
    """Return offsets and scale factors of the gyroscopes: the same model as ours on the diagonal."""
    offsets = {f'angular_velocity_offset_{a}': value for a, value in zip(AXES, imu.bias['gyroscope'])}
    return {**offsets, SCALE_KEY: np.diag(imu.matrix['gyroscope'])}


def _offset(found):
    return np.array([found[f'angular_velocity_offset_{a}'] for a in AXES])


def imu(found: dict) -> AffineImu:
    """Return the IMU of such numbers."""
    return AffineImu(bias={'accelerometer': np.zeros(3), 'gyroscope': _offset(found)},
                     matrix={'accelerometer': np.eye(3), 'gyroscope': np.diag(found[SCALE_KEY])})


def noise(found: Noise) -> dict:
    """Return standard deviations of samples, the square roots of the covariances in its messages."""
    rate = found.gyroscope.sample_sd(found.rate)
    return {**{f'angular_velocity_stddev_{a}{a}': rate for a in AXES}, 'acceleration_stddev': found.accelerometer.sample_sd(found.rate)}


def write(page: Page) -> str:
    """Return a parameter file."""
    x, y, z = (float(value) for value in page.numbers[SCALE_KEY])
    scale = [f'the file has no scale factors; the node reads them from the topic {SCALE_KEY}, published repeatedly:',
             f'  ros2 topic pub -r 1 {SCALE_KEY} geometry_msgs/msg/Vector3Stamped "{{vector: {{x: {x!r}, y: {y!r}, z: {z!r}}}}}"']
    parameters = {name: value for name, value in page.numbers.items() if name != SCALE_KEY} | (page.noise or {})
    switches = {'correct_for_static_bias': True, 'correct_for_dynamic_bias': False, 'correct_for_scale': True}
    return yaml_file([*page.comments, *scale], {'/**': {'ros__parameters': {**parameters, 'on_off_correction': switches}}})


def read(content: bytes, _path: str | Path) -> Read:
    """Read a parameter file; scale factors only from the comment that `write` makes."""
    what = 'imu_corrector parameter file'
    found = section(section(read_yaml(content, what), '/**', what), 'ros__parameters', what)
    offsets = {name: float(numbers_at(found, name, (), what=what)) for name in (f'angular_velocity_offset_{a}' for a in AXES)}
    scale = re.search(rf'^#.*{SCALE_KEY} .*\{{x: (\S+), y: (\S+), z: ([^}}\s]+)\}}', content.decode(), flags=re.M)
    try:
        values = [float(part) for part in scale.groups()] if scale else [1.0] * 3
    except ValueError as error:
        raise InputError(f'the {what} must repeat three numbers in its comment on {SCALE_KEY}: {shortened(str(error))}; '
                         'correct it') from error
    return Read({**offsets, SCALE_KEY: values}, () if scale else of('gyroscope', SCALES))


TARGETS = (Target(
    name='autoware', title='Autoware imu_corrector parameters',
    formula='rate = (raw - angular_velocity_offset) / gyro_scale_input; specific force unchanged\n'
            'covariances = stddev^2; after the rotation to base_link the largest of the three is used for all',
    source='autowarefoundation/autoware_universe, sensing/autoware_imu_corrector/src/imu_corrector_core.cpp',
    holds=of('gyroscope', OFFSETS + SCALES), numbers=numbers, noise=noise, needs_walk=False,
    noise_is='discrete: standard deviation of a sample', write=write, read=read, imu=imu,
    hint='older versions name the switches on_off_correction.correct_for_bias and have no scale'),)
