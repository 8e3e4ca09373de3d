"""
Checks of a recording before the estimate.

`CHECKS` is the registry: a check is a function of the `Evidence` that yields `Finding` objects; adding one is adding an entry.
"""


from collections.abc import Sequence

from imu_calibration.constants import STANDARD_GRAVITY
from imu_calibration.errors import InputError
from imu_calibration.preflight import frozen_checks, stamp_checks, value_checks
from imu_calibration.preflight.evidence import EvidenceGatherer
from imu_calibration.preflight.finding import REFUSE, WARNING, CheckFinding
from imu_calibration.segmentation.block_cleaning import BlockCleaner, CleanedBlock
from imu_calibration.segmentation.stream_cleaning import StreamStatistics

CHECKS = (
    value_checks.force_unit, stamp_checks.stamps, stamp_checks.clocks, frozen_checks.frozen, frozen_checks.frozen_for_a_time,
    value_checks.rate_unit, value_checks.full_scale, value_checks.handedness, value_checks.bias, value_checks.gravity,
    value_checks.clipping,
    value_checks.repeated_readings, value_checks.resolution, value_checks.temperature,
    stamp_checks.sampling, stamp_checks.gaps, stamp_checks.jitter,
)
"""In the order in which they refuse: a wrong unit causes failures of later checks as well."""


class Preflight:
    """
    Watches a recording while it is read (a `segmentation.block_cleaning.Watcher`).

    Parameters
    ----------
    gravity : float, optional
        Local gravity, m/s^2; default standard gravity.
    strict : bool
        Whether `finish` raises when a finding implies a wrong result.

    """

    def __init__(self, gravity: float | None = None, *, strict: bool = True):
        self._gatherer, self._strict = EvidenceGatherer(STANDARD_GRAVITY if gravity is None else gravity), strict
        self.findings: tuple[CheckFinding, ...] = ()
        self.streams: dict[str, StreamStatistics] = {}
        self.lost: dict[str, int] = {}
        """Findings; name -> StreamStatistics; reason -> number of unreadable messages: complete after `finish`."""

    def push(self, cleaned: CleanedBlock) -> None:
        """Process a CleanedBlock."""
        self._gatherer.push(cleaned)

    def finish(self, cleaner: BlockCleaner) -> None:
        """
        Check the streams that the BlockCleaner cleaned.

        Raises
        ------
        InputError
            When a finding implies a wrong result, unless `strict` is off.

        """
        self.streams, self.lost = cleaner.statistics(), cleaner.lost
        evidence = self._gatherer.evidence(self.streams)
        self.findings = tuple(finding for check in CHECKS for finding in check(evidence)) if 'imu' in evidence.streams else ()
        if self._strict:
            refuse(self.findings)


def refuse(findings: tuple[CheckFinding, ...]) -> None:
    """Raise the first finding that makes the result wrong as an InputError."""
    for finding in findings:
        if finding.severity == REFUSE:
            raise InputError(finding.text, key=finding.key, code=finding.check)


def warnings(findings: Sequence[CheckFinding]) -> list[CheckFinding]:
    """Return the findings that a user must see."""
    return [finding for finding in findings if finding.severity in (REFUSE, WARNING)]


def unusable(findings: Sequence[CheckFinding]) -> int:
    """Return how many samples are unusable for reasons that no other count holds."""
    return sum(finding.samples for finding in findings)
