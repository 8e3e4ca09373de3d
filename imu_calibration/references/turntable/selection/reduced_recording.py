"""
A recording reduced to factors: columns at a bank of time constants, windows of the recent past.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product

import numpy as np

from imu_calibration.core.progress import report
from imu_calibration.effects.base import SENSORS, Effect
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
class BankEntry:
    """One effect at one time constant."""

    effect: Effect
    """It."""
    number: int
    """Number of the time constant."""
    point: dict
    """Point of linearisation."""
    used: tuple
    """(ColumnGroup, columns that the amplitudes multiply), ..."""
    slopes: np.ndarray
    """d(coefficients) / d(amplitudes), shape (n_columns, 3, n_amplitudes)."""
    label: str
    """Effect name and number of the time constant."""

    @property
    def param_names(self) -> list[str]:
        """Names of the amplitudes."""
        return [
            f'{self.label}.{component}'
            for component in self.effect.amplitudes(self.effect.components)
        ]

    @property
    def prior_sd(self) -> np.ndarray:
        """Standard deviations of the amplitudes before any data."""
        return BANK_PRIOR_RATIO * self.effect.amplitudes(self.effect.prior_sds())

    def columns(self, ref: Reference) -> np.ndarray:
        """Return the columns that the amplitudes multiply, shape (n, n_columns)."""
        return np.concatenate(
            [group.columns(ref, self.point)[:, rows] for group, rows in self.used], axis=1
        )


def make_bank(
    effects: Sequence[Effect], constants: np.ndarray, model: SensorModel, *, values: np.ndarray
) -> dict[str, list[BankEntry]]:
    """
    Return sensor -> list of BankEntry for the `effects` that have a time constant.

    They are taken at `values` of a model for the rest of the sensor.
    """
    bank: dict[str, list[BankEntry]] = {sensor: [] for sensor in SENSORS}
    for effect in effects:
        if effect.time_constant:
            bank[effect.sensor] += [
                _entry(effect, number, constant, model, values)
                for number, constant in enumerate(constants)
            ]
    return bank


def columns_with_bank(
    references: References, sensor: str, bank: dict[str, list[BankEntry]]
) -> np.ndarray:
    """Return the columns of `sensor` in the model of `references`, and those of the bank."""
    return np.concatenate(
        [
            columns(references, sensor),
            *(entry.columns(references.at(sensor)) for entry in bank[sensor]),
        ],
        axis=1,
    )


def _entry(
    effect: Effect, number: int, constant: float, model: SensorModel, values: np.ndarray
) -> BankEntry:
    own = effect.at_time_constant(constant)
    point = {**model.full_point(), effect.name: own}
    slopes = effect_slopes(
        effect, {**model.values_of(effect.sensor, values), effect.name: own}, point
    )[1]
    amplitudes = {
        name: effect.amplitudes(np.moveaxis(block, -1, 0)) for name, block in slopes.items()
    }
    used = [
        (group, np.flatnonzero(np.any(amplitudes[group.name] != 0, axis=(0, 2))))
        for group in effect.groups
    ]
    joined = np.concatenate([amplitudes[group.name][:, rows] for group, rows in used], axis=1)
    return BankEntry(
        effect, number, point, tuple(used), np.moveaxis(joined, 0, -1), f'{effect.name}@{number}'
    )


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
    Windows of one recording as statistics, and residuals at a point.

    The statistics are of ``[columns of the model | bank of time constants | output]``.
    """

    model: SensorModel
    """Model of all candidate effects, linearised at its point."""
    values: np.ndarray
    """Parameters that residuals belong to."""
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
        """Short pieces of each window, shape (k,)."""
        (sensor, *_) = self.sensors
        return np.array([window.sensors[sensor].slow_rows for window in self.windows])

    @property
    def period(self) -> float:
        """Typical time from sample to sample, s."""
        return float(
            np.median([max(window.duration, 1e-3) / window.count for window in self.windows])
        )

    def mean(self, sensor: str) -> np.ndarray:
        """Return the mean rows ``[columns | residual]``, shape (k, p + 3)."""
        return self._with_residual(
            sensor, np.array([window.sensors[sensor].mean for window in self.windows])
        )

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
        for at in range(0, len(chosen), UNPACKED_WINDOWS):
            some = chosen[at : at + UNPACKED_WINDOWS]
            yield (
                some,
                self._with_residual(
                    sensor,
                    unpacked([self.factors[sensor, part][k] for k in some], self._width(sensor)),
                ),
            )

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
        return len(self.windows[0].sensors[sensor].mean)

    @cached_property
    def _sums(self) -> Recent:
        return Recent(MOST_SUMS)

    @cached_property
    def _coefficients(self) -> dict[str, np.ndarray]:
        return {sensor: coefficients(self.model, sensor, self.values) for sensor in self.sensors}

    def _with_residual(self, sensor: str, rows: np.ndarray) -> np.ndarray:
        own = self._coefficients[sensor]
        rows[..., -3:] -= rows[..., : len(own)] @ own
        return rows

    def rebased(self, values: np.ndarray) -> 'ReducedRecording':
        """
        Return the same recording with the residual of other `values`.

        The point of linearisation is unchanged.
        """
        return replace(self, values=values)

    def select(self, rows: np.ndarray) -> 'ReducedRecording':
        """Return the recording of the windows `rows` (mask) alone."""
        chosen = np.flatnonzero(rows)
        factors = {}
        for key, each in self.factors.items():
            factors[key] = [each[k] for k in chosen]
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
    reduced = []
    factors: dict[tuple[str, str], list[np.ndarray]] = {
        key: [] for key in product(sensors_of(windows), FACTOR_PARTS)
    }
    for some in chunks(windows):
        for window in reduce_windows(
            some, model, table, column_function=partial(columns_with_bank, bank=bank)
        ):
            for (sensor, part), kept in factors.items():
                factor = getattr(window.sensors[sensor], part)
                kept.append(np.zeros(0) if factor is None else packed(factor))
            bare = {}  # without the factors, which are kept packed
            for sensor, known in window.sensors.items():
                bare[sensor] = replace(known, within=known.within[:0].copy(), slow=None)
            reduced.append(replace(window, sensors=bare))
        report(REDUCING, len(reduced), len(windows))
    descriptions = [_describe(window) for window in windows]
    describe = {}
    for name in descriptions[0]:
        describe[name] = np.array([description[name] for description in descriptions])
    return ReducedRecording(model, values, bank, tuple(reduced), factors, describe)


def _describe(window: Window) -> dict[str, float]:
    motion = window.motion
    found = {
        'time': float(window.time.mean()),
        'specific force': float(np.linalg.norm(window.force_s.mean(axis=0))),
        'temperature': (
            np.nan if window.temperature_c is None else float(window.temperature_c.mean())
        ),
        'rate': float(np.sqrt((motion.rate**2).sum(axis=1).mean())),
    }
    for joint in range(motion.position.shape[1]):
        found[f'angle{joint}'] = float(motion.position[:, joint].mean())
        found[f'span{joint}'] = float(np.ptp(motion.position[:, joint]))
    return found


def mean_arms(model: SensorModel, values: np.ndarray) -> np.ndarray:
    """
    Return the mean lever arm of the accelerometers for each of them, zero where a model has none.

    Shape (3, 3).

    Their differences change the derivative of a delay little where they are millimetres, and
    distort it where a recording does not determine them and they are estimated as centimetres.
    """
    return np.tile(all_arms(model, values).mean(axis=0), (3, 1))
