"""Settings of the compensator, and adoption of a calibration from a file or topic."""

from dataclasses import dataclass, replace
from pathlib import Path

from imu_calibration.compensation.compensate import Transfer
from imu_calibration.compensation.health import CalibrationHealth, HealthOptions, StopWatch
from imu_calibration.compensation.plausible_change import implausible_change
from imu_calibration.compensation.stream import requested_transfer
from imu_calibration.compensation.unit_gate import GravityScale, UnitGate
from imu_calibration.core.documents import version_of
from imu_calibration.core.errors import DocumentError, ImuCalibrationError, shortened
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.settings import (
    flag_setting,
    height_setting,
    path_setting,
    setting,
    text_setting,
)
from imu_calibration.document import files, trust
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.calibration_text import calibration_from_text
from imu_calibration.document.comparison import moved_beyond_sd
from imu_calibration.document.decision import HARMS, decisions_text
from imu_calibration.document.trust import with_measured_noise
from imu_calibration.kinematics.rotations import gravity_of_settings
from imu_calibration.nodes.message_compensation import LiveCompensation
from imu_calibration.nodes.robot_stand import TF_STATIC, StaticFrames

FROM_FILE, FROM_TOPIC, FILE_THEN_TOPIC = 'file', 'topic', 'file_then_topic'
"""
Source of the calibrations.

By default a given file remains in force and the topic is ignored; without a file the topic is used.
A user who gives a file does not want another session to replace it, and without a file the node has
no other source.
"""


@dataclass(frozen=True)
class CompensatorSettings:
    """Calibration, target frame and options of the compensation."""

    calibration_file: str = path_setting(
        'calibration.yaml or its folder, read again on ~/reload; empty: wait for imu/calibration',
        'no messages are published, see diagnostics',
    )
    wait_for_file: bool = flag_setting(
        'wait for calibration_file while it does not exist',
        'the node ends at its start',
    )
    adopt: str = text_setting(
        'source of calibrations; file: calibration_file only, for the field; '
        'topic: imu/calibration, which replaces the file; '
        'file_then_topic: imu/calibration only while no calibration_file is named',
        'a calibration on the topic is not adopted, or replaces the file',
        default=FILE_THEN_TOPIC,
        live=True,
        choices=(FROM_FILE, FROM_TOPIC, FILE_THEN_TOPIC),
    )
    anyway: bool = flag_setting(
        'also correct a sensor whose decision is unproven, and adopt a calibration from the topic'
        ' that changes the readings by more than such sensors need; one whose decision is harms is'
        ' never corrected',
        'the correction may increase the error of the readings',
        live=True,
    )
    passthrough: bool = flag_setting(
        'publish the messages unchanged until there is a calibration',
        'uncorrected messages on the corrected topic',
        live=True,
    )
    target_frame: str = text_setting(
        'frame of the same rigid body to move the readings to, by target_xyz and target_rpy, '
        'or where both are zero by the transforms on /tf_static; empty: the frame of the sensor',
        'subscribers expect a different frame_id',
        live=True,
        session=True,
    )
    target_xyz: tuple = setting(
        (0.0, 0.0, 0.0),
        'm',
        'place of the sensor in the target frame; with target_rpy zero too: from /tf_static',
        symptom='specific force is wrong while the body turns, right at rest',
        live=True,
        session=True,
    )
    target_rpy: tuple = setting(
        (0.0, 0.0, 0.0),
        'rad',
        'roll, pitch and yaw of the sensor in the target frame; '
        'with target_xyz zero too: from /tf_static',
        symptom='gravity points along the wrong axis',
        live=True,
        session=True,
    )
    check_frame_id: bool = flag_setting(
        'correct only messages that carry the frame_id of the calibration',
        'no messages are published, diagnostics name both frames; '
        'if false, messages of a different sensor are corrected',
        default=True,
        live=True,
    )
    correct_stamps: bool = flag_setting(
        'move the stamps back by the time_offset of the calibration',
        'stamps differ from those of the driver',
        live=True,
    )
    parameter_covariance: bool = flag_setting(
        'add the uncertainty of the calibration to the covariances',
        'covariances are too small, filters trust the readings too much',
        default=True,
        live=True,
    )
    noise_file: str = path_setting(
        'noise.yaml of this IMU, from the verb noise: '
        'covariances follow from it where the messages bring none; empty: '
        'from the noise that the calibration saw',
        'filters trust the readings too much or too little',
    )
    covariance_rate: float = setting(
        1.0,
        'Hz',
        'rate of updates of the covariances at the present motion; 0: only with a new calibration',
        (0.0, 100.0),
        'too small: covariances lag behind fast turns; too large: computing time',
        live=True,
    )
    gravity: float = setting(
        0.0,
        'm/s^2',
        'gravity at the site of the robot, for the test of the calibration at stops; 0: that of the'
        ' latitude, or of the calibration, within the half per cent of variation between sites',
        (0.0, 20.0),
        'an error of a scale below half a per cent is not detected',
        live=True,
    )
    latitude: float = setting(
        100.0,
        'deg',
        'latitude of the robot, used if gravity is 0 (WGS 84 normal gravity); above 90: unknown',
        (-90.0, 100.0),
        'as with a wrong gravity',
        live=True,
    )
    height: float = height_setting()
    update_gyro_bias: bool = flag_setting(
        'correct the residual bias of the gyroscope measured at stops',
        'headings drift as the sensor warms up; if true where the robot turns slowly and'
        ' steadily at "rest", that rotation counts as a bias',
        live=True,
    )
    gyro_bias_time: float = setting(
        600.0,
        's',
        'in which such an update loses its meaning while the robot does not stop',
        (10.0, 86400.0),
        'too long: the bias of long ago is believed; too short: it is forgotten between stops',
        live=True,
    )
    public_executor: bool = flag_setting(
        "use rclpy's public executor, at two to four times the computing time, "
        'instead of a wait set of our own',
        'messages are lost above 3 kHz',
        fixed='the loop is chosen when the node starts',
    )

    @property
    def calibration_path(self) -> Path:
        """Path of the calibration, also where `calibration_file` names its folder."""
        return files.calibration_path(files.user_path(self.calibration_file))

    @property
    def takes_topic(self) -> bool:
        """Whether calibrations received on the topic are adopted."""
        return self.adopt == FROM_TOPIC or (
            self.adopt == FILE_THEN_TOPIC and not self.calibration_file
        )


