"""The slope of the temperature, and effects in proportion to it."""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.calibration.diagnosis.diagnose import diagnose_recording
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import InputError
from imu_calibration.document.trust import MEAN
from imu_calibration.effects.catalogue import CATALOGUE, term
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.signal_history import TemperatureSlope
from imu_calibration.kinematics.table import Table
from imu_calibration.references.gravity.hand_parameters import HandModel
from imu_calibration.references.turntable.residuals.formulas import grammar
from imu_calibration.references.turntable.table_reference import TableReference

from worlds.calibrated import calibrated_on_table
from worlds.candidates import FEW
from worlds.physics import make_session

FOLLOWS = term(
    'bias_while_warming',
    sensor='gyroscope',
    column='temperature_rate',
    unit='(rad/s)/(K/s)',
    tolerance=1e-3,
    text='Heat that flows through the package bends the gyroscope.',
)
SIZE = np.array([0.02, -0.03, 0.05])


def warming(seconds):
    """Return (temperature, its slope): 4 K up, constant, and 4 K down."""
    slope = np.where(seconds < 80.0, 0.05, np.where(seconds < 120.0, 0.0, -0.05))
    rise = 0.05 * np.minimum(seconds, 80.0)
    return 25.0 + rise - 0.05 * np.maximum(seconds - 120.0, 0.0), slope


def test_a_steady_change_has_its_slope_and_parts_give_the_same():
    stamp_ns = np.arange(200) * 10**9
    warm = 20.0 + 0.03 * np.arange(200)
    slope = TemperatureSlope().of(stamp_ns, warm)
    assert slope[0] == 0.0
    np.testing.assert_allclose(slope[1:], 0.03, rtol=1e-9)
    parts = TemperatureSlope()
    joined = [parts.of(stamp_ns[:70], warm[:70]), parts.of(stamp_ns[70:], warm[70:])]
    np.testing.assert_array_equal(np.concatenate(joined), slope)


@pytest.fixture(scope='module')
def session_that_warms():
    """Return (samples, table) of a gyroscope whose biases are SIZE times the slope."""
    session = make_session(
        8250,
        None,
        'white',
        profile='random_short',
        duration=180.0,
        imu_rate=50.0,
        joint_rate=50.0,
        temperature='cycle',
    )
    first = session.imu.stamp_ns[0]
    at_readings = 1e-9 * (session.temperature.stamp_ns - first)
    bias = np.outer(warming(1e-9 * (session.imu.stamp_ns - first))[1], SIZE)
    imu = replace(session.imu, rate_s=session.imu.rate_s + bias)
    temperature = replace(session.temperature, temperature_c=warming(at_readings)[0])
    block = replace(session.block, imu=imu, temperature=temperature)
    return block, Table.from_mapping(session.table)


def test_a_bias_in_proportion_to_the_slope_of_the_temperature_is_estimated(session_that_warms):
    block, table = session_that_warms
    options = CalibrationOptions(
        accelerometer_model='bias+matrix',
        gyroscope_model='bias+matrix+bias_while_warming',
        catalogue=CATALOGUE.with_effects(FOLLOWS).with_candidates(FEW),
    )
    result = calibrated_on_table([[block]], table, options)
    value = result.calibration.value('gyroscope', 'bias_while_warming')
    np.testing.assert_allclose(value, SIZE, rtol=0.2)
    # Compensation replaces it by its mean: the slope of another session is another one.
    (entry,) = result.calibration.statistics['uncorrected']
    assert entry['effect'] == 'bias_while_warming' and entry['applied'] == MEAN

    without = replace(block, temperature=None)
    with pytest.raises(InputError) as refused:
        calibrated_on_table([[without]], table, options)
    assert refused.value.key == 'temperature_topic' and refused.value.code == 'temperature_missing'


def test_by_hand_it_is_refused_with_a_key():
    model = SensorModel(
        gyroscope=('bias', 'matrix', 'bias_while_warming'),
        catalogue=CATALOGUE.with_effects(FOLLOWS),
    )
    with pytest.raises(InputError) as refused:
        HandModel(model, 9.81)
    assert refused.value.key == 'table' and refused.value.code == 'table_needed'


def test_formulas_with_a_temperature_contain_its_slope():
    columns = [formula.columns for formula in grammar(1, True, 100.0)]
    assert ('temperature_rate',) in columns
    assert ('temperature_rate',) not in [f.columns for f in grammar(1, False, 100.0)]
    (slope,) = [f for f in grammar(1, True, 100.0) if f.columns == ('temperature_rate',)]
    assert slope.unit('rad/s') == 'rad/s/(K/s)' and slope.smooth


@pytest.mark.long
def test_the_diagnosis_names_the_slope_of_the_temperature(session_that_warms):
    # A wander of all axes alike followed it, and nothing was found.
    block, table = session_that_warms
    catalogue = CATALOGUE.with_candidates('gyro_thermal_bias+gyro_bias_drift+gyro_bias_trend')
    options = CalibrationOptions(catalogue=catalogue)
    diagnosis = diagnose_recording([block], TableReference(table), options).diagnosis
    assert not diagnosis.findings
    rest = diagnosis.unexplained['gyroscope']
    assert rest.significant and rest.correlates_with == 'temperature rate' and rest.share > 0.5
    assert not diagnosis.unexplained['accelerometer'].significant
