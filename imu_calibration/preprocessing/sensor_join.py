"""Accelerometer and gyroscope with stamps of their own, joined to one stream."""

from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples
from imu_calibration.kinematics.rotations import skew, unit_rows

MAX_GAP_PERIODS = 5.0
"""Between readings farther apart than this many periods nothing is interpolated."""
MIN_OVERLAP_SAMPLES = 100
"""Joined samples, at least."""
MAX_DELAY = 0.25
"""s; delays that are searched first."""
WIDE_DELAY = 3.0
"""s; delays that are searched where a smaller one does not explain the rotation of gravity."""
WIDE_STEP = 0.05
"""s; distance of these delays."""
MIN_PREDICTED = 0.8
"""
Share of the rotation of gravity in each part that the rates predict with A and b of the other
parts, at a delay beyond `MAX_DELAY`: among many delays one may fit a few turns by chance.
"""
DELAY_STEP = 0.01
"""s; distance of the delays among which the search begins: short against turns by hand."""
FINE_DELAY_STEP = 0.001
"""s; distance of the delays near the best one; the residual is a parabola between them."""
MIN_EIGENVALUE = 1e-10
"""Of normal equations with a diagonal of ones: a smaller one is an undetermined direction."""
DELAY_WINDOW = 0.1
"""s; rotation of gravity and integral of the rates are compared over this time."""
DELAY_PARTS = 8
"""Parts of the recording that are left out in turn, for the standard deviation of the delay."""
MOST_COMPARED_WINDOWS = 4000
"""Windows that are compared, at most."""
MIN_DELAY_ROTATION = 0.5
"""Sum of the rotation of gravity that a delay needs, rad."""
LARGE_DELAY = 0.01
"""s; smaller delays are not reported as a fault: accelerations in turns imitate some ms."""
LARGE_DELAY_SDS = 4.0
"""Standard deviations of a significant delay."""
MIN_EXPLAINED = 0.5
"""Share of the rotation of gravity that the rates explain, at least."""


@dataclass(frozen=True, eq=False)
class SensorStream:
    """Readings of one sensor."""

    stamp_ns: np.ndarray
    """Increasing, int64, shape (n,)."""
    values: np.ndarray
    """SI, shape (n, 3)."""

    @property
    def period_ns(self) -> float:
        """Median step between stamps, ns."""
        return float(np.median(np.diff(self.stamp_ns)))


@dataclass(frozen=True)
class GyroscopeDelay:
    """By how much the stamps of the gyroscope are late relative to those of the accelerometer."""

    delay: float
    """s; negative: early."""
    sd: float
    """Its standard deviation, s."""

    @property
    def text(self) -> str:
        """The delay with its standard deviation, in words."""
        side = 'late' if self.delay >= 0.0 else 'early'
        return f'{1e3 * abs(self.delay):.1f} ± {1e3 * self.sd:.1f} ms {side}'

    @property
    def is_large(self) -> bool:
        """Whether it is a fault: significant, and more than accelerations in turns imitate."""
        return abs(self.delay) > max(LARGE_DELAY, LARGE_DELAY_SDS * self.sd)

    def to_mapping(self) -> dict[str, float]:
        """Return delay and sd as plain data."""
        return {'delay': self.delay, 'sd': self.sd}


@dataclass(frozen=True, eq=False)
class JoinedSensors:
    """One stream of two sensors."""

    imu: ImuSamples
    """At the stamps of the slower sensor."""
    slower: str
    """Sensor whose stamps are kept."""
    delay: GyroscopeDelay | None
    """None where the motion does not determine it. It is not corrected."""

    @property
    def text(self) -> str:
        """The method and the delay in one line."""
        faster = 'gyroscope'
        if self.slower == faster:
            faster = 'accelerometer'
        line = f'the {faster} is interpolated linearly to the stamps of the {self.slower}'
        if self.delay is None:
            return f'{line}; their delay is not determined by the motion'
        return f'{line}; the gyroscope is {self.delay.text} (not corrected)'


