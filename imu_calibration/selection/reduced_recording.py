"""A recording reduced with the columns of all candidate effects: sufficient for candidates, folds and resamples."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Callable, Sequence

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.columns import References, columns
from imu_calibration.effects.forward_equations import all_arms, coefficients
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.accumulator import Accumulator, restricted_window, selected_columns
from imu_calibration.estimation.noise_model import sessions_of
from imu_calibration.estimation.window_statistics import WindowStatistics, reduce_windows
from imu_calibration.reference.table import Table
from imu_calibration.segmentation.window import Window, chunks
from imu_calibration.selection.time_constant_bank import BankEntry


@dataclass(frozen=True, eq=False)
class ReducedRecording:
    """Windows of one recording as statistics of ``[columns of the model | bank of time constants | output]``; residuals at a point."""

    model: SensorModel
    """Model of all candidate effects, linearised at its point."""
    values: np.ndarray
    """Parameters that residuals belong to."""
    bank: dict[str, list[BankEntry]]
    """Sensor -> effects with a time constant, at each of a bank; their columns are last."""
    windows: tuple[WindowStatistics, ...]
    """Reduced as for a calibration, kept one by one."""
    describe: dict[str, np.ndarray]
    """Window means of variables that a residual may depend on: 'time', 'temperature', joint angles, rates; each (k,)."""

    @cached_property
    def kind(self) -> np.ndarray:
        """Kind of each window, shape (k,)."""
        return np.array([window.kind for window in self.windows])

    @cached_property
    def moving(self) -> np.ndarray:
        """Whether each window has centred rows, shape (k,)."""
        return self.kind != 'static'

    @cached_property
    def time(self) -> np.ndarray:
        """Middle of each window, s, shape (k,)."""
        return np.array([window.time for window in self.windows])

    @cached_property
    def count(self) -> np.ndarray:
        """Samples of each window, shape (k,)."""
        return np.array([window.count for window in self.windows], float)

    @cached_property
    def duration(self) -> np.ndarray:
        """Length of each window, s, shape (k,)."""
        return np.array([window.duration for window in self.windows])

    @cached_property
    def keys(self) -> list[tuple[int, float]]:
        """(Recording, middle in s) of each window."""
        return [(window.session, window.time) for window in self.windows]

    @property
    def encoder_step(self) -> float:
        """Largest step of the encoders that shows in the readings, rad; 0 where none does."""
        return max((window.encoder_step for window in self.windows), default=0.0)

    @cached_property
    def slow_rows(self) -> np.ndarray:
        """Short pieces of each window, shape (k,)."""
        return np.array([window.sensors['accelerometer'].slow_rows for window in self.windows])

    @property
    def period(self) -> float:
        """Typical time from sample to sample, s."""
        return float(np.median([max(window.duration, 1e-3) / window.count for window in self.windows]))

    def mean(self, sensor: str) -> np.ndarray:
        """Return the mean rows ``[columns | residual]``, shape (k, p + 3)."""
        return self._with_residual(sensor, np.array([window.sensors[sensor].mean for window in self.windows]))

    def products_of(self, sensor: str, part: str) -> np.ndarray:
        """Return the products of the centred rows ``[columns | residual]`` of each window, shape (k, p + 3, p + 3)."""
        if (sensor, part) not in self._products:
            width = len(self.windows[0].sensors[sensor].mean)
            found = self._products[sensor, part] = np.zeros((len(self.windows), width, width))   # windows at rest have zeros
            for k, rows in self._centred(sensor, part, self.moving):
                np.matmul(rows.T, rows, out=found[k])
        return self._products[sensor, part]

    def product_sum(self, sensor: str, part: str, rows: np.ndarray) -> np.ndarray:
        """Return the sum of `products_of` over the windows `rows` (mask) without keeping them, shape (p + 3, p + 3)."""
        width = len(self.windows[0].sensors[sensor].mean)
        return sum((each.T @ each for _, each in self._centred(sensor, part, rows & self.moving)), np.zeros((width, width)))

    @cached_property
    def _products(self):
        return {}

    def _centred(self, sensor, part, rows):
        """Yield (number, triangular factor of the centred rows with the residual) of the windows `rows` (mask)."""
        for k in np.flatnonzero(rows).tolist():
            factor = getattr(self.windows[k].sensors[sensor], part)
            if factor is not None:
                yield k, self._with_residual(sensor, factor)

    @cached_property
    def sessions(self) -> list[np.ndarray]:
        """Indices of each session's windows in order of time."""
        return sessions_of(self.windows)

    @cached_property
    def _coefficients(self):
        return {sensor: coefficients(self.model, sensor, self.values) for sensor in SENSORS}

    def _with_residual(self, sensor, rows):
        own, rows = self._coefficients[sensor], rows.copy()
        rows[..., -3:] -= rows[..., :len(own)] @ own
        return rows

    def rebased(self, values: np.ndarray) -> 'ReducedRecording':
        """Return the same recording with the residual of other `values`; the point of linearisation is unchanged."""
        moved = replace(self, values=values)
        moved.__dict__.update({name: self.__dict__[name] for name in ('kind', 'moving', 'time', 'count', 'slow_rows', 'sessions')
                               if name in self.__dict__})
        return moved

    def select(self, rows: np.ndarray) -> 'ReducedRecording':
        """Return the recording of the windows `rows` (mask) only."""
        return replace(self, windows=tuple(window for window, kept in zip(self.windows, rows) if kept),
                       describe={name: values[rows] for name, values in self.describe.items()})

    def accumulated(self, model: SensorModel) -> Accumulator:
        """Return the Accumulator of a model; its columns are a subset of this recording's."""
        chosen = selected_columns(self.model, model)
        accumulator = Accumulator()
        for window in self.windows:
            accumulator.add(restricted_window(window, chosen))
        return accumulator


