"""An effect is found where a single one of its components is not zero, collinear or not."""

import numpy as np
import pytest

from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.kinematics.table import Table
from imu_calibration.use_cases.diagnose import diagnose

from worlds.physics import make_session

SQUARES = CATALOGUE.find('gyroscope', 'gyro_force_squared')
FEW = 'gyro_force_squared+gyro_g_sensitivity+gyro_quadratic+time_offset'


@pytest.mark.parametrize('components', [(1, 7, 13), (3,)])
def test_a_response_to_one_square_of_the_force_is_found_beside_the_bias(components):
    """
    The sum of the squares is that of gravity at rest, which is a bias.

    Known are differences of the squares; the mean of each three is zero by convention.
    """
    hidden = np.zeros(SQUARES.size)
    hidden[list(components)] = 12.0 * SQUARES.tolerance
    session = make_session(
        52,
        {'gyro_force_squared': hidden.reshape(3, 6)},
        'white',
        profile='quick',
        imu_rate=50.0,
        joint_rate=50.0,
    )
    result = diagnose(session.block, Table.from_mapping(session.table), candidates=FEW).result
    assert [finding.effect for finding in result.diagnosis.findings] == ['gyro_force_squared']

    expected = hidden.copy()
    for group in SQUARES.bias_sums:
        expected[list(group)] -= expected[list(group)].mean()
    known = result.calibration
    part = known.model.slices['gyroscope', 'gyro_force_squared']
    distance = (known.values[part] - expected) / known.sd[part]
    assert np.max(np.abs(distance)) < 4.0
    assert np.all(known.sd[part] < SQUARES.tolerance)
    assert not any(rest.significant for rest in result.diagnosis.unexplained.values())


def test_the_declared_sums_are_those_of_the_squares():
    pairs = [name.partition('_')[2] for name in SQUARES.components]
    assert [[pairs[k] for k in group] for group in SQUARES.bias_sums] == [['xx', 'yy', 'zz']] * 3
