"""Health of a compensated stream: bias at stops, range, temperature."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_calibration.compensation.compensate import FittedErrors, Transfer
from imu_calibration.compensation.covariance import Uncertainty
from imu_calibration.core.progress import LiveState
from imu_calibration.core.text_enum import StrEnum
from imu_calibration.core.units import DEG, GRAVITY_PLACE_SHARE, STANDARD_GRAVITY, unit_of_rest
from imu_calibration.effects.base import SENSORS
from imu_calibration.kinematics.rotations import EARTH_RATE

HEALTH_BLOCK_SECONDS = 0.25
"""s; means over it are steady at rest even where a motor shakes the robot."""
N_BLOCKS = 4
"""Blocks in a row that must agree, one second."""
MOST_RATE = 0.1
"""
rad/s; larger than the rest reading of any gyroscope that is calibrated, so that a faster rotation
is no rest.
"""
MOST_SHAKE = np.array([0.6] * 3 + [0.06] * 3)
"""
Standard deviation within a block, m/s^2 and rad/s: above that of an idling engine, below that of
driving over a floor.
"""
MAX_BLOCK_CHANGE = np.array([0.05] * 3 + [3e-3] * 3)
"""
Largest difference of block means in addition to noise, m/s^2 and rad/s: 0.3 degrees of tilt, 0.2
degrees per second.
"""
MAX_STOP_SECONDS = 30.0
"""
s; a longer rest counts as several, so that a bias that drifts while the robot is parked is tracked.
"""
TIMES_NOISE = 6.0
"""
Range of four means of noise, in their standard deviations: exceeded once in ten thousand times by
three axes of two sensors.
"""


@dataclass(frozen=True, eq=False)
class Stop:
    """A rest of the IMU until now."""

    start: float
    """When it began, s."""
    end: float
    """The end of its last block, s."""
    n_samples: int
    """Samples in its later half."""
    mean: np.ndarray
    """
    Mean of specific force and rate over the later half, m/s^2 and rad/s, shape (6,): a slow stop
    settles in the earlier half.
    """
    further_mean: np.ndarray
    """Mean of the further columns over the later half, shape (k,)."""
    shake_sd: np.ndarray
    """Standard deviation of the samples in the blocks of the later half, shape (6,)."""
    change: np.ndarray
    """
    Mean over the later half less that over the earlier half, shape (6,): bounds the error of `mean`
    while the motion decays.
    """

    @property
    def seconds(self) -> float:
        """Length, s."""
        return self.end - self.start


# Columns of a block (`StopDetector`): start, end, samples, means of force, rate and k further
# columns, variances of force and rate.
_START, _END, _N_SAMPLES = 0, 1, 2
_FORCE_RATE_MEANS = slice(3, 9)
_RATE_MEANS = slice(6, 9)
_VARIANCES = slice(-6, None)


class StopDetector:
    """
    Processes readings in pieces of any length; the result does not depend on the division.

    A robot that rotates steadily at less than `MOST_RATE` about the vertical is not separable from
    one at rest.

    Parameters
    ----------
    noise_sd : ndarray, shape (6,)
        Standard deviation of a sample at rest, force then rate.

    """

    def __init__(self, noise_sd: np.ndarray):
        self._noise_sd = np.asarray(noise_sd, float)
        self._max_variance = (MOST_SHAKE + 4 * self._noise_sd) ** 2
        """Largest variance of the samples in a block at rest, shape (6,)."""
        self._incomplete: np.ndarray = np.zeros((0, 1))
        """Samples of the block that is not complete yet, as the argument of `push`."""
        self._blocks: list[np.ndarray] = []
        """
        The last `N_BLOCKS` blocks, shape (3 + 6 + k + 6,) each, with the columns above.
        """
        self._still_blocks: list[np.ndarray] = []
        """All blocks of the present stop, as `_blocks`; empty while the IMU moves."""
        self._stop: Stop | None = None
        """The stop of these blocks."""

    def push(self, rows: np.ndarray) -> Stop | None:
        """
        Process samples; return the stop that continues at their end, or None while the IMU moves.

        Parameters
        ----------
        rows : ndarray, shape (n, 7 + k)
            Time in s, specific force, rate, and columns of which the means are wanted as well.

        """
        rows = np.concatenate([self._incomplete, rows]) if len(self._incomplete) else rows
        while len(rows) and rows[-1, 0] - rows[0, 0] >= HEALTH_BLOCK_SECONDS:
            n = max(int(np.searchsorted(rows[:, 0], rows[0, 0] + HEALTH_BLOCK_SECONDS)), 1)
            self._add_block(rows[:n])
            rows = rows[n:]
        self._incomplete = rows
        return self._stop

    def _add_block(self, rows: np.ndarray) -> None:
        """Process the samples of one block, or restart after a gap; rows as of `push`."""
        if self._blocks and rows[0, 0] - self._blocks[-1][_END] > HEALTH_BLOCK_SECONDS:
            self._blocks = []
            self._still_blocks = []
        block = np.concatenate(
            [
                [rows[0, 0], rows[-1, 0], len(rows)],
                rows[:, 1:].mean(axis=0),
                rows[:, 1:7].var(axis=0),
            ]
        )
        self._blocks = [*self._blocks[-N_BLOCKS + 1 :], block]
        if not self._is_calm(block) or not self._do_blocks_agree():
            self._still_blocks = []
        elif not self._still_blocks:
            self._still_blocks = list(self._blocks)  # a stop begins
        elif block[_END] - self._still_blocks[0][_START] <= MAX_STOP_SECONDS:
            self._still_blocks.append(block)
        else:
            self._still_blocks = [block]  # a long rest counts as several
        self._stop = _stop_from(np.array(self._still_blocks)) if self._still_blocks else None

    def _is_calm(self, block: np.ndarray) -> bool:
        """Return whether rate and variances of a block, by itself, are those of a rest."""
        rate = block[_RATE_MEANS]
        if rate @ rate >= MOST_RATE**2:
            return False
        variance = block[_VARIANCES]
        return bool((variance <= self._max_variance).all())

    def _do_blocks_agree(self) -> bool:
        """Return whether the means of the last `N_BLOCKS` blocks are equal within their noise."""
        if len(self._blocks) < N_BLOCKS:
            return False
        blocks = np.array(self._blocks)
        n_samples = blocks[:, _N_SAMPLES]
        means = blocks[:, _FORCE_RATE_MEANS]
        variance = blocks[:, _VARIANCES].max(axis=0)
        # Vibration of the robot is noise for the means as well.
        sample_sd = np.maximum(self._noise_sd, np.sqrt(variance))
        allowed = MAX_BLOCK_CHANGE + TIMES_NOISE * sample_sd / np.sqrt(n_samples.min())
        is_change_small = (np.ptp(means, axis=0) <= allowed).all()
        return bool(is_change_small and (variance <= self._max_variance).all())


def _stop_from(blocks: np.ndarray) -> Stop:
    """Return the `Stop` of the blocks of a rest, shape (n, 3 + 6 + k + 6)."""
    half = len(blocks) // 2
    early_blocks = blocks[: half or None]  # one block is both halves
    late_blocks = blocks[half:]
    # Means and variances over each half: (force, rate, further columns, variances).
    early = np.average(early_blocks[:, 3:], axis=0, weights=early_blocks[:, _N_SAMPLES])
    late = np.average(late_blocks[:, 3:], axis=0, weights=late_blocks[:, _N_SAMPLES])
    return Stop(
        start=float(blocks[0, _START]),
        end=float(blocks[-1, _END]),
        n_samples=int(late_blocks[:, _N_SAMPLES].sum()),
        mean=late[:6],
        further_mean=late[6:-6],
        shake_sd=np.sqrt(late[-6:]),
        change=(late - early)[:6],
    )


MOST_MOVED = 0.02
"""rad/s, 1.1 deg/s: a calibrated bias that has moved farther is a slow turn, or a broken sensor."""


class GyroBiasUpdate:
    """
    The residual bias after compensation, a Gauss-Markov process that every stop measures.

    Between stops ``b <- phi b, P <- phi^2 P + (1 - phi^2) S^2`` with ``phi = exp(-dt / time)``; at
    a stop the Kalman update with the mean of the corrected rate. Without stops the update decays
    and its uncertainty returns to S: that of the calibration, or that of the stops if it is larger.

    Parameters
    ----------
    prior_sd : ndarray, shape (3,)
        Standard deviation of the bias in the calibration, rad/s.
    time : float
        Seconds in which an update loses its meaning.

    """

    def __init__(self, prior_sd: np.ndarray, time: float):
        prior = np.asarray(prior_sd, float) ** 2
        self._correlation_time = time
        self._stop_start = float('nan')
        """Start of the last stop, which identifies it, s."""
        self.n_stops = 0
        """Number of stops."""
        self._before_stop = _BiasState(np.zeros(3), prior, prior, np.zeros(3))
        """Bias before the last stop."""
        self._latest = self._before_stop
        """Bias after the last measurement."""

    def predict(self, now: float) -> tuple[np.ndarray, np.ndarray]:
        """Return (bias, its variance) at `now`, s; rad/s and its square, each shape (3,)."""
        state = self._latest.after(now, self._correlation_time)
        return state.bias, state.variance

    def measure(self, start: float, now: float, *, rate: np.ndarray, variance: np.ndarray) -> None:
        """
        Process the mean of the corrected rate over a stop until now.

        As the stop grows, the longer mean replaces the shorter one.

        Parameters
        ----------
        start, now : float
            Start of the stop, which identifies it, and the end of the mean, s.
        rate : ndarray, shape (3,)
            Without any update, rad/s.
        variance : ndarray, shape (3,)
            Of that mean; the Earth's rate is added here.

        """
        if start != self._stop_start:
            self._stop_start = start
            self._before_stop = self._latest
            self.n_stops += 1
        rate_variance = variance + EARTH_RATE**2 / 3  # about axes that are unknown here
        predicted = self._before_stop.after(now, self._correlation_time)

        # The stationary variance is at least the mean square of the measured rates. The prediction
        # had a larger one too, before it was measured.
        square_sum = predicted.square_sum + rate**2
        weight = predicted.weight + 1
        stationary = np.maximum(self._before_stop.stationary, square_sum / weight)
        prior = predicted.variance + np.maximum(stationary - self._before_stop.stationary, 0)

        gain = prior / (prior + rate_variance)
        self._latest = _BiasState(
            bias=predicted.bias + gain * (rate - predicted.bias),
            variance=(1 - gain) * prior,
            stationary=stationary,
            square_sum=square_sum,
            weight=weight,
            at=now,
        )


@dataclass(frozen=True, eq=False)
class _BiasState:
    """Gauss-Markov process of the residual bias at one time, each array of shape (3,)."""

    bias: np.ndarray
    """Estimate, rad/s."""
    variance: np.ndarray
    """Variance of its error, (rad/s)^2."""
    stationary: np.ndarray
    """Variance without stops, (rad/s)^2."""
    square_sum: np.ndarray
    """Weighted sum of the squared rates of the stops, (rad/s)^2."""
    weight: float = 0.0
    """Sum of these weights, which decay with the age of a stop; 0: no stop yet."""
    at: float = 0.0
    """Time, s."""

    def after(self, now: float, time: float) -> '_BiasState':
        """Return the state predicted for `now`, with the correlation time, both in s."""
        phi = np.exp(-max(now - self.at, 0.0) / time) if self.weight else 0.0
        return _BiasState(
            bias=phi * self.bias,
            variance=phi**2 * self.variance + (1 - phi**2) * self.stationary,
            stationary=self.stationary,
            square_sum=phi * self.square_sum,
            weight=phi * self.weight,
            at=now,
        )


MAX_ERROR_SDS = 4.0
"""Standard deviations; three axes exceed it by chance once in five thousand calibrations."""
MIN_STOP_SECONDS = 2.0
"""Shortest stop that is tested, s."""
HARM_RATIO = 1.5
"""
Times the error without calibration, from which a calibration does harm rather than too little.
"""


class HealthWord(StrEnum):
    """Whether a calibration still holds."""

    WAITING = 'waiting'
    """The robot has not stopped yet."""
    HOLDS = 'holds'
    MOVED = 'moved'
    """Something has moved by more than its standard deviation allows."""
    FOLLOWED = 'followed'
    """The bias of the gyroscope has moved, and an update corrects it."""
    HARMS = 'harms'
    """At rest, readings are farther from the truth with the calibration than without."""
    UNIT = 'unit'
    """The specific force at rest is that of another unit."""


WAITING, HOLDS, MOVED, FOLLOWED, HARMS, UNIT = HealthWord


@dataclass(frozen=True)
class HealthOptions:
    """Site of the robot, and permitted corrections."""

    gravity: float = 0.0
    """Local gravity, m/s^2; 0: that of the calibration, within the variation between sites."""
    update: bool = False
    """Whether the bias of the gyroscope follows the stops."""
    bias_time: float = 600.0
    """Seconds in which an update loses its meaning."""


@dataclass(frozen=True, eq=False)
class _JudgedStop:
    """A stop with the quantities of its evaluation."""

    stop: Stop
    """The stop."""
    mean_variance: np.ndarray
    """Variance of its mean (force, rate), shape (6,)."""
    n_stops: int
    """Number of stops up to this one."""
    bias_update: tuple[np.ndarray, np.ndarray] | None
    """Residual bias of the gyroscope and its variance, each shape (3,); None without an update."""


@dataclass(frozen=True, eq=False)
class _RestErrors:
    """Errors of corrected readings at a stop."""

    rate: np.ndarray
    """Mean of the rate, rad/s, shape (3,)."""
    rate_off: np.ndarray
    """Excess of each component over the Earth's rate, in standard deviations, shape (3,)."""
    force_length: float
    """Length of the mean specific force, m/s^2."""
    gravity_error: float
    """Difference of this length from gravity, m/s^2."""
    gravity_sd: float
    """Standard deviation of the length, m/s^2."""
    force_off: float
    """Excess of the difference over that between sites, in standard deviations."""


