"""
imu_calib (ROS 1, and its ports to ROS 2), imu_tk (read only) and Autoware.

Matrices, offsets or scale factors of triads.
"""

import re
from pathlib import Path

import numpy as np

from imu_calibration.core.errors import InputError, shortened
from imu_calibration.document.exports.affine import (
    MATRICES,
    OFFSETS,
    SCALES,
    AffineImu,
    Capability,
    imu_of_corrections,
    of,
)
from imu_calibration.document.exports.target import (
    Noise,
    Numbers,
    Page,
    Read,
    Target,
    numbers_at,
    read_yaml,
    section,
    text_of,
    yaml_file,
)
from imu_calibration.effects.base import AXES


def numbers_imu_calib(imu: AffineImu) -> Numbers:
    """Return SM by rows and the bias, which is subtracted after the matrix."""
    inverse = np.linalg.inv(imu.matrix['accelerometer'])
    return {'SM': inverse.ravel(), 'bias': inverse @ imu.bias['accelerometer']}


def imu_imu_calib(numbers: Numbers) -> AffineImu:
    """Return the IMU of SM and bias."""
    matrix = np.reshape(numbers['SM'], (3, 3))
    return imu_of_corrections({'accelerometer': (matrix, np.asarray(numbers['bias']))})


def write_imu_calib(page: Page) -> str:
    """Return the YAML file."""
    return yaml_file(page.comments, page.numbers)


def read_imu_calib(content: bytes, _path: str | Path) -> Read:
    """Read the YAML file."""
    what = 'imu_calib file'
    mapping = read_yaml(content, what)
    return Read(
        {
            'SM': numbers_at(mapping, 'SM', (9,), what=what),
            'bias': numbers_at(mapping, 'bias', (3,), what=what),
        }
    )


IMU_CALIB = (
    Target(
        name='imu-calib',
        title='imu_calib YAML (ROS 1 and ROS 2)',
        formula=(
            'corrected = SM raw - bias of the accelerometer, SM by rows; the gyroscopes lose the'
            ' mean of their first readings'
        ),
        source='dpkoch/imu_calib, src/accel_calib.cpp',
        holds=of('accelerometer', OFFSETS + MATRICES),
        estimates=of('gyroscope', OFFSETS),
        numbers=numbers_imu_calib,
        write=write_imu_calib,
        read=read_imu_calib,
        imu=imu_imu_calib,
        hint='set calibrate_gyros to true and keep the robot still at the start',
    ),
)


ENDINGS = {'accelerometer': '.acc', 'gyroscope': '.gyro'}
COUNT = 21
"""Numbers in a file: misalignment and scale matrices by rows, bias."""


def imu_imu_tk(numbers: Numbers) -> AffineImu:
    """Return the IMU of {sensor: T, K by rows and B}; a sensor without a file is perfect."""
    corrections = {}
    for sensor, entries in numbers.items():
        values = np.asarray(entries, float)
        misalignment = values[:9].reshape(3, 3)
        scale = values[9:18].reshape(3, 3)
        # calibrated = T K raw - T K B.
        matrix = misalignment @ scale
        corrections[sensor] = (matrix, matrix @ values[18:])
    return imu_of_corrections(corrections)


def read_imu_tk(content: bytes, path: str | Path) -> Read:
    """Read the named file and, if present, that of the other sensor in the same folder."""
    path = Path(path)
    sensor_of_ending = {ending: sensor for sensor, ending in ENDINGS.items()}
    named_sensor = sensor_of_ending.get(path.suffix, 'accelerometer')
    numbers = {named_sensor: _numbers(content)}
    for sensor, ending in ENDINGS.items():
        other_file = path.with_suffix(ending)
        if sensor != named_sensor and other_file.is_file():
            numbers[sensor] = _numbers(other_file.read_bytes())
    lacks: tuple[Capability, ...] = ()
    for sensor in ENDINGS:
        if sensor not in numbers:
            lacks += of(sensor, OFFSETS + MATRICES)
    return Read(numbers=numbers, lacks=lacks)


def _numbers(content: bytes) -> list[float]:
    """Return the 21 numbers of a file; both matrices in them must have an inverse."""
    words = text_of(content, 'imu_tk file').split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    usable = len(values) == COUNT and bool(np.all(np.isfinite(values)))
    if usable:
        misalignment, scale = np.reshape(values[:18], (2, 3, 3))
        usable = abs(np.linalg.det(misalignment)) > 0 and abs(np.linalg.det(scale)) > 0
    if not usable:
        raise InputError(
            f'an imu_tk file must have {COUNT} numbers, misalignment and scale matrices that can be'
            f' inverted and a bias, got {len(words)} entries; give a different file'
        )
    return values


