"""
Somebody who has only the picture.

Turns the IMU where the arrow points, ten degrees off, holds it with a trembling hand, looks again.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.core.samples import ImuSamples

from worlds.hand_sessions import GRAVITY, random_truth, turn_samples, unpack

PERIOD = 0.01
OFF = np.deg2rad(10.0)
"""Rms of how far the attitude is from the one that was shown."""


class Person:
    """
    An IMU in a hand.

    Parameters
    ----------
    seed : int
    tremor : float
        Rms specific force of the tremor at some 8 Hz, m/s^2.
    creep : float
        Rms rate at which the attitude creeps while it is held, rad/s.
    hold, move : float
        Seconds that a pose is held, and that a turn takes.

    """

    def __init__(self, seed, *, tremor=0.02, creep=5e-4, hold=3.0, move=2.0):
        self.rng = np.random.default_rng([seed, 71])
        self.truth, self.attitude, self.now_ns = random_truth(self.rng), Rotation.identity(), 10**18
        self.tremor, self.creep, self.hold_time, self.move_time = tremor, creep, hold, move
        self.seconds = 0.0

    def hold(self):
        """Return the samples of a pose that is held."""
        count = round(self.hold_time / PERIOD)
        rate = self.rng.normal(0, self.creep, 3)
        held = self.attitude * Rotation.from_rotvec(np.outer(PERIOD * np.arange(count), rate))
        shake = self.tremor * np.sin(
            2 * np.pi * 8 * PERIOD * np.arange(count) + self.rng.uniform(0, 6)
        )
        self.attitude = held[-1]
        return self._read(
            held.inv().apply([0, 0, GRAVITY]) + np.outer(shake, self.rng.normal(0, 1, 3)),
            np.tile(rate, (count, 1)),
        )

    def go(self, axis, angle):
        """
        Return the samples of a turn about an axis of the sensor, and of the end pose.

        The end pose is the pose in which the turn ends, some degrees off.
        """
        aim = (
            Rotation.from_rotvec(np.asarray(axis) * angle)
            * Rotation.from_rotvec(self.rng.normal(0, OFF / np.sqrt(3), 3))
        ).as_rotvec()
        turning, rate = turn_samples(
            self.attitude, aim, self.rng.normal(0, 0.3, 3), PERIOD, self.move_time
        )
        moved = self._read(turning.inv().apply([0, 0, GRAVITY]), rate)
        self.attitude = self.attitude * Rotation.from_rotvec(aim)
        return ImuSamples.concatenate([moved, self.hold()])

    def _read(self, force, rate):
        bias_f, matrix_f, bias_w, matrix_w = unpack(self.truth)
        count = len(force)
        stamps = self.now_ns + np.round(1e9 * PERIOD * np.arange(count)).astype(np.int64)
        self.now_ns, self.seconds = int(stamps[-1] + 1e9 * PERIOD), self.seconds + count * PERIOD
        return ImuSamples(
            stamps,
            force @ matrix_f.T + bias_f + self.rng.normal(0, 0.02, force.shape),
            rate @ matrix_w.T + bias_w + self.rng.normal(0, 0.002, rate.shape),
            'imu_link',
        )
