"""
Values that only misfit gives are held and named; values of effects that nobody asked for shrink.
"""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.effects.forward_equations import predict
from imu_calibration.effects.sensor_model import SensorModel, parse_reference
from imu_calibration.estimation.solution import shrunk
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.accumulator import Accumulator
from imu_calibration.references.turntable.estimation.solver import solve
from imu_calibration.references.turntable.window_statistics import reduce_windows

from worlds.misfit_coverage import calibrated, clean
from worlds.misfit_worlds import SHAFT, make_pair
from worlds.physics import TABLES

UPRIGHT = {**SHAFT, 'joints': [{'name': 'shaft', 'axis': [0, 0, 1]}], 'up': [0, 0, 1]}


def solved(windows, model, table):
    """Return the Solution."""
    accumulator = Accumulator()
    for row in reduce_windows(windows, model, table):
        accumulator.add(row)
    return solve(accumulator, model)


@pytest.fixture(scope='module')
def upright():
    """
    Windows on a vertical shaft, where gravity never acts along x and y.

    Readings of a perfect sensor.
    """
    found = calibrated(make_pair(None, 41, table=UPRIGHT, profile='sweeps').first)
    return found.windows, Table.from_mapping(UPRIGHT)


def read(windows, table, model, values, *, ripple=0.0, seed=1):
    """
    Return the windows with the readings of a sensor of these parameters.

    They have noise, and a force on x in turns, as no effect has it.
    """
    rng, made = np.random.default_rng(seed), []
    for window in windows:
        force, rate = predict(model, values, table, motion=window.motion)
        moves, turns = (
            np.broadcast_to(part[:, 0], len(window.time))
            for part in (window.motion.position, window.motion.rate)
        )
        force = force + ripple * np.outer(
            (np.abs(turns) > 1.0) * (1.0 + np.sin(7 * moves)), [1.0, 0.0, 0.0]
        )
        made.append(
            replace(
                window,
                force_s=force + rng.normal(0, 0.02, (len(window.time), 3)),
                rate_s=rate + rng.normal(0, 2e-3, (len(window.time), 3)),
            )
        )
    return made


def test_a_scale_that_only_misfit_gives_is_held_and_named(upright):
    """
    Gravity never acts along x.

    Where the sensor sits, 10 mm off the axis, brings some mm/s^2 there in step with the motion, and
    so does misfit.
    """
    windows, table = upright
    table = replace(table, mount_xyz=np.array([0.01, 0.0, 0.0]))
    model = SensorModel(accelerometer=('bias', 'matrix'), joint_names=tuple(table.joint_names))
    found = solved(read(windows, table, model, model.start(), ripple=0.5), model, table)
    names = [name for name in found.not_believed if name.startswith('accelerometer.matrix')]
    assert names and all(found.held[model.param_names.index(name)] for name in names)
    assert all(
        found.values[model.param_names.index(name)] == float(name[-1] == name[-2]) for name in names
    )


def test_a_wrong_full_scale_setting_is_no_misfit():
    """A gyroscope that reads twice the rate keeps its factor: it fits."""
    table, found = Table.from_mapping(TABLES['three_axis']), clean(11)
    model = SensorModel(accelerometer=('bias', 'matrix'), joint_names=tuple(table.joint_names))
    doubled = solved(
        [replace(window, rate_s=2 * window.rate_s) for window in found.windows], model, table
    )
    assert not doubled.not_believed
    np.testing.assert_allclose(
        np.diag(doubled.values[model.slices['gyroscope', 'matrix']].reshape(3, 3)), 2.0, atol=0.05
    )


def test_the_rate_of_the_earth_is_known_or_estimated():
    """The Earth turns below every table: without latitude or azimuth, in an unknown direction."""
    known = {'latitude': 50.0, 'height': 0.0, 'azimuth_deg': 20.0, 'gravity': 9.81}
    assert 'earth_rate' not in parse_reference(None, three_axis(**known))
    assert 'earth_rate' in parse_reference(None, three_axis(**{**known, 'azimuth_deg': None}))
    assert 'earth_rate' in parse_reference(None, three_axis(**{**known, 'latitude': None}))


def three_axis(**site):
    return Table.from_mapping(TABLES['three_axis'] | site)


def test_what_nobody_asked_for_shrinks_and_what_is_plain_stays():
    """
    Arms that are not there move most of the way to zero, and plain ones remain.

    The standard deviations are as they were.
    """
    windows, table = clean(11).windows, Table.from_mapping(TABLES['three_axis'])
    model = SensorModel(
        accelerometer=('bias', 'matrix', 'accel_size_effect'), joint_names=tuple(table.joint_names)
    )
    part = model.slices['accelerometer', 'accel_size_effect']
    moved = []
    for size in (0.0, 0.02):
        values = model.start()
        values[part] = size * np.linspace(-1, 1, 9)
        before = solved(read(windows, table, model, values), model, table)
        after = shrunk(before, [part])
        np.testing.assert_array_equal(after.covariance, before.covariance)
        moved.append(np.linalg.norm(after.values[part]) / np.linalg.norm(before.values[part]))
        assert np.abs((after.values - values) / after.sd).max() < 4.5
    assert moved[0] < 0.7 and moved[1] > 0.99


def test_options_know_what_is_there_unasked():
    """A size effect that was asked for does not shrink."""
    from imu_calibration.references.turntable.table_calibration import _by_default

    model = SensorModel(
        accelerometer=('bias', 'matrix', 'accel_size_effect'),
        reference=('table_tilt', 'time_offset'),
    )
    asked = CalibrationOptions(
        accelerometer_model='size_effect', reference_model='table_tilt+time_offset'
    )
    assert _by_default(model, asked) == []
    size_effect = model.slices['accelerometer', 'accel_size_effect']
    tilt = model.slices['reference', 'table_tilt']
    assert tilt in _by_default(model, CalibrationOptions())
    # Beside an error of table or clock that was added, levelling is estimated as in a request.
    added = CalibrationOptions(added=(('reference', 'time_offset'),))
    assert _by_default(model, added) == [size_effect]
