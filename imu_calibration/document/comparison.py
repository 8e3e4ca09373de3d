"""
Whether two calibrations of the same IMU agree.

The IMU is judged apart from table and clock, in one convention of axes and origin.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.exit_codes import exit_code_of
from imu_calibration.document.calibration import Calibration, listed
from imu_calibration.document.exports.affine import lower_times_rotation
from imu_calibration.document.reference_texts import ACCELEROMETER_AXES, MOUNT_AXES
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import FIXED, HELD

COMPARISON_P_VALUE = 0.01
"""Significance level: two calibrations differ when the p-value is below this."""
MOTION_COLUMNS = {'force', 'rate', 'angular acceleration', 'joint rate', 'vibration'}
"""Quantities with components along the axes of the sensor (`ColumnGroup.uses`)."""


class Group(NamedTuple):
    """Test of the difference of the parameters of one effect."""

    name: str
    """SENSOR.EFFECT."""
    chi2: float
    """Squared distance ``d' (P1 + P2)^-1 d``."""
    dof: int
    """Degrees of freedom."""
    p_value: float
    """Probability of such a distance by chance."""

    @property
    def text(self) -> str:
        """The size of the difference."""
        return (
            f'{self.name}: differs by {np.sqrt(self.chi2 / self.dof):.1f} combined sd'
            f' (rms of {self.dof}), chance {self.p_value:.1g}'
        )


@dataclass(frozen=True)
class Row:
    """One parameter that both calibrations have."""

    name: str
    """Parameter name."""
    first: float
    """Value in the first document."""
    second: float
    """Value in the second document."""
    sd: float
    """Combined standard deviation of both calibrations."""
    unit: str
    """SI unit."""
    ratio: float | None
    """
    Difference in combined standard deviations; None when either is held or fixed, or the
    uncertainty of neither is known.
    """


@dataclass(frozen=True)
class Comparison:
    """Outcome for all common parameters."""

    rows: tuple
    """One Row per common parameter."""
    agree: bool | None
    """
    Whether no group of the IMU differs significantly, corrected for the number of groups; None when
    undecided.
    """
    lines: tuple
    """The verdict as text."""
    reference_agree: bool | None = None
    """The same for table and clock; None when undecided, or without common parameters."""
    differences: tuple[str, ...] = ()
    """The groups of the IMU that differ significantly, a line each."""

    @property
    def exit_code(self) -> int:
        """3 where the calibrations of the IMU disagree, otherwise 0."""
        return exit_code_of(self.reasons)

    @property
    def reasons(self) -> list[str]:
        """Why the exit code is 3, a line each."""
        return [*self.differences, self.lines[-1]] if self.agree is False else []


def moved_beyond_sd(first: Calibration, second: Calibration) -> bool:
    """
    Return whether a later calibration has other parameters, or a value that moved by over an sd.

    The sd is that of the first.
    """
    if first.param_names != second.param_names:
        return True
    return bool(np.any(np.abs(second.values - first.values) > first.sd))


def compare(first: Calibration, second: Calibration) -> Comparison:
    """
    Compare two calibrations, group by group.

    The squared distance of a group of k parameters, ``d' (P1 + P2)^-1 d``, is chi-square with k
    degrees of freedom when both are honest; groups are judged at 1 % over all groups (Holm), those
    of the IMU apart from those of table and clock.

    Where the conventions of axes differ, or the matrices of two tables disagree, both are brought
    to the axes of the accelerometer (`in_accelerometer_axes`): the rotation of the IMU on the table
    is no property of the IMU.

    Raises
    ------
    InputError
        When the frames or gauges differ, or no parameter is common.

    """
    common = [name for name in first.param_names if name in second.param_names]
    if not common:
        raise InputError(
            'two calibrations must have parameters in common, these have none; compare files of the'
            ' same kind',
            code='nothing_in_common',
        )
    notes = _notes(first, second)

    # Axes of the readings, where both files state them.
    mat_flu_first = first.readings.mat_flu_source()
    mat_flu_second = second.readings.mat_flu_source()
    if mat_flu_first is not None and mat_flu_second is not None:
        mat_first_second = mat_flu_first.T @ mat_flu_second
        if not np.array_equal(mat_first_second, np.eye(3)):
            notes.append(f'both are compared in the axes {first.readings.axes} of the first one')
            second = _in_other_readings(second, mat_first_second)

    # Axes of the true quantities.
    axes = {first.gauge.get('axes'), second.gauge.get('axes')}
    if axes == {MOUNT_AXES, ACCELEROMETER_AXES}:
        note = 'both are compared in the axes of the accelerometer'
        return _compared_turned(first, second, common, [*notes, note])
    comparison = _compared(first, second, common, notes)
    if comparison.agree is False and axes == {MOUNT_AXES}:
        note = 'the IMU is mounted differently: compared in the axes of the accelerometer'
        turned = _compared_turned(first, second, common, [*notes, note])
        if turned.agree:
            return turned
    return comparison


