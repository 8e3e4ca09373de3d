"""Parameters of compensator_node, declared once."""

from dataclasses import dataclass

from imu_calibration.core.errors import InputError
from imu_calibration.core.settings import setting

FILE, TOPIC, FILE_THEN_TOPIC = 'file', 'topic', 'file_then_topic'
ADOPT = (FILE, TOPIC, FILE_THEN_TOPIC)
"""
Source of the calibrations.

By default a given file remains in force and the topic is ignored; without a file the topic is used. A user who gives a file does not want
another session to replace it, and without a file the node has no other source.
"""


@dataclass(frozen=True)
class CompensatorSettings:
    """Calibration, target frame and options of the compensation."""

    calibration_file: str = setting('', '', 'calibration.yaml to correct with, read again on ~/reload; '
                                    'empty: wait for imu/calibration',
                                    symptom='no messages are published, see diagnostics', session=True, path=True)
    wait_for_file: bool = setting(False, '', 'wait for calibration_file while it does not exist', symptom='the node ends at its start')
    adopt: str = setting(FILE_THEN_TOPIC, '', 'source of calibrations; file: calibration_file only, for the field; '
                         'topic: imu/calibration, which replaces the file; '
                         'file_then_topic: imu/calibration only while no calibration_file is named',
                         symptom='a calibration on the topic is not adopted, or replaces the file', live=True)
    anyway: bool = setting(False, '', 'also correct a sensor whose decision is unproven; one whose decision is harms is never corrected',
                           symptom='the correction may increase the error of the readings', live=True)
    passthrough: bool = setting(False, '', 'publish the messages unchanged until there is a calibration',
                                symptom='uncorrected messages on the corrected topic', live=True)
    target_frame: str = setting('', '', 'frame of the same rigid body to move the readings to, by target_xyz and target_rpy, '
                                'or where both are zero by the transforms on /tf_static; empty: the frame of the sensor',
                                symptom='subscribers expect a different frame_id', live=True, session=True)
    target_xyz: tuple = setting((0.0, 0.0, 0.0), 'm', 'place of the sensor in the target frame; with target_rpy zero too: from /tf_static',
                                symptom='specific force is wrong while the body turns, right at rest', live=True, session=True)
    target_rpy: tuple = setting((0.0, 0.0, 0.0), 'rad', 'roll, pitch and yaw of the sensor in the target frame; '
                                'with target_xyz zero too: from /tf_static',
                                symptom='gravity points along the wrong axis', live=True, session=True)
    check_frame_id: bool = setting(True, '', 'correct only messages that carry the frame_id of the calibration',
                                   symptom='no messages are published, diagnostics name both frames; '
                                   'if false, messages of a different sensor are corrected',
                                   live=True)
    correct_stamps: bool = setting(False, '', 'move the stamps back by the time_offset of the calibration',
                                   symptom='stamps differ from those of the driver', live=True)
    parameter_covariance: bool = setting(True, '', 'add the uncertainty of the calibration to the covariances',
                                         symptom='covariances are too small, filters trust the readings too much', live=True)
    noise_file: str = setting('', '', 'noise.yaml of this IMU, from the verb noise: '
                              'covariances follow from it where the messages bring none; empty: '
                              'from the noise that the calibration saw', symptom='filters trust the readings too much or too little',
                              session=True, path=True)
    covariance_rate: float = setting(1.0, 'Hz', 'rate of updates of the covariances at the present motion; '
                                     '0: only with a new calibration',
                                     (0.0, 100.0), 'too small: covariances lag behind fast turns; too large: computing time', live=True)
    gravity: float = setting(0.0, 'm/s^2', 'gravity at the site of the robot, for the test of the calibration at stops; '
                             '0: that of the calibration, within '
                             'the half per cent of variation between sites',
                             (0.0, 20.0), 'an error of a scale below half a per cent is not detected',
                             live=True)
    update_gyro_bias: bool = setting(False, '', 'correct the residual bias of the gyroscope measured at stops',
                                     symptom='headings drift as the sensor warms up; '
                                     'if true where the robot turns slowly and steadily at "rest", that '
                                     'rotation counts as a bias', live=True)
    gyro_bias_time: float = setting(600.0, 's', 'in which such an update loses its meaning while the robot does not stop', (10.0, 86400.0),
                                    'too long: the bias of long ago is believed; too short: it is forgotten between stops', live=True)
    public_executor: bool = setting(False, '', "use rclpy's public executor, at two to four times the computing time, "
                                    "instead of a wait set of our own",
                                    symptom='messages are lost above 3 kHz', fixed='the loop is chosen when the node starts')

    def __post_init__(self):
        if self.adopt not in ADOPT:
            raise InputError(f"parameter 'adopt' must be {', '.join(ADOPT)}, got '{self.adopt}'; choose one")

    @property
    def takes_topic(self) -> bool:
        """Whether calibrations received on the topic are adopted."""
        return self.adopt == TOPIC or (self.adopt == FILE_THEN_TOPIC and not self.calibration_file)
