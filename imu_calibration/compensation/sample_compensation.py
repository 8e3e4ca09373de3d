"""One sample after another, corrected in plain floats: the kernel with the derivative and the covariances that it needs."""

from collections import Counter
from functools import partial
from typing import Any

import numpy as np

from imu_calibration.compensation.angular_acceleration import NO_SLOPE
from imu_calibration.compensation.compensate import FittedErrors, Transfer, invertible, saturation_level
from imu_calibration.compensation.covariance import Uncertainty, is_known
from imu_calibration.compensation.kernel import make_kernel
from imu_calibration.compensation.rate_slope import RateSlope
from imu_calibration.compensation.stream import derivative_for, uses_slope
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.kinematics.signal_history import BandVariance, ThermalBranch


class SampleCompensation:
    """
    Corrects sample by sample, independent of messages.

    Parameters
    ----------
    calibration : Calibration
    transfer : compensation.Transfer, optional
        Another point and frame.
    with_parameters : bool
        Whether the uncertainty of the calibration enters the covariances.

    """

    def __init__(self, calibration: FittedErrors, transfer: Transfer | None = None, with_parameters: bool = True):
        self.calibration, self.transfer, self.with_parameters = calibration, transfer, with_parameters
        self.counts, self.corrected, self.fastest_squared = Counter(), 0, 0.0
        model = invertible(calibration.model)
        self.needs_temperature = model.needs_temperature
        self.dt = None if self.needs_temperature else 0.0
        self.branch, self.vibration = ThermalBranch(), BandVariance()
        self._shakes = model.uses('vibration')
        self.at_zero = {sensor: tuple(calibration.of(sensor, Role.OFFSET).tolist()) for sensor in SENSORS}
        self.levels = tuple(saturation_level(calibration, sensor) for sensor in SENSORS)
        self.needs_slope = uses_slope(calibration, transfer)
        self._follows = self.needs_slope or self._shakes or calibration.knows_density   # the stamps determine the noise of a sample
        self.slope = RateSlope(partial(derivative_for, calibration, transfer=transfer), self._take_derivative)
        self._kernel = make_kernel(calibration, transfer)
        self.last: tuple[Any, ...] = ((0.0, 0.0, 9.8), (0.0, 0.0, 0.0), NO_SLOPE, 0.0, 0.0, NO_SLOPE)
        self.revision = 0
        """Number of updates of the covariances."""
        self._uncertainty = Uncertainty(calibration, transfer)
        self.refresh()

    def set_temperature(self, temperature_c: float) -> None:
        """Set the temperature near the sensor, degrees Celsius."""
        if temperature_c - temperature_c != 0.0:
            return
        self.branch.push(temperature_c)
        if self.needs_temperature:
            self.dt = temperature_c - self.calibration.model.temperature_ref_c

    def correct(self, stamp_ns: int, wx: float, wy: float, wz: float, fx: float, fy: float, fz: float) -> tuple[float, ...] | None:
        """Return corrected rate and specific force, six floats, or None if no sample can be published; `counts` has the reason."""
        total, dt = wx + wy + wz + fx + fy + fz, self.dt
        if total - total != 0.0 or dt is None:
            self.counts['no temperature yet' if dt is None else 'not finite'] += 1
            return None
        slope = self.slope.push(stamp_ns, wx, wy, wz) if self._follows else NO_SLOPE
        vibration = self.vibration.push(self.slope.period or 0.0, (fx, fy, fz)) if self._shakes else NO_SLOPE
        ux, uy, uz, vx, vy, vz = self._kernel(fx, fy, fz, wx, wy, wz, *slope, dt, self.branch.now, *vibration)
        squared = vx * vx + vy * vy + vz * vz
        if squared != squared:
            self.counts['outside the invertible range'] += 1
            return None
        self.last = ((fx, fy, fz), (wx, wy, wz), slope, dt, self.branch.now, vibration)
        if squared > self.fastest_squared:
            self.fastest_squared = squared
        self.corrected += 1
        return vx, vy, vz, ux, uy, uz

    def covariances(self, force_cov: np.ndarray | None, rate_cov: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the covariances of corrected (force, rate), each (3, 3), at the sample of their last update.

        Covariances of the readings, (3, 3), may be zero or invalid: the noise of the calibration is used; or None: not measured.
        """
        force, rate = (np.zeros((3, 3)) if cov is None else cov if is_known(cov) else noise
                       for cov, noise in zip((force_cov, rate_cov), self._uncertainty.noise))
        return self._sensitivity.covariances(force, rate, self.with_parameters)

    def refresh(self) -> None:
        """Update the covariances of the corrected readings at the latest sample."""
        self._sensitivity = self._uncertainty.at(*self.last[:3], dt=self.last[3], branch=self.last[4], vibration=self.last[5],
                                                 slope_error=self.slope.error() if self.needs_slope else None)
        self.revision += 1

    def prepare(self, before: 'SampleCompensation') -> None:
        """Prepare the replacement of `before`: compute period and covariances at its latest sample, which is slow."""
        self.slope.prepare(before.slope)
        self.last = before.last
        self.refresh()

    def follow(self, before: 'SampleCompensation') -> None:
        """Continue from another compensation: same past of the rate, same temperature, same counts."""
        self.counts, self.corrected, self.fastest_squared = before.counts, before.corrected, before.fastest_squared
        if before.dt is not None and before.needs_temperature and self.dt is None:
            self.dt = before.dt + before.calibration.model.temperature_ref_c - self.calibration.model.temperature_ref_c
        self.branch, self.vibration = before.branch, before.vibration
        self.slope.follow(before.slope)

    def _take_derivative(self):
        self._uncertainty.use(self.slope.derivative, self.slope.period)
        self.refresh()
