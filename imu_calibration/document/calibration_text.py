"""The calibration as a YAML document, with the checks of a file that is read."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from imu_calibration.core.documents import from_text, plain, to_text
from imu_calibration.core.errors import DocumentError, InputError, shortened
from imu_calibration.core.readings import RawReadings
from imu_calibration.document.calibration import Calibration, with_nominal
from imu_calibration.document.decision import HARMS, SensorDecision
from imu_calibration.document.proof_entry import ProofEntry
from imu_calibration.effects.base import SECTIONS, SENSORS, Effect, Role
from imu_calibration.effects.catalogue import CATALOGUE, JOINTS, Catalogue
from imu_calibration.effects.sensor_model import BASE, SensorModel
from imu_calibration.estimation.solution import Status
from imu_calibration.kinematics.joint import JointNames

CONDITION_LIMIT = 20.0
"""A sensor matrix with a larger condition number cannot belong to three independent axes."""
MAX_VALUE = 1e9
"""
Values and standard deviations above this occur with no sensor in any unit; their products would
overflow.
"""
RANGE_C = (-273.15, 1000.0)
"""Temperatures of a sensor, degrees Celsius."""
MAX_DOCUMENT_JOINTS = 30
COVARIANCE_ROUNDING = 1e-6
"""
Tolerance for rounding, relative to the variances, of the test that a covariance is positive
semidefinite.
"""


def _is_number(value: Any, low: float = -MAX_VALUE, high: float = MAX_VALUE) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and low <= value <= high


def _is_size(value: Any) -> bool:
    return _is_number(value, 0.0)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= 2**62


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_list_of(kind: Callable[[Any], bool], length: int | None = None) -> Callable[[Any], bool]:
    return lambda value: (
        isinstance(value, (list, tuple)) and length in (None, len(value)) and all(map(kind, value))
    )


def _is_range(value: Any, kind: Callable[[Any], bool] = _is_number) -> bool:
    return _is_list_of(kind, 2)(value) and value[0] <= value[1]


def _is_temperature_range(value: Any) -> bool:
    return _is_range(value) and RANGE_C[0] <= value[0] and value[1] <= RANGE_C[1]


def _or_none(kind: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: value is None or kind(value)


def _is_direction(value: Any) -> bool:
    weights = value.get('parameters') if isinstance(value, dict) else None
    return (
        isinstance(weights, dict)
        and _is_text(value.get('needs'))
        and all(_is_text(k) and _is_number(v) for k, v in weights.items())
    )


def _is_joint_errors(value: Any) -> bool:
    return isinstance(value, dict) and all(
        _is_list_of(_is_text)(value.get(name))
        and len(set(value[name])) == len(value[name]) <= MAX_DOCUMENT_JOINTS
        for name in ('turning', 'zeros', 'angles')
    )


_NOISE = {
    'noise_sd': _is_list_of(_is_size, 3),
    'between_window_sd': _is_size,
    'between_window_dof': _is_size,
    'wander_sd': _is_size,
}
_ERRORS: dict[str, Callable[[Any], bool]] = {
    'before': _is_size,
    'after': _is_size,
    'ci95': lambda value: _is_range(value, _is_size),
}
"""Fields that errors in a regime of motion must have."""
_PROOF = {**_ERRORS, 'unit': _is_text, 'windows': _is_count}
"""Fields that the errors of a sensor must have."""
_FURTHER: dict[str, Callable[[Any], bool]] = {
    'unit': _is_text,
    'windows': _is_count,
    'seconds': _is_size,
    'delay_s': _is_number,
    'delay_explains': _is_number,
}
"""Fields that they may have."""


def _are_errors(value: Any, needed: Mapping[str, Callable[[Any], bool]]) -> bool:
    """Return whether a mapping has the fields `needed`, and no other one of a wrong type."""
    if not isinstance(value, dict) or not all(name in value for name in needed):
        return False
    known = {**_FURTHER, **needed}
    return all(kind(value[name]) for name, kind in known.items() if name in value)


def _is_proof(value: Any) -> bool:
    if not _are_errors(value, _PROOF):
        return False
    earlier, regimes = value.get('earlier'), value.get('regimes') or {}
    of_earlier = {name: kind for name, kind in _ERRORS.items() if name != 'before'}
    if earlier is not None and not _are_errors(earlier, of_earlier):
        return False
    return isinstance(regimes, dict) and all(
        _is_text(name) and _are_errors(part, _ERRORS) for name, part in regimes.items()
    )


_SECTION = {'effects': _is_list_of(_is_text)}
KEYS_OF_PARTS = {
    **{section: _SECTION for section in SECTIONS},
    'covariance': {},
    'covariance_terms': {},
    'frame_id': _is_text,
    'absent': lambda value: _is_list_of(SENSORS.__contains__)(value) and len(value) < len(SENSORS),
    'reference_temperature_c': lambda value: _is_number(value, *RANGE_C),
    'joint_names': lambda value: (
        _is_list_of(_is_text)(value) and len(set(value)) == len(value) <= MAX_DOCUMENT_JOINTS
    ),
    'effects': {},
    'joint_errors': _or_none(_is_joint_errors),
    'gauge': {},
    'provenance': {},
    'readings': {},
    'undetermined_directions': _or_none(_is_list_of(_is_direction)),
    'statistics': {sensor: _NOISE for sensor in SENSORS},
    'conditions': {
        'largest_rate': _or_none(_is_size),
        'temperature_range_c': _or_none(_is_temperature_range),
        'date': _is_text,
    },
    'decision': dict.fromkeys(SENSORS, tuple(SensorDecision).__contains__),
    'decision_reasons': {sensor: _is_text for sensor in SENSORS},
    'notes': _is_list_of(_is_text),
    'proof': {sensor: _is_proof for sensor in SENSORS},
}
"""
Part of a document -> requirement if present: a function, or a mapping with requirements of its
entries.
"""


def check_parts(document: Mapping, known: Mapping = KEYS_OF_PARTS, place: str = '') -> None:
    """
    Refuse a document in which a part of `known` has another type or range.

    Other parts are not checked.

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
                raise DocumentError(
                    f"'{place}{name}' must be a mapping, got {shortened(repr(value))}; "
                    'correct the calibration file or calibrate again',
                    code='not_a_mapping',
                )
            check_parts(value or {}, wanted, f'{place}{name}.')
        elif not wanted(value):
            raise DocumentError(
                f"'{place}{name}' must have the type and range of the format, got"
                f' {shortened(repr(value))}; correct the calibration file or calibrate again',
                code='part_value',
            )


