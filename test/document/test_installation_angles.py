"""
Scale factors and installation angles from the matrix.

With their standard deviations, in the papers' units.
"""

import numpy as np
import pytest
from papers import zhang2017 as zhang

from imu_calibration.calibration.diagnosis.diagnosis_result import ParameterEstimate
from imu_calibration.calibration.diagnosis.findings import sentence
from imu_calibration.calibration.installation_angles import (
    AXIS_PAIRS,
    angles_of,
    derive,
    in_paper_units,
    split,
)
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.units import NOISE_QUANTITY, decimals, for_people, significant, with_sd
from imu_calibration.core.units import STANDARD_GRAVITY as G
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.catalogue import term
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import DETERMINED
from imu_calibration.report.page import people

MODEL = SensorModel()
DEG = np.pi / 180


def calibration_of(matrix, bias=(0.0, 0.0, 0.0), covariance=None):
    """Return a calibration whose accelerometer has this matrix and bias."""
    values = MODEL.start()
    values[MODEL.slices['accelerometer', 'matrix']] = np.ravel(matrix)
    values[MODEL.slices['accelerometer', 'bias']] = bias
    covariance = np.zeros((len(values),) * 2) if covariance is None else covariance
    return Calibration(MODEL, values, covariance, (DETERMINED,) * len(values))


def test_zhangs_table_1_comes_back_from_its_matrix():
    printed = zhang.printed_static_model()
    per_si = 0.4 / G
    found = derive(
        calibration_of(printed.matrix / G / per_si, (printed.bias - 2.4) / per_si), 'accelerometer'
    )
    scale, bias = in_paper_units(found, RawReadings.of_scales(2.4, per_si))
    assert (scale[1], bias[1]) == ('V/g', 'V')
    rows = (0, 2)  # the printed second row is no unit vector, by 48 ppm
    assert scale[2][list(rows)] == pytest.approx(zhang.TABLE_1_SCALE[list(rows)], rel=2e-9)
    assert bias[2] == pytest.approx(zhang.TABLE_1_BIAS, rel=1e-12)
    assert found.angles[rows, :] / DEG == pytest.approx(zhang.TABLE_1_ANGLES_DEG[rows, :], abs=1e-5)
    assert found.angles[1, 1] / DEG == pytest.approx(0.93365, abs=1e-5)
    assert scale[2][1] == pytest.approx(0.398099, abs=1e-6)


def test_small_and_right_angles_are_exact():
    angle = 1e-9
    axes = np.array([[np.cos(angle), np.sin(angle), 0], [0, 1, 0], [0, 0, 1.0]])
    assert angles_of(axes)[0, 0] == pytest.approx(angle, rel=1e-7)
    assert angles_of(axes)[0, 1] == pytest.approx(np.pi / 2 - angle, rel=1e-15)
    scale, unit = split(np.diag([2.0, 3.0, 4.0]) @ axes)
    assert scale == pytest.approx([2, 3, 4]) and unit == pytest.approx(axes)


def test_standard_deviations_are_those_of_random_matrices():
    rng = np.random.default_rng(8)
    matrix = np.eye(3) + rng.normal(0, 0.02, (3, 3))
    root = rng.normal(0, 2e-4, (9, 9))
    covariance = np.zeros((len(MODEL.start()),) * 2)
    part = MODEL.slices['accelerometer', 'matrix']
    covariance[part, part] = root @ root.T
    found = derive(calibration_of(matrix, covariance=covariance), 'accelerometer')
    draws = matrix.ravel() + rng.normal(size=(4000, 9)) @ root.T
    splits = [split(draw.reshape(3, 3)) for draw in draws]
    scales, axes = (np.array(parts) for parts in zip(*splits))
    tolerance = {'rel': 0.06}  # 4000 draws: 1.1 % each, five of it
    assert found.scale_sd == pytest.approx(scales.std(axis=0), **tolerance)
    assert found.angles_sd == pytest.approx(
        np.array([angles_of(a) for a in axes]).std(axis=0), **tolerance
    )
    between = np.array([[np.arccos(a[i] @ a[j]) for i, j in AXIS_PAIRS] for a in axes])
    assert found.between_sd == pytest.approx(between.std(axis=0), **tolerance)


def test_a_perfect_sensor_has_the_bias_it_reads_and_no_surprise_at_zero_angles():
    covariance = 1e-8 * np.eye(len(MODEL.start()))
    found = derive(calibration_of(np.eye(3), (0.1, -0.2, 0.3), covariance), 'accelerometer')

    assert np.diag(found.angles_sd) == pytest.approx([1e-4] * 3)
    scale, bias = in_paper_units(found)
    assert (scale[1], bias[1]) == ('g/g', 'mg')
    assert bias[2] == pytest.approx(np.array([0.1, -0.2, 0.3]) / G * 1e3)


def test_gyroscopes_are_given_in_degrees():
    scale, bias = in_paper_units(
        derive(calibration_of(np.eye(3)), 'gyroscope'),
        RawReadings.of_scales(gyroscope_offset=2.5, gyroscope_scale=0.1 / DEG),
    )
    assert scale[1] == 'V/(deg/s)' and scale[2] == pytest.approx([0.1] * 3)
    assert bias[2] == pytest.approx([2.5] * 3)


def test_numbers_have_the_digits_that_their_sd_supports():
    assert with_sd(1.23456, 0.0123) == ('1.235', '0.012')
    assert with_sd(123.4, 20.0) == ('123', '20')
    assert decimals(0.001) == 4 and decimals(0.00099999999999) == 4
    assert (
        significant(0.0) == '0'
        and significant(1234.5) == '1234'
        and significant(1.5e-7, 2) == '1.5e-07'
    )
    factor, unit = for_people('rad')
    assert (factor * np.pi / 180, unit) == (pytest.approx(60.0), 'arcmin')
    assert for_people('1') == (1.0, '1')
    assert for_people('s') == (1e3, 'ms') and for_people('s', 'reference.clock_step.time') == (
        1.0,
        's',
    )


def test_the_unit_of_a_parameter_depends_on_its_sensor():
    """The change of a gyroscope's scale factor with the force was printed in mg/g^2."""
    factor, unit = for_people('(m/s^2)^-1', 'gyroscope.scale_by_force.x')
    assert (factor, unit) == (pytest.approx(100 * G), '% per g')
    assert for_people('(m/s^2)^-1', 'accelerometer.accel_quadratic.x') == (
        pytest.approx(1e3 * G),
        'mg/g²',
    )
    assert (
        for_people('rad/s', 'gyroscope')[1] == 'deg/s'
        and for_people('rad/s', NOISE_QUANTITY)[1] == 'deg/h'
    )
    force = term(
        'scale_by_force',
        sensor='gyroscope',
        column='w_x * f_x',
        unit='(m/s^2)^-1',
        tolerance=1e-5,
        text='Scale by force.',
    )
    estimate = ParameterEstimate(1e-3, 1e-5, '(m/s^2)^-1')
    for text in (
        sentence(force, {'gyroscope.scale_by_force.x': estimate}, None),
        people(1e-3, 1e-5, '(m/s^2)^-1', quantity='gyroscope.scale_by_force.x')[2],
    ):
        assert '% per g' in text and 'mg' not in text
