"""The first reading of a recording: short means of the whole of it, the period, the temperature, and what looks wrong."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from imu_calibration.preflight.checks import Preflight
from imu_calibration.preflight.chunks import Chunks, ChunkSeries
from imu_calibration.samples import NominalScaling, SampleBlock
from imu_calibration.segmentation.stream_cleaning import StreamCheck

CHUNK_TIME = 0.25
"""s; also the distance at which temperatures are kept."""
CAPACITY = 1_000_000
"""Chunks, nearly three days."""


@dataclass(frozen=True, eq=False)
class Survey:
    """What a recording holds."""

    epochs: list[Chunks]
    """Chunks of each epoch of the clock."""
    period: float
    """Time between samples, s."""
    temperature: tuple[np.ndarray, np.ndarray] | None
    """Stamps (ns) and degrees Celsius, thinned; None without."""
    findings: tuple
    """What looks wrong with the recording."""
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
    preflight, imu_check, warmth_check = Preflight(None, nominal), StreamCheck(), StreamCheck()
    series: dict[int, ChunkSeries] = {}
    dropped: Counter = Counter()
    temperature, frame_id = _Thinned(), ''
    for block in preflight.watch(blocks):
        dropped.update(block.dropped or {})
        for epoch, imu in imu_check.push(block.imu):
            frame_id = frame_id or imu.frame_id
            _push(series, epoch, imu, nominal)
        for _, warmth in warmth_check.push(block.temperature):
            temperature.push(warmth)
    for epoch, imu in imu_check.finish():
        _push(series, epoch, imu, nominal)
    dropped.update({reason: count for reason, count in imu_check.counts.items() if reason != 'clock reset'})
    epochs = [item.chunks() for _, item in sorted(series.items())]
    return Survey(epochs, _period(epochs), temperature.result(), preflight.findings, dropped, frame_id)


def _push(series, epoch, imu, nominal):
    if len(imu):
        imu = imu if nominal is None else nominal.apply(imu)
        series.setdefault(epoch, ChunkSeries(CHUNK_TIME, CAPACITY)).push(imu.stamp_ns, np.concatenate([imu.force_s.T, imu.rate_s.T]))


def _period(epochs):
    """Return the period of most chunks: the mean of those near the median, since stamps may come in whole milliseconds."""
    steps = np.concatenate([chunks.duration / chunks.size for chunks in epochs]) if epochs else np.zeros(0)
    if not len(steps):
        return 0.0
    middle = np.median(steps)
    return float(f'{np.mean(steps[np.abs(steps / middle - 1.0) < 0.02]):.9g}')   # what rounding adds does not belong into a file


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
