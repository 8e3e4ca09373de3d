"""A simulated table with an IMU on it, block after block, for a live simulator."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.core.samples import ImuSamples, JointSamples, TemperatureSamples
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.forward_equations import clip, warped_reference
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.rotations import lever_matrix
from imu_calibration.kinematics.signal_history import autoregressive
from imu_calibration.kinematics.table import Table
from imu_calibration.simulation.sensor_noise import Cause, Felt, quantise, read_encoders
from imu_calibration.simulation.session import SimulationOptions, answered, temperature_at
from imu_calibration.simulation.table_controller import TableController

TEMPERATURE_RATE = 1.0
"""Temperatures per second."""


@dataclass(frozen=True, eq=False)
class SimulatedBlock:
    """Samples of a stretch of time."""

    imu: ImuSamples
    """Readings."""
    joints: JointSamples
    """Joint states."""
    temperature: TemperatureSamples | None
    """Temperatures, when the simulation has them."""
    truth: ImuSamples
    """True specific force and rate at the origin of the arms, at the stamps of `imu`."""


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

    """

    def __init__(self, model: SensorModel, values: np.ndarray, table: Table, *, motion: TableController,
                 options: SimulationOptions = SimulationOptions(), seed: int = 0, start_ns: int = 0, causes: Sequence[Cause] = ()):
        self.model, self.values, self.table, self.motion, self.options = model.at(values), values, table, motion, options
        self.start_ns, self.causes = start_ns, tuple(causes)
        self._rng = np.random.default_rng([seed, 3])
        self._n = {'imu': 0, 'joints': 0, 'temperature': 0}
        noise = options.noise
        self._wander = [_Wander(sd, noise.correlation_time, 1 / options.imu_rate, self._rng)
                        for sd in (noise.accel_instability, noise.gyro_instability)]

    def take(self, until: float) -> SimulatedBlock:
        """Return the samples from the end of the last block to `until` (s, exclusive)."""
        time = self._times('imu', self.options.imu_rate, 0.0, until)
        imu, truth = self._imu(time)
        return SimulatedBlock(imu, self._joints(until), self._temperature(until), truth)

    def _times(self, stream, rate, offset, until):
        """Return the times of a stream's next samples before `until`, s."""
        first = self._n[stream]
        stop = max(int(np.ceil(until * rate - offset)), first)
        self._n[stream] = stop
        return (np.arange(first, stop) + offset) / rate

    def _stamps(self, time):
        return self.start_ns + np.round(time * 1e9).astype(np.int64)

    def _imu(self, time):
        if not len(time):
            empty = ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), self.options.frame_id)
            return empty, empty
        motion, noise = self.motion.at(time), self.options.noise
        outputs = []
        figures = ((noise.accel_density, noise.accel_resolution), (noise.gyro_density, noise.gyro_resolution))
        for sensor, output, wander, (density, resolution) in zip(SENSORS, self._answered(time, motion), self._wander, figures):
            white = self._rng.normal(0.0, density * np.sqrt(self.options.imu_rate), output.shape)
            outputs.append(clip(self.model, sensor, self.values, output=quantise(output + white + wander.take(len(output)), resolution)))
        jitter = np.round(self._rng.normal(0.0, noise.stamp_jitter * 1e9, len(time))).astype(np.int64) if noise.stamp_jitter else 0
        stamps = self._stamps(time) + jitter
        return ImuSamples(stamps, *outputs, self.options.frame_id), self._truth(stamps, motion)

    def _answered(self, time, motion):
        """Return the outputs of the sensors without noise."""
        force, rate = answered(self.model, self.values, self.table, motion=motion, time=time, options=self.options)
        if not self.causes:
            return force, rate
        truth = self._truth(np.zeros(len(time), np.int64), motion)
        felt = Felt(truth.force_s, truth.rate_s, force, rate)
        for cause in self.causes:
            felt = cause(felt)
        return felt.force, felt.rate

    def _truth(self, stamps, motion):
        felt = [warped_reference(self.model, sensor, self.table, motion=motion) for sensor in SENSORS]
        force = felt[0].force_s
        arm = self.model.value('accelerometer', Role.ARM, self.values)
        if arm is not None:
            force = force + lever_matrix(felt[0].rate_s, felt[0].alpha_s) @ arm
        return ImuSamples(stamps, force, felt[1].rate_s, self.options.frame_id)

    def _joints(self, until):
        time = self._times('joints', self.options.joint_rate, 0.5, until)
        names = tuple(self.table.joint_names)
        if not len(time):
            return JointSamples(np.zeros(0, np.int64), np.zeros((0, len(names))), np.zeros((0, len(names))), names)
        motion = self.motion.at(time)
        velocity = motion.rate if self.options.with_velocity else np.full_like(motion.rate, np.nan)
        return JointSamples(self._stamps(time), read_encoders(motion.position, self.options.noise, self._rng), velocity, names)

    def _temperature(self, until):
        if self.options.temperature_start_c is None:
            return None
        time = self._times('temperature', TEMPERATURE_RATE, 0.0, until)
        return TemperatureSamples(self._stamps(time), temperature_at(time, self.options) if len(time) else np.zeros(0))


class _Wander:
    """The first-order Gauss-Markov bias of `gauss_markov`, continued from block to block."""

    def __init__(self, sd, correlation_time, step, rng):
        self._decay, self._rng = np.exp(-step / correlation_time), rng
        self._drive_sd = sd * np.sqrt(-np.expm1(-2.0 * step / correlation_time))
        self._state = rng.normal(0.0, sd, 3)

    def take(self, count):
        """Return the next values, shape (count, 3)."""
        drive = self._rng.normal(0.0, self._drive_sd, (count, 3))
        values = autoregressive(drive, self._decay, self._state)
        self._state = values[-1]
        return values
