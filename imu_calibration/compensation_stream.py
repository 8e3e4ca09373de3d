"""Compensation of a stream of blocks: the state that has to go from one block to the next, and what is noticed on the way."""

import numpy as np

from imu_calibration import compensation
from imu_calibration.compensation import arms_of, compensate, needs_temperature, output_covariance
from imu_calibration.differentiation import choose_derivative
from imu_calibration.errors import InputError

CORRECTED_TOPIC_ENDINGS = ('data_corrected', 'corrected')
"""A topic that ends like this is refused: nobody should correct twice."""


class CompensationStream:
    """
    Corrects blocks of samples in order; the outcome does not depend on how the stream is cut.

    Parameters
    ----------
    calibration : Calibration
    period : float, optional
        Sampling period, s; default the median step of the first block.
    temperature : TemperatureSamples, optional
        For calibrations with thermal effects.
    transfer : compensation.Transfer, optional
        Another point and frame.

    """

    def __init__(self, calibration, period=None, temperature=None, transfer=None):
        self.calibration, self.transfer, self.temperature = calibration, transfer, temperature
        if needs_temperature(compensation.invertible(calibration.model)) and temperature is None:
            raise InputError('the calibration has thermal effects and needs temperatures, the recording has none; record imu/temperature')
        self.period, self.derivative = period, None
        self.count, self.flagged = 0, 0
        self._past = np.zeros((0, 3))
        self._fastest, self._temperatures = 0.0, []

    def correct(self, imu):
        """Return `Corrected` for the next block of ImuSamples."""
        self._settle(imu)
        temperature = self._temperature_at(imu.stamp_ns)
        rate = np.concatenate([self._past, imu.rate_s])
        alpha = self._alpha(rate)[len(self._past):]
        self._past = rate[-(self.derivative.taps - 1):]
        corrected = compensate(self.calibration, imu.force_s, imu.rate_s, alpha, temperature, self.transfer)
        self.count += len(imu)
        self.flagged += int(corrected.flagged.sum())
        if len(imu):
            self._fastest = max(self._fastest, float(np.sqrt((imu.rate_s**2).sum(axis=1).max())))
        return corrected

    def _settle(self, imu):
        if self.derivative is not None:
            return
        if self.period is None:
            steps = np.diff(imu.stamp_ns[:10_000])
            self.period = float(np.median(steps[steps > 0])) * 1e-9 if np.any(steps > 0) else 0.01
        self.derivative = derivative_for(self.calibration, self.period, self.transfer)

    def _alpha(self, rate):
        """Angular acceleration of the true rate: the derivative of the measured one through the inverse matrix."""
        return self.derivative.apply(rate) @ np.linalg.inv(self.calibration.value('gyroscope', 'matrix')).T

    def _temperature_at(self, stamp_ns):
        if self.temperature is None or not len(self.temperature):
            return None
        origin = self.temperature.stamp_ns[0]
        values = np.interp((stamp_ns - origin) * 1e-9, (self.temperature.stamp_ns - origin) * 1e-9, self.temperature.temperature_c)
        if len(values):
            self._temperatures += [float(values.min()), float(values.max())]
            self._temperatures = [min(self._temperatures), max(self._temperatures)]
        return values

    def covariances(self):
        """Return the noise covariances of corrected (force, rate), each (3, 3), for messages whose own are unknown."""
        return tuple(output_covariance(self.calibration, sensor) for sensor in ('accelerometer', 'gyroscope'))

    def warnings(self):
        """Return lines about what was outside the calibration's conditions or could not be corrected."""
        fastest = np.array([[self._fastest, 0.0, 0.0]])
        lines = compensation.outside_conditions(self.calibration, fastest, self._temperatures or None)
        if self.flagged:
            lines.append(f'{self.flagged} samples are saturated: they are passed on as they are and cannot be trusted')
        return lines


def derivative_for(calibration, period, transfer=None):
    """Return the causal derivative that suits the arms and the noise of a calibration."""
    arm = float(np.max(np.linalg.norm(arms_of(calibration), axis=1)))
    if transfer is not None:
        arm = max(arm, float(np.linalg.norm(transfer.arm_t)))
    (force_sd, _), (rate_sd, _) = (calibration.noise(sensor) for sensor in ('accelerometer', 'gyroscope'))
    return choose_derivative(period, float(rate_sd.max()), arm, max(float(force_sd.min()), 1e-9))


def refuse_corrected(topic):
    """
    Refuse a stream that is corrected already.

    Raises
    ------
    InputError
        When the topic's name says so.

    """
    if topic.rstrip('/').endswith(CORRECTED_TOPIC_ENDINGS):
        raise InputError(f"the topic must carry raw measurements, '{topic}' is corrected already; name the raw topic with --imu-topic")