def in_accelerometer_axes(calibration: Calibration) -> Calibration:
    """
    Return the same calibration in the axes of the accelerometer, origin at its sensitive points.

    With the accelerometer matrix ``M = L Q``, L lower triangular with positive diagonal, Q a
    rotation, and with the true quantities ``Q f``, ``Q w``: matrices M to ``M Q'``, lever arms r to
    ``Q (r - mean of r)``, other effects by the order of their tensor (`Effect.input_order`). The
    covariance follows by differences. Effects that a rotation mixes with others keep their axes:
    `compare` turns and omits them by the rotation between both files (`_errors_of_turn`).
    """
    model = calibration.model
    values = _turned(model, calibration.values)
    jacobian = np.empty((len(values),) * 2)
    for k, sd in enumerate(calibration.sd):
        # Small against the uncertainty, large against rounding.
        step = np.zeros(len(values))
        step[k] = max(1e-3 * sd, 1e-7)
        above = _turned(model, calibration.values + step)
        below = _turned(model, calibration.values - step)
        jacobian[:, k] = (above - below) / (2 * step[k])
    # The upper triangle of L is zero by definition.
    status = np.array(calibration.status, object)
    matrix_status = status[model.part('accelerometer', Role.LINEAR)].reshape(3, 3)
    matrix_status[np.triu_indices(3, 1)] = FIXED  # a view: changes `status`
    return replace(
        calibration,
        values=values,
        covariance=jacobian @ calibration.covariance @ jacobian.T,
        status=tuple(status),
        covariance_terms={},
        gauge={**calibration.gauge, 'axes': ACCELEROMETER_AXES},
    )


def _in_other_readings(calibration: Calibration, mat_ts: np.ndarray) -> Calibration:
    """
    Return the same calibration of readings in other axes, ``mat_ts reading`` (signed permutation).

    With P = `mat_ts` a bias b becomes ``P b``, a matrix M ``P M P'``, arms A (a row per output)
    ``|P| A P'``: linear in the values, with the Kronecker product of the two factors for values by
    rows.

    Raises
    ------
    InputError
        For effects of another form.

    """
    slope = np.eye(len(calibration.values))
    for effect in calibration.model.effects:
        if effect.sensor not in SENSORS:
            continue
        parameters = calibration.model.slices[effect.key]
        if effect.role is Role.OFFSET:
            slope[parameters, parameters] = mat_ts
        elif effect.role in (Role.LINEAR, Role.CROSS):
            slope[parameters, parameters] = np.kron(mat_ts, mat_ts)
        elif effect.role is Role.ARMS:
            slope[parameters, parameters] = np.kron(np.abs(mat_ts), mat_ts)
        else:
            raise InputError(
                'calibrations with further effects are compared for readings in the same axes,'
                f' {effect.name} is in {calibration.readings.axes}; state the same axes for both',
                key='axes',
                code='other_axes',
            )
    # The status of a parameter moves with it: each row of a signed permutation has one entry.
    order = np.argmax(np.abs(slope), axis=1)
    return replace(
        calibration,
        values=slope @ calibration.values,
        covariance=slope @ calibration.covariance @ slope.T,
        status=tuple(calibration.status[index] for index in order),
        covariance_terms={},
    )


def _turned(model: SensorModel, values: np.ndarray) -> np.ndarray:
    """Return the values in the axes of the accelerometer, as `in_accelerometer_axes` states."""
    turned = values.copy()
    matrix = model.matrix('accelerometer', values)
    _, rotation = lower_times_rotation(matrix)
    for effect in model.effects:
        parameters = model.slices[effect.key]
        if effect.role is Role.ARMS:
            arms = values[parameters].reshape(3, 3)
            turned[parameters] = ((arms - arms.mean(axis=0)) @ rotation.T).ravel()
        elif not effect.input_places:
            turned[parameters] = effect.in_other_axes(values[parameters], rotation)
    return turned


def _compared_turned(
    first: Calibration, second: Calibration, common: Sequence[str], notes: list[str]
) -> Comparison:
    """Compare the common parameters of two calibrations in the axes of the accelerometer."""
    _, rotation_first = lower_times_rotation(first.model.matrix('accelerometer', first.values))
    _, rotation_second = lower_times_rotation(second.model.matrix('accelerometer', second.values))
    # From the axes of the second file to those of the first, by cos(angle) = (trace(turn) - 1) / 2.
    turn = rotation_first.T @ rotation_second
    angle = float(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0)))
    errors = _errors_of_turn(first, turn.T, angle)
    for name, error in _errors_of_turn(second, turn, angle).items():
        errors[name] = max(error, errors.get(name, 0.0))
    return _compared(
        in_accelerometer_axes(first),
        _with_parts_turned(in_accelerometer_axes(second), turn),
        common,
        notes,
        angle=angle,
        errors=errors,
    )


