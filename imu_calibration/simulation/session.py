"""
Simulated sessions.

An IMU made of the catalogue's effects on a table that follows a profile or trajectories.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, JointSamples, TemperatureSamples
from imu_calibration.effects.base import Role
from imu_calibration.effects.catalogue import CATALOGUE, Catalogue
from imu_calibration.effects.forward_equations import References, clip, predict
from imu_calibration.effects.sensor_model import NAMED_MODELS, SensorModel
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.rotations import lever_matrix
from imu_calibration.kinematics.signal_history import HALF_WIDTH
from imu_calibration.kinematics.table import Table
from imu_calibration.simulation.motion_builder import Profile
from imu_calibration.simulation.sensor_noise import (
    GRADES,
    Cause,
    ImuNoise,
    SensorMotion,
    SimulatedNoise,
    jitter_stamps,
    read_encoders,
)
from imu_calibration.simulation.table_controller import TableController

LOUDEST_HUM = 0.25
"""Rms of the machine's vibration on each axis in its loudest gear, m/s^2."""
GEAR_AMPLITUDES = (0.0, 1.0, 0.5, 0.0, 0.75)
"""Relative amplitudes of the gears of the machine, in their order."""
GEAR_SECONDS = 11.0
"""Time in each gear, s."""
ALIASED = 0.31
"""Frequency of the vibration after aliasing, as a share of the sample rate."""


