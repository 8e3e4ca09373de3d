"""Effects of the sensor model in a recording whose clock also needs an effect."""

import numpy as np
import pytest

import imu_calibration as imu
from imu_calibration.kinematics.table import Table

from worlds.physics import make_session

FEW = 'accel_size_effect+time_offset+encoder_zero'
"""Candidates of the search."""
DELAY = 0.014
"""s."""
ZERO = np.radians(0.31)
"""Of the encoder of the middle joint."""


@pytest.mark.long
def test_a_delay_and_a_zero_do_not_cost_the_effects_that_are_in_the_model():
    """
    The standard deviations without the delay contain its misfit.

    By these no arm of a sensor is significant; with the delay in the model it is.
    """
    hidden = {'time_offset': np.array([DELAY]), 'encoder_zero': np.array([ZERO])}
    session = make_session(6, hidden, arms=True, profile='quick', imu_rate=50.0, joint_rate=50.0)
    found = imu.calibrate(
        session.block, Table.from_mapping(session.table), candidates=FEW
    ).calibration
    assert set(found.statistics['added']) == set(hidden)
    for name, value in (('time_offset.offset', DELAY), ('encoder_zero.middle', ZERO)):
        place = found.param_names.index(f'reference.{name}')
        assert abs(found.values[place] - value) < 4 * found.sd[place]
        assert found.sd[place] < 0.01 * value
    assert not {'denied', 'unexplained', 'implausible'} & set(found.statistics)
    bias = [found.param_names.index(f'accelerometer.bias.{axis}') for axis in 'xyz']
    off = found.values[bias] - session.truth['accelerometer'].bias
    # 0.05 mg; it was 0.5 to 1.2 mg.
    assert found.sd[bias].max() < 5e-4
    assert np.all(np.abs(off) < 4 * found.sd[bias])
