"""Health of a compensated stream: bias at stops, range, temperature."""

from dataclasses import dataclass

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
    others: np.ndarray
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
        self._most_variance = (MOST_SHAKE + 4 * self._noise_sd) ** 2
        self._rest: np.ndarray = np.zeros((0, 1))
        self._blocks: list[np.ndarray] = []
        """
        Start, end, samples, means of the columns, variances of force and rate; shape (3 + 6 + k +
        6,) each.
        """
        self._stand: list[np.ndarray] = []
        self._stop: Stop | None = None

    def push(self, rows: np.ndarray) -> Stop | None:
        """
        Process samples; return the stop that continues at their end, or None while the IMU moves.

        Parameters
        ----------
        rows : ndarray, shape (n, 7 + k)
            Time in s, specific force, rate, and columns of which the means are wanted as well.

        """
        rows = np.concatenate([self._rest, rows]) if len(self._rest) else rows
        while len(rows) and rows[-1, 0] - rows[0, 0] >= HEALTH_BLOCK_SECONDS:
            n = max(int(np.searchsorted(rows[:, 0], rows[0, 0] + HEALTH_BLOCK_SECONDS)), 1)
            self._take(rows[:n])
            rows = rows[n:]
        self._rest = rows
        return self._stop

    def _take(self, rows):
        """Process one block, or restart after a gap."""
        if self._blocks and rows[0, 0] - self._blocks[-1][1] > HEALTH_BLOCK_SECONDS:
            self._blocks, self._stand = [], []
        block = np.concatenate(
            [
                [rows[0, 0], rows[-1, 0], len(rows)],
                rows[:, 1:].mean(axis=0),
                rows[:, 1:7].var(axis=0),
            ]
        )
        self._blocks = [*self._blocks[-N_BLOCKS + 1 :], block]
        if not self._may_be_still(block) or not self._is_still():
            self._stand = []
        elif self._stand and block[1] - self._stand[0][0] <= MAX_STOP_SECONDS:
            self._stand.append(block)
        else:
            self._stand = [block] if self._stand else list(self._blocks)
        self._stop = _stop_of(np.array(self._stand)) if self._stand else None

    def _may_be_still(self, block):
        """
        Return whether a block turns and shakes little enough by itself.

        Most blocks of a robot that drives do not.
        """
        return block[6:9] @ block[6:9] < MOST_RATE**2 and bool(
            (block[-6:] <= self._most_variance).all()
        )

    def _is_still(self):
        if len(self._blocks) < N_BLOCKS:
            return False
        blocks = np.array(self._blocks)
        variance = blocks[:, -6:].max(axis=0)
        # Vibration of the robot is noise for the means as well.
        allowed = MAX_BLOCK_CHANGE + TIMES_NOISE * np.maximum(
            self._noise_sd, np.sqrt(variance)
        ) / np.sqrt(blocks[:, 2].min())
        return bool(
            (np.ptp(blocks[:, 3:9], axis=0) <= allowed).all()
            and (variance <= self._most_variance).all()
        )


