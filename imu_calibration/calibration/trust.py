"""May a calibration be used? What its document says against it, and what whoever uses it should know."""

from imu_calibration.calibration.document import Calibration
from imu_calibration.calibration.plausibility import implausible
from imu_calibration.calibration.proof_words import disproved
from imu_calibration.calibration.status import DETERMINED
from imu_calibration.calibration.verdict import BAD, GOOD, listed
from imu_calibration.errors import DocumentError


def objections(calibration: Calibration) -> list[str]:
    """
    Return why nobody should be corrected with a calibration unless they insist, a line each; the first is the gravest.

    A bad verdict; values beyond what is known of any instrument; a proof that does not show a smaller error with the calibration
    than without, or a larger one in some motion (`proof_words.disproved`).
    """
    reasons = calibration.verdict_reasons[:1]
    bad = [': '.join(['its verdict is bad', *reasons])] if calibration.verdict == BAD else []
    return list(dict.fromkeys([*bad, *implausible(calibration), *disproved(calibration.proof)]))


def caveats(calibration: Calibration) -> list[str]:
    """Return what should be known about a calibration that may be used, a line each."""
    if not calibration.verdict:
        return ['it carries no verdict, as files of earlier versions do: calibrate again to know how good it is']
    why = missing(calibration) or ''.join(calibration.verdict_reasons[:1])
    return [] if calibration.verdict == GOOD else [f'its verdict is {calibration.verdict}' + (f': {why}' if why else '')]


def missing(calibration: Calibration) -> str:
    """Return which parameters are not determined, as text; '' when all are."""
    names = [name for name, status in zip(calibration.param_names, calibration.status) if status != DETERMINED]
    return f'{len(names)} of {len(calibration.status)} parameters not determined ({listed(names)})' if names else ''


def standing(calibration: Calibration) -> str:
    """Return in a few words how well a calibration is known, for one line in a log."""
    proof = 'proven on held-out data' if calibration.proof and not disproved(calibration.proof) else 'no proof on held-out data'
    return f'{calibration.verdict or "no verdict"}, {proof}'


def refuse_untrusted(calibration: Calibration) -> None:
    """
    Refuse a calibration that has objections against it.

    Raises
    ------
    DocumentError
        With the gravest of them.

    """
    against = objections(calibration)
    if against:
        raise DocumentError(f'a calibration must help before anybody is corrected with it, against this one speaks: {against[0]}; calibrate '
                            'again, or insist', key='anyway')
