"""MPU-9150 by hand against published biases."""

import numpy as np

from imu_calibration.by_hand.calibrate import calibrate_by_hand
from imu_calibration.by_hand.options import HandOptions
from imu_calibration.segmentation.static_detector import find_still
from validation.recordings import load, reference
from validation.section import Section, listed, text

NAME = 'mpu9150_0'


def figures(folder):
    """Return (HandCalibration, bias difference from the published ones in m/s^2)."""
    imu = load(folder, NAME)
    found = calibrate_by_hand(imu, HandOptions(gravity_sd=0.02), find_still(imu))
    return found, found.accelerometer[0] - reference(folder, NAME)['published']['accelerometer_bias']


def run(folder, plots):
    """Return the section."""
    section = Section('Published biases: MPU-9150 (mpu9150_0)')
    found, difference = figures(folder)
    section.claim('mpu9150_0: accelerometer biases against the published ones', 'within 10 mm/s²', f'{listed(1e3 * difference, 1)} mm/s²',
                  np.max(np.abs(difference)) < 0.010)
    statistics = found.statistics
    section.say(text('mpu9150', sds=', '.join(f'{1e3 * sd:.1f}' for sd in found.sd[:3]), poses=statistics['poses'],
                     turns=statistics['turns'], residual=1e3 * statistics['norm_residual_rms']))
    return section
