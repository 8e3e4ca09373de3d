"""Parameters of planner_node, declared once."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.reference.motion_limits import MotionLimits
from imu_calibration.settings import setting
from imu_calibration.simulation.sensor_noise import GRADES


@dataclass(frozen=True)
class PlannerNodeSettings:
    """Moved joints, parameters to determine, and interface of the commands."""

    table_file: str = setting('', '', 'description of the table with the limits of its joints, path; empty: urdf_file describes the arm',
                              symptom='other joints, or limits that are not theirs', session=True, path=True)
    tolerances_file: str = setting('', '', 'tolerances, path; empty: the installed config/tolerances.yaml',
                                   symptom='motions last too long, or end too early', session=True, path=True)
    accelerometer_model: str = setting('', '', 'as of calibration_node', symptom='motions for parameters that are not estimated')
    gyroscope_model: str = setting('', '', 'as of calibration_node', symptom='motions for parameters that are not estimated')
    reference_model: str = setting('', '', 'as of calibration_node', symptom='motions for parameters that are not estimated')
    grade: str = setting('industrial', '', 'grade of the noise that is expected before it is known: ' + ', '.join(sorted(GRADES)),
                         symptom='the predicted standard deviations are not reached')
    noise_file: str = setting('', '', 'noise.yaml of this IMU, from the verb noise, path; empty: that of the grade',
                              symptom='the predicted standard deviations are not reached', session=True, path=True)
    imu_rate: float = setting(100.0, 'Hz', 'Imu messages per second', (1.0, 20000.0),
                              'the predicted standard deviations are not reached')
    command: str = setting('topic', '', 'how trajectories are sent: topic (joint_trajectory), action (follow_joint_trajectory, needs '
                           'control_msgs) or auto (the action where there is one)', symptom='nothing moves')
    max_turns: float = setting(1.0, '1', 'turns of an endless joint to either side of its position at the first start, unwound at the end; '
                               '0: unlimited, for slip rings', (0.0, 1e4), 'too large: cables are wound up; too small: slow plans',
                               fixed='the range of every joint is set at the first start')
    reach_deg: float = setting(0.0, 'deg', 'largest angle of each joint to either side of its position at the first start; '
                               'sliding joints do not move; 0: the whole range', (0.0, 3600.0), 'too large: collisions',
                               fixed='the range of every joint is set at the first start')
    calibration_node: str = setting('calibration_node', '', 'name of the node that collects the windows',
                                    symptom='~/start reports a missing service')


def restricted_limits(limits: MotionLimits, position: np.ndarray, settings: PlannerNodeSettings) -> MotionLimits:
    """Return the limits of the joints restricted by `max_turns` and `reach_deg` about a position."""
    limits = limits.wound(position, settings.max_turns)
    return limits.reached(position, settings.reach_deg) if settings.reach_deg else limits
