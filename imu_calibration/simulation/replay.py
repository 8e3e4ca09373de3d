"""Simulation of a calibrated IMU on the motion of a recording."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, SampleBlock, joined_stream
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import clip, predict
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.signal_history import BandVariance
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window, WindowKind, all_samples, chunks
from imu_calibration.preprocessing.window_finder import MotionGatherer
from imu_calibration.simulation.sensor_noise import gauss_markov_samples
from imu_calibration.simulation.session import turning_world, unit_hum

BIAS_TIME = 100.0
"""Correlation time of the bias process where it is not identified, s."""


class ReplayNoise(NamedTuple):
    """Noise of one sensor in a recording."""

    white_sd: np.ndarray
    """Standard deviation of a sample, m/s^2 or rad/s, shape (3,)."""
    bias_sd: np.ndarray | float
    """Standard deviation of the bias process, shape (3,), or equal on all axes."""
    bias_time: float = BIAS_TIME
    """Correlation time of the bias process, s."""


def predict_windows(
    windows: Sequence[Window], table: Table, model: SensorModel, *, values: np.ndarray
) -> dict[str, np.ndarray]:
    """
    Return sensor -> output of a model without noise at the samples of windows, shape (n, 3), SI.
    """
    motion, temperature, rows = all_samples(windows)
    if temperature is None and model.needs_temperature:
        raise InputError(
            'a model with thermal effects requires the temperature of every sample, the recording'
            ' has none for some; name the temperature topic',
            key='temperature_topic',
            code='temperature_missing',
        )
    outputs = predict(model, values, table, motion=motion, temperature_c=temperature)
    return {sensor: output[rows] for sensor, output in zip(SENSORS, outputs)}


def recorded_noise(windows: Sequence[Window]) -> dict[str, ReplayNoise]:
    """
    Return sensor -> noise of a recording.

    The white noise is the median over the windows at rest; there is no bias process.

    Raises
    ------
    InputError
        When no window is at rest.

    """
    white_sds = [window.noise_sd for window in windows if window.kind is WindowKind.STATIC]
    if not white_sds:
        raise InputError(
            'the noise must be in the statistics of the calibration, or a rest in the recording;'
            ' both are missing; calibrate from a recording with rests',
            key='calibration',
            code='noise_unknown',
        )
    force_sd, rate_sd = np.median(white_sds, axis=0)
    return {
        'accelerometer': ReplayNoise(force_sd, np.zeros(3)),
        'gyroscope': ReplayNoise(rate_sd, np.zeros(3)),
    }


def simulate_on_recording(
    blocks: Iterable[SampleBlock],
    table: Table,
    model: SensorModel,
    *,
    values: np.ndarray,
    noise: Mapping[str, ReplayNoise] | None = None,
    seed: int = 0,
) -> tuple[SampleBlock, int]:
    """
    Return (the recording with simulated readings, number of omitted samples).

    Samples without known motion are omitted.

    Parameters
    ----------
    blocks : iterable of SampleBlock
        The recording.
    table : Table
        The reference that its joints move.
    model, values : SensorModel, ndarray
        The simulated IMU.
    noise : mapping, optional
        Sensor -> ReplayNoise; default the noise at rest of the recording.
    seed : int
        Of the noise.

    Raises
    ------
    InputError
        When no sample has a known motion, or noise or temperature is unknown.

    """
    blocks = list(blocks)
    table = turning_world(table, model)
    windows = MotionGatherer(table, keep_unused=True).all_of(blocks)
    if not windows:
        raise InputError(
            'a replay requires IMU samples between joint states of the table, none was found; check'
            ' the topics and the stamps',
            code='no_motion',
        )

    # Outputs without noise; where biases follow the vibration, with that of the recording. Windows
    # are predicted in groups, which bounds the memory.
    outputs = [predict_windows(group, table, model, values=values) for group in chunks(windows)]
    # Windows of one sample have no period.
    period = float(np.median([window.period for window in windows if len(window) > 1] or [1.0]))
    noise = noise or recorded_noise(windows)
    exact = {}
    for sensor in SENSORS:
        exact[sensor] = np.concatenate([output[sensor] for output in outputs])
    if model.uses('vibration'):
        exact['accelerometer'] += _recorded_hum(windows, period)

    # Noise and the limits of the sensors.
    rng = np.random.default_rng([seed, 3])
    readings = []
    for sensor in SENSORS:
        sensor_noise = noise[sensor]
        shape = exact[sensor].shape
        noisy = exact[sensor] + rng.normal(0.0, sensor_noise.white_sd, shape)
        noisy += gauss_markov_samples(
            sensor_noise.bias_sd, sensor_noise.bias_time, period, shape=shape, rng=rng
        )
        readings.append(clip(model, sensor, values, output=noisy))

    # The other streams of the recording are unchanged.
    stamps = np.concatenate([window.stamp_ns for window in windows])
    imu_blocks = [block.imu for block in blocks if block.imu is not None]
    frame_id = next(imu.frame_id for imu in imu_blocks if len(imu))
    n_omitted = sum(len(imu) for imu in imu_blocks) - len(stamps)
    force, rate = readings
    replayed = SampleBlock(
        ImuSamples(stamps, force, rate, frame_id),
        joined_stream(blocks, 'joints'),
        joined_stream(blocks, 'temperature'),
    )
    return replayed, n_omitted


def _recorded_hum(windows: Sequence[Window], period: float) -> np.ndarray:
    """
    Return a hum with the variance of the vibration in windows, m/s^2, shape (n, 3).

    `period`: time between samples, s.
    """
    variances = []
    for motion, _, rows in map(all_samples, chunks(windows)):
        variances.append(np.asarray(motion.vibration)[rows])
    variance = np.concatenate(variances)
    hum = unit_hum(period * np.arange(len(variance)), 1.0 / period)
    # Compensation measures the variance with a filter, which passes a part of it.
    measured_variance = BandVariance().of(period, hum)[-1]
    return hum * np.sqrt(variance / measured_variance)
