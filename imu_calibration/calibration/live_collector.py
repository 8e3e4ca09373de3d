"""The collector of a live calibration: samples of completed windows for residuals, a bounded store, copies for the solver."""

import copy
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from imu_calibration.calibration.collector import Collector
from imu_calibration.calibration.gathered import Gathered
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.columns import columns
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.window_statistics import joined_motion
from imu_calibration.estimation.window_store import WindowStore, owned_window
from imu_calibration.reference.table import Table
from imu_calibration.segmentation.window import Window


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