def reduce_recording(windows: Sequence[Window], table: Table, model: SensorModel, *, values: np.ndarray, bank: dict[str, list[BankEntry]],
                     progress: Callable | None = None) -> ReducedRecording:
    """
    Reduce windows with the columns of a model and a bank of time constants.

    Parameters
    ----------
    windows : sequence of Window
        Static, spin and dynamic windows of one recording.
    table : Table
    model : SensorModel
    values : array, shape (n_params,)
        Parameters that residuals belong to.
    bank : dict
        Sensor -> list of BankEntry (`make_bank`).
    progress : callable, optional
        Called with the share that is done, in [0, 1].

    """
    def with_bank(model, sensor, table, motion, temperature_c=None, references: References | None = None):
        references = references or References(model, table, motion, temperature_c=temperature_c)
        ref = references.at(sensor)
        return np.concatenate([columns(model, sensor, table, motion=motion, temperature_c=temperature_c, references=references),
                               *(entry.columns(ref) for entry in bank[sensor])], axis=1)

    reduced = []
    for part in chunks(windows):
        reduced += reduce_windows(part, model, table, column_function=with_bank)
        if progress:
            progress(len(reduced) / len(windows))
    descriptions = [_describe(window) for window in windows]
    return ReducedRecording(model, values, bank, tuple(reduced),
                            {name: np.array([d[name] for d in descriptions]) for name in descriptions[0]})


def _describe(window):
    motion = window.motion
    found = {'time': float(window.time.mean()), 'specific force': float(np.linalg.norm(window.force_s.mean(axis=0))),
             'temperature': np.nan if window.temperature_c is None else float(window.temperature_c.mean()),
             'rate': float(np.sqrt((motion.rate**2).sum(axis=1).mean()))}
    for joint in range(motion.position.shape[1]):
        found[f'angle{joint}'] = float(motion.position[:, joint].mean())
        found[f'span{joint}'] = float(np.ptp(motion.position[:, joint]))
    return found


def mean_arms(model: SensorModel, values: np.ndarray) -> np.ndarray:
    """
    Return the mean lever arm of the accelerometers for each of them, zero where a model has none, shape (3, 3).

    Their differences change the derivative of a delay little where they are millimetres, and distort it where a recording does not
    determine them and they are estimated as centimetres.
    """
    return np.tile(all_arms(model, values).mean(axis=0), (3, 1))
