"""Parameters of compensator_node, declared once."""

from dataclasses import dataclass

from imu_calibration.settings import setting


@dataclass(frozen=True)
class CompensatorSettings:
    """What to correct with, where to, and how."""

    calibration_file: str = setting('', '', 'calibration.yaml to start with and to return to on ~/reload; empty: wait for imu/calibration',
                                    symptom='nothing is published, diagnostics say why')
    passthrough: bool = setting(False, '', 'publish the messages unchanged until there is a calibration',
                                symptom='uncorrected messages on the corrected topic')
    target_frame: str = setting('', '', 'frame of the same rigid body to move the readings to; empty: the frame of the sensor',
                                symptom='frame_id is not the one that others expect')
    target_xyz: tuple = setting((0.0, 0.0, 0.0), 'm', 'place of the sensor in the target frame',
                                symptom='specific force is wrong while the body turns, right at rest')
    target_rpy: tuple = setting((0.0, 0.0, 0.0), 'rad', 'roll, pitch and yaw of the sensor in the target frame',
                                symptom='gravity points along the wrong axis')
    reliable: bool = setting(False, '', 'subscribe reliably instead of best-effort',
                             symptom='a best-effort publisher never connects; if false, messages may be lost under load')
    check_frame_id: bool = setting(True, '', 'correct only messages that carry the frame_id of the calibration',
                                   symptom='nothing is published, diagnostics name both frames; if false, another sensor may pass unnoticed')
    correct_stamps: bool = setting(False, '', 'move the stamps back by the time_offset of the calibration',
                                   symptom='stamps differ from those of the driver')
    parameter_covariance: bool = setting(True, '', 'add what the uncertainty of the calibration contributes to the covariances',
                                         symptom='covariances are too small, filters trust the readings too much')
    covariance_rate: float = setting(1.0, 'Hz', 'how often covariances are taken anew at the present motion; 0: only with a new calibration',
                                     (0.0, 100.0), 'too small: covariances lag behind fast turns; too large: computing time')
    public_executor: bool = setting(False, '', "use rclpy's public executor, four times slower, instead of a wait set of our own",
                                    symptom='messages are lost above 3 kHz')
