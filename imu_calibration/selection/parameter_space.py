"""From columns to parameters: each window's contribution to a linear problem in the parameters of everything that is asked."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Sequence

import numpy as np

from imu_calibration.effects.base import SENSORS, Effect
from imu_calibration.effects.forward_equations import coefficient_jacobian
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.selection.questions import Question, special
from imu_calibration.selection.reduced_recording import ReducedRecording

BANK_PRIOR_SD = {'accelerometer': 0.5, 'gyroscope': 0.05}
"""Of the amplitudes of warm-ups, m/s^2 and rad/s."""


@dataclass(frozen=True, eq=False)
class ParameterSpace:
    """
    A reduced recording in the parameters that are asked about: those of the extended model, then the banks of warm-ups (time constant
    by axis, per sensor).

    Rows are ``[design | residual]`` of one axis; all their columns act on that axis.
    """

    recording: ReducedRecording
    """The recording."""
    names: tuple[str, ...]
    """Parameter names."""
    prior_sd: np.ndarray
    """Prior standard deviations, shape (q,)."""
    prior_mean: np.ndarray
    """Prior minus the values of the linearisation, shape (q,)."""
    index: dict[str, list[np.ndarray]]
    """Sensor -> the parameters that act on each axis."""
    join: dict[str, list[np.ndarray]]
    """Sensor -> per axis the matrix that turns ``[columns | residual]`` of three axes into ``[design | residual]``, shape (p + 3, q_a + 1)."""
    slow_only: dict[str, np.ndarray] = field(default_factory=lambda: {sensor: np.zeros(3, bool) for sensor in SENSORS})
    """Sensor -> whether only the slow part of the centred rows is compared, shape (3,)."""
    slow_variance: dict[str, np.ndarray] = field(default_factory=lambda: {sensor: np.zeros(3) for sensor in SENSORS})
    """Sensor -> variance of the white noise that then stands in for the fast part, shape (3,)."""

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.names)

    def places(self, sensor: str, axis: int) -> np.ndarray:
        """Return where the rows of an axis stand in a normal matrix of all parameters, shape (q_a + 1,)."""
        return np.append(self.index[sensor][axis], self.size)

    def reduced(self, used: Sequence[int], values: np.ndarray) -> np.ndarray:
        """Return the vector that turns rows of all parameters into residuals at `values` of those `used`, shape (q + 1,)."""
        found = np.zeros(self.size + 1)
        found[list(used)], found[-1] = -values, 1.0
        return found

    @cached_property
    def mean(self) -> dict[str, list[np.ndarray]]:
        """Sensor -> mean rows of the windows for each axis, shape (k, q_a + 1)."""
        return {sensor: [self.recording.mean(sensor) @ join for join in self.join[sensor]] for sensor in SENSORS}

    def within_each(self, sensor: str, axis: int, rows: np.ndarray, part: str | None = None) -> np.ndarray:
        """
        Return the products of the centred rows of each of the windows `rows` (mask), shape (k, q_a + 1, q_a + 1).

        `part` 'within' or 'slow'; without it what is compared on that axis.
        """
        return self._joined(sensor, axis, part, lambda products: products[rows], np.flatnonzero(rows))

    def within_sum(self, sensor: str, axis: int, rows: np.ndarray, part: str | None = None) -> np.ndarray:
        """Return the sum of `within_each`, shape (q_a + 1, q_a + 1)."""
        return self._joined(sensor, axis, part, lambda products: products[rows].sum(axis=0, keepdims=True), rows)[0]

    def squares_within(self, sensor: str, axis: int, weights: np.ndarray) -> np.ndarray:
        """Return the sum of squares of the centred rows of each window times `weights`, shape (k,)."""
        columns = self.join[sensor][axis] @ weights
        return np.maximum(np.einsum('kij,i,j->k', self.recording.products[sensor, 'within'], columns, columns, optimize=True), 0.0)

    def _joined(self, sensor, axis, part, pick, rows):
        slow_only = part is None and self.slow_only[sensor][axis]
        join = self.join[sensor][axis]
        found = join.T @ (pick(self.recording.products[sensor, 'slow' if slow_only else part or 'within']) @ join)
        if slow_only:
            missing = np.maximum(self.recording.count - np.maximum(self.recording.slow_rows, 1), 0.0)
            found[:, -1, -1] += self.slow_variance[sensor][axis] * (missing[rows] if rows.dtype != bool else missing[rows].sum())
        return found


def parameter_space(recording: ReducedRecording, baseline: SensorModel) -> ParameterSpace:
    """
    Return the ParameterSpace of a recording: the Jacobian of the coefficients joins columns to parameters.

    Parameters of the baseline count from the values of the linearisation; those of all other effects from nothing, so that an
    effect that is left out is absent even where the columns were taken with it.

    Parameters
    ----------
    recording : ReducedRecording
    baseline : SensorModel
        The model that is asked what it lacks.

    """
    model, n_bank = recording.model, len(recording.constants)
    prior, sd = model.prior()
    for effect in model.effects:
        if effect.name.endswith('_bias_drift'):
            prior[model.slices[effect.sensor, effect.name]][-1] = recording.values[model.slices[effect.sensor, effect.name]][-1]
    in_baseline = counted_from_values(model, baseline)
    shift = np.where(in_baseline, prior - recording.values, prior)
    removed = np.where(in_baseline, 0.0, recording.values)
    names = [*model.param_names, *(f'{sensor}_warm_up.{k}.{axis}' for sensor in SENSORS for k in range(n_bank) for axis in 'xyz')]
    index, join = {}, {}
    for number, sensor in enumerate(SENSORS):
        parts = [_join(model, sensor, axis, recording, removed, number) for axis in range(3)]
        index[sensor], join[sensor] = map(list, zip(*parts))
    bank_sd = np.repeat([BANK_PRIOR_SD[sensor] for sensor in SENSORS], 3 * n_bank)
    return ParameterSpace(recording, tuple(names), np.concatenate([sd, bank_sd]), np.concatenate([shift, np.zeros(6 * n_bank)]), index, join)


def _join(model, sensor, axis, recording, removed, number):
    """Return (parameters that act on an axis, matrix that joins columns to them)."""
    n_bank, n_model = len(recording.constants), len(model.param_names)
    jacobian = coefficient_jacobian(model, sensor, recording.values)[:, axis]
    p = len(jacobian)
    full = np.zeros((p + n_bank + 3, n_model + 6 * n_bank + 1))
    full[:p, :n_model] = jacobian
    full[p + np.arange(n_bank), n_model + 3 * n_bank * number + 3 * np.arange(n_bank) + axis] = 1.0
    full[:p, -1] = jacobian @ removed
    full[p + n_bank + axis, -1] = 1.0
    used = np.flatnonzero(np.any(full[:, :-1] != 0, axis=0))
    return used, full[:, np.append(used, -1)]


def counted_from_values(model: SensorModel, baseline: SensorModel) -> np.ndarray:
    """Return a mask of the parameters that count from the linearisation: the baseline's, and time constants of warm-ups."""
    masks = [np.full(e.size, (e.sensor, e.name) in baseline.slices) for e in model.effects]
    for effect, mask in zip(model.effects, masks):
        if effect.name.endswith('_bias_drift'):
            mask[-1] = True
    return np.concatenate(masks)


def questions(space: ParameterSpace, effects: Sequence[Effect]) -> list[Question]:
    """Return a Question for each effect; a warm-up gives one per time constant of the bank."""
    model, constants = space.recording.model, space.recording.constants
    n_bank, n_model = len(constants), len(model.param_names)
    asked = []
    for effect in effects:
        if (effect.sensor, effect.name) in model.slices:
            part = model.slices[effect.sensor, effect.name]
            asked.append(Question(effect, tuple(range(part.start, part.stop)), effect.size, effect.name))
        elif special(effect) and effect.name.endswith('_bias_drift'):
            first = n_model + 3 * n_bank * SENSORS.index(effect.sensor)
            for k in range(n_bank):
                asked.append(Question(effect, tuple(range(first + 3 * k, first + 3 * k + 3)), 4, f'{effect.name}@{k}'))
    return asked


def smooth_parameters(asked: Sequence[Question]) -> dict[str, list[tuple[int, ...]]]:
    """Return sensor -> list of the parameters of effects that are smooth in time: thermal bias and warm-ups."""
    smooth = [q for q in asked if q.name.endswith(('_thermal_bias', '_bias_drift'))]
    return {sensor: [q.parameters for q in smooth if q.sensor == sensor] for sensor in SENSORS}
