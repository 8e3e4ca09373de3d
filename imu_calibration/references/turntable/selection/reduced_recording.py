"""
A recording reduced to factors: columns at a bank of time constants, windows of the recent past.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import Any

import numpy as np

from imu_calibration.core.progress import report
from imu_calibration.effects.base import SENSORS, ColumnGroup, Effect
from imu_calibration.effects.forward_equations import (
    References,
    all_arms,
    coefficients,
    columns,
    effect_slopes,
)
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.rotations import Reference
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window, chunks, sensors_of
from imu_calibration.references.turntable.accumulator import (
    Accumulator,
    restricted_window,
    selected_columns,
)
from imu_calibration.references.turntable.estimation.window_means import WindowMeans
from imu_calibration.references.turntable.packed_factors import packed, unpacked
from imu_calibration.references.turntable.window_statistics import WindowStatistics, reduce_windows
from imu_calibration.selection.evidence import Recent

BANK_PRIOR_RATIO = 10.0
"""
Standard deviations of amplitudes in a bank, times the effect's own: neighbours share one curve with
opposite signs, and where the prior constrained them the estimated noise changed; from a factor of
six on it does not.
"""


@dataclass(frozen=True, eq=False)
class UsedColumns:
    """The columns of one group that an effect multiplies with its amplitudes."""

    group: ColumnGroup
    """Group of the effect."""
    indices: np.ndarray
    """Columns with a nonzero coefficient, shape (n_columns,)."""


@dataclass(frozen=True, eq=False)
class BankEntry:
    """
    One effect at one time constant: a linear model of its output.

    With the time constant fixed the output of axis i is linear in the amplitudes a::

        output_i(t) = columns(t) @ slopes[:, i, :] @ a
    """

    effect: Effect
    """Effect with a time constant."""
    number: int
    """Number of the time constant in the bank."""
    point: dict[str, Any]
    """Effect -> values at which columns are linearised; this effect at its time constant."""
    used: tuple[UsedColumns, ...]
    """Columns of each group of the effect."""
    slopes: np.ndarray
    """d(coefficients) / d(amplitudes), shape (n_columns, 3, n_amplitudes)."""

    @property
    def label(self) -> str:
        """Effect name and number of the time constant."""
        return f'{self.effect.name}@{self.number}'

    @property
    def param_names(self) -> list[str]:
        """Names of the amplitudes."""
        components = self.effect.amplitudes(self.effect.components)
        return [f'{self.label}.{component}' for component in components]

    @property
    def prior_sd(self) -> np.ndarray:
        """Standard deviations of the amplitudes before any data."""
        return BANK_PRIOR_RATIO * self.effect.amplitudes(self.effect.prior_sds())

    def columns(self, ref: Reference) -> np.ndarray:
        """Return the columns that the amplitudes multiply, shape (n, n_columns)."""
        return np.concatenate(
            [used.group.columns(ref, self.point)[:, used.indices] for used in self.used], axis=1
        )


def make_bank(
    effects: Sequence[Effect], constants: np.ndarray, model: SensorModel, *, values: np.ndarray
) -> dict[str, list[BankEntry]]:
    """
    Return sensor -> list of BankEntry for the `effects` that have a time constant.

    Each is linearised at each of the time `constants` and at the `values` of the other parameters
    of the model.
    """
    bank: dict[str, list[BankEntry]] = {sensor: [] for sensor in SENSORS}
    for effect in effects:
        if not effect.time_constant:
            continue
        for number, constant in enumerate(constants):
            bank[effect.sensor].append(_bank_entry(effect, number, constant, model, values))
    return bank


def columns_with_bank(
    references: References, sensor: str, bank: dict[str, list[BankEntry]]
) -> np.ndarray:
    """Return the columns of `sensor` in the model of `references`, and those of the bank."""
    of_model = columns(references, sensor)
    of_bank = [entry.columns(references.at(sensor)) for entry in bank[sensor]]
    return np.concatenate([of_model, *of_bank], axis=1)


def _bank_entry(
    effect: Effect, number: int, time_constant: float, model: SensorModel, values: np.ndarray
) -> BankEntry:
    """Return the entry of an effect, linearised at its prior amplitudes and a time constant."""
    effect_values = effect.at_time_constant(time_constant)
    point = {**model.full_point(), effect.name: effect_values}
    sensor_values = {**model.values_of(effect.sensor, values), effect.name: effect_values}
    _, slopes = effect_slopes(effect, sensor_values, point)

    used = []
    used_slopes = []
    for group in effect.groups:
        # Shape (width, 3, n_amplitudes): without the time constant, which is fixed.
        of_amplitudes = slopes[group.name][..., : effect.n_amplitudes]
        indices = np.flatnonzero(np.any(of_amplitudes != 0, axis=(1, 2)))
        used.append(UsedColumns(group, indices))
        used_slopes.append(of_amplitudes[indices])
    return BankEntry(effect, number, point, tuple(used), np.concatenate(used_slopes))


FACTOR_PARTS = ('within', 'slow')
"""Triangular factors of a window: of all centred rows, and of the means of short pieces."""
REDUCING = 'reducing the recording'
"""Phase of the progress."""
UNPACKED_WINDOWS = 8
"""Windows whose factors are unpacked at a time."""
MOST_SUMS = 32
"""Sums of products kept: the folds of every kind of window, for the next axis."""


@dataclass(frozen=True, eq=False)
class ReducedRecording(WindowMeans):
    """
    Windows of one recording as statistics, and their residuals at values of the parameters.

    The statistics are of ``[columns of the model | bank of time constants | output]``.
    """

    model: SensorModel
    """Model of all candidate effects, linearised at its point."""
    values: np.ndarray
    """Parameters of the model that are subtracted from the output for a residual."""
    bank: dict[str, list[BankEntry]]
    """Sensor -> effects with a time constant, at each of a bank; their columns are last."""
    windows: tuple[WindowStatistics, ...]
    """Reduced as for a calibration, kept one by one, without their triangular factors."""
    factors: dict[tuple[str, str], list[np.ndarray]]
    """
    (sensor, one of `FACTOR_PARTS`) -> triangular factor of the centred rows
    ``[columns | output]`` of each window.
    """
    describe: dict[str, np.ndarray]
    """
    Window means of variables that a residual may depend on: 'time', 'temperature', joint angles,
    rates; each (k,).
    """

    @cached_property
    def slow_rows(self) -> np.ndarray:
        """Number of short pieces of each window, shape (k,)."""
        sensor = self.sensors[0]
        return np.array([window.sensors[sensor].slow_rows for window in self.windows])

    @property
    def period(self) -> float:
        """Typical time from sample to sample, s."""
        periods = [max(window.duration, 1e-3) / window.count for window in self.windows]
        return float(np.median(periods))

    def mean(self, sensor: str) -> np.ndarray:
        """Return the mean rows ``[columns | residual]``, shape (k, p + 3)."""
        means = np.array([window.sensors[sensor].mean for window in self.windows])
        return self._with_residual(sensor, means)

    def factors_of(
        self, sensor: str, part: str, rows: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """
        Yield the triangular factors of the centred rows ``[columns | residual]``.

        Each step covers some windows at a time.

        Factors of all windows, and their products even more, would take several times the memory of
        the samples.

        Parameters
        ----------
        sensor : str
        part : str
            One of `FACTOR_PARTS`.
        rows : array, shape (k,)
            Mask of the windows; those at rest have no factor.

        Yields
        ------
        tuple
            Indices of the windows, shape (m,), and their factors, shape (m, r, p + 3); missing rows
            are zero.

        """
        chosen = np.flatnonzero(rows & self.moving)
        for first in range(0, len(chosen), UNPACKED_WINDOWS):
            indices = chosen[first : first + UNPACKED_WINDOWS]
            packed_factors = [self.factors[sensor, part][k] for k in indices]
            factors = unpacked(packed_factors, self._width(sensor))
            yield indices, self._with_residual(sensor, factors)

    def product_sum(self, sensor: str, part: str, rows: np.ndarray) -> np.ndarray:
        """
        Return the summed products of the centred rows ``[columns | residual]``.

        The sum is over the windows `rows` (mask), and the shape is (p + 3, p + 3).
        """
        key = sensor, part, rows.tobytes()
        if key not in self._sums:
            width = self._width(sensor)
            total = self._sums[key] = np.zeros((width, width))
            for _, factors in self.factors_of(sensor, part, rows):
                stacked = factors.reshape(-1, width)
                total += stacked.T @ stacked
        return self._sums[key]

    def _width(self, sensor: str) -> int:
        """Return the number of columns and outputs of a sensor, p + 3."""
        return len(self.windows[0].sensors[sensor].mean)

    @cached_property
    def _sums(self) -> Recent:
        """(sensor, part, mask of windows as bytes) -> last results of `product_sum`."""
        return Recent(MOST_SUMS)

    @cached_property
    def _coefficients(self) -> dict[str, np.ndarray]:
        """Sensor -> coefficients of the columns of the model at `values`, shape (n_columns, 3)."""
        return {sensor: coefficients(self.model, sensor, self.values) for sensor in self.sensors}

    def _with_residual(self, sensor: str, rows: np.ndarray) -> np.ndarray:
        """Return rows ``[columns | output]`` with the residual in place of the output, in place."""
        of_model = self._coefficients[sensor]
        rows[..., -3:] -= rows[..., : len(of_model)] @ of_model
        return rows

    def rebased(self, values: np.ndarray) -> 'ReducedRecording':
        """Return the recording with residuals at other `values`, columns unchanged."""
        return replace(self, values=values)

    def select(self, rows: np.ndarray) -> 'ReducedRecording':
        """Return the recording of the windows `rows` (mask) alone."""
        chosen = np.flatnonzero(rows)
        factors = {}
        for key, of_windows in self.factors.items():
            factors[key] = [of_windows[k] for k in chosen]
        return replace(
            self,
            windows=tuple(self.windows[k] for k in chosen),
            factors=factors,
            describe={name: values[rows] for name, values in self.describe.items()},
        )

    def accumulated(self, model: SensorModel) -> Accumulator:
        """Return the Accumulator of a model; its columns are a subset of this recording's."""
        chosen = selected_columns(self.model, model)
        accumulator = Accumulator()
        for k in range(len(self.windows)):
            accumulator.add(restricted_window(self._with_factors(k), chosen))
        return accumulator

    def _with_factors(self, k: int) -> WindowStatistics:
        """Return a window with its triangular factors."""
        sensors = {}
        for sensor, known in self.windows[k].sensors.items():
            factors = {}
            for part in FACTOR_PARTS:
                packed_factor = self.factors[sensor, part][k]
                factors[part] = unpacked([packed_factor], self._width(sensor))[0]
            sensors[sensor] = replace(known, **factors)
        return replace(self.windows[k], sensors=sensors)


