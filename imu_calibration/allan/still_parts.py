"""
The first pass over a recording (short means, period, temperature, faults), and its parts at rest.

A chunk is a short mean over a fixed number of samples, with their scatter.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from imu_calibration.allan.outliers import RestOutliers, without_outliers
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import SampleBlock, TemperatureSamples, runs_of
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.rest_detection import shrunk_mask
from imu_calibration.preprocessing.scan import (
    CHUNK_SECONDS,
    Chunks,
    ChunkSeries,
    frozen_chunks,
    still_chunks,
)
from imu_calibration.preprocessing.stream_cleaning import BlockCleaner

OUTLIER = 8.0
"""
Robust standard deviations from the median beyond which a scatter or a step is motion.
"""
LEAST_GROWTH = 1.25
"""Least factor on the median of a scatter that is motion, even if all others are equal."""
FROZEN = 0.05
"""Share of chunks without any scatter, from which an output is coarse."""
SETTLING = 1.0
"""Time before and after motion that is excluded, s."""
MIN_STILL_SECONDS = 2.0
"""Shortest part, s."""
STEP_WIDTHS = (1, 4, 16, 64)
"""Numbers of chunks per mean for the search of steps: small steps need long means."""
PERIOD_MEDIAN_CHUNKS = 41
"""Chunks of the running median of the sampling period."""
SAME_PERIOD = 0.02
"""Relative change of the sampling period that ends a part."""
MOST_MISSING = 0.2
"""Share of the samples of a chunk that may be dropped where the median step is the usual one."""
USUAL_STEP_SHARE = 0.05
"""Least share of chunks without dropped samples that determines the period."""
BRIDGE = 60.0
"""Longest hole within a part, s."""


@dataclass(frozen=True, eq=False)
class StillPart:
    """A stretch at rest."""

    first_ns: int
    """First stamp of the part."""
    end_ns: int
    """First stamp after the part."""
    chunks: slice
    """Chunks of the part."""

    @property
    def seconds(self) -> float:
        """Length, s."""
        return (self.end_ns - self.first_ns) * 1e-9


LEFT_OUT = ('motion', 'short_rests', 'other_sampling_rate', 'frozen_output')
"""
Reasons for which time is not used: motion and the time around it, rests that are too short, another
sampling rate, a repeated reading.
"""


def still_parts(
    chunks: Chunks, period: float, resolution: np.ndarray
) -> tuple[list[StillPart], dict[str, float]]:
    """
    Return (parts at rest, reason of `LEFT_OUT` -> seconds that are not used).

    Parameters
    ----------
    chunks : Chunks
        Of one epoch of the clock.
    period : float
        Usual time between samples, s.
    resolution : array, shape (6,)
        Smallest step between readings of each column.

    """
    # Chunks in which a sensor repeats its reading, and those at the usual rate.
    frozen = np.logical_or(*frozen_chunks(chunks, resolution).values())
    seconds = float(np.median(chunks.duration)) if len(chunks) else 0.0  # of a chunk
    usual_rate = _at_the_usual_rate(chunks, period)

    # Rest is relative to the quietest tenth of the chunks, which frozen chunks would all be.
    live = chunks.select(~frozen)
    still = np.zeros(len(chunks), bool)
    still[~frozen] = _without_unusual(live, still_chunks(live) & usual_rate[~frozen])
    # Without the time in which the IMU settles after a motion, and as long before one.
    margin = int(np.ceil(SETTLING / seconds)) if seconds else 0
    settled = shrunk_mask(still, margin)

    # Runs of these chunks, long enough and without a long hole.
    parts = []
    seconds_short = 0.0
    for first, last in runs_of(settled, np.diff(chunks.time) > BRIDGE):
        part = _part(chunks, first, last)
        if part.seconds >= MIN_STILL_SECONDS:
            parts.append(part)
        else:
            seconds_short += part.seconds
    seconds_left_out = {
        'motion': float(np.sum(~settled & usual_rate & ~frozen)) * seconds,
        'short_rests': seconds_short,
        'other_sampling_rate': float(np.sum(~usual_rate & ~frozen)) * seconds,
        'frozen_output': float(np.sum(frozen)) * seconds,
    }
    return parts, seconds_left_out


def _at_the_usual_rate(chunks: Chunks, period: float) -> np.ndarray:
    """
    Return a mask of the chunks around which most have the usual period, shape (n_chunks,).

    A chunk with a lost sample is longer, its neighbours are not. Where outliers were dropped from
    most chunks, the median step between stamps is still the period.
    """
    from scipy.ndimage import median_filter  # here, because its import is slow

    if not len(chunks):
        return np.zeros(0, bool)
    mean_step = median_filter(chunks.duration / chunks.size, PERIOD_MEDIAN_CHUNKS, mode='nearest')
    excess = mean_step / period - 1.0
    usual_mean = np.abs(excess) <= SAME_PERIOD
    median_step = median_filter(chunks.step, PERIOD_MEDIAN_CHUNKS, mode='nearest')
    usual_step = np.abs(median_step / period - 1.0) <= SAME_PERIOD
    return usual_mean | (usual_step & (np.abs(excess) <= MOST_MISSING))


def _without_unusual(chunks: Chunks, still: np.ndarray) -> np.ndarray:
    """Return the chunks at rest (mask) without chunks of unusual scatter or at a step."""
    if not still.any():
        return still
    scatter = np.log(np.maximum(chunks.sd, _least_scatter(chunks.sd[still])))
    usual = np.ones(len(chunks), bool)
    for column in scatter.T:
        middle, width = _centre(column[still])
        usual &= column - middle <= max(OUTLIER * width, np.log(LEAST_GROWTH))
    still = still & usual
    for width in STEP_WIDTHS:
        still = still & ~_at_step(chunks.mean, still, width)
    return still


def _least_scatter(sd: np.ndarray) -> np.ndarray:
    """
    Return the least meaningful scatter of each column, shape (6,).

    For a coarse converter, which often repeats a value, it is the 90 % quantile of the scatter of
    the chunks `sd`, otherwise zero.
    """
    frozen = (sd == 0).mean(axis=0) > FROZEN
    return np.where(frozen, np.maximum(np.quantile(sd, 0.9, axis=0), 1e-300), 1e-300)


def _at_step(mean: np.ndarray, still: np.ndarray, width: int) -> np.ndarray:
    """
    Return a mask of the chunks at a step of the means, shape (n_chunks,).

    At a step the means of `width` chunks before and after, all at rest, differ by more than
    `OUTLIER` times the usual difference, and by more than at all chunks nearby. An eighth of
    `width` on both sides of a step belongs to it, because its place is found within a few chunks.
    With fewer than 4 `width` comparisons the usual difference is unknown, and there is no step.

    Parameters
    ----------
    mean : ndarray, shape (n_chunks, 6)
    still : ndarray of bool, shape (n_chunks,)
        Mask of the chunks at rest.
    width : int

    """
    from scipy.ndimage import maximum_filter1d  # here, because its import is slow

    # Cumulative sums of the means at rest and of their number, from 0 on.
    at_rest = np.where(still[:, None], mean - mean[0], 0.0)
    sums = np.cumsum(np.concatenate([np.zeros((1, at_rest.shape[1])), at_rest]), axis=0)
    n_still = np.cumsum(np.concatenate([np.zeros(1), still.astype(float)]))
    all_still = n_still[width:] - n_still[:-width] == width
    means = (sums[width:] - sums[:-width]) / width

    # Row k compares the chunks k to k + width - 1 with the next `width` chunks.
    difference = np.abs(means[width:] - means[:-width])
    comparable = all_still[width:] & all_still[:-width]
    at_step = np.zeros(len(still), bool)
    if comparable.sum() < 4 * width:
        return at_step
    margin = max(width // 8, 1)
    for column in difference.T:
        # 1.4826 times the median of absolute values is the sd of a normal distribution.
        step_size = np.where(comparable, column, 0.0)
        usual_size = 1.4826 * np.median(column[comparable])
        if not usual_size > 0:
            continue
        peaks = step_size > OUTLIER * usual_size
        peaks &= step_size == maximum_filter1d(step_size, 2 * width + 1)
        for peak in np.flatnonzero(peaks):
            at_step[peak + width - margin : peak + width + margin] = True
    return at_step


def _centre(values: np.ndarray) -> tuple[float, float]:
    """Return (median, robust standard deviation)."""
    middle = np.median(values)
    return middle, 1.4826 * np.median(np.abs(values - middle))


def _part(chunks: Chunks, first: int, last: int) -> StillPart:
    """Return the part of the chunks `first` to `last` - 1."""
    begin = chunks.time[first] - 0.5 * chunks.duration[first]
    end = chunks.time[last - 1] + 0.5 * chunks.duration[last - 1]
    return StillPart(
        chunks.first_ns + round(begin * 1e9),
        chunks.first_ns + round(end * 1e9),
        slice(int(first), int(last)),
    )


MAX_STILL_CHUNKS = 1_000_000
"""Largest number of chunks: nearly three days."""


@dataclass(frozen=True, eq=False)
class Survey:
    """Result of the first pass over a recording."""

    epochs: list[Chunks]
    """Chunks of each epoch of the clock."""
    period: float
    """Time between samples, s."""
    temperature: tuple[np.ndarray, np.ndarray] | None
    """Stamps (ns) and degrees Celsius, thinned; None without."""
    findings: tuple
    """Faults of the recording."""
    resolution: np.ndarray
    """Smallest step between readings of each column, shape (6,); 0 when unknown."""
    dropped: Counter = field(default_factory=Counter)
    """Reason -> messages that could not be used."""
    frame_id: str = ''
    """Frame of the messages."""
    absent: tuple[str, ...] = ()
    """Sensors without readings."""
    unusable: dict[str, str] = field(default_factory=dict)
    """Sensor with unusable readings -> reason, if the other sensor is usable."""


def survey(blocks: Iterable[SampleBlock], nominal: RawReadings | None = None) -> Survey:
    """
    Read a recording once: its chunks, period, temperature and faults.

    Raises
    ------
    InputError
        When something makes the result wrong, such as other units.

    """
    preflight = Preflight(one_sensor=True)
    cleaner = BlockCleaner(nominal=nominal, watchers=[preflight], one_sensor=True)
    series: dict[int, ChunkSeries] = {}
    temperature = _Thinned()
    frame_id = ''
    outliers = RestOutliers()
    # Chunks of each epoch of the clock, without outliers.
    for cleaned in without_outliers(cleaner.all_of(blocks), outliers):
        for epoch, imu in cleaned.imu:
            frame_id = frame_id or imu.frame_id
            columns = np.concatenate([imu.force_s.T, imu.rate_s.T])
            series.setdefault(epoch, ChunkSeries(CHUNK_SECONDS, MAX_STILL_CHUNKS)).push(
                imu.stamp_ns, columns
            )
        for _, samples in cleaned.temperature:
            temperature.push(samples)

    # Samples that were not used.
    dropped = Counter(cleaner.lost)
    for reason, count in preflight.streams['imu'].dropped.items():
        # A count of jumps, which drop no sample.
        if reason != 'clock reset':
            dropped[reason] += count
    if outliers.replaced:
        dropped['outlier'] = outliers.replaced
    epochs = [item.chunks() for _, item in sorted(series.items())]
    return Survey(
        epochs=epochs,
        period=_period(epochs),
        temperature=temperature.result(),
        findings=preflight.findings,
        resolution=preflight.resolution,
        dropped=dropped,
        frame_id=frame_id,
        absent=preflight.streams['imu'].absent,
        unusable=preflight.unusable,
    )


def _period(epochs: list[Chunks]) -> float:
    """
    Return the period of most chunks, s; 0 without chunks.

    It is the mean over the chunks with about the usual period, since stamps may be rounded to
    milliseconds. The usual period is the median step between stamps if enough chunks have it,
    because dropped outliers lengthen the other chunks; otherwise the median over the chunks.
    """
    if not epochs:
        return 0.0
    steps = np.concatenate([chunks.duration / chunks.size for chunks in epochs])
    if not len(steps):
        return 0.0
    middle = np.median(steps)
    usual_step = np.median(np.concatenate([chunks.step for chunks in epochs]))
    if np.mean(np.abs(steps / usual_step - 1.0) < SAME_PERIOD) > USUAL_STEP_SHARE:
        middle = usual_step
    # Nine digits, without rounding errors in the document.
    return float(f'{np.mean(steps[np.abs(steps / middle - 1.0) < SAME_PERIOD]):.9g}')


class _Thinned:
    """Temperatures with at least the length of a chunk between them."""

    def __init__(self) -> None:
        # Kept stamps, ns, and temperatures of each call; the last kept stamp.
        self._stamps: list[np.ndarray] = []
        self._values: list[np.ndarray] = []
        self._last = -np.inf

    def push(self, samples: TemperatureSamples) -> None:
        """Add the next temperatures."""
        kept = []
        for k, stamp in enumerate(samples.stamp_ns):
            if abs(float(stamp) - self._last) >= CHUNK_SECONDS * 1e9:
                kept.append(k)
                self._last = float(stamp)
        self._stamps.append(samples.stamp_ns[kept])
        self._values.append(samples.temperature_c[kept])

    def result(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return (stamps in ns, degrees Celsius) of all kept temperatures, None without any."""
        if not self._stamps or not sum(map(len, self._stamps)):
            return None
        return np.concatenate(self._stamps), np.concatenate(self._values)
