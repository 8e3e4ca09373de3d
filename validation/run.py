"""
Run every section on the recordings and write docs/validation.md with its plots.

Exit code 1 if a section failed.
"""

import argparse
import contextlib
import importlib
import platform
import sys
import time
import traceback
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any
from unittest.mock import patch

ROOT = Path(__file__).resolve().parents[1]
if __name__ == '__main__':
    sys.path[:0] = [str(ROOT), str(ROOT / 'test')]  # simulated worlds are those of the tests

from imu_calibration import __version__  # noqa: E402
from imu_calibration.core.errors import ImuCalibrationError  # noqa: E402
from tools.smallest import add_smallest  # noqa: E402
from validation.recordings import VARIABLE, data_folder  # noqa: E402
from validation.section import Section, claims_table, text  # noqa: E402

SECTIONS = (
    'cross',
    'decisions',
    'misfit',
    'scatter',
    'shaft',
    'boards',
    'arm_live',
    'xsens',
    'mpu9150',
    'ferraris',
    'simulated_table',
    'peers',
    'held_out',
    'noise',
    'inspecting',
    'diagnosing',
)
MPU9150 = slice(1, 2)
"""The shortest of the recordings by hand."""
SMALLEST: dict[str, Any] = {
    'arm_live.STRETCH_S': 40.0,
    'boards.BOARD': 2,
    'cross.ONE_UNIT': 0,
    'cross.RECORDINGS': slice(1, 2),
    'decisions.BY_HAND': MPU9150,
    'decisions.KINDS': 1,
    'decisions.SEEDS': 1,
    'diagnosing.ALL': slice(-1, None),
    'held_out.BY_HAND': MPU9150,
    'held_out.LEFT_OUT': 2,
    'held_out.SPLITS': 2,
    'inspecting.ALL': slice(-1, None),
    'inspecting.SEVERAL': 'ferraris',
    'misfit.WORLDS': slice(1, 2),
    'mpu9150.LEFT_OUT': 2,
    'mpu9150.TURNS': 1,
    'noise.RESTING': slice(2, 3),
    'peers.MOST_KINDS': 1,
    'peers.ON_A_TABLE': 1,
    'peers.SEEDS': 1,
    'peers.TRIAL_SEEDS': 1,
    'scatter.BY_HAND': 1,
    'scatter.SESSIONS': 2,
    'shaft.LONGEST': 60.0,
    'shaft.SHAFT': 1,
}
"""
Constant of a section -> what remains with `--smallest`: the first entries, a slice of them, the
number of sessions or seconds, or another recording.
"""
PACKAGES = ('numpy', 'scipy', 'rosbags', 'imucal', 'python-ins')


def versions():
    """Return [(name, version)] of the package, the system and the libraries."""
    found = [
        ('imu_calibration', __version__),
        ('Python', platform.python_version()),
        ('system', f'{platform.system()} {platform.machine()}'),
    ]
    for name in PACKAGES:
        try:
            found.append((name, version(name)))
        except PackageNotFoundError:
            found.append((name, 'not installed'))
    return found


@contextlib.contextmanager
def reduced_to_smallest():
    """Keep only the first entries of the recordings, kinds and seeds in `SMALLEST`."""
    with contextlib.ExitStack() as stack:
        for place, size in SMALLEST.items():
            module_name, constant = place.split('.')
            module = importlib.import_module(f'validation.{module_name}')
            entries = getattr(module, constant)
            if entries is None or isinstance(entries, (int, float, str, slice)):
                reduced = size
            elif isinstance(size, slice):
                reduced = entries[size]
            elif isinstance(entries, dict):
                reduced = dict(list(entries.items())[:size])
            else:
                reduced = entries[:size]
            stack.enter_context(patch.object(module, constant, reduced))
        yield


def run_section(name, folder, plots):
    """Return (Section, whether it is complete)."""
    start = time.monotonic()
    print(f'{name} ...', end=' ', flush=True)
    try:
        section, whole = importlib.import_module(f'validation.{name}').run(folder, plots), True
    except ImuCalibrationError as error:
        section, whole = Section(name), False
        section.say(f'Refused: {error}')
    except Exception as error:  # one section must not cost the others
        traceback.print_exc()
        section, whole = Section(name), False
        section.say(f'Could not be run: {type(error).__name__}: {error}')
    print(f'{time.monotonic() - start:.0f} s', flush=True)
    for row in section.rows:
        print(
            f'    {row.claim}: {row.found} (wanted'
            f' {row.target}){"" if row.holds in (None, True) else "  NO"}'
        )
    return section, whole


def document(sections):
    """Return the text of docs/validation.md."""
    head = text(
        'introduction',
        date=date.today().isoformat(),
        versions='\n'.join(f'| {name} | {found} |' for name, found in versions()),
    )
    rows = [row for section in sections for row in section.rows if row.holds is not None]
    missed = [row for row in rows if not row.holds]
    count = f'{len(rows) - len(missed)} of {len(rows)} claims hold.'
    parts = [head, '## In short', count + (' Those that do not:' if missed else '')]
    if missed:
        parts.append(claims_table(missed))
    return '\n\n'.join(parts + [section.markdown() for section in sections]) + '\n'


def claims(sections):
    """Return docs/claims.md: the headlines of this run."""
    rows = [row for section in sections for row in section.rows]
    judged = [row for row in rows if row.holds is not None]
    table = claims_table([row for row in rows if row.headline])
    return (
        text(
            'claims',
            date=date.today().isoformat(),
            holding=sum(row.holds for row in judged),
            total=len(judged),
            table=table,
        )
        + '\n'
    )


def main(arguments=None):
    """Run the sections and write the pages."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        '--only',
        action='append',
        choices=SECTIONS,
        help='run only this section and print it; may be repeated',
    )
    parser.add_argument(
        '--output',
        type=Path,
        default=ROOT / 'docs',
        help='folder for validation.md, claims.md and validation/, default docs',
    )
    add_smallest(parser, output=Path('out/validation'))
    options = parser.parse_args(arguments)
    folder = data_folder()
    if folder is None:
        print(
            f'the recordings must be in ../shared/data or where {VARIABLE} says, there is no such'
            f' folder; set {VARIABLE}',
            file=sys.stderr,
        )
        return 1
    plots = options.output / 'validation'
    plots.mkdir(parents=True, exist_ok=True)
    reduction = reduced_to_smallest() if options.smallest else contextlib.nullcontext()
    with reduction:
        results = [run_section(name, folder, plots) for name in options.only or SECTIONS]
    sections = [section for section, _ in results]
    if options.only:
        print('\n\n'.join(section.markdown() for section in sections))
    else:
        (options.output / 'validation.md').write_text(document(sections))
        (options.output / 'claims.md').write_text(claims(sections))
        print(f'written: {options.output / "validation.md"}')
    return 0 if all(whole for _, whole in results) else 1


if __name__ == '__main__':
    sys.exit(main())
