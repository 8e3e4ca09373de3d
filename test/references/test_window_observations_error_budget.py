"""
The error budget.

What it predicts is what happens when the same recording is calibrated against a wrong reference.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.samples import SampleBlock
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.chain import tilt
from imu_calibration.references.turntable.collector import GatherStep
from imu_calibration.references.turntable.error_budget_of_windows import (
    JOINT_POSITION_SD,
    _faster,
    _heavier,
    _sources,
    _tilted,
    _turned,
    error_budget,
    parameter_shifts,
)
from imu_calibration.references.turntable.estimation.solver import solve
from imu_calibration.references.turntable.session_data import merge
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.sensor_noise import GRADES
from imu_calibration.simulation.session import SimulationOptions, random_values, simulate_session

from worlds.calibrated import calibrated_on_table
from worlds.tables import three_axis_table

TABLE = three_axis_table(gravity=9.81)
NO_TILT = CalibrationOptions(
    accelerometer_model='bias+matrix+accel_size_effect', reference_model='none'
)
SIZES = np.array([1e-3] * 3 + [1e-4] * 9 + [1e-4] * 9)


@pytest.fixture(scope='module')
def recording():
    """A short session of an IMU with a size effect."""
    model = SensorModel(accelerometer=('bias', 'matrix', 'accel_size_effect'))
    values = random_values(model, 'industrial', 4)
    imu, joints, _ = simulate_session(
        model,
        values,
        TABLE,
        profile=make_profile('quick', 4, TABLE),
        options=SimulationOptions(50.0, 50.0, noise=GRADES['industrial'].noise),
        seed=4,
    )
    return SampleBlock(imu, joints)


def calibrated(recording, table, options=NO_TILT):
    """Calibrate against a table, without a search for effects."""
    options = replace(options, as_asked=True)
    return calibrated_on_table([[recording]], table, options)


@pytest.fixture(scope='module')
def result(recording):
    """The calibration against the true table."""
    return calibrated(recording, replace(TABLE, mount_xyz=(0.0, 0.0, 0.0)))


def shifts_by(result, *changes):
    """Return the shifts of the parameters by each change of the reference, in each window."""
    data = result.data
    return parameter_shifts(data.table, data.gathered, result.solution, changes=changes)


def moved(recording, result, false_table):
    """Return how the estimate moves when the reference is wrong, at the same weights."""
    gathered = GatherStep(false_table, result.model).gather([recording], 0)
    return (
        solve(gathered.accumulator, result.model, noise=result.solution.noise).values
        - result.solution.values
    )


@pytest.mark.parametrize('axis', (0, 1))
def test_a_table_that_is_not_level_moves_the_parameters_as_predicted(recording, result, axis):
    angle = 1e-3 * np.eye(2)[axis]
    shift = shifts_by(result, partial(_tilted, angle))[0].sum(axis=0)
    actual = -moved(recording, result, tilt(result.data.table, angle))
    assert np.linalg.norm(shift[:12]) > 1e-4
    for effect in result.solution.model.effects[:3]:
        part = result.solution.model.slices[effect.sensor, effect.name]
        assert actual[part] == pytest.approx(
            shift[part], abs=0.02 * np.max(np.abs(shift[part])) + 1e-9
        )


def test_a_wrong_gravity_scales_the_accelerometer_matrix(recording, result):
    shift = shifts_by(result, partial(_heavier, 0.01))[0].sum(axis=0)
    assert shift[3:12] == pytest.approx(result.solution.values[3:12] * 0.01 / 9.81, abs=3e-7)
    actual = -moved(recording, result, replace(result.data.table, gravity=9.82))
    assert actual[:21] == pytest.approx(shift[:21], abs=5e-6)


def test_a_fast_table_clock_scales_the_gyroscope_matrix_and_the_arms(result):
    shift = shifts_by(result, partial(_faster, 1 + 1e-3))[0].sum(axis=0)
    names = result.solution.param_names
    arms, matrix = (
        result.solution.model.slices[key]
        for key in (('accelerometer', 'accel_size_effect'), ('gyroscope', 'matrix'))
    )
    assert names[matrix.start] == 'gyroscope.matrix.xx'
    assert shift[matrix] == pytest.approx(1e-3 * result.solution.values[matrix], abs=2e-6)
    assert shift[arms] == pytest.approx(2e-3 * result.solution.values[arms], abs=2e-5)


def test_joint_errors_are_drawn_anew_in_every_window(result):
    """The sd of the budget is that of random joint errors put through the same shifts."""
    budget = result.error_budget()
    changes = [partial(_turned, angles) for angles in JOINT_POSITION_SD * np.eye(3)]
    shifts = shifts_by(result, *changes)
    rng = np.random.default_rng(5)
    draws = np.einsum('dkw,kwp->dp', rng.normal(size=(4000, *shifts.shape[:2])), shifts)
    own = budget.causes['joint position']
    large = own > 1e-12
    # 4000 draws: 1.1 % each, five of it.
    assert draws.std(axis=0)[large] == pytest.approx(own[large], rel=0.06)


def test_levelling_counts_only_where_tilt_is_not_estimated(recording, result):
    without = result.error_budget()
    assert list(without.causes) == ['noise', 'levelling', 'joint position', 'table rate', 'gravity']
    matrix = result.solution.model.slices['accelerometer', 'matrix']
    assert np.max(without.causes['levelling'][matrix]) > 10 * np.max(
        without.causes['noise'][matrix]
    )
    with_tilt = calibrated(recording, TABLE, CalibrationOptions()).error_budget()
    assert 'levelling' not in with_tilt.causes


def test_the_total_is_the_root_of_the_sum_of_squares_and_sizes_scale_it(result, monkeypatch):
    small = result.error_budget()
    monkeypatch.setattr(
        'imu_calibration.references.turntable.error_budget_of_windows.JOINT_POSITION_SD',
        10 * JOINT_POSITION_SD,
    )
    large = result.error_budget()
    assert small.total**2 == pytest.approx(
        sum(part**2 for part in small.causes.values()), rel=1e-12
    )
    assert large.causes['joint position'] == pytest.approx(
        10 * small.causes['joint position'], rel=1e-3, abs=1e-12
    )


def test_gravity_sd_of_the_table_description_is_used(result):
    stated = replace(result.data.table, gravity_sd=1e-3)
    budget = error_budget(stated, result.data.gathered, result.solution)
    assert '0.001' in budget.texts['gravity']


def test_normal_gravity_of_a_latitude_has_the_accuracy_of_its_formula(recording, result):
    """The sd of every scale factor contains 1e-4 of its value; the budget has the same share."""
    place = replace(result.data.table, gravity=None)
    scales = [
        result.solution.param_names.index(f'accelerometer.matrix.{axis}')
        for axis in ('xx', 'yy', 'zz')
    ]
    stated, exact = (
        np.diag(calibrated(recording, table).calibration.covariance)[scales]
        for table in (place, replace(place, gravity_sd=0.0))
    )
    assert stated - exact == pytest.approx(1e-8 * result.solution.values[scales] ** 2, rel=1e-3)
    at_place = error_budget(place, result.data.gathered, result.solution)
    assert at_place.causes['gravity'][scales] == pytest.approx(1e-4, rel=0.02)


def test_windows_of_a_second_recording_share_no_bias_with_the_first(recording, result):
    step = GatherStep(TABLE, result.model)
    gathered = merge([step.gather([recording], session) for session in (0, 1)])
    sessions = {'static': [], 'moving': []}
    for source in _sources(gathered):
        sessions['static' if source.kind == 'static' else 'moving'].append(source.session)
    for of_kind in sessions.values():
        n = len(of_kind) // 2
        assert n > 0 and of_kind == [0] * n + [1] * n
