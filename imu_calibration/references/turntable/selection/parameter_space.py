"""Parameters of a search and their columns, and normal matrices over them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from imu_calibration.effects.base import SENSORS, Effect
from imu_calibration.effects.forward_equations import coefficient_jacobian
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.rows import Rows, normal_of_rows, weights_of
from imu_calibration.references.turntable.noise_model import NoiseModel
from imu_calibration.references.turntable.selection.reduced_recording import ReducedRecording
from imu_calibration.selection.questions import Question


@dataclass(frozen=True, eq=False)
class ParameterSpace:
    """
    A reduced recording in the q parameters under test.

    The parameters of the extended model are first, then the amplitudes of the banks of time
    constants, per sensor. Rows are ``[design | residual]`` of one axis; their q_a columns are those
    of the parameters that act on the axis.
    """

    recording: ReducedRecording
    """Windows, their p columns per sensor, and the point of linearisation."""
    names: tuple[str, ...]
    """Parameter names."""
    prior_sd: np.ndarray
    """Prior standard deviations, shape (q,)."""
    prior_mean: np.ndarray
    """Prior values; of the baseline minus the values of the linearisation, shape (q,)."""
    index: dict[str, list[np.ndarray]]
    """Sensor -> the parameters that act on each axis, each of shape (q_a,)."""
    join: dict[str, list[np.ndarray]]
    """
    Sensor -> per axis the matrix that turns ``[columns | residual]`` of three axes into ``[design |
    residual]``, shape (p + 3, q_a + 1).
    """
    join_within: dict[str, list[np.ndarray]]
    """
    The same for the part within windows: zero for effects that are smooth in time, since the bias
    varies there too and the noise within is modelled as white.
    """
    slow_only: dict[str, np.ndarray] = field(
        default_factory=lambda: {sensor: np.zeros(3, bool) for sensor in SENSORS}
    )
    """Sensor -> whether only the slow part of the centred rows is compared, shape (3,)."""
    slow_variance: dict[str, np.ndarray] = field(
        default_factory=lambda: {sensor: np.zeros(3) for sensor in SENSORS}
    )
    """Sensor -> variance of the white noise that then replaces the fast part, shape (3,)."""

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors with rows: those with readings."""
        return tuple(self.index)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.names)

    def places(self, sensor: str, axis: int) -> np.ndarray:
        """
        Return the positions of the rows of an axis in a normal matrix of all parameters.

        Shape (q_a + 1,).
        """
        return np.append(self.index[sensor][axis], self.size)

    def restricted(self, kept: np.ndarray) -> 'ParameterSpace':
        """Return the space of the parameters `kept`, shape (q',), in this order."""
        # The new number of a parameter is its place in `kept`.
        new_number = np.full(self.size, -1)
        new_number[kept] = np.arange(len(kept))
        joined: dict[str, list[_Joined]] = {}
        for sensor in self.sensors:
            joined[sensor] = []
            for axis, acting in enumerate(self.index[sensor]):
                is_kept = new_number[acting] >= 0
                columns = np.append(is_kept, True)  # and the residual, which is last
                join = self.join[sensor][axis][:, columns]
                within = self.join_within[sensor][axis][:, columns]
                joined[sensor].append(_Joined(new_number[acting[is_kept]], join, within))
        return replace(
            self,
            names=tuple(self.names[k] for k in kept),
            prior_sd=self.prior_sd[kept],
            prior_mean=self.prior_mean[kept],
            **_matrices(joined),
        )

    @cached_property
    def mean(self) -> dict[str, list[np.ndarray]]:
        """Sensor -> mean rows of the windows for each axis, shape (k, q_a + 1)."""
        means = {}
        for sensor in self.sensors:
            rows = self.recording.mean(sensor)
            means[sensor] = [rows @ join for join in self.join[sensor]]
        return means

    def within_each(self, sensor: str, axis: int, rows: np.ndarray) -> Iterator[np.ndarray]:
        """
        Yield the products of the centred rows of the windows `rows` (mask), some windows at a time.

        Shape (m, q_a + 1, q_a + 1).
        """
        replacement = self._replacement_of_fast(sensor, axis)
        join = self.join_within[sensor][axis]
        compared = self._compared(sensor, axis)
        for indices, factors in self.recording.factors_of(sensor, compared, rows):
            products = join.T @ (factors.transpose(0, 2, 1) @ factors @ join)
            products[:, -1, -1] += replacement[indices]
            yield products

    def within_sum(
        self, sensor: str, axis: int, rows: np.ndarray, *, part: str | None = None
    ) -> np.ndarray:
        """
        Return the products of the centred rows of the windows `rows` (mask), summed.

        Shape (q_a + 1, q_a + 1). `part`: 'within' or 'slow'; by default the part that is compared
        on this axis, with the replacement of the fast part.
        """
        join = self.join_within[sensor][axis]
        products = self.recording.product_sum(sensor, part or self._compared(sensor, axis), rows)
        total = join.T @ products @ join
        if part is None:
            total[-1, -1] += self._replacement_of_fast(sensor, axis)[rows].sum()
        return total

    def slopes_within(self, sensor: str, axis: int, weights: np.ndarray) -> np.ndarray:
        """
        Return ``B'B w`` of the centred rows B = ``[design | residual]`` of each window.

        With the `weights` w of the residual (`weights_of`), shape (q_a + 1,), it is half of the
        slope of the sum of squares ``w'B'B w``, shape (k, q_a + 1).
        """
        recording = self.recording
        join = self.join_within[sensor][axis]
        of_columns = join @ weights
        compared = self._compared(sensor, axis)
        slopes = np.zeros((len(recording.kind), join.shape[1]))
        for indices, factors in recording.factors_of(sensor, compared, recording.moving):
            # w' J' F' F J of each window, with the factor F of its centred rows.
            slopes[indices] = ((factors @ of_columns)[:, None] @ factors)[:, 0] @ join
        return slopes

    def squares_within(self, sensor: str, axis: int, weights: np.ndarray) -> np.ndarray:
        """
        Return the sum of squares of the residual about its mean in each window, shape (k,).

        `weights`: those of the residual (`weights_of`) in each window, shape (k, q_a + 1). All
        parts of the rows count, and all effects.
        """
        recording = self.recording
        of_columns = weights @ self.join[sensor][axis].T
        squares = np.zeros(len(of_columns))
        for indices, factors in recording.factors_of(sensor, 'within', recording.moving):
            residuals = factors @ of_columns[indices, :, None]
            squares[indices] = (residuals**2).sum(axis=(1, 2))
        return squares

    def _compared(self, sensor: str, axis: int) -> str:
        """Return the part of the centred rows that is compared on an axis, of `FACTOR_PARTS`."""
        return 'slow' if self.slow_only[sensor][axis] else 'within'

    def _replacement_of_fast(self, sensor: str, axis: int) -> np.ndarray:
        """
        Return the sum of squares that replaces the fast part of each window, shape (k,).

        It is ``slow_variance (n_samples - n_pieces)``, and zero where the fast part is compared.
        """
        if not self.slow_only[sensor][axis]:
            return np.zeros(len(self.recording.count))
        n_slow = np.maximum(self.recording.slow_rows, 1)
        n_fast = np.maximum(self.recording.count - n_slow, 0.0)
        return self.slow_variance[sensor][axis] * n_fast


