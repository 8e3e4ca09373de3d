"""Identification of the noise figures from a recording at rest."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np

from imu_calibration import __version__
from imu_calibration.allan.curve import AllanCurve, Detrending, RestReader, averaging_factors
from imu_calibration.allan.figures import AxisFigures, NoiseFigures
from imu_calibration.allan.moment_fit import Moments, Whitener
from imu_calibration.allan.moved_at_rest import tilt_at_rest
from imu_calibration.allan.processes import RANDOM_WALK, WHITE, NoiseProcess, ScaleCovariance
from imu_calibration.allan.reading_faults import ReadingFaults
from imu_calibration.allan.still_parts import LEFT_OUT, StillPart, Survey, still_parts, survey
from imu_calibration.allan.terms import (
    LEAST_SCALES,
    PROCESSES,
    AxisNoise,
    identify_axis,
    with_wider_white_noise,
)
from imu_calibration.allan.trends import MAX_TREND_BLOCKS, AxisTrend, Blocks, TrendSearch
from imu_calibration.core.distributions import f_sf
from imu_calibration.core.errors import InputError
from imu_calibration.core.progress import reported
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import LARGEST_STEP, BlockSource
from imu_calibration.effects.base import AXES, SENSORS
from imu_calibration.estimation.solution import DETERMINED
from imu_calibration.preprocessing.scan import SENSOR_COLUMNS, Chunks

CYCLES = 64
"""
Cycles of the hump's frequency in a segment, at most: a resonance of quality below 16 is wider than
the neighbouring ordinates of the test.
"""
FEWEST_CYCLES = 16
"""Cycles in the longest rest, at least: with fewer, slow noise and a line are not separable."""
PER_CYCLE = 16
"""Block means per cycle: twice the hump's frequency, the highest under test, has eight."""
LINE_HALF_BINS = 2
"""Half width of a line under a Hann window, bins."""
LINE_NEIGHBOUR_BINS = 9
"""Distance of the farthest ordinates around a line, bins."""
HANN_INDEPENDENT_SHARE = 2 / 3
"""Share of independent ordinates under a Hann window: its noise bandwidth is 1.5 bins."""
LINE_P_VALUE = 1e-4
"""
Significance level over all frequencies under test: six axes of 100 recordings without a line give
0.06 false ones.
"""


