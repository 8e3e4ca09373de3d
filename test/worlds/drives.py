"""
A robot that drives and stops.

Specific force and rate of its IMU, with a gyroscope whose bias moves by warming up and by
wandering.
"""

from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.core.samples import ImuSamples
from imu_calibration.core.units import DEG

from worlds.compensation_cases import random_calibration

G = 9.80665
RATE = 100.0
SD = 0.01 * DEG
"""What the calibration says of the bias of the gyroscope, rad/s."""


@dataclass(frozen=True, eq=False)
class Drive:
    """What the IMU reads, and what only the world knows."""

    imu: ImuSamples
    """Readings."""
    true_rate: np.ndarray
    """rad/s, shape (n, 3)."""
    bias: np.ndarray
    """Bias of the gyroscope beyond the calibration, rad/s, shape (n, 3)."""
    still: np.ndarray
    """When it stands, shape (n,)."""
    path: np.ndarray
    """True place in the plane, m, shape (n, 2)."""


def drive(
    seed,
    minutes=10.0,
    *,
    warm_up=(0.0, 0.0, 0.0),
    walk=0.0,
    period=40.0,
    stop=6.0,
    shake=0.0,
    noise=(0.02, 0.002),
    gravity=G,
    tilt=0.02,
):
    """
    Return a Drive on a floor that is tilted a little.

    Parameters
    ----------
    warm_up : sequence of 3 floats
        Bias in the end, rad/s, approached with a time constant of five minutes.
    walk : float
        Random walk of the bias, rad/s per square root of a second.
    period, stop : float
        A stop of `stop` seconds at the end of each `period`.
    shake : float
        Vibration at rest, m/s^2.

    """
    rng, n = np.random.default_rng([seed, 43]), round(minutes * 60 * RATE)
    time = np.arange(n) / RATE
    phase = time % period
    moving = np.clip(np.minimum(phase, period - stop - phase), 0, 1)  # ramps of a second
    leg = (time // period).astype(int)
    turns, speeds = rng.uniform(-0.6, 0.6, leg[-1] + 1), rng.uniform(0.4, 1.2, leg[-1] + 1)
    speed, turn = moving * speeds[leg], moving * turns[leg] * np.sin(2 * np.pi * phase / 9)
    heading = np.cumsum(turn) / RATE
    force = np.stack([np.gradient(speed, 1 / RATE), speed * turn, np.full(n, gravity)], axis=1)
    force[:, 0] += gravity * np.sin(tilt)
    force[:, 2] = gravity * np.cos(tilt)
    rough = moving[:, None] * rng.normal(0, [0.5, 0.5, 0.8], (n, 3)) + shake * rng.normal(
        0, 1, (n, 3)
    )
    rate = np.stack(
        [moving * 0.05 * np.sin(7 * time), moving * 0.05 * np.cos(6 * time), turn], axis=1
    )
    bias = np.asarray(warm_up) * (1 - np.exp(-time / 300))[:, None] + np.cumsum(
        rng.normal(0, walk / np.sqrt(RATE), (n, 3)), axis=0
    )
    read_force, read_rate = (
        force + rough + rng.normal(0, noise[0], (n, 3)),
        rate + bias + rng.normal(0, noise[1], (n, 3)),
    )
    path = (
        np.cumsum(speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
        / RATE
    )
    stamps = 10**18 + np.round(time * 1e9).astype(np.int64)
    return Drive(
        ImuSamples(stamps, read_force, read_rate, 'imu_link'), rate, bias, moving == 0, path
    )


def plain_calibration(offset=0.0):
    """
    A calibration that changes nothing but the gyroscope's bias about z by `offset`.

    The bias is known to SD.
    """
    calibration = random_calibration(1, accelerometer=())
    values, sd = np.zeros(24), np.full(24, 1e-5)
    values[3:12] = values[15:24] = np.eye(3).ravel()
    values[14], sd[:3], sd[12:15] = offset, 0.003, SD
    return replace(
        calibration,
        values=values,
        covariance=np.diag(sd**2),
        conditions=calibration.conditions | {'gravity': G},
    )
