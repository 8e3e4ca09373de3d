"""A recording of a second and a calibration, to be damaged."""

import numpy as np
import yaml

from imu_calibration.core.documents import to_text
from imu_calibration.core.samples import ImuSamples, JointSamples
from imu_calibration.document.calibration_text import calibration_to_text
from msg_adapters.write import write_session

from worlds.compensation_cases import random_calibration


def write_small_bag(path, n=200, frame_id='imu_link', **options):
    """Write an IMU at rest and a joint, in which every reading differs; return the path."""
    stamp_ns = 1_700_000_000_000_000_000 + 5_000_000 * np.arange(n)
    wave = 1e-3 * np.sin(np.arange(n))
    force, rate = np.column_stack([wave, -wave, 9.81 + wave]), np.column_stack([wave, wave, -wave])
    joints = JointSamples(stamp_ns, wave[:, np.newaxis], np.full((n, 1), np.nan), ('outer',))
    write_session(path, ImuSamples(stamp_ns, force, rate, frame_id), joints, **options)
    return path


def hostile_calibration():
    """
    Return a calibration of twenty effects whose columns nest powers.

    Each level multiplies the text of the compensation by nine.
    """
    column = 'f_x'
    for _ in range(9):
        column = f'abs({column})**9'
    return with_effects([column] * 20)


def with_effects(columns):
    """A calibration that carries accelerometer effects with these columns."""
    document = yaml.safe_load(calibration_to_text(random_calibration(0, ())))
    names = [f'mine_{k}' for k in range(len(columns))]
    document['effects'] = {
        name: {
            'sensor': 'accelerometer',
            'column': column,
            'unit': '1',
            'tolerance': 1e-3,
            'text': 'mine',
        }
        for name, column in zip(names, columns, strict=True)
    }
    document['accelerometer']['effects'] += names
    document['accelerometer'] |= {
        name: {'value': [0.1] * 3, 'sd': [0.1] * 3, 'unit': '1', 'status': ['determined'] * 3}
        for name in names
    }
    old = len(document['covariance']['names'])
    document['covariance']['names'] += [
        f'accelerometer.{name}.{axis}' for name in names for axis in 'xyz'
    ]
    matrix = 0.01 * np.eye(len(document['covariance']['names']))
    matrix[:old, :old] = document['covariance']['matrix']
    document['covariance']['matrix'] = matrix.tolist()
    return to_text(document)
