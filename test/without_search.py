"""
Scripts whose searches for effects test only some candidates, without reports.

Of their recordings the noise of one axis is identified.

Scripts are run as users run them, without an argument for the candidates of their searches.
`python -m without_search 'EFFECT+... MODULE [ARGUMENT ...]' ...` runs modules one after the other,
in one process that has imported the package once.
"""

import contextlib
import runpy
import shlex
import sys
from collections.abc import Iterator
from unittest.mock import patch


@contextlib.contextmanager
def candidates_in_scripts(candidates: str) -> Iterator[None]:
    """Test only these effects of the catalogue, and those of users, in each search."""
    from imu_calibration.effects.catalogue import CATALOGUE
    from imu_calibration.references.gravity import model_selection
    from imu_calibration.references.turntable.selection import testable_effects

    every = testable_effects.sort_effects
    chosen = CATALOGUE.with_candidates(candidates).candidates
    left_out = {name for _, name in CATALOGUE.effects()} - set(chosen)

    def some(*arguments, **options):
        effects, not_testable = every(*arguments, **options)
        return [effect for effect in effects if effect.name not in left_out], not_testable

    with contextlib.ExitStack() as stack:
        for search in (model_selection, testable_effects):
            stack.enter_context(patch.object(search, 'sort_effects', some))
        yield


if __name__ == '__main__':
    from worlds.no_reports import without_reports
    from worlds.noise_worlds import identifying

    for line in sys.argv[1:]:
        names, *sys.argv = shlex.split(line)
        print(f'== {line}', flush=True)
        with candidates_in_scripts(names), without_reports(), identifying(0):
            try:
                runpy.run_module(sys.argv[0], run_name='__main__', alter_sys=True)
            except SystemExit as end:
                if end.code:
                    raise