def check_numbers(calibration: Calibration) -> Calibration:
    """
    Return the calibration if its values are possible for an IMU.

    In the result a sensor with an ill-conditioned matrix has nominal parameters and the decision
    `harms`; the other sensor can be used.

    Raises
    ------
    DocumentError
        When a value is not finite, a covariance is not positive semidefinite, or both sensor
        matrices are ill-conditioned.

    """
    values, covariance = calibration.values, calibration.covariance
    effects = calibration.model.effects
    levels = np.repeat([e.role is Role.LIMIT for e in effects], [e.size for e in effects])
    if not np.all(np.isfinite(values[~levels])) or not np.all(np.isfinite(covariance)):
        raise DocumentError(
            'every value of a calibration must be a finite number, some are not; calibrate again',
            code='not_finite',
        )
    if not np.all(values[levels] > 0):
        raise DocumentError(
            'a saturation level must be larger than zero, one is not; calibrate again',
            code='saturation_level',
        )
    if max(np.max(np.abs(values[~levels])), math.sqrt(np.max(np.abs(covariance)))) > MAX_VALUE:
        raise DocumentError(
            f'values and standard deviations must be below {MAX_VALUE:g}, some are not; calibrate'
            ' again',
            code='too_large',
        )
    _check_covariance(covariance)
    terms, variance = calibration.covariance_terms, np.diag(covariance)
    parts = np.array(list(terms.values()))
    if terms and not np.all(
        np.abs(parts.sum(axis=0) - variance) <= COVARIANCE_ROUNDING * np.abs(parts).sum(axis=0)
    ):
        raise DocumentError(
            'the terms of each variance must sum to it, some do not; calibrate again',
            code='covariance_terms',
        )
    for sensor in SENSORS:
        for needed in BASE:
            if not calibration.has(sensor, needed):
                raise DocumentError(
                    f"the {sensor} must have '{needed}', it is missing; calibrate again",
                    code='effect_missing',
                )
    return _without_ill_conditioned(calibration)


