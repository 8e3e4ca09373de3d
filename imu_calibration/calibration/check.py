"""Does a calibration help on another recording, and has its error changed? For any reference."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from imu_calibration.calibration.check_result import (
    OWN_RECORDING,
    TOO_FEW_WINDOWS,
    CheckResult,
)
from imu_calibration.core.errors import InputError
from imu_calibration.core.exit_codes import dropped_text
from imu_calibration.core.settings import CHANGE
from imu_calibration.document.calibration import Calibration, scale_questions
from imu_calibration.document.change import changes_since
from imu_calibration.document.outcome import decision_limits
from imu_calibration.document.proof_entry import Proof
from imu_calibration.effects.base import SENSORS
from imu_calibration.preprocessing.checks import unusable
from imu_calibration.preprocessing.recording_evidence import CheckFinding


@dataclass(frozen=True, eq=False, kw_only=True)
class ReadingErrors:
    """
    Errors of the readings of a recording against a reference, raw and as compensation writes them.

    This is what a reference contributes to a check (`window_readings`, `pose_readings`).
    """

    proof: Proof
    """Sensor -> error before and after by regime; {} with too few data."""
    stored: Proof
    """Held-out errors in the file of the calibration, with the same names of motions."""
    findings: tuple[CheckFinding, ...]
    """Findings of the checks of the recording."""
    lost: Mapping[str, int]
    """Reason -> samples that are not used because of a fault."""
    n_used: int
    """Samples without a fault."""
    why: str = TOO_FEW_WINDOWS
    """Why there is no proof, where there is none."""
    notes: tuple[str, ...] = ()
    """Notes on the reference."""


def require_sensor(calibration: Calibration, absent: Collection[str]) -> frozenset[str]:
    """
    Return the sensors that cannot be checked: without parameters or without readings.

    Raises
    ------
    InputError
        When that leaves none.

    """
    not_checked = frozenset({*calibration.absent, *absent})
    if not_checked == set(SENSORS):
        raise InputError(
            'a calibration must be of a sensor that the recording has, it is of the'
            f' {calibration.sensors[0]} only and the recording has no readings of it; give another'
            ' recording',
            code='absent',
        )
    return not_checked


def check_errors(
    errors: ReadingErrors,
    calibration: Calibration,
    *,
    change_limit: float = CHANGE,
    own_recording: bool = False,
) -> CheckResult:
    """
    Return the result of the check of a calibration.

    Parameters
    ----------
    errors : ReadingErrors
        Of a recording of its IMU.
    calibration : Calibration
    change_limit : float
        Factor of the error from which a significant change counts, at least 1.
    own_recording : bool
        Whether the calibration was made from this recording: no decision is then better than that
        in its file.

    """
    # Errors of the same kind of motion now and on the day of the calibration.
    changes = changes_since(errors.stored, errors.proof)
    notes = [*errors.notes]
    if errors.proof and not changes:
        notes.append('the file has no held-out error of the same kinds of motion to compare')
    notes += scale_questions(calibration).values()
    if own_recording:
        notes.append(OWN_RECORDING)

    return CheckResult(
        errors.proof,
        errors.findings,
        why=errors.why,
        notes=tuple(notes),
        limits=decision_limits(calibration, own_recording=own_recording),
        changes=changes,
        change_limit=change_limit,
        dropped=dropped_text({**errors.lost, 'unusable': unusable(errors.findings)}, errors.n_used),
        sensors=tuple(calibration.sensors),
    )