class CalibrationHealth:
    """
    Judges stops of a stream of corrected readings.

    Parameters
    ----------
    calibration : Calibration
    transfer : Transfer, optional
        Frame of the corrected readings.
    options : HealthOptions

    """

    def __init__(
        self, calibration: FittedErrors, transfer: Transfer | None, options: HealthOptions
    ):
        self.options = options
        self.n_stops = 0
        """Number of stops that were judged."""

        # White noise in the axes of the output: variances are rotated with squared cosines. The
        # drift of a bias is as likely in each direction.
        mat_ts = np.eye(3) if transfer is None else transfer.mat_ts
        noise_sds = []
        drift_variances = []
        for sensor in SENSORS:
            white_sd, bias_sd = calibration.noise(sensor)
            noise_sds.append(np.sqrt(mat_ts**2 @ np.square(white_sd)))
            drift_variances += [float(np.max(bias_sd)) ** 2] * 3
        self.noise_sd = np.concatenate(noise_sds)
        parameter_covariance = Uncertainty(calibration, transfer).at().parameters
        self._known_covariance = parameter_covariance + np.diag(drift_variances)
        """Covariance of corrected (force, rate) at rest from parameters and drift, shape (6, 6)."""

        # Gravity at the place of calibration differs from that here; a given gravity is known to a
        # tenth of the difference between places.
        stated = options.gravity or calibration.conditions.get('gravity')
        self._gravity = float(stated or STANDARD_GRAVITY)
        self._gravity_site_share = (
            0.1 * GRAVITY_PLACE_SHARE if options.gravity else GRAVITY_PLACE_SHARE
        )

        self.update = None
        if options.update:
            bias_sd = np.sqrt(np.diag(self._known_covariance)[3:])
            self.update = GyroBiasUpdate(bias_sd, options.bias_time)
        self._start_of_judged: float | None = None
        """Start of the last judged stop, which identifies it, s."""
        self._last: _JudgedStop | None = None
        """The last judged stop; replaced as one object, so that another thread may read it."""

    def judge(self, stop: Stop) -> None:
        """
        Process a growing stop.

        Parameters
        ----------
        stop : Stop
            Of corrected readings without any update; its `further_mean` is that of the measured
            specific force and rate.

        """
        if stop.seconds < MIN_STOP_SECONDS or np.linalg.norm(stop.mean[3:]) > MOST_MOVED:
            return  # too short, or a slow and steady turn
        if self._start_of_judged != stop.start:
            self._start_of_judged = stop.start
            self.n_stops += 1
        # A mean with a trend is not rest: motion that decays is an error of the mean of about its
        # change.
        sample_sd = np.maximum(stop.shake_sd, self.noise_sd)
        mean_variance = sample_sd**2 / stop.n_samples + (2 * stop.change) ** 2
        bias_update = None
        if self.update is not None:
            rate_variance = mean_variance[3:]
            self.update.measure(stop.start, stop.end, rate=stop.mean[3:], variance=rate_variance)
            bias_update = self.update.predict(stop.end)
        self._last = _JudgedStop(stop, mean_variance, self.n_stops, bias_update)

    @property
    def state(self) -> LiveState:
        """Result of the last stop, computed on request."""
        if self._last is None:
            return LiveState(WAITING, 'no stop of two seconds yet')
        return self._evaluated(self._last)

    def _evaluated(self, judged: _JudgedStop) -> LiveState:
        """Return the state after a stop, from the errors of rate and gravity at rest."""
        errors = self._errors_at(judged)
        values = self._values(judged, errors)

        # Readings in another unit have no other state.
        measured_length = float(np.linalg.norm(judged.stop.further_mean[:3]))
        unit = unit_of_rest(measured_length)
        if unit:
            return LiveState(
                UNIT,
                f'the measured specific force at rest is {measured_length:.4g}: the unit is {unit},'
                ' it must be m/s^2; correct the driver',
                values,
            )

        # Changes since the calibration, and the bias that would correct them.
        if judged.bias_update is not None:
            bias, variance = judged.bias_update
            values |= {
                'bias update [deg/s]': ', '.join(f'{value / DEG:+.4f}' for value in bias),
                'bias update, sd [deg/s]': ', '.join(
                    f'{value / DEG:.4f}' for value in np.sqrt(variance)
                ),
            }
        changes = '; '.join(self._changes(errors))
        if not changes:
            off = f'{errors.rate_off.max():.1f} and {errors.force_off:.1f} sd'
            return LiveState(
                HOLDS,
                f'the calibration holds: at the last stop rate and gravity were off by {off}',
                values,
            )
        if self._is_harmful(errors, judged.stop):
            return LiveState(
                HARMS,
                changes + ': without the calibration it would be less; is it the right one?'
                ' calibrate again',
                values,
            )
        if judged.bias_update is not None and errors.force_off <= MAX_ERROR_SDS:
            return LiveState(FOLLOWED, changes + ': corrected as long as stops confirm it', values)
        return LiveState(
            MOVED,
            changes + ': calibrate again, unless it turned slowly and steadily there',
            values,
        )

    def _errors_at(self, judged: _JudgedStop) -> _RestErrors:
        """
        Return the errors of corrected rate and gravity at a stop.

        They are counted in standard deviations, beyond the Earth's rate and the local differences
        of gravity::

            rate_off  = max(|w| - Earth's rate, 0) / sd(w)             each axis
            force_off = max(||f| - g| - local differences, 0) / sd(|f|)
        """
        covariance = self._known_covariance + np.diag(judged.mean_variance)
        force = judged.stop.mean[:3]
        rate = judged.stop.mean[3:]
        rate_excess = np.maximum(np.abs(rate) - EARTH_RATE, 0)
        length = float(np.linalg.norm(force))
        vertical = force / max(np.linalg.norm(force), 1e-9)
        gravity_sd = float(np.sqrt(vertical @ covariance[:3, :3] @ vertical))
        gravity_error = abs(length - self._gravity)
        gravity_excess = max(gravity_error - self._gravity_site_share * self._gravity, 0)
        return _RestErrors(
            rate=rate,
            rate_off=rate_excess / np.sqrt(np.diag(covariance)[3:]),
            force_length=length,
            gravity_error=gravity_error,
            gravity_sd=gravity_sd,
            force_off=gravity_excess / gravity_sd,
        )

    def _values(self, judged: _JudgedStop, errors: _RestErrors) -> dict[str, Any]:
        """Return the figures of a stop by name."""
        return {
            'stops': judged.n_stops,
            'seconds of the last stop': f'{judged.stop.seconds:.1f}',
            'rate at rest [deg/s]': ', '.join(f'{value / DEG:+.4f}' for value in errors.rate),
            'rate at rest [sd]': f'{errors.rate_off.max():.1f}',
            'gravity read [m/s^2]': f'{errors.force_length:.4f}',
            'gravity expected [m/s^2]': f'{self._gravity:.4f}',
            'gravity off [sd]': f'{errors.force_off:.1f}',
        }

    def _changes(self, errors: _RestErrors) -> list[str]:
        """Return a line on each sensor that has changed significantly since the calibration."""
        lines = []
        axis = int(np.argmax(errors.rate_off))
        if errors.rate_off[axis] > MAX_ERROR_SDS:
            lines.append(
                f'the bias of the gyroscope has moved by {errors.rate[axis] / DEG:+.3g} deg/s about'
                f' {"xyz"[axis]}, {errors.rate_off[axis]:.0f} times its sd'
            )
        if errors.force_off > MAX_ERROR_SDS:
            lines.append(
                f'gravity reads {errors.force_length:.3f} m/s^2 instead of {self._gravity:.3f},'
                f' {errors.force_off:.0f} times its sd beyond what places differ by'
            )
        return lines

    def _is_harmful(self, errors: _RestErrors, stop: Stop) -> bool:
        """Return whether a significant error would be clearly smaller without the calibration."""
        measured_rate = float(np.linalg.norm(stop.further_mean[3:6]))
        rate_is_worse = np.linalg.norm(errors.rate) > HARM_RATIO * measured_rate
        if errors.rate_off.max() > MAX_ERROR_SDS and rate_is_worse:
            return True
        measured_error = abs(float(np.linalg.norm(stop.further_mean[:3])) - self._gravity)
        harmful_error = HARM_RATIO * measured_error + MAX_ERROR_SDS * errors.gravity_sd
        return errors.force_off > MAX_ERROR_SDS and errors.gravity_error > harmful_error


