"""
Scripts whose searches for effects on a table test only some candidates.

Scripts are run as users run them, without an argument for the candidates of their searches.
`python -m without_search EFFECT+... MODULE [ARGUMENT ...]` runs a module.
"""

import contextlib
import runpy
import sys
from collections.abc import Iterator
from unittest.mock import patch


@contextlib.contextmanager
def candidates_in_scripts(candidates: str) -> Iterator[None]:
    """Test only these effects of the catalogue, and those of users, in each search on a table."""
    from imu_calibration.effects.catalogue import CATALOGUE
    from imu_calibration.selection import investigation

    every = investigation.testable_effects
    chosen = CATALOGUE.with_candidates(candidates).candidates
    left_out = {name for _, name in CATALOGUE.effects()} - set(chosen)

    def some(*arguments):
        effects, not_testable = every(*arguments)
        return [effect for effect in effects if effect.name not in left_out], not_testable

    with patch.object(investigation, 'testable_effects', some):
        yield


if __name__ == '__main__':
    _, names, module, *_ = sys.argv
    del sys.argv[:2]
    with candidates_in_scripts(names):
        runpy.run_module(module, run_name='__main__', alter_sys=True)
