"""
Whether two calibrations of the same IMU agree.

The IMU is judged apart from table and clock, in one convention of axes and origin.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from scipy.special import chdtrc

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

Group = tuple[str, float, int, float]
"""SENSOR.EFFECT, chi-square, degrees of freedom, probability by chance."""


@dataclass(frozen=True)
class Row:
    """One parameter of both."""

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
    Return whether a later calibration differs.

    In its parameters, or in a value by more than the sd of the first.
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
    mat_flu_first = first.readings.mat_flu_source()
    mat_flu_second = second.readings.mat_flu_source()
    if mat_flu_first is not None and mat_flu_second is not None:
        turn = mat_flu_first.T @ mat_flu_second
        if not np.array_equal(turn, np.eye(3)):
            notes.append(f'both are compared in the axes {first.readings.axes} of the first one')
            second = _in_other_readings(second, turn)
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
        step = np.zeros(len(values))
        step[k] = max(1e-3 * sd, 1e-7)
        above = _turned(model, calibration.values + step)
        below = _turned(model, calibration.values - step)
        jacobian[:, k] = (above - below) / (2 * step[k])
    # The upper triangle of L is zero by definition.
    status = np.array(calibration.status, object)
    matrix_status = status[model.part('accelerometer', Role.LINEAR)]
    if len(matrix_status):
        matrix_status.reshape(3, 3)[np.triu_indices(3, 1)] = FIXED
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

    A bias b becomes ``P b``, a matrix M ``P M P'``, arms A (a row per output) ``|P| A P'``: linear
    in the values.

    Raises
    ------
    InputError
        For effects of another form.

    """
    slope = np.eye(len(calibration.values))
    for effect in calibration.model.effects:
        if effect.sensor not in SENSORS:
            continue
        part = calibration.model.slices[effect.key]
        if effect.role is Role.OFFSET:
            slope[part, part] = mat_ts
        elif effect.role in (Role.LINEAR, Role.CROSS):
            slope[part, part] = np.kron(mat_ts, mat_ts)
        elif effect.role is Role.ARMS:
            slope[part, part] = np.kron(np.abs(mat_ts), mat_ts)
        else:
            raise InputError(
                'calibrations with further effects are compared for readings in the same axes,'
                f' {effect.name} is in {calibration.readings.axes}; state the same axes for both',
                key='axes',
                code='other_axes',
            )
    order = np.argmax(np.abs(slope), axis=1)
    return replace(
        calibration,
        values=slope @ calibration.values,
        covariance=slope @ calibration.covariance @ slope.T,
        status=tuple(calibration.status[place] for place in order),
        covariance_terms={},
    )


def _turned(model: SensorModel, values: np.ndarray) -> np.ndarray:
    """Return the values in the axes of the accelerometer."""
    turned = values.copy()
    matrix = model.matrix('accelerometer', values)
    _, rotation = lower_times_rotation(matrix)
    for effect in model.effects:
        part = model.slices[effect.key]
        if effect.role is Role.ARMS:
            arms = values[part].reshape(3, 3)
            turned[part] = ((arms - arms.mean(axis=0)) @ rotation.T).ravel()
        elif not effect.input_places:
            turned[part] = effect.in_other_axes(values[part], rotation)
    return turned


