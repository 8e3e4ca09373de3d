"""
The first pass over a recording (short means, period, temperature, faults), and the parts at rest.

From which its noise is estimated.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from imu_calibration.allan.outliers import RestOutliers, without_outliers
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import SampleBlock, runs_of
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
Scatter and steps count as motion beyond so many of their usual (robust) deviations from the median.
"""
LEAST_GROWTH = 1.25
"""A scatter within this factor of the median is no motion, however regular it is otherwise."""
FROZEN = 0.05
"""Share of chunks without any scatter from which on an output is coarse."""
SETTLING = 1.0
"""Kept out on both sides of motion, s."""
MIN_STILL_SECONDS = 2.0
"""Shortest part, s."""
STEP_WIDTHS = (1, 4, 16, 64)
"""Means of so many chunks are compared: a small step shows only against long ones."""
PERIOD_MEDIAN_CHUNKS = 41
"""Chunks among which a period is the usual one."""
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
    """First stamp that belongs to it."""
    end_ns: int
    """First stamp that does not."""
    chunks: slice
    """Its chunks."""

    @property
    def seconds(self) -> float:
        """Length, s."""
        return (self.end_ns - self.first_ns) * 1e-9


LEFT_OUT = ('motion', 'short_rests', 'other_sampling_rate', 'frozen_output')
"""
Reasons for which seconds are not used: motion and the time around it, pieces too short, another
sampling rate, one reading again and again.
"""


def still_parts(
    chunks: Chunks, period: float, resolution: np.ndarray
) -> tuple[list[StillPart], dict[str, float]]:
    """
    Return the parts at rest, and the seconds that were left out for each reason of `LEFT_OUT`.

    Parameters
    ----------
    chunks : Chunks
        Of one epoch of the clock.
    period : float
        Usual time between samples, s.
    resolution : array, shape (6,)
        Smallest step between readings of each column.

    """
    frozen = np.logical_or(*frozen_chunks(chunks, resolution).values())
    seconds = float(np.median(chunks.duration)) if len(chunks) else 0.0
    same = _at_the_usual_rate(chunks, period)
    # frozen chunks have no scatter: with them nothing else would be as quiet as the quietest tenth
    live = chunks.select(~frozen)
    still = np.zeros(len(chunks), bool)
    still[~frozen] = _usual(live, still_chunks(live) & same[~frozen])
    margin = int(np.ceil(SETTLING / seconds)) if seconds else 0
    inner = shrunk_mask(still, margin)
    parts, short = [], 0.0
    for first, last in runs_of(inner, np.diff(chunks.time) > BRIDGE):
        part = _part(chunks, first, last)
        if part.seconds >= MIN_STILL_SECONDS:
            parts.append(part)
        else:
            short += part.seconds
    lost = {
        'motion': float(np.sum(~inner & same & ~frozen)) * seconds,
        'short_rests': short,
        'other_sampling_rate': float(np.sum(~same & ~frozen)) * seconds,
        'frozen_output': float(np.sum(frozen)) * seconds,
    }
    return parts, lost


