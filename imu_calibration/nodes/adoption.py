"""Read, validate and prepare a calibration document for compensation."""

from dataclasses import dataclass, replace

from imu_calibration.compensation.compensate import Transfer
from imu_calibration.compensation.health import CalibrationHealth, HealthOptions, StopWatch
from imu_calibration.compensation.stream import requested_transfer
from imu_calibration.core.documents import version_of
from imu_calibration.core.errors import DocumentError, ImuCalibrationError, shortened
from imu_calibration.document import files, trust
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.calibration_text import calibration_from_text
from imu_calibration.document.comparison import moved_beyond_sd
from imu_calibration.document.trust import with_measured_noise
from imu_calibration.nodes.compensator_settings import CompensatorSettings
from imu_calibration.nodes.message_compensation import LiveCompensation
from imu_calibration.nodes.static_frames import TOPIC, StaticFrames


class Awaited(ImuCalibrationError):
    """A precondition is not met yet; the text names it."""


@dataclass(frozen=True, eq=False)
class Adopted:
    """A calibration that is in force."""

    calibration: Calibration
    """Content of the document."""
    used: trust.Usable
    """The part of the calibration that is used."""
    compensation: LiveCompensation
    """Compensation by this calibration."""
    version: str
    """Changes whenever the document does."""
    source: str
    """Source of the document, readable."""

    @property
    def caveats(self) -> list[str]:
        """Sensors that are not corrected or corrected with caution, and parameters that are not determined."""
        return [*self.used.lines, *trust.caveats(self.calibration)]

    def line(self) -> str:
        """Return one line that describes the calibration in force."""
        return f'calibration {self.version} from {self.source} ({trust.standing(self.calibration)}) adopted'

    def says_more_than(self, other: 'Adopted | None') -> bool:
        """Return whether the change from `other` must be reported: its source, decisions or values differ."""
        if other is None or self.calibration.decisions != other.calibration.decisions:
            return True
        if self.source != other.source or self.used.refused.keys() != other.used.refused.keys():
            return True
        return moved_beyond_sd(other.calibration, self.calibration)


def adopt(text: str, source: str, settings: CompensatorSettings, *, frames: StaticFrames, before: Adopted | None = None) -> Adopted:
    """
    Return the calibration in a document, ready to take the place of `before`.

    Raises
    ------
    Awaited
        While the transform into the target frame has not been received.
    ImuCalibrationError
        When the document is invalid, not usable, or for another sensor; any other exception is converted to this type.

    """
    try:
        calibration = calibration_from_text(text)
        used = trust.usable(calibration, anyway=settings.anyway, live=True)
        _require_same_frame(calibration, before)
        return Adopted(calibration, used, _prepared(used.calibration, settings, frames, before), version_of(text), source)
    except ImuCalibrationError:
        raise
    except Exception as error:   # no document may end the node
        what = shortened(f'{type(error).__name__}: {error}', 200)
        raise DocumentError(f'a calibration must be usable, this one is not: {what}', code='not_usable') from error


def again(adopted: Adopted, settings: CompensatorSettings, frames: StaticFrames) -> Adopted:
    """Return the same calibration under other settings or transforms."""
    return replace(adopted, compensation=_prepared(adopted.used.calibration, settings, frames, adopted))


def has_moved(adopted: Adopted, settings: CompensatorSettings, frames: StaticFrames) -> bool:
    """Return whether the pose from the static transforms differs from the one in force."""
    found = _transfer(adopted.calibration, settings, frames)
    return found is not None and not found.is_close(adopted.compensation.transfer)


def _transfer(calibration: Calibration, settings: CompensatorSettings, frames: StaticFrames) -> Transfer | None:
    """Return where the readings are to be moved: by the pose in the parameters, without one by the static transforms."""
    target, given = settings.target_frame, any(settings.target_xyz) or any(settings.target_rpy)
    if not target or given or target == calibration.frame_id:
        return requested_transfer(target, settings.target_xyz, settings.target_rpy)
    if not calibration.frame_id:
        raise DocumentError(f"to move readings to '{target}' by {TOPIC} the calibration must name the frame of the sensor, "
                            "it names none; give "
                            'target_xyz and target_rpy')
    pose = frames.pose(target, calibration.frame_id)
    if pose is None:
        raise Awaited(frames.waits_for(target, calibration.frame_id))
    xyz_t, mat_ts = pose
    return Transfer(target, mat_ts, xyz_t)


def _prepared(calibration: Calibration, settings: CompensatorSettings, frames: StaticFrames, before: Adopted | None) -> LiveCompensation:
    if settings.noise_file:
        calibration = with_measured_noise(calibration, files.read_noise(files.user_path(settings.noise_file)))
    transfer = _transfer(calibration, settings, frames)
    compensation = LiveCompensation(calibration, transfer, check_frame=settings.check_frame_id,
                                    with_parameters=settings.parameter_covariance,
                                    correct_stamps=settings.correct_stamps, watch=_watch(calibration, transfer, settings, before))
    if before is not None:
        compensation.prepare(before.compensation)
    return compensation


def _watch(calibration: Calibration, transfer: Transfer | None, settings: CompensatorSettings, before: Adopted | None) -> StopWatch:
    """Return the StopWatch: the present one where its inputs are unchanged."""
    options = HealthOptions(settings.gravity, settings.update_gyro_bias, settings.gyro_bias_time)
    watch = None if before is None or before.used.calibration is not calibration else before.compensation.watch
    if before is not None and watch is not None and watch.health.options == options:
        was = before.compensation.transfer
        if was is transfer or (transfer is not None and transfer.is_close(was)):
            return watch
    return StopWatch(CalibrationHealth(calibration, transfer, options))


def _require_same_frame(calibration: Calibration, before: Adopted | None) -> None:
    known = '' if before is None else before.compensation.frame_id
    if known and calibration.frame_id and calibration.frame_id != known:
        raise DocumentError(f"a new calibration must be for the same sensor, '{known}', this one is for '{calibration.frame_id}'; "
                            'restart the node for another sensor', code='other_sensor')
