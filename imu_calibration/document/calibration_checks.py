"""Checks of the values in a calibration document; a document that was read needs no further checks."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from imu_calibration.core.errors import DocumentError, shortened
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.decision import HARMS, SensorDecision
from imu_calibration.document.nominal import with_nominal
from imu_calibration.effects.base import SECTIONS, SENSORS, Role
from imu_calibration.effects.sensor_model import BASE

CONDITION_LIMIT = 20.0
"""A sensor matrix with a larger condition number cannot belong to three independent axes."""
LARGEST = 1e9
"""Values and standard deviations above this occur with no sensor in any unit; their products would overflow."""
RANGE_C = (-273.15, 1000.0)
"""Temperatures of a sensor, degrees Celsius."""
MOST_JOINTS = 30
ROUNDING = 1e-6
"""Tolerance for rounding, relative to the variances, of the test that a covariance is positive semidefinite."""


def _is_number(value, low=-LARGEST, high=LARGEST):
    return isinstance(value, (int, float)) and not isinstance(value, bool) and low <= value <= high


def _is_size(value):
    return _is_number(value, 0.0)


def _is_count(value):
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= 2**62


def _is_text(value):
    return isinstance(value, str)


def _is_range(value, kind=_is_number):
    return isinstance(value, (list, tuple)) and len(value) == 2 and all(map(kind, value)) and value[0] <= value[1]


def _is_temperature_range(value):
    return _is_range(value) and RANGE_C[0] <= value[0] and value[1] <= RANGE_C[1]


def _is_triple_of_sizes(value):
    return isinstance(value, (list, tuple)) and len(value) == 3 and all(map(_is_size, value))


def _or_none(kind):
    return lambda value: value is None or kind(value)


def _is_list_of(kind):
    return lambda value: isinstance(value, (list, tuple)) and all(map(kind, value))


def _is_direction(value):
    weights = value.get('parameters') if isinstance(value, dict) else None
    return isinstance(weights, dict) and _is_text(value.get('needs')) and all(_is_text(k) and _is_number(v) for k, v in weights.items())


def _is_joint_errors(value):
    return isinstance(value, dict) and all(_is_list_of(_is_text)(value.get(name))
                                           and len(set(value[name])) == len(value[name]) <= MOST_JOINTS
                                           for name in ('turning', 'zeros', 'angles'))


def _is_decision(value):
    return value in tuple(SensorDecision)


_NOISE = {'noise_sd': _is_triple_of_sizes, 'between_window_sd': _is_size, 'wander_sd': _is_size}
_PROOF = {'before': _is_size, 'after': _is_size, 'ci95': lambda value: _is_range(value, _is_size), 'unit': _is_text, 'windows': _is_count}


def _is_proof(value):
    return isinstance(value, dict) and all(name in value and kind(value[name]) for name, kind in _PROOF.items())


_SECTION = {'effects': _is_list_of(_is_text)}
KNOWN = {
    **{section: _SECTION for section in SECTIONS}, 'covariance': {}, 'covariance_terms': {},
    'frame_id': _is_text, 'reference_temperature_c': lambda value: _is_number(value, *RANGE_C),
    'joint_names': lambda value: _is_list_of(_is_text)(value) and len(set(value)) == len(value) <= MOST_JOINTS,
    'effects': {}, 'joint_errors': _or_none(_is_joint_errors), 'gauge': {}, 'provenance': {},
    'undetermined_directions': _or_none(_is_list_of(_is_direction)),
    'statistics': {sensor: _NOISE for sensor in SENSORS},
    'conditions': {'largest_rate': _or_none(_is_size), 'temperature_range_c': _or_none(_is_temperature_range), 'date': _is_text},
    'decision': {sensor: _is_decision for sensor in SENSORS}, 'decision_reasons': {sensor: _is_text for sensor in SENSORS},
    'notes': _is_list_of(_is_text),
    'proof': {sensor: _is_proof for sensor in SENSORS},
}
"""Part of a document -> requirement if present: a function, or a mapping with requirements of its entries."""


def check_parts(document: Mapping, known: Mapping = KNOWN, place: str = '') -> None:
    """
    Refuse a document in which a part of `known` has another type or range; other parts are not checked.

    Raises
    ------
    DocumentError

    """
    for name, wanted in known.items():
        if name not in document:
            continue
        value = document[name]
        if isinstance(wanted, dict):
            if not isinstance(value, dict) and (value is not None or place):
                raise DocumentError(f"'{place}{name}' must be a mapping, got {shortened(repr(value))}; "
                                    "correct the calibration file or calibrate again", code='not_a_mapping')
            check_parts(value or {}, wanted, f'{place}{name}.')
        elif not wanted(value):
            raise DocumentError(f"'{place}{name}' must have the type and range of the format, got {shortened(repr(value))}; "
                                "correct the calibration file or calibrate again", code='part_value')


def check_numbers(calibration: Calibration) -> Calibration:
    """
    Return the calibration if its values are possible for an IMU.

    In the result a sensor with an ill-conditioned matrix has nominal parameters and the decision `harms`; the other sensor can be used.

    Raises
    ------
    DocumentError
        When a value is not finite, a covariance is not positive semidefinite, or both sensor matrices are ill-conditioned.

    """
    values, covariance = calibration.values, calibration.covariance
    effects = calibration.model.effects
    levels = np.repeat([e.role is Role.LIMIT for e in effects], [e.size for e in effects])
    if not np.all(np.isfinite(values[~levels])) or not np.all(np.isfinite(covariance)):
        raise DocumentError('every value of a calibration must be a finite number, some are not; calibrate again', code='not_finite')
    if not np.all(values[levels] > 0):
        raise DocumentError('a saturation level must be larger than zero, one is not; calibrate again', code='saturation_level')
    if max(np.max(np.abs(values[~levels])), math.sqrt(np.max(np.abs(covariance)))) > LARGEST:
        raise DocumentError(f'values and standard deviations must be below {LARGEST:g}, some are not; calibrate again', code='too_large')
    _check_covariance(covariance)
    terms, variance = calibration.covariance_terms, np.diag(covariance)
    parts = np.array(list(terms.values()))
    if terms and not np.all(np.abs(parts.sum(axis=0) - variance) <= ROUNDING * np.abs(parts).sum(axis=0)):
        raise DocumentError('the terms of each variance must sum to it, some do not; calibrate again', code='covariance_terms')
    for sensor in SENSORS:
        for needed in BASE:
            if not calibration.has(sensor, needed):
                raise DocumentError(f"the {sensor} must have '{needed}', it is missing; calibrate again", code='effect_missing')
    return _without_ill_conditioned(calibration)


def _without_ill_conditioned(calibration):
    condition = {sensor: float(np.linalg.cond(calibration.of(sensor, Role.LINEAR))) for sensor in SENSORS}
    wrong = {sensor: f'the {sensor} matrix must be well conditioned (below {CONDITION_LIMIT:g}), its condition number is {number:.3g}; '
                     'calibrate again with more attitudes' for sensor, number in condition.items() if not number < CONDITION_LIMIT}
    if len(wrong) == len(SENSORS):
        raise DocumentError(next(iter(wrong.values())), code='ill_conditioned')
    if not wrong:
        return calibration
    return replace(with_nominal(calibration, list(wrong)), decision=calibration.decision | dict.fromkeys(wrong, str(HARMS)),
                   decision_reasons=calibration.decision_reasons | wrong)


def _check_covariance(covariance):
    variance = np.diag(covariance)
    if np.any(variance < 0):
        raise DocumentError('variances must not be negative, some are; calibrate again', code='negative_variance')
    scale = np.sqrt(np.where(variance > 0, variance, 1.0))
    correlation = covariance / np.outer(scale, scale)
    if np.max(np.abs(correlation - correlation.T)) > ROUNDING or np.linalg.eigvalsh(correlation)[0] < -ROUNDING:
        raise DocumentError('the covariance must be symmetric and positive semidefinite, it is not; calibrate again',
                            code='not_a_covariance')