@dataclass(frozen=True, eq=False)
class OtherSensor:
    """The faster one of two sensors, whose readings are added to the messages of the slower one."""

    quantity: str
    """'force' or 'rate'."""
    stream: SensorStream
    """All its readings."""
    frame_id: str
    """Frame of the accelerometer, in which both sensors are calibrated."""

    def known(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return at which stamps there is a reading to interpolate, bool, shape (n,)."""
        return interpolated(self.stream, stamp_ns)[1]

    def added_to(self, imu: ImuSamples) -> ImuSamples:
        """Return the samples with the readings of this sensor, NaN where there are none."""
        values, known = interpolated(self.stream, imu.stamp_ns)
        values[~known] = np.nan
        if self.quantity == 'force':
            return replace(imu, force_s=values, frame_id=self.frame_id)
        return replace(imu, rate_s=values, frame_id=self.frame_id)


def finite_stream(stamp_ns: np.ndarray, values: np.ndarray) -> SensorStream:
    """Return the finite readings with increasing stamps of one sensor."""
    known = np.isfinite(values).all(axis=1)
    stamp_ns = stamp_ns[known]
    values = values[known]
    newest = np.maximum.accumulate(stamp_ns)
    advances = np.append(True, stamp_ns[1:] > newest[:-1])[: len(stamp_ns)]
    return SensorStream(stamp_ns[advances], values[advances])


def join_sensors(
    accelerometer: SensorStream, gyroscope: SensorStream, frame_id: str = ''
) -> JoinedSensors:
    """
    Return both sensors at the stamps of the slower one.

    Parameters
    ----------
    accelerometer, gyroscope : SensorStream
    frame_id : str

    Raises
    ------
    InputError
        When the two hardly overlap in time.

    """
    n_least = min(len(accelerometer.stamp_ns), len(gyroscope.stamp_ns))
    slower, stamp_ns = 'gyroscope', gyroscope.stamp_ns
    if n_least >= 2 and accelerometer.period_ns >= gyroscope.period_ns:
        slower, stamp_ns = 'accelerometer', accelerometer.stamp_ns
    force, has_force = interpolated(accelerometer, stamp_ns)
    rate, has_rate = interpolated(gyroscope, stamp_ns)
    kept = has_force & has_rate
    if np.count_nonzero(kept) < MIN_OVERLAP_SAMPLES:
        raise InputError(
            'accelerometer and gyroscope must be recorded at the same time, by one clock, for at'
            f' least {MIN_OVERLAP_SAMPLES} samples, {np.count_nonzero(kept)} are common; give two'
            ' recordings of one session',
            code='no_overlap',
        )
    imu = ImuSamples(stamp_ns[kept], force[kept], rate[kept], frame_id)
    return JoinedSensors(imu, slower, gyroscope_delay(accelerometer, gyroscope))


def interpolated(stream: SensorStream, stamp_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (values at stamps, shape (n, 3); whether they are known, shape (n,)).

    Linear between neighbours; unknown outside of the stream and in its gaps.
    """
    n = len(stream.stamp_ns)
    if n < 2:
        return np.zeros((len(stamp_ns), 3)), np.zeros(len(stamp_ns), bool)
    after = np.searchsorted(stream.stamp_ns, stamp_ns)
    inside = (stamp_ns >= stream.stamp_ns[0]) & (stamp_ns <= stream.stamp_ns[-1])
    after = np.clip(after, 1, n - 1)
    first = stream.stamp_ns[after - 1]
    last = stream.stamp_ns[after]
    step = last - first
    share = ((stamp_ns - first) / step)[:, None]
    values = (1.0 - share) * stream.values[after - 1] + share * stream.values[after]
    known = inside & ((step <= MAX_GAP_PERIODS * stream.period_ns) | (stamp_ns == last))
    return values, known


def delay_of(imu: ImuSamples) -> GyroscopeDelay | None:
    """Return the delay of the gyroscope in one stream of both sensors; None if unknown."""
    if imu.absent:
        return None
    return gyroscope_delay(
        finite_stream(imu.stamp_ns, imu.force_s), finite_stream(imu.stamp_ns, imu.rate_s)
    )


def gyroscope_delay(accelerometer: SensorStream, gyroscope: SensorStream) -> GyroscopeDelay | None:
    """
    Return the delay of the gyroscope's stamps; None where the motion does not determine it.

    With the direction u of the specific force and the integral theta of the rates over a window,
    shifted by the delay d::

        u(t + w) - u(t) = u(t + w / 2) x (A (theta(t + w + d) - theta(t + d)) + b w)

    A (3 x 3) and b are fitted for each d, so that neither units nor axes nor biases matter; d has
    the least squared residual.
    """
    windows = _windows(accelerometer)
    if windows is None:
        return None
    start, stop, middle, change = windows
    if np.linalg.norm(change, axis=1).sum() < MIN_DELAY_ROTATION:
        return None
    delay = _found_delay(gyroscope, accelerometer.stamp_ns[0], windows, MAX_DELAY)
    if delay is None:
        delay = _found_delay(gyroscope, accelerometer.stamp_ns[0], windows, WIDE_DELAY)
    return delay


def _found_delay(gyroscope, origin_ns, windows, reach):
    """Return the GyroscopeDelay up to `reach` s that explains the rotation of gravity, or None."""
    start, stop, middle, change = windows
    time = (gyroscope.stamp_ns - origin_ns) * 1e-9
    inside = (start > time[0] + reach) & (stop < time[-1] - reach)
    if np.count_nonzero(inside) < 20 * DELAY_PARTS:
        return None
    # Windows in which gravity rotates most determine the delay.
    rotation = np.where(inside, np.linalg.norm(change, axis=1), 0.0)
    most = np.sort(np.argsort(rotation)[-MOST_COMPARED_WINDOWS:])
    used = most[rotation[most] > 0.0]
    cost = _DelayCost(
        gyroscope,
        time,
        start=start[used],
        stop=stop[used],
        middle=middle[used],
        change=change[used],
    )

    # The least residual, first among widely spaced delays, then near the best of them.
    near, around = 0.0, reach
    steps = [DELAY_STEP]
    if reach > MAX_DELAY:
        steps = [WIDE_STEP, DELAY_STEP]
    for step in steps:
        coarse = near + np.arange(-around, around + step / 2, step)
        near = coarse[int(np.argmin([cost.residual(delay) for delay in coarse]))]
        around = step
    fine = near + np.arange(-DELAY_STEP, DELAY_STEP + FINE_DELAY_STEP / 2, FINE_DELAY_STEP)
    residuals = np.array([cost.without_each_part(delay) for delay in fine])
    total = float(np.sum(change[used] ** 2))
    if residuals[:, 0].min() > (1.0 - MIN_EXPLAINED) * total:
        return None
    if reach > MAX_DELAY and cost.prediction_error(near) > (1.0 - MIN_PREDICTED) * total:
        return None
    delay = _least_place(fine, residuals[:, 0])
    if abs(delay) > reach - steps[0]:
        return None

    # Jackknife over parts of the recording, because the residuals are correlated in time.
    without = np.array([_least_place(fine, left_out) for left_out in residuals[:, 1:].T])
    variance = (DELAY_PARTS - 1) / DELAY_PARTS * np.sum((without - without.mean()) ** 2)
    return GyroscopeDelay(delay, float(np.sqrt(variance)))


class _DelayCost:
    """
    Squared residuals of the windows for a delay, with A and b of `gyroscope_delay` fitted.

    A row of the fit is ``u x (A turned)``: linear in the 12 numbers of (A, b), with the products of
    `lever` = [u x] and `turned` as coefficients. The normal equations therefore need only the
    products of ``lever.T lever`` and ``turned turned.T``, summed over the windows of each part.
    """

    def __init__(
        self,
        gyroscope: SensorStream,
        time: np.ndarray,
        *,
        start: np.ndarray,
        stop: np.ndarray,
        middle: np.ndarray,
        change: np.ndarray,
    ):
        self._time = time
        self._start = start
        self._stop = stop
        steps = np.diff(time)[:, None] * 0.5 * (gyroscope.values[1:] + gyroscope.values[:-1])
        self._theta = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        lever = skew(middle)
        squared = np.einsum('nij,nik->njk', lever, lever).reshape(-1, 9)
        applied = np.einsum('nij,ni->nj', lever, change)
        # Sums over the parts are products with the windows of one part after another.
        first = np.arange(DELAY_PARTS + 1) * len(start) // DELAY_PARTS
        self._parts = [slice(a, b) for a, b in zip(first[:-1], first[1:], strict=True)]
        self._squared = [squared[part].T for part in self._parts]
        self._applied = [applied[part].T for part in self._parts]
        self._observed = np.array([np.sum(change[part] ** 2) for part in self._parts])

    def residual(self, delay: float) -> float:
        """Return the least sum of squares of all windows."""
        normal, applied, observed = (of_parts.sum(axis=0) for of_parts in self._equations(delay))
        return float(_least_squares_residual(normal, applied, observed))

    def without_each_part(self, delay: float) -> np.ndarray:
        """Return the least sums of squares of all windows, then without each part in turn."""
        normal, applied, observed = self._equations(delay)
        return _least_squares_residual(
            _all_and_without_each(normal),
            _all_and_without_each(applied),
            _all_and_without_each(observed),
        )

    def prediction_error(self, delay: float) -> float:
        """Return the sum of squares of each part with A and b of the other parts."""
        normal, applied, observed = self._equations(delay)
        fit = _least_squares(_all_and_without_each(normal)[1:], _all_and_without_each(applied)[1:])
        # |y - X x|^2 = y'y - 2 b'x + x'N x
        crossed = np.einsum('ki,ki->', fit, applied)
        return float(observed.sum() - 2.0 * crossed + np.einsum('ki,kij,kj->', fit, normal, fit))

    def _equations(self, delay: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (N, b, y'y) of the normal equations of each part, (k, 12, 12), (k, 12), (k,)."""
        turned = np.empty((len(self._start), 4))
        for axis in range(3):
            turned[:, axis] = np.interp(self._stop + delay, self._time, self._theta[:, axis])
            turned[:, axis] -= np.interp(self._start + delay, self._time, self._theta[:, axis])
        turned[:, 3] = self._stop - self._start
        products = (turned[:, :, None] * turned[:, None, :]).reshape(-1, 16)
        normal = np.empty((DELAY_PARTS, 12, 12))
        applied = np.empty((DELAY_PARTS, 12))
        for number, part in enumerate(self._parts):
            blocks = (self._squared[number] @ products[part]).reshape(3, 3, 4, 4)
            normal[number] = blocks.transpose(0, 2, 1, 3).reshape(12, 12)
            applied[number] = (self._applied[number] @ turned[part]).reshape(12)
        return normal, applied, self._observed


def _all_and_without_each(of_parts):
    """Return the sum over the parts, then without each part in turn, shape (k + 1, ...)."""
    total = of_parts.sum(axis=0)
    return np.concatenate([total[None], total - of_parts])


@dataclass(frozen=True, eq=False)
class _Directions:
    """Eigenvectors of normal equations ``N x = b`` in unknowns of equal size."""

    scale: np.ndarray
    """Square roots of the diagonal of N, shape (..., n)."""
    vectors: np.ndarray
    """Eigenvectors in the columns, shape (..., n, n)."""
    along: np.ndarray
    """Component of ``b / scale`` along each, shape (..., n)."""
    determined: np.ndarray
    """Whether the windows determine it."""
    values: np.ndarray
    """Its eigenvalue; 1 where it is not determined."""

    @classmethod
    def of(cls, normal: np.ndarray, applied: np.ndarray) -> '_Directions':
        """Return those of equations of shapes (..., n, n), (..., n)."""
        diagonal = np.diagonal(normal, axis1=-2, axis2=-1)
        scale = np.sqrt(np.maximum(diagonal, np.finfo(float).tiny))
        values, vectors = np.linalg.eigh(normal / (scale[..., :, None] * scale[..., None, :]))
        along = np.einsum('...ij,...i->...j', vectors, applied / scale)
        determined = values > MIN_EIGENVALUE
        return cls(scale, vectors, along, determined, np.where(determined, values, 1.0))


def _least_squares(normal, applied):
    """Return the solution of ``N x = b``, zero along what the windows do not determine."""
    found = _Directions.of(normal, applied)
    length = np.where(found.determined, found.along / found.values, 0.0)
    return np.einsum('...ij,...j->...i', found.vectors, length) / found.scale


def _least_squares_residual(normal, applied, observed):
    """
    Return ``y.T y - b.T N^-1 b`` of normal equations ``N x = b``, shapes (..., n, n), (..., n).

    Directions that the windows do not determine are left out.
    """
    found = _Directions.of(normal, applied)
    explained = np.where(found.determined, found.along**2 / found.values, 0.0)
    return observed - explained.sum(axis=-1)


def _least_place(places: np.ndarray, costs: np.ndarray) -> float:
    """Return the place of the least cost: the vertex of the parabola through its neighbours."""
    least = int(np.clip(np.argmin(costs), 1, len(costs) - 2))
    before, here, after = costs[least - 1 : least + 2]
    curvature = before - 2.0 * here + after
    if curvature <= 0.0:
        return float(places[int(np.argmin(costs))])
    step = places[least] - places[least - 1]
    return float(places[least] + np.clip(0.5 * (before - after) / curvature, -1.0, 1.0) * step)


def _windows(accelerometer):
    """Return (start, end, direction in the middle, change of the direction) of windows, or None."""
    if len(accelerometer.stamp_ns) < 20:
        return None
    time = (accelerometer.stamp_ns - accelerometer.stamp_ns[0]) * 1e-9
    half = max(int(round(0.5 * DELAY_WINDOW / (accelerometer.period_ns * 1e-9))), 1)
    length = np.linalg.norm(accelerometer.values, axis=1)
    usual = np.median(length)
    if not usual > 0.0 or len(time) < 4 * half:
        return None
    direction = unit_rows(np.where((length > 0.1 * usual)[:, None], accelerometer.values, 1.0))
    start = np.arange(0, len(time) - 2 * half, half)
    middle = half
    begin = start
    centre = start + middle
    end = start + 2 * half
    whole = time[end] - time[begin] < 2.0 * DELAY_WINDOW + 4e-9 * accelerometer.period_ns
    begin = begin[whole]
    centre = centre[whole]
    end = end[whole]
    return time[begin], time[end], direction[centre], direction[end] - direction[begin]