def parameter_space(recording: ReducedRecording, baseline: SensorModel) -> ParameterSpace:
    """
    Return the ParameterSpace of a recording, by the Jacobian of the coefficients.

    Parameters of the baseline are changes from the point of linearisation; parameters of all other
    effects are absolute, so that an omitted effect is zero even where the point of linearisation
    includes it.

    Parameters
    ----------
    recording : ReducedRecording
    baseline : SensorModel
        The model to be extended.

    """
    model = recording.model
    prior, prior_sd = model.prior()
    # A time constant has no prior of its own: it is where its columns were computed.
    for effect in model.effects:
        if effect.time_constant:
            prior[model.slices[effect.key]][-1] = recording.values[model.slices[effect.key]][-1]

    # Parameters of the baseline count from the linearisation, the other ones from zero: their
    # share of the prediction is returned to the residual.
    is_change = counted_from_values(model, baseline)
    prior_mean = np.where(is_change, prior - recording.values, prior)
    removed = np.where(is_change, 0.0, recording.values)

    # The parameters of the model, then those of the banks.
    names = list(model.param_names)
    smooth = [model.mask(lambda effect: effect.smooth)]
    sds = [prior_sd]
    for entries in recording.bank.values():
        for entry in entries:
            names += entry.param_names
            smooth.append(np.full(len(entry.param_names), entry.effect.smooth))
            sds.append(entry.prior_sd)

    joined: dict[str, list[_Joined]] = {}
    for sensor in recording.sensors:
        jacobian = coefficient_jacobian(model, sensor, recording.values)
        joined[sensor] = []
        for axis in range(3):
            joined[sensor].append(
                _join(jacobian[:, axis], sensor, axis, recording, removed, np.concatenate(smooth))
            )
    return ParameterSpace(
        recording,
        tuple(names),
        np.concatenate(sds),
        np.pad(prior_mean, (0, len(names) - len(prior_mean))),
        **_matrices(joined),
    )


