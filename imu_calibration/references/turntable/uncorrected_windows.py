"""Constant values that compensation applies instead of effects, from windows on a table."""

from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.document.trust import (
    Uncorrected,
    columns_at,
    constant_part,
    has_settled,
    uncorrected_size,
)
from imu_calibration.effects.base import INPUT_OF, Effect, Role
from imu_calibration.effects.expressions import ColumnCentre
from imu_calibration.effects.forward_equations import coefficients, in_time, not_applied
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.references.turntable.accumulator import Accumulator

LEAST_INPUT = {'accelerometer': 1.0, 'gyroscope': 0.1}
"""
Sensor -> rms of its true input in a direction, m/s^2 or rad/s, from which bias and matrix take the
place of an effect that compensation cannot undo: 0.1 g, and 6 deg/s.
"""


def uncorrected_on_table(
    model: SensorModel,
    values: np.ndarray,
    accumulator: Accumulator,
    *,
    gathered: SensorModel,
    latest: SensorModel | None = None,
) -> Uncorrected:
    """
    Return the errors that remain uncorrected by a calibration on a table.

    Parameters
    ----------
    model : SensorModel
        At the point of its `values`.
    values : array, shape (n_params,)
    accumulator : Accumulator
        Windows with the columns of `gathered`.
    gathered : SensorModel
    latest : SensorModel, optional
        `latest_settling`; default: `model`.

    """
    latest = latest or model
    end = end_of(accumulator)
    # The model at the time constants of the gathered columns, which are others than its own.
    gathered_at = {e.name: gathered.point_of(e) for e in model.effects if e.time_constant}
    model_of_columns = replace(model, point=model.point | gathered_at)

    centre: dict[str, ColumnCentre] = {}
    sizes = []
    for effect in not_applied(model):
        settled = has_settled(latest, effect, end)
        true_input = gathered.columns_of(effect.sensor, Role.LINEAR)
        samples = _Samples.of(accumulator, effect.sensor, true_input)
        squares = np.zeros(3)
        for group in effect.groups:
            # Constant part of a settled effect: the value at the end. Of any other one the part
            # that bias and matrix describe, moved to the time constant of the model.
            columns = gathered.layout(effect.sensor).rows[group.name]
            if settled:
                columns_at_end = columns_at(model, effect, [end])[group.name][0]
                centre_of_group = constant_part(effect, columns_at_end)
            else:
                change = values[model.slices[effect.key]] - gathered.point_of(effect)
                centre_of_group = _moved(effect, _projection(effect, columns, samples), change)
            centre[group.name] = centre_of_group

            # The output of the effect in the gathered columns, without that of the constant part.
            rows = model.layout(effect.sensor).rows[group.name]
            value = coefficients(model_of_columns, effect.sensor, values)[rows]
            applied = coefficients(model, effect.sensor, values)[rows]
            squares += samples.squares_without(columns, value, centre_of_group, applied)
        sizes.append(uncorrected_size(effect, np.sqrt(squares / samples.counts.sum()), settled))
    return Uncorrected(centre, tuple(sizes))


@dataclass(frozen=True, eq=False)
class _Samples:
    """The columns of one sensor in all windows: means, and factors of the rows about them."""

    counts: np.ndarray
    """Samples of each window, shape (n_windows,)."""
    means: np.ndarray
    """Mean rows of the windows, shape (n_windows, n_columns + 3)."""
    within: list[np.ndarray]
    """Factors of the rows about these means, each shape (k, n_columns + 3)."""
    true_input: slice
    """Columns of the true input."""

    @classmethod
    def of(cls, accumulator: Accumulator, sensor: str, true_input: slice) -> '_Samples':
        """Return the columns of a sensor in the windows of an accumulator."""
        counts = np.array([row.count for row in accumulator.rows], float)
        means = np.array([row.sensors[sensor].mean for row in accumulator.rows])
        factors = accumulator.within.items()
        within = [factor for (owner, _), factor in factors if owner == sensor]
        return cls(counts, means, within, true_input)

    def squares_without(
        self, columns: slice, value: np.ndarray, part: ColumnCentre, applied: np.ndarray
    ) -> np.ndarray:
        """
        Return the sum over all samples of squares of an effect without its constant part, (3,).

        ``columns @ value - (constant + slope @ true) @ applied`` for each axis.

        Parameters
        ----------
        columns : slice
            Columns of the effect.
        value : array, shape (width, 3)
            Their coefficients.
        part : ColumnCentre
            Constant and slope of each column.
        applied : array, shape (width, 3)
            Coefficients of the constant part.

        """
        constant = part.constant @ applied
        slope = part.slope.T @ applied
        means = self.means[:, columns] @ value - constant - self.means[:, self.true_input] @ slope
        squares = self.counts @ means**2
        for factor in self.within:
            about_mean = factor[:, columns] @ value - factor[:, self.true_input] @ slope
            squares += (about_mean**2).sum(axis=0)
        return squares


def _projection(effect: Effect, columns: slice, samples: _Samples) -> ColumnCentre:
    """
    Return the part of the columns of an effect that bias and matrix describe.

    It minimises the squares of ``column - constant - slope @ true`` over all samples. An effect in
    time only is no function of the motion and has no slope: its mean is the value in another
    session.
    """
    counts = samples.counts
    true_input = samples.true_input
    mean = counts @ samples.means / counts.sum()
    slope = np.zeros((columns.stop - columns.start, 3))
    if not in_time(effect):
        about_mean = np.sqrt(counts)[:, None] * (samples.means - mean)
        stacked = np.concatenate([about_mean, *samples.within])
        inputs = stacked[:, true_input]
        # Directions in which the sensor had no input have no slope.
        power, directions = np.linalg.eigh(inputs.T @ inputs / counts.sum())
        directions = directions[:, power > LEAST_INPUT[effect.sensor] ** 2]
        along = inputs @ directions
        slope = (directions @ np.linalg.lstsq(along, stacked[:, columns], rcond=None)[0]).T
    constant = mean[columns] - slope @ mean[true_input]
    return ColumnCentre(constant, slope, INPUT_OF[effect.sensor])


def _moved(effect: Effect, part: ColumnCentre, change: np.ndarray) -> ColumnCentre:
    """
    Return the constant part of an effect with parameters that differ from the point of its columns.

    To first order in the change of a time constant: the second half of its columns are the
    derivatives of the first half. `change`: parameters minus the point.
    """
    if not effect.time_constant:
        return part
    constant, constant_by_tau = np.split(part.constant, 2)
    slope, slope_by_tau = np.split(part.slope, 2)
    return replace(
        part,
        constant=np.concatenate([constant + change[-1] * constant_by_tau, constant_by_tau]),
        slope=np.concatenate([slope + change[-1] * slope_by_tau, slope_by_tau]),
    )


def end_of(accumulator: Accumulator) -> float:
    """Return the end of the longest recording, s since its start."""
    return max(row.time + row.duration / 2 for row in accumulator.rows)
