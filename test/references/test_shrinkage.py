"""Values of effects that nobody requested shrink."""

import numpy as np

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.shrinkage import shrunk

from worlds.misfit_coverage import clean
from worlds.perfect_readings import read, solved
from worlds.physics import TABLES


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
