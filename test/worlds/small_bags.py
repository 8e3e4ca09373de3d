"""A recording of a second, to be damaged."""

import numpy as np

from imu_calibration.samples import ImuSamples, JointSamples
from msg_adapters.write import write_session


def write_small_bag(path, n=200, frame_id='imu_link', **options):
    """Write an IMU at rest and a joint, in which every reading differs; return the path."""
    stamp_ns = 1_700_000_000_000_000_000 + 5_000_000 * np.arange(n)
    wave = 1e-3 * np.sin(np.arange(n))
    force, rate = np.column_stack([wave, -wave, 9.81 + wave]), np.column_stack([wave, wave, -wave])
    joints = JointSamples(stamp_ns, wave[:, np.newaxis], np.full((n, 1), np.nan), ('outer',))
    write_session(path, ImuSamples(stamp_ns, force, rate, frame_id), joints, **options)
    return path
