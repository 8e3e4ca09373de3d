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
    lower_times_rotation,
    undone,
)
from imu_calibration.document.exports.target import (
    Noise,
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


def numbers_kalibr(imu: AffineImu) -> dict:
    """
    Return M, C_gyro_i, A and lever arms of an IMU in its accelerometer's axes.

    The origin is at the x accelerometer of the IMU.

    ``matrix_g = M C`` and ``A C = cross``: Kalibr's A acts on specific force in the gyroscope's
    axes.
    """
    gyro, turn = lower_times_rotation(imu.matrix['gyroscope'])
    arms = (
        {'model': 'scale-misalignment-size-effect'}
        if np.any(imu.arms)
        else {'model': 'scale-misalignment'}
    )
    levers = dict(zip(LEVERS, imu.arms)) if np.any(imu.arms) else {}
    return {
        **arms,
        'accelerometers': {'M': np.tril(imu.matrix['accelerometer']), **levers},
        'gyroscopes': {'M': gyro, 'C_gyro_i': turn, 'A': imu.cross @ turn.T},
    }


def imu_kalibr(found: dict) -> AffineImu:
    """Return the IMU of such numbers."""
    accelerometers = found['accelerometers']
    gyroscopes = found['gyroscopes']
    turn = np.asarray(gyroscopes['C_gyro_i'])
    arms = (
        np.array([accelerometers[name] for name in LEVERS])
        if LEVERS[0] in accelerometers
        else np.zeros((3, 3))
    )
    return AffineImu(
        matrix={
            'accelerometer': np.asarray(accelerometers['M']),
            'gyroscope': np.asarray(gyroscopes['M']) @ turn,
        },
        cross=np.asarray(gyroscopes['A']) @ turn,
        arms=arms,
    )


def noise_kalibr(found: Noise) -> dict:
    """Return continuous densities."""
    accel, gyro = found.accelerometer, found.gyroscope
    return {
        'accelerometer_noise_density': accel.white,
        'accelerometer_random_walk': accel.walk,
        'gyroscope_noise_density': gyro.white,
        'gyroscope_random_walk': gyro.walk,
        'update_rate': found.rate,
    }


def _sensor_entries(page: Page) -> dict[str, float | np.ndarray | str]:
    """Return the entries of an IMU in addition to its intrinsics."""
    known = {'update_rate': page.rate} if page.rate else {}
    if page.noise is not None:
        known = page.noise
    return {'rostopic': '/imu/data_raw', **known, 'T_i_b': np.eye(4), 'time_offset': 0.0}


def write_kalibr(page: Page) -> str:
    """Return imu.yaml."""
    return yaml_file(page.comments, _sensor_entries(page) | page.numbers)


def read_densities(mapping: dict[str, Any]) -> dict[str, float]:
    """Return {sensor: sd of a sample} from noise densities and the rate."""
    rate: Any = mapping.get('update_rate')
    values: dict[str, Any] = {sensor: mapping.get(f'{sensor}_noise_density') for sensor in SENSORS}
    if not all(isinstance(v, (int, float)) and v > 0 for v in (rate, *values.values())):
        return {}
    return {sensor: float(value) * float(rate) ** 0.5 for sensor, value in values.items()}


def read_kalibr(content: bytes, _path: str | Path) -> Read:
    """Read files of kalibr_calibrate_imu_camera (``imu0: ...``) and of `write_kalibr`."""
    what = 'Kalibr result'
    mapping = read_yaml(content, what)
    mapping = section(mapping, 'imu0', what) if 'imu0' in mapping else mapping
    if 'accelerometers' not in mapping:
        model = shortened(str(mapping.get('model', 'calibrated')))
        raise InputError(
            f"the {what} must come of a model with intrinsics, its model is '{model}'; run Kalibr"
            ' with scale-misalignment'
        )
    a = section(mapping, 'accelerometers', what)
    g = section(mapping, 'gyroscopes', what)
    arms = {name: numbers_at(a, name, (3,), what=what) for name in LEVERS if name in a}
    found = {
        'model': mapping.get('model'),
        'accelerometers': {'M': numbers_at(a, 'M', (3, 3), what=what), **arms},
        'gyroscopes': {
            name: numbers_at(g, name, (3, 3), what=what) for name in ('M', 'C_gyro_i', 'A')
        },
    }
    return Read(found, () if arms else ARMS, read_densities(mapping))


def accelerometer_lower_at_x(imu: AffineImu) -> Placement:
    """
    Return the placement in the axes and at the origin of the accelerometer.

    The accelerometer matrix is lower triangular, and the origin is in the sensitive point of the x
    accelerometer.
    """
    return Placement(
        mat_ts=lower_times_rotation(imu.matrix['accelerometer'])[1], origin_s=imu.arms[0]
    )


def at_the_mean(found: AffineImu) -> Placement:
    """Return our placement: the same axes, the origin in the mean of the sensitive points."""
    return Placement(origin_s=found.arms.mean(axis=0))


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


_TURNED_ROUND = np.eye(3)[::-1]


def upper_times_rotation(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (U, Q) with ``matrix = U @ Q``: U upper triangular with positive diagonal, Q a rotation.
    """
    lower, rotation = lower_times_rotation(_TURNED_ROUND @ matrix @ _TURNED_ROUND)
    return _TURNED_ROUND @ lower @ _TURNED_ROUND, _TURNED_ROUND @ rotation @ _TURNED_ROUND


SHAPES = {'lower': lower_times_rotation, 'upper': upper_times_rotation}
MATRIX_KEYS = ('Tw', 'R_IMUtoGYRO', 'Ta', 'R_IMUtoACC', 'Tg')


def numbers_openvins(imu: AffineImu, shape: str) -> dict:
    """
    Return triangular matrices and the rotations to them.

    The IMU's axes are unchanged, so that no extrinsic changes.
    """
    (ta, to_acc), (tw, to_gyro) = (
        SHAPES[shape](imu.matrix[sensor]) for sensor in ('accelerometer', 'gyroscope')
    )
    return {'Tw': tw, 'R_IMUtoGYRO': to_gyro, 'Ta': ta, 'R_IMUtoACC': to_acc, 'Tg': imu.cross}


def imu_openvins(found: dict) -> AffineImu:
    """
    Return the IMU of such numbers: ``a_m = Ta R_IMUtoACC f``, ``w_m = Tw R_IMUtoGYRO w + Tg f``.
    """
    tw, to_gyro, ta, to_acc, tg = (np.asarray(found[name]) for name in MATRIX_KEYS)
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
    found = {name: np.zeros((3, 3)) if name == 'Tg' else np.eye(3) for name in MATRIX_KEYS}
    found |= {
        name: numbers_at(chain, name, (3, 3), what=what) for name in MATRIX_KEYS if name in chain
    }
    return Read(found, (), read_densities(chain))


def _target(name: str, model: str, shape: str) -> Target:
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


def numbers_basalt(imu: AffineImu) -> dict:
    """
    Return biases (after the matrix) and matrices minus identity, by columns: a lower triangle.

    The full matrix for the gyroscope.
    """
    inverse = {sensor: np.linalg.inv(matrix) for sensor, matrix in imu.matrix.items()}
    bias = {sensor: inverse[sensor] @ imu.bias[sensor] for sensor in inverse}
    extra = {sensor: matrix - np.eye(3) for sensor, matrix in inverse.items()}
    return {
        'calib_accel_bias': np.array(
            [*bias['accelerometer'], *(extra['accelerometer'][at] for at in LOWER_BY_COLUMNS)]
        ),
        'calib_gyro_bias': np.array([*bias['gyroscope'], *extra['gyroscope'].T.ravel()]),
    }


def imu_basalt(found: dict) -> AffineImu:
    """Return the IMU of such numbers."""
    accel = np.asarray(found['calib_accel_bias'])
    gyro = np.asarray(found['calib_gyro_bias'])
    lower = np.eye(3)
    for at, value in zip(LOWER_BY_COLUMNS, accel[3:]):
        lower[at] += value
    return undone(
        {
            'accelerometer': (lower, accel[:3]),
            'gyroscope': (np.eye(3) + gyro[3:].reshape(3, 3).T, gyro[:3]),
        }
    )


def noise_basalt(found: Noise) -> dict:
    """Return continuous standard deviations, one for each axis."""
    accel, gyro = found.accelerometer, found.gyroscope
    return {
        'imu_update_rate': found.rate,
        'accel_noise_std': [accel.white] * 3,
        'gyro_noise_std': [gyro.white] * 3,
        'accel_bias_std': [accel.walk] * 3,
        'gyro_bias_std': [gyro.walk] * 3,
    }


def accelerometer_lower(imu: AffineImu) -> Placement:
    """Return the placement in which the accelerometer's matrix is lower triangular."""
    return Placement(mat_ts=lower_times_rotation(imu.matrix['accelerometer'])[1])


def write_basalt(page: Page) -> str:
    """Return the JSON; comments follow the content, where basalt does not read."""
    return (
        json.dumps(
            plain({'value0': {**page.numbers, **(page.noise or {})}, 'comments': page.comments}),
            indent=2,
        )
        + '\n'
    )


def read_basalt(content: bytes, _path: str | Path) -> Read:
    """Read a calibration JSON of basalt."""
    what = 'basalt calibration'
    values = section(read_json(content, what), 'value0', what)
    found = {
        name: numbers_at(values, name, (size,), what=what)
        for name, size in (('calib_accel_bias', 9), ('calib_gyro_bias', 12))
    }
    rate = values.get('imu_update_rate')
    sample_sd = {}
    if isinstance(rate, (int, float)) and rate > 0:
        for sensor, name in (('accelerometer', 'accel_noise_std'), ('gyroscope', 'gyro_noise_std')):
            if name in values:
                sample_sd[sensor] = float(
                    np.max(numbers_at(values, name, (3,), what=what)) * np.sqrt(rate)
                )
    return Read(found, (), sample_sd)


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
