"""Accelerometer and gyroscope with stamps of their own, joined to one stream."""

from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import AlignedArrays, ImuSamples
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
class SensorStream(AlignedArrays):
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
        faster = 'accelerometer' if self.slower == 'gyroscope' else 'gyroscope'
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
        """Return whether the readings can be interpolated to each stamp, bool, shape (n,)."""
        return interpolated(self.stream, stamp_ns)[1]

    def added_to(self, imu: ImuSamples) -> ImuSamples:
        """Return the samples with the readings of this sensor, NaN where there are none."""
        values, known = interpolated(self.stream, imu.stamp_ns)
        values[~known] = np.nan
        if self.quantity == 'force':
            return replace(imu, force_s=values, frame_id=self.frame_id)
        return replace(imu, rate_s=values, frame_id=self.frame_id)


def finite_stream(stamp_ns: np.ndarray, values: np.ndarray) -> SensorStream:
    """Return the finite readings of one sensor whose stamps exceed all stamps before."""
    readings = SensorStream(stamp_ns, values)
    is_finite = np.isfinite(values).all(axis=1)
    # A long recording is not copied where all of it is used.
    if not is_finite.all():
        readings = readings.select(is_finite)
    newest = np.maximum.accumulate(readings.stamp_ns)
    advances = np.append(True, readings.stamp_ns[1:] > newest[:-1])[: len(readings)]
    return readings if advances.all() else readings.select(advances)


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
    n_fewer = min(len(accelerometer.stamp_ns), len(gyroscope.stamp_ns))
    slower, stamp_ns = 'gyroscope', gyroscope.stamp_ns
    if n_fewer >= 2 and accelerometer.period_ns >= gyroscope.period_ns:
        slower, stamp_ns = 'accelerometer', accelerometer.stamp_ns
    force, has_force = interpolated(accelerometer, stamp_ns)
    rate, has_rate = interpolated(gyroscope, stamp_ns)
    has_both = has_force & has_rate
    n_common = np.count_nonzero(has_both)
    if n_common < MIN_OVERLAP_SAMPLES:
        raise InputError(
            'accelerometer and gyroscope must be recorded at the same time, by one clock, for at'
            f' least {MIN_OVERLAP_SAMPLES} samples, {n_common} are common; give two'
            ' recordings of one session',
            code='no_overlap',
        )
    imu = ImuSamples(stamp_ns[has_both], force[has_both], rate[has_both], frame_id)
    return JoinedSensors(imu, slower, gyroscope_delay(accelerometer, gyroscope))


