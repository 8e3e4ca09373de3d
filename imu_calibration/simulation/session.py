"""Simulated sessions: an IMU made of the catalogue's effects on a table that follows a profile, or on the motion of a recording."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, JointSamples, SampleBlock, TemperatureSamples
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.forward_equations import clip, predict
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.signal_history import HALF_WIDTH, BandVariance
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window, WindowKind, all_samples, chunks
from imu_calibration.preprocessing.window_finder import MotionGatherer
from imu_calibration.simulation.motion_builder import Profile
from imu_calibration.simulation.sensor_noise import GRADES, ImuNoise, SimulatedNoise, gauss_markov, jitter_stamps, read_encoders

LOUDEST = 0.25
"""Rms of the machine's vibration on each axis in its loudest gear, m/s^2."""
GEAR_AMPLITUDES, GEAR_SECONDS = (0.0, 1.0, 0.5, 0.0, 0.75), 11.0
"""Relative amplitudes of the gears of the machine in their order, and time in each gear, s."""
ALIASED = 0.31
"""Frequency of the vibration after aliasing, as a share of the sample rate."""


def hum_and_variance(time: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the contribution of the machine to the specific force, m/s^2, and its variance, (m/s^2)^2, each shape (n, 3).

    Parameters
    ----------
    time : ndarray, shape (n,)
        Seconds.
    rate : float
        Samples per second.

    """
    loudness = LOUDEST * np.array(GEAR_AMPLITUDES)[(np.asarray(time) // GEAR_SECONDS).astype(int) % len(GEAR_AMPLITUDES)][:, None]
    return loudness * _unit_hum(time, rate), np.tile(loudness**2, 3)


def _unit_hum(time, rate):
    """Return a sine of unit variance on each axis, shape (n, 3)."""
    return np.sqrt(2.0) * np.sin(2 * np.pi * ALIASED * rate * time[:, None] + np.arange(3.0))


SESSION_START_NS = 1_700_000_000_000_000_000
"""First stamp of simulated sessions: arbitrary but fixed, so that the same seed gives the same bytes."""
SIMULATED_BLOCK_SAMPLES = 100_000


@dataclass(frozen=True)
class SimulationOptions:
    """Rates and noise of a simulated session."""

    imu_rate: float = 100.0
    """IMU samples per second."""
    joint_rate: float = 100.0
    """Joint states per second."""
    noise: SimulatedNoise = GRADES['industrial'].noise
    """Noise of the IMU, the encoders and the stamps."""
    with_velocity: bool = True
    """Whether the joint states carry velocities."""
    temperature_start_c: float | None = None
    """Temperature at turn-on; None: no temperature topic."""
    temperature_rise_c: float = 15.0
    """Temperature rise, K."""
    temperature_time: float = 240.0
    """Time constant of the warm-up, s."""
    frame_id: str = 'imu_link'
    """Frame of the messages."""


def random_values(model: SensorModel, grade: str = 'industrial', seed: int = 0) -> np.ndarray:
    """
    Return parameter values of a random IMU of a grade, shape (n_params,).

    Bias, matrix and arms scatter with the sd of the grade; every other effect is zero.
    """
    rng, grade = np.random.default_rng([seed, 7]), GRADES[grade]
    values = model.start()
    for effect in model.effects:
        part = model.slices[effect.key]
        if effect.role is Role.OFFSET:
            values[part] += rng.normal(0.0, grade.accel_bias if effect.sensor == 'accelerometer' else grade.gyro_bias, 3)
        elif effect.role is Role.LINEAR:
            spread = np.where(np.eye(3), grade.scale, grade.misalignment).ravel()
            values[part] += rng.normal(0.0, 1.0, 9) * spread
        elif effect.role is Role.ARMS:
            arms = rng.normal(0.0, grade.arm, (3, 3))
            values[part] = (arms - arms.mean(axis=0)).ravel()
    return values


def hidden_effect(model: SensorModel, name: str, seed: int = 0, *, share: float = 0.3, moment: float = 60.0) -> tuple[str, np.ndarray]:
    """Return (sensor, values) of an effect of a model's catalogue at a share of its plausible size; a step occurs at `moment`, s."""
    sensor = model.catalogue.owner_of(name, model.joint_names)
    effect = model.catalogue.find(sensor, name, model.joint_names)
    if not effect.plausible:
        or_else = ', or give its largest size in its definition (largest)' if effect.definition else ''
        raise InputError(f"effect '{name}' cannot be simulated by name, for its size is not known; "
                         f'simulate with a calibration that contains it{or_else}', key='calibration', code='size_unknown')
    rng = np.random.default_rng([seed, 11])
    values = share * effect.largest * rng.uniform(0.4, 1.0, effect.size) * rng.choice((-1.0, 1.0), effect.size)
    if effect.nonnegative:
        values = np.abs(values)
    if effect.timed:
        values[-1] = moment if effect.located else 0.8 * effect.prior_values()[-1]
    return sensor, values


def simulate(model: SensorModel, values: np.ndarray, table: Table, *, profile: Profile, options: SimulationOptions = SimulationOptions(),
             seed: int = 0) -> tuple[ImuSamples, JointSamples, TemperatureSamples | None]:
    """
    Simulate a session.

    Parameters
    ----------
    model, values : SensorModel, ndarray
        The true IMU, table and clock.
    table : Table
        The table as its description says.
    profile : Profile
        Motion of the joints as their encoders would read it without noise.
    options : SimulationOptions
    seed : int

    Returns
    -------
    (ImuSamples, JointSamples, TemperatureSamples or None)

    """
    rng = np.random.default_rng([seed, 3])
    n_imu, n_joint = (int(profile.duration * rate) for rate in (options.imu_rate, options.joint_rate))
    time = np.arange(n_imu) / options.imu_rate
    noisy = ImuNoise(options.noise, sample_rate=options.imu_rate, rng=rng).add(*_outputs(model, values, table, profile, time, options))
    force, rate = (clip(model, sensor, values, output=output) for sensor, output in zip(SENSORS, noisy))
    stamps = jitter_stamps(stamps_at(time), options.noise.stamp_jitter, rng)
    imu = ImuSamples(stamps, force, rate, options.frame_id)
    joints = joint_samples(profile.at((np.arange(n_joint) + 0.5) / options.joint_rate), table, options, start_ns=SESSION_START_NS, rng=rng)
    seconds = np.arange(0, profile.duration)
    warmth = temperature_at(seconds, options)
    return imu, joints, None if warmth is None else TemperatureSamples(stamps_at(seconds), warmth)


def joint_samples(motion: JointMotion, table: Table, options: SimulationOptions, *, start_ns: int,
                  rng: np.random.Generator) -> JointSamples:
    """Return a motion as its encoders measure it; `start_ns` is the stamp of time zero."""
    position = read_encoders(motion.position, options.noise, rng)
    velocity = motion.rate if options.with_velocity else np.full_like(motion.rate, np.nan)
    return JointSamples(stamps_at(motion.time, start_ns), position, velocity, tuple(table.joint_names))


def stamps_at(time: np.ndarray, start_ns: int = SESSION_START_NS) -> np.ndarray:
    """Return the stamps of times, s; `start_ns` is the stamp of time zero."""
    return start_ns + np.round(time * 1e9).astype(np.int64)


def _outputs(model, values, table, profile, time, options):
    parts = []
    for start in range(0, len(time), SIMULATED_BLOCK_SAMPLES):
        now = time[start:start + SIMULATED_BLOCK_SAMPLES]
        parts.append(answered(model, values, table, motion=profile.at(now), time=now, options=options))
    return tuple(np.concatenate(sensor) for sensor in zip(*parts))


def answered(model: SensorModel, values: np.ndarray, table: Table, *, motion: JointMotion, time: np.ndarray,
             options: SimulationOptions) -> tuple[np.ndarray, np.ndarray]:
    """Return the outputs of the sensors without noise, each (n, 3): motion, warm-up, and a machine if biases depend on vibration."""
    warmth, hum = temperature_at(time, options), 0.0
    if warmth is not None:   # it never turns (`kinematics.signal_history`)
        motion = replace(motion, thermal_branch=np.clip((warmth - options.temperature_start_c) / HALF_WIDTH, -1.0, 1.0))
    if model.uses('vibration'):
        hum, variance = hum_and_variance(time, options.imu_rate)
        motion = replace(motion, vibration=variance)
    force, rate = predict(model, values, table, motion=motion, temperature_c=warmth)
    return force + hum, rate


def temperature_at(time: np.ndarray, options: SimulationOptions) -> np.ndarray | None:
    """Return the temperature of the warm-up, or None without a temperature topic: ``start + rise (1 - exp(-t / tau))``."""
    if options.temperature_start_c is None:
        return None
    return options.temperature_start_c + options.temperature_rise_c * (1 - np.exp(-time / options.temperature_time))


BIAS_TIME = 100.0
"""Correlation time of the bias process where it is not identified, s."""


class ReplayNoise(NamedTuple):
    """Noise of one sensor in a recording."""

    white_sd: np.ndarray
    """Standard deviation of a sample, m/s^2 or rad/s, shape (3,)."""
    bias_sd: np.ndarray
    """Standard deviation of the bias process, shape (3,)."""
    bias_time: float = BIAS_TIME
    """Correlation time of the bias process, s."""


def predict_windows(windows: Sequence[Window], table: Table, model: SensorModel, *, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return sensor -> output of a model without noise at the samples of some windows, m/s^2 and rad/s, shape (n, 3)."""
    motion, temperature, rows = all_samples(windows)
    if temperature is None and model.needs_temperature:
        raise InputError('a model with thermal effects requires the temperature of every sample, the recording has none for some; '
                         'name the temperature topic', key='temperature_topic', code='temperature_missing')
    outputs = predict(model, values, table, motion=motion, temperature_c=temperature)
    return {sensor: output[rows] for sensor, output in zip(SENSORS, outputs)}


def noise_at_rest(windows: Sequence[Window]) -> dict[str, ReplayNoise]:
    """
    Return sensor -> noise of a recording: median over the windows at rest of their white noise, and no bias process.

    Raises
    ------
    InputError
        When no window is at rest.

    """
    found = [window.noise_sd for window in windows if window.kind is WindowKind.STATIC]
    if not found:
        raise InputError('the noise must be in the statistics of the calibration, or a rest in the recording; both are missing; '
                         'calibrate from a recording with rests', key='calibration', code='noise_unknown')
    return {sensor: ReplayNoise(white, np.zeros(3)) for sensor, white in zip(SENSORS, np.median(found, axis=0))}


def replay(blocks: Iterable[SampleBlock], table: Table, model: SensorModel, *, values: np.ndarray,
           noise: Mapping[str, ReplayNoise] | None = None, seed: int = 0) -> tuple[SampleBlock, int]:
    """
    Return (the recording with simulated readings, number of its samples without known motion, which are left out).

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
    windows = MotionGatherer(table, keep_unused=True).all_of(blocks)
    if not windows:
        raise InputError('a replay requires IMU samples between joint states of the table, none was found; check the topics and the stamps',
                         code='no_motion')
    outputs = [predict_windows(group, table, model, values=values) for group in chunks(windows)]
    stamps = np.concatenate([window.stamp_ns for window in windows])
    period = float(np.median([window.period for window in windows if len(window) > 1] or [1.0]))
    noise, rng = noise or noise_at_rest(windows), np.random.default_rng([seed, 3])
    exact = {sensor: np.concatenate([output[sensor] for output in outputs]) for sensor in SENSORS}
    if model.uses('vibration'):   # biases follow the vibration of the readings
        known = [np.asarray(motion.vibration)[rows] for motion, _, rows in map(all_samples, chunks(windows))]
        variance = np.concatenate(known)
        unit = _unit_hum(period * np.arange(len(variance)), 1.0 / period)
        exact['accelerometer'] += unit * np.sqrt(variance / BandVariance().of(period, unit)[-1])
    readings = []
    for sensor in SENSORS:
        own, shape = noise[sensor], exact[sensor].shape
        noisy = exact[sensor] + rng.normal(0.0, own.white_sd, shape)
        noisy += gauss_markov(own.bias_sd, own.bias_time, period, shape=shape, rng=rng)
        readings.append(clip(model, sensor, values, output=noisy))
    frame = next(block.imu.frame_id for block in blocks if block.imu is not None and len(block.imu))
    joints, temperature = (_joined([getattr(block, name) for block in blocks]) for name in ('joints', 'temperature'))
    lost = sum(len(block.imu) for block in blocks if block.imu is not None) - len(stamps)
    return SampleBlock(ImuSamples(stamps, readings[0], readings[1], frame), joints, temperature), lost


def _joined(parts):
    parts = [part for part in parts if part is not None and len(part)]
    return type(parts[0]).concatenate(parts) if parts else None