def reduce_recording(
    windows: Sequence[Window],
    table: Table,
    model: SensorModel,
    *,
    values: np.ndarray,
    bank: dict[str, list[BankEntry]],
) -> ReducedRecording:
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

    """
    # Statistics of each window, and its factors, which are kept packed: they need most memory.
    reduced = []
    factors: dict[tuple[str, str], list[np.ndarray]] = {
        key: [] for key in product(sensors_of(windows), FACTOR_PARTS)
    }
    column_function = partial(columns_with_bank, bank=bank)
    for chunk in chunks(windows):
        for window in reduce_windows(chunk, model, table, column_function=column_function):
            for (sensor, part), kept in factors.items():
                factor = getattr(window.sensors[sensor], part)
                kept.append(np.zeros(0) if factor is None else packed(factor))
            bare = {}  # statistics without the factors
            for sensor, known in window.sensors.items():
                bare[sensor] = replace(known, within=known.within[:0].copy(), slow=None)
            reduced.append(replace(window, sensors=bare))
        report(REDUCING, len(reduced), len(windows))

    # Variables of all windows as arrays.
    descriptions = [_describe(window) for window in windows]
    describe = {}
    for name in descriptions[0]:
        describe[name] = np.array([description[name] for description in descriptions])
    return ReducedRecording(model, values, bank, tuple(reduced), factors, describe)


def _describe(window: Window) -> dict[str, float]:
    """Return the variables of `ReducedRecording.describe` of one window."""
    motion = window.motion
    temperature = np.nan
    if window.temperature_c is not None:
        temperature = float(window.temperature_c.mean())
    variables = {
        'time': float(window.time.mean()),
        'specific force': float(np.linalg.norm(window.force_s.mean(axis=0))),
        'temperature': temperature,
        'rate': float(np.sqrt((motion.rate**2).sum(axis=1).mean())),
    }
    for joint in range(motion.position.shape[1]):
        variables[f'angle{joint}'] = float(motion.position[:, joint].mean())
        variables[f'span{joint}'] = float(np.ptp(motion.position[:, joint]))
    return variables


def mean_arms(model: SensorModel, values: np.ndarray) -> np.ndarray:
    """
    Return the mean lever arm of the three accelerometers, once for each of them, shape (3, 3).

    It is zero where a model has none.

    Their differences change the derivative of a delay little where they are millimetres, and
    distort it where a recording does not determine them and they are estimated as centimetres.
    """
    return np.tile(all_arms(model, values).mean(axis=0), (3, 1))
