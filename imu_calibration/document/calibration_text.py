"""A `Calibration` as a document, written and read: mappings and YAML text; the numbers are checked in `document_checks`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from imu_calibration.core.documents import from_text, to_text
from imu_calibration.core.errors import DocumentError, InputError, shortened
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.calibration_checks import check_numbers, check_parts
from imu_calibration.effects.base import SECTIONS
from imu_calibration.effects.catalogue import CATALOGUE, JOINTS, Catalogue
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.status import Status
from imu_calibration.kinematics.joint import JointNames


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
            raise DocumentError(f"the standard deviations of '{effect.name}' must not be negative, some are or are no numbers; "
                                "calibrate again", code='negative_sd')
    return {'model': replace(model.at(values), centre=_centre(model, entries)), 'values': values,
            'covariance': _covariance(document.get('covariance'), model, entries),
            'status': tuple(status), 'frame_id': document.get('frame_id', ''),
            'covariance_terms': _covariance_terms(document, model),
            'held_reason': {name: str(reason) for e in model.effects if 'held_reason' in entries[e.key] for name, reason in zip(
                e.param_names(), np.array(entries[e.key]['held_reason'], dtype=object).reshape(e.size), strict=True) if reason},
            'undetermined': tuple(document.get('undetermined_directions') or ()), 'notes': tuple(document.get('notes') or ()),
            **{name: dict(document.get(name) or {})
               for name in ('gauge', 'statistics', 'conditions', 'decision', 'decision_reasons', 'proof', 'provenance')}}


def _model(document):
    """Return (SensorModel, {(sensor, effect): entry of the document})."""
    joint_names = JointNames.of(document.get('joint_names', JOINTS), document.get('joint_errors'))
    catalogue = Catalogue.from_definitions(document.get('effects') or {})
    owners = {effect.name: effect.sensor for effect in catalogue.effects(joint_names).values() if effect.in_reference}
    members, entries = {section: [] for section in SECTIONS}, {}
    for section in SECTIONS:
        part = document.get(section) or {'effects': []}
        for name in part['effects']:
            sensor = owners.get(name, section)
            if (sensor, name) in entries:
                raise DocumentError(f"an effect must be listed once, '{name}' is listed twice; remove one", code='effect_repeated')
            members[sensor].append(name)
            entries[sensor, name] = part[name]
    return SensorModel(*(tuple(members[s]) for s in SECTIONS), joint_names=joint_names,
                       temperature_ref_c=float(document.get('reference_temperature_c', 25.0)), catalogue=catalogue), entries


def _shaped(value, effect):
    array = np.asarray(value, float)
    if array.shape != effect.shape or np.asarray(value).dtype == bool:
        raise DocumentError(f"'{effect.name}' must be numbers of shape {effect.shape}, got {array.shape}; correct the file", code='shape')
    return array.ravel()


def _statuses(value, effect):
    words = np.array(value, dtype=object).reshape(effect.size).tolist()
    if any(word not in tuple(Status) for word in words):
        raise DocumentError(f"the status of '{effect.name}' must be {', '.join(Status)}; correct the file", code='status_unknown')
    return map(Status, words)


def _check_unit(found, effect):
    wanted = effect.unit if isinstance(effect.unit, str) else list(effect.unit)
    if found is not None and found != wanted:
        raise DocumentError(f"the unit of '{effect.name}' must be {wanted}, got {shortened(repr(found))}; correct the file", code='unit')


def _centre(model, entries):
    """Return column group -> the value from which its columns are measured."""
    known = {group.name: group for e in model.effects for group in e.groups}
    found = {name: np.asarray(value, float) for e in model.effects for name, value in (entries[e.key].get('centre') or {}).items()}
    for name, value in found.items():
        if name not in known or value.shape != (known[name].width,) or not np.all(np.isfinite(value)):
            raise DocumentError(f'the centre {shortened(repr(name))} must have one finite number for each column of its effect; '
                                'correct the calibration file', code='centre')
    return found


def _covariance_terms(document, model):
    """Return term -> variance of each parameter in the model's order; the document has the order of its covariance."""
    terms = document.get('covariance_terms') or {}
    order = [document['covariance']['names'].index(name) for name in model.param_names] if terms else []
    return {str(name): np.asarray(variance, float)[order] for name, variance in terms.items()}


def _covariance(given, model, entries):
    """Return the covariance in the model's order; without one, the diagonal of the standard deviations."""
    if not given:
        return np.diag(np.concatenate([_shaped(entries[e.key]['sd'], e) for e in model.effects])**2)
    order = [given['names'].index(name) for name in model.param_names]
    return np.asarray(given['matrix'], float)[np.ix_(order, order)]


FORMAT = 'imu_calibration/1'
_WHERE_KNOWN = ('decision', 'decision_reasons', 'notes', 'proof')
"""Parts of a document that are omitted while unknown."""


