"""The columns of a model over a motion, predicted readings, and the model applied to samples."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.effects.base import INPUT_OF, SENSORS, Effect, Lag, Role, matrix_times_arms
from imu_calibration.effects.expressions import ColumnCentre
from imu_calibration.effects.sensor_model import WARP, WARP_LEVER, ColumnLayout, SensorModel
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.joint_motion import JointMotion, shifted
from imu_calibration.kinematics.rotations import Reference, lever_matrix
from imu_calibration.kinematics.table import Table


@dataclass(frozen=True, eq=False)
class _ActingWarp:
    """An effect with a warp, and the values at which it acts."""

    effect: Effect
    """The effect."""
    values: np.ndarray
    """Its values, shape (size,)."""

    @property
    def key(self) -> tuple:
        """Name and values; the key of a cache."""
        return self.effect.name, *self.values

    @property
    def is_lag(self) -> bool:
        """Whether it shifts the motion in time."""
        return isinstance(self.effect.warp, Lag)


def _shifted_by(
    lags: Sequence[_ActingWarp], motion: JointMotion, roughly: bool
) -> list[tuple[float, JointMotion]]:
    """
    Return (weight, motion) pairs: the motion at each sum of the delays of several lags.

    A lag is ``x -> sum_k w_k x(t - d_k)``; the weights of lags in series are multiplied, and their
    delays added. `roughly` as in `References.at`.
    """
    delays = [(1.0, np.zeros(()))]
    for acting in lags:
        lag = cast(Lag, acting.effect.warp)
        if roughly:
            lag = lag.single
        delays_of_lag = lag.delays(motion.time, acting.values)
        combined = []
        for weight, delay in delays:
            for lag_weight, lag_delay in delays_of_lag:
                combined.append((weight * lag_weight, delay + lag_delay))
        delays = combined
    return [(weight, shifted(motion, delay)) for weight, delay in delays]


def _mean_reference(weighted: Sequence[tuple[float, Reference]], motion: JointMotion) -> Reference:
    """Return the mean of (weight, reference) pairs, of the given motion: a lag is such a mean."""
    _, first = weighted[0]
    if len(weighted) == 1:
        return first
    total = sum(weight for weight, _ in weighted)
    means: dict[str, Any] = {}
    for name in ('force_s', 'rate_s', 'alpha_s', 'mat_sn'):
        weighted_sum = sum(weight * getattr(ref, name) for weight, ref in weighted)
        means[name] = weighted_sum / total
    return replace(first, motion=motion, **means)


class References:
    """
    The reference motion of each sensor: that of the table, changed by the warps of a model.

    A reference that both sensors have in common is computed once.
    """

    def __init__(
        self,
        model: SensorModel,
        table: Table,
        motion: JointMotion,
        *,
        temperature_c: np.ndarray | None = None,
    ):
        self.model = model
        self.table = table
        self.motion = motion
        self.temperature_c = temperature_c
        # Sensor -> the warps of the model at their points.
        self._warps: dict[str, list[_ActingWarp]] = {}
        for sensor in SENSORS:
            self._warps[sensor] = []
            for effect in model.concerning(sensor):
                if effect.warp is not None:
                    self._warps[sensor].append(_ActingWarp(effect, model.point_of(effect)))
        # Cache of `at`: warps with their values -> reference.
        self._references: dict[tuple, Reference] = {}
        # Cache of `_shifted_by`: lags with their values -> (weight, motion) pairs.
        self._shifts: dict[tuple, list[tuple[float, JointMotion]]] = {}

    def at(
        self,
        sensor: str,
        effect: Effect | None = None,
        values: np.ndarray | None = None,
        *,
        roughly: bool = False,
    ) -> Reference:
        """
        Return the reference of `sensor`, with every warp of the model at its point.

        The motion is shifted once by the sum of all lags; errors of table and encoders act on the
        shifted motion.

        Parameters
        ----------
        sensor : str
        effect, values : Effect and array, optional
            An effect with other values than its point, for a difference quotient; the reference is
            then without attitude.
        roughly : bool
            Approximate a lag by a delay of the same first derivative; a filter averages several
            delays and costs as many times more.

        """
        moved = None  # key of the effect that is not at its point
        if effect is not None and values is not None:
            if np.any(values != self.model.point_of(effect)):
                moved = effect.key
        acting = []
        for warp in self._warps[sensor]:
            if values is not None and warp.effect.key == moved:
                warp = _ActingWarp(warp.effect, values)
            if np.any(warp.values):  # with zeros it has no effect
                acting.append(warp)
        key = (roughly, moved, *(warp.key for warp in acting))
        if key not in self._references:
            self._references[key] = self._warped(acting, roughly, attitude=moved is None)
        return self._references[key]

    def _warped(self, acting: Sequence[_ActingWarp], roughly: bool, attitude: bool) -> Reference:
        """Return the reference after `acting` warps; `attitude`: whether it has `mat_sn`."""
        lags = [warp for warp in acting if warp.is_lag]
        key = (roughly, *(lag.key for lag in lags))
        if key not in self._shifts:
            self._shifts[key] = _shifted_by(lags, self.motion, roughly)
        references = []
        for weight, motion in self._shifts[key]:
            table = self.table
            for warp in acting:
                if not warp.is_lag:
                    change = cast(Callable, warp.effect.warp)
                    table, motion = change(table, motion, warp.values)
            reference = reference_motion(table, motion, self.temperature_c, attitude=attitude)
            references.append((weight, reference))
        return _mean_reference(references, self.motion)


def columns(references: References, sensor: str) -> np.ndarray:
    """
    Return the regressors of `sensor` in the model of `references`, shape (n, n_columns).

    They are in the order of ``model.groups(sensor)``.

    A warp contributes, per parameter, the three components of the derivative of the true input
    (`force_s` or `rate_s`); its coefficients are matrix times parameter. The derivative is a
    difference of the exact kinematics.
    """
    model = references.model
    ref = references.at(sensor)
    layout = model.layout(sensor)
    needs_temperature = any(
        group.uses & {'temperature', 'temperature rate'} for group in layout.groups.values()
    )
    if needs_temperature and ref.temperature_c is None:
        raise InputError(
            'a thermal effect needs temperatures, none were received; record imu/temperature or'
            ' omit the effect',
            key='temperature_topic',
            code='temperature_missing',
        )
    # Blocks in the order of the layout; the columns of a warp include those of its lever matrix.
    warps = {WARP + e.name: e for e in layout.effects if e.warp is not None}
    parts = []
    for name in layout.rows:
        if name in warps:
            parts += _warp_columns(references, warps[name], sensor)
        elif name in layout.groups:
            parts.append(layout.groups[name].columns(ref, layout.point))
    return np.concatenate(parts, axis=1)


def _warp_columns(references: References, effect: Effect, sensor: str) -> list[np.ndarray]:
    """
    Return the columns of a warp, one or two blocks.

    They are d(true input)/d(parameter), shape (n, 3 size), and for a model with arms also
    d(lever matrix)/d(parameter), shape (n, 9 size). With `SensorModel.folded_arms` the true input
    is that at the sensitive points, and there is no second block.
    """
    model = references.model
    if effect.derivative is not None:
        return [effect.derivative(references.at(sensor))]

    # To first order a lag near zero is a delay of the clock, whose references are computed anyway.
    clock = model.find('reference', Role.DELAY)
    if clock is not None and effect.sensor == sensor and not np.any(model.point_of(effect)):
        effect = clock

    # A search folds the arms and needs many warps: forward differences halve the references, with
    # an error of the curvature over a step. Candidate effects are evaluated with a delay in place
    # of a filter.
    folded_arms = model.folded_arms
    in_search = folded_arms is not None
    roughly = in_search and not np.any(model.point_of(effect))

    # Lever-arm terms change only where there are arms.
    with_arms = sensor == 'accelerometer' and bool(model.arms)
    if folded_arms is not None and not folded_arms.any():
        with_arms = False

    # Difference quotient by each parameter.
    inputs = []
    levers = []
    steps = _steps(effect, model.point_of(effect), forward=in_search)
    for values_above, values_below, distance in steps:
        above = references.at(sensor, effect, values_above, roughly=roughly)
        below = references.at(sensor, effect, values_below, roughly=roughly)
        change = getattr(above, INPUT_OF[sensor]) - getattr(below, INPUT_OF[sensor])
        if with_arms:
            # Force at a sensitive point: force_s + lever_matrix @ arm.
            lever_above = lever_matrix(above.rate_s, above.alpha_s)
            lever_change = lever_above - lever_matrix(below.rate_s, below.alpha_s)
            if folded_arms is not None:
                change = change + np.einsum('nij,ij->ni', lever_change, folded_arms)
            else:
                levers.append(lever_change.reshape(-1, 9) / distance)
        inputs.append(change / distance)
    return [np.concatenate(part, axis=1) for part in (inputs, levers) if part]


def _steps(
    effect: Effect, point: np.ndarray, forward: bool
) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """
    Yield (values above, values below, distance) of the difference quotient by each parameter.

    The differences are central, or `forward`. Nonnegative values are not varied below zero.
    """
    for index in range(effect.size):
        if index == effect.n_amplitudes and effect.located:
            yield point, point, 1.0  # a zero column: least squares does not move the time of a step
            continue
        size = effect.step
        central = not forward
        if effect.nonnegative and point[index] > 0:
            size = min(size, 0.5 * point[index])
        elif effect.nonnegative:
            central = False
        step = np.zeros(effect.size)
        step[index] = size
        above = point + step
        below = point - step if central else point
        yield above, below, (above - below)[index]


def columns_at_point(model: SensorModel, sensor: str, ref: Reference) -> np.ndarray:
    """
    Return the columns without the warps' derivatives, whose coefficients are zero at the point.
    """
    layout = model.layout(sensor)
    blocks = [group.columns(ref, layout.point) for group in layout.groups.values()]
    return np.concatenate(blocks, axis=1)


def coefficients(model: SensorModel, sensor: str, values: np.ndarray) -> np.ndarray:
    """
    Return the coefficients of the columns for parameters, real or complex, shape (n_columns, 3).
    """
    sensor_values = model.values_of(sensor, values)
    layout = model.layout(sensor)
    total = np.zeros((layout.width, 3), values.dtype)
    for effect in layout.effects:
        _add_coefficients(total, model, effect, sensor_values, layout)
    return total


def _add_coefficients(
    total: np.ndarray,
    model: SensorModel,
    effect: Effect,
    sensor_values: Mapping[str, np.ndarray],
    layout: ColumnLayout,
) -> None:
    """
    Add one effect's coefficients to `total`, shape (n_columns, 3), in place.

    `sensor_values` has the values of all effects of the sensor by name. A warp with the change d_p
    of parameter p, in output i of a sensor with matrix M and arms r, has the coefficients::

        d_p M_ij         of d(true input_j) / dp
        d_p M_ij r_ik    of d(lever matrix_jk) / dp
    """
    if effect.warp is not None:
        change = sensor_values[effect.name] - model.point_of(effect)
        matrix = sensor_values['matrix'].reshape(3, 3)
        input_block = change[:, None, None] * matrix.T[None]
        total[layout.rows[WARP + effect.name]] += input_block.reshape(-1, 3)
        if WARP_LEVER + effect.name in layout.rows:
            arms = sum((sensor_values[e.name].reshape(-1, 3) for e in model.arms), np.zeros((3, 3)))
            lever_block = change[:, None, None] * matrix_times_arms(matrix, arms)[None]
            total[layout.rows[WARP_LEVER + effect.name]] += lever_block.reshape(-1, 3)
    elif effect.coefficients is not None:
        for group, block in effect.coefficients(effect, sensor_values, layout.point).items():
            if group in layout.rows:  # an effect on both sensors has groups of each
                total[layout.rows[group]] += block


def all_arms(model: SensorModel, values: np.ndarray) -> np.ndarray:
    """
    Return the arms from the reference point to the three sensitive points, m, shape (3, 3).

    They are zero if the model has none.
    """
    return sum((values[model.slices[e.key]].reshape(-1, 3) for e in model.arms), np.zeros((3, 3)))


def coefficient_jacobian(model: SensorModel, sensor: str, values: np.ndarray) -> np.ndarray:
    """
    Return d(coefficients)/d(values) by complex steps, shape (n_columns, 3, n_params).

    The coefficients of an effect depend on its values, and on the effects that are
    `Effect.shared`: the sensor's matrix and, for warps, the arms.
    """
    layout = model.layout(sensor)
    step = 1e-30
    # Only the coefficients that depend on a value are computed at its step.
    jacobian = np.zeros((layout.width, 3, len(values)))
    sensor_values = model.values_of(sensor, values.astype(complex))
    readers = _readers(model, sensor_values, layout)
    for effect in layout.effects:
        dependent_effects = readers.get(effect.name, ()) if effect.shared else (effect,)
        part = model.slices[effect.key]
        for place, index in enumerate(range(part.start, part.stop)):
            moved = sensor_values[effect.name].copy()
            moved[place] += 1j * step
            moved_values = {**sensor_values, effect.name: moved}
            total = np.zeros((layout.width, 3), complex)
            for dependent in dependent_effects:
                _add_coefficients(total, model, dependent, moved_values, layout)
            jacobian[:, :, index] = total.imag / step
    return jacobian


class _NotedReads(Mapping[str, np.ndarray]):
    """Values of effects by name; notes whose are read, in whatever way."""

    def __init__(self, values: Mapping[str, np.ndarray]):
        self._values = values
        self.names: set[str] = set()
        """Names of the effects whose values were read."""

    def __getitem__(self, name: str) -> np.ndarray:
        self.names.add(name)
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


def _readers(
    model: SensorModel, sensor_values: dict[str, np.ndarray], layout: ColumnLayout
) -> dict[str, list[Effect]]:
    """Return {effect name: the effects whose coefficients depend on its values}."""
    readers: dict[str, list[Effect]] = {}
    total = np.zeros((layout.width, 3), complex)
    for effect in layout.effects:
        noted = _NotedReads(sensor_values)
        _add_coefficients(total, model, effect, noted, layout)
        for name in noted.names:
            readers.setdefault(name, []).append(effect)
    return readers


def effect_slopes(
    effect: Effect, sensor_values: dict[str, np.ndarray], point: dict[str, Any]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """
    Return the coefficients of one effect and their derivatives, by group.

    They are {group: coefficients (w, 3)} and {group: derivative by the values of the effect
    (w, 3, size)}, by complex steps. `sensor_values` is `SensorModel.values_of` the sensor, and
    `point` is `SensorModel.full_point`.
    """
    coefficients = effect.coefficients
    if coefficients is None:
        raise ValueError(f'{effect.name} has no coefficients')
    blocks = coefficients(effect, sensor_values, point)
    slopes = {group: np.zeros(block.shape + (effect.size,)) for group, block in blocks.items()}
    for k in range(effect.size):
        moved = sensor_values[effect.name].astype(complex)
        moved[k] += 1e-30j
        for group, block in coefficients(
            effect, {**sensor_values, effect.name: moved}, point
        ).items():
            slopes[group][..., k] = np.imag(block) / 1e-30
    return blocks, slopes


def output_of_effects(
    effects: Sequence[Effect], model: SensorModel, values: np.ndarray, *, ref: Reference
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the contribution of some effects of one sensor to its output, and its derivative.

    ``output = sum_g columns_g(ref) @ coefficients_g(values)`` over the groups of columns.

    Parameters
    ----------
    effects : sequence of Effect
        Of one sensor, one or several.
    model : SensorModel
        With these effects.
    values : array, shape (n_params,)
    ref : Reference
        True quantities at n samples.

    Returns
    -------
    tuple
        Output, shape (n, 3), and its derivative by the parameters of the effects in their order,
        shape (n, 3, p).

    """
    point = model.full_point()
    sensor_values = model.values_of(effects[0].sensor, values)
    output = np.zeros((len(ref.time), 3))
    derivatives = []
    for effect in effects:
        effect_coefficients, slopes = effect_slopes(effect, sensor_values, point)
        contribution = np.zeros((len(ref.time), 3))
        derivative = np.zeros((len(ref.time), 3, effect.size))
        for group in effect.groups:
            basis = group.columns(ref, point)
            contribution += basis @ effect_coefficients[group.name]
            derivative += np.einsum('mw,wip->mip', basis, slopes[group.name])
        output += contribution
        derivatives.append(derivative)
    return output, np.concatenate(derivatives, axis=2)


