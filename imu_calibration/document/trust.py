"""Applied parts of a calibration: the decision per sensor, and consent of the user."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from imu_calibration.core.errors import DocumentError
from imu_calibration.core.units import error_text
from imu_calibration.document.calibration import (
    AXES_MISSING,
    Calibration,
    beyond_instruments,
    scale_questions,
    with_nominal,
)
from imu_calibration.document.decision import HARMS, HELPS, UNPROVEN, reason_of
from imu_calibration.document.outcome import missing
from imu_calibration.effects.base import INPUT_OF, SENSORS, UNITS, Effect, Role
from imu_calibration.effects.expressions import ColumnCentre
from imu_calibration.effects.forward_equations import Centre, coefficients, in_time, not_applied
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import LACKING
from imu_calibration.kinematics.rotations import Reference

if TYPE_CHECKING:  # the import needs 1 MB of the compensator node
    from imu_calibration.allan.figures import NoiseFigures

END = 'end of the recording'
MEAN = 'mean of the recording'
"""Which value of an effect in time is applied."""
AGAIN = (
    '; it is proven for its last third only, and the error returns where the effect starts again'
)
LAST_SHARE = 2.0 / 3.0
"""
Effects that have settled are proven on the windows after this share of the recording: the value at
its end is applied.
"""
SETTLED = 0.1
"""
An effect in time has settled if a recording of twice the length would change it by at most this
share more: 2.3 time constants.
"""
PROBABLE = 2.0
"""Standard deviations above a time constant with which an effect has to have settled."""


@dataclass(frozen=True, eq=False)
class Uncorrected:
    """Constant values that compensation applies instead of effects that it cannot invert."""

    centre: Centre = field(default_factory=dict)
    """The part of the effects that the applied bias and matrix contain."""
    sizes: tuple[dict[str, Any], ...] = ()
    """
    Entries of the statistics: effect, sensor, 'applied' (`END` or `MEAN`), rms of the uncorrected
    part on each axis and its unit.
    """

    def to_mapping(self) -> dict[str, Any]:
        """Return the part of a document's statistics."""
        return {'uncorrected': [dict(entry) for entry in self.sizes]} if self.sizes else {}


def constant_part(effect: Effect, columns: np.ndarray) -> ColumnCentre:
    """Return the centre of an effect with constant columns, shape (width,)."""
    return ColumnCentre(columns, np.zeros((len(columns), 3)), INPUT_OF[effect.sensor])


def uncorrected_in_time(
    model: SensorModel,
    values: np.ndarray,
    times: Sequence[float] | np.ndarray,
    *,
    end: float,
    latest: SensorModel | None = None,
) -> Uncorrected:
    """
    Return the uncorrected part of effects in time at `times`, s, of a recording that ends at `end`.

    An effect that has settled by the model `latest` (`latest_settling`, default `model`) is applied
    with its value at the end, any other with its mean. The uncorrected part is the remainder::

        (columns(t) - applied columns) @ coefficients
    """
    latest = latest or model
    centre: dict[str, ColumnCentre] = {}
    sizes = []
    for effect in not_applied(model):
        # The columns that are applied as constants.
        at_end = has_settled(latest, effect, end)
        at_times = columns_at(model, effect, times)
        applied = columns_at(model, effect, [end]) if at_end else at_times
        for name, columns in applied.items():
            centre[name] = constant_part(effect, columns.mean(axis=0))

        # The remainder on each axis at `times`, shape (n, 3).
        rows = model.layout(effect.sensor).rows
        uncorrected = 0.0
        for name, columns in at_times.items():
            column_coefficients = coefficients(model, effect.sensor, values)[rows[name]]
            uncorrected = uncorrected + (columns - centre[name].constant) @ column_coefficients
        rms = np.sqrt(np.mean(np.square(uncorrected), axis=0))
        sizes.append(uncorrected_size(effect, rms, at_end))
    return Uncorrected(centre, tuple(sizes))


def latest_settling(model: SensorModel, values: np.ndarray, sd: np.ndarray) -> SensorModel:
    """
    Return the model at the largest probable time constants, for `has_settled`.

    A cause that only resembles a warm-up has an uncertain time constant, and its value at the end
    of a recording is no value of another recording.
    """
    longest = values.copy()
    for effect in model.effects:
        if effect.time_constant:
            last = model.slices[effect.key].stop - 1
            longest[last] += PROBABLE * sd[last]
    return model.at(longest)