def bank_places(recording: ReducedRecording) -> dict[str, slice]:
    """Return label -> parameters of each entry of the banks."""
    places = {}
    start = len(recording.model.param_names)
    for entries in recording.bank.values():
        for entry in entries:
            end = start + len(entry.param_names)
            places[entry.label] = slice(start, end)
            start = end
    return places


@dataclass(frozen=True, eq=False)
class _Joined:
    """How the p columns of a sensor, which act on three axes, become the design of one axis."""

    used: np.ndarray
    """Parameters that act on the axis, shape (q_a,)."""
    columns: np.ndarray
    """As in `ParameterSpace.join`, shape (p + 3, q_a + 1)."""
    within: np.ndarray
    """As in `ParameterSpace.join_within`, shape (p + 3, q_a + 1)."""


def _matrices(joined: dict[str, list[_Joined]]) -> dict[str, Any]:
    """Return `index`, `join` and `join_within` of a ParameterSpace."""
    index = {}
    join = {}
    join_within = {}
    for sensor, axes in joined.items():
        index[sensor] = [each.used for each in axes]
        join[sensor] = [each.columns for each in axes]
        join_within[sensor] = [each.within for each in axes]
    return {'index': index, 'join': join, 'join_within': join_within}


def _join(
    jacobian: np.ndarray,
    sensor: str,
    axis: int,
    recording: ReducedRecording,
    removed: np.ndarray,
    smooth: np.ndarray,
) -> _Joined:
    """
    Return the matrices that turn columns of a sensor into the design of one axis.

    Parameters
    ----------
    jacobian : array, shape (n_columns of the model, n_params of the model)
        Derivative of the coefficients of this axis.
    sensor : str
    axis : int
    recording : ReducedRecording
    removed : array, shape (n_params of the model,)
        Values of absolute parameters at the linearisation, whose output is added to the residual.
    smooth : array of bool, shape (q,)
        Parameters of effects that are smooth in time.

    """
    bank = recording.bank[sensor]
    places = bank_places(recording)
    n_of_model, n_params = jacobian.shape
    n_columns = n_of_model + sum(len(entry.slopes) for entry in bank)

    # Rows: columns of the model and of the banks, then the residuals of three axes.
    full = np.zeros((n_columns + 3, len(smooth) + 1))
    full[:n_of_model, :n_params] = jacobian
    start = n_of_model
    for entry in bank:
        end = start + len(entry.slopes)
        full[start:end, places[entry.label]] = entry.slopes[:, axis]
        start = end
    full[:n_of_model, -1] = jacobian @ removed
    full[n_columns + axis, -1] = 1.0

    # Within windows, effects that are smooth in time have no columns.
    within = np.where(np.append(smooth, False), 0.0, full)
    within[:n_of_model, -1] = jacobian @ np.where(smooth[:n_params], 0.0, removed)

    used = np.flatnonzero(np.any(full[:, :-1] != 0, axis=0))
    kept = np.append(used, -1)
    return _Joined(used, full[:, kept], within[:, kept])


def counted_from_values(model: SensorModel, baseline: SensorModel) -> np.ndarray:
    """
    Return a mask of the parameters of `model` that are fitted as changes from the linearisation.

    They are those of the baseline, time constants and times of steps.
    """
    counted = model.mask(lambda effect: effect.key in baseline.slices)
    for effect in model.effects:
        if effect.timed:
            counted[model.slices[effect.key].stop - 1] = True
    return counted


def questions(space: ParameterSpace, effects: Sequence[Effect]) -> Sequence[Question]:
    """
    Return a Question for each effect of the model, and one for each entry of the bank.

    An effect with a time constant that the model lacks has a question per time constant.
    """
    model = space.recording.model
    places = bank_places(space.recording)
    candidates = []
    for effect in effects:
        # Label -> parameters: of an effect of the model, or at each time constant of its bank.
        if effect.key in model.slices:
            parts = {effect.name: model.slices[effect.key]}
        else:
            parts = {}
            for entry in space.recording.bank.get(effect.sensor, ()):
                if entry.effect is effect:
                    parts[entry.label] = places[entry.label]
        for label, part in parts.items():
            parameters = tuple(range(part.start, part.stop))
            candidates.append(Question(effect, parameters, effect.size, label))
    return candidates