class Awaited(ImuCalibrationError):
    """A precondition is not met yet; the text names it."""


def may_become_ready(error: ImuCalibrationError, text: str) -> bool:
    """Return whether a calibration is refused only because it has too few data so far."""
    if error.code != 'no_sensor_helps':
        return False
    return HARMS not in calibration_from_text(text).decisions.values()


@dataclass(frozen=True, eq=False)
class Adopted:
    """A calibration that is in force."""

    calibration: Calibration
    """Content of the document."""
    used: trust.Usable
    """The calibration as it is applied, and the sensors that are not corrected."""
    compensation: LiveCompensation
    """Compensation by this calibration."""
    version: str
    """Hash of the document's text."""
    source: str
    """Source of the document, readable."""
    anchor: Calibration
    """
    The last calibration from a file or with consent, or else the first from the topic: documents
    from the topic are compared with it too, so that many small changes do not add up.
    """

    @property
    def caveats(self) -> list[str]:
        """Lines on sensors that are not corrected or with caution, and undetermined parameters."""
        return [*self.used.lines, *trust.caveats(self.calibration)]

    def line(self) -> str:
        """Return one line that describes the calibration in force."""
        return (
            f'calibration {self.version} from {self.source}'
            f' ({decisions_text(self.calibration.decisions)}) adopted'
        )

    def must_be_reported_after(self, reported: 'Adopted | None') -> bool:
        """Return whether source, decisions or values differ from the last reported calibration."""
        if reported is None or self.source != reported.source:
            return True
        if self.calibration.decisions != reported.calibration.decisions:
            return True
        if self.used.refused.keys() != reported.used.refused.keys():
            return True
        return moved_beyond_sd(reported.calibration, self.calibration)


def adopt(
    text: str,
    source: str,
    settings: CompensatorSettings,
    *,
    frames: StaticFrames,
    before: Adopted | None = None,
    from_topic: bool = False,
) -> Adopted:
    """
    Return the calibration in a document, ready to take the place of `before`.

    A document from the topic is not trusted: without the user's consent (`anyway`) it may change
    the readings only by as much as sensors of the kind need.

    Raises
    ------
    Awaited
        While the transform into the target frame has not been received.
    ImuCalibrationError
        When the document is invalid, not usable, or for another sensor; any other exception is
        converted to this type.

    """
    try:
        calibration = calibration_from_text(text)
        used = trust.usable(calibration, anyway=settings.anyway, live=True)
        _require_same_frame(calibration, before)
        # Compiled before its readings are compared: a document of nested powers is refused here.
        compensation = _make_compensation(used.calibration, settings, frames, before)
        anchor = used.calibration
        if from_topic:
            anchor = _anchor_from_topic(used.calibration, settings, before)
        return Adopted(
            calibration,
            used,
            compensation,
            version_of(text),
            source,
            anchor,
        )
    except ImuCalibrationError:
        raise
    except Exception as error:  # no document may end the node
        reason = shortened(f'{type(error).__name__}: {error}', 200)
        raise DocumentError(
            f'a calibration must be usable, this one is not: {reason}', code='not_usable'
        ) from error


def with_settings(adopted: Adopted, settings: CompensatorSettings, frames: StaticFrames) -> Adopted:
    """Return the same calibration under other settings or transforms."""
    return replace(
        adopted,
        compensation=_make_compensation(adopted.used.calibration, settings, frames, adopted),
    )