def judged_from_of(model: SensorModel, end: float) -> float:
    """
    Return the time from which the windows of a recording until `end` are judged, s.

    It is 0, or the beginning of the last third if an effect of the model has settled.
    """
    if any(has_settled(model, effect, end) for effect in not_applied(model)):
        return LAST_SHARE * end
    return 0.0


def has_settled(model: SensorModel, effect: Effect, end: float) -> bool:
    """
    Return whether an effect in time has settled at the end of a recording, s.

    It has, with its columns c at the point of the model, if each of them changes in a second
    recording by at most the share `SETTLED` of its change in this one::

        |c(2 end) - c(end)| <= SETTLED |c(end) - c(0)|

    Then its value at the end is applied: it holds until the next start. Otherwise the mean is
    applied, with the least error in a recording that repeats the drift; a drift that continues
    exceeds either.
    """
    if not in_time(effect):
        return False
    columns = list(columns_at(model, effect, [0.0, end, 2.0 * end]).values())
    if effect.time_constant:
        # The second half is the derivative by the time constant.
        tested, _ = np.split(columns[0], 2, axis=1)
    else:
        tested = np.concatenate(columns, axis=1)
    start, at_end, later = tested
    return bool(np.all(np.abs(later - at_end) <= SETTLED * np.abs(at_end - start)))


def columns_at(
    model: SensorModel, effect: Effect, times: Sequence[float] | np.ndarray
) -> dict[str, np.ndarray]:
    """Return the columns of an effect in time at `times`, s: group -> shape (n, width)."""
    # The motion is a placeholder: such an effect depends on time only.
    no_motion = np.zeros((len(times), 3))
    ref = Reference(
        time=np.asarray(times, float),
        mat_sn=np.zeros((len(times), 3, 3)),
        force_s=no_motion,
        rate_s=no_motion,
        alpha_s=no_motion,
        gravity=0.0,
    )
    return {group.name: group.columns(ref, model.full_point()) for group in effect.groups}


def uncorrected_size(effect: Effect, rms: np.ndarray, at_end: bool) -> dict[str, Any]:
    """Return an entry of `Uncorrected.sizes`; `at_end`: the value at the end is applied."""
    return {
        'effect': effect.name,
        'sensor': effect.sensor,
        'applied': END if at_end else MEAN,
        'rms': rms.tolist(),
        'unit': UNITS[effect.sensor],
    }


def uncorrected_lines(statistics: Mapping[str, Any]) -> list[str]:
    """
    Return a line for each effect of the statistics that compensation replaces by a constant.
    """
    lines = []
    for entry in statistics.get('uncorrected') or ():
        size = error_text(max(entry['rms']), entry['unit'])
        lines.append(
            f'{entry["effect"]} is not corrected: {entry["sensor"]} bias and matrix contain its'
            f' value at the {entry["applied"]}, with an error of {size} rms during the'
            f' recording{AGAIN if entry["applied"] == END else ""}'
        )
    return lines


@dataclass(frozen=True, eq=False)
class Usable:
    """The part of a calibration that is applied."""

    calibration: Calibration
    """With nominal parameters of refused sensors."""
    refused: Mapping[str, str] = field(default_factory=dict)
    """Sensor that is not corrected -> why."""
    cautions: tuple[str, ...] = ()
    """A line for each sensor that is corrected although the decision is not `helps`."""

    @property
    def lines(self) -> list[str]:
        """Sensors that are not corrected, or corrected with caution, a line each."""
        return [
            *(f'the {sensor} is not corrected: {why}' for sensor, why in self.refused.items()),
            *self.cautions,
        ]


def usable(calibration: Calibration, *, anyway: bool = False, live: bool = False) -> Usable:
    """
    Return the part of a calibration that is applied.

    A sensor with the decision `helps` is always corrected. Offline `unproven` is corrected with a
    caution, and `harms` only with the user's consent. Live `unproven` is corrected only with
    consent, and `harms` never. By hand the accelerometer defines the axes of the gyroscope, so that
    the gyroscope is not corrected without it. A sensor with implausible values is never corrected,
    nor, live, an unproven sensor with most of its parameters undetermined.

    Parameters
    ----------
    calibration : Calibration
    anyway : bool
        The user's consent.
    live : bool
        Whether a robot uses the readings while they are made.

    Raises
    ------
    DocumentError
        When no sensor is corrected (code `no_sensor_helps`); the key is `anyway` where consent
        would change that.

    """
    refused = refused_sensors(calibration, anyway=anyway, live=live)
    if refused.keys() == set(calibration.sensors):
        # A sensor that the calibration harms is named before an unproven one.
        first = min(refused, key=lambda sensor: calibration.decisions[sensor] is not HARMS)
        refused_anyway = refused_sensors(calibration, anyway=True, live=live)
        consent_helps = refused_anyway.keys() != set(calibration.sensors)
        text = (
            'a calibration must help a sensor on held-out data to be applied, this one does not: '
            f'{first} {refused[first]}; calibrate again'
        )
        raise DocumentError(text, key='anyway' if consent_helps else None, code='no_sensor_helps')
    applied = with_nominal(calibration, list(refused)) if refused else calibration
    return Usable(applied, refused, cautions_of(calibration, refused))


