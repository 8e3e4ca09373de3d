"""May a calibration be used, of both sensors or of one? What its document says against it, and what whoever uses it should know."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from imu_calibration.calibration.document import Calibration
from imu_calibration.calibration.nominal import with_nominal
from imu_calibration.calibration.plausibility import implausible
from imu_calibration.calibration.proof_words import disproved
from imu_calibration.calibration.reasons import BAD, GOOD, HAND_AXES, listed
from imu_calibration.calibration.shown import verdict_text
from imu_calibration.calibration.status import DETERMINED
from imu_calibration.calibration.verdict import grave_reasons
from imu_calibration.effects.base import SENSORS
from imu_calibration.errors import DocumentError


def objections(calibration: Calibration, sensor: str | None = None) -> list[str]:
    """
    Return why nobody should be corrected with a calibration unless they insist, a line each; the first is the gravest.

    A bad verdict; values beyond what is known of any instrument; a proof that does not show a smaller error with the calibration
    than without, or a larger one in some motion (`proof_words.disproved`). With a `sensor`, what concerns its parameters.
    """
    reasons, proof = calibration.verdict_reasons[:1], calibration.proof
    word = calibration.verdict
    if sensor is not None:
        word = calibration.verdicts.get(sensor, word) if BAD in calibration.verdicts.values() else word   # nobody judged them apart
        reasons = [reason.what for reason in grave_reasons(calibration) if sensor in reason.sensors][:1] or reasons
        proof = {sensor: proof[sensor]} if sensor in proof else {}
    bad = [': '.join([f'its verdict is {verdict_text(BAD, calibration.verdicts)}', *reasons])] if word == BAD else []
    return list(dict.fromkeys([*bad, *implausible(calibration, sensor), *disproved(proof)]))


@dataclass(frozen=True, eq=False)
class Usable:
    """What a calibration is used as."""

    calibration: Calibration
    """With the parameters of refused sensors as of a data sheet."""
    refused: Mapping[str, str] = field(default_factory=dict)
    """Sensor that is left as it comes -> why."""

    @property
    def lines(self) -> list[str]:
        """What whoever uses it should know of that, a line each."""
        return [f'the {sensor} is left as it comes: {why}' for sensor, why in self.refused.items()]


def usable(calibration: Calibration) -> Usable:
    """
    Return what of a calibration may be used by people who do not insist.

    Raises
    ------
    DocumentError
        When that is nothing, with the gravest objection.

    """
    refused = refused_sensors(calibration)
    if refused.keys() == set(SENSORS):
        raise DocumentError('a calibration must help before anybody is corrected with it, against this one speaks: '
                            f'{objections(calibration)[0]}; calibrate again, or insist', key='anyway')
    return Usable(with_nominal(calibration, list(refused)) if refused else calibration, refused)


def refused_sensors(calibration: Calibration) -> dict[str, str]:
    """
    Return sensor -> why nobody should be corrected with its parameters.

    What makes one sensor bad may have spoilt the other: beside a refused sensor only one is used that is shown to help. By hand a gyroscope
    has its axes and its proof from the accelerometer.
    """
    against = {sensor: found[0] for sensor in SENSORS if (found := objections(calibration, sensor))}
    if not against and objections(calibration):   # of the table, or of the clock
        against = dict.fromkeys(SENSORS, objections(calibration)[0])
    for sensor in SENSORS if against else ():
        if sensor not in against and sensor not in calibration.proof:
            against[sensor] = 'that it helps is not shown'
    if 'accelerometer' in against and calibration.gauge.get('axes') == HAND_AXES:
        against.setdefault('gyroscope', 'its axes are those of the accelerometer')
    return against


def usage(calibration: Calibration) -> str:
    """Return what compensation makes of a calibration of which it uses one sensor alone, a line; '' otherwise."""
    refused = refused_sensors(calibration)
    if not 0 < len(refused) < len(SENSORS):
        return ''
    corrected = next(s for s in SENSORS if s not in refused)
    return f'compensation corrects the {corrected} with it, and leaves the {next(iter(refused))} as it comes'


def caveats(calibration: Calibration) -> list[str]:
    """Return what should be known about a calibration that may be used, a line each."""
    if not calibration.verdict:
        return ['it carries no verdict, as files of earlier versions do: calibrate again to know how good it is']
    why = missing(calibration) or ''.join(calibration.verdict_reasons[:1])
    told = f'its verdict is {verdict_text(calibration.verdict, calibration.verdicts)}' + (f': {why}' if why else '')
    return [] if calibration.verdict == GOOD else [told]


def missing(calibration: Calibration) -> str:
    """Return which parameters are not determined, as text; '' when all are."""
    names = [name for name, status in zip(calibration.param_names, calibration.status) if status != DETERMINED]
    return f'{len(names)} of {len(calibration.status)} parameters not determined ({listed(names)})' if names else ''


def standing(calibration: Calibration) -> str:
    """Return in a few words how well a calibration is known, for one line in a log."""
    proof = 'proven on held-out data' if calibration.proof and not disproved(calibration.proof) else 'no proof on held-out data'
    return f'{verdict_text(calibration.verdict, calibration.verdicts) or "no verdict"}, {proof}'
