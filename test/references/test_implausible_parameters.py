"""Values that only misfit gives are held and named."""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table

from worlds.misfit_coverage import calibrated, clean
from worlds.misfit_worlds import SHAFT, make_pair
from worlds.perfect_readings import read, solved
from worlds.physics import TABLES

UPRIGHT = {**SHAFT, 'joints': [{'name': 'shaft', 'axis': [0, 0, 1]}], 'up': [0, 0, 1]}


@pytest.fixture(scope='module')
def upright():
    """
    Windows on a vertical shaft, where gravity never acts along x and y.

    Readings of a perfect sensor.
    """
    found = calibrated(make_pair(None, 41, table=UPRIGHT, profile='sweeps').first)
    return found.windows, Table.from_mapping(UPRIGHT)


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