def _without_ill_conditioned(calibration: Calibration) -> Calibration:
    condition = {
        sensor: float(np.linalg.cond(calibration.of(sensor, Role.LINEAR))) for sensor in SENSORS
    }
    wrong = {
        sensor: (
            f'the {sensor} matrix must be well conditioned (below {CONDITION_LIMIT:g}), its'
            f' condition number is {number:.3g}; calibrate again with more attitudes'
        )
        for sensor, number in condition.items()
        if not number < CONDITION_LIMIT
    }
    if len(wrong) == len(SENSORS):
        raise DocumentError(next(iter(wrong.values())), code='ill_conditioned')
    if not wrong:
        return calibration
    return replace(
        with_nominal(calibration, list(wrong)),
        decision=calibration.decision | dict.fromkeys(wrong, str(HARMS)),
        decision_reasons=calibration.decision_reasons | wrong,
    )


def _check_covariance(covariance: np.ndarray) -> None:
    variance = np.diag(covariance)
    if np.any(variance < 0):
        raise DocumentError(
            'variances must not be negative, some are; calibrate again', code='negative_variance'
        )
    scale = np.sqrt(np.where(variance > 0, variance, 1.0))
    correlation = covariance / np.outer(scale, scale)
    if (
        np.max(np.abs(correlation - correlation.T)) > COVARIANCE_ROUNDING
        or np.linalg.eigvalsh(correlation)[0] < -COVARIANCE_ROUNDING
    ):
        raise DocumentError(
            'the covariance must be symmetric and positive semidefinite, it is not; calibrate'
            ' again',
            code='not_a_covariance',
        )


def parts_of(document: Mapping) -> dict[str, Any]:
    """
    Return {field of a Calibration: value} from the mapping of its document, after `check_parts`.

    Raises
    ------
    DocumentError, KeyError, TypeError, ValueError, AttributeError, OverflowError
        When a part is missing or has the wrong form.

    """
    model, entries = _model(document)
    values = np.concatenate([_shaped(entries[e.key]['value'], e) for e in model.effects])
    status = [word for e in model.effects for word in _statuses(entries[e.key]['status'], e)]
    for effect in model.effects:
        entry = entries[effect.key]
        _check_unit(entry.get('unit'), effect)
        if not np.all(_shaped(entry.get('sd', np.zeros(effect.shape)), effect) >= 0):
            raise DocumentError(
                f"the standard deviations of '{effect.name}' must not be negative, some are or are"
                ' no numbers; calibrate again',
                code='negative_sd',
            )
    terms = document.get('covariance_terms') or {}
    order = (
        [document['covariance']['names'].index(name) for name in model.param_names] if terms else []
    )
    return {
        'model': replace(model.at(values), centre=_centre(model, entries)),
        'values': values,
        'covariance': _covariance(document.get('covariance'), model, entries),
        'status': tuple(status),
        'frame_id': document.get('frame_id', ''),
        'covariance_terms': {
            str(name): np.asarray(variance, float)[order] for name, variance in terms.items()
        },
        'held_reason': {
            name: str(reason)
            for e in model.effects
            if 'held_reason' in entries[e.key]
            for name, reason in zip(
                e.param_names(),
                np.array(entries[e.key]['held_reason'], dtype=object).reshape(e.size),
                strict=True,
            )
            if reason
        },
        'undetermined': tuple(document.get('undetermined_directions') or ()),
        'absent': tuple(document.get('absent') or ()),
        'notes': tuple(document.get('notes') or ()),
        'readings': RawReadings.from_mapping(document.get('readings') or {}),
        **{
            name: dict(document.get(name) or {})
            for name in (
                'gauge',
                'statistics',
                'conditions',
                'decision',
                'decision_reasons',
                'provenance',
            )
        },
        'proof': {
            sensor: ProofEntry.from_mapping(entry)
            for sensor, entry in (document.get('proof') or {}).items()
            if sensor in SENSORS and entry
        },
    }


def _model(
    document: Mapping[str, Any],
) -> tuple[SensorModel, dict[tuple[str, str], dict[str, Any]]]:
    """Return (SensorModel, {(sensor, effect): entry of the document})."""
    joint_names = JointNames.of(document.get('joint_names', JOINTS), document.get('joint_errors'))
    catalogue = CATALOGUE.with_definitions(document.get('effects') or {})
    owners = {
        effect.name: effect.sensor
        for effect in catalogue.effects(joint_names).values()
        if effect.in_reference
    }
    members, entries = {section: [] for section in SECTIONS}, {}
    for section in SECTIONS:
        part = document.get(section) or {'effects': []}
        for name in part['effects']:
            sensor = owners.get(name, section)
            if (sensor, name) in entries:
                raise DocumentError(
                    f"an effect must be listed once, '{name}' is listed twice; remove one",
                    code='effect_repeated',
                )
            members[sensor].append(name)
            entries[sensor, name] = part[name]
    return (
        SensorModel(
            tuple(members['accelerometer']),
            tuple(members['gyroscope']),
            tuple(members['reference']),
            joint_names=joint_names,
            temperature_ref_c=float(document.get('reference_temperature_c', 25.0)),
            catalogue=catalogue,
        ),
        entries,
    )


