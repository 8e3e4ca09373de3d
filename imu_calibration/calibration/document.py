"""The calibration of an IMU, estimated from recordings, as a document that users and nodes exchange."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from imu_calibration.calibration import shown
from imu_calibration.calibration.decision import SensorDecision, decide, most_cautious
from imu_calibration.calibration.document_checks import check_numbers, check_parts
from imu_calibration.calibration.document_parts import parts_of
from imu_calibration.calibration.status import COMMON_SCALE, FIXED, LACKING
from imu_calibration.documents import from_text, to_text
from imu_calibration.effects.base import SECTIONS, SENSORS, Role
from imu_calibration.effects.catalogue import CATALOGUE, Catalogue
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.errors import DocumentError, InputError, shortened
from imu_calibration.estimation.covariance_terms import GRAVITY
from imu_calibration.samples import ImuSamples

if TYPE_CHECKING:
    from imu_calibration.calibration.verdict import Verdict

FORMAT = 'imu_calibration/1'
UNKNOWN = 'unknown'
"""Entry of the provenance for the uncertainty of imported values."""
_WHERE_KNOWN = ('decision', 'decision_reasons', 'notes', 'proof')
"""Parts of a document that are omitted while unknown."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Parameters with covariance and status, and the conditions under which they were found."""

    model: SensorModel
    """Effects and their order."""
    values: np.ndarray
    """Parameters in ``model.param_names`` order, SI, shape (n_params,)."""
    covariance: np.ndarray
    """Covariance of the values, shape (n_params, n_params)."""
    status: tuple
    """'determined', 'weak' or 'held' for each parameter."""
    frame_id: str = ''
    """Sensor frame."""
    gauge: dict = field(default_factory=dict)
    """Origin of the arms and the sensor axes, by convention."""
    undetermined: tuple = ()
    """Weak directions: {'parameters': {name: weight}, 'needs': motion}."""
    statistics: dict = field(default_factory=dict)
    """Residual rms, noise, chi-square, windows, samples dropped."""
    conditions: dict = field(default_factory=dict)
    """Temperature range, largest rate, gravity, duration, date."""
    provenance: dict = field(default_factory=dict)
    """Software version, bag names and hashes, options."""
    decision: dict[str, str] = field(default_factory=dict)
    """Sensor -> decision in the file (`decision.SensorDecision`); see `decisions` for a sensor without one."""
    decision_reasons: dict[str, str] = field(default_factory=dict)
    """Sensor -> the reason for the decision."""
    notes: tuple = ()
    """Parameters within tolerance, warnings, notes and next steps, a line each."""
    proof: dict = field(default_factory=dict)
    """
    Sensor -> {'before', 'after', 'ci95' of after / before, 'unit', 'windows'}: its error on held-out data; {}: never measured.
    """
    covariance_terms: dict[str, np.ndarray] = field(default_factory=dict)
    """Term (`estimation.covariance_terms`) -> its variance of each parameter, shape (n_params,); the sum is that of `covariance`."""
    held_reason: dict[str, str] = field(default_factory=dict)
    """Held parameter -> the reason (`status.reasons_held`)."""
    judgement: Verdict | None = None
    """The verdict with its reasons one by one, where it was not read from a file."""

    @property
    def param_names(self) -> list[str]:
        """Names in the order of `values`."""
        return self.model.param_names

    @property
    def sd(self) -> np.ndarray:
        """Standard deviations, shape (n_params,)."""
        return np.sqrt(np.clip(np.diag(self.covariance), 0, None))

    @property
    def common_scale(self) -> dict:
        """{'sd', 'tolerance', 'status'} of the accelerometer's common scale by hand, {} where gravity counts as exact."""
        return self.statistics.get('by_hand', {}).get('common_scale', {})

    @property
    def own_sd(self) -> np.ndarray:
        """Standard deviations without `common_scale`, relative to which the other parameters are judged, shape (n_params,)."""
        common = self.covariance_terms.get(GRAVITY, 0.0) if self.common_scale else 0.0
        return np.sqrt(np.clip(np.diag(self.covariance) - common, 0, None))

    @property
    def status_by_name(self) -> dict[str, str]:
        """Status of each parameter and of the common scale, by name."""
        common = {COMMON_SCALE: self.common_scale['status']} if self.common_scale else {}
        return dict(zip(self.param_names, self.status)) | common

    def value(self, sensor: str, effect: str) -> np.ndarray:
        """Return the value of one effect in its documented shape."""
        found = self.model.catalogue.find(sensor, effect, self.model.joint_names)
        return self.values[self.model.slices[sensor, effect]].reshape(found.shape)

    def of(self, sensor: str, role: Role) -> Any:
        """Return the value of the effect in a place of a sensor's equation (`effects.base.Role`) in its documented shape, or None."""
        return self.model.value(sensor, role, self.values)

    def has(self, sensor: str, effect: str) -> bool:
        """Return whether the model contains the effect."""
        return (sensor, effect) in self.model.slices

    @property
    def knows_density(self) -> bool:
        """Whether the noise is known at any sampling rate."""
        return 'noise_density' in self.statistics.get('accelerometer', {})

    def noise(self, sensor: str, period: float | None = None) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (standard deviation of a sample, sd of window offsets and wander), each shape (3,), from the statistics.

        With a noise density and a `period` (s), the sample sd is for that rate; else for the rate of the recording.
        """
        found = self.statistics.get(sensor, {})
        white = np.asarray(found.get('noise_sd', [0.0] * 3), float)
        if period is not None and 'noise_density' in found:
            white = np.asarray(found['noise_density'], float) / np.sqrt(period)
        return white, np.hypot(float(found.get('between_window_sd', 0.0)), float(found.get('wander_sd', 0.0)))

    @property
    def uncertainty_known(self) -> bool:
        """Whether the uncertainty of the values is known; that of imported values is not."""
        return self.provenance.get('uncertainty') != UNKNOWN

    @property
    def decisions(self) -> dict[str, SensorDecision]:
        """Sensor -> decision: the more cautious of that in the file and that of the proof; UNPROVEN without both."""
        found = {}
        for sensor in SENSORS:
            known = [SensorDecision(self.decision[sensor])] if sensor in self.decision else []
            found[sensor] = most_cautious([*known, decide(self.proof.get(sensor))] if self.proof.get(sensor) or not known else known)
        return found

    @property
    def requested(self) -> dict[str, str]:
        """Status of the requested parameters and of the common scale, by name; table, clock and the common arm are nuisances."""
        nuisances = set(np.array(self.param_names)[~self.model.requested])
        return {name: status for name, status in self.status_by_name.items() if name not in nuisances and status != FIXED}

    def all_determined(self) -> bool:
        """Return whether every parameter is determined."""
        return not set(LACKING) & set(self.status_by_name.values())

    def compensate(self, samples: ImuSamples | np.ndarray, rate_s: np.ndarray | None = None, *, time: np.ndarray | None = None,
                   temperature_c: Any = None) -> ImuSamples | tuple[np.ndarray, np.ndarray]:
        """
        Return readings with the calibrated errors removed; see `compensation.arrays.compensate_readings`.

        Parameters
        ----------
        samples : ImuSamples, or array_like, shape (n, 3)
            Readings of one IMU in order of time, or measured specific force in the sensor frame, m/s^2.
        rate_s : array_like, shape (n, 3), optional
            Measured angular rate of the same samples, rad/s.
        time : array_like, shape (n,), optional
            When the arrays were measured, s; needed where the sensitive points have lever arms.
        temperature_c : float, array_like of shape (n,), or TemperatureSamples, optional
            Needed when the calibration has thermal effects.

        Returns
        -------
        ImuSamples, or (ndarray, ndarray)
            Corrected specific force and rate, of the same type as the input; NaN where a reading cannot be corrected.

        """
        from imu_calibration.compensation.stream import compensate_readings
        return compensate_readings(self, samples, rate_s, time=time, temperature_c=temperature_c)

    def __repr__(self):
        return shown.summary(self)

    def __str__(self):
        return shown.as_text(self)

    def _repr_html_(self):
        return shown.as_html(self)


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
