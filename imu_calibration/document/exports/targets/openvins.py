"""OpenVINS: kalibr_imu_chain.yaml with the intrinsics of its models 'kalibr' and 'rpng'."""

from functools import partial
from pathlib import Path

import numpy as np

from imu_calibration.document.exports.affine import G_SENSITIVITY, MATRICES, SLOW_OFFSETS, AffineImu, lower_times_rotation
from imu_calibration.document.exports.target import Page, Read, Target, numbers_at, read_yaml, section, yaml_file
from imu_calibration.document.exports.targets.kalibr import noise, read_densities

_TURNED_ROUND = np.eye(3)[::-1]


def upper_times_rotation(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (U, Q) with ``matrix = U @ Q``: U upper triangular with positive diagonal, Q a rotation."""
    lower, rotation = lower_times_rotation(_TURNED_ROUND @ matrix @ _TURNED_ROUND)
    return _TURNED_ROUND @ lower @ _TURNED_ROUND, _TURNED_ROUND @ rotation @ _TURNED_ROUND


SHAPES = {'lower': lower_times_rotation, 'upper': upper_times_rotation}
MATRIX_KEYS = ('Tw', 'R_IMUtoGYRO', 'Ta', 'R_IMUtoACC', 'Tg')


def numbers(imu: AffineImu, shape: str) -> dict:
    """Return triangular matrices and the rotations to them; the IMU's axes are unchanged, so that no extrinsic changes."""
    (ta, to_acc), (tw, to_gyro) = (SHAPES[shape](imu.matrix[sensor]) for sensor in ('accelerometer', 'gyroscope'))
    return {'Tw': tw, 'R_IMUtoGYRO': to_gyro, 'Ta': ta, 'R_IMUtoACC': to_acc, 'Tg': imu.cross}


def imu(found: dict) -> AffineImu:
    """Return the IMU of such numbers: ``a_m = Ta R_IMUtoACC f``, ``w_m = Tw R_IMUtoGYRO w + Tg f``."""
    tw, to_gyro, ta, to_acc, tg = (np.asarray(found[name]) for name in MATRIX_KEYS)
    return AffineImu(matrix={'accelerometer': ta @ to_acc, 'gyroscope': tw @ to_gyro}, cross=tg)


def write(page: Page, model: str) -> str:
    """Return kalibr_imu_chain.yaml."""
    known = page.noise if page.noise is not None else {'update_rate': page.rate} if page.rate else {}
    chain = {'T_i_b': np.eye(4), **known, 'model': model, 'rostopic': '/imu/data_raw', 'time_offset': 0.0, **page.numbers}
    return yaml_file(page.comments, {'imu0': chain}, head='%YAML:1.0\n')


def read(content: bytes, _path: str | Path) -> Read:
    """Read a chain; missing entries are the identity, or zero, as in OpenVINS."""
    what = 'OpenVINS chain'
    chain = section(read_yaml(content, what), 'imu0', what)
    found = {name: np.zeros((3, 3)) if name == 'Tg' else np.eye(3) for name in MATRIX_KEYS}
    found |= {name: numbers_at(chain, name, (3, 3), what=what) for name in MATRIX_KEYS if name in chain}
    return Read(found, (), read_densities(chain))


def _target(name: str, model: str, shape: str) -> Target:
    return Target(
        name=name, title=f'OpenVINS kalibr_imu_chain.yaml, model {model}',
        formula='f = R_IMUtoACC\' Ta^-1 (a_m - b); w = R_IMUtoGYRO\' Tw^-1 (w_m - b - Tg f)\n'
                f'Ta and Tw {shape} triangular: the other half is not read by the model {model}',
        source='rpng/open_vins, ov_msckf/src/core/VioManagerOptions.h, state/Propagator.cpp, state/State.h',
        holds=MATRICES + G_SENSITIVITY, estimates=SLOW_OFFSETS, numbers=partial(numbers, shape=shape),
        noise=noise, noise_is='continuous, as Kalibr', write=partial(write, model=model), read=read, imu=imu,
        hint='the file named by relative_config_imu; set calib_imu_intrinsics and calib_imu_g_sensitivity to false to keep these numbers')


TARGETS = (_target('openvins', 'kalibr', 'lower'), _target('openvins-rpng', 'rpng', 'upper'))
