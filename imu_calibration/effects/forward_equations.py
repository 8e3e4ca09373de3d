"""The columns of a model over a motion, predicted readings, and the model applied to samples."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.effects.base import INPUT_OF, SENSORS, Effect, Lag, Role
from imu_calibration.effects.expressions import ColumnCentre
from imu_calibration.effects.sensor_model import WARP, WARP_LEVER, SensorModel
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.joint_motion import JointMotion, shifted
from imu_calibration.kinematics.rotations import Reference, lever_matrix
from imu_calibration.kinematics.table import Table


@dataclass(frozen=True, eq=False)
class _ActingWarp:
    """An effect with a warp, and the values at which it acts."""

    effect: Effect
    values: np.ndarray
    """Values of the effect, shape (size,)."""

    @property
    def key(self):
        """Name and values; the key of a cache."""
        return self.effect.name, *self.values

    @property
    def is_lag(self):
        """Whether it shifts the motion in time."""
        return isinstance(self.effect.warp, Lag)


def _shifted_by(lags, motion, roughly):
    """
    Return (weight, motion) pairs: the motion at each sum of the delays of several lags.

    A lag is ``x -> sum_k w_k x(t - d_k)``; the weights of lags in series are multiplied, and their
    delays added.
    """
    delays = [(1.0, np.zeros(()))]
    for acting in lags:
        lag = acting.effect.warp
        if roughly:
            lag = lag.single
        added = lag.delays(motion.time, acting.values)
        delays = [(weight * w, delay + d) for (weight, delay), (w, d) in product(delays, added)]
    return [(weight, shifted(motion, delay)) for weight, delay in delays]


def _mean_reference(weighted, motion):
    """Return the weighted mean of references (a lag is a mean over delays)."""
    if len(weighted) == 1:
        return weighted[0][1]
    total = sum(weight for weight, _ in weighted)
    mean: dict[str, Any] = {}
    for name in ('force_s', 'rate_s', 'alpha_s', 'mat_sn'):
        weighted_sum = sum(weight * getattr(ref, name) for weight, ref in weighted)
        mean[name] = weighted_sum / total
    return replace(weighted[0][1], motion=motion, **mean)


class References:
    """
    The motions that a model's sensors are thought to have felt.

    Each is worked out once for both sensors where both feel the same.
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
        self._warps: dict[str, list[_ActingWarp]] = {}
        for sensor in SENSORS:
            self._warps[sensor] = []
            for effect in model.concerning(sensor):
                if effect.warp is not None:
                    self._warps[sensor].append(_ActingWarp(effect, model.point_of(effect)))
        self._known: dict[tuple, Reference] = {}
        self._shifts: dict[tuple, list] = {}

    def at(
        self,
        sensor: str,
        effect: Effect | None = None,
        values: np.ndarray | None = None,
        *,
        roughly: bool = False,
    ) -> Reference:
        """
        Return the reference that `sensor` is thought to have felt.

        With every warp of the model at its point.

        The motion is shifted once by the sum of all lags; errors of table and encoders act on the
        shifted motion.

        Parameters
        ----------
        sensor : str
        effect, values : Effect and array, optional
            An effect with other values than its point; the reference is then without attitude.
        roughly : bool
            Approximate a lag by a delay of the same first derivative; a filter averages several
            delays and costs as many times more.

        """
        acting = []
        moved = None
        if (
            effect is not None
            and values is not None
            and np.any(values != self.model.point_of(effect))
        ):
            moved = effect.key
        for each in self._warps[sensor]:
            if values is not None and each.effect.key == moved:
                each = _ActingWarp(each.effect, values)
            if np.any(each.values):  # a warp of zero changes nothing
                acting.append(each)
        key = (roughly, moved, *(each.key for each in acting))
        if key not in self._known:
            self._known[key] = self._warped(acting, roughly, attitude=moved is None)
        return self._known[key]

    def _warped(self, acting, roughly, attitude):
        lags = [each for each in acting if each.is_lag]
        key = (roughly, *(lag.key for lag in lags))
        if key not in self._shifts:
            self._shifts[key] = _shifted_by(lags, self.motion, roughly)
        references = []
        for weight, felt in self._shifts[key]:
            table = self.table
            for each in acting:
                if not each.is_lag:
                    table, felt = each.effect.warp(table, felt, each.values)
            reference = reference_motion(table, felt, self.temperature_c, attitude=attitude)
            references.append((weight, reference))
        return _mean_reference(references, self.motion)


