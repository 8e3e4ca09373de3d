"""The calibration as a YAML document, with the checks of a file that is read."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from imu_calibration.core.documents import from_text, plain, to_text
from imu_calibration.core.errors import DocumentError, InputError, shortened
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.schema import (
    Document,
    Requirement,
    anything,
    array,
    equal,
    flag,
    list_of,
    mapping,
    maybe,
    number,
    require,
    text,
    whole,
)
from imu_calibration.document.calibration import Calibration, with_nominal
from imu_calibration.document.decision import HARMS, SensorDecision
from imu_calibration.document.proof_entry import ProofEntry
from imu_calibration.effects.base import AXES, INPUT_OF, SECTIONS, SENSORS, Effect, Role
from imu_calibration.effects.catalogue import CATALOGUE, JOINTS, Catalogue
from imu_calibration.effects.expressions import ColumnCentre
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


_SIZE = number(0.0, MAX_VALUE)
_NOISE = {
    'noise_sd': list_of(_SIZE, len(AXES)),
    'between_window_sd': _SIZE,
    'between_window_dof': _SIZE,
    'wander_sd': _SIZE,
}
_AFTER = {'after': _SIZE, 'ci95': list_of(_SIZE, 2, rising=True)}
_ERRORS = {'before': _SIZE, **_AFTER}
_FURTHER = {'unit': text(), 'windows': whole(), 'seconds': _SIZE}
_PROOF = mapping(
    {**_ERRORS, 'unit': text(), 'windows': whole()},
    {
        'seconds': _SIZE,
        'delay_s': number(-MAX_VALUE, MAX_VALUE),
        'delay_explains': number(-MAX_VALUE, MAX_VALUE),
        'regimes': maybe(mapping(each=mapping(_ERRORS, _FURTHER))),
        'one_attitude': flag(),
        'few_directions': flag(),
        'earlier': maybe(mapping(_AFTER)),
    },
)
_JOINT_NAMES = list_of(text(), most=MAX_DOCUMENT_JOINTS, distinct=True)
_JOINT_ERRORS = mapping(
    {'turning': _JOINT_NAMES, 'zeros': _JOINT_NAMES, 'angles': _JOINT_NAMES},
    {
        'places': list_of(text(), most=2 * MAX_DOCUMENT_JOINTS, distinct=True),
        'angle_sd': maybe(_SIZE),
        'place_sd': maybe(_SIZE),
    },
    closed=True,
)
_DIRECTION = mapping({'parameters': mapping(each=number(-MAX_VALUE, MAX_VALUE)), 'needs': text()})
_SECTION = mapping({'effects': list_of(text())})
PARTS = mapping(
    optional={
        **dict.fromkeys(SECTIONS, _SECTION),
        'frame_id': text(),
        'absent': list_of(text(*SENSORS), 0, 1),
        'reference_temperature_c': number(*RANGE_C),
        'joint_names': _JOINT_NAMES,
        'joint_errors': maybe(_JOINT_ERRORS),
        **dict.fromkeys(('effects', 'gauge', 'provenance', 'readings'), maybe(mapping())),
        'covariance': maybe(mapping({'names': list_of(text()), 'matrix': anything})),
        'covariance_terms': maybe(mapping()),
        'undetermined_directions': maybe(list_of(_DIRECTION)),
        'statistics': maybe(mapping(optional=dict.fromkeys(SENSORS, mapping(optional=_NOISE)))),
        'conditions': maybe(
            mapping(
                optional={
                    'largest_rate': maybe(_SIZE),
                    'temperature_range_c': maybe(list_of(number(*RANGE_C), 2, rising=True)),
                    'date': text(),
                }
            )
        ),
        'decision': maybe(mapping(optional=dict.fromkeys(SENSORS, text(*SensorDecision)))),
        'decision_reasons': maybe(mapping(optional=dict.fromkeys(SENSORS, text()))),
        'notes': maybe(list_of(text())),
        'proof': maybe(mapping(optional=dict.fromkeys(SENSORS, _PROOF))),
    }
)
CALIBRATION = Document(
    'calibration',
    PARTS,
    'correct the calibration file or calibrate again',
    dict.fromkeys(('type', 'range', 'length'), 'part_value')
    | dict.fromkeys(('missing', 'unknown'), 'document_parts'),
)


def _entries_of(model: SensorModel, names: Collection[str]) -> Requirement:
    """
    Return the requirement of the parts that depend on the effects of a document.

    Parameters
    ----------
    model : SensorModel
        Its effects.
    names : collection of str
        Names of its covariance, in their order; empty: each effect has standard deviations.

    """
    sections: dict[str, dict[str, Requirement]] = {section: {} for section in SECTIONS}
    for effect in model.effects:
        sections[effect.section][effect.name] = _entry_of(effect, with_sd=not names)
    parts = {section: mapping(entries) for section, entries in sections.items() if entries}
    each_variance = array((len(names),), number())
    covariance = {
        'names': list_of(text(), including=model.param_names),
        'matrix': array((len(names), len(names)), number(code='not_finite')),
    }
    return mapping(
        parts,
        {
            'covariance': mapping(covariance if names else {}),
            'covariance_terms': maybe(mapping(each=each_variance)),
        },
    )


def _entry_of(effect: Effect, with_sd: bool) -> Requirement:
    """Return the requirement of the entry of an effect; `with_sd`: its sd must be there."""
    # Saturation levels may be infinite; `check_numbers` checks the values.
    values = array(effect.shape, number(finite=False, code='document_parts'))
    centre = {group.name: array((group.width,), number(code='centre')) for group in effect.groups}
    slope = {group.name: array((group.width, 3), number(code='centre')) for group in effect.groups}
    unit = effect.unit if isinstance(effect.unit, str) else list(effect.unit)
    needed = {
        'value': values,
        'status': array(effect.shape, text(*Status, code='status_unknown')),
    }
    sd = {'sd': array(effect.shape, number(0.0, code='negative_sd'))}
    further = {
        'unit': maybe(equal(unit, code='unit')),
        'centre': maybe(mapping(optional=centre, closed=True, code='centre')),
        'centre_slope': maybe(mapping(optional=slope, closed=True, code='centre')),
        'held_reason': array(effect.shape, maybe(text())),
    }
    return mapping(needed | sd, further) if with_sd else mapping(needed, further | sd)


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
    levels = calibration.model.mask(lambda effect: effect.role is Role.LIMIT)
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
    largest_value = np.max(np.abs(values[~levels]))
    largest_sd = math.sqrt(np.max(np.abs(covariance)))
    if max(largest_value, largest_sd) > MAX_VALUE:
        raise DocumentError(
            f'values and standard deviations must be below {MAX_VALUE:g}, some are not; calibrate'
            ' again',
            code='too_large',
        )
    _check_covariance(covariance)
    if calibration.covariance_terms:
        variances = np.array(list(calibration.covariance_terms.values()))  # (n_terms, n_params)
        residual = np.abs(variances.sum(axis=0) - np.diag(covariance))
        if not np.all(residual <= COVARIANCE_ROUNDING * np.abs(variances).sum(axis=0)):
            raise DocumentError(
                'the terms of each variance must sum to it, some do not; calibrate again',
                code='covariance_terms',
            )
    for sensor in SENSORS:
        for effect in BASE:
            if not calibration.has(sensor, effect):
                raise DocumentError(
                    f"the {sensor} must have '{effect}', it is missing; calibrate again",
                    code='effect_missing',
                )
    return _without_ill_conditioned(calibration)


def _without_ill_conditioned(calibration: Calibration) -> Calibration:
    """Return the calibration with nominal parameters of a sensor with an ill-conditioned matrix."""
    reasons = {}  # sensor -> why its matrix is refused
    for sensor in SENSORS:
        condition = float(np.linalg.cond(calibration.of(sensor, Role.LINEAR)))
        if not condition < CONDITION_LIMIT:
            reasons[sensor] = (
                f'the {sensor} matrix must be well conditioned (below {CONDITION_LIMIT:g}), its'
                f' condition number is {condition:.3g}; calibrate again with more attitudes'
            )
    if len(reasons) == len(SENSORS):
        raise DocumentError(next(iter(reasons.values())), code='ill_conditioned')
    if not reasons:
        return calibration
    return replace(
        with_nominal(calibration, list(reasons)),
        decision=calibration.decision | dict.fromkeys(reasons, str(HARMS)),
        decision_reasons=calibration.decision_reasons | reasons,
    )


def _check_covariance(covariance: np.ndarray) -> None:
    """Refuse a matrix that is not symmetric and positive semidefinite, up to rounding."""
    variance = np.diag(covariance)
    if np.any(variance < 0):
        raise DocumentError(
            'variances must not be negative, some are; calibrate again', code='negative_variance'
        )
    scale = np.sqrt(np.where(variance > 0, variance, 1.0))
    correlation = covariance / np.outer(scale, scale)
    refused = np.max(np.abs(correlation - correlation.T)) > COVARIANCE_ROUNDING
    if not refused:
        refused = np.linalg.eigvalsh(correlation)[0] < -COVARIANCE_ROUNDING
    if refused:
        raise DocumentError(
            'the covariance must be symmetric and positive semidefinite, it is not; calibrate'
            ' again',
            code='not_a_covariance',
        )


def _unchecked(document: Mapping[str, Any]) -> Calibration:
    """
    Return the calibration that a document describes, without the checks of `check_numbers`.

    Raises
    ------
    InputError
        When a part is missing or has the wrong form.

    """
    require(document, CALIBRATION)
    # The form of the entries depends on the effects: the other parts are checked first.
    model = _model(document)
    covariance = document.get('covariance') or {}
    names = covariance.get('names') or []
    require(document, CALIBRATION, _entries_of(model, names))

    # Values, status and covariance in the order of the model; names in a file may have another.
    entries = [document[effect.section][effect.name] for effect in model.effects]
    values = _joined(entry['value'] for entry in entries)
    status = _joined((entry['status'] for entry in entries), str)
    order = [names.index(name) for name in model.param_names] if names else []
    if names:
        matrix = np.asarray(covariance['matrix'], float)[np.ix_(order, order)]
    else:
        matrix = np.diag(_joined(entry['sd'] for entry in entries) ** 2)

    # Reasons of held parameters, and centres of columns, are entries of their effects.
    held_reason = {}
    centre = {}
    for effect, entry in zip(model.effects, entries):
        reasons = np.ravel(np.array(entry.get('held_reason', ''), dtype=object)).tolist()
        for name, reason in zip(effect.param_names(), reasons):
            if reason:
                held_reason[name] = reason
        slopes = entry.get('centre_slope') or {}
        for group, value in (entry.get('centre') or {}).items():
            offset = np.asarray(value, float)
            slope = np.asarray(slopes.get(group, np.zeros((len(offset), 3))), float)
            centre[group] = ColumnCentre(offset, slope, INPUT_OF[effect.sensor])

    # The parts of the variance and the proof of each sensor.
    terms = {}
    for name, variance in (document.get('covariance_terms') or {}).items():
        terms[str(name)] = np.asarray(variance, float)[order]
    proof = {}
    for sensor, entry in (document.get('proof') or {}).items():
        if sensor in SENSORS:
            proof[sensor] = ProofEntry.from_mapping(entry)

    copied: dict[str, Any] = {name: dict(document.get(name) or {}) for name in _COPIED}
    return Calibration(
        model=replace(model.at(values), centre=centre),
        values=values,
        covariance=matrix,
        status=tuple(map(Status, status)),
        frame_id=document.get('frame_id', ''),
        covariance_terms=terms,
        held_reason=held_reason,
        undetermined=tuple(document.get('undetermined_directions') or ()),
        absent=tuple(document.get('absent') or ()),
        notes=tuple(document.get('notes') or ()),
        readings=RawReadings.from_mapping(document.get('readings') or {}),
        proof=proof,
        **copied,
    )


def _joined(values: Iterable[Any], kind: type = float) -> np.ndarray:
    """Return the items of nested lists in one array, shape (n,)."""
    return np.concatenate([np.ravel(np.asarray(value, kind)) for value in values])


def _model(document: Mapping[str, Any]) -> SensorModel:
    """Return the SensorModel of the effects that a document lists."""
    joint_names = JointNames.of(document.get('joint_names', JOINTS), document.get('joint_errors'))
    catalogue = CATALOGUE.with_definitions(document.get('effects') or {})
    sensor_of = {}  # effect of a sensor that the document lists in its section 'reference'
    for effect in catalogue.effects(joint_names).values():
        if effect.in_reference:
            sensor_of[effect.name] = effect.sensor
    members: dict[str, list[str]] = {section: [] for section in SECTIONS}
    for section in SECTIONS:
        names = (document.get(section) or {'effects': []})['effects']
        listed_entries = mapping(dict.fromkeys(names, mapping()))
        require(document, CALIBRATION, mapping(optional={section: listed_entries}))
        for name in names:
            sensor = sensor_of.get(name, section)
            if name in members[sensor]:
                raise DocumentError(
                    f"an effect must be listed once, '{name}' is listed twice; remove one",
                    code='effect_repeated',
                )
            members[sensor].append(name)
    effects: dict[str, Any] = {section: tuple(names) for section, names in members.items()}
    return SensorModel(
        **effects,
        joint_names=joint_names,
        temperature_ref_c=float(document.get('reference_temperature_c', 25.0)),
        catalogue=catalogue,
    )


_COPIED = ('gauge', 'statistics', 'conditions', 'decision', 'decision_reasons', 'provenance')
"""Parts that a `Calibration` has in the form of the document."""
CALIBRATION_FORMAT = 'imu_calibration/1'
_WHERE_KNOWN = ('decision', 'decision_reasons', 'notes', 'proof')
"""Parts of a document that are omitted while unknown."""


TOLERANCES = Document(
    'tolerance file',
    mapping(),
    'correct it',
    dict.fromkeys(('mapping', 'unknown'), 'tolerance_section'),
    error=InputError,
)


def checked_tolerances(
    mapping_of_file: Any, catalogue: Catalogue = CATALOGUE
) -> dict[str, dict[str, float]]:
    """
    Return the content of a tolerance file when it is one: {section: {effect: number above zero}}.

    Raises
    ------
    InputError
        When a section or an effect does not exist, or a tolerance is no number above zero.

    """
    sections = {}
    for section in SECTIONS:
        names = [name for owner, name in catalogue.effects() if owner == section]
        tolerances = dict.fromkeys(names, number(0.0, above=True, code='tolerance_value'))
        sections[section] = mapping(optional=tolerances, closed=True, code='tolerance_name')
    require(mapping_of_file, TOLERANCES, mapping(optional=sections, closed=True))
    return mapping_of_file


def calibration_mapping(calibration: Calibration) -> dict[str, Any]:
    """Return the document as plain dicts, lists, floats and strings, in a fixed order."""
    document: dict[str, Any] = {
        'format': CALIBRATION_FORMAT,
        'frame_id': calibration.frame_id,
        'gauge': dict(calibration.gauge),
    }

    # First the differences from a complete IMU in SI units and its own axes.
    if calibration.absent:
        document['absent'] = list(calibration.absent)
    readings = calibration.readings
    if readings.axes or not readings.is_si:
        document['readings'] = readings.to_mapping()
    if calibration.model.definitions:
        document['effects'] = plain(calibration.model.definitions)

    # The parameters of each sensor and of the reference, and their covariance.
    for section in SECTIONS:
        document[section] = _section(calibration, section)
    document['reference_temperature_c'] = float(calibration.model.temperature_ref_c)
    document['joint_names'] = list(calibration.model.joint_names)
    errors = calibration.model.joint_names.errors
    if errors is not None:
        document['joint_errors'] = errors
    document['covariance'] = {
        'names': list(calibration.param_names),
        'matrix': plain(calibration.covariance),
    }
    if calibration.covariance_terms:
        document['covariance_terms'] = plain(calibration.covariance_terms)
    document['undetermined_directions'] = list(map(dict, calibration.undetermined))

    # Statistics, conditions and provenance; empty parts are omitted.
    for name in ('statistics', 'conditions', *_WHERE_KNOWN, 'provenance'):
        part = getattr(calibration, name)
        if name == 'proof':
            part = {sensor: entry.to_mapping() for sensor, entry in part.items()}
        if part or name not in _WHERE_KNOWN:
            document[name] = plain(part)
    return document


def _section(calibration: Calibration, section: str) -> dict[str, Any]:
    """Return the names of the effects of a section, and the entry of each."""
    effects = [effect for effect in calibration.model.effects if effect.section == section]
    entries: dict[str, Any] = {'effects': [effect.name for effect in effects]}
    for effect in effects:
        parameters = calibration.model.slices[effect.key]
        status = np.array(calibration.status, dtype=object)[parameters].reshape(effect.shape)
        entry: dict[str, Any] = {
            'value': plain(calibration.values[parameters].reshape(effect.shape)),
            'sd': plain(calibration.own_sd[parameters].reshape(effect.shape)),
            'unit': effect.unit if isinstance(effect.unit, str) else list(effect.unit),
            'status': status.tolist(),
        }

        # The part of its columns that bias and matrix contain.
        constants = {}
        slopes = {}
        for group in effect.groups:
            centre = calibration.model.centre.get(group.name)
            if centre is not None:
                constants[group.name] = centre.constant
                if np.any(centre.slope):
                    slopes[group.name] = centre.slope
        if constants:
            entry['centre'] = plain(constants)
        if slopes:
            entry['centre_slope'] = plain(slopes)

        # Why components are held, where one is.
        reasons = [calibration.held_reason.get(name, '') for name in effect.param_names()]
        if any(reasons):
            entry['held_reason'] = np.array(reasons, dtype=object).reshape(effect.shape).tolist()
        entries[effect.name] = entry
    return entries


def from_mapping(document: Any) -> Calibration:
    """
    Return the calibration that a document describes.

    Raises
    ------
    DocumentError
        When the format is unknown or newer, a value is missing, not finite or implausible.

    """
    require(document, CALIBRATION, mapping())
    _check_format(document.get('format'))
    try:
        calibration = _unchecked(document)
    except InputError as error:
        if isinstance(error, DocumentError):
            raise
        raise DocumentError(
            f'{CALIBRATION.name}: {error}', code=error.code or 'document_parts'
        ) from error
    return check_numbers(calibration)


def _check_format(stated: Any) -> None:
    """Refuse a document whose 'format' is unknown or newer."""
    name, _, number = str(stated).partition('/')
    if name != 'imu_calibration' or not number.isdigit():
        raise DocumentError(
            f"a calibration document must have 'format: {CALIBRATION_FORMAT}', got"
            f" {shortened(repr(stated))}; give a file written by 'imu_calibration calibrate'",
            code='document_format',
        )
    if int(number) > int(CALIBRATION_FORMAT.partition('/')[2]):
        raise DocumentError(
            f"a calibration document must not be newer than '{CALIBRATION_FORMAT}', got"
            f' {shortened(repr(stated))}; update imu_calibration',
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