def cautions_of(calibration: Calibration, refused: Collection[str]) -> tuple[str, ...]:
    """Return a line for each sensor, except those refused, on which the decision is not `helps`."""
    cautions = []
    for sensor, decision in calibration.decisions.items():
        if sensor not in refused and decision is not HELPS:
            cautions.append(f'{sensor} {_text(calibration, sensor)}')
    return tuple(cautions)


def refused_sensors(
    calibration: Calibration, *, anyway: bool = False, live: bool = False
) -> dict[str, str]:
    """Return sensor -> why it is not corrected; arguments as in `usable`."""
    accepted = {HELPS}
    if anyway or not live:
        accepted.add(UNPROVEN)
    if anyway and not live:
        accepted.add(HARMS)
    refused = {}
    for sensor in calibration.sensors:
        if calibration.decisions[sensor] not in accepted:
            refused[sensor] = _text(calibration, sensor)
    # Reasons that no decision or consent changes.
    for sensor in calibration.sensors:
        why = beyond_instruments(calibration, sensor)
        if not why and live:
            why = _mostly_undetermined(calibration, sensor)
        if why:
            refused[sensor] = why
    if calibration.gyroscope_in_accelerometer_axes and 'accelerometer' in refused:
        refused.setdefault('gyroscope', AXES_MISSING)
    return refused


def _mostly_undetermined(calibration: Calibration, sensor: str) -> str:
    """Return why an unproven sensor is not applied even with consent; '' where it may be."""
    status: list[str] = []
    # By hand the accelerometer defines the axes: without it only the bias has a reference.
    only_bias = calibration.accelerometer_defines_axes and 'accelerometer' in calibration.absent
    for effect in calibration.model.effects:
        if effect.sensor == sensor and (effect.role is Role.OFFSET or not only_bias):
            status += calibration.status[calibration.model.slices[effect.key]]
    n_undetermined = sum(state in LACKING for state in status)
    if calibration.decisions[sensor] is UNPROVEN and 2 * n_undetermined > len(status):
        return f'unproven, and {n_undetermined} of {len(status)} parameters are not determined'
    return ''


def _text(calibration: Calibration, sensor: str) -> str:
    """Return the decision on a sensor with its reason."""
    reason = calibration.decision_reasons.get(sensor)
    reason = reason or reason_of(calibration.proof.get(sensor))
    return f'{calibration.decisions[sensor]}: {reason}'


def usage(calibration: Calibration) -> str:
    """Return a line with the sensor that is corrected if only one is; '' otherwise."""
    unchanged = [*refused_sensors(calibration), *calibration.absent]
    if len(unchanged) != 1:
        return 'compensation corrects neither sensor with it' if unchanged else ''
    corrected = next(sensor for sensor in SENSORS if sensor not in unchanged)
    return f'compensation corrects the {corrected} with it; the {unchanged[0]} is unchanged'


def caveats(calibration: Calibration) -> list[str]:
    """
    Return the caveats for a user of the calibration in addition to the decisions, a line each.
    """
    lines = uncorrected_lines(calibration.statistics)
    text = missing(calibration)
    if text:
        lines.append(text)
    return [*lines, *scale_questions(calibration).values()]


def with_measured_noise(calibration: Calibration, figures: 'NoiseFigures') -> Calibration:
    """
    Return the calibration with the white noise of noise.yaml in its statistics.

    `noise_density` (per root hertz, by axis) gives the standard deviation of a sample at any rate;
    `noise_sd` is that at the rate at which the noise was recorded. Compensation and its covariances
    read both through `Calibration.noise`.
    """
    statistics = dict(calibration.statistics)
    for sensor in figures.sensors:
        density = np.array([axis.white for axis in figures.sensor(sensor)])
        statistics[sensor] = dict(statistics.get(sensor, {})) | {
            'noise_sd': (density * np.sqrt(figures.rate)).tolist(),
            'noise_density': density.tolist(),
        }
    return replace(calibration, statistics=statistics)
