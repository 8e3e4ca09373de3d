"""Compensation of a recording, block by block or one sample after another, and its evaluation."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from imu_calibration.compensation.angular_acceleration import (
    NO_SLOPE,
    CausalDerivative,
    choose_derivative,
    typical_period,
)
from imu_calibration.compensation.compensate import (
    Corrected,
    FittedErrors,
    Transfer,
    arms_of,
    compensated_samples,
    invertible,
    outside_conditions,
    saturation_level,
)
from imu_calibration.compensation.covariance import Uncertainty, is_known
from imu_calibration.compensation.kernel import make_kernel
from imu_calibration.compensation.rate_slope import WITHOUT, RateSlope
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, SampleBlock, TemperatureSamples
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.kinematics.signal_history import BandVariance, ThermalBranch
from imu_calibration.preprocessing.stamping import REGULAR, StampLine, describe_stamps

NO_VIBRATION: tuple = (0.0, 0.0, 0.0)
FOLLOWED_NS = 500_000
"""
Time between updates of the covariances in a new window, ns: at several kHz an update for each
sample takes longer than the samples do, and messages are lost.
"""
CORRECTED_TOPIC_ENDINGS = ('data_corrected', 'corrected')
"""A topic with this ending is refused, because a second correction would be wrong."""


class CompensationStream:
    """
    Corrects blocks of samples in order; the outcome does not depend on how the stream is cut.

    Parameters
    ----------
    calibration : Calibration
    temperature : TemperatureSamples, optional
        For calibrations with thermal effects.
    transfer : Transfer, optional
        Another point and frame.

    """

    def __init__(
        self,
        calibration: FittedErrors,
        temperature: TemperatureSamples | None = None,
        transfer: Transfer | None = None,
    ):
        self.calibration = calibration
        self.transfer = transfer
        self.temperature = temperature
        model = invertible(calibration.model)
        if model.needs_temperature and temperature is None:
            raise InputError(
                'the calibration has thermal effects and needs temperatures, the recording has'
                ' none; record imu/temperature',
                code='temperature_missing',
            )
        if temperature is not None and model.uses('thermal branch'):
            self.temperature = replace(
                temperature, branch=ThermalBranch().of(temperature.temperature_c)
            )
        self._vibration = BandVariance() if model.uses('vibration') else None
        self.count = 0
        """Number of samples."""
        self.flagged = 0
        """Number of samples that cannot be trusted (`Corrected.flagged`)."""
        self.frame_id = ''
        """Frame of the last block."""
        self.slope = RateSlope(
            partial(derivative_for, calibration, transfer=transfer),
            bias=calibration.of('gyroscope', Role.OFFSET),
        )
        self._uncertainty = Uncertainty(calibration, transfer)
        self._inverse_rate = np.linalg.inv(calibration.of('gyroscope', Role.LINEAR))
        self._largest_rate = 0.0
        """Largest measured rate, rad/s."""
        self._temperature_range: list[float] = []
        """Lowest and highest temperature, degrees Celsius; empty without one."""
        self._last_inputs: dict[str, Any] = {}
        """Arguments of `Uncertainty.at` at the last complete sample."""
        self.measured = dict.fromkeys(SENSORS, False)
        """Sensor -> whether a finite reading of it was received."""

    def correct(self, imu: ImuSamples) -> Corrected:
        """
        Return `Corrected` for the next block of ImuSamples.

        A reading that is NaN, absent or broken remains NaN and does not affect its neighbours or
        the other sensor.
        """
        # The first block determines how the samples are stamped; too few stamps count as those of a
        # clock, a single one as at 100 Hz.
        if self.slope.line is None and len(imu):
            first = imu.stamp_ns[:10_000]
            line = describe_stamps(first)
            self.slope.settle(line or StampLine(REGULAR, 1e9 * (typical_period(first) or 0.01)))

        # Inputs besides the readings: temperature, derivative of the rate, vibration.
        temperature, branch = self._temperature_at(imu.stamp_ns)
        has_force = np.isfinite(imu.force_s).all(axis=1)
        has_rate = np.isfinite(imu.rate_s).all(axis=1)
        self.measured['accelerometer'] |= bool(has_force.any())
        self.measured['gyroscope'] |= bool(has_rate.any())
        slope = np.zeros_like(imu.rate_s)
        slope[has_rate] = self.slope.push_block(imu.stamp_ns[has_rate], imu.rate_s[has_rate])

        # A missing reading is computed as that of zero input, and is NaN again in the result.
        no_force = self.calibration.of('accelerometer', Role.OFFSET)
        no_rate = self.calibration.of('gyroscope', Role.OFFSET)
        force_s = np.where(has_force[:, None], imu.force_s, no_force)
        rate_s = np.where(has_rate[:, None], imu.rate_s, no_rate)
        vibration = self._vibration_of(imu.force_s, has_force)
        corrected = compensated_samples(
            self.calibration,
            force_s,
            rate_s,
            alpha_s=slope @ self._inverse_rate.T,
            temperature_c=temperature,
            thermal_branch=branch,
            vibration=vibration,
            transfer=self.transfer,
        )
        corrected.force[~has_force] = np.nan
        corrected.rate[~has_rate] = np.nan

        # Counts, and the last complete sample, for the state of the stream.
        self.count += len(imu)
        self.frame_id = imu.frame_id
        self.flagged += int(corrected.flagged.sum())
        squares = (imu.rate_s[has_rate] ** 2).sum(axis=1)
        self._largest_rate = max(self._largest_rate, float(np.sqrt(squares.max(initial=0.0))))
        usable = np.flatnonzero(has_force & has_rate)
        if len(usable):
            k = usable[-1]
            self._last_inputs = {
                'force': imu.force_s[k],
                'rate': imu.rate_s[k],
                'derivative': slope[k],
            }
            if temperature is not None:
                reference_c = self.calibration.model.temperature_ref_c
                self._last_inputs['warming'] = float(temperature[k]) - reference_c
            if branch is not None:
                self._last_inputs['branch'] = float(branch[k])
            if vibration is not None:
                self._last_inputs['vibration'] = tuple(vibration[k].tolist())
        return corrected

    def _vibration_of(self, force_s: np.ndarray, finite: np.ndarray) -> np.ndarray | None:
        """
        Return the variance of vibration at the samples of a block, (m/s^2)^2, shape (n, 3).

        At a sample that is not `finite` it is that before the block; None if it is not needed.
        """
        if self._vibration is None:
            return None
        vibration = np.tile(self._vibration.now, (len(force_s), 1))
        vibration[finite] = self._vibration.of(self.slope.period or 0.0, force_s[finite])
        return vibration

    def _temperature_at(self, stamp_ns: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Return (temperatures, thermal branches) at stamps; None where absent or not needed."""
        temperature = self.temperature
        if temperature is None or not len(temperature):
            return None, None
        origin = temperature.stamp_ns[0]
        time = (stamp_ns - origin) * 1e-9
        measured_time = (temperature.stamp_ns - origin) * 1e-9
        values = np.interp(time, measured_time, temperature.temperature_c)
        if len(values):
            reached = [*self._temperature_range, float(values.min()), float(values.max())]
            self._temperature_range = [min(reached), max(reached)]
        branch = None
        if temperature.branch is not None:
            branch = np.interp(time, measured_time, temperature.branch)
        return values, branch

    def propagate(
        self, force_cov: np.ndarray | None, rate_cov: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the covariances of corrected (force, rate), each (3, 3), at the last sample.

        Parameters
        ----------
        force_cov, rate_cov : ndarray or None
            Covariances of the readings, shape (3, 3); zero, invalid or None: the noise of the
            calibration is used.

        """
        self._uncertainty.use(self.slope.derivative, self.slope.period)
        force_noise, rate_noise = self._uncertainty.noise
        sensitivity = self._uncertainty.at(**self._last_inputs, slope_error=self.slope.error())
        return sensitivity.covariances(
            _stated_or_noise(force_cov, force_noise), _stated_or_noise(rate_cov, rate_noise)
        )

    def warnings(self) -> list[str]:
        """
        Return lines on samples outside the conditions of the calibration, or without correction.
        """
        lines = outside_conditions(self.calibration, self._largest_rate, self._temperature_range)
        names_both_frames = self.frame_id and self.calibration.frame_id
        if names_both_frames and self.frame_id != self.calibration.frame_id:
            lines.append(
                f"the messages carry frame_id '{self.frame_id}', the calibration is for"
                f" '{self.calibration.frame_id}': make sure that it is the same sensor"
            )
        if self.slope.n_without and uses_slope(self.calibration, self.transfer):
            lines.append(
                f'the stamps of {self.slope.n_without} of {self.count} samples are frozen{WITHOUT}'
            )
        if self.flagged:
            lines.append(
                f'{self.flagged} samples are saturated or too large to be corrected: they cannot be'
                ' trusted'
            )
        return lines


def derivative_for(
    calibration: FittedErrors, period: float, transfer: Transfer | None = None
) -> CausalDerivative:
    """Return the causal derivative that suits the arms and the noise of a calibration."""
    arm = float(np.max(np.linalg.norm(arms_of(calibration), axis=1)))
    if transfer is not None:
        arm = max(arm, float(np.linalg.norm(transfer.arm_t)))
    force_sd, _ = calibration.noise('accelerometer', period)
    rate_sd, _ = calibration.noise('gyroscope', period)
    return choose_derivative(period, float(rate_sd.max()), arm, force_sd=float(force_sd.min()))


def uses_slope(calibration: FittedErrors, transfer: Transfer | None = None) -> bool:
    """Return whether the correction uses the angular acceleration: there is a lever arm."""
    if transfer is not None and np.any(transfer.arm_t):
        return True
    return bool(np.any(arms_of(calibration)))


def refuse_corrected(topic: str) -> None:
    """
    Refuse a stream that is corrected already.

    Raises
    ------
    InputError
        If the name of the topic has the ending of corrected topics.

    """
    if topic.rstrip('/').endswith(CORRECTED_TOPIC_ENDINGS):
        raise InputError(
            f"the topic must carry raw measurements, '{topic}' is corrected already; name the raw"
            ' topic',
            key='imu_topic',
            code='corrected_already',
        )


def requested_transfer(
    frame_id: str, xyz: Sequence[float], rpy: Sequence[float]
) -> Transfer | None:
    """
    Return the Transfer of options or parameters, None without a target frame.

    Raises
    ------
    InputError
        If a pose is given without the name of its frame.

    """
    if frame_id:
        return Transfer.from_pose(frame_id, xyz, rpy)
    if any(xyz) or any(rpy):
        raise InputError(
            'a pose in the target frame needs the name of that frame, none was given; give the'
            ' target frame as well',
            key='target_frame',
            code='frame_name_missing',
        )
    return None


def late_ns(calibration: FittedErrors, wanted: bool = True) -> int:
    """Return the delay to subtract from stamps, ns: the time_offset if `wanted`, otherwise 0."""
    delay = calibration.of('reference', Role.DELAY) if wanted else None
    return 0 if delay is None else round(float(delay) * 1e9)


Vectors = Sequence[Sequence[float]] | np.ndarray
Temperatures = Sequence[float] | np.ndarray | TemperatureSamples | float


def compensate_samples(
    calibration: FittedErrors, imu: ImuSamples, temperature_c: Temperatures | None = None
) -> ImuSamples:
    """Return samples without the calibrated errors; as `compensate_readings`."""
    corrected = CompensationStream(
        calibration, _as_temperatures(temperature_c, imu.stamp_ns)
    ).correct(imu)
    return ImuSamples(imu.stamp_ns, corrected.force, corrected.rate, imu.frame_id)


def compensate_readings(
    calibration: FittedErrors,
    samples: Vectors | ImuSamples,
    rate_s: Vectors | None = None,
    *,
    time: Sequence[float] | np.ndarray | None = None,
    temperature_c: Temperatures | None = None,
) -> tuple[np.ndarray, np.ndarray] | ImuSamples:
    """
    Return readings without the calibrated errors.

    Parameters
    ----------
    calibration : Calibration
    samples : ImuSamples, or array_like, shape (n, 3)
        Readings of one IMU in order of time, or measured specific force in the sensor frame, m/s^2.
    rate_s : array_like, shape (n, 3), optional
        Measured angular rate at the samples of specific force, rad/s.
    time : array_like, shape (n,), optional
        Times of the arrays, s: a causal filter of the rates gives the angular acceleration.
    temperature_c : float, array_like of shape (n,), or TemperatureSamples, optional
        Needed when the calibration has thermal effects, degrees Celsius.

    Returns
    -------
    ImuSamples, or (ndarray, ndarray)
        Specific force and rate as they were given; NaN where a reading cannot be corrected.

    Raises
    ------
    InputError
        When shapes do not fit, or times or temperatures are missing that the calibration needs.

    """
    if isinstance(samples, ImuSamples):
        return compensate_samples(calibration, samples, temperature_c)
    corrected = compensate_samples(
        calibration, _as_samples(calibration, samples, rate_s, time), temperature_c
    )
    return corrected.force_s, corrected.rate_s


def _as_samples(calibration: FittedErrors, force_s: Vectors, rate_s: Any, time: Any) -> ImuSamples:
    """Return arrays as ImuSamples; times may be missing if no arm needs angular acceleration."""
    if time is None:
        if np.any(arms_of(calibration)):
            raise InputError(
                'the calibration has lever arms and needs the time of each reading, none was given;'
                ' give `time` in seconds',
                code='time_missing',
            )
        time = np.arange(len(force_s)) * 0.01  # 100 Hz; no derivative is used
    imu = SampleBlock.from_arrays(time, force_s, rate_s).imu
    assert imu is not None, 'a block of arrays has readings'
    return imu


def _as_temperatures(
    temperature_c: Temperatures | None, stamp_ns: np.ndarray
) -> TemperatureSamples | None:
    """Return a temperature, or one for each stamp, as TemperatureSamples."""
    if temperature_c is None or isinstance(temperature_c, TemperatureSamples):
        return temperature_c
    return TemperatureSamples(
        stamp_ns, np.broadcast_to(np.asarray(temperature_c, float), stamp_ns.shape)
    )


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

    def __init__(
        self,
        calibration: FittedErrors,
        transfer: Transfer | None = None,
        with_parameters: bool = True,
    ):
        self.calibration = calibration
        self.transfer = transfer
        self.with_parameters = with_parameters
        self.counts: Counter[str] = Counter()
        """Reason -> number of samples that are not corrected, or with a fault."""
        self.corrected = 0
        """Number of corrected samples."""
        self.fastest_squared = 0.0
        """Largest squared rate since a user has set it to zero, (rad/s)^2."""
        model = invertible(calibration.model)
        self.needs_temperature = model.needs_temperature
        self.warming = None if self.needs_temperature else 0.0
        """Temperature above the calibration's reference temperature, K; None before the first."""
        self.branch = ThermalBranch()
        self.vibration = BandVariance()
        self._uses_vibration = model.uses('vibration')
        """Whether the correction uses the vibration."""
        self.at_zero = {
            sensor: tuple(calibration.of(sensor, Role.OFFSET).tolist()) for sensor in SENSORS
        }
        """Sensor -> reading at zero input, SI."""
        self.levels = tuple(saturation_level(calibration, sensor) for sensor in SENSORS)
        """Readings from which (force, rate) are saturated, SI."""
        self.needs_slope = uses_slope(calibration, transfer)
        """Whether the correction uses the derivative of the rate."""
        # With known densities the sampling period determines the noise of a sample.
        self._needs_stamps = self.needs_slope or self._uses_vibration or calibration.knows_density
        """Whether the stamps are followed."""
        self.slope = RateSlope(
            partial(derivative_for, calibration, transfer=transfer),
            self._take_derivative,
            self.at_zero['gyroscope'],
        )
        self._kernel = make_kernel(calibration, transfer)
        at_rest = (0.0, 0.0, 9.8), (0.0, 0.0, 0.0), NO_SLOPE
        self.last: tuple[Any, ...] = (*at_rest, 0.0, 0.0, NO_VIBRATION)
        """
        Arguments of `Uncertainty.at` at the last sample: force, rate, derivative of the rate,
        warming, thermal branch, vibration. A tuple, because each sample makes one.
        """
        self.revision = 0
        """Number of updates of the covariances."""
        self._n_changes = 0
        """`RateSlope.n_changes` at the last update of the covariances by the derivative."""
        self._restarts = 0
        """`RateSlope.restarts` at that update."""
        self._followed_ns = 0
        """Stamp of the sample of that update, ns."""
        self._uncertainty = Uncertainty(calibration, transfer, self._kernel)
        self.refresh()

    def set_temperature(self, temperature_c: float) -> None:
        """Set the temperature near the sensor, degrees Celsius."""
        if temperature_c - temperature_c != 0.0:  # not finite
            return
        self.branch.push(temperature_c)
        if self.needs_temperature:
            self.warming = temperature_c - self.calibration.model.temperature_ref_c

    def correct(
        self, stamp_ns: int, wx: float, wy: float, wz: float, fx: float, fy: float, fz: float
    ) -> tuple[float, ...] | None:
        """
        Return corrected rate and specific force, six floats, or None if no sample can be published.

        `counts` has the reason.
        """
        warming = self.warming
        if warming is None:
            self.counts['no temperature yet'] += 1
            return None
        total = wx + wy + wz + fx + fy + fz
        if total - total != 0.0:  # NaN where a reading is NaN or infinite
            self.counts['not finite'] += 1
            return None
        slope = self.slope.push(stamp_ns, wx, wy, wz) if self._needs_stamps else NO_SLOPE
        vibration = NO_VIBRATION
        if self._uses_vibration:
            vibration = self.vibration.push(self.slope.period or 0.0, (fx, fy, fz))
        ux, uy, uz, vx, vy, vz = self._kernel(
            fx, fy, fz, wx, wy, wz, *slope, warming, self.branch.now, *vibration
        )
        rate_squared = vx * vx + vy * vy + vz * vz
        if rate_squared != rate_squared:  # NaN
            self.counts['outside the invertible range'] += 1
            return None
        self.last = (
            (fx, fy, fz),
            (wx, wy, wz),
            slope,
            warming,
            self.branch.now,
            vibration,
        )
        if rate_squared > self.fastest_squared:
            self.fastest_squared = rate_squared
        self.corrected += 1
        if self.needs_slope and self.slope.n_changes != self._n_changes:
            is_due = abs(stamp_ns - self._followed_ns) >= FOLLOWED_NS
            if is_due or self.slope.window_begins:
                self._followed_ns = stamp_ns
                self._follow_slope()
        return vx, vy, vz, ux, uy, uz

    def covariances(
        self, force_cov: np.ndarray | None, rate_cov: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the covariances of corrected (force, rate), each (3, 3), at their last update.

        Arguments as for `CompensationStream.propagate`, except None for an absent sensor.
        """
        force_noise, rate_noise = self._uncertainty.noise
        absent = np.zeros((3, 3))
        force = absent if force_cov is None else _stated_or_noise(force_cov, force_noise)
        rate = absent if rate_cov is None else _stated_or_noise(rate_cov, rate_noise)
        return self._sensitivity.covariances(force, rate, self.with_parameters)

    def refresh(self) -> None:
        """Update the covariances of the corrected readings at the latest sample."""
        force, rate, slope, warming, branch, vibration = self.last
        self._sensitivity = self._uncertainty.at(
            force,
            rate,
            slope,
            warming=warming,
            branch=branch,
            vibration=vibration,
            slope_error=self.slope.error() if self.needs_slope else None,
        )
        self.revision += 1

    def _follow_slope(self) -> None:
        """Update the covariances while the derivative is not yet that of a full window."""
        # The gains are slow to compute, and change with the motion only.
        is_first = not self._n_changes
        if is_first or self.slope.restarts != self._restarts:
            self.refresh()
        else:
            self._sensitivity = self._sensitivity.with_slope_error(self.slope.error())
            self.revision += 1
        self._n_changes = self.slope.n_changes
        self._restarts = self.slope.restarts

    def prepare(self, before: 'SampleCompensation') -> None:
        """
        Prepare the replacement of `before`.

        Compute period and covariances at its latest sample, which is slow.
        """
        self.slope.prepare(before.slope)
        self.last = before.last
        self.refresh()

    def follow(self, before: 'SampleCompensation') -> None:
        """
        Continue from another compensation: same past of the rate, same temperature, same counts.
        """
        self.counts = before.counts
        self.corrected = before.corrected
        self.fastest_squared = before.fastest_squared
        if before.warming is not None and before.needs_temperature and self.warming is None:
            self.warming = (
                before.warming
                + before.calibration.model.temperature_ref_c
                - self.calibration.model.temperature_ref_c
            )
        self.branch, self.vibration = before.branch, before.vibration
        self.slope.follow(before.slope)

    def _take_derivative(self) -> None:
        """Update the covariances for another derivative or sampling period."""
        self._uncertainty.use(self.slope.derivative, self.slope.period)
        self.refresh()


def _stated_or_noise(covariance: np.ndarray | None, noise: np.ndarray) -> np.ndarray:
    """Return the stated covariance of a reading if it is valid, else its noise, shape (3, 3)."""
    return noise if covariance is None or not is_known(covariance) else covariance
