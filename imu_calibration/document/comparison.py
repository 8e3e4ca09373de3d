"""Whether two calibrations of the same IMU agree."""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from imu_calibration.core.errors import InputError
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.base import Role
from imu_calibration.estimation.solution import FIXED, HELD

COMPARISON_P_VALUE = 0.01
"""Significance level: two calibrations differ when the p-value is below this."""


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
    Whether no group differs significantly, corrected for the number of groups; None when undecided.
    """
    lines: tuple
    """The verdict as text."""


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
    degrees of freedom when both are honest; groups are judged at 1 % over all groups (Holm).

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
    rejected = _holm(groups)
    lines = notes + [
        f'{name}: differs by {np.sqrt(chi2 / k):.1f} combined sd (rms of {k}), chance {p:.1g}'
        for name, chi2, k, p in groups
        if name in rejected
    ]
    linear = {'.'.join(effect.key) for effect in first.model.effects if effect.role == Role.LINEAR}
    if rejected & linear and 'mount' in (first.gauge.get('axes'), second.gauge.get('axes')):
        lines.append(
            'off-diagonal terms of a matrix include how the IMU was mounted on the table: '
            'they differ after remounting without a change of the IMU'
        )
    if held.any():
        lines.append(
            f'{int(held.sum())} parameters are held or fixed in one of them and were not compared'
        )
    if len(parts) < 2:
        lines.append(
            'agreement of the calibrations cannot be tested: the uncertainties of imported values'
            ' are unknown'
        )
        return Comparison(rows, None, tuple(lines))
    lines.append('the calibrations disagree' if rejected else 'the calibrations agree')
    return Comparison(rows, not rejected, tuple(lines))


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