IMU_TK = (
    Target(
        name='imu-tk',
        title='imu_tk calibration',
        formula='calibrated = T K (raw - B)',
        source='A. Pretto, imu_tk, include/imu_tk/calibration.h',
        holds=OFFSETS + MATRICES,
        read=read_imu_tk,
        imu=imu_imu_tk,
        axes='accelerometer_upper_triangular',
    ),
)


SCALE_KEY = 'gyro_scale_input'


def numbers_autoware(imu: AffineImu) -> Numbers:
    """
    Return offsets and scale factors of the gyroscopes: the same model as ours on the diagonal.
    """
    offsets = {
        f'angular_velocity_offset_{a}': value for a, value in zip(AXES, imu.bias['gyroscope'])
    }
    return {**offsets, SCALE_KEY: np.diag(imu.matrix['gyroscope'])}


def imu_autoware(numbers: Numbers) -> AffineImu:
    """Return the IMU of offsets and scale factors of the gyroscopes."""
    offset = np.array([numbers[f'angular_velocity_offset_{a}'] for a in AXES])
    return AffineImu(
        bias={'accelerometer': np.zeros(3), 'gyroscope': offset},
        matrix={'accelerometer': np.eye(3), 'gyroscope': np.diag(numbers[SCALE_KEY])},
    )


def noise_autoware(noise: Noise) -> Numbers:
    """
    Return standard deviations of samples, the square roots of the covariances in its messages.
    """
    rate_sd = noise.gyroscope.sample_sd(noise.rate)
    return {
        **{f'angular_velocity_stddev_{a}{a}': rate_sd for a in AXES},
        'acceleration_stddev': noise.accelerometer.sample_sd(noise.rate),
    }


def write_autoware(page: Page) -> str:
    """Return a parameter file."""
    x, y, z = (float(value) for value in page.numbers[SCALE_KEY])
    scale = [
        (
            f'the file has no scale factors; the node reads them from the topic {SCALE_KEY},'
            ' published repeatedly:'
        ),
        (
            f'  ros2 topic pub -r 1 {SCALE_KEY} geometry_msgs/msg/Vector3Stamped "{{vector: {{x:'
            f' {x!r}, y: {y!r}, z: {z!r}}}}}"'
        ),
    ]
    parameters = {name: value for name, value in page.numbers.items() if name != SCALE_KEY}
    parameters |= page.noise or {}
    switches = {
        'correct_for_static_bias': True,
        'correct_for_dynamic_bias': False,
        'correct_for_scale': True,
    }
    return yaml_file(
        [*page.comments, *scale],
        {'/**': {'ros__parameters': {**parameters, 'on_off_correction': switches}}},
    )


def read_autoware(content: bytes, _path: str | Path) -> Read:
    """Read a parameter file; scale factors only from the comment that `write_autoware` makes."""
    what = 'imu_corrector parameter file'
    nodes = section(read_yaml(content, what), '/**', what)
    parameters = section(nodes, 'ros__parameters', what)
    offsets = {}
    for axis in AXES:
        name = f'angular_velocity_offset_{axis}'
        offsets[name] = float(numbers_at(parameters, name, (), what=what))
    scale = re.search(
        rf'^#.*{SCALE_KEY} .*\{{x: (\S+), y: (\S+), z: ([^}}\s]+)\}}', content.decode(), flags=re.M
    )
    try:
        values = [float(part) for part in scale.groups()] if scale else [1.0] * 3
    except ValueError as error:
        raise InputError(
            f'the {what} must repeat three numbers in its comment on {SCALE_KEY}:'
            f' {shortened(str(error))}; correct it'
        ) from error
    lacks = () if scale else of('gyroscope', SCALES)
    return Read(numbers={**offsets, SCALE_KEY: values}, lacks=lacks)


AUTOWARE = (
    Target(
        name='autoware',
        title='Autoware imu_corrector parameters',
        formula=(
            'rate = (raw - angular_velocity_offset) / gyro_scale_input; specific force'
            ' unchanged\ncovariances = stddev^2; after the rotation to base_link the largest of the'
            ' three is used for all'
        ),
        source=(
            'autowarefoundation/autoware_universe,'
            ' sensing/autoware_imu_corrector/src/imu_corrector_core.cpp'
        ),
        holds=of('gyroscope', OFFSETS + SCALES),
        numbers=numbers_autoware,
        noise=noise_autoware,
        needs_walk=False,
        noise_is='discrete: standard deviation of a sample',
        write=write_autoware,
        read=read_autoware,
        imu=imu_autoware,
        hint=(
            'older versions name the switches on_off_correction.correct_for_bias and have no scale'
        ),
    ),
)


TARGETS = IMU_CALIB + IMU_TK + AUTOWARE