def interpolated(stream: SensorStream, stamp_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (values at stamps, shape (n, 3); whether they are known, shape (n,)).

    Linear between neighbours; unknown outside of the stream and in its gaps.
    """
    n = len(stream.stamp_ns)
    if n < 2:
        return np.zeros((len(stamp_ns), 3)), np.zeros(len(stamp_ns), bool)
    # Readings after - 1 and after are the neighbours of a stamp.
    after = np.searchsorted(stream.stamp_ns, stamp_ns)
    inside = (stamp_ns >= stream.stamp_ns[0]) & (stamp_ns <= stream.stamp_ns[-1])
    after = np.clip(after, 1, n - 1)
    before_ns = stream.stamp_ns[after - 1]
    after_ns = stream.stamp_ns[after]
    step_ns = after_ns - before_ns
    share = ((stamp_ns - before_ns) / step_ns)[:, None]
    values = (1.0 - share) * stream.values[after - 1] + share * stream.values[after]
    not_in_gap = (step_ns <= MAX_GAP_PERIODS * stream.period_ns) | (stamp_ns == after_ns)
    return values, inside & not_in_gap


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
    windows = _gravity_windows(accelerometer)
    if windows is None or windows.rotation.sum() < MIN_DELAY_ROTATION:
        return None
    delay = _delay_within(gyroscope, accelerometer.stamp_ns[0], windows, MAX_DELAY)
    if delay is None:
        delay = _delay_within(gyroscope, accelerometer.stamp_ns[0], windows, WIDE_DELAY)
    return delay


@dataclass(frozen=True, eq=False)
class _GravityWindows(AlignedArrays):
    """Rotation of the direction u of the specific force in short windows."""

    start: np.ndarray
    """Time since the first reading of the accelerometer, s, shape (n,)."""
    stop: np.ndarray
    """s, shape (n,)."""
    middle: np.ndarray
    """u in the middle of the window, shape (n, 3)."""
    change: np.ndarray
    """u at its end minus u at its start, shape (n, 3)."""

    @property
    def rotation(self) -> np.ndarray:
        """Rotation of gravity, rad (small angles), shape (n,)."""
        return np.linalg.norm(self.change, axis=1)


def _gravity_windows(accelerometer: SensorStream) -> _GravityWindows | None:
    """Return windows of `DELAY_WINDOW` s, half overlapping, without gaps; None if too short."""
    if len(accelerometer.stamp_ns) < 20:
        return None
    time = (accelerometer.stamp_ns - accelerometer.stamp_ns[0]) * 1e-9
    half = max(int(round(0.5 * DELAY_WINDOW / (accelerometer.period_ns * 1e-9))), 1)
    median_length = np.median(np.linalg.norm(accelerometer.values, axis=1))
    if not median_length > 0.0 or len(time) < 4 * half:
        return None
    start = np.arange(0, len(time) - 2 * half, half)
    # Without a gap: of a slow sensor a window has two periods, which may be jittered.
    longest = 2.0 * DELAY_WINDOW + 4e-9 * accelerometer.period_ns
    start = start[time[start + 2 * half] - time[start] < longest]
    stop = start + 2 * half
    force = accelerometer.values
    least_length = 0.1 * median_length
    return _GravityWindows(
        start=time[start],
        stop=time[stop],
        middle=_directions(force[start + half], least_length),
        change=_directions(force[stop], least_length) - _directions(force[start], least_length),
    )


def _directions(force: np.ndarray, least_length: float) -> np.ndarray:
    """
    Return the unit vectors of specific forces, shape (n, 3).

    A force near zero has no direction: that of (1, 1, 1) stands for those up to `least_length`.
    """
    has_direction = np.linalg.norm(force, axis=1) > least_length
    return unit_rows(np.where(has_direction[:, None], force, 1.0))


def _delay_within(
    gyroscope: SensorStream, origin_ns: int, windows: _GravityWindows, reach: float
) -> GyroscopeDelay | None:
    """
    Return the delay up to `reach` s whose fit explains the rotation of gravity, or None.

    Times of the windows count from the stamp `origin_ns`.
    """
    time = (gyroscope.stamp_ns - origin_ns) * 1e-9
    inside = (windows.start > time[0] + reach) & (windows.stop < time[-1] - reach)
    if np.count_nonzero(inside) < 20 * DELAY_PARTS:
        return None
    # Windows in which gravity rotates most determine the delay.
    rotation = np.where(inside, windows.rotation, 0.0)
    largest = np.sort(np.argsort(rotation)[-MOST_COMPARED_WINDOWS:])
    windows = windows.select(largest[rotation[largest] > 0.0])
    cost = _DelayCost(gyroscope, time, windows)

    # The least residual among delays of decreasing distance: those within `reach`, then those
    # within one step of the best one.
    best = 0.0
    half_range = reach
    steps = [WIDE_STEP, DELAY_STEP] if reach > MAX_DELAY else [DELAY_STEP]
    for step in steps:
        delays = best + np.arange(-half_range, half_range + step / 2, step)
        best = delays[int(np.argmin([cost.residual(delay) for delay in delays]))]
        half_range = step
    fine_delays = best + np.arange(-DELAY_STEP, DELAY_STEP + FINE_DELAY_STEP / 2, FINE_DELAY_STEP)
    # Row 0: of all windows; row 1 + k: without part k.
    residuals = np.transpose([cost.residuals_without_parts(delay) for delay in fine_delays])
    total = float(np.sum(windows.change**2))
    if residuals[0].min() > (1.0 - MIN_EXPLAINED) * total:
        return None
    # Among many delays one may fit by chance; it does not predict other parts of the recording.
    if reach > MAX_DELAY and cost.prediction_error(best) > (1.0 - MIN_PREDICTED) * total:
        return None
    delay, *delays_without_parts = (_minimum_of_parabola(fine_delays, row) for row in residuals)
    # A minimum at the end of the searched delays may be a slope of one beyond.
    if abs(delay) > reach - steps[0]:
        return None
    # Jackknife over parts of the recording, because the residuals are correlated in time.
    return GyroscopeDelay(delay, float(np.sqrt((DELAY_PARTS - 1) * np.var(delays_without_parts))))


class _DelayCost:
    """
    Squared residuals of the windows for a delay, with A and b of `gyroscope_delay` fitted.

    The model of a window is ``change = [u x] (A, b) turned``, with the direction u of gravity in
    its middle, and `turned`: the integral of the rates over the window shifted by the delay, and
    its duration, (4,). It is linear in the 12 numbers of (A, b), whose coefficients are products
    of a number of [u x] and one of `turned`. The normal equations are therefore sums over windows
    of products of ``[u x].T [u x]``, which is the same for all delays, with ``turned turned.T``.
    """

    def __init__(self, gyroscope: SensorStream, time: np.ndarray, windows: _GravityWindows):
        # Times of the gyroscope, s, and integral of its rates up to them, rad, shape (3, n).
        self._time = time
        self._integral = np.zeros((3, len(time)))
        half_step = np.diff(time) * 0.5
        for axis, rate in enumerate(gyroscope.values.T):
            np.cumsum(half_step * (rate[1:] + rate[:-1]), out=self._integral[axis, 1:])
        self._windows = windows

        # Parts of the windows, in order. A sum over the windows of a part is a matrix product.
        n_windows = len(windows.start)
        bounds = np.arange(DELAY_PARTS + 1) * n_windows // DELAY_PARTS
        self._parts = [slice(a, b) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
        # Of each part: the 9 numbers of [u x].T [u x], the 3 of [u x].T change, and |change|^2.
        cross = skew(windows.middle)
        cross_squares = np.einsum('nij,nik->njk', cross, cross).reshape(-1, 9)
        cross_changes = np.einsum('nij,ni->nj', cross, windows.change)
        self._cross_squares = [cross_squares[part].T for part in self._parts]
        self._cross_changes = [cross_changes[part].T for part in self._parts]
        self._change_squares = np.array([np.sum(windows.change[part] ** 2) for part in self._parts])

    def residual(self, delay: float) -> float:
        """Return the least sum of squares of all windows."""
        parts = self._equations(delay)
        return float(
            _least_squares_residual(
                parts.normal.sum(axis=0), parts.applied.sum(axis=0), parts.observed.sum()
            )
        )

    def residuals_without_parts(self, delay: float) -> np.ndarray:
        """Return the least sums of squares of all windows, then without each part, (k + 1,)."""
        parts = self._equations(delay)
        return _least_squares_residual(
            _all_and_without_each(parts.normal),
            _all_and_without_each(parts.applied),
            _all_and_without_each(parts.observed),
        )

    def prediction_error(self, delay: float) -> float:
        """Return the sum of squares of each part with A and b of the other parts."""
        parts = self._equations(delay)
        fit = _least_squares(
            _all_and_without_each(parts.normal)[1:], _all_and_without_each(parts.applied)[1:]
        )
        # |y - X x|^2 = y'y - 2 b'x + x'N x
        crossed = np.einsum('ki,ki->', fit, parts.applied)
        squares = np.einsum('ki,kij,kj->', fit, parts.normal, fit)
        return float(parts.observed.sum() - 2.0 * crossed + squares)

    def _equations(self, delay: float) -> '_PartEquations':
        """Return the normal equations of each part."""
        start, stop = self._windows.start, self._windows.stop
        turned = np.empty((len(start), 4))
        for axis in range(3):
            turned[:, axis] = np.interp(stop + delay, self._time, self._integral[axis])
            turned[:, axis] -= np.interp(start + delay, self._time, self._integral[axis])
        turned[:, 3] = stop - start
        # Sums over a part: (9, n) @ (n, 16) are the products of [u x].T [u x] (j, k) with those of
        # `turned` (l, m), as (j, k, l, m).
        products = (turned[:, :, None] * turned[:, None, :]).reshape(-1, 16)
        normal = np.empty((DELAY_PARTS, 12, 12))
        applied = np.empty((DELAY_PARTS, 12))
        for number, part in enumerate(self._parts):
            # Unknown 4 j + l is the number (j, l) of (A, b): N has rows (j, l) and columns (k, m).
            blocks = (self._cross_squares[number] @ products[part]).reshape(3, 3, 4, 4)
            normal[number] = blocks.transpose(0, 2, 1, 3).reshape(12, 12)
            applied[number] = (self._cross_changes[number] @ turned[part]).reshape(12)
        return _PartEquations(normal, applied, self._change_squares)


@dataclass(frozen=True, eq=False)
class _PartEquations:
    """Normal equations ``N x = b`` of each of k parts."""

    normal: np.ndarray
    """N, shape (k, 12, 12)."""
    applied: np.ndarray
    """b, shape (k, 12)."""
    observed: np.ndarray
    """Squares ``y.T y`` of the changes of direction, shape (k,)."""


def _all_and_without_each(parts: np.ndarray) -> np.ndarray:
    """Return the sum over the parts, then without each part in turn, shape (k + 1, ...)."""
    total = parts.sum(axis=0)
    return np.concatenate([total[None], total - parts])


@dataclass(frozen=True, eq=False)
class _EigenForm:
    """
    Normal equations ``N x = b`` along the eigenvectors of N, in unknowns of equal size.

    Shapes: N (..., n, n), b (..., n). With ``z = x scale`` and an eigenvector v of the scaled N,
    ``value (v . z) = v . (b / scale)``.
    """

    scale: np.ndarray
    """Square roots of the diagonal of N, shape (..., n)."""
    vectors: np.ndarray
    """Eigenvectors in the columns, shape (..., n, n)."""
    values: np.ndarray
    """Eigenvalues, 1 where the windows do not determine the direction, shape (..., n)."""
    determined: np.ndarray
    """Whether they determine it, bool, shape (..., n)."""
    right_side: np.ndarray
    """Components of ``b / scale`` along the eigenvectors, shape (..., n)."""

    @classmethod
    def of(cls, normal: np.ndarray, applied: np.ndarray) -> '_EigenForm':
        """Return the form of equations with N and b."""
        diagonal = np.diagonal(normal, axis1=-2, axis2=-1)
        scale = np.sqrt(np.maximum(diagonal, np.finfo(float).tiny))
        values, vectors = np.linalg.eigh(normal / (scale[..., :, None] * scale[..., None, :]))
        right_side = np.einsum('...ij,...i->...j', vectors, applied / scale)
        determined = values > MIN_EIGENVALUE
        return cls(scale, vectors, np.where(determined, values, 1.0), determined, right_side)


def _least_squares(normal: np.ndarray, applied: np.ndarray) -> np.ndarray:
    """Return the solution of ``N x = b``, zero along directions that are not determined."""
    form = _EigenForm.of(normal, applied)
    components = np.where(form.determined, form.right_side / form.values, 0.0)
    return np.einsum('...ij,...j->...i', form.vectors, components) / form.scale


def _least_squares_residual(
    normal: np.ndarray, applied: np.ndarray, observed: np.ndarray
) -> np.ndarray:
    """
    Return ``y.T y - b.T N^-1 b`` of normal equations ``N x = b``, without undetermined directions.

    Shapes of N, b and ``y.T y``: (..., n, n), (..., n), (...).
    """
    form = _EigenForm.of(normal, applied)
    explained = np.where(form.determined, form.right_side**2 / form.values, 0.0)
    return observed - explained.sum(axis=-1)


def _minimum_of_parabola(delays: np.ndarray, costs: np.ndarray) -> float:
    """
    Return the delay at the vertex of the parabola through the least cost and its neighbours.

    It is limited to one step, and is the delay of the least cost without a positive curvature.
    """
    least = int(np.clip(np.argmin(costs), 1, len(costs) - 2))
    before, at_least, after = costs[least - 1 : least + 2]
    curvature = before - 2.0 * at_least + after
    if curvature <= 0.0:
        return float(delays[int(np.argmin(costs))])
    step = delays[least] - delays[least - 1]
    n_steps = np.clip(0.5 * (before - after) / curvature, -1.0, 1.0)
    return float(delays[least] + n_steps * step)
