"""
What is wrong with a recording before anything is estimated from it.

`CHECKS` is the registry: a check is a function of the `Evidence` that yields `Finding` objects; adding one is adding an entry.
"""

from imu_calibration.constants import STANDARD_GRAVITY
from imu_calibration.errors import InputError
from imu_calibration.preflight import stamp_checks, value_checks
from imu_calibration.preflight.evidence import EvidenceGatherer
from imu_calibration.preflight.finding import REFUSE, WARNING

CHECKS = (
    value_checks.force_unit, stamp_checks.stamps, stamp_checks.clocks, value_checks.frozen, value_checks.rate_unit, value_checks.handedness,
    value_checks.gravity, value_checks.clipping, value_checks.repeated_readings, value_checks.resolution, value_checks.temperature,
    stamp_checks.sampling, stamp_checks.gaps, stamp_checks.jitter,
)
"""In the order in which they refuse: a wrong unit makes much of what follows wrong as well."""


class Preflight:
    """
    Looks at a recording while something else reads it.

    Parameters
    ----------
    gravity : float, optional
        Local gravity, m/s^2; default standard gravity.
    nominal : NominalScaling of `gathering`, optional
        For recordings in volts or counts.

    """

    def __init__(self, gravity=None, nominal=None):
        self._gatherer = EvidenceGatherer(STANDARD_GRAVITY if gravity is None else gravity, nominal)
        self.findings = ()

    def watch(self, blocks, strict=True):
        """
        Yield the blocks; after the last one `findings` is complete.

        Raises
        ------
        InputError
            After the last block, when a finding says that the result would be wrong and `strict` is set.

        """
        for block in blocks:
            self._gatherer.push(block)
            yield block
        evidence = self._gatherer.evidence()
        self.findings = tuple(finding for check in CHECKS for finding in check(evidence)) if 'imu' in evidence.streams else ()
        if strict:
            refuse(self.findings)


def refuse(findings):
    """Raise the first finding that makes the result wrong as an InputError."""
    for finding in findings:
        if finding.severity == REFUSE:
            raise InputError(finding.text, key=finding.key)


def warnings(findings):
    """Return the findings that a user must see."""
    return [finding for finding in findings if finding.severity in (REFUSE, WARNING)]


def unusable(findings):
    """Return how many samples are unusable for reasons that no other count holds."""
    return sum(finding.samples for finding in findings)
