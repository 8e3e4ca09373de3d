"""Effects that compensation cannot undo: the constant that it applies instead, and the error that remains during the recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from imu_calibration.core.units import error_text
from imu_calibration.effects.base import UNIT, Effect
from imu_calibration.effects.forward_equations import Centre, coefficients, in_time, not_applied
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.accumulator import Accumulator
from imu_calibration.kinematics.rotations import Reference

END, MEAN = 'end of the recording', 'mean of the recording'
LAST_SHARE = 2.0 / 3.0
"""Effects in time are proven on the windows after this share of the recording: the value at its end is applied."""


@dataclass(frozen=True, eq=False)
class Uncorrected:
    """Constant values that compensation applies instead of effects that it cannot undo."""

    centre: Centre = field(default_factory=dict)
    """Column group -> values of its columns at which the effect is applied."""
    sizes: tuple[dict[str, Any], ...] = ()
    """Entries of the statistics: effect, sensor, 'applied' (`END` or `MEAN`), rms of the rest on each axis and its unit."""

    def to_mapping(self) -> dict[str, Any]:
        """Return the part of a document's statistics."""
        return {'uncorrected': [dict(entry) for entry in self.sizes]} if self.sizes else {}


def uncorrected_on_table(model: SensorModel, values: np.ndarray, accumulator: Accumulator, *, gathered: SensorModel) -> Uncorrected:
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

    """
    counts, end = np.array([row.count for row in accumulator.rows], float), end_of(accumulator)
    centre, sizes = {}, []
    for effect in not_applied(model):
        squares = np.zeros(3)
        for group in effect.groups:
            rows, own = gathered.layout(effect.sensor).rows[group.name], model.layout(effect.sensor).rows[group.name]
            means = np.array([row.sensors[effect.sensor].mean[rows] for row in accumulator.rows])
            centre[group.name] = columns_at(model, effect, [end])[group.name][0] if in_time(effect) else counts @ means / counts.sum()
            value = coefficients(model, effect.sensor, values)[own]
            squares += counts @ ((means - centre[group.name]) @ value)**2
            for (sensor, _), factor in accumulator.within.items():
                squares += ((factor[:, rows] @ value)**2).sum(axis=0) if sensor == effect.sensor else 0.0
        sizes.append(_size(effect, np.sqrt(squares / counts.sum())))
    return Uncorrected(centre, tuple(sizes))


def uncorrected_in_time(model: SensorModel, values: np.ndarray, times: Sequence[float] | np.ndarray, *,
                        end: float) -> Uncorrected:
    """Return the uncorrected part of effects in time at `times`, s, of a recording that ends at `end`."""
    centre, sizes = {}, []
    for effect in not_applied(model):
        at_end, at_times = columns_at(model, effect, [end]), columns_at(model, effect, times)
        centre |= {name: columns[0] for name, columns in at_end.items()}
        rows = model.layout(effect.sensor).rows
        rest = sum((at_times[name] - centre[name]) @ coefficients(model, effect.sensor, values)[rows[name]] for name in at_end)
        sizes.append(_size(effect, np.sqrt(np.mean(np.square(rest), axis=0))))
    return Uncorrected(centre, tuple(sizes))


def end_of(accumulator: Accumulator) -> float:
    """Return the end of the longest recording, s since its start."""
    return max(row.time + row.duration / 2 for row in accumulator.rows)


def columns_at(model: SensorModel, effect: Effect, times: Sequence[float] | np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of an effect in time at some times, s: group -> shape (n, width)."""
    nothing = np.zeros((len(times), 3))
    ref = Reference(np.asarray(times, float), np.zeros((len(times), 3, 3)), nothing, nothing, nothing, 0.0)
    return {group.name: group.columns(ref, model.full_point()) for group in effect.groups}


def _size(effect, rms):
    return {'effect': effect.name, 'sensor': effect.sensor, 'applied': END if in_time(effect) else MEAN, 'rms': rms.tolist(),
            'unit': UNIT[effect.sensor]}


def uncorrected_lines(statistics: Mapping[str, Any]) -> list[str]:
    """Return a line for each effect that compensation replaces by a constant, from the statistics of a document."""
    lines = []
    for entry in statistics.get('uncorrected') or ():
        size = error_text(max(entry['rms']), entry['unit'])
        lines.append(f'{entry["effect"]} is not corrected: the {entry["sensor"]} bias has its value at the {entry["applied"]}, '
                     f'with an error of {size} rms during the recording')
    return lines