SIX = tuple[float, ...]
STOP_COLUMNS = [0, 4, 5, 6, 1, 2, 3, 10, 11, 12, 7, 8, 9]
"""
Columns of a sample for the detection of stops: time, force, rate, measured force, measured rate.
"""


class StopWatch:
    """
    Follows a `CalibrationHealth` sample by sample; between two evaluations it costs an append.

    Parameters
    ----------
    health : CalibrationHealth

    """

    def __init__(self, health: CalibrationHealth):
        self.health = health
        self._detector = StopDetector(health.noise_sd)
        self._samples: list[SIX] = []
        """Samples since the last evaluation: ns since `_first_ns`, corrected, measured."""
        self._first_ns = 0
        """Stamp of the first sample; 0 before it."""
        self._next_ns = 0
        """Time of the next evaluation, ns since `_first_ns`."""
        self._bias: tuple[float, float, float] | None = None
        """Bias of the corrected rate at the last evaluation, rad/s; None without an update."""

    def follow(self, stamp_ns: int, measured: SIX, corrected: SIX) -> SIX:
        """
        Process a sample (rate x, y, z, force x, y, z; measured and corrected).

        Return the corrected one minus the bias update.
        """
        since_ns = stamp_ns - self._first_ns
        self._samples.append((since_ns, *corrected, *measured))
        if since_ns >= self._next_ns or since_ns < 0:
            self._evaluate(stamp_ns)
        if self._bias is None:
            return corrected
        bx, by, bz = self._bias
        return (corrected[0] - bx, corrected[1] - by, corrected[2] - bz, *corrected[3:])

    @property
    def rate_cov(self) -> np.ndarray:
        """Covariance of the bias update that is subtracted from the rate, shape (3, 3)."""
        if self._bias is None or self.health.update is None:
            return np.zeros((3, 3))
        _, variance = self.health.update.predict(self._next_ns * 1e-9)
        return np.diag(variance)

    def _evaluate(self, stamp_ns: int) -> None:
        """Judge the stop at the end of the stored samples, or start again without them."""
        if stamp_ns < self._first_ns or not self._first_ns:  # the beginning, or a clock set back
            self._first_ns = stamp_ns
            self._next_ns = 0
            self._samples = []
            self._detector = StopDetector(self.health.noise_sd)
            return
        samples = np.array(self._samples)
        since_ns = int(samples[-1, 0])
        self._samples = []
        self._next_ns = since_ns + round(1e9 * HEALTH_BLOCK_SECONDS)
        rows = samples[:, STOP_COLUMNS]
        rows[:, 0] *= 1e-9
        stop = self._detector.push(rows)
        if stop is not None:
            self.health.judge(stop)
        if self.health.update is not None and self.health.update.n_stops:
            bias, _ = self.health.update.predict(since_ns * 1e-9)
            bx, by, bz = bias.tolist()
            self._bias = (bx, by, bz)
