"""Applied parts of a calibration: the decision per sensor, and consent of the user."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from imu_calibration.allan.figures import NoiseFigures
from imu_calibration.core.errors import DocumentError
from imu_calibration.document.calibration import HAND_AXES, Calibration, beyond_instruments, listed, with_nominal
from imu_calibration.document.decision import HARMS, HELPS, UNPROVEN, decisions_text, reason_of
from imu_calibration.document.uncorrected import uncorrected_lines
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.solution import LACKING


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
        return [*(f'the {sensor} is not corrected: {why}' for sensor, why in self.refused.items()), *self.cautions]


def usable(calibration: Calibration, *, anyway: bool = False, live: bool = False) -> Usable:
    """
    Return the part of a calibration that is applied.

    A sensor with the decision `helps` is always corrected. Offline `unproven` is corrected with a caution, and `harms` only with the user's
    consent. Live `unproven` is corrected only with consent, and `harms` never. By hand the accelerometer defines the axes of the gyroscope,
    so that the gyroscope is not corrected without it. A sensor with implausible values is never corrected, nor, live, an unproven sensor
    with most of its parameters undetermined.

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
        When no sensor is corrected (code `no_sensor_helps`); the key is `anyway` where consent would change that.

    """
    words, refused = calibration.decisions, refused_sensors(calibration, anyway=anyway, live=live)
    if refused.keys() == set(SENSORS):
        first = min(refused, key=lambda sensor: words[sensor] is not HARMS)
        consent = refused_sensors(calibration, anyway=True, live=live).keys() != set(SENSORS)
        text = ('a calibration must help a sensor on held-out data to be applied, this one does not: '
                f'{first} {refused[first]}; calibrate again')
        raise DocumentError(text, key='anyway' if consent else None, code='no_sensor_helps')
    cautions = tuple(f'{sensor} {_text(calibration, sensor)}' for sensor in SENSORS
                     if sensor not in refused and words[sensor] is not HELPS)
    return Usable(with_nominal(calibration, list(refused)) if refused else calibration, refused, cautions)


def refused_sensors(calibration: Calibration, *, anyway: bool = False, live: bool = False) -> dict[str, str]:
    """Return sensor -> why it is not corrected; arguments as in `usable`."""
    accepted = {HELPS} | ({UNPROVEN} if anyway or not live else set()) | ({HARMS} if anyway and not live else set())
    refused = {sensor: _text(calibration, sensor) for sensor in SENSORS if calibration.decisions[sensor] not in accepted}
    for sensor in SENSORS:
        if why := beyond_instruments(calibration, sensor) or (live and _mostly_undetermined(calibration, sensor)):
            refused[sensor] = why
    if 'accelerometer' in refused and calibration.gauge.get('axes') == HAND_AXES:
        refused.setdefault('gyroscope', 'its axes depend on the accelerometer')
    return refused


def _mostly_undetermined(calibration, sensor):
    """Return why an unproven sensor is not applied even with consent; '' where it may be."""
    status = [calibration.status[place] for effect in calibration.model.effects if effect.sensor == sensor
              for place in range(*calibration.model.slices[effect.key].indices(len(calibration.status)))]
    missing = sum(each in LACKING for each in status)
    return f'unproven, and {missing} of {len(status)} parameters are not determined' \
        if calibration.decisions[sensor] is UNPROVEN and 2 * missing > len(status) else ''


def _text(calibration, sensor):
    """Return the decision on a sensor with its reason."""
    return f'{calibration.decisions[sensor]}: {calibration.decision_reasons.get(sensor) or reason_of(calibration.proof.get(sensor))}'


def usage(calibration: Calibration) -> str:
    """Return a line with the sensor that is corrected if only one is; '' otherwise."""
    refused = refused_sensors(calibration)
    if len(refused) != 1:
        return 'compensation corrects neither sensor with it' if refused else ''
    corrected = next(s for s in SENSORS if s not in refused)
    return f'compensation corrects the {corrected} with it; the {next(iter(refused))} is unchanged'


def caveats(calibration: Calibration) -> list[str]:
    """Return the caveats for a user of the calibration in addition to the decisions, a line each."""
    return uncorrected_lines(calibration.statistics) + ([text] if (text := missing(calibration)) else [])


def missing(calibration: Calibration) -> str:
    """Return which parameters are not determined, as text; '' when all are."""
    known = calibration.status_by_name
    names = [name for name, status in known.items() if status in LACKING]
    return f'{len(names)} of {len(known)} parameters not determined ({listed(names)})' if names else ''


def standing(calibration: Calibration) -> str:
    """Return the decisions in short, for one line in a log."""
    return decisions_text(calibration.decisions)


def with_measured_noise(calibration: Calibration, figures: NoiseFigures) -> Calibration:
    """
    Return the calibration with the white noise of noise.yaml in its statistics.

    `noise_density` (per root hertz, by axis) gives the standard deviation of a sample at any rate; `noise_sd` is that at the rate at
    which the noise was recorded. Compensation and its covariances read both through `Calibration.noise`.
    """
    statistics = dict(calibration.statistics)
    for sensor in SENSORS:
        density = np.array([axis.white for axis in figures.sensor(sensor)])
        statistics[sensor] = dict(statistics.get(sensor, {})) | {
            'noise_sd': (density * np.sqrt(figures.rate)).tolist(), 'noise_density': density.tolist()}
    return replace(calibration, statistics=statistics)