def _compared_turned(
    first: Calibration, second: Calibration, common: Sequence[str], notes: list[str]
) -> Comparison:
    """Compare the common parameters of two calibrations in the axes of the accelerometer."""
    rotations = []
    for calibration in (first, second):
        matrix = calibration.model.matrix('accelerometer', calibration.values)
        _, rotation = lower_times_rotation(matrix)
        rotations.append(rotation)
    # From the axes of the second to those of the first; cos(angle) = (trace(turn) - 1) / 2.
    turn = rotations[0].T @ rotations[1]
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
            part = calibration.model.slices[effect.key]
            columns = [effect.in_other_axes(unit, turn) for unit in np.eye(effect.size)]
            slope[part, part] = np.transpose(columns)
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
    found = {}
    for effect in calibration.model.effects:
        if effect.role is not Role.TERM or effect.sensor not in SENSORS:
            continue
        values = calibration.values[calibration.model.slices[effect.key]]
        uses_motion = bool(set().union(*(group.uses for group in effect.groups)) & MOTION_COLUMNS)
        if effect.input_places:
            size = effect.lost_in_other_axes(values, turn)
        elif effect.input_order is None and uses_motion:
            size = float(np.max(np.abs(values)))
        else:
            continue
        found |= dict.fromkeys(effect.param_names(), angle * size)
    return found


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
    a = [first.param_names.index(name) for name in common]
    b = [second.param_names.index(name) for name in common]
    difference = second.values[b] - first.values[a]
    parts = [
        c.covariance[np.ix_(at, at)] for c, at in ((first, a), (second, b)) if c.uncertainty_known
    ]
    covariance = sum(parts, np.zeros((len(common), len(common))))
    held = np.array(
        [bool({first.status[i], second.status[j]} & {HELD, FIXED}) for i, j in zip(a, b)]
    )
    sd = np.sqrt(np.diag(covariance))

    in_other_axes = np.array([errors.get(name, 0.0) for name in common]) > sd
    held |= in_other_axes
    units = {}
    for effect in first.model.effects:
        for k, name in enumerate(effect.param_names()):
            units[name] = effect.unit_of(k)
    rows = tuple(
        Row(
            name,
            float(first.values[i]),
            float(second.values[j]),
            float(s),
            units[name],
            None if h or not parts else _ratio(d, s),
        )
        for name, i, j, s, h, d in zip(common, a, b, sd, held, difference)
    )
    groups = _groups(common, difference, covariance, held) if len(parts) == 2 else []
    # Table and clock are judged separately: they are no property of the IMU.
    keys_of_reference = set()
    for effect in first.model.effects:
        if effect.section == 'reference':
            keys_of_reference |= {name.rpartition('.')[0] for name in effect.param_names()}
    of_reference, of_imu = [], []
    for group in groups:
        if group[0] in keys_of_reference:
            of_reference.append(group)
        else:
            of_imu.append(group)
    rejected_reference = _holm(of_reference)
    rejected = _holm(of_imu)
    lines = list(notes)
    differences = []
    for name, chi2, k, p in groups:
        if name not in rejected | rejected_reference:
            continue
        text = (
            f'{name}: differs by {np.sqrt(chi2 / k):.1f} combined sd (rms of {k}), chance {p:.1g}'
        )
        lines.append(text)
        if name in rejected:
            differences.append(text)
    linear = {'.'.join(effect.key) for effect in first.model.effects if effect.role == Role.LINEAR}
    if rejected & linear and MOUNT_AXES in (first.gauge.get('axes'), second.gauge.get('axes')):
        lines.append(
            'off-diagonal terms of a matrix include how the IMU was mounted on the table: '
            'they differ after remounting without a change of the IMU'
        )
    fixed = int(np.count_nonzero(held & ~in_other_axes))
    if fixed:
        lines.append(f'{fixed} parameters are held or fixed in one of them and were not compared')
    if in_other_axes.any():
        names = [name for name, other in zip(common, in_other_axes) if other]
        lines.append(
            f'not compared, because their axes differ by {np.degrees(angle):.2g} deg:'
            f' {listed(names)}'
        )
    if len(parts) < 2:
        lines.append(
            'agreement of the calibrations cannot be tested: the uncertainties of imported values'
            ' are unknown'
        )
        return Comparison(rows, None, tuple(lines))
    reference_agree = None
    if of_reference:
        reference_agree = not rejected_reference
        word = 'agree' if reference_agree else 'differ'
        lines.append(f'table and clock {word}, which is no property of the IMU')
    if not of_imu:
        lines.append(
            'agreement of the calibrations cannot be tested: no parameter of the IMU is determined'
            ' in both'
        )
        return Comparison(rows, None, tuple(lines), reference_agree)
    verdict = 'the calibrations disagree' if rejected else 'the calibrations agree'
    if in_other_axes.any():
        verdict += f'; {int(in_other_axes.sum())} parameters in other axes were not compared'
    lines.append(verdict)
    return Comparison(rows, not rejected, tuple(lines), reference_agree, tuple(differences))


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
    if (
        first.model.temperature_ref_c != second.model.temperature_ref_c
        and first.model.needs_temperature
    ):
        notes.append('note: the reference temperatures differ, so the biases need not agree')
    return notes


def _groups(
    names: Sequence[str], difference: np.ndarray, covariance: np.ndarray, held: np.ndarray
) -> list[Group]:
    """Return (group, chi-square, number, probability) for each SENSOR.EFFECT."""
    keys = [name.rpartition('.')[0] for name in names]
    found = []
    for key in dict.fromkeys(keys):
        index = np.array([k == key for k in keys]) & ~held
        if not index.any():
            continue
        block = covariance[np.ix_(index, index)]
        d = difference[index]
        scale = np.sqrt(np.maximum(np.diag(block), 1e-300))
        correlation = block / np.outer(scale, scale)
        chi2 = float(
            (d / scale) @ np.linalg.pinv(correlation, rcond=1e-9, hermitian=True) @ (d / scale)
        )
        rank = max(int(np.linalg.matrix_rank(correlation, tol=1e-9, hermitian=True)), 1)
        found.append((key, chi2, rank, float(chdtrc(rank, chi2))))
    return found


def _holm(groups: Sequence[Group]) -> set[str]:
    """Return the groups that are rejected at COMPARISON_P_VALUE, all groups accounted for."""
    rejected = set()
    ordered = sorted(groups, key=lambda g: g[3])
    for k, (name, _, _, probability) in enumerate(ordered):
        if probability > COMPARISON_P_VALUE / (len(ordered) - k):
            break
        rejected.add(name)
    return rejected