def _with_parts_turned(calibration: Calibration, turn: np.ndarray) -> Calibration:
    """Return the calibration with its incomplete tensors (`Effect.input_places`) in other axes."""
    slope = np.eye(len(calibration.values))
    for effect in calibration.model.effects:
        if effect.input_places:
            parameters = calibration.model.slices[effect.key]
            # The map is linear: its columns are the images of the unit vectors.
            columns = [effect.in_other_axes(unit, turn) for unit in np.eye(effect.size)]
            slope[parameters, parameters] = np.transpose(columns)
    return replace(
        calibration,
        values=slope @ calibration.values,
        covariance=slope @ calibration.covariance @ slope.T,
    )


def _errors_of_turn(calibration: Calibration, turn: np.ndarray, angle: float) -> dict[str, float]:
    """
    Return {name: error of a parameter in other axes} of effects that a rotation mixes with others.

    An incomplete tensor, as products of two components without squares, has the components c that
    it does not contain in the other axes, ``c = O(angle)``. The other calibration, which does not
    have them either, is in error by ``angle c``. All other effects remain in the axes of their
    file: a coefficient changes by up to the angle times the largest.
    """
    errors = {}
    for effect in calibration.model.effects:
        if effect.role is not Role.TERM or effect.sensor not in SENSORS:
            continue
        values = calibration.values[calibration.model.slices[effect.key]]
        uses_motion = any(group.uses & MOTION_COLUMNS for group in effect.groups)
        if effect.input_places:
            size = effect.lost_in_other_axes(values, turn)
        elif effect.input_order is None and uses_motion:
            size = float(np.max(np.abs(values)))
        else:
            continue
        errors |= dict.fromkeys(effect.param_names(), angle * size)
    return errors


def _compared(
    first: Calibration,
    second: Calibration,
    common: Sequence[str],
    notes: list[str],
    *,
    angle: float = 0.0,
    errors: Mapping[str, float] = MappingProxyType({}),
) -> Comparison:
    """
    Compare the common parameters of two calibrations.

    `angle` is the rotation, rad, between the axes of both files, and `errors` has its effect on
    parameters that cannot be turned (`_errors_of_turn`); those in error by a standard deviation
    are not compared.
    """
    # 1. Differences with their covariance, to which an unknown uncertainty contributes nothing.
    index_first = [first.param_names.index(name) for name in common]
    index_second = [second.param_names.index(name) for name in common]
    difference = second.values[index_second] - first.values[index_first]
    covariance = np.zeros((len(common), len(common)))
    n_known = 0
    for calibration, index in ((first, index_first), (second, index_second)):
        if calibration.uncertainty_known:
            covariance = covariance + calibration.covariance[np.ix_(index, index)]
            n_known += 1
    sd = np.sqrt(np.diag(covariance))

    # 2. Parameters that are not compared: not estimated in one of both, or in other axes.
    not_estimated = np.array(
        [
            first.status[i] in (HELD, FIXED) or second.status[j] in (HELD, FIXED)
            for i, j in zip(index_first, index_second)
        ]
    )
    in_other_axes = np.array([errors.get(name, 0.0) for name in common]) > sd
    excluded = not_estimated | in_other_axes

    # 3. A row for each parameter; without any known uncertainty no ratio has a meaning.
    units = {}
    for effect in first.model.effects:
        for k, name in enumerate(effect.param_names()):
            units[name] = effect.unit_of(k)
    rows = []
    for k, name in enumerate(common):
        ratio = None if excluded[k] or not n_known else _ratio(difference[k], sd[k])
        rows.append(
            Row(
                name,
                first=float(first.values[index_first[k]]),
                second=float(second.values[index_second[k]]),
                sd=float(sd[k]),
                unit=units[name],
                ratio=ratio,
            )
        )

    # 4. Tests, with both uncertainties. Table and clock are judged separately: they are no property
    #    of the IMU.
    groups = _groups(common, difference, covariance, ~excluded) if n_known == 2 else []
    names_of_reference = set()
    for effect in first.model.effects:
        if effect.section == 'reference':
            names_of_reference |= {name.rpartition('.')[0] for name in effect.param_names()}
    of_reference = [group for group in groups if group.name in names_of_reference]
    of_imu = [group for group in groups if group not in of_reference]
    rejected_reference = _holm(of_reference)
    rejected = _holm(of_imu)

    # 5. Differences, omitted parameters and verdict as text.
    all_rejected = rejected | rejected_reference
    lines = [*notes, *(group.text for group in groups if group.name in all_rejected)]
    linear = {'.'.join(effect.key) for effect in first.model.effects if effect.role == Role.LINEAR}
    if rejected & linear and MOUNT_AXES in (first.gauge.get('axes'), second.gauge.get('axes')):
        lines.append(
            'off-diagonal terms of a matrix include how the IMU was mounted on the table: '
            'they differ after remounting without a change of the IMU'
        )
    n_not_estimated = int(np.count_nonzero(not_estimated & ~in_other_axes))
    if n_not_estimated:
        lines.append(
            f'{n_not_estimated} parameters are held or fixed in one of them and were not compared'
        )
    names_in_other_axes = list(compress(common, in_other_axes))
    if names_in_other_axes:
        lines.append(
            f'not compared, because their axes differ by {np.degrees(angle):.2g} deg:'
            f' {listed(names_in_other_axes)}'
        )
    if of_reference:
        word = 'differ' if rejected_reference else 'agree'
        lines.append(f'table and clock {word}, which is no property of the IMU')
    agree = not rejected if of_imu else None
    return Comparison(
        rows=tuple(rows),
        agree=agree,
        lines=(*lines, _verdict(agree, len(names_in_other_axes), n_known)),
        reference_agree=not rejected_reference if of_reference else None,
        differences=tuple(group.text for group in of_imu if group.name in rejected),
    )