def checked_tolerances(mapping: Any, catalogue: Catalogue = CATALOGUE) -> dict[str, dict[str, float]]:
    """
    Return the content of a tolerance file when it is one: {section: {effect: number above zero}}.

    Raises
    ------
    InputError
        When a section or an effect does not exist, or a tolerance is no number above zero.

    """
    known = {section: [name for owner, name in catalogue.effects() if owner == section] for section in SECTIONS}
    for section, entries in mapping.items():
        if section not in known or not isinstance(entries, dict):
            raise InputError(f'a tolerance file must have the mappings {", ".join(SECTIONS)}, it has {shortened(repr(section))}: '
                             f'{shortened(repr(entries))}; correct it', code='tolerance_section')
        for name, value in entries.items():
            if name not in known[section]:
                raise InputError(f'a tolerance must be of an effect of the {section}, {shortened(repr(name))} is not one; '
                                 f'its effects are {", ".join(known[section])}', code='tolerance_name')
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < np.inf:
                raise InputError(f"the tolerance of '{name}' must be a number above zero, got {shortened(repr(value))}; correct it")
    return mapping


def to_mapping(calibration: Calibration) -> dict:
    """Return the document as plain dicts, lists, floats and strings, in a fixed order."""
    document: dict[str, Any] = {'format': FORMAT, 'frame_id': calibration.frame_id, 'gauge': dict(calibration.gauge)}
    if calibration.model.definitions:
        document['effects'] = _plain(calibration.model.definitions)
    for section in SECTIONS:
        document[section] = _section(calibration, section)
    document['reference_temperature_c'] = float(calibration.model.temperature_ref_c)
    document['joint_names'] = list(calibration.model.joint_names)
    if (errors := calibration.model.joint_names.errors) is not None:
        document['joint_errors'] = errors
    document['covariance'] = {'names': list(calibration.param_names), 'matrix': _plain(calibration.covariance)}
    if calibration.covariance_terms:
        document['covariance_terms'] = _plain(calibration.covariance_terms)
    document['undetermined_directions'] = [dict(direction) for direction in calibration.undetermined]
    for name in ('statistics', 'conditions', *_WHERE_KNOWN, 'provenance'):
        part = getattr(calibration, name)
        if part or name not in _WHERE_KNOWN:
            document[name] = _plain(part)
    return document


def _section(calibration, section):
    effects = [effect for effect in calibration.model.effects if effect.section == section]
    entries = {'effects': [effect.name for effect in effects]}
    for effect in effects:
        part = calibration.model.slices[effect.key]
        status = np.array(calibration.status, dtype=object)[part].reshape(effect.shape)
        entries[effect.name] = {
            'value': _plain(calibration.values[part].reshape(effect.shape)), 'sd': _plain(calibration.own_sd[part].reshape(effect.shape)),
            'unit': effect.unit if isinstance(effect.unit, str) else list(effect.unit), 'status': status.tolist()}
        centre = {group.name: calibration.model.centre[group.name] for group in effect.groups if group.name in calibration.model.centre}
        if centre:
            entries[effect.name]['centre'] = _plain(centre)
        reasons = [calibration.held_reason.get(name, '') for name in effect.param_names()]
        if any(reasons):
            entries[effect.name]['held_reason'] = np.array(reasons, dtype=object).reshape(effect.shape).tolist()
    return entries


def _plain(value):
    """Return value with arrays and numpy numbers turned into lists and Python numbers."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    return value


def from_mapping(document: Any) -> Calibration:
    """
    Return the calibration that a document describes.

    Raises
    ------
    DocumentError
        When the format is unknown or newer, a value is missing, not finite or implausible.

    """
    if not isinstance(document, dict):
        raise DocumentError(f"a calibration document must be a mapping, got {type(document).__name__}; "
                            "give a file written by 'imu_calibration calibrate'", code='not_a_mapping')
    _check_format(document.get('format'))
    check_parts(document)
    try:
        calibration = Calibration(**parts_of(document))
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError, InputError) as error:
        raise DocumentError(f'a calibration document must have the parts of {FORMAT}, one is missing or has another shape '
                            f'({_one_line(error)}); calibrate again', code=getattr(error, 'code', '') or 'document_parts') from error
    return check_numbers(calibration)


def _one_line(error):
    return shortened(str(error) if isinstance(error, InputError) else f'{type(error).__name__}: {error}', 200)


def _check_format(found):
    name, _, number = str(found).partition('/')
    if name != 'imu_calibration' or not number.isdigit():
        raise DocumentError(f"a calibration document must have 'format: {FORMAT}', got {shortened(repr(found))}; "
                            "give a file written by 'imu_calibration calibrate'", code='document_format')
    if int(number) > int(FORMAT.partition('/')[2]):
        raise DocumentError(f"a calibration document must not be newer than '{FORMAT}', got {shortened(repr(found))}; "
                            "update imu_calibration", code='document_newer')


def calibration_to_text(calibration: Calibration) -> str:
    """Return a calibration as the YAML of its document."""
    return to_text(to_mapping(calibration))


def calibration_from_text(text: str) -> Calibration:
    """
    Return the calibration in a YAML document.

    Raises
    ------
    DocumentError
        When it is no calibration, newer, or implausible.

    """
    try:
        mapping = from_text(text, 'calibration document')
    except InputError as error:
        raise DocumentError(str(error), code=error.code) from error
    return from_mapping(mapping)