def hum_and_variance(time: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (specific force by the machine's vibration, its variance), each shape (n, 3).

    The units are m/s^2 and (m/s^2)^2.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Seconds.
    rate : float
        Samples per second.

    """
    gear = (np.asarray(time) // GEAR_SECONDS).astype(int) % len(GEAR_AMPLITUDES)
    rms = LOUDEST_HUM * np.array(GEAR_AMPLITUDES)[gear][:, None]
    return rms * unit_hum(time, rate), np.tile(rms**2, 3)


def unit_hum(time: np.ndarray, rate: float) -> np.ndarray:
    """
    Return a sine of unit variance on each axis at times in s, shape (n, 3), for samples per second.
    """
    return np.sqrt(2.0) * np.sin(2 * np.pi * ALIASED * rate * time[:, None] + np.arange(3.0))


SESSION_START_NS = 1_700_000_000_000_000_000
"""
First stamp of simulated sessions: arbitrary but fixed, so that the same seed gives the same bytes.
"""
SIMULATED_BLOCK_SAMPLES = 100_000
TEMPERATURE_RATE = 1.0
"""Temperatures per second of a live simulation."""


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
    rng = np.random.default_rng([seed, 7])
    sizes = GRADES[grade]
    values = model.start()
    for effect in model.effects:
        part = model.slices[effect.key]
        if effect.role is Role.OFFSET:
            bias_sd = sizes.accel_bias if effect.sensor == 'accelerometer' else sizes.gyro_bias
            values[part] += rng.normal(0.0, bias_sd, 3)
        elif effect.role is Role.LINEAR:
            element_sd = np.where(np.eye(3), sizes.scale, sizes.misalignment).ravel()
            values[part] += rng.normal(0.0, 1.0, 9) * element_sd
        elif effect.role is Role.ARMS:
            # The origin of the arms is the mean of the three sensitive points.
            arms = rng.normal(0.0, sizes.arm, (3, 3))
            values[part] = (arms - arms.mean(axis=0)).ravel()
    return values


def true_imu(
    table: Table,
    known: tuple[SensorModel, np.ndarray] | None,
    grade: str,
    *,
    seed: int,
    catalogue: Catalogue = CATALOGUE,
) -> tuple[SensorModel, np.ndarray]:
    """
    Return `known`, (model, values), or for None those of a random IMU of a grade with size effect.
    """
    if known is None:
        model = SensorModel(
            NAMED_MODELS['size_effect'], joint_names=table.joint_names, catalogue=catalogue
        )
        return model, random_values(model, grade, seed)
    require_joints(known[0], table)
    return known


def turning_world(table: Table, model: SensorModel) -> Table:
    """
    Return the table of a simulated world: it turns with the Earth wherever a latitude is given.

    Without an azimuth in the description north is along base x; calibration estimates it. An
    Earth's rate that the model states is that of the world already.
    """
    is_stated = any(effect.known_size for effect in model.effects)
    if is_stated or table.latitude is None or table.azimuth_deg is not None:
        return table
    return replace(table, azimuth_deg=0.0)


def require_joints(model: SensorModel, table: Table) -> None:
    """
    Refuse a model with effects of the reference for joints that differ from those of the table.
    """
    if model.reference and set(model.joint_names) != set(table.joint_names):
        raise InputError(
            f'the calibration must be of a table with joints {", ".join(table.joint_names)}, it'
            f' names {", ".join(model.joint_names)}; give its table',
            key='table',
        )


def hidden_effect(
    model: SensorModel, name: str, seed: int = 0, *, share: float = 0.3, moment: float = 60.0
) -> tuple[str, np.ndarray]:
    """
    Return (sensor, values) of an effect of a model's catalogue at a share of its plausible size.

    A step occurs at `moment`, s.
    """
    sensor = model.catalogue.owner_of(name, model.joint_names)
    effect = model.catalogue.find(sensor, name, model.joint_names)
    if not effect.plausible:
        alternative = ''
        if effect.definition:
            alternative = ', or give its largest size in its definition (largest)'
        raise InputError(
            f"effect '{name}' cannot be simulated by name, for its size is not known; "
            f'simulate with a calibration that contains it{alternative}',
            key='calibration',
            code='size_unknown',
        )
    rng = np.random.default_rng([seed, 11])
    sizes = rng.uniform(0.4, 1.0, effect.size)
    signs = rng.choice((-1.0, 1.0), effect.size)
    values = share * effect.largest * sizes * signs
    if effect.nonnegative:
        values = np.abs(values)
    # The last value is the moment of a step, or a time constant.
    if effect.timed:
        values[-1] = moment if effect.located else 0.8 * effect.prior_values()[-1]
    return sensor, values


@dataclass(frozen=True, eq=False)
class SimulatedBlock:
    """Samples of a stretch of time."""

    imu: ImuSamples
    """Readings."""
    joints: JointSamples
    """Joint states."""
    temperature: TemperatureSamples | None
    """Temperatures, when the simulation has them."""
    imu_time: np.ndarray
    """Times of `imu`, s, without errors of the stamps, shape (n,)."""


class LiveSimulation:
    """
    The forward model with noise that is continuous across blocks.

    Parameters
    ----------
    model, values : SensorModel, ndarray
        The true IMU, table and clock.
    table : Table
        The table as its description says.
    motion : object
        ``at(time) -> JointMotion``.
    options : SimulationOptions
        Rates, noise, temperature.
    seed : int
    start_ns : int
        Stamp of time zero.
    causes : sequence of Cause
        Further faults of the IMU (`hidden_causes`).
    drawn : bool
        As for `ImuNoise`.

    """

    def __init__(
        self,
        model: SensorModel,
        values: np.ndarray,
        table: Table,
        *,
        motion: TableController | Profile,
        options: SimulationOptions = SimulationOptions(),
        seed: int = 0,
        start_ns: int = SESSION_START_NS,
        causes: Sequence[Cause] = (),
        drawn: bool = True,
    ):
        self.model = model
        self.values = values
        self.table = turning_world(table, model)
        self.motion = motion
        self.options = options
        self.start_ns = start_ns
        self.causes = tuple(causes)
        self._rng = np.random.default_rng([seed, 3])
        self._n_samples = {'imu': 0, 'joints': 0, 'temperature': 0}
        """Stream -> number of samples that `take` has returned."""
        self._noise = ImuNoise(
            options.noise, sample_rate=options.imu_rate, rng=self._rng, drawn=drawn
        )

    def take(self, until: float) -> SimulatedBlock:
        """Return the samples from the end of the last block to `until` (s, exclusive)."""
        return self.at(
            self._times('imu', self.options.imu_rate, 0.0, until),
            self._times('joints', self.options.joint_rate, 0.5, until),
            self._times('temperature', TEMPERATURE_RATE, 0.0, until),
        )

    def _times(self, stream: str, rate: float, offset: float, until: float) -> np.ndarray:
        """
        Return the times of a stream's next samples before `until`, s.

        Sample k is at ``(k + offset) / rate``.
        """
        first = self._n_samples[stream]
        stop = max(int(np.ceil(until * rate - offset)), first)
        self._n_samples[stream] = stop
        return (np.arange(first, stop) + offset) / rate

    def at(
        self, imu_time: np.ndarray, joint_time: np.ndarray, temperature_time: np.ndarray
    ) -> SimulatedBlock:
        """Return the samples at the times of each stream, s."""
        # The order of the random numbers (IMU, then encoders) belongs to the result of a seed.
        imu = self._imu(imu_time)
        motion = self.motion.at(joint_time)
        position = read_encoders(motion.position, self.options.noise, self._rng)
        velocity = motion.rate if self.options.with_velocity else np.full_like(motion.rate, np.nan)
        joints = JointSamples(
            self._stamps(motion.time), position, velocity, tuple(self.table.joint_names)
        )
        temperature = None
        temperature_c = warm_up_temperature(temperature_time, self.options)
        if temperature_c is not None:
            temperature = TemperatureSamples(self._stamps(temperature_time), temperature_c)
        return SimulatedBlock(imu, joints, temperature, imu_time)

    def _stamps(self, time: np.ndarray) -> np.ndarray:
        """Return the stamps of times in s, ns."""
        return self.start_ns + np.round(time * 1e9).astype(np.int64)

    def _imu(self, time: np.ndarray) -> ImuSamples:
        """Return the readings at times in s: outputs, noise, and the limits of the sensors."""
        if not len(time):
            return ImuSamples(
                np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), self.options.frame_id
            )
        # In parts, which bound the memory.
        force_parts = []
        rate_parts = []
        for k in range(0, len(time), SIMULATED_BLOCK_SAMPLES):
            force, rate = self._noiseless_outputs(time[k : k + SIMULATED_BLOCK_SAMPLES])
            force_parts.append(force)
            rate_parts.append(rate)
        force, rate = self._noise.add(np.concatenate(force_parts), np.concatenate(rate_parts))
        force = clip(self.model, 'accelerometer', self.values, output=force)
        rate = clip(self.model, 'gyroscope', self.values, output=rate)
        stamps = jitter_stamps(self._stamps(time), self.options.noise.stamp_jitter, self._rng)
        return ImuSamples(stamps, force, rate, self.options.frame_id)

    def _noiseless_outputs(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (force, rate) of the sensors with hidden causes and without noise, (n, 3) each."""
        outputs = noiseless_outputs(
            self.model,
            self.values,
            self.table,
            motion=self.motion.at(time),
            time=time,
            options=self.options,
        )
        if not self.causes:
            return outputs
        force, rate = outputs
        true_force, true_rate = self._true_motion(time)
        sensor_motion = SensorMotion(true_force, true_rate, force, rate)
        for cause in self.causes:
            sensor_motion = cause(sensor_motion)
        return sensor_motion.force, sensor_motion.rate

    def truth(self, block: SimulatedBlock) -> ImuSamples:
        """
        Return true specific force and rate at the origin of the arms, at the stamps of `block.imu`.
        """
        force, rate = self._true_motion(block.imu_time)
        return ImuSamples(block.imu.stamp_ns, force, rate, self.options.frame_id)

    def _true_motion(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return true specific force and rate at the origin of the arms, each (n, 3)."""
        references = References(self.model, self.table, self.motion.at(time))
        accelerometer = references.at('accelerometer')
        gyroscope = references.at('gyroscope')
        true_force = accelerometer.force_s
        arm = self.model.value('accelerometer', Role.ARM, self.values)
        if arm is not None:
            lever = lever_matrix(accelerometer.rate_s, accelerometer.alpha_s)
            true_force = true_force + lever @ arm
        return true_force, gyroscope.rate_s


def simulate_session(
    model: SensorModel,
    values: np.ndarray,
    table: Table,
    *,
    profile: Profile,
    options: SimulationOptions = SimulationOptions(),
    seed: int = 0,
) -> tuple[ImuSamples, JointSamples, TemperatureSamples | None]:
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
    simulation = LiveSimulation(
        model, values, table, motion=profile, options=options, seed=seed, drawn=False
    )
    n_imu = int(profile.duration * options.imu_rate)
    n_joint = int(profile.duration * options.joint_rate)
    block = simulation.at(
        np.arange(n_imu) / options.imu_rate,
        (np.arange(n_joint) + 0.5) / options.joint_rate,
        np.arange(0, profile.duration),
    )
    return block.imu, block.joints, block.temperature


def noiseless_outputs(
    model: SensorModel,
    values: np.ndarray,
    table: Table,
    *,
    motion: JointMotion,
    time: np.ndarray,
    options: SimulationOptions,
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (force, rate) of the sensors without noise, each (n, 3).

    They follow from the motion, the warm-up, and a vibrating machine if biases depend on vibration.
    """
    temperature_c = warm_up_temperature(time, options)
    if temperature_c is not None:
        # A temperature that only rises has this branch (`kinematics.signal_history`).
        rise = temperature_c - options.temperature_start_c
        motion = replace(motion, thermal_branch=np.clip(rise / HALF_WIDTH, -1.0, 1.0))
    hum: np.ndarray | float = 0.0
    if model.uses('vibration'):
        hum, variance = hum_and_variance(time, options.imu_rate)
        motion = replace(motion, vibration=variance)
    force, rate = predict(model, values, table, motion=motion, temperature_c=temperature_c)
    return force + hum, rate


def warm_up_temperature(time: np.ndarray, options: SimulationOptions) -> np.ndarray | None:
    """
    Return the temperature of the warm-up, or None without a temperature topic.

    ``start + rise (1 - exp(-t / tau))``.
    """
    if options.temperature_start_c is None:
        return None
    return options.temperature_start_c + options.temperature_rise_c * (
        1 - np.exp(-time / options.temperature_time)
    )
