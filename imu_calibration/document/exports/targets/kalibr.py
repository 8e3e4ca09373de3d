"""Kalibr: imu.yaml with noise densities and the intrinsics of its models scale-misalignment and scale-misalignment-size-effect."""

from pathlib import Path
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError, shortened
from imu_calibration.document.exports.affine import ARMS, G_SENSITIVITY, MATRICES, SLOW_OFFSETS, AffineImu, Placement, lower_times_rotation
from imu_calibration.document.exports.target import Noise, Page, Read, Target, numbers_at, read_yaml, section, yaml_file
from imu_calibration.effects.base import SENSORS

LEVERS = ('rx_i', 'ry_i', 'rz_i')
DENSITIES = {'accelerometer': ('accelerometer_noise_density', 'accelerometer_random_walk'),
             'gyroscope': ('gyroscope_noise_density', 'gyroscope_random_walk')}


def numbers(imu: AffineImu) -> dict:
    """
    Return M, C_gyro_i, A and lever arms of an IMU in the axes of its accelerometer, at its x accelerometer.

    ``matrix_g = M C`` and ``A C = cross``: Kalibr's A acts on specific force in the gyroscope's axes.
    """
    gyro, turn = lower_times_rotation(imu.matrix['gyroscope'])
    arms = {'model': 'scale-misalignment-size-effect'} if np.any(imu.arms) else {'model': 'scale-misalignment'}
    levers = dict(zip(LEVERS, imu.arms)) if np.any(imu.arms) else {}
    return {**arms, 'accelerometers': {'M': np.tril(imu.matrix['accelerometer']), **levers},
            'gyroscopes': {'M': gyro, 'C_gyro_i': turn, 'A': imu.cross @ turn.T}}


def imu(found: dict) -> AffineImu:
    """Return the IMU of such numbers."""
    accelerometers, gyroscopes = found['accelerometers'], found['gyroscopes']
    turn = np.asarray(gyroscopes['C_gyro_i'])
    arms = np.array([accelerometers[name] for name in LEVERS]) if LEVERS[0] in accelerometers else np.zeros((3, 3))
    return AffineImu(matrix={'accelerometer': np.asarray(accelerometers['M']), 'gyroscope': np.asarray(gyroscopes['M']) @ turn},
                     cross=np.asarray(gyroscopes['A']) @ turn, arms=arms)


def noise(found: Noise) -> dict:
    """Return continuous densities."""
    return {key: value for sensor in SENSORS for d in [getattr(found, sensor)]
            for key, value in zip(DENSITIES[sensor], (d.white, d.walk))} | {'update_rate': found.rate}


def write(page: Page) -> str:
    """Return imu.yaml."""
    known = page.noise if page.noise is not None else {'update_rate': page.rate} if page.rate else {}
    return yaml_file(page.comments, {'rostopic': '/imu/data_raw', **known, 'T_i_b': np.eye(4), 'time_offset': 0.0, **page.numbers})


def read_densities(mapping: dict[str, Any]) -> dict[str, float]:
    """Return {sensor: sd of a sample} from noise densities and the rate."""
    rate: Any = mapping.get('update_rate')
    values: dict[str, Any] = {sensor: mapping.get(names[0]) for sensor, names in DENSITIES.items()}
    if not all(isinstance(v, (int, float)) and v > 0 for v in (rate, *values.values())):
        return {}
    return {sensor: float(value) * float(rate)**0.5 for sensor, value in values.items()}


def read(content: bytes, _path: str | Path) -> Read:
    """Read files of kalibr_calibrate_imu_camera (``imu0: ...``) and of `write`."""
    what = 'Kalibr result'
    mapping = read_yaml(content, what)
    mapping = section(mapping, 'imu0', what) if 'imu0' in mapping else mapping
    if 'accelerometers' not in mapping:
        model = shortened(str(mapping.get('model', 'calibrated')))
        raise InputError(f"the {what} must come of a model with intrinsics, its model is '{model}'; run Kalibr with scale-misalignment")
    a, g = section(mapping, 'accelerometers', what), section(mapping, 'gyroscopes', what)
    arms = {name: numbers_at(a, name, (3,), what=what) for name in LEVERS if name in a}
    found = {'model': mapping.get('model'), 'accelerometers': {'M': numbers_at(a, 'M', (3, 3), what=what), **arms},
             'gyroscopes': {name: numbers_at(g, name, (3, 3), what=what) for name in ('M', 'C_gyro_i', 'A')}}
    return Read(found, () if arms else ARMS, read_densities(mapping))


def accelerometer_lower_at_x(imu: AffineImu) -> Placement:
    """Return the placement with a lower triangular accelerometer matrix and the origin in the sensitive point of the x accelerometer."""
    return Placement(mat_ts=lower_times_rotation(imu.matrix['accelerometer'])[1], origin_s=imu.arms[0])


def at_the_mean(found: AffineImu) -> Placement:
    """Return our placement: the same axes, the origin in the mean of the sensitive points."""
    return Placement(origin_s=found.arms.mean(axis=0))


TARGETS = (Target(
    name='kalibr', title='Kalibr imu.yaml',
    formula='a_m = M (f + [W r]) + b with (W r)_i of the arm r_i of axis i, W = [alpha x] + [w x]^2\n'
            'w_m = M C_gyro_i w + A C_gyro_i f + b; M lower triangular; rx_i = 0: the origin is the x accelerometer',
    source='ethz-asl/kalibr, kalibr_imu_camera_calibration/IccSensors.py and kalibr_common/ConfigReader.py',
    holds=MATRICES + G_SENSITIVITY + ARMS, estimates=SLOW_OFFSETS, placement=accelerometer_lower_at_x, numbers=numbers,
    noise=noise, noise_is='continuous: N in m/s^2/sqrt(Hz), rad/s/sqrt(Hz), K in m/s^3/sqrt(Hz), rad/s^2/sqrt(Hz)',
    write=write, read=read, imu=imu, back=at_the_mean, axes='accelerometer_lower_triangular',
    hint='Kalibr reads the topic, the rate and the noise, and estimates all other values; its intrinsics have the format of its output'),)
