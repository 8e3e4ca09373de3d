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
    of,
    undone,
)
from imu_calibration.document.exports.target import (
    Noise,
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


def numbers_imu_calib(imu: AffineImu) -> dict:
    """Return SM by rows and the bias, which is subtracted after the matrix."""
    inverse = np.linalg.inv(imu.matrix['accelerometer'])
    return {'SM': inverse.ravel(), 'bias': inverse @ imu.bias['accelerometer']}


def imu_imu_calib(found: dict) -> AffineImu:
    """Return the IMU of such numbers."""
    return undone({'accelerometer': (np.reshape(found['SM'], (3, 3)), np.asarray(found['bias']))})


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


def imu_imu_tk(found: dict) -> AffineImu:
    """Return the IMU of such numbers; a sensor without a file is perfect."""
    # calibrated = T K raw - T K B.
    corrections = {}
    for sensor, values in found.items():
        numbers = np.asarray(values, float)
        matrix = numbers[:9].reshape(3, 3) @ numbers[9:18].reshape(3, 3)
        corrections[sensor] = (matrix, matrix @ numbers[18:])
    return undone(corrections)


def read_imu_tk(content: bytes, path: str | Path) -> Read:
    """Read the named file and, if present, that of the other sensor in the same folder."""
    path = Path(path)
    own = next(
        (sensor for sensor, ending in ENDINGS.items() if path.suffix == ending), 'accelerometer'
    )
    found = {own: _numbers(content)}
    for sensor, ending in ENDINGS.items():
        beside = path.with_suffix(ending)
        if sensor != own and beside.is_file():
            found[sensor] = _numbers(beside.read_bytes())
    lacks: tuple[Capability, ...] = ()
    for sensor in ENDINGS:
        if sensor not in found:
            lacks += of(sensor, OFFSETS + MATRICES)
    return Read(found, lacks)


def _numbers(content: bytes) -> list[float] | None:
    words = text_of(content, 'imu_tk file').split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    usable = len(values) == COUNT and bool(np.all(np.isfinite(values)))
    if usable:
        misalignment, scale = np.reshape(values[:18], (2, 3, 3))
        usable = all(abs(np.linalg.det(matrix)) > 0 for matrix in (misalignment, scale))
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


def numbers_autoware(imu: AffineImu) -> dict:
    """
    Return offsets and scale factors of the gyroscopes: the same model as ours on the diagonal.
    """
    offsets = {
        f'angular_velocity_offset_{a}': value for a, value in zip(AXES, imu.bias['gyroscope'])
    }
    return {**offsets, SCALE_KEY: np.diag(imu.matrix['gyroscope'])}


def imu_autoware(found: dict) -> AffineImu:
    """Return the IMU of such numbers."""
    offset = np.array([found[f'angular_velocity_offset_{a}'] for a in AXES])
    return AffineImu(
        bias={'accelerometer': np.zeros(3), 'gyroscope': offset},
        matrix={'accelerometer': np.eye(3), 'gyroscope': np.diag(found[SCALE_KEY])},
    )


def noise_autoware(found: Noise) -> dict:
    """
    Return standard deviations of samples, the square roots of the covariances in its messages.
    """
    rate = found.gyroscope.sample_sd(found.rate)
    return {
        **{f'angular_velocity_stddev_{a}{a}': rate for a in AXES},
        'acceleration_stddev': found.accelerometer.sample_sd(found.rate),
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
    parameters = {name: value for name, value in page.numbers.items() if name != SCALE_KEY} | (
        page.noise or {}
    )
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
    found = section(section(read_yaml(content, what), '/**', what), 'ros__parameters', what)
    offsets = {}
    for axis in AXES:
        name = f'angular_velocity_offset_{axis}'
        offsets[name] = float(numbers_at(found, name, (), what=what))
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
    return Read({**offsets, SCALE_KEY: values}, () if scale else of('gyroscope', SCALES))


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
