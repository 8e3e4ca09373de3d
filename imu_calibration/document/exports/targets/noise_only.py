"""
Visual, lidar and wheel estimators with noise parameters only; their input is compensated readings.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.document.exports.affine import SLOW_OFFSETS
from imu_calibration.document.exports.target import Noise, Numbers, Page, Target, yaml_file


def _gravity(page: Page) -> float:
    """Return the gravity of the calibration's recording, m/s^2, standard gravity without one."""
    gravity = page.calibration.conditions.get('gravity')
    if isinstance(gravity, (int, float)) and gravity > 0:
        return float(gravity)
    return STANDARD_GRAVITY


def vins(noise: Noise) -> Numbers:
    """
    Return the noise for the midpoint rule.

    The rule weights each of two samples with half a step and multiplies walks by a full one.
    """
    accel, gyro = noise.accelerometer, noise.gyroscope
    return {
        'acc_n': accel.white * (2 * noise.rate) ** 0.5,
        'gyr_n': gyro.white * (2 * noise.rate) ** 0.5,
        'acc_w': accel.walk * noise.rate**0.5,
        'gyr_w': gyro.walk * noise.rate**0.5,
    }


def lio_sam(noise: Noise) -> Numbers:
    """Return continuous densities, as used by gtsam's preintegration."""
    accel, gyro = noise.accelerometer, noise.gyroscope
    return {
        'imuAccNoise': accel.white,
        'imuGyrNoise': gyro.white,
        'imuAccBiasN': accel.walk,
        'imuGyrBiasN': gyro.walk,
    }


def fast_lio(noise: Noise) -> Numbers:
    """Return variances that the filter multiplies with the square of the step."""
    accel, gyro = noise.accelerometer, noise.gyroscope
    return {
        'acc_cov': accel.white**2 * noise.rate,
        'gyr_cov': gyro.white**2 * noise.rate,
        'b_acc_cov': accel.walk**2 * noise.rate,
        'b_gyr_cov': gyro.walk**2 * noise.rate,
    }


def orb_slam3(noise: Noise) -> Numbers:
    """Return continuous densities and the rate with which the program makes them discrete."""
    return {
        'IMU.NoiseGyro': noise.gyroscope.white,
        'IMU.NoiseAcc': noise.accelerometer.white,
        'IMU.GyroWalk': noise.gyroscope.walk,
        'IMU.AccWalk': noise.accelerometer.walk,
        'IMU.Frequency': noise.rate,
    }


def covariances(noise: Noise) -> Numbers:
    """Return the covariances of messages, by rows."""
    gyro = noise.gyroscope.sample_sd(noise.rate) ** 2
    accel = noise.accelerometer.sample_sd(noise.rate) ** 2
    return {
        'angular_velocity_covariance': np.diag([gyro] * 3).ravel().tolist(),
        'linear_acceleration_covariance': np.diag([accel] * 3).ravel().tolist(),
    }


def write(page: Page, inside: str = '', gravity: str = '', *, head: str = '') -> str:
    """
    Return YAML with the noise.

    `inside` is the section of the program, `gravity` its key of gravity, '' where it has none.
    """
    values = dict(page.noise or {})
    if gravity:
        values[gravity] = _gravity(page)
    if inside:
        values = {inside: values}
    return yaml_file(page.comments, values, head)


def _target(
    name: str,
    title: str,
    formula: str,
    source: str,
    noise: Callable,
    noise_is: str,
    writer: Callable,
    **fields: Any,
) -> Target:
    """Return a target with noise only; it estimates slow offsets unless `fields` deny it."""
    return Target(
        name=name,
        title=title,
        formula=formula,
        source=source,
        noise=noise,
        noise_is=noise_is,
        write=writer,
        **{'estimates': SLOW_OFFSETS, **fields},
    )


TARGETS = (
    _target(
        'vins',
        'VINS-Mono and VINS-Fusion noise',
        'midpoint rule: angle variance of a step = 2 (dt/2)^2 gyr_n^2, of the bias (dt gyr_w)^2',
        'HKUST-Aerial-Robotics/VINS-Mono, vins_estimator/src/factor/integration_base.h',
        vins,
        'per sample of the midpoint rule: N sqrt(2 rate), K sqrt(rate)',
        partial(write, gravity='g_norm', head='%YAML:1.0\n'),
        hint='put these lines into the configuration; they hold for this rate only',
    ),
    _target(
        'lio-sam',
        'LIO-SAM noise',
        "gtsam's preintegration: variance of a step = imuGyrNoise^2 dt, of the bias"
        ' imuGyrBiasN^2 dt',
        'TixiaoShan/LIO-SAM, src/imuPreintegration.cpp, config/params.yaml',
        lio_sam,
        'continuous: N, K',
        partial(write, inside='lio_sam', gravity='imuGravity'),
    ),
    _target(
        'fast-lio',
        'FAST-LIO and FAST-LIO2 noise',
        'filter: variance of a step = dt^2 gyr_cov, of the bias dt^2 b_gyr_cov; '
        'acc is scaled by gravity over the mean at the start',
        'hku-mars/FAST_LIO, src/IMU_Processing.hpp, IKFoM esekfom.hpp',
        fast_lio,
        'per sample: N^2 rate, K^2 rate',
        partial(write, inside='mapping'),
        hint='they hold for this rate only',
    ),
    _target(
        'orb-slam3',
        'ORB-SLAM3 noise',
        'discrete inside: Noise sqrt(Frequency), Walk / sqrt(Frequency)',
        'UZ-SLAMLab/ORB_SLAM3, src/Tracking.cc',
        orb_slam3,
        'continuous: N, K',
        partial(write, head='%YAML:1.0\n'),
    ),
    _target(
        'robot-localization',
        'covariances for robot_localization and imu_tools',
        'both use the covariances of the messages only',
        'cra-ros-pkg/robot_localization, CCNYRoboticsLab/imu_tools',
        covariances,
        'discrete: N^2 rate, as in the messages',
        write,
        needs_walk=False,
        estimates=(),
        hint=(
            'compensator_node fills them in by itself; these numbers are for drivers with such'
            ' parameters'
        ),
    ),
)