def _shaped(value: Any, effect: Effect) -> np.ndarray:
    array = np.asarray(value, float)
    if array.shape != effect.shape or np.asarray(value).dtype == bool:
        raise DocumentError(
            f"'{effect.name}' must be numbers of shape {effect.shape}, got {array.shape}; correct"
            ' the file',
            code='shape',
        )
    return array.ravel()


def _statuses(value: Any, effect: Effect) -> Iterator[Status]:
    words = np.array(value, dtype=object).reshape(effect.size).tolist()
    if any(word not in tuple(Status) for word in words):
        raise DocumentError(
            f"the status of '{effect.name}' must be {', '.join(Status)}; correct the file",
            code='status_unknown',
        )
    return map(Status, words)


def _check_unit(found: Any, effect: Effect) -> None:
    wanted = effect.unit if isinstance(effect.unit, str) else list(effect.unit)
    if found is not None and found != wanted:
        raise DocumentError(
            f"the unit of '{effect.name}' must be {wanted}, got {shortened(repr(found))}; correct"
            ' the file',
            code='unit',
        )


def _centre(
    model: SensorModel, entries: Mapping[tuple[str, str], Mapping[str, Any]]
) -> dict[str, np.ndarray]:
    """Return column group -> the value from which its columns are measured."""
    known = {group.name: group for e in model.effects for group in e.groups}
    found = {
        name: np.asarray(value, float)
        for e in model.effects
        for name, value in (entries[e.key].get('centre') or {}).items()
    }
    for name, value in found.items():
        if (
            name not in known
            or value.shape != (known[name].width,)
            or not np.all(np.isfinite(value))
        ):
            raise DocumentError(
                f'the centre {shortened(repr(name))} must have one finite number for each column of'
                ' its effect; correct the calibration file',
                code='centre',
            )
    return found


def _covariance(
    given: Mapping[str, Any] | None,
    model: SensorModel,
    entries: Mapping[tuple[str, str], Mapping[str, Any]],
) -> np.ndarray:
    """
    Return the covariance in the model's order.

    Without one, the diagonal of the standard deviations.
    """
    if not given:
        return np.diag(
            np.concatenate([_shaped(entries[e.key]['sd'], e) for e in model.effects]) ** 2
        )
    order = [given['names'].index(name) for name in model.param_names]
    return np.asarray(given['matrix'], float)[np.ix_(order, order)]


CALIBRATION_FORMAT = 'imu_calibration/1'
_WHERE_KNOWN = ('decision', 'decision_reasons', 'notes', 'proof')
"""Parts of a document that are omitted while unknown."""


def checked_tolerances(
    mapping: Any, catalogue: Catalogue = CATALOGUE
) -> dict[str, dict[str, float]]:
    """
    Return the content of a tolerance file when it is one: {section: {effect: number above zero}}.

    Raises
    ------
    InputError
        When a section or an effect does not exist, or a tolerance is no number above zero.

    """
    known = {
        section: [name for owner, name in catalogue.effects() if owner == section]
        for section in SECTIONS
    }
    for section, entries in mapping.items():
        if section not in known or not isinstance(entries, dict):
            raise InputError(
                f'a tolerance file must have the mappings {", ".join(SECTIONS)}, it has'
                f' {shortened(repr(section))}: {shortened(repr(entries))}; correct it',
                code='tolerance_section',
            )
        for name, value in entries.items():
            if name not in known[section]:
                raise InputError(
                    f'a tolerance must be of an effect of the {section}, {shortened(repr(name))} is'
                    f' not one; its effects are {", ".join(known[section])}',
                    code='tolerance_name',
                )
            if (
                isinstance(value, bool)
                or not isinstance(value, (int, float))
                or not 0 < value < np.inf
            ):
                raise InputError(
                    f"the tolerance of '{name}' must be a number above zero, got"
                    f' {shortened(repr(value))}; correct it'
                )
    return mapping


