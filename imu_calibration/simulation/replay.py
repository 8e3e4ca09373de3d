"""Simulation of a calibrated IMU on the motion of a recording."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, SampleBlock
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
    Return sensor -> output of a model without noise at the samples of some windows.

    The units are m/s^2 and rad/s, and the shape is (n, 3).
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

    Median over the windows at rest of their white noise, and no bias process.

    Raises
    ------
    InputError
        When no window is at rest.

    """
    found = [window.noise_sd for window in windows if window.kind is WindowKind.STATIC]
    if not found:
        raise InputError(
            'the noise must be in the statistics of the calibration, or a rest in the recording;'
            ' both are missing; calibrate from a recording with rests',
            key='calibration',
            code='noise_unknown',
        )
    return {
        sensor: ReplayNoise(white, np.zeros(3))
        for sensor, white in zip(SENSORS, np.median(found, axis=0))
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
    Return (the recording with simulated readings, number of its samples left out).

    Samples without known motion are left out.

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
    outputs = [predict_windows(group, table, model, values=values) for group in chunks(windows)]
    stamps = np.concatenate([window.stamp_ns for window in windows])
    period = float(np.median([window.period for window in windows if len(window) > 1] or [1.0]))
    noise = noise or recorded_noise(windows)
    rng = np.random.default_rng([seed, 3])
    exact = {}
    for sensor in SENSORS:
        exact[sensor] = np.concatenate([output[sensor] for output in outputs])
    if model.uses('vibration'):  # biases follow the vibration of the readings
        of_chunks = []
        for motion, _, rows in map(all_samples, chunks(windows)):
            of_chunks.append(np.asarray(motion.vibration)[rows])
        variance = np.concatenate(of_chunks)
        unit = unit_hum(period * np.arange(len(variance)), 1.0 / period)
        exact['accelerometer'] += unit * np.sqrt(variance / BandVariance().of(period, unit)[-1])
    readings = []
    for sensor in SENSORS:
        own = noise[sensor]
        shape = exact[sensor].shape
        noisy = exact[sensor] + rng.normal(0.0, own.white_sd, shape)
        noisy += gauss_markov_samples(own.bias_sd, own.bias_time, period, shape=shape, rng=rng)
        readings.append(clip(model, sensor, values, output=noisy))
    frame = next(block.imu.frame_id for block in blocks if block.imu is not None and len(block.imu))
    joints = _joined([block.joints for block in blocks])
    temperature = _joined([block.temperature for block in blocks])
    lost = sum(len(block.imu) for block in blocks if block.imu is not None) - len(stamps)
    return (
        SampleBlock(ImuSamples(stamps, readings[0], readings[1], frame), joints, temperature),
        lost,
    )


def _joined(parts):
    parts = [part for part in parts if part is not None and len(part)]
    return type(parts[0]).concatenate(parts) if parts else None
