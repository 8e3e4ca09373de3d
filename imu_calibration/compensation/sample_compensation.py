"""One sample after another, corrected in plain floats: the kernel with the derivative and the covariances that it needs."""

from collections import Counter

import numpy as np

from imu_calibration.compensation.angular_acceleration import WARM_UP, CausalDerivative, StampedDerivative, typical_period
from imu_calibration.compensation.compensate import arms_of, invertible, saturation_level
from imu_calibration.compensation.covariance import Uncertainty
from imu_calibration.compensation.kernel import make_kernel
from imu_calibration.compensation.stream import derivative_for
from imu_calibration.effects.base import SENSORS, Role

NO_SLOPE = (0.0, 0.0, 0.0)


class SampleCompensation:
    """
    Corrects sample after sample; knows no messages.

    Parameters
    ----------
    calibration : Calibration
    transfer : compensation.Transfer, optional
        Another point and frame.
    with_parameters : bool
        Whether the uncertainty of the calibration enters the covariances.

    """

    def __init__(self, calibration, transfer=None, with_parameters=True):
        self.calibration, self.transfer, self.with_parameters = calibration, transfer, with_parameters
        self.counts, self.corrected, self.fastest_squared = Counter(), 0, 0.0
        self.needs_temperature = invertible(calibration.model).needs_temperature
        self.dt = None if self.needs_temperature else 0.0
        self.at_zero = {sensor: tuple(calibration.of(sensor, Role.OFFSET).tolist()) for sensor in SENSORS}
        self.levels = tuple(saturation_level(calibration, sensor) for sensor in SENSORS)
        self.needs_slope = bool(np.any(arms_of(calibration))) or (transfer is not None and bool(np.any(transfer.arm_t)))
        self.period, self._tracker, self._steps = None, None, []
        self._push = self._warm_up if self.needs_slope else None
        self._kernel = make_kernel(calibration, transfer)
        self.last = ((0.0, 0.0, 9.8), (0.0, 0.0, 0.0), NO_SLOPE, 0.0)
        self.revision = 0
        """Counts how often the covariances were taken anew."""
        self._take_uncertainty(None)

    def set_temperature(self, temperature_c):
        """Tell the temperature near the sensor, degrees Celsius."""
        if self.needs_temperature and temperature_c - temperature_c == 0.0:
            self.dt = temperature_c - self.calibration.model.temperature_ref_c

    @property
    def derivative(self):
        """The causal derivative in use, None until the period is known or when it is not needed."""
        return None if self._tracker is None else CausalDerivative(self._tracker.taps, self._tracker.period)

    def correct(self, stamp_ns, wx, wy, wz, fx, fy, fz):
        """Return corrected rate and specific force, six floats, or None when there is nothing to publish; `counts` says why."""
        total, dt = wx + wy + wz + fx + fy + fz, self.dt
        if total - total != 0.0 or dt is None:
            return self.refuse('no temperature yet' if dt is None else 'not finite')
        slope = NO_SLOPE if self._push is None else self._push(stamp_ns, wx, wy, wz)
        ux, uy, uz, vx, vy, vz = self._kernel(fx, fy, fz, wx, wy, wz, *slope, dt)
        squared = vx * vx + vy * vy + vz * vz
        if squared != squared:
            return self.refuse('beyond what can be undone')
        self.last = ((fx, fy, fz), (wx, wy, wz), slope, dt)
        if squared > self.fastest_squared:
            self.fastest_squared = squared
        self.corrected += 1
        return vx, vy, vz, ux, uy, uz

    def refuse(self, reason):
        """Count a sample that cannot be corrected; return None."""
        self.counts[reason] += 1

    def covariances(self, force_cov, rate_cov):
        """
        Return the covariances of corrected (force, rate), each (3, 3), at the sample at which they were taken last.

        Those of the measured ones, (3, 3), may be zero: unknown, the calibration's noise is taken; or None: not measured.
        """
        known = [np.zeros((3, 3)) if cov is None else cov if cov.any() else noise for cov, noise in zip((force_cov, rate_cov), self._uncertainty.noise)]
        return self._sensitivity.covariances(*known, self.with_parameters)

    def refresh(self):
        """Take the covariances of the corrected readings anew at the latest sample."""
        self._sensitivity = self._uncertainty.at(*self.last)
        self.revision += 1

    def prepare(self, before):
        """Do beforehand what takes long when this takes over from `before`: period and covariances at its latest sample."""
        if before.period is not None:
            self._settle(before.period)
        self.last = before.last
        self.refresh()

    def follow(self, before):
        """Go on where another compensation stops: same past of the rate, same temperature, same counts."""
        self.counts, self.corrected, self.fastest_squared, self._steps = before.counts, before.corrected, before.fastest_squared, before._steps
        if before.dt is not None and before.needs_temperature and self.dt is None:
            self.set_temperature(before.dt + before.calibration.model.temperature_ref_c)
        if self._tracker is not None and before._tracker is not None:
            self._tracker.seed(before._tracker)

    def _warm_up(self, stamp_ns, *_):
        """Gather stamps until the period is known; the angular acceleration counts as zero so long."""
        self._steps.append(stamp_ns)
        if len(self._steps) > WARM_UP:
            period, self._steps = typical_period(self._steps), []
            if period is not None:
                self._settle(period)
        return NO_SLOPE

    def _settle(self, period):
        self.period = period
        if self.needs_slope:
            self._tracker = StampedDerivative(derivative_for(self.calibration, period, self.transfer))
            self._push = self._tracker.push
            self._take_uncertainty(self.derivative)

    def _take_uncertainty(self, derivative):
        self._uncertainty = Uncertainty(self.calibration, self.transfer, derivative)
        self.refresh()
