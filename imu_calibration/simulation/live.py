"""A simulated table with an IMU on it, block after block, for a live simulator."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.core.samples import ImuSamples, JointSamples, TemperatureSamples
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.forward_equations import References, clip
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.rotations import lever_matrix
from imu_calibration.kinematics.table import Table
from imu_calibration.simulation.sensor_noise import Cause, Felt, ImuNoise, jitter_stamps
from imu_calibration.simulation.session import SimulationOptions, answered, joint_samples, stamps_at, temperature_at
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
        self._noise = ImuNoise(options.noise, sample_rate=options.imu_rate, rng=self._rng, drawn=True)

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

    def _imu(self, time):
        if not len(time):
            empty = ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), self.options.frame_id)
            return empty, empty
        motion = self.motion.at(time)
        noisy = self._noise.add(*self._answered(time, motion))
        force, rate = (clip(self.model, sensor, self.values, output=output) for sensor, output in zip(SENSORS, noisy))
        stamps = jitter_stamps(stamps_at(time, self.start_ns), self.options.noise.stamp_jitter, self._rng)
        return ImuSamples(stamps, force, rate, self.options.frame_id), self._truth(stamps, motion)

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
        references = References(self.model, self.table, motion)
        felt = [references.at(sensor) for sensor in SENSORS]
        force = felt[0].force_s
        arm = self.model.value('accelerometer', Role.ARM, self.values)
        if arm is not None:
            force = force + lever_matrix(felt[0].rate_s, felt[0].alpha_s) @ arm
        return ImuSamples(stamps, force, felt[1].rate_s, self.options.frame_id)

    def _joints(self, until):
        motion = self.motion.at(self._times('joints', self.options.joint_rate, 0.5, until))
        return joint_samples(motion, self.table, self.options, start_ns=self.start_ns, rng=self._rng)

    def _temperature(self, until):
        if self.options.temperature_start_c is None:
            return None
        time = self._times('temperature', TEMPERATURE_RATE, 0.0, until)
        return TemperatureSamples(stamps_at(time, self.start_ns), temperature_at(time, self.options))