def calibration_mapping(calibration: Calibration) -> dict:
    """Return the document as plain dicts, lists, floats and strings, in a fixed order."""
    document: dict[str, Any] = {
        'format': CALIBRATION_FORMAT,
        'frame_id': calibration.frame_id,
        'gauge': dict(calibration.gauge),
    }
    if calibration.absent:
        document['absent'] = list(calibration.absent)
    readings = calibration.readings
    if readings.axes or not readings.is_si:
        document['readings'] = readings.to_mapping()
    if calibration.model.definitions:
        document['effects'] = plain(calibration.model.definitions)
    for section in SECTIONS:
        document[section] = _section(calibration, section)
    document['reference_temperature_c'] = float(calibration.model.temperature_ref_c)
    document['joint_names'] = list(calibration.model.joint_names)
    if (errors := calibration.model.joint_names.errors) is not None:
        document['joint_errors'] = errors
    document['covariance'] = {
        'names': list(calibration.param_names),
        'matrix': plain(calibration.covariance),
    }
    if calibration.covariance_terms:
        document['covariance_terms'] = plain(calibration.covariance_terms)
    document['undetermined_directions'] = [
        dict(direction) for direction in calibration.undetermined
    ]
    for name in ('statistics', 'conditions', *_WHERE_KNOWN, 'provenance'):
        part = getattr(calibration, name)
        if name == 'proof':
            part = {sensor: entry.to_mapping() for sensor, entry in part.items()}
        if part or name not in _WHERE_KNOWN:
            document[name] = plain(part)
    return document


def _section(calibration: Calibration, section: str) -> dict[str, Any]:
    effects = [effect for effect in calibration.model.effects if effect.section == section]
    entries: dict[str, Any] = {'effects': [effect.name for effect in effects]}
    for effect in effects:
        part = calibration.model.slices[effect.key]
        status = np.array(calibration.status, dtype=object)[part].reshape(effect.shape)
        entries[effect.name] = {
            'value': plain(calibration.values[part].reshape(effect.shape)),
            'sd': plain(calibration.own_sd[part].reshape(effect.shape)),
            'unit': effect.unit if isinstance(effect.unit, str) else list(effect.unit),
            'status': status.tolist(),
        }
        centre = {
            group.name: calibration.model.centre[group.name]
            for group in effect.groups
            if group.name in calibration.model.centre
        }
        if centre:
            entries[effect.name]['centre'] = plain(centre)
        reasons = [calibration.held_reason.get(name, '') for name in effect.param_names()]
        if any(reasons):
            entries[effect.name]['held_reason'] = (
                np.array(reasons, dtype=object).reshape(effect.shape).tolist()
            )
    return entries


def from_mapping(document: Any) -> Calibration:
    """
    Return the calibration that a document describes.

    Raises
    ------
    DocumentError
        When the format is unknown or newer, a value is missing, not finite or implausible.

    """
    if not isinstance(document, dict):
        raise DocumentError(
            f'a calibration document must be a mapping, got {type(document).__name__}; '
            "give a file written by 'imu_calibration calibrate'",
            code='not_a_mapping',
        )
    _check_format(document.get('format'))
    check_parts(document)
    try:
        calibration = Calibration(**parts_of(document))
    except (
        KeyError,
        TypeError,
        ValueError,
        IndexError,
        AttributeError,
        OverflowError,
        InputError,
    ) as error:
        text = str(error) if isinstance(error, InputError) else f'{type(error).__name__}: {error}'
        raise DocumentError(
            f'a calibration document must have the parts of {CALIBRATION_FORMAT}, one is missing or'
            f' has another shape ({shortened(text, 200)}); calibrate again',
            code=getattr(error, 'code', '') or 'document_parts',
        ) from error
    return check_numbers(calibration)


def _check_format(found: Any) -> None:
    name, _, number = str(found).partition('/')
    if name != 'imu_calibration' or not number.isdigit():
        raise DocumentError(
            f"a calibration document must have 'format: {CALIBRATION_FORMAT}', got"
            f" {shortened(repr(found))}; give a file written by 'imu_calibration calibrate'",
            code='document_format',
        )
    if int(number) > int(CALIBRATION_FORMAT.partition('/')[2]):
        raise DocumentError(
            f"a calibration document must not be newer than '{CALIBRATION_FORMAT}', got"
            f' {shortened(repr(found))}; update imu_calibration',
            code='document_newer',
        )


def calibration_to_text(calibration: Calibration) -> str:
    """Return a calibration as the YAML of its document."""
    return to_text(calibration_mapping(calibration))


def calibration_from_text(text: str) -> Calibration:
    """
    Return the calibration in a YAML document.

    Raises
    ------
    DocumentError
        When it is no calibration, newer, or implausible.

    """
    return from_mapping(from_text(text, 'calibration document'))
