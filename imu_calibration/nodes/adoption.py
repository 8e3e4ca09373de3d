"""From a calibration document to what a compensator corrects with: read, asked what speaks against it, prepared."""

from dataclasses import dataclass, replace

from imu_calibration import files
from imu_calibration.calibration import trust
from imu_calibration.calibration.comparison import moved_beyond_sd
from imu_calibration.calibration.document import Calibration, calibration_from_text
from imu_calibration.calibration.measured_noise import with_measured_noise
from imu_calibration.compensation.stream import requested_transfer
from imu_calibration.documents import version_of
from imu_calibration.errors import DocumentError, ImuCalibrationError, shortened
from imu_calibration.nodes.compensator_settings import CompensatorSettings
from imu_calibration.nodes.message_compensation import LiveCompensation


@dataclass(frozen=True, eq=False)
class Adopted:
    """A calibration that is in force."""

    calibration: Calibration
    """What its document says."""
    compensation: LiveCompensation
    """What corrects with it."""
    version: str
    """Changes whenever the document does."""
    source: str
    """Where it came from, for people."""

    @property
    def caveats(self) -> list[str]:
        """What should be known of it, and what speaks against it where somebody insisted."""
        return trust.objections(self.calibration) + trust.caveats(self.calibration)

    def line(self) -> str:
        """Return in one line what is in force."""
        return f'calibration {self.version} from {self.source} ({trust.standing(self.calibration)}) taken over'

    def says_more_than(self, other: 'Adopted | None') -> bool:
        """Return whether a person should hear of this after `other`: it came from elsewhere, or says something else."""
        if other is None or (self.source, self.calibration.verdict) != (other.source, other.calibration.verdict):
            return True
        return moved_beyond_sd(other.calibration, self.calibration)


def adopt(text: str, source: str, settings: CompensatorSettings, before: Adopted | None = None) -> Adopted:
    """
    Return the calibration in a document, ready to take the place of `before`.

    Raises
    ------
    ImuCalibrationError
        When it is none, something speaks against it, or it is for another sensor; whatever else goes wrong is told in the same way.

    """
    try:
        calibration = calibration_from_text(text)
        if not settings.anyway:
            trust.refuse_untrusted(calibration)
        _require_same_frame(calibration, before)
        return Adopted(calibration, _prepared(calibration, settings, before), version_of(text), source)
    except ImuCalibrationError:
        raise
    except Exception as error:   # whatever a document does, it must not end the node
        raise DocumentError('a calibration must be usable, this one is not: ' + shortened(f'{type(error).__name__}: {error}', 200)) from error


def again(adopted: Adopted, settings: CompensatorSettings) -> Adopted:
    """Return the same calibration under other settings."""
    return replace(adopted, compensation=_prepared(adopted.calibration, settings, adopted))


def _prepared(calibration: Calibration, settings: CompensatorSettings, before: Adopted | None) -> LiveCompensation:
    if settings.noise_file:
        calibration = with_measured_noise(calibration, files.read_noise(files.user_path(settings.noise_file)))
    transfer = requested_transfer(settings.target_frame, settings.target_xyz, settings.target_rpy)
    compensation = LiveCompensation(calibration, transfer, settings.check_frame_id, settings.parameter_covariance, settings.correct_stamps)
    if before is not None:
        compensation.prepare(before.compensation)
    return compensation


def _require_same_frame(calibration: Calibration, before: Adopted | None) -> None:
    known = '' if before is None else before.compensation.frame_id
    if known and calibration.frame_id and calibration.frame_id != known:
        raise DocumentError(f"a new calibration must be for the same sensor, '{known}', this one is for '{calibration.frame_id}'; "
                            'restart the node for another sensor')
