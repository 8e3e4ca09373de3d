"""From the mapping of a calibration document to the parts of a `Calibration`: its layout; the numbers are not checked."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from imu_calibration.calibration.status import Status
from imu_calibration.effects.base import SECTIONS
from imu_calibration.effects.catalogue import JOINTS, Catalogue
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.errors import DocumentError, shortened
from imu_calibration.reference.joint import JointNames


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
