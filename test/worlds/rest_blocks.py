"""Blocks of a residual with a bias as the only parameter."""

from types import SimpleNamespace

import numpy as np

from imu_calibration.estimation.sensor_noise import BiasProcess
from imu_calibration.references.turntable.residuals.residual_blocks import BlockMeans
from imu_calibration.selection.stamp_jitter import StampJitter

WINDOWS, EACH = 60, 4
TIME = np.arange(WINDOWS * EACH, dtype=float)
WINDOW = np.repeat(np.arange(WINDOWS), EACH)
STARTS = np.arange(len(TIME))


def blocks_of(rest, rough, locked=np.zeros(len(TIME), bool)):
    """Return the blocks of a residual with a bias as the only parameter."""
    return BlockMeans(
        'gyroscope',
        SimpleNamespace(rate_s=np.ones((len(TIME), 3))),
        starts=STARTS,
        time=TIME,
        window=WINDOW,
        locked=locked,
        design=tuple(np.stack([np.ones(len(TIME)), column], axis=1) for column in rest.T),
        index=tuple(np.zeros((3, 1), int)),
        variance=np.ones((len(TIME), 3)),
        processes=(BiasProcess(0.5, 100.0),),
        rough=rough,
        freedom=np.full(len(TIME), 12.0),
        jitter=StampJitter(0.0, False),
    )
