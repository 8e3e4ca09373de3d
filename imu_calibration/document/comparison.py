"""
Whether two calibrations of the same IMU agree.

The IMU is judged apart from table and clock, in one convention of axes and origin.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from imu_calibration.core.errors import InputError
from imu_calibration.core.exit_codes import exit_code_of
from imu_calibration.document.calibration import HAND_AXES, Calibration, listed
from imu_calibration.document.exports.affine import lower_times_rotation
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.estimation.solution import FIXED, HELD

COMPARISON_P_VALUE = 0.01
"""Significance level: two calibrations differ when the p-value is below this."""
MOTION_COLUMNS = {'force', 'rate', 'angular acceleration', 'joint rate', 'vibration'}
"""Quantities with components along the axes of the sensor (`ColumnGroup.uses`)."""
TABLE_AXES = 'mount'
"""Axes of a calibration on a table: those of the mount."""


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

    @property
    def exit_code(self) -> int:
        """3 where the calibrations of the IMU disagree, otherwise 0."""
        return exit_code_of(self.reasons)

    @property
    def reasons(self) -> list[str]:
        """Why the exit code is 3, a line each."""
        return [line for line in self.lines if self.agree is False]


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
    axes = {first.gauge.get('axes'), second.gauge.get('axes')}
    if axes == {TABLE_AXES, HAND_AXES}:
        note = 'both are compared in the axes of the accelerometer'
        return _compared_turned(first, second, common, [*notes, note])
    comparison = _compared(first, second, common, notes)
    if comparison.agree is False and axes == {TABLE_AXES}:
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
    covariance follows by differences. `compare` omits the effects that a rotation mixes with
    others (`_kept_axes`) where the axes of both files differ too much.
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
        gauge={**calibration.gauge, 'axes': HAND_AXES},
    )


def _turned(model, values):
    """Return the values in the axes of the accelerometer."""
    turned = values.copy()
    matrix = model.value('accelerometer', Role.LINEAR, values)
    _, rotation = lower_times_rotation(matrix)
    for effect in model.effects:
        part = model.slices[effect.key]
        if effect.role is Role.ARMS:
            arms = values[part].reshape(3, 3)
            turned[part] = ((arms - arms.mean(axis=0)) @ rotation.T).ravel()
        else:
            turned[part] = effect.in_other_axes(values[part], rotation)
    return turned


def _compared_turned(first, second, common, notes):
    """Compare the common parameters of two calibrations in the axes of the accelerometer."""
    rotations = []
    for calibration in (first, second):
        matrix = calibration.model.value('accelerometer', Role.LINEAR, calibration.values)
        _, rotation = lower_times_rotation(matrix)
        rotations.append(rotation)
    # The angle of a rotation R: cos(angle) = (trace(R) - 1) / 2.
    cosine = 0.5 * (np.trace(rotations[0] @ rotations[1].T) - 1.0)
    angle = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return _compared(
        in_accelerometer_axes(first), in_accelerometer_axes(second), common, notes, angle=angle
    )


def _kept_axes(calibration):
    """
    Return {name: largest value of its effect} of parameters in the axes of their own file.

    A rotation of the true motion mixes their columns with columns of other effects.
    """
    found = {}
    for effect in calibration.model.effects:
        used = set().union(*(group.uses for group in effect.groups)) & MOTION_COLUMNS
        is_mixed = effect.role is Role.TERM and effect.input_order is None and bool(used)
        if is_mixed and effect.sensor in SENSORS:
            largest = float(
                np.max(np.abs(calibration.values[calibration.model.slices[effect.key]]))
            )
            found |= dict.fromkeys(effect.param_names(), largest)
    return found


def _compared(first, second, common, notes, *, angle=0.0):
    """
    Compare the common parameters of two calibrations.

    `angle`: rotation, rad, between the axes in which the parameters of `_kept_axes` are.
    """
    a, b = ([c.param_names.index(name) for name in common] for c in (first, second))
    difference = second.values[b] - first.values[a]
    parts = [
        c.covariance[np.ix_(at, at)] for c, at in ((first, a), (second, b)) if c.uncertainty_known
    ]
    covariance = sum(parts, np.zeros((len(common), len(common))))
    held = np.array(
        [bool({first.status[i], second.status[j]} & {HELD, FIXED}) for i, j in zip(a, b)]
    )
    sd = np.sqrt(np.diag(covariance))

    # A rotation by the angle changes a coefficient by at most about the angle times the largest.
    sizes = [_kept_axes(each) for each in (first, second)]
    turned = np.array([angle * max(each.get(name, 0.0) for each in sizes) for name in common])
    in_other_axes = turned > sd
    held |= in_other_axes
    units = {
        name: effect.unit_of(k)
        for effect in first.model.effects
        for k, name in enumerate(effect.param_names())
    }
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
    lines = notes + [
        f'{name}: differs by {np.sqrt(chi2 / k):.1f} combined sd (rms of {k}), chance {p:.1g}'
        for name, chi2, k, p in groups
        if name in rejected | rejected_reference
    ]
    linear = {'.'.join(effect.key) for effect in first.model.effects if effect.role == Role.LINEAR}
    if rejected & linear and TABLE_AXES in (first.gauge.get('axes'), second.gauge.get('axes')):
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
    lines.append('the calibrations disagree' if rejected else 'the calibrations agree')
    return Comparison(rows, not rejected, tuple(lines), reference_agree)


def _ratio(difference, sd):
    return float(abs(difference) / sd) if sd > 0 else (0.0 if difference == 0 else float('inf'))


def _notes(first, second):
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


def _groups(names, difference, covariance, held):
    """Return (group, chi-square, number, probability) for each SENSOR.EFFECT."""
    keys = [name.rpartition('.')[0] for name in names]
    found = []
    for key in dict.fromkeys(keys):
        index = np.array([k == key for k in keys]) & ~held
        if not index.any():
            continue
        block, d = covariance[np.ix_(index, index)], difference[index]
        scale = np.sqrt(np.maximum(np.diag(block), 1e-300))
        correlation = block / np.outer(scale, scale)
        chi2 = float(
            (d / scale) @ np.linalg.pinv(correlation, rcond=1e-9, hermitian=True) @ (d / scale)
        )
        rank = max(int(np.linalg.matrix_rank(correlation, tol=1e-9, hermitian=True)), 1)
        found.append((key, chi2, rank, float(chdtrc(rank, chi2))))
    return found


def _holm(groups):
    """Return the groups that are rejected at COMPARISON_P_VALUE, all groups accounted for."""
    rejected = set()
    ordered = sorted(groups, key=lambda g: g[3])
    for k, (name, _, _, probability) in enumerate(ordered):
        if probability > COMPARISON_P_VALUE / (len(ordered) - k):
            break
        rejected.add(name)
    return rejected