def columns(references: References, sensor: str) -> np.ndarray:
    """
    Return the regressors of `sensor` in the model of `references`.

    Shape (n, n_columns), in the order of ``model.groups(sensor)``.

    A warp contributes, per parameter, the three components of the derivative of the true input
    (`force_s` or `rate_s`); its coefficients are matrix times parameter. The derivative is a
    difference of the exact kinematics.
    """
    model = references.model
    ref = references.at(sensor)
    layout = model.layout(sensor)
    if ref.temperature_c is None and any(
        group.uses & {'temperature', 'temperature rate'} for group in layout.groups.values()
    ):
        raise InputError(
            'a thermal effect needs temperatures, none were received; record imu/temperature or'
            ' omit the effect',
            key='temperature_topic',
            code='temperature_missing',
        )
    warps = {WARP + e.name: e for e in layout.effects if e.warp is not None}
    parts = []
    for name in layout.rows:
        if name in warps:
            parts += _warp_columns(references, warps[name], sensor)
        elif name in layout.groups:
            parts.append(layout.groups[name].columns(ref, layout.point))
    return np.concatenate(parts, axis=1)


def _warp_columns(references, effect, sensor):
    """
    Return the columns of a warp.

    D(true input)/d(parameter), shape (n, 3 size), and d(lever matrix)/d(parameter) where arms are
    modelled.

    With `folded_arms` the true input is that at the sensitive points, and there is no second block.
    """
    model = references.model
    if effect.derivative is not None:
        return [effect.derivative(references.at(sensor))]
    clock = model.find('reference', Role.DELAY)
    if clock is not None and effect.sensor == sensor and not np.any(model.point_of(effect)):
        effect = clock  # a lag of zero is a delay to first order
    # A search folds the arms and needs many warps: forward differences halve the references, with
    # an error of the curvature over a step. Candidate effects are evaluated with a delay in place
    # of a filter.
    in_search = model.folded_arms is not None
    roughly = in_search and not np.any(model.point_of(effect))
    with_arms = sensor == 'accelerometer' and bool(model.arms)
    if in_search and not model.folded_arms.any():
        with_arms = False
    inputs, levers = [], []
    for values_above, values_below, distance in _steps(
        effect, model.point_of(effect), forward=in_search
    ):
        above = references.at(sensor, effect, values_above, roughly=roughly)
        below = references.at(sensor, effect, values_below, roughly=roughly)
        change = getattr(above, INPUT_OF[sensor]) - getattr(below, INPUT_OF[sensor])
        if with_arms:
            # Force at a sensitive point: force_s + lever_matrix @ arm.
            lever_above = lever_matrix(above.rate_s, above.alpha_s)
            lever_change = lever_above - lever_matrix(below.rate_s, below.alpha_s)
            if in_search:
                change = change + np.einsum('nij,ij->ni', lever_change, model.folded_arms)
            else:
                levers.append(lever_change.reshape(-1, 9) / distance)
        inputs.append(change / distance)
    return [np.concatenate(part, axis=1) for part in (inputs, levers) if part]


def _steps(effect, at, forward):
    """
    Yield (values above, values below, distance) for the derivative by each parameter.

    Nonnegative values are not varied below zero.
    """
    for index in range(effect.size):
        step = np.zeros(effect.size)
        if index == effect.n_amplitudes and effect.located:
            yield at, at, 1.0  # least squares does not move the time of a step
            continue
        step[index] = effect.step
        below = at if forward else at - step
        if effect.nonnegative:
            step[index] = min(effect.step, 0.5 * at[index]) if at[index] > 0 else effect.step
            below = at - step if at[index] > 0 and not forward else at
        yield at + step, below, (at + step - below)[index]