def normal_matrix(
    space: ParameterSpace, noise: dict[str, NoiseModel], select: np.ndarray | None = None
) -> np.ndarray:
    """
    Return the normal matrix of the windows `select` (mask; default: all), shape (q + 1, q + 1).

    It is the sum of the products of their means and of the samples about them.
    """
    means = []
    for sensor in space.sensors:
        means += mean_rows(space, noise, sensor)
    return within_matrix(space, noise, select) + normal_of_rows(means, space.size, select)


def within_matrix(
    space: ParameterSpace,
    noise: dict[str, NoiseModel],
    select: np.ndarray | None = None,
    *,
    sensors: Sequence[str] | None = None,
) -> np.ndarray:
    """
    Return the part of the normal matrix from the samples about the means, (q + 1, q + 1).

    `select`: mask of windows, default all; `sensors`: default all.
    """
    total = np.zeros((space.size + 1, space.size + 1))
    for sensor in space.sensors if sensors is None else sensors:
        for axis in range(3):
            at = space.places(sensor, axis)
            total[np.ix_(at, at)] += within_of_axis(
                space, noise[sensor], sensor, axis=axis, select=select
            )
    return total


def within_of_axis(
    space: ParameterSpace,
    noise: NoiseModel,
    sensor: str,
    *,
    axis: int,
    select: np.ndarray | None = None,
) -> np.ndarray:
    """
    Return the normal matrix of the samples of one axis about the means, (q_a + 1, q_a + 1).

    Its columns are ``space.places(sensor, axis)``; `select`: mask of windows, default all.
    """
    kind = space.recording.kind
    chosen = space.recording.moving
    if select is not None:
        chosen = select & chosen
    total = np.zeros((len(space.places(sensor, axis)),) * 2)
    for name in np.unique(kind[chosen]):
        products = space.within_sum(sensor, axis, chosen & (kind == name))
        total += products / noise.row_variance(name)[axis]
    return total


def scatter_of_each(
    space: ParameterSpace, noise: dict[str, NoiseModel], values: np.ndarray
) -> dict[str, np.ndarray]:
    """
    Return sensor -> variance ratio of the samples of each window, at least 1, shape (k, 3).

    It is the sum of squares of the residual about its mean, at the parameters `values`, shape (q,),
    over its expectation by the noise of this kind of window.
    """
    recording = space.recording
    weights = weights_of(range(space.size), values, space.size)
    ratios = {}
    for sensor in space.sensors:
        variance = np.array([noise[sensor].row_variance(name) for name in recording.kind])
        expected = variance * np.maximum(recording.count - 1, 1)[:, None]
        # With the centred rows B of a window and the weights w of the residual: w'B'B w.
        squares = []
        for axis in range(3):
            of_axis = weights[space.places(sensor, axis)]
            squares.append(space.slopes_within(sensor, axis, of_axis) @ of_axis)
        ratios[sensor] = np.maximum(np.stack(squares, axis=1) / expected, 1.0)
    return ratios


def mean_rows(
    space: ParameterSpace,
    noise: dict[str, NoiseModel],
    sensor: str,
    *,
    scatter: np.ndarray | None = None,
) -> list[Rows]:
    """
    Return the means of the windows for each axis, with the variance of their errors.

    `scatter`: variance ratio of the samples of each window (`scatter_of_each`), shape (k, 3).
    """
    recording = space.recording
    of_sensor = noise[sensor]
    # Errors, times and recordings of the windows, three axes, without columns.
    means = recording.mean_rows(np.zeros((len(recording.kind), 3, 0)), of_sensor)
    variance = means.variance
    if scatter is not None:
        # Only the part of the variance that the samples cause grows.
        of_samples = of_sensor.mean_variance(recording.kind, recording.count)
        variance = variance + (scatter - 1) * of_samples
    rows_of_axes = []
    for axis, equations in enumerate(space.mean[sensor]):
        of_axis = replace(
            means,
            equations=equations[:, None],
            variance=variance[:, axis : axis + 1],
            places=space.places(sensor, axis),
        )
        rows_of_axes.append(of_axis)
    return rows_of_axes