def has_moved(adopted: Adopted, settings: CompensatorSettings, frames: StaticFrames) -> bool:
    """Return whether the pose from the static transforms differs from the one in force."""
    transfer = _transfer(adopted.calibration, settings, frames)
    return transfer is not None and not transfer.is_close(adopted.compensation.transfer)


def _transfer(
    calibration: Calibration, settings: CompensatorSettings, frames: StaticFrames
) -> Transfer | None:
    """
    Return the transfer of the readings to the target frame; None without a target frame.

    The pose of the sensor is that of the parameters, or where these are zero that of the static
    transforms; raises `Awaited` while that one has not been received.
    """
    target = settings.target_frame
    has_pose = any(settings.target_xyz) or any(settings.target_rpy)
    if not target or has_pose or target == calibration.frame_id:
        return requested_transfer(target, settings.target_xyz, settings.target_rpy)
    if not calibration.frame_id:
        raise DocumentError(
            f"to move readings to '{target}' by {TF_STATIC} the calibration must name the frame of"
            ' the sensor, it names none; give target_xyz and target_rpy'
        )
    pose = frames.pose(target, calibration.frame_id)
    if pose is None:
        raise Awaited(frames.waits_for(target, calibration.frame_id))
    xyz_t, mat_ts = pose
    return Transfer(target, mat_ts, xyz_t)


def _make_compensation(
    calibration: Calibration,
    settings: CompensatorSettings,
    frames: StaticFrames,
    before: Adopted | None,
) -> LiveCompensation:
    """Return the compensation by a calibration, ready to continue that of `before`."""
    if settings.noise_file:
        noise = files.read_noise(files.user_path(settings.noise_file))
        calibration = with_measured_noise(calibration, noise)
    transfer = _transfer(calibration, settings, frames)
    compensation = LiveCompensation(
        calibration,
        transfer,
        check_frame=settings.check_frame_id,
        with_parameters=settings.parameter_covariance,
        correct_stamps=settings.correct_stamps,
        watch=_stop_watch(calibration, transfer, settings, before),
        readings=calibration.readings,
        gate=UnitGate(calibration.readings, GravityScale(calibration)),
    )
    if before is not None:
        compensation.prepare(before.compensation)
    return compensation


def _stop_watch(
    calibration: Calibration,
    transfer: Transfer | None,
    settings: CompensatorSettings,
    before: Adopted | None,
) -> StopWatch:
    """
    Return the StopWatch of a calibration.

    That of `before`, with the stops so far, where calibration, options and transfer are the same.
    """
    gravity, _ = gravity_of_settings(settings.gravity, settings.latitude, settings.height)
    options = HealthOptions(gravity, settings.update_gyro_bias, settings.gyro_bias_time)
    if before is not None and before.used.calibration is calibration:
        watch = before.compensation.watch
        old_transfer = before.compensation.transfer
        same_transfer = old_transfer is transfer
        if transfer is not None:
            same_transfer = same_transfer or transfer.is_close(old_transfer)
        if watch is not None and watch.health.options == options and same_transfer:
            return watch
    return StopWatch(CalibrationHealth(calibration, transfer, options))


def _anchor_from_topic(
    calibration: Calibration, settings: CompensatorSettings, before: Adopted | None
) -> Calibration:
    """
    Return the anchor (see `Adopted.anchor`) after a calibration from the topic.

    Raises a DocumentError for a change of the readings, from those of the present calibration or of
    the anchor, that no IMU of the kind needs: decisions in a document may be copied.
    """
    if settings.anyway:
        return calibration
    # None: the uncorrected readings, with which the first calibration is compared.
    references: list[Calibration | None] = [None]
    if before is not None:
        references = [before.used.calibration, before.anchor]
    for reference in references:
        fault = implausible_change(calibration, reference)
        units = RawReadings() if reference is None else reference.readings
        # Another unit changes the readings by any factor.
        if not calibration.readings.has_units_of(units):
            fault = 'it describes readings in other units'
        if fault:
            near = 'uncorrected readings' if reference is None else 'the one in use'
            raise DocumentError(
                f'a calibration from the topic must be near {near}: {fault}; if it is right, set'
                ' anyway:=true',
                key='anyway',
                code='implausible_change',
            )
    return calibration if before is None else before.anchor


def _require_same_frame(calibration: Calibration, before: Adopted | None) -> None:
    """Raise a DocumentError for a calibration of another sensor than the present one."""
    present = '' if before is None else before.compensation.frame_id
    if present and calibration.frame_id and calibration.frame_id != present:
        raise DocumentError(
            f"a new calibration must be for the same sensor, '{present}', this one is for"
            f" '{calibration.frame_id}'; restart the node for another sensor",
            code='other_sensor',
        )