def _stop_of(stand):
    """Return the `Stop` of the blocks of a rest, shape (n, 3 + 6 + k + 6)."""
    half = len(stand) // 2
    early, late = (
        np.average(part[:, 3:], axis=0, weights=part[:, 2])
        for part in (stand[: half or None], stand[half:])
    )
    return Stop(
        float(stand[0, 0]),
        float(stand[-1, 1]),
        int(stand[half:, 2].sum()),
        late[:6],
        late[6:-6],
        np.sqrt(late[-6:]),
        (late - early)[:6],
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
        self._time = time
        self._stop = float('nan')
        self.n_stops = 0
        self._now = self._before = _State(np.zeros(3), prior, prior, np.zeros(3))

    def predict(self, now: float) -> tuple[np.ndarray, np.ndarray]:
        """Return (bias, its variance) at `now`, s; rad/s and its square, each shape (3,)."""
        return self._now.after(now, self._time)[:2]

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
        if start != self._stop:
            self._stop, self._before, self.n_stops = start, self._now, self.n_stops + 1
        variance = variance + EARTH_RATE**2 / 3  # about axes that are unknown here
        bias, spread, seen, weight = self._before.after(now, self._time)
        seen = seen + rate**2
        weight = weight + 1
        stationary = np.maximum(self._before.stationary, seen / weight)
        # It has been as wide before anybody saw it.
        spread = spread + np.maximum(stationary - self._before.stationary, 0)
        gain = spread / (spread + variance)
        self._now = _State(
            bias + gain * (rate - bias), (1 - gain) * spread, stationary, seen, weight, now
        )


@dataclass(frozen=True, eq=False)
class _State:
    bias: np.ndarray
    variance: np.ndarray
    stationary: np.ndarray
    """Variance without stops."""
    seen: np.ndarray
    """Sum of squares of the updates, with decreasing weight of older stops."""
    weight: float = 0.0
    at: float = 0.0

    def after(self, now, time):
        """Return (bias, variance, seen, weight) at `now`."""
        phi = np.exp(-max(now - self.at, 0.0) / time) if self.weight else 0.0
        return (
            phi * self.bias,
            phi**2 * self.variance + (1 - phi**2) * self.stationary,
            phi * self.seen,
            phi * self.weight,
        )


LIMIT = 4.0
"""Standard deviations; three axes exceed it by chance once in five thousand calibrations."""
MIN_STOP_SECONDS = 2.0
"""Shortest stop that is tested, s."""
WORSE = 1.5
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
        of_parameters = Uncertainty(calibration, transfer).at().parameters
        self._known = of_parameters + np.diag(drift_variances)

        # Gravity at the place of calibration differs from that here, unless it is given.
        stated = options.gravity or calibration.conditions.get('gravity')
        self._gravity = float(stated or STANDARD_GRAVITY)
        self._place = 0.1 * GRAVITY_PLACE_SHARE if options.gravity else GRAVITY_PLACE_SHARE

        self.update = None
        if options.update:
            bias_sd = np.sqrt(np.diag(self._known)[3:])
            self.update = GyroBiasUpdate(bias_sd, options.bias_time)
        self._judged: float | None = None
        self._last: tuple | None = None
        """Arguments of `_evaluated`; replaced as a whole, so that another thread may read it."""

    def judge(self, stop: Stop) -> None:
        """
        Process a growing stop.

        Parameters
        ----------
        stop : Stop
            Of corrected readings without any update; its `others` are the measured specific force
            and rate.

        """
        if stop.seconds < MIN_STOP_SECONDS or np.linalg.norm(stop.mean[3:]) > MOST_MOVED:
            return  # too short, or a slow and steady turn
        if self._judged != stop.start:
            self._judged, self.n_stops = stop.start, self.n_stops + 1
        # A mean with a trend is not rest: motion that decays is an error of the mean of about its
        # change.
        of_mean = (
            np.maximum(stop.shake_sd, self.noise_sd) ** 2 / stop.n_samples + (2 * stop.change) ** 2
        )
        if self.update is not None:
            self.update.measure(stop.start, stop.end, rate=stop.mean[3:], variance=of_mean[3:])
        self._last = (
            stop,
            of_mean,
            self.n_stops,
            None if self.update is None else self.update.predict(stop.end),
        )

    @property
    def state(self) -> LiveState:
        """Result of the last stop, computed on request."""
        return (
            LiveState(WAITING, 'no stop of two seconds yet')
            if self._last is None
            else self._evaluated(*self._last)
        )

    def _evaluated(self, stop, of_mean, n_stops, bias_update):
        """
        Return the state after a stop.

        From the variance of its mean, (6,), and the corrected bias with its variance, or None.
        """
        # Rate and gravity at rest, in standard deviations beyond the Earth's rate and the local
        # differences of gravity.
        total = self._known + np.diag(of_mean)
        along = stop.mean[:3] / max(np.linalg.norm(stop.mean[:3]), 1e-9)
        rate_off = np.maximum(np.abs(stop.mean[3:]) - EARTH_RATE, 0) / np.sqrt(np.diag(total)[3:])
        gravity_sd = float(np.sqrt(along @ total[:3, :3] @ along))
        rate = stop.mean[3:]
        length = float(np.linalg.norm(stop.mean[:3]))
        force_off = max(abs(length - self._gravity) - self._place * self._gravity, 0) / gravity_sd
        axis = int(np.argmax(rate_off))
        values = {
            'stops': n_stops,
            'seconds of the last stop': f'{stop.seconds:.1f}',
            'rate at rest [deg/s]': ', '.join(f'{value / DEG:+.4f}' for value in rate),
            'rate at rest [sd]': f'{rate_off.max():.1f}',
            'gravity read [m/s^2]': f'{length:.4f}',
            'gravity expected [m/s^2]': f'{self._gravity:.4f}',
            'gravity off [sd]': f'{force_off:.1f}',
        }
        measured_length, measured_rate = (
            float(np.linalg.norm(stop.others[part])) for part in (slice(3), slice(3, 6))
        )

        # Readings in another unit have no other state.
        unit = unit_of_rest(measured_length)
        if unit:
            return LiveState(
                UNIT,
                f'the measured specific force at rest is {measured_length:.4g}: the unit is {unit},'
                ' it must be m/s^2; correct the driver',
                values,
            )

        # Changes since the calibration, and the bias that would correct them.
        lines = []
        if rate_off[axis] > LIMIT:
            lines.append(
                f'the bias of the gyroscope has moved by {rate[axis] / DEG:+.3g} deg/s about'
                f' {"xyz"[axis]}, {rate_off[axis]:.0f} times its sd'
            )
        if force_off > LIMIT:
            lines.append(
                f'gravity reads {length:.3f} m/s^2 instead of {self._gravity:.3f}, {force_off:.0f}'
                ' times its sd beyond what places differ by'
            )
        if bias_update is not None:
            bias, variance = bias_update
            values |= {
                'bias update [deg/s]': ', '.join(f'{value / DEG:+.4f}' for value in bias),
                'bias update, sd [deg/s]': ', '.join(
                    f'{value / DEG:.4f}' for value in np.sqrt(variance)
                ),
            }
        if not lines:
            off = f'{rate_off.max():.1f} and {force_off:.1f} sd'
            return LiveState(
                HOLDS,
                f'the calibration holds: at the last stop rate and gravity were off by {off}',
                values,
            )
        harms = (rate_off[axis] > LIMIT and np.linalg.norm(rate) > WORSE * measured_rate) or (
            force_off > LIMIT
            and abs(length - self._gravity)
            > WORSE * abs(measured_length - self._gravity) + LIMIT * gravity_sd
        )
        if harms:
            return LiveState(
                HARMS,
                '; '.join(lines)
                + ': without the calibration it would be less; is it the right one? calibrate'
                ' again',
                values,
            )
        if bias_update is not None and force_off <= LIMIT:
            return LiveState(
                FOLLOWED, '; '.join(lines) + ': corrected as long as stops confirm it', values
            )
        return LiveState(
            MOVED,
            '; '.join(lines) + ': calibrate again, unless it turned slowly and steadily there',
            values,
        )


SIX = tuple[float, ...]
AS_STOPS = [0, 4, 5, 6, 1, 2, 3, 10, 11, 12, 7, 8, 9]
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
        self._waiting: list[SIX] = []
        self._first_ns = self._look = 0
        self._offset: tuple[float, float, float] | None = None

    def follow(self, stamp_ns: int, measured: SIX, corrected: SIX) -> SIX:
        """
        Process a sample (rate x, y, z, force x, y, z; measured and corrected).

        Return the corrected one minus the bias update.
        """
        since = stamp_ns - self._first_ns
        self._waiting.append((since, *corrected, *measured))
        if since >= self._look or since < 0:
            self._take(stamp_ns)
        if self._offset is None:
            return corrected
        bx, by, bz = self._offset
        return (corrected[0] - bx, corrected[1] - by, corrected[2] - bz, *corrected[3:])

    @property
    def rate_cov(self) -> np.ndarray:
        """Covariance of the correction of the rate, shape (3, 3)."""
        if self._offset is None or self.health.update is None:
            return np.zeros((3, 3))
        return np.diag(self.health.update.predict(self._look * 1e-9)[1])

    def _take(self, stamp_ns):
        if stamp_ns < self._first_ns or not self._first_ns:  # the beginning, or a clock set back
            self._first_ns, self._look, self._waiting, self._detector = (
                stamp_ns,
                0,
                [],
                StopDetector(self.health.noise_sd),
            )
            return
        samples = np.array(self._waiting)
        since = int(samples[-1, 0])
        self._waiting, self._look = [], since + round(1e9 * HEALTH_BLOCK_SECONDS)
        rows = samples[:, AS_STOPS]
        rows[:, 0] *= 1e-9
        stop = self._detector.push(rows)
        if stop is not None:
            self.health.judge(stop)
        if self.health.update is not None and self.health.update.n_stops:
            self._offset = tuple(self.health.update.predict(since * 1e-9)[0].tolist())
