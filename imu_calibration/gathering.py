"""From a stream of samples to a least-squares system: one recording at a time, to be merged."""

from dataclasses import dataclass, field, replace

import numpy as np

from imu_calibration.least_squares import Accumulator
from imu_calibration.preflight import Preflight
from imu_calibration.samples import SampleBlock
from imu_calibration.sensor_model import SensorModel
from imu_calibration.settings import WindowSettings
from imu_calibration.window_statistics import WindowStatistics, reduce_window

KEPT_SAMPLES = 200_000
"""Samples of moving windows kept for plots and for the autocorrelation of residuals."""
KEPT_STATISTICS = 2000
"""Windows whose full statistics are kept for residuals per window."""


@dataclass(eq=False)
class Gathered:
    """What a recording leaves behind."""

    accumulator: Accumulator = field(default_factory=Accumulator)
    """The least-squares system."""
    windows: list = field(default_factory=list)
    """Reduced windows with their centred rows, the first KEPT_STATISTICS of them."""
    kept: list = field(default_factory=list)
    """Windows with all samples, as far as KEPT_SAMPLES reaches."""
    poses: list = field(default_factory=list)
    """(time, session, joint positions) of each static window."""
    counts: dict = field(default_factory=dict)
    """Samples used and dropped, gaps, by reason."""
    frame_id: str = ''
    """Frame of the first IMU message."""
    first_stamp_ns: int | None = None
    """First IMU stamp."""
    last_stamp_ns: int | None = None
    """Last IMU stamp."""
    largest_rate: float = 0.0
    """Largest rate of the reference, rad/s."""
    largest_force: float = 0.0
    """Largest measured component of specific force, m/s^2."""
    temperature_c: tuple | None = None
    """Lowest and highest temperature."""
    findings: tuple = ()
    """What a look at the recording found before anything was estimated (`preflight.Finding`)."""

    @property
    def duration(self):
        """Seconds from the first to the last IMU stamp, recordings added."""
        return 0.0 if self.first_stamp_ns is None else (self.last_stamp_ns - self.first_stamp_ns) * 1e-9


@dataclass(frozen=True)
class NominalScaling:
    """Nominal conversion of volts or counts to SI: ``SI = (reading - offset) / scale``."""

    accelerometer_offset: float = 0.0
    """Reading at zero specific force."""
    accelerometer_scale: float = 1.0
    """Reading per m/s^2."""
    gyroscope_offset: float = 0.0
    """Reading at zero rate."""
    gyroscope_scale: float = 1.0
    """Reading per rad/s."""

    def apply(self, imu):
        """Return the samples in SI."""
        return replace(imu, force_s=(imu.force_s - self.accelerometer_offset) / self.accelerometer_scale,
                       rate_s=(imu.rate_s - self.gyroscope_offset) / self.gyroscope_scale)


class Collector:
    """Feeds blocks to the window finder and reduces what it finds; the same object serves bags and live topics."""

    def __init__(self, table, model: SensorModel, settings=WindowSettings(), nominal=None, session=0, keep=True):
        from imu_calibration.windows import MotionGatherer
        self.table, self.model, self.nominal, self.session, self.keep = table, model, nominal, session, keep
        self.gatherer = MotionGatherer(table, settings)
        self.gathered = Gathered()
        self._adapter_drops = {}

    def push(self, block: SampleBlock):
        """Take a block and return the windows that it completed."""
        for reason, count in (block.dropped or {}).items():
            self._adapter_drops[reason] = self._adapter_drops.get(reason, 0) + count
        if block.imu is not None and len(block.imu):
            if self.nominal is not None:
                block = replace(block, imu=self.nominal.apply(block.imu))
            self._note_imu(block.imu)
        if block.temperature is not None and len(block.temperature):
            self._note_temperature(block.temperature.temperature_c)
        return self._take(self.gatherer.push(block))

    def finish(self):
        """Close the last window and return what was gathered."""
        self._take(self.gatherer.finish())
        self.update_counts()
        return self.gathered

    def update_counts(self):
        """Bring the counts up to date."""
        counts = dict(self.gatherer.counts)
        for reason, count in self._adapter_drops.items():
            counts[reason] = counts.get(reason, 0) + count
        self.gathered.counts = counts

    def _note_imu(self, imu):
        found = self.gathered
        if found.first_stamp_ns is None:
            found.first_stamp_ns, found.frame_id = int(imu.stamp_ns[0]), imu.frame_id
        found.last_stamp_ns = max(int(imu.stamp_ns[-1]), found.last_stamp_ns or 0)

    def _note_temperature(self, temperature_c):
        finite = temperature_c[np.isfinite(temperature_c)]
        if len(finite):
            low, high = self.gathered.temperature_c or (np.inf, -np.inf)
            self.gathered.temperature_c = (float(min(low, finite.min())), float(max(high, finite.max())))

    def _take(self, windows):
        return [self._reduce(window) for window in windows if window.kind != 'unused']

    def _reduce(self, window):
        reduced = reduce_window(window, self.model, self.table, self.session)
        found = self.gathered
        found.accumulator.add(reduced)
        found.largest_force = max(found.largest_force, float(np.max(np.abs(window.force_s))))
        if window.kind == 'static':
            found.poses.append((reduced.time, self.session, np.array(window.motion.position[0])))
            del found.poses[:-KEPT_STATISTICS]
        else:
            found.largest_rate = max(found.largest_rate, float(np.sqrt((window.rate_s**2).sum(axis=1).max())))
        if self.keep:
            self._store(window, reduced)
        return reduced

    def _store(self, window, reduced: WindowStatistics):
        found = self.gathered
        if len(found.windows) < KEPT_STATISTICS:
            found.windows.append(reduced)
        if window.kind != 'static' and sum(len(w.time) for w in found.kept) + len(window.time) <= KEPT_SAMPLES:
            found.kept.append(window)


