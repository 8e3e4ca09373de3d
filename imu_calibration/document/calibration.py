"""
The calibration: parameters with covariance, statuses, reasons, nominal values and plausible sizes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from typing import Any, overload

import numpy as np

from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import ImuSamples
from imu_calibration.core.scales import (
    DOUBTFUL,
    IMPOSSIBLE,
    POSSIBLE_SCALE,
    USUAL_SCALE,
    ScaleRange,
    scale_range,
)
from imu_calibration.core.units import DEG, STANDARD_GRAVITY, for_people, significant, with_sd
from imu_calibration.document.decision import (
    BY_DEFINITION,
    HARMS,
    HELPS,
    UNPROVEN,
    SensorDecision,
    Verdict,
    decide,
    decisions_text,
    most_cautious,
)
from imu_calibration.document.proof_entry import Proof
from imu_calibration.document.reference_texts import (
    ACCELEROMETER_AXES,
    ReferenceTexts,
    texts_of,
)
from imu_calibration.effects.base import SECTIONS, SENSORS, Effect, Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import (
    COMMON_SCALE,
    DETERMINED,
    FIXED,
    GRAVITY,
    HELD,
    Status,
)

UNKNOWN_SD = 'unknown'
"""Entry of the provenance for the uncertainty of imported values."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Parameters with covariance and status, and the conditions under which they were found."""

    model: SensorModel
    """Effects, in the order of their parameters."""
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
    """
    Sensor -> decision in the file (`decision.SensorDecision`); see `decisions` for a sensor without
    one.
    """
    decision_reasons: dict[str, str] = field(default_factory=dict)
    """Sensor -> the reason for the decision."""
    notes: tuple = ()
    """Parameters within tolerance, warnings, notes and next steps, a line each."""
    proof: Proof = field(default_factory=dict)
    """Sensor -> its errors on held-out data; {}: never measured."""
    covariance_terms: dict[str, np.ndarray] = field(default_factory=dict)
    """
    Term (`estimation.solution`) -> its variance of each parameter, shape (n_params,); the sum is
    that of `covariance`.
    """
    held_reason: dict[str, str] = field(default_factory=dict)
    """Held parameter -> the reason (`status.reasons_held`)."""
    absent: tuple[str, ...] = ()
    """
    Sensors without readings in the recording: their parameters are nominal, without a decision, and
    their readings are not corrected.
    """
    readings: RawReadings = RawReadings()
    """Units and axes of the readings that it is for; the values are SI in axes of the source."""
    judgement: Verdict | None = None
    """The verdict with its reasons one by one, where it was not read from a file."""

    @property
    def param_names(self) -> list[str]:
        """Names in the order of `values`."""
        return self.model.param_names

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors that were calibrated."""
        return tuple(sensor for sensor in SENSORS if sensor not in self.absent)

    @property
    def sd(self) -> np.ndarray:
        """Standard deviations, shape (n_params,)."""
        return np.sqrt(np.clip(np.diag(self.covariance), 0, None))

    @property
    def texts(self) -> ReferenceTexts:
        """Texts of its reference."""
        return texts_of(self.gauge)

    @property
    def accelerometer_defines_axes(self) -> bool:
        """Whether the axes are those of the accelerometer, calibrated or not."""
        return self.gauge.get('axes') == ACCELEROMETER_AXES

    @property
    def gyroscope_in_accelerometer_axes(self) -> bool:
        """Whether the accelerometer, which was calibrated too, defines axes of the gyroscope."""
        return self.accelerometer_defines_axes and not self.absent

    @property
    def by_hand(self) -> dict[str, Any]:
        """Statistics of poses and turns by hand; {} for a calibration on a table."""
        return self.statistics.get('by_hand') or {}

    @property
    def common_scale(self) -> dict[str, Any]:
        """
        {'sd', 'tolerance', 'status'} of the accelerometer's common scale by hand.

        It is {} where gravity counts as exact, and without an accelerometer.
        """
        if 'accelerometer' in self.absent:
            return {}
        return self.by_hand.get('common_scale', {})

    @property
    def own_sd(self) -> np.ndarray:
        """
        Standard deviations without `common_scale`, shape (n_params,).

        The other parameters are judged relative to them.
        """
        common = self.covariance_terms.get(GRAVITY, 0.0) if self.common_scale else 0.0
        return np.sqrt(np.clip(np.diag(self.covariance) - common, 0, None))

    @property
    def status_by_name(self) -> dict[str, str]:
        """Status of each parameter of the sensors with readings, and of the common scale."""
        status_by_name = {}
        for name, status in zip(self.param_names, self.status):
            if name.partition('.')[0] not in self.absent:
                status_by_name[name] = status
        if self.common_scale:
            status_by_name[COMMON_SCALE] = self.common_scale['status']
        return status_by_name

    def value(self, sensor: str, effect: str) -> np.ndarray:
        """Return the value of one effect in its documented shape."""
        shape = self.model.catalogue.find(sensor, effect, self.model.joint_names).shape
        return self.values[self.model.slices[sensor, effect]].reshape(shape)

    def of(self, sensor: str, role: Role) -> Any:
        """
        Return the value of the effect in a place of a sensor's equation, or None.

        The place is an `effects.base.Role`, and the value has its documented shape.
        """
        return self.model.value(sensor, role, self.values)

    def has(self, sensor: str, effect: str) -> bool:
        """Return whether the model contains the effect."""
        return (sensor, effect) in self.model.slices

    @property
    def knows_density(self) -> bool:
        """Whether the noise of a sensor is known at any sampling rate."""
        return any('noise_density' in self.statistics.get(sensor, {}) for sensor in SENSORS)

    def noise(self, sensor: str, period: float | None = None) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (sd of a sample, shape (3,); sd of window offsets and wander, shape ()).

        With a noise density and a `period` (s), the sample sd is for that rate; else for the rate
        of the recording. Zero where the statistics have none.
        """
        statistics = self.statistics.get(sensor, {})
        white = np.asarray(statistics.get('noise_sd', [0.0] * 3), float)
        if period is not None and 'noise_density' in statistics:
            white = np.asarray(statistics['noise_density'], float) / np.sqrt(period)
        offset_sd = float(statistics.get('between_window_sd', 0.0))
        wander_sd = float(statistics.get('wander_sd', 0.0))
        return white, np.hypot(offset_sd, wander_sd)

    @property
    def uncertainty_known(self) -> bool:
        """Whether the uncertainty of the values is known; that of imported values is not."""
        return self.provenance.get('uncertainty') != UNKNOWN_SD

    @property
    def decisions(self) -> dict[str, SensorDecision]:
        """
        Sensor -> decision: the more cautious of that in the file and that of the proof.

        UNPROVEN without both, and at best UNPROVEN where compensation refuses the values. An absent
        sensor has none.
        """
        decisions = {}
        for sensor in self.sensors:
            limits = []
            if sensor in self.decision:
                limits.append(SensorDecision(self.decision[sensor]))
            if self.proof.get(sensor) or not limits:
                limits.append(decide(self.proof.get(sensor)))
            if beyond_instruments(self, sensor):
                limits.append(UNPROVEN)
            decisions[sensor] = most_cautious(limits)
        if needs_accelerometer(self, decisions):
            decisions['gyroscope'] = most_cautious([decisions['gyroscope'], UNPROVEN])
        return decisions

    @property
    def requested(self) -> dict[str, str]:
        """
        Status of the requested parameters of the sensors and of the common scale, by name.

        Table, clock and the common arm are nuisances: they belong to the reference.
        """
        nuisances = set(np.array(self.param_names)[~self.model.requested])
        requested = {}
        for name, status in self.status_by_name.items():
            if name not in nuisances and status != FIXED and name.partition('.')[0] in SENSORS:
                requested[name] = status
        return requested

    @overload
    def compensate(self, samples: ImuSamples, *, temperature_c: Any = None) -> ImuSamples: ...

    @overload
    def compensate(
        self,
        samples: np.ndarray,
        rate_s: np.ndarray,
        *,
        time: np.ndarray | None = None,
        temperature_c: Any = None,
    ) -> tuple[np.ndarray, np.ndarray]: ...

    def compensate(
        self,
        samples: ImuSamples | np.ndarray,
        rate_s: np.ndarray | None = None,
        *,
        time: np.ndarray | None = None,
        temperature_c: Any = None,
    ) -> ImuSamples | tuple[np.ndarray, np.ndarray]:
        """
        Return readings with the calibrated errors removed; see `compensate_readings`.

        Parameters
        ----------
        samples : ImuSamples, or array_like, shape (n, 3)
            Readings of one IMU in order of time, or measured specific force in the sensor frame,
            in the unit of `readings` (m/s^2 unless the calibration states another).
        rate_s : array_like, shape (n, 3), optional
            Measured angular rate of the same samples, in the unit of `readings` (rad/s).
        time : array_like, shape (n,), optional
            When the arrays were measured, s; needed where the sensitive points have lever arms.
        temperature_c : float, array_like of shape (n,), or TemperatureSamples, optional
            Needed when the calibration has thermal effects.

        Returns
        -------
        ImuSamples, or (ndarray, ndarray)
            Corrected specific force and rate, of the same type as the input; NaN where a reading
            cannot be corrected.

        """
        from imu_calibration.compensation.stream import compensate_readings

        if isinstance(samples, ImuSamples):
            samples = self.readings.apply(samples)
        elif rate_s is not None:
            samples = self.readings.accelerometer.convert(np.asarray(samples, float))
            rate_s = self.readings.gyroscope.convert(np.asarray(rate_s, float))
        return compensate_readings(self, samples, rate_s, time=time, temperature_c=temperature_c)

    def __repr__(self) -> str:
        statuses = list(self.requested.values())
        counts = ', '.join(
            f'{statuses.count(status)} {status}' for status in Status if status in statuses
        )
        return (
            f'<Calibration of {self.frame_id or "an IMU"}: {decisions_text(self.decisions)},'
            f' {counts}>'
        )

    def __str__(self) -> str:
        rows = [PARAMETER_HEADINGS, *parameter_rows(self)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [repr(self)]
        for row in rows:
            cells = []
            for cell, width, heading in zip(row, widths, PARAMETER_HEADINGS):
                cells.append(cell.rjust(width) if heading in NUMBER_COLUMNS else cell.ljust(width))
            lines.append('  '.join(cells).rstrip())
        return '\n'.join(lines)

    def _repr_html_(self) -> str:
        rows = _html_row(PARAMETER_HEADINGS, 'th')
        for cells in parameter_rows(self):
            rows += _html_row(cells, 'td')
        return f'<table><caption>{escape(repr(self))}</caption>{rows}</table>'


def _html_row(cells: tuple[str, ...], tag: str) -> str:
    """Return a row of the table of parameters; `tag` is that of its cells."""
    row = ''
    for cell, heading in zip(cells, PARAMETER_HEADINGS, strict=True):
        side = 'right' if heading in NUMBER_COLUMNS else 'left'
        row += f'<{tag} style="text-align:{side}">{escape(cell)}</{tag}>'
    return f'<tr>{row}</tr>'


PARAMETER_HEADINGS = ('parameter', 'value', 'sd', 'unit', 'status')
NUMBER_COLUMNS = ('value', 'sd')
"""Columns that are set flush right."""


def parameter_rows(calibration: Calibration) -> Iterator[tuple[str, ...]]:
    """Yield the cells of each parameter in the order of `PARAMETER_HEADINGS`."""
    for effect in calibration.model.effects:
        if effect.sensor in calibration.absent:
            continue
        parameters = calibration.model.slices[effect.key]
        # Parameter k of the effect is parameter `index` of the model.
        for k, index in enumerate(range(parameters.start, parameters.stop)):
            name = calibration.param_names[index]
            factor, unit = for_people(effect.unit_of(k), name)
            value, sd = with_sd(
                calibration.values[index] * factor, calibration.own_sd[index] * factor
            )
            yield name, value, sd, unit, str(calibration.status[index])
    common = calibration.common_scale
    if common:
        yield COMMON_SCALE, *with_sd(1.0, common['sd']), '1', str(common['status'])


READINGS = {'accelerometer': {'force'}, 'gyroscope': {'rate', 'angular acceleration'}}
"""
Sensor -> items of `ColumnGroup.uses` that are computed from its readings to correct the other
sensor.
"""


def with_nominal(calibration: Calibration, sensors: Sequence[str]) -> Calibration:
    """
    Return a calibration without correction of the given sensors.

    Biases and matrices of these sensors are their priors', with the priors' standard deviations,
    which the covariances of corrected readings propagate; their other effects, except range limits,
    are removed. So are corrections of the other sensor that use their readings: a g-sensitivity by
    the force of a refused accelerometer, lever arms by the rate of a refused gyroscope.
    """
    model = calibration.model
    names: dict[str, Any] = {section: () for section in SECTIONS}
    for effect in model.effects:
        if _remains(effect, sensors):
            names[effect.sensor] += (effect.name,)
    reduced = replace(model, **names)
    # Of the parameters that remain: their indices in the complete model, in the reduced order.
    all_indices = np.arange(len(calibration.values))
    indices = np.concatenate([all_indices[model.slices[key]] for key in reduced.slices])
    values = calibration.values[indices]
    covariance = calibration.covariance[np.ix_(indices, indices)]
    status = [calibration.status[index] for index in indices]

    # Biases and matrices of these sensors at their priors, independent of the other parameters.
    for effect in reduced.effects:
        if effect.sensor in sensors and effect.role is not Role.LIMIT:
            parameters = reduced.slices[effect.key]
            values[parameters] = effect.prior_values()
            status[parameters] = [HELD] * effect.size
            covariance[parameters, :] = covariance[:, parameters] = 0.0
            covariance[parameters, parameters] = np.diag(effect.prior_sds() ** 2)
    return replace(
        calibration,
        model=reduced,
        values=values,
        covariance=covariance,
        status=tuple(status),
        covariance_terms={},
        held_reason={},
    )


def _remains(effect: Effect, sensors: Sequence[str]) -> bool:
    """Return whether an effect remains when `sensors` are not corrected."""
    if effect.sensor in sensors:
        return effect.role in (Role.OFFSET, Role.LINEAR, Role.LIMIT)
    if effect.sensor == 'reference':
        return True
    # A correction that needs readings of a sensor without correction is removed too.
    inputs = frozenset().union(*(group.uses for group in effect.groups))
    return not any(inputs & READINGS[sensor] for sensor in sensors)


SHOWN_NAMES = 6
"""Largest number of names that are listed one by one; more are listed by group."""


def listed(names: Sequence[str]) -> str:
    """Return names in a sentence; many as ``SENSOR.EFFECT (number: components)``."""
    if len(names) <= SHOWN_NAMES:
        return ', '.join(names)
    groups: dict[str, list[str]] = {}
    for name in names:
        group, _, component = name.rpartition('.')
        groups.setdefault(group, []).append(component)
    parts = []
    for group, components in groups.items():
        parts.append(f'{group} ({len(components)}: {", ".join(components)})')
    return ', '.join(parts)


MIN_COEFFICIENT_SDS = 3.0
"""
Standard deviations by which one coefficient of an effect must differ from its prior for the effect
to be added.
"""


def one_significant(distance: np.ndarray, sd: np.ndarray) -> bool:
    """
    Return whether one of several coefficients differs from its prior.

    Its `distance` must be more than MIN_COEFFICIENT_SDS standard deviations; shapes (n,).
    """
    return bool(np.any(np.abs(distance) > MIN_COEFFICIENT_SDS * sd))


OFF_DIAGONAL = 0.5
"""
Largest off-diagonal element: axes 30 degrees from orthogonal; the mount is part of the table
description.
"""
CONVERT = 'convert the readings in the driver'
"""Remedy for a scale factor that is explained by a wrong unit."""
LARGEST_BIAS = {'accelerometer': 16 * STANDARD_GRAVITY, 'gyroscope': 4000 * DEG}
"""The largest full scales of such sensors, m/s^2 and rad/s."""


def worst_scale(calibration: Calibration, sensor: str) -> float:
    """Return the scale factor of a sensor, smallest or largest, in the worse `ScaleRange`."""
    diagonal = np.diag(np.asarray(calibration.of(sensor, Role.LINEAR)))
    smallest = float(diagonal.min())
    largest = float(diagonal.max())
    severity = list(ScaleRange)
    if severity.index(scale_range(largest)) > severity.index(scale_range(smallest)):
        return largest
    return smallest


def scale_supported(calibration: Calibration, sensor: str) -> bool:
    """
    Return whether the data support scale factors that are far from 1.

    All are determined, and the corrected readings have smaller errors on held-out data.
    """
    matrix = calibration.model.part(sensor, Role.LINEAR)
    diagonal = range(matrix.start, matrix.stop, 4)  # entries 0, 4 and 8 of nine
    names = calibration.param_names
    statuses = {calibration.status_by_name[names[index]] for index in diagonal}
    entry = calibration.proof.get(sensor)
    # Without a proof the file states the decision: the true parameters of a simulation.
    decision = decide(entry) if entry else calibration.decision.get(sensor)
    return statuses == {DETERMINED} and decision == HELPS


def scale_questions(calibration: Calibration) -> dict[str, str]:
    """Return sensor -> question, where a scale factor is possible but not usual."""
    low, high = USUAL_SCALE
    questions = {}
    for sensor in SENSORS:
        factor = worst_scale(calibration, sensor)
        if scale_range(factor) is DOUBTFUL:
            questions[sensor] = (
                f'is the unit of the {sensor} right, and the full-scale range or rate that its'
                f' driver assumes? A scale factor is usually {low:g} to {high:g}, it is'
                f' {significant(factor)}'
            )
    return questions


@dataclass(frozen=True)
class InstrumentLimit:
    """A value that belongs to no instrument."""

    why: str
    """The limit and the value."""
    remedy: str
    """The next step, which removes the cause."""
    key: str | None = None
    """The input needed for it, a key of `errors.ERROR_KEYS`."""


def surpassed_limit(calibration: Calibration, sensor: str) -> InstrumentLimit | None:
    """
    Return the limit of instruments that a sensor's matrix or bias surpasses; None for none.

    A scale factor that is possible but not usual (`core.scales`) needs the support of the data.
    """
    matrix = np.asarray(calibration.of(sensor, Role.LINEAR))
    bias = np.asarray(calibration.of(sensor, Role.OFFSET))
    off_diagonal = np.abs(matrix - np.diag(np.diag(matrix))).max()
    factor = worst_scale(calibration, sensor)
    if scale_range(factor) is IMPOSSIBLE:
        low, high = POSSIBLE_SCALE
        return InstrumentLimit(
            f'a scale factor must be {low:g} to {high:g}, it is {significant(factor)}',
            CONVERT,
            f'{sensor}_unit',
        )
    if scale_range(factor) is DOUBTFUL and not scale_supported(calibration, sensor):
        low, high = USUAL_SCALE
        return InstrumentLimit(
            f'a scale factor outside {low:g} to {high:g} must be determined and help on held-out'
            f' data, {significant(factor)} is not',
            CONVERT,
            f'{sensor}_unit',
        )
    if off_diagonal > OFF_DIAGONAL:
        return InstrumentLimit(
            f'off-diagonal elements must be at most {OFF_DIAGONAL:g}, the largest is'
            f' {significant(off_diagonal)}',
            calibration.texts.off_diagonal,
        )
    if np.abs(bias).max() > LARGEST_BIAS[sensor]:
        return InstrumentLimit(
            f'a bias must be within full scale ({significant(LARGEST_BIAS[sensor])} SI), it is'
            f' {significant(np.abs(bias).max())}',
            'check offsets in the driver, and the supply of the sensor',
        )
    return None


def beyond_instruments(calibration: Calibration, sensor: str) -> str:
    """Return which value of a sensor belongs to no instrument, with the limit; '' for none."""
    limit = surpassed_limit(calibration, sensor)
    return limit.why if limit else ''


def needs_accelerometer(calibration: Calibration, decisions: Mapping[str, SensorDecision]) -> bool:
    """Return whether the gyroscope lacks its axes: those of an accelerometer that is refused."""
    if not calibration.gyroscope_in_accelerometer_axes:
        return False
    if decisions['accelerometer'] is HARMS:
        return True
    return bool(beyond_instruments(calibration, 'accelerometer'))


ABSENT = 'the recording of the calibration has no readings of it'
"""Why compensation leaves the readings of an absent sensor as they are."""
AXES_MISSING = 'its axes depend on the accelerometer'
"""Why compensation refuses the gyroscope of a calibration by hand."""


def never_applied(calibration: Calibration, sensor: str) -> str:
    """Return why compensation refuses the values of a sensor; '' where it does not."""
    if sensor in calibration.absent:
        return ABSENT
    why = beyond_instruments(calibration, sensor)
    if why:
        return why
    if sensor == 'gyroscope' and needs_accelerometer(calibration, calibration.decisions):
        return AXES_MISSING
    return ''


def true_calibration(
    model: SensorModel, values: np.ndarray, frame_id: str, *, simulated: dict[str, Any]
) -> Calibration:
    """
    Return the exact calibration of a simulated IMU.

    `simulated` describes the simulation in its provenance.
    """
    return Calibration(
        model=model.at(values),
        values=values,
        covariance=np.zeros((len(values),) * 2),
        status=(DETERMINED,) * len(values),
        frame_id=frame_id,
        gauge={'origin': 'mean_of_sensitive_points', 'axes': 'mount'},
        provenance={'simulated': simulated},
        **BY_DEFINITION,
    )


def beyond_known(share: float, section: str) -> str:
    """
    Return the message for an effect of a size that no known instrument has.

    With this size the effect explains `share` of the excess variance; `section` is its sensor or
    'reference'.
    """
    instruments = 'of such sensors: check saturation, the mount, the scale'
    if section == 'reference':
        instruments = 'of tables: check the description of the table, the mount, the stamps'
    return (
        f'explains {100 * share:.0f} % of the residual, but its size exceeds the literature values'
        f' {instruments}'
    )


def implausible(calibration: Calibration, section: str) -> list[str]:
    """
    Return a line for each effect with a value beyond those of all grades of instruments.

    The effects are those of one section of the document.
    """
    lines = []
    for effect in calibration.model.effects:
        if effect.sensor != section:
            continue
        amplitudes = effect.amplitudes(calibration.values[calibration.model.slices[effect.key]])
        if effect.surpasses(amplitudes):
            grade, largest, source = effect.plausible
            size = max(map(abs, amplitudes))
            lines.append(
                f'{effect.sensor} {effect.name} reaches {size:.3g} {effect.unit_of(0)}, more than'
                f' ten times the known values of {grade} instruments ({largest:.3g}; {source})'
            )
    return lines
