"""An effect is found where a single one of its components is not zero, collinear or not."""

import numpy as np
import pytest

from imu_calibration.api.diagnose import diagnose
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.kinematics.table import Table

from worlds.hide_and_seek_worlds import by_convention
from worlds.physics import make_session

SQUARES = CATALOGUE.find('gyroscope', 'gyro_force_squared')
COMPLIANCE = CATALOGUE.find('reference', 'load_compliance')
FEW = 'gyro_force_squared+gyro_g_sensitivity+gyro_quadratic+load_compliance+time_offset'


@pytest.mark.parametrize(
    ('effect', 'components', 'size'),
    [
        # The sum of the squares is that of gravity at rest, which is a bias.
        (SQUARES, (1, 7, 13), 12.0),
        (SQUARES, (3,), 12.0),
        # A mount that turns about the force that it carries changes nothing.
        (COMPLIANCE, (0,), 4.0),
    ],
)
def test_a_single_component_is_found_where_a_sum_is_not_determined(effect, components, size):
    """Known are differences of the components; the mean of each three is zero by convention."""
    hidden = np.zeros(effect.size)
    hidden[list(components)] = size * effect.tolerance
    session = make_session(
        52,
        {effect.name: hidden.reshape(effect.shape)},
        'white',
        profile='quick',
        imu_rate=50.0,
        joint_rate=50.0,
    )
    result = diagnose(session.block, Table.from_mapping(session.table), candidates=FEW).result
    assert [finding.effect for finding in result.diagnosis.findings] == [effect.name]

    expected = by_convention(effect.name, hidden)
    known = result.calibration
    part = known.model.slices[effect.key]
    distance = (known.values[part] - expected) / known.sd[part]
    assert np.max(np.abs(distance)) < 4.0
    assert np.all(known.sd[part] < effect.tolerance)
    assert not any(rest.significant for rest in result.diagnosis.unexplained.values())


def test_the_declared_sums_are_those_of_the_squares():
    pairs = [name.partition('_')[2] for name in SQUARES.components]
    assert [[pairs[k] for k in group] for group in SQUARES.zero_sums] == [['xx', 'yy', 'zz']] * 3