def columns_at_point(model: SensorModel, sensor: str, ref: Reference) -> np.ndarray:
    """
    Return the columns without the warps' derivatives.

    These have zero coefficients at the point itself.
    """
    layout = model.layout(sensor)
    return np.concatenate(
        [group.columns(ref, layout.point) for group in layout.groups.values()], axis=1
    )


def coefficients(model: SensorModel, sensor: str, values: np.ndarray) -> np.ndarray:
    """
    Return the coefficients of the columns for a parameter vector (real or complex).

    Shape (n_columns, 3).
    """
    of_sensor = model.values_of(sensor, values)
    layout = model.layout(sensor)
    total = np.zeros((layout.width, 3), values.dtype)
    for effect in layout.effects:
        _add_coefficients(total, model, effect, of_sensor, layout)
    return total


def _add_coefficients(total, model, effect, of_sensor, layout):
    """Add one effect's coefficients in place."""
    if effect.warp is not None:
        change = of_sensor[effect.name] - model.point_of(effect)
        matrix = of_sensor['matrix'].reshape(3, 3)
        total[layout.rows[WARP + effect.name]] += (change[:, None, None] * matrix.T[None]).reshape(
            -1, 3
        )
        if WARP_LEVER + effect.name in layout.rows:
            arms = sum((of_sensor[e.name].reshape(-1, 3) for e in model.arms), np.zeros((3, 3)))
            products = (matrix[:, :, None] * arms[:, None, :]).reshape(3, 9).T
            total[layout.rows[WARP_LEVER + effect.name]] += (
                change[:, None, None] * products[None]
            ).reshape(-1, 3)
    elif effect.coefficients is not None:
        for group, block in effect.coefficients(effect, of_sensor, layout.point).items():
            if group in layout.rows:  # an effect on both sensors has groups of each
                total[layout.rows[group]] += block


def all_arms(model: SensorModel, values: np.ndarray) -> np.ndarray:
    """
    Return the arms from the reference point to the three sensitive points.

    Shape (3, 3), zero where the model has none.
    """
    return sum((values[model.slices[e.key]].reshape(-1, 3) for e in model.arms), np.zeros((3, 3)))


def coefficient_jacobian(model: SensorModel, sensor: str, values: np.ndarray) -> np.ndarray:
    """
    Return d(coefficients)/d(values) by complex steps, shape (n_columns, 3, n_params).

    Besides its own values an effect's coefficients depend on the sensor's matrix and, for warps, on
    its arms.
    """
    layout = model.layout(sensor)
    step = 1e-30
    jacobian = np.zeros((layout.width, 3, len(values)))
    for effect in layout.effects:
        concerned = layout.effects if effect.shared else (effect,)
        part = model.slices[effect.key]
        for index in range(part.start, part.stop):
            moved = values.astype(complex)
            moved[index] += 1j * step
            of_sensor = model.values_of(sensor, moved)
            total = np.zeros((layout.width, 3), complex)
            for other in concerned:
                _add_coefficients(total, model, other, of_sensor, layout)
            jacobian[:, :, index] = total.imag / step
    return jacobian


