"""Constants that are texts print their value, on Python 3.10 too."""

import json

from imu_calibration.core.text_enum import StrEnum


class Side(StrEnum):
    """One side."""

    LEFT = 'left'


def test_a_constant_is_its_text():
    assert (str(Side.LEFT), f'{Side.LEFT:>5}', '%s' % Side.LEFT) == ('left', ' left', 'left')
    assert Side.LEFT == 'left' and Side('left') is Side.LEFT
    assert json.dumps({Side.LEFT: Side.LEFT}) == '{"left": "left"}'
