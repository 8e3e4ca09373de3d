"""Raw counts of an Xsens MTi against its factory calibration."""

import numpy as np

from imu_calibration.preprocessing.rest_detection import find_still
from imu_calibration.references.gravity.hand_calibration import calibrate_by_hand
from imu_calibration.references.gravity.hand_parameters import HandOptions
from validation.recordings import gravity_of, load, nominal_of, reference
from validation.section import Section, listed, text

NAME = 'xsens_counts'


def in_counts(found, nominal, sensor):
    """
    Return (offsets, scale factors) of one sensor in counts and counts per SI unit.

    Lengths of matrix rows need no choice of axes.
    """
    bias, matrix = found.accelerometer if sensor == 'accelerometer' else found.gyroscope[:2]
    unit = getattr(nominal, sensor)
    offset, scale = unit.offset, unit.scale
    return offset + scale * bias, scale * np.linalg.norm(matrix, axis=1)


def figures(folder):
    """
    Return (HandCalibration, {sensor: (offset difference in counts, relative scale difference)}).
    """
    nominal, factory = nominal_of(folder, NAME), reference(folder, NAME)['factory']
    imu = load(folder, NAME)
    found = calibrate_by_hand(imu, HandOptions(gravity_of(folder, NAME)), find_still(imu))
    differences = {}
    for sensor in ('accelerometer', 'gyroscope'):
        offset, scale = in_counts(found, nominal, sensor)
        differences[sensor] = (
            offset - factory[f'{sensor}_offset'],
            scale / factory[f'{sensor}_scale'] - 1,
        )
    return found, differences


def run(folder, plots):
    """Return the section."""
    section = Section('Raw counts: Xsens MTi (xsens_counts)')
    found, differences = figures(folder)
    offset, scale = differences['accelerometer']
    rate_offset, rate_scale = differences['gyroscope']
    section.claim(
        'xsens_counts: accelerometer offsets against the factory',
        'within 10 counts',
        f'{listed(offset, 1)} counts',
        np.max(np.abs(offset)) < 10,
    )
    section.claim(
        'xsens_counts: accelerometer scale factors against the factory',
        'within 0.3 %',
        f'{listed(100 * scale, 2)} %',
        np.max(np.abs(scale)) < 0.003,
    )
    section.claim(
        'gyroscope scale factors against the factory',
        'within 0.3 %',
        f'{listed(100 * rate_scale, 2)} %',
        np.max(np.abs(rate_scale)) < 0.003,
    )
    section.claim(
        'gyroscope offsets against the factory',
        'another turn-on',
        f'{listed(rate_offset, 1)} counts',
    )
    statistics = found.statistics
    section.claim(
        'chi-square per degree of freedom of the gravity norm, white noise',
        'about 13 by batch means',
        f'{statistics["norm_chi2_per_dof"]:.1f}',
    )
    section.say(
        text(
            'xsens',
            gravity=gravity_of(folder, NAME),
            scatter=1e3 * statistics['pose_scatter_sd'],
            **{key: statistics[key] for key in ('poses', 'attitudes', 'turns')},
        )
    )
    return section