class ToneSearch:
    """
    Search for a line near the frequency of a hump in one axis, block by block.

    Segments of block means are transformed, and their periodograms are added, at constant memory.
    The search covers half to twice the frequency of the hump.

    Parameters
    ----------
    frequency : float
        Frequency of the hump, Hz.
    period : float
        Time between samples, s.
    column : int
        Axis: force x, y, z, then rate x, y, z.
    longest : float
        Duration of the longest rest, s.

    """

    def __init__(self, frequency: float, period: float, column: int, *, longest: float):
        self._frequency = frequency
        self._column = column
        # Samples of a block, and its length, s.
        self._block_size = max(int(1 / (PER_CYCLE * frequency * period)), 1)
        self._block_seconds = self._block_size * period
        # Blocks of a segment; 0 if all rests are too short for a search.
        self._n_blocks = 0
        if longest * frequency >= FEWEST_CYCLES:
            self._n_blocks = int(min(CYCLES / frequency, longest) / self._block_seconds)
        # Sum of the periodograms of complete segments, their number, and samples of the next one.
        self._power = np.zeros(self._n_blocks // 2 + 1)
        self._n_segments = 0
        self._samples = np.zeros(0)

    def push(self, values: np.ndarray, present: np.ndarray) -> None:
        """Add the next samples of a rest, shape (n, 6); missing ones are replaced by the mean."""
        from scipy.signal import periodogram  # here, because its import is slow

        if not self._n_blocks or not present.any():
            return
        mean = values[present, self._column].mean()
        new = np.where(present, values[:, self._column], mean)
        self._samples = np.concatenate([self._samples, new])
        n_samples = self._block_size * self._n_blocks  # of a segment
        while len(self._samples) >= n_samples:
            samples = self._samples[:n_samples].reshape(self._n_blocks, self._block_size)
            segment = samples.mean(axis=1)
            self._samples = self._samples[n_samples:]
            _, power = periodogram(segment, window='hann', detrend='linear', scaling='spectrum')
            self._power += power
            self._n_segments += 1

    def end_stretch(self) -> None:
        """Discard the incomplete segment: the next sample belongs to another rest."""
        self._samples = np.zeros(0)

    def line(self) -> tuple[float, float] | None:
        """
        Return (frequency in Hz, amplitude) of the most significant line, None without one.

        The test is an F test of one ordinate of the spectrum against the mean of those around it;
        its probability is multiplied by the number of tested frequencies.
        """
        # Ordinates in the range of the search, each with all its neighbours.
        bins = np.arange(LINE_NEIGHBOUR_BINS, len(self._power) - LINE_NEIGHBOUR_BINS)
        hertz = 1 / (max(self._n_blocks, 1) * self._block_seconds)
        bins = bins[(bins * hertz >= 0.5 * self._frequency) & (bins * hertz <= 2 * self._frequency)]
        if not self._n_segments or not len(bins):
            return None
        below = np.arange(-LINE_NEIGHBOUR_BINS, -LINE_HALF_BINS)
        above = np.arange(LINE_HALF_BINS + 1, LINE_NEIGHBOUR_BINS + 1)
        offsets = np.concatenate([below, above])
        # Mean of the neighbours outside the lobe of a line, shape (n_bins,).
        around = self._power[bins[:, None] + offsets].mean(axis=1)
        ratio = self._power[bins] / around
        best = int(np.argmax(ratio))
        # An ordinate has two degrees of freedom in each segment.
        freedom = 2 * self._n_segments
        freedom_around = 2 * self._n_segments * len(offsets) * HANN_INDEPENDENT_SHARE
        if not f_sf(ratio[best], freedom, freedom_around) * len(bins) < LINE_P_VALUE:
            return None

        # A sine of amplitude a has the sum 1.5 a^2 / 2 over its lobe, in addition to the noise.
        # Means over blocks of T s lower the amplitude by sin(pi f T) / (pi f T).
        lobe = np.arange(bins[best] - LINE_HALF_BINS, bins[best] + LINE_HALF_BINS + 1)
        power = self._power[lobe]
        frequency = float(power @ lobe / power.sum()) * hertz
        power_of_line = max(power.sum() - len(lobe) * around[best], 0.0) / self._n_segments
        squared_amplitude = power_of_line * 2 * HANN_INDEPENDENT_SHARE
        return frequency, float(
            np.sqrt(squared_amplitude) / np.sinc(frequency * self._block_seconds)
        )


LENGTHS = 60.0 * np.array(
    [10, 15, 20, 30, 45, 60, 90, 120, 180, 240, 360, 480, 720, 1080, 1440, 2160, 2880], float
)
"""Possible lengths of a recording, s: from ten minutes to two days."""
RELATIVE_SD = 0.24
"""
Standard deviation of a coefficient over the coefficient at which the 95 % interval of its root has
a ratio of 1.6.
"""
SCALES_FROM = 0.1
"""Shortest averaging time of the prediction, s: shorter ones determine the white noise only."""


class RecordingTimes:
    """
    Predicts relative standard deviations of coefficients from one recording at rest.

    Parameters
    ----------
    period : float
        Time between samples, s.

    """

    def __init__(self, period: float):
        self._period = period
        # Length of a recording, s -> covariance of its Allan variances, which is slow to compute.
        self._covariance_of_length: dict[float, ScaleCovariance] = {}

    def needed(
        self, processes: tuple[NoiseProcess, ...], coefficients: np.ndarray, index: int
    ) -> float | None:
        """
        Return the shortest of `LENGTHS` in which coefficient `index` of a model is determined, s.

        None when none is long enough.
        """
        for length in LENGTHS:
            if self.relative_sd(length, processes, coefficients, index=index) <= RELATIVE_SD:
                return float(length)
        return None

    def relative_sd(
        self,
        seconds: float,
        processes: tuple[NoiseProcess, ...],
        coefficients: np.ndarray,
        *,
        index: int,
    ) -> float:
        """
        Return sd / value of coefficient `index`, as a recording of `seconds` would determine it.

        All coefficients c of the model are fitted. With the expected variances ``D c`` and the
        covariance C of the measured ones, the information on relative changes of c is ``diag(c) D'
        C^-1 D diag(c)``. C is quadratic in c, as Allan variances are in the noise: with the tensor
        T of the pairs (p, q) of processes, ``C_ij = sum_pq c_p c_q T_pqij``.
        """
        moments = self._moments(seconds)
        design = moments.design(processes)
        tensor = moments.tensor(processes)
        covariance = np.einsum('p,q,pqij->ij', coefficients, coefficients, tensor)
        whiten = Whitener(covariance)
        columns = whiten(design * coefficients)  # of relative changes of the coefficients
        information = columns.T @ columns
        # With a unit diagonal, so that the inverse is accurate.
        scale = np.sqrt(np.diag(information))
        inverse = np.linalg.pinv(information / np.outer(scale, scale), rcond=1e-12, hermitian=True)
        return float(np.sqrt(inverse[index, index]) / scale[index])

    def _moments(self, seconds: float) -> Moments:
        """
        Return `Moments` for the prediction: the sampling errors of a recording of this length, s.

        The prediction uses their scales only; ones take the place of the Allan variances.
        """
        if seconds not in self._covariance_of_length:
            n = int(seconds / self._period)
            factors = averaging_factors(n, per_octave=1)
            factors = factors[factors * self._period >= SCALES_FROM]
            self._covariance_of_length[seconds] = ScaleCovariance(factors, [n], self._period)
        scales = self._covariance_of_length[seconds]
        return Moments(scales, np.ones(len(scales.factors)), np.ones(len(scales.factors), bool))


MIN_CURVE_SAMPLES = 1000
"""Least number of samples at rest for a curve."""
EPOCH_GAP = 1.0
"""Time between two epochs of the clock, s; the true one is unknown."""


@dataclass(frozen=True, eq=False)
class RestingRecord:
    """
    The Allan curves of the parts at rest of a recording.

    The excluded parts and the subtracted trends are included.
    """

    curve: AllanCurve
    """Allan variances of the six axes."""
    moments: tuple[Moments | None, ...]
    """
    Variances with their covariance, one for each axis: force x, y, z, then rate x, y, z; None for
    the axes of a sensor that is absent or unusable.
    """
    trends: tuple[tuple[AxisTrend, ...], ...]
    """Trends subtracted from each axis."""
    parts: tuple[StillPart, ...]
    """Stretches at rest."""
    left_out: dict[str, float]
    """Reason (`LEFT_OUT`) -> seconds that were not used."""
    sample_sd: np.ndarray
    """Standard deviation of single samples within a quarter of a second, shape (6,)."""
    survey: Survey
    """Result of the first pass."""
    reader: RestReader
    """Reads the parts at rest again."""
    unusable: dict[str, str] = field(default_factory=dict)
    """Sensor with readings but without identifiable noise -> reason."""


@dataclass(frozen=True, eq=False)
class NoiseIdentification:
    """The noise of an IMU, estimated from a recording."""

    record: RestingRecord
    """The recording."""
    axes: tuple[AxisNoise | None, ...]
    """Force x, y, z, then rate x, y, z; None for a sensor that is absent or unusable."""

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors with identified noise."""
        identified = []
        for sensor, columns in SENSOR_COLUMNS.items():
            if self.axes[columns.start] is not None:
                identified.append(sensor)
        return tuple(identified)


def identify_noise(source: BlockSource, nominal: RawReadings | None = None) -> NoiseIdentification:
    """
    Identify the noise of an IMU from a recording that contains rest.

    Parameters
    ----------
    source : BlockSource
        The recording; it is read twice, and again where a curve has a hump.
    nominal : RawReadings, optional
        For recordings in volts or counts.

    Raises
    ------
    InputError
        When no part at rest is long enough, or the recording is not usable.

    """
    record = read_rest(source, nominal)
    axes: list[AxisNoise | None] = []
    for moments in reported('identifying the noise', record.moments, len(record.moments)):
        axes.append(None if moments is None else identify_axis(moments))

    # A hump of a curve is an oscillation only with a line in the spectrum.
    longest = max(part.seconds for part in record.parts)
    searches: dict[int, ToneSearch] = {}
    for k, axis in enumerate(axes):
        if axis is not None and axis.oscillation:
            frequency, _ = axis.oscillation
            searches[k] = ToneSearch(frequency, record.curve.period, k, longest=longest)
    if searches:
        record.reader.read(*searches.values())
    for k, axis in enumerate(axes):
        if axis is not None:
            line = searches[k].line() if k in searches else None
            axis = with_wider_white_noise(axis, record.curve.faults.factor(k))
            axes[k] = replace(axis, oscillation=line)
    return NoiseIdentification(record, tuple(axes))


def read_rest(source: BlockSource, nominal: RawReadings | None = None) -> RestingRecord:
    """
    Read a recording twice, first for parts at rest and trends, then for the Allan curves.

    Arguments as for `identify_noise`.
    """
    # First pass: parts of the recording without motion, of each epoch of the clock.
    surveyed = survey(source, nominal)
    parts, left_out = _parts_at_rest(surveyed)
    _require_no_tilt(surveyed, parts)

    # Trends, which are no noise, are subtracted in the second pass.
    clock = _Clock(surveyed.epochs)
    search = TrendSearch(_blocks(surveyed, parts, clock))
    skipped_sensors = {*surveyed.absent, *surveyed.unusable}
    skipped = _axes_of(skipped_sensors)
    trends = tuple(() if axis in skipped else search.find(axis) for axis in range(6))
    detrending = Detrending(trends, search.reference, clock.temperature(surveyed))
    reader = RestReader(source, parts, surveyed.period, detrending, clock.time, nominal)
    curve = reader.curve()

    # Moments of the Allan variances of the axes with readings that scatter.
    unusable = surveyed.unusable | _without_scatter(curve, skipped_sensors)
    skipped = _axes_of({*surveyed.absent, *unusable})
    scales = ScaleCovariance(curve.factors, list(curve.lengths), curve.period)
    moments: list[Moments | None] = []
    for axis, variance in enumerate(curve.variance.T):
        if axis in skipped:
            moments.append(None)
            continue
        kept_share = search.kept(axis, trends[axis])
        moments.append(Moments(scales, variance, variance > 0, kept_share, curve.parts[axis]))
    return RestingRecord(
        curve=curve,
        moments=tuple(moments),
        trends=trends,
        parts=tuple(chain.from_iterable(parts)),
        left_out=left_out,
        sample_sd=_sample_sd(surveyed, parts),
        survey=surveyed,
        reader=reader,
        unusable=unusable,
    )


def _parts_at_rest(surveyed: Survey) -> tuple[list[list[StillPart]], dict[str, float]]:
    """
    Return (parts at rest of each epoch of the clock, reason -> seconds that are not used).

    Raises InputError for a low sampling rate or a short rest.
    """
    if surveyed.period > LARGEST_STEP:
        raise InputError(
            f'the IMU must be read at least once in {LARGEST_STEP:g} s, the median step is'
            f' {surveyed.period:g} s; record at its full rate',
            code='rate_too_low',
        )
    parts = []
    left_out = dict.fromkeys(LEFT_OUT, 0.0)
    for chunks in surveyed.epochs:
        parts_of_epoch, seconds_left_out = still_parts(chunks, surveyed.period, surveyed.resolution)
        parts.append(parts_of_epoch)
        for reason in LEFT_OUT:
            left_out[reason] += seconds_left_out[reason]
    seconds = sum(part.seconds for part in chain.from_iterable(parts))
    if seconds < MIN_CURVE_SAMPLES * surveyed.period or not surveyed.period:
        raise InputError(
            f'the IMU must rest for at least {MIN_CURVE_SAMPLES} samples, it rested for'
            f' {seconds:.1f} s; record with the IMU lying still on something heavy, for an hour if'
            ' you can',
            code='rest_too_short',
        )
    return parts, left_out


def _require_no_tilt(surveyed: Survey, parts: list[list[StillPart]]) -> None:
    """
    Refuse a rest in which gravity turns slowly and the rates explain it.

    `parts` are those of each epoch of the clock.
    """
    if surveyed.absent or surveyed.unusable:
        return
    for chunks, parts_of_epoch in zip(surveyed.epochs, parts, strict=True):
        for part in parts_of_epoch:
            tilt = tilt_at_rest(chunks.time[part.chunks], chunks.mean[part.chunks])
            if tilt:
                raise InputError(
                    'the IMU must lie still, it was tilted slowly by'
                    f' {np.degrees(tilt):.2g} deg (rms) during a rest of {part.seconds:.0f} s, as'
                    ' both sensors measure; put it on something heavy, or omit that time',
                    key='exclude',
                    code='moved_at_rest',
                )


def _axes_of(sensors: Iterable[str]) -> set[int]:
    """Return the axes of some sensors, 0 to 5."""
    axes = set()
    for sensor in sensors:
        part = SENSOR_COLUMNS[sensor]
        axes |= set(range(part.start, part.stop))
    return axes


def _without_scatter(curve: AllanCurve, skipped: set[str]) -> dict[str, str]:
    """
    Return sensor with an axis of constant readings -> why its noise cannot be identified.

    The quantisation of these readings hides the noise. `skipped` are the sensors that are absent or
    unusable; an error is raised if no other sensor remains.
    """
    reasons = {}
    for sensor, part in SENSOR_COLUMNS.items():
        if sensor in skipped:
            continue
        n_scales = np.sum(curve.variance[:, part] > 0, axis=0)
        frozen = []
        for letter, count in zip(AXES, n_scales, strict=True):
            if count < LEAST_SCALES:
                frozen.append(f'{sensor} {letter}')
        if frozen:
            reasons[sensor] = (
                f'every axis must scatter at rest, {" and ".join(frozen)} remains on one step of'
                ' its readings; record with a finer resolution'
            )
    if reasons and {*reasons, *skipped} == set(SENSORS):
        raise InputError(next(iter(reasons.values())), code='coarse_steps')
    return reasons


def figures_of(result: NoiseIdentification, provenance: dict | None = None) -> NoiseFigures:
    """Return the content of noise.yaml: the figures of all axes and the excluded parts."""
    record = result.record
    times = RecordingTimes(record.curve.period)
    axes_of_sensor: dict[str, list[AxisFigures]] = {sensor: [] for sensor in SENSORS}
    for number, axis in enumerate(result.axes):
        if axis is None:
            continue
        figures = AxisFigures(
            **vars(axis),
            trends=record.trends[number],
            record_for=_record_for(axis, times),
            sample_sd=float(record.sample_sd[number]),
            deviation=tuple(np.sqrt(record.curve.variance[:, number]).tolist()),
        )
        axes_of_sensor[SENSORS[number // 3]].append(figures)
    dropped = dict(record.survey.dropped)
    frozen = record.left_out['frozen_output']
    if frozen:
        dropped['imu frozen output'] = round(frozen / record.curve.period)
    recording = {
        'seconds_at_rest': float(record.curve.seconds),
        'parts': len(record.parts),
        'longest_part': float(max(part.seconds for part in record.parts)),
        'left_out': record.left_out,
        'dropped': dropped,
        'faults': _fault_entries(record.curve.faults, result.sensors),
        'intervals_hold_for': 'this recording; the slow noise of another one can be outside',
    }
    if record.unusable:
        recording['unusable'] = dict(record.unusable)
    return NoiseFigures(
        tuple(axes_of_sensor['accelerometer']),
        tuple(axes_of_sensor['gyroscope']),
        rate=1.0 / record.curve.period,
        frame_id=record.survey.frame_id,
        recording=recording,
        tau=tuple(float(tau) for tau in record.curve.tau),
        provenance={'software': f'imu_calibration {__version__}'} | (provenance or {}),
    )


def _fault_entries(faults: ReadingFaults, sensors: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the doubtful readings of the sensors for noise.yaml: sensor or axis -> figures."""
    entries: dict[str, dict[str, float]] = {}
    for k, sensor in enumerate(SENSORS):
        if sensor not in sensors:
            continue
        if faults.repeated[k] > 0:
            entries[sensor] = {
                'repeated': float(faults.repeated[k]),
                'white_noise_too_high_by': float(faults.repetition[k]),
            }
        for axis, letter in enumerate(AXES, start=3 * k):
            if faults.named[axis]:
                ratio = float(faults.tails[axis])
                entries[f'{sensor} {letter}'] = {'white_noise_too_high_by': ratio}
    return entries


def _record_for(axis: AxisNoise, times: RecordingTimes) -> dict[str, float | None]:
    """
    Return figure that is not determined -> recording time that determines it, s.

    A figure with an upper limit only has the size of this limit. None if no time is long enough.
    """
    needed = {}
    for name, term in axis.terms.items():
        # White noise, the random walk that filters need, and the processes of the form; correlation
        # times are no processes.
        is_needed = name in (WHITE.name, RANDOM_WALK.name, *axis.form) and name in PROCESSES
        if not is_needed or term.status == DETERMINED or not np.isfinite(term.interval[1]):
            continue
        # The fitted model, with this process first if it is not part of it.
        fitted = dict(zip(axis.fit.names, axis.fit.coefficients))
        coefficients = fitted if name in fitted else {name: 0.0} | fitted
        coefficients[name] = (term.value or term.interval[1]) ** 2
        # Processes of zero size have no relative sd.
        positive = {process: value for process, value in coefficients.items() if value > 0}
        names = list(positive)
        needed[name] = times.needed(
            tuple(PROCESSES[process] for process in names),
            np.array(list(positive.values())),
            names.index(name),
        )
    return needed


class _Clock:
    """Time since the beginning of the recording, across new settings of the clock."""

    def __init__(self, epochs: Sequence[Chunks]):
        # First stamp of each epoch, ns, and its time since the beginning, s.
        self._first = [chunks.first_ns for chunks in epochs]
        lengths = [float(chunks.time[-1]) + EPOCH_GAP if len(chunks) else 0.0 for chunks in epochs]
        self._offset = np.append(0.0, np.cumsum(lengths))

    def time(self, epoch: int, stamp_ns: np.ndarray) -> np.ndarray:
        """Return seconds since the beginning for stamps of an epoch."""
        return (stamp_ns - self._first[epoch]) * 1e-9 + self._offset[epoch]

    def temperature(self, surveyed: Survey) -> tuple[np.ndarray, np.ndarray] | None:
        """
        Return (time, degrees Celsius) of the thinned temperatures, or None.

        They belong to the first epoch of the clock.
        """
        if surveyed.temperature is None:
            return None
        stamp_ns, values = surveyed.temperature
        order = np.argsort(stamp_ns, kind='stable')
        return self.time(0, stamp_ns[order]), values[order]


def _blocks(surveyed: Survey, parts: list[list[StillPart]], clock: _Clock) -> Blocks:
    """
    Return means over blocks of equal numbers of chunks, about `MAX_TREND_BLOCKS` in all parts.

    `parts` are those of each epoch of the clock.
    """
    n_chunks = sum(part.chunks.stop - part.chunks.start for part in chain.from_iterable(parts))
    size = max(int(np.ceil(n_chunks / MAX_TREND_BLOCKS)), 1)
    times = []
    means = []
    numbers = []  # of the part of each block
    seconds = 0.0  # of a block, by the last epoch with a part; all chunks are about as long
    for epoch, (chunks, parts_of_epoch) in enumerate(zip(surveyed.epochs, parts)):
        for part in parts_of_epoch:
            first = part.chunks.start
            n_blocks = (part.chunks.stop - first) // size  # an incomplete last one is not used
            used = slice(first, first + n_blocks * size)
            middle = chunks.time[used].reshape(n_blocks, size).mean(axis=1)
            times.append(clock.time(epoch, chunks.first_ns + middle * 1e9))
            means.append(chunks.mean[used].reshape(n_blocks, size, 6).mean(axis=1))
            numbers.append(np.full(n_blocks, len(numbers)))
            seconds = size * float(np.median(chunks.duration))
    time = np.concatenate(times)
    temperature = clock.temperature(surveyed)
    return Blocks(
        time,
        np.concatenate(means),
        np.concatenate(numbers),
        seconds,
        None if temperature is None else np.interp(time, *temperature),
    )


def _sample_sd(surveyed: Survey, parts: list[list[StillPart]]) -> np.ndarray:
    """Return the standard deviation of samples within chunks, without bias, shape (6,)."""
    variances = []
    for chunks, parts_of_epoch in zip(surveyed.epochs, parts):
        variances += [chunks.sd[part.chunks] ** 2 for part in parts_of_epoch]
    size = surveyed.epochs[0].size
    return np.sqrt(np.concatenate(variances).mean(axis=0) * size / (size - 1))
