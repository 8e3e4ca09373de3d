"""Values of settings: the type and the bounds of each declaration, for all groups alike."""

import math
from dataclasses import dataclass

import pytest
from refusal import refused

from imu_calibration.core.errors import InputError
from imu_calibration.core.settings import override, setting


@dataclass(frozen=True)
class Group:
    """One setting of each type."""

    length: float = setting(1.0, 'm', 'length', (0.5, None))
    count: int = setting(3, '', 'count', (0, 9))
    enabled: bool = setting(False, '', 'enabled')
    method: str = setting('auto', '', 'method', choices=('auto', 'none'))


def test_values_within_the_declaration_are_set():
    values = override(Group(), {'length': 2, 'count': 9, 'enabled': True, 'method': 'none'})
    assert values == Group(2.0, 9, True, 'none') and isinstance(values.length, float)


@pytest.mark.parametrize(
    ('name', 'value', 'code'),
    [
        ('length', math.nan, 'part_type'),
        ('length', math.inf, 'part_type'),
        ('length', True, 'part_type'),
        ('length', '2', 'part_type'),
        ('length', 0.4, 'part_range'),
        ('count', 2.0, 'part_type'),
        ('count', 10, 'part_type'),
        ('enabled', 1, 'part_type'),
        ('method', 1, 'choice_unknown'),
        ('method', 'nothing', 'choice_unknown'),
        ('lenght', 2.0, 'key_unknown'),
    ],
)
def test_other_values_are_refused(name, value, code):
    """NaN passed every comparison with the bounds; without an upper one infinity did too."""
    with refused(InputError, code, name):
        override(Group(), {name: value})