def gather(blocks, table, model, settings=WindowSettings(), nominal=None, session=0, keep=True, progress=None):
    """
    Reduce one recording to a `Gathered`: the map step of calibration.

    Parameters
    ----------
    blocks : iterable of SampleBlock
        The recording in file order.
    progress : callable, optional
        Called with the number of IMU samples read so far.

    Raises
    ------
    InputError
        At the end of the recording, when it cannot give a right result (`preflight`).

    """
    collector, count = Collector(table, model, settings, nominal, session, keep), 0
    preflight = Preflight(table.gravity_value, nominal)
    for block in preflight.watch(blocks):
        collector.push(block)
        count += 0 if block.imu is None else len(block.imu)
        if progress is not None:
            progress(count)
    gathered = collector.finish()
    gathered.findings = preflight.findings
    return gathered


def merge(parts):
    """Join what several recordings left behind: the merge step of calibration."""
    parts = list(parts)
    total = parts[0]
    for part in parts[1:]:
        total.accumulator.merge(part.accumulator)
        total.windows = (total.windows + part.windows)[:KEPT_STATISTICS]
        total.kept, total.poses = _within_reach(total.kept + part.kept), total.poses + part.poses
        total.counts = {key: _added(total.counts.get(key, 0), part.counts.get(key, 0)) for key in {**total.counts, **part.counts}}
        total.largest_rate = max(total.largest_rate, part.largest_rate)
        total.largest_force = max(total.largest_force, part.largest_force)
        total.frame_id = total.frame_id or part.frame_id
        total.findings += part.findings
        ranges = [r for r in (total.temperature_c, part.temperature_c) if r]
        total.temperature_c = (min(r[0] for r in ranges), max(r[1] for r in ranges)) if ranges else None
        if part.first_stamp_ns is not None:
            total.first_stamp_ns = part.first_stamp_ns if total.first_stamp_ns is None else total.first_stamp_ns
            total.last_stamp_ns = (total.last_stamp_ns or total.first_stamp_ns) + part.last_stamp_ns - part.first_stamp_ns
    return total


def _within_reach(windows):
    """Return the windows up to KEPT_SAMPLES samples."""
    ends = np.cumsum([len(window.time) for window in windows])
    return windows[:int(np.searchsorted(ends, KEPT_SAMPLES, side='right'))]


def _added(a, b):
    return a + b if isinstance(a, (int, float)) and isinstance(b, (int, float)) else a or b


def restrict(accumulator, wide, narrow):
    """Return the accumulator with only the columns that the model `narrow` needs, from one made with the model `wide`."""
    chosen = {}
    for sensor in ('accelerometer', 'gyroscope'):
        index, start = {}, 0
        for name, width in wide.groups(sensor):
            index[name] = np.arange(start, start + width)
            start += width
        chosen[sensor] = np.concatenate([index[name] for name, _ in narrow.groups(sensor)] + [np.arange(start, start + 3)])
    small = Accumulator(samples=dict(accumulator.samples), windows=dict(accumulator.windows), slow_rows=dict(accumulator.slow_rows))
    small.within, small.slow = ({(sensor, kind): factor[:, chosen[sensor]] for (sensor, kind), factor in factors.items()}
                                for factors in (accumulator.within, accumulator.slow))
    small.rows = [restricted_window(row, chosen) for row in accumulator.rows]
    return small


def restricted_window(window, chosen):
    """Return a reduced window with the columns `chosen` (sensor -> indices) only."""
    sensors = {name: replace(s, mean=s.mean[chosen[name]], within=s.within[:, chosen[name]]) for name, s in window.sensors.items()}
    return replace(window, sensors=sensors)
