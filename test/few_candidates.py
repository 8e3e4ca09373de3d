"""
The search for effects on a table, restricted to a few candidates: a third of the time.

`python -m few_candidates NAME,NAME,... MODULE [ARGUMENT ...]` runs a module with the restriction.
"""

import contextlib
import runpy
import sys
from collections.abc import Iterator, Sequence
from unittest.mock import patch

FEW = (
    'accel_quadratic',
    'accel_cubic',
    'accel_bias_drift',
    'gyro_g_sensitivity',
    'gyro_bandwidth',
    'gyro_bias_drift',
    'time_offset',
)
"""Effects that remain candidates."""


@contextlib.contextmanager
def restricted(names: Sequence[str] = FEW) -> Iterator[None]:
    """Leave out the effects of the catalogue that are not in `names`; effects of users remain."""
    from imu_calibration.effects.catalogue import CATALOGUE
    from imu_calibration.selection import investigation

    every = investigation.testable_effects
    left_out = {name for _, name in CATALOGUE.effects()} - set(names)

    def few(*arguments):
        effects, not_testable = every(*arguments)
        return [effect for effect in effects if effect.name not in left_out], not_testable

    with patch.object(investigation, 'testable_effects', few):
        yield


if __name__ == '__main__':
    _, candidates, module, *_ = sys.argv
    del sys.argv[:2]
    with restricted(candidates.split(',')):
        runpy.run_module(module, run_name='__main__', alter_sys=True)