def _at_the_usual_rate(chunks, period):
    """
    Return the chunks around which most have the usual period.

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


def _usual(chunks, still):
    """Return the chunks at rest without outliers in scatter or step."""
    if not still.any():
        return still
    scatter = np.log(np.maximum(chunks.sd, _least_scatter(chunks.sd[still])))
    usual = np.ones(len(chunks), bool)
    for column in scatter.T:
        middle, width = _centre(column[still])
        usual &= column - middle <= max(OUTLIER * width, np.log(LEAST_GROWTH))
    still = still & usual
    for width in STEP_WIDTHS:
        still = still & ~_stepping(chunks.mean, still, width)
    return still


def _least_scatter(sd):
    """
    Return the least meaningful scatter of each column.

    The quantisation steps where a coarse converter often repeats a value.
    """
    frozen = (sd == 0).mean(axis=0) > FROZEN
    return np.where(frozen, np.maximum(np.quantile(sd, 0.9, axis=0), 1e-300), 1e-300)


def _stepping(mean, still, width):
    """
    Return the chunks at which the means before and after differ unusually.

    The means of `width` chunks before and after differ by more than they usually do.
    """
    from scipy.ndimage import maximum_filter1d  # here, because its import is slow

    sums, count = (
        np.cumsum(np.concatenate([np.zeros((1, values.shape[1])), values]), axis=0)
        for values in (np.where(still[:, None], mean - mean[0], 0.0), still[:, None].astype(float))
    )
    whole = (count[width:] - count[:-width])[:, 0] == width
    means = (sums[width:] - sums[:-width]) / width
    step = np.abs(means[width:] - means[:-width])
    rests = whole[width:] & whole[:-width]
    found = np.zeros(len(still), bool)
    if rests.sum() < 4 * width:
        return found
    for column in step.T:
        size = np.where(rests, column, 0.0)
        usual = 1.4826 * np.median(column[rests])
        peaks = (
            (size > OUTLIER * usual) & (size == maximum_filter1d(size, 2 * width + 1)) & (usual > 0)
        )
        for peak in np.flatnonzero(peaks):
            margin = max(width // 8, 1)
            found[peak + width - margin : peak + width + margin] = True
    return found


def _centre(values):
    """Return the median and the robust standard deviation."""
    middle = np.median(values)
    return middle, 1.4826 * np.median(np.abs(values - middle))


def _part(chunks, first, last):
    begin = chunks.time[first] - 0.5 * chunks.duration[first]
    end = chunks.time[last - 1] + 0.5 * chunks.duration[last - 1]
    return StillPart(
        chunks.first_ns + round(begin * 1e9),
        chunks.first_ns + round(end * 1e9),
        slice(int(first), int(last)),
    )


MAX_STILL_CHUNKS = 1_000_000
"""Chunks, nearly three days."""


@dataclass(frozen=True, eq=False)
class Survey:
    """Summary of a recording."""

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
    """Sensor with readings that cannot be used -> why, where the other one can be used."""


def survey(blocks: Iterable[SampleBlock], nominal: RawReadings | None = None) -> Survey:
    """
    Read a recording once.

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
    for cleaned in without_outliers(cleaner.all_of(blocks), outliers):
        for epoch, imu in cleaned.imu:
            frame_id = frame_id or imu.frame_id
            columns = np.concatenate([imu.force_s.T, imu.rate_s.T])
            series.setdefault(epoch, ChunkSeries(CHUNK_SECONDS, MAX_STILL_CHUNKS)).push(
                imu.stamp_ns, columns
            )
        for _, warmth in cleaned.temperature:
            temperature.push(warmth)
    dropped = Counter(cleaner.lost)
    dropped.update(
        {
            reason: count
            for reason, count in preflight.streams['imu'].dropped.items()
            if reason != 'clock reset'
        }
    )
    if outliers.replaced:
        dropped['outlier'] = outliers.replaced
    epochs = [item.chunks() for _, item in sorted(series.items())]
    return Survey(
        epochs,
        _period(epochs),
        temperature.result(),
        preflight.findings,
        preflight.resolution,
        dropped,
        frame_id,
        absent=preflight.streams['imu'].absent,
        unusable=preflight.unusable,
    )


def _period(epochs):
    """
    Return the period of most chunks.

    The mean of those near the median, since stamps may be rounded to milliseconds. Near the median
    step between stamps, where such chunks exist: dropped outliers lengthen the others.
    """
    steps = (
        np.concatenate([chunks.duration / chunks.size for chunks in epochs])
        if epochs
        else np.zeros(0)
    )
    if not len(steps):
        return 0.0
    middle = np.median(steps)
    usual_step = np.median(np.concatenate([chunks.step for chunks in epochs]))
    if np.mean(np.abs(steps / usual_step - 1.0) < SAME_PERIOD) > USUAL_STEP_SHARE:
        middle = usual_step
    # Without rounding errors in the file.
    return float(f'{np.mean(steps[np.abs(steps / middle - 1.0) < SAME_PERIOD]):.9g}')


class _Thinned:
    """Temperatures not closer than a chunk."""

    def __init__(self):
        self._stamps = []
        self._values = []
        self._last = -np.inf

    def push(self, samples):
        keep = []
        for k, stamp in enumerate(samples.stamp_ns):
            if abs(float(stamp) - self._last) >= CHUNK_SECONDS * 1e9:
                keep.append(k)
                self._last = float(stamp)
        self._stamps.append(samples.stamp_ns[keep])
        self._values.append(samples.temperature_c[keep])

    def result(self):
        if not self._stamps or not sum(map(len, self._stamps)):
            return None
        return np.concatenate(self._stamps), np.concatenate(self._values)
