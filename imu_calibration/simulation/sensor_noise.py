"""
Noise of simulated sensors, encoders and clocks, and faults beyond the model.

The inertial sensors, encoders and clocks have noise by grade, and the faults follow their physics.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.units import DEG, DEG_H, MICRO_G, STANDARD_GRAVITY
from imu_calibration.kinematics.signal_history import autoregressive


@dataclass(frozen=True)
class SimulatedNoise:
    """
    Random errors of one IMU and of its reference.

    The bias wander is a stationary first-order Gauss-Markov process; its standard deviation is the
    data sheet's in-run instability.
    """

    accel_density: float = 0.0
    """White noise of the accelerometer, m/s^2/sqrt(Hz)."""
    gyro_density: float = 0.0
    """White noise of the gyroscope, rad/s/sqrt(Hz)."""
    accel_instability: float = 0.0
    """Standard deviation of the accelerometer's bias wander, m/s^2."""
    gyro_instability: float = 0.0
    """Standard deviation of the gyroscope's bias wander, rad/s."""
    correlation_time: float = 100.0
    """Correlation time of the bias wander, s."""
    accel_resolution: float = 0.0
    """Step of the accelerometer's output, m/s^2; 0: continuous."""
    gyro_resolution: float = 0.0
    """Step of the gyroscope's output, rad/s; 0: continuous."""
    stamp_jitter: float = 0.0
    """Standard deviation of the IMU's stamps, s."""
    encoder_noise: float = 0.0
    """White noise of the joint positions, rad."""
    encoder_resolution: float = 0.0
    """Step of the joint positions, rad; 0: continuous."""


@dataclass(frozen=True)
class ImuGrade:
    """
    A grade of IMU: its noise, and the standard deviations of the errors that a calibration finds.
    """

    noise: SimulatedNoise
    """Random errors."""
    accel_bias: float
    """Run-to-run accelerometer bias, m/s^2."""
    gyro_bias: float
    """Run-to-run gyroscope bias, rad/s."""
    scale: float
    """Scale-factor error."""
    misalignment: float
    """Direction error of an input axis, rad."""
    arm: float
    """Distance of a sensitive point from the middle of the package, m."""
    source: str
    """Source of the figures."""


GRADES = {
    'consumer': ImuGrade(
        SimulatedNoise(
            accel_density=400 * MICRO_G,
            gyro_density=0.005 * DEG,
            accel_instability=100 * MICRO_G,
            gyro_instability=20 * DEG_H,
            accel_resolution=61e-6 * STANDARD_GRAVITY,
            gyro_resolution=DEG / 131.0,
        ),
        accel_bias=0.05 * STANDARD_GRAVITY,
        gyro_bias=2.0 * DEG,
        scale=0.02,
        misalignment=0.01,
        arm=3e-3,
        source=(
            'MPU-6050 data sheet: noise densities, 16 bits at 2 g and 250 deg/s; instability'
            ' assumed, the sheet has none'
        ),
    ),
    'industrial': ImuGrade(
        SimulatedNoise(
            accel_density=120 * MICRO_G,
            gyro_density=0.007 * DEG,
            accel_instability=30 * MICRO_G,
            gyro_instability=10 * DEG_H,
        ),
        accel_bias=5e-3 * STANDARD_GRAVITY,
        gyro_bias=0.2 * DEG,
        scale=5e-3,
        misalignment=3e-3,
        arm=3e-3,
        source=(
            'Xsens MTi-1 data sheet: 120 ug/sqrt(Hz), 0.007 deg/s/sqrt(Hz), 30 ug, 10 deg/h;'
            ' matrix and arms before factory calibration'
        ),
    ),
    'tactical': ImuGrade(
        SimulatedNoise(
            accel_density=150 * MICRO_G,
            gyro_density=0.002 * DEG,
            accel_instability=200 * MICRO_G,
            gyro_instability=8 * DEG_H,
            accel_resolution=250 * MICRO_G,
            gyro_resolution=0.005 * DEG,
        ),
        accel_bias=15e-3 * STANDARD_GRAVITY,
        gyro_bias=0.5 * DEG,
        scale=5e-3,
        misalignment=0.87e-3,
        arm=5e-3,
        source=(
            'ADIS16460 data sheet: 0.09 m/s/sqrt(h), 0.12 deg/sqrt(h), 0.2 mg, 8 deg/h, run-to-run'
            ' 15 mg and 0.5 deg/s, axis to axis 0.05 deg'
        ),
    ),
    'navigation': ImuGrade(
        SimulatedNoise(
            accel_density=1 * MICRO_G,
            gyro_density=0.002 / 60 * DEG,
            accel_instability=10 * MICRO_G,
            gyro_instability=0.005 * DEG_H,
        ),
        accel_bias=75 * MICRO_G,
        gyro_bias=0.02 * DEG_H,
        scale=1e-4,
        misalignment=3e-5,
        arm=0.02,
        source=(
            'assumed: 1 ug/sqrt(Hz), 0.002 deg/sqrt(h), instability 5-20 ug and 0.001-0.01 deg/h,'
            ' run-to-run 50-100 ug and 0.01-0.03 deg/h'
        ),
    ),
}
"""Grades by name."""