def predict(
    model: SensorModel,
    values: np.ndarray,
    table: Table,
    *,
    motion: JointMotion,
    temperature_c: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the readings of this model, (force, rate), each shape (n, 3): the forward equations.

    Warps are exact at `values`; saturation clips the result.
    """
    exact = model.at(values)
    references = References(exact, table, motion, temperature_c=temperature_c)
    readings = []
    for sensor in SENSORS:
        output = sensor_output(exact, sensor, values, ref=references.at(sensor))
        readings.append(clip(exact, sensor, values, output=output))
    force, rate = readings
    return force, rate


def coefficients_at_point(model: SensorModel, sensor: str, values: np.ndarray) -> np.ndarray:
    """Return the coefficients that belong to `columns_at_point`."""
    layout = model.layout(sensor)
    total = coefficients(model, sensor, values)
    return np.concatenate([total[layout.rows[name]] for name in layout.groups])


def clip(model: SensorModel, sensor: str, values: np.ndarray, *, output: np.ndarray) -> np.ndarray:
    """Clip the output at the saturation level, when the model has one."""
    level = model.value(sensor, Role.LIMIT, values)
    return output if level is None else np.clip(output, -level, level)


def sensor_output(
    model: SensorModel, sensor: str, values: np.ndarray, *, ref: Reference
) -> np.ndarray:
    """
    Return the output for a given true motion, without warps, shape (n, 3); compensation inverts it.

    Parameters
    ----------
    ref : Reference
        True specific force, rate and angular acceleration in the sensor frame.

    """
    return columns_at_point(model, sensor, ref) @ coefficients_at_point(model, sensor, values)


Centre = Mapping[str, ColumnCentre]
"""Column group -> the part of its columns that bias and matrix describe."""


def not_applied(model: SensorModel) -> list[Effect]:
    """
    Return the effects of the sensors that compensation cannot invert.

    They are drifts, and formulas in joint angles or time.
    """
    effects = []
    for effect in model.effects:
        # An effect of the table or the session is no error of the sensor; a warp has no columns.
        if effect.sensor not in SENSORS or effect.in_reference or effect.warp is not None:
            continue
        if effect.compensation == 'none' and effect.groups:
            effects.append(effect)
    return effects


def in_time(effect: Effect) -> bool:
    """Return whether an effect depends on time only."""
    return all(group.uses <= {'time', 'time constant'} for group in effect.groups)


def centred(
    model: SensorModel, values: np.ndarray, centre: Centre
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (values with centred columns, their derivative by `values`).

    With ``column = constant + slope @ true + remainder`` the output is that of a changed bias and
    matrix, and of the remainder::

        bias_i + matrix_ij true_j + column value_i
            = (bias_i + constant value_i) + (matrix_ij + slope_j value_i) true_j
              + remainder value_i

    Parameters
    ----------
    model : SensorModel
    values : array, shape (n_params,)
    centre : Centre

    """
    moved = values.copy()
    derivative = np.eye(len(values))
    for effect in not_applied(model):
        sensor = effect.sensor
        bias = model.part(sensor, Role.OFFSET)
        matrix = model.part(sensor, Role.LINEAR)
        for group in effect.groups:
            if group.name not in centre:
                continue
            part = centre[group.name]
            rows = model.layout(sensor).rows[group.name]
            # Of the columns q in the outputs a, and their derivatives by the values n.
            block = coefficients(model, sensor, values)[rows]
            jacobian = coefficient_jacobian(model, sensor, values)[rows]
            moved[bias] += part.constant @ block
            derivative[bias] += np.einsum('q,qan->an', part.constant, jacobian)
            if np.any(part.slope):
                moved[matrix] += (block.T @ part.slope).ravel()
                of_matrix = np.einsum('qk,qan->akn', part.slope, jacobian)
                derivative[matrix] += of_matrix.reshape(9, -1)
    return moved, derivative


READ_FROM = {
    'accelerometer': frozenset({'force'}),
    'gyroscope': frozenset({'rate', 'angular acceleration'}),
}
"""Sensor -> quantities that compensation computes from its readings."""


def without_input(model: SensorModel, absent: Sequence[str]) -> list[Effect]:
    """Return the effects for whose compensation readings of the absent sensors are needed."""
    unknown: frozenset[str] = frozenset().union(*(READ_FROM[sensor] for sensor in absent))
    effects = []
    for effect in model.effects:
        if effect.sensor in SENSORS and any(group.uses & unknown for group in effect.groups):
            effects.append(effect)
    return effects


def applied_values(
    model: SensorModel,
    values: np.ndarray,
    centre: Centre | None = None,
    *,
    absent: Sequence[str] = (),
) -> np.ndarray:
    """
    Return the values that compensation applies, shape (n_params,).

    Effects that it cannot invert are at their priors, and bias and matrix contain their part in the
    `centre`. Effects that need readings of the sensors `absent` are at their priors too.
    """
    applied, _ = centred(model, values, centre or {})
    for effect in (*not_applied(model), *without_input(model, absent)):
        applied[model.slices[effect.key]] = effect.prior_values()
    return np.where(np.isfinite(applied), applied, 0.0)