def effect_slopes(
    effect: Effect, of_sensor: dict[str, np.ndarray], point: dict[str, Any]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """
    Return the coefficients of one effect and their derivatives, by group.

    They are {group: coefficients (w, 3)} and {group: derivative by its own values (w, 3, size)}, by
    complex steps.
    """
    coefficients = effect.coefficients
    if coefficients is None:
        raise ValueError(f'{effect.name} has no coefficients')
    found = coefficients(effect, of_sensor, point)
    slopes = {group: np.zeros(block.shape + (effect.size,)) for group, block in found.items()}
    for k in range(effect.size):
        moved = of_sensor[effect.name].astype(complex)
        moved[k] += 1e-30j
        for group, block in coefficients(effect, {**of_sensor, effect.name: moved}, point).items():
            slopes[group][..., k] = np.imag(block) / 1e-30
    return found, slopes


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
    own = model.values_of(effects[0].sensor, values)
    output = np.zeros((len(ref.time), 3))
    derivatives = []
    for effect in effects:
        coefficients_of, slopes = effect_slopes(effect, own, point)
        contribution = np.zeros((len(ref.time), 3))
        derivative = np.zeros((len(ref.time), 3, effect.size))
        for group in effect.groups:
            basis = group.columns(ref, point)
            contribution += basis @ coefficients_of[group.name]
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
    outputs = {
        sensor: sensor_output(exact, sensor, values, ref=references.at(sensor))
        for sensor in SENSORS
    }
    force, rate = (clip(exact, sensor, values, output=output) for sensor, output in outputs.items())
    return force, rate


def coefficients_at_point(model: SensorModel, sensor: str, values: np.ndarray) -> np.ndarray:
    """Return the coefficients that belong to `columns_at_point`."""
    layout = model.layout(sensor)
    found = coefficients(model, sensor, values)
    return np.concatenate([found[layout.rows[name]] for name in layout.groups])


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
    Return the effects of the sensors that compensation cannot undo.

    Drifts, formulas in joint angles or time.
    """
    found = []
    for effect in model.effects:
        if (
            effect.sensor in SENSORS
            and effect.compensation == 'none'
            and not effect.in_reference
            and effect.warp is None
            and effect.groups
        ):
            found.append(effect)
    return found


def in_time(effect: Effect) -> bool:
    """Return whether an effect depends on time only."""
    return all(group.uses <= {'time', 'time constant'} for group in effect.groups)


def centred(
    model: SensorModel, values: np.ndarray, centre: Centre
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (values, their derivative by the given ones) for centred columns.

    With ``column = constant + slope @ true + rest`` the output is that of a changed bias and
    matrix, and of the rest::

        bias_i + matrix_ij true_j + column value_i
            = (bias_i + constant value_i) + (matrix_ij + slope_j value_i) true_j + rest value_i

    Parameters
    ----------
    model : SensorModel
    values : array, shape (n_params,)
    centre : Centre

    """
    moved = values.copy()
    slope = np.eye(len(values))
    for effect in not_applied(model):
        sensor = effect.sensor
        bias = model.part(sensor, Role.OFFSET)
        matrix = model.part(sensor, Role.LINEAR)
        for group in effect.groups:
            if group.name not in centre:
                continue
            of_group = centre[group.name]
            rows = model.layout(sensor).rows[group.name]
            of_axes = coefficients(model, sensor, values)[rows]
            derivative = coefficient_jacobian(model, sensor, values)[rows]
            moved[bias] += of_group.constant @ of_axes
            slope[bias] += np.einsum('q,qan->an', of_group.constant, derivative)
            if np.any(of_group.slope):
                moved[matrix] += (of_axes.T @ of_group.slope).ravel()
                of_matrix = np.einsum('qk,qan->akn', of_group.slope, derivative)
                slope[matrix] += of_matrix.reshape(9, -1)
    return moved, slope


READ_FROM = {
    'accelerometer': frozenset({'force'}),
    'gyroscope': frozenset({'rate', 'angular acceleration'}),
}
"""Sensor -> quantities that compensation computes from its readings."""


def without_input(model: SensorModel, absent: Sequence[str]) -> list[Effect]:
    """Return the effects that compensation needs readings of absent sensors for."""
    unknown: frozenset[str] = frozenset().union(*(READ_FROM[sensor] for sensor in absent))
    found = []
    for effect in model.effects:
        if effect.sensor in SENSORS and any(group.uses & unknown for group in effect.groups):
            found.append(effect)
    return found


def applied_values(
    model: SensorModel,
    values: np.ndarray,
    centre: Centre | None = None,
    *,
    absent: Sequence[str] = (),
) -> np.ndarray:
    """
    Return the values with effects that compensation cannot undo fixed at the centre.

    These effects are at their value in the centre, which bias and matrix contain; those that need
    readings of the sensors `absent` are zero.
    """
    applied = centred(model, values, centre or {})[0]
    for effect in (*not_applied(model), *without_input(model, absent)):
        applied[model.slices[effect.key]] = effect.prior_values()
    return np.where(np.isfinite(applied), applied, 0.0)
