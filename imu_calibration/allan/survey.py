"""The first pass over a recording: short means, the period, the temperature, and faults."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from imu_calibration.preflight.checks import Preflight
from imu_calibration.preflight.chunks import Chunks, ChunkSeries
from imu_calibration.samples import NominalScaling, SampleBlock
from imu_calibration.segmentation.block_cleaning import BlockCleaner

CHUNK_TIME = 0.25
"""s; also the distance at which temperatures are kept."""
CAPACITY = 1_000_000
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
    dropped: Counter = field(default_factory=Counter)
    """Reason -> messages that could not be used."""
    frame_id: str = ''
    """Frame of the messages."""


def survey(blocks: Iterable[SampleBlock], nominal: NominalScaling | None = None) -> Survey:
    """
    Read a recording once.

    Raises
    ------
    InputError
        When something makes the result wrong, such as other units.

    """
    preflight = Preflight()
    cleaner = BlockCleaner(nominal=nominal, watchers=[preflight])
    series: dict[int, ChunkSeries] = {}
    temperature, frame_id = _Thinned(), ''
    for cleaned in cleaner.all_of(blocks):
        for epoch, imu in cleaned.imu:
            frame_id = frame_id or imu.frame_id
            columns = np.concatenate([imu.force_s.T, imu.rate_s.T])
            series.setdefault(epoch, ChunkSeries(CHUNK_TIME, CAPACITY)).push(imu.stamp_ns, columns)
        for _, warmth in cleaned.temperature:
            temperature.push(warmth)
    dropped = Counter(cleaner.lost)
    dropped.update({reason: count for reason, count in preflight.streams['imu'].dropped.items() if reason != 'clock reset'})
    epochs = [item.chunks() for _, item in sorted(series.items())]
    return Survey(epochs, _period(epochs), temperature.result(), preflight.findings, dropped, frame_id)


def _period(epochs):
    """Return the period of most chunks: the mean of those near the median, since stamps may be rounded to milliseconds."""
    steps = np.concatenate([chunks.duration / chunks.size for chunks in epochs]) if epochs else np.zeros(0)
    if not len(steps):
        return 0.0
    middle = np.median(steps)
    return float(f'{np.mean(steps[np.abs(steps / middle - 1.0) < 0.02]):.9g}')   # without rounding errors in the file


class _Thinned:
    """Temperatures not closer than a chunk."""

    def __init__(self):
        self._stamps, self._values, self._last = [], [], -np.inf

    def push(self, samples):
        keep = []
        for k, stamp in enumerate(samples.stamp_ns):
            if abs(float(stamp) - self._last) >= CHUNK_TIME * 1e9:
                keep.append(k)
                self._last = float(stamp)
        self._stamps.append(samples.stamp_ns[keep])
        self._values.append(samples.temperature_c[keep])

    def result(self):
        if not self._stamps or not sum(map(len, self._stamps)):
            return None
        return np.concatenate(self._stamps), np.concatenate(self._values)