def _verdict(agree: bool | None, n_in_other_axes: int, n_known: int) -> str:
    """
    Return whether two calibrations agree as text; `agree`: None where that cannot be tested.

    `n_known`: number of calibrations with a known uncertainty.
    """
    if agree is None:
        cause = 'no parameter of the IMU is determined in both'
        if n_known < 2:
            cause = 'the uncertainties of imported values are unknown'
        return f'agreement of the calibrations cannot be tested: {cause}'
    verdict = 'the calibrations agree' if agree else 'the calibrations disagree'
    if n_in_other_axes:
        verdict += f'; {n_in_other_axes} parameters in other axes were not compared'
    return verdict


def _ratio(difference: float, sd: float) -> float:
    """Return a difference in standard deviations; without one, zero or infinite."""
    if sd > 0:
        return float(abs(difference) / sd)
    return 0.0 if difference == 0 else float('inf')


def _notes(first: Calibration, second: Calibration) -> list[str]:
    """Return the conventions in which two calibrations differ, a line each."""
    notes = []
    if first.frame_id != second.frame_id:
        notes.append(f"note: the frames differ: '{first.frame_id}' and '{second.frame_id}'")
    if first.gauge != second.gauge:
        notes.append(
            f'note: the conventions of origin or axes differ: {first.gauge} and {second.gauge}'
        )
    same_temperature = first.model.temperature_ref_c == second.model.temperature_ref_c
    if not same_temperature and first.model.needs_temperature:
        notes.append('note: the reference temperatures differ, so the biases need not agree')
    return notes


def _groups(
    names: Sequence[str], difference: np.ndarray, covariance: np.ndarray, compared: np.ndarray
) -> list[Group]:
    """
    Return the test of each SENSOR.EFFECT with a parameter that is compared.

    The distance is computed with the correlations C and the differences e in standard deviations:
    ``d' P^-1 d = e' C^-1 e``. C may be singular; its rank is then the degrees of freedom.
    """
    from scipy.special import chdtrc  # here: compensator_node compares, but needs no test

    effects = [name.rpartition('.')[0] for name in names]
    groups = []
    for name in dict.fromkeys(effects):
        index = np.array([effect == name for effect in effects]) & compared
        if not index.any():
            continue
        block = covariance[np.ix_(index, index)]
        scale = np.sqrt(np.maximum(np.diag(block), 1e-300))
        correlation = block / np.outer(scale, scale)
        in_sds = difference[index] / scale
        chi2 = float(in_sds @ np.linalg.pinv(correlation, rcond=1e-9, hermitian=True) @ in_sds)
        rank = max(int(np.linalg.matrix_rank(correlation, tol=1e-9, hermitian=True)), 1)
        groups.append(Group(name, chi2, rank, float(chdtrc(rank, chi2))))
    return groups


def _holm(groups: Sequence[Group]) -> set[str]:
    """Return the names of the groups that Holm's step-down test rejects at COMPARISON_P_VALUE."""
    rejected = set()
    ordered = sorted(groups, key=lambda group: group.p_value)
    for k, group in enumerate(ordered):
        if group.p_value > COMPARISON_P_VALUE / (len(ordered) - k):
            break
        rejected.add(group.name)
    return rejected
