"""From a stream of samples to a least-squares system: one recording at a time, to be merged."""

import copy
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.core.samples import NominalScaling, SampleBlock
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.columns import columns
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.window_statistics import WindowStatistics, joined_motion, reduce_window
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.block_cleaning import Watcher
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.window import Window, WindowSettings
from imu_calibration.preprocessing.window_finder import MotionGatherer
from imu_calibration.references.options import CalibrationOptions
from imu_calibration.references.turntable.gathered import KEPT_POSES, KEPT_SAMPLES, Gathered, naming
from imu_calibration.references.turntable.window_store import WindowStore, owned_window


class Collector:
    """Feeds blocks to the window finder and reduces its windows; the same object serves bags and live topics."""

    def __init__(self, table: Table, model: SensorModel, settings: WindowSettings = WindowSettings(), *,
                 nominal: NominalScaling | None = None, session: int = 0, watchers: Sequence[Watcher] = (), windows: list | None = None,
                 spread: bool = False, judged_from: float = 0.0):
        self.table, self.model, self.session, self.windows, self.spread = table, model, session, windows, spread
        self.gatherer = MotionGatherer(table, settings, windows is not None, nominal=nominal, watchers=watchers)
        self.gathered = Gathered(judged_from=judged_from)

    def push(self, block: SampleBlock) -> list[Window]:
        """Process a block and return the windows that it completed."""
        if block.imu is not None and len(block.imu):
            self._note_imu(block.imu)
        if block.temperature is not None and len(block.temperature):
            self._note_temperature(block.temperature.temperature_c)
        return self._take(self.gatherer.push(block))

    def finish(self) -> Gathered:
        """Close the last window and return the gathered data."""
        self._take(self.gatherer.finish())
        self.update_counts()
        return self.gathered

    def update_counts(self) -> None:
        """Bring the counts up to date."""
        counts = dict(self.gatherer.counts)
        for reason, count in self.gatherer.cleaner.lost.items():
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
        if self.windows is not None:
            self.windows += windows
        return [self._reduce(window) for window in windows if window.kind != 'unused']

    def _reduce(self, window):
        reduced = reduce_window(window, self.model, self.table, session=self.session, with_pieces=True,
                                column_function=self._columns(window))
        found = self.gathered
        found.take(reduced)
        found.largest_force = max(found.largest_force, float(np.max(np.abs(window.force_s))))
        if window.kind == 'static':
            found.poses.append((reduced.time, self.session, np.array(window.motion.position[0])))
            del found.poses[:-KEPT_POSES]
        else:
            found.largest_rate = max(found.largest_rate, float(np.sqrt((window.rate_s**2).sum(axis=1).max())))
        self._store(window, reduced)
        return reduced

    def _columns(self, _window):
        """Return the function that gives the columns of a window."""
        return columns

    def _store(self, window, _reduced: WindowStatistics):
        kept = self.gathered.kept
        if window.kind != 'static' and sum(len(w.time) for w in kept) + len(window.time) <= KEPT_SAMPLES:
            kept.append(window)
        if self.spread:
            self.gathered.spreads[0].add(owned_window(window))


@dataclass(frozen=True)
class GatherStep:
    """The map step with its arguments bound, so that it can be sent to another process or machine."""

    table: Table
    """The reference."""
    model: SensorModel
    """Defines the columns."""
    windows: WindowSettings = WindowSettings()
    """How windows are found."""
    nominal: NominalScaling | None = None
    """For recordings in volts or counts."""
    names: tuple = ()
    """Names of the recordings for messages; with several of them an error names the one at fault."""
    spread: bool = False
    """Whether windows are kept for the search of effects."""
    progress: Callable[[int], object] | None = None
    """Called with the number of IMU samples read so far."""
    judged_from: float = 0.0
    """Windows from this time on are judged by a proof, s."""

    def __call__(self, numbered: tuple[int, Callable]) -> Gathered:
        """Return the Gathered of a recording, given (its number, callable that yields its blocks)."""
        session, source = numbered
        return naming(self.names, session)(self.read, source(), session, Preflight(self.table.gravity_value))

    def read(self, blocks: Iterable[SampleBlock], session: int, preflight: Preflight, *, windows: list | None = None) -> Gathered:
        """
        Return the Gathered of a recording, which is read once, for its windows and for the checks.

        All windows, unused ones too, are appended to `windows`.

        Raises
        ------
        InputError
            At the end of the recording, when it cannot give a right result (`preflight`).

        """
        collector = Collector(self.table, self.model, self.windows, nominal=self.nominal, session=session, watchers=(preflight,),
                              windows=windows, spread=self.spread, judged_from=self.judged_from)
        count = 0
        for block in blocks:
            collector.push(block)
            count += 0 if block.imu is None else len(block.imu)
            if self.progress is not None:
                self.progress(count)
        gathered = collector.finish()
        gathered.findings = preflight.findings
        return gathered


def columns_at(window: Window, model: SensorModel, *, table: Table, told: slice) -> dict[str, np.ndarray]:
    """Return sensor -> columns at the samples `told` of a window."""
    motion, temperature = joined_motion([window])
    if window.kind != 'static':
        motion, temperature = motion.select(told), None if temperature is None else temperature[told]
    return {sensor: columns(model, sensor, table, motion=motion, temperature_c=temperature) for sensor in SENSORS}


class LiveCollector(Collector):
    """A Collector that hands completed windows on, with their columns at the samples `told`, and keeps a bounded number of them."""

    def __init__(self, table: Table, model: SensorModel, options: CalibrationOptions, *, session: int, store: WindowStore,
                 told: Callable[[Window], slice]):
        super().__init__(table, model, options.windows, nominal=options.nominal, session=session)
        self.store, self._told, self._completed = store, told, {}

    def _columns(self, window):
        told, designs = self._told(window), {}

        def kept(model, sensor, *arguments, **options):
            found = columns(model, sensor, *arguments, **options)
            designs[sensor] = found if window.kind == 'static' else found[told].copy()
            return found
        self._completed[window] = told, designs
        return kept

    def _store(self, window, reduced):
        kept = owned_window(window)
        self.store.add(kept, reduced)
        self.gathered.spreads[0].add(kept)

    def take_model(self, model: SensorModel) -> None:
        """Gather the columns of another model from now on; those of all kept windows are computed again."""
        self.model, self.gathered = model, self.gathered.anew(self.store.reduced(model, self.table, self.session))

    def take_completed(self) -> dict[Window, tuple[slice, dict[str, np.ndarray]]]:
        """Return the windows since the last call, each with the samples for published residuals and their columns."""
        completed, self._completed = self._completed, {}
        return completed

    def snapshot(self, pending: bool) -> tuple[Gathered, WindowStore]:
        """Return copies of the gathered data and of the store; with `pending`, open windows are closed in the copies."""
        twin = copy.copy(self)
        twin.gathered, twin.store, twin._completed = copied(self.gathered), self.store.copy(), {}
        if pending:
            twin.gatherer = copy.deepcopy(self.gatherer)
            twin.finish()
        else:
            twin.update_counts()
        return twin.gathered, twin.store


def copied(gathered: Gathered) -> Gathered:
    """Return a copy that shares only objects that are never changed in place."""
    return replace(gathered, accumulator=gathered.accumulator.copy(), held_out=gathered.held_out.copy(), poses=list(gathered.poses),
                   kept=[], counts=dict(gathered.counts), spreads=[spread.copy() for spread in gathered.spreads])