def realistic(
    grade: str = 'industrial', encoder_resolution: float = 0.001 * DEG, stamp_jitter: float = 50e-6
) -> SimulatedNoise:
    """Return the noise of a grade, with an encoder's resolution (rad) and a stamp jitter (s)."""
    return replace(
        GRADES[grade].noise, encoder_resolution=encoder_resolution, stamp_jitter=stamp_jitter
    )


def gauss_markov_samples(
    standard_deviation: float | np.ndarray,
    correlation_time: float,
    step: float,
    *,
    shape: tuple[int, ...],
    rng: np.random.Generator,
    before: np.ndarray | None = None,
) -> np.ndarray:
    """
    Return a stationary first-order Gauss-Markov process along the first axis of `shape`.

    ``x[k] = a x[k-1] + sd sqrt(1 - a^2) w[k]`` with ``a = exp(-step / correlation_time)``,
    continued from the values `before`, or started from its stationary distribution.
    """
    decay = np.exp(-step / correlation_time)
    drive = rng.normal(0.0, standard_deviation, shape)
    # The first value of a new process is from the stationary distribution.
    first_step = 1 if before is None else 0
    drive[first_step:] *= np.sqrt(-np.expm1(-2.0 * step / correlation_time))
    start = 0.0 if before is None else before
    return autoregressive(drive.reshape(len(drive), -1), decay, start).reshape(shape)


def quantise(values: np.ndarray, step: float) -> np.ndarray:
    """Round `values` to multiples of `step`; 0: unchanged."""
    return np.asarray(values) if step == 0.0 else np.round(np.asarray(values) / step) * step


def jitter_stamps(
    stamp_ns: np.ndarray, standard_deviation: float, rng: np.random.Generator
) -> np.ndarray:
    """Return stamps with white jitter (s), still int64 and in the order of arrival."""
    if standard_deviation == 0.0:
        return stamp_ns
    jitter_ns = np.round(rng.normal(0.0, standard_deviation * 1e9, len(stamp_ns)))
    return stamp_ns + jitter_ns.astype(np.int64)


