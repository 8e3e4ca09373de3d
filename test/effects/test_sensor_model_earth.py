"""When the rate of the Earth is a parameter of the table."""

from imu_calibration.effects.sensor_model import parse_reference
from imu_calibration.kinematics.table import Table

from worlds.physics import TABLES


def test_the_rate_of_the_earth_is_known_or_estimated():
    """The Earth turns below every table: without latitude or azimuth, in an unknown direction."""
    known = {'latitude': 50.0, 'height': 0.0, 'azimuth_deg': 20.0, 'gravity': 9.81}
    assert 'earth_rate' not in parse_reference(None, three_axis(**known))
    assert 'earth_rate' in parse_reference(None, three_axis(**{**known, 'azimuth_deg': None}))
    assert 'earth_rate' in parse_reference(None, three_axis(**{**known, 'latitude': None}))


def three_axis(**site):
    return Table.from_mapping(TABLES['three_axis'] | site)
