"""
Readings of an IMU on an arm, with gaps, whose true force in the target frame is known exactly.

Sums of sines give rate and angular acceleration at any time.
"""

from dataclasses import dataclass

import numpy as np

from imu_calibration.compensation.compensate import Transfer
from imu_calibration.core.samples import ImuSamples
from imu_calibration.document.calibration import Calibration
from msg_adapters.imu import FIELDS
from validation.imu_messages import parse_imu

from worlds.compensation_cases import random_calibration

START, PERIOD_NS = 10**18, 5_000_000


@dataclass
class ExactMotion:
    """Readings, and what compensation should make of them."""

    calibration: Calibration
    transfer: Transfer
    readings: ImuSamples
    force: np.ndarray
    """True specific force in the target frame, m/s^2, shape (3,)."""
    gaps_s: np.ndarray
    """Gap before each run but the first, s."""

    def normalised_errors(self, messages):
        """Return error / stated sd of the force of published messages, shape (n, 3)."""
        doubles = np.array([parse_imu(message).doubles for message in messages])
        variance = doubles[:, FIELDS['force_cov']][:, ::4]
        return (doubles[:, FIELDS['force_s']] - self.force) / np.sqrt(variance)


def motion(time_s, rng):
    """Return rate and angular acceleration, each (n, 3), rms about 0.5 rad/s and 2 rad/s^2."""
    rate = np.zeros((len(time_s), 3))
    alpha = np.zeros_like(rate)
    for omega in 2.0 * np.pi * rng.uniform(0.2, 1.2, 4):
        amplitude = rng.normal(0.0, 0.4, 3)
        phase = rng.uniform(0.0, 2.0 * np.pi, 3)
        rate += amplitude * np.sin(np.outer(time_s, omega) + phase)
        alpha += amplitude * omega * np.cos(np.outer(time_s, omega) + phase)
    return rate, alpha


def exact_motion(arm, gaps_s, run, seed, lively=1.0, spin=False):
    """
    Return an ExactMotion in runs of `run` readings at 200 Hz, with the gaps between in any order.

    `arm` is the length in metres; `spin` adds a constant rate.
    """
    rng = np.random.default_rng([seed, 60])
    calibration = random_calibration(seed, (), (), sd=1e-9)
    direction = rng.normal(size=3)
    transfer = Transfer.from_pose('base', arm * direction / np.linalg.norm(direction))
    gaps_s = rng.permutation(gaps_s)
    steps_ns = np.full((len(gaps_s) + 1, run), PERIOD_NS)
    steps_ns[1:, 0] += (1e9 * gaps_s).astype(np.int64)
    stamps = START + np.cumsum(steps_ns.ravel())
    rate, alpha = (lively * each for each in motion((stamps - START) * 1e-9, rng))
    rate = rate + spin * rng.normal(0.0, 0.5, 3)
    force_target = np.array([0.0, 0.0, 9.81]) + rng.normal(0.0, 1.0, 3)
    r = transfer.arm_t
    force = force_target + np.cross(alpha, r) + np.cross(rate, np.cross(rate, r))
    noise = {sensor: calibration.noise(sensor)[0] for sensor in ('accelerometer', 'gyroscope')}
    readings = ImuSamples(
        stamps,
        force @ calibration.value('accelerometer', 'matrix').T
        + calibration.value('accelerometer', 'bias')
        + noise['accelerometer'] * rng.normal(size=force.shape),
        rate @ calibration.value('gyroscope', 'matrix').T
        + calibration.value('gyroscope', 'bias')
        + noise['gyroscope'] * rng.normal(size=rate.shape),
        'imu_link',
    )
    return ExactMotion(calibration, transfer, readings, force_target, gaps_s)