class ImuNoise:
    """
    White noise, bias wander and resolution of an IMU; the wander continues from call to call.

    Parameters
    ----------
    model : SimulatedNoise
    sample_rate : float
        Hz; a density d gives every sample the standard deviation ``d sqrt(sample_rate)``, so that
        the integral over t seconds scatters by ``d sqrt(t)`` (random-walk convention).
    rng : numpy.random.Generator
    drawn : bool
        Whether the first biases are drawn now, not with the first samples.

    """

    def __init__(
        self,
        model: SimulatedNoise,
        *,
        sample_rate: float,
        rng: np.random.Generator,
        drawn: bool = False,
    ):
        self._model = model
        self._sample_rate = sample_rate
        self._rng = rng
        self._force_bias: np.ndarray | None = None
        """Last bias of the accelerometer, m/s^2, shape (3,); None before the first samples."""
        self._rate_bias: np.ndarray | None = None
        """Last bias of the gyroscope, rad/s, shape (3,); None before the first samples."""
        if drawn:
            self._force_bias = rng.normal(0.0, model.accel_instability, 3)
            self._rate_bias = rng.normal(0.0, model.gyro_instability, 3)

    def add(self, force_s: np.ndarray, rate_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Return readings from outputs without noise, m/s^2 and rad/s, shape (n, 3), n at least 1.
        """
        model = self._model
        force, self._force_bias = self._with_noise(
            force_s, model.accel_density, model.accel_instability, self._force_bias
        )
        rate, self._rate_bias = self._with_noise(
            rate_s, model.gyro_density, model.gyro_instability, self._rate_bias
        )
        return quantise(force, model.accel_resolution), quantise(rate, model.gyro_resolution)

    def _with_noise(
        self, true: np.ndarray, density: float, instability: float, before: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (values with noise, last value of the bias), which continues from `before`."""
        values = true + self._rng.normal(0.0, density * np.sqrt(self._sample_rate), true.shape)
        bias = gauss_markov_samples(
            instability,
            self._model.correlation_time,
            1.0 / self._sample_rate,
            shape=true.shape,
            rng=self._rng,
            before=before,
        )
        return values + bias, bias[-1]


def read_encoders(
    position: np.ndarray, model: SimulatedNoise, rng: np.random.Generator
) -> np.ndarray:
    """
    Return joint positions as read by noisy encoders of finite resolution, rad, shape (n, n_joints).
    """
    noisy = position + rng.normal(0.0, model.encoder_noise, np.shape(position))
    return quantise(noisy, model.encoder_resolution)


class SensorMotion(NamedTuple):
    """True motion of the housing, and the outputs of its sensors so far, all of shape (n, 3)."""

    true_force: np.ndarray
    """Specific force, m/s^2."""
    true_rate: np.ndarray
    """Rate, rad/s."""
    force: np.ndarray
    """Output of the accelerometers, m/s^2."""
    rate: np.ndarray
    """Output of the gyroscopes, rad/s."""


Cause = Callable[[SensorMotion], SensorMotion]
"""A fault of the sensors: returns the same motion with the changed outputs."""


def _two_half_ranges(rng: np.random.Generator) -> Cause:
    """Gains of each gyroscope that differ by 0.2 to 0.4 % between the two senses of rotation."""
    gap = rng.uniform(2e-3, 4e-3, 3) * rng.choice([-1, 1], 3)
    return lambda motion: motion._replace(rate=motion.rate + 0.5 * gap * np.abs(motion.true_rate))


def _unbalanced_mass(rng: np.random.Generator) -> Cause:
    """Gyroscopes with masses off their axes: they read 20 to 60 deg/h per g of specific force."""
    per_force = (
        rng.uniform(20.0, 60.0, (3, 3)) * rng.choice([-1, 1], (3, 3)) * DEG_H / STANDARD_GRAVITY
    )
    return lambda motion: motion._replace(rate=motion.rate + motion.true_force @ per_force.T)


def _soft_spring(rng: np.random.Generator) -> Cause:
    """Accelerometers with springs softer in one sense: 0.2 to 0.5 mg (f / g)^2 on each axis."""
    per_square = rng.uniform(2e-4, 5e-4, 3) * rng.choice([-1, 1], 3) / STANDARD_GRAVITY
    return lambda motion: motion._replace(force=motion.force + per_square * motion.true_force**2)


def _gain_by_sense(rng: np.random.Generator) -> Cause:
    """Gains of each accelerometer that differ by 0.05 to 0.1 % between the two signs."""
    gap = rng.uniform(5e-4, 1e-3, 3) * rng.choice([-1, 1], 3)
    return lambda motion: motion._replace(
        force=motion.force + 0.5 * gap * np.abs(motion.true_force)
    )


def _narrow_range(rng: np.random.Generator) -> Cause:
    """Gyroscopes whose converter ends at 100 to 120 deg/s."""
    most = rng.uniform(100.0, 120.0) * DEG
    return lambda motion: motion._replace(rate=np.clip(motion.rate, -most, most))


CAUSES: dict[str, Callable[[np.random.Generator], Cause]] = {
    'two_half_ranges': _two_half_ranges,
    'unbalanced_mass': _unbalanced_mass,
    'soft_spring': _soft_spring,
    'gain_by_sense': _gain_by_sense,
    'narrow_range': _narrow_range,
}
"""
Name -> function of a generator that draws the size and returns the cause; `narrow_range` belongs
last.
"""


def hidden_causes(names: Sequence[str], seed: int, size: float = 1.0) -> list[Cause]:
    """
    Return the causes of the given names, `size` times as large as drawn.

    Each cause is drawn from a separate generator.

    Raises
    ------
    InputError
        When a name is unknown.

    """
    for name in names:
        if name not in CAUSES:
            raise InputError(
                f"a hidden cause must be one of {', '.join(CAUSES)}, got '{name}'; name one of"
                ' them',
                code='cause_unknown',
            )
    causes = []
    for number, (name, draw) in enumerate(CAUSES.items()):
        if name in names:
            causes.append(_scaled(draw(np.random.default_rng([seed, number])), size))
    return causes


def _scaled(cause: Cause, size: float) -> Cause:
    """Return a cause whose changes of force and rate are `size` times as large."""
    if size == 1.0:
        return cause

    def scaled_cause(motion: SensorMotion) -> SensorMotion:
        changed = cause(motion)
        return motion._replace(
            force=motion.force + size * (changed.force - motion.force),
            rate=motion.rate + size * (changed.rate - motion.rate),
        )

    return scaled_cause
