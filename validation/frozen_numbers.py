"""
Write every document of the verbs, and compare two such folders numerically.

The documents are for the sample session, recordings and simulated sessions.

A change that must keep all numbers is checked by one folder written before it and one written after
it: numbers are the same if their bytes are, or if they differ by at most 1e-9 relative. Texts,
names of software versions and hashes are not compared.

Run: ``python validation/frozen_numbers.py write FOLDER [--data DATA] [--recordings NAME ...]
[--sessions N] [--without-plan]`` and ``python validation/frozen_numbers.py compare FOLDER_A
FOLDER_B``; exit code 1 when a number or an exit code differs.
"""

import argparse
import contextlib
import io
import json
import re
import sys
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[1]
if __name__ == '__main__':
    sys.path.insert(0, str(ROOT))

from imu_calibration.cli.main import main  # noqa: E402
from tools.smallest import add_smallest  # noqa: E402
from validation.recordings import VARIABLE, data_folder, reference  # noqa: E402

SAMPLE = ROOT / 'bags/sample_session'
EFFECTS = ('gyro_g_sensitivity', 'accel_quadratic', None, 'time_offset', 'accel_thermal_bias')
"""Effects hidden in the simulated sessions, in turn."""
RELATIVE = 1e-9
"""Largest difference of two numbers that count as equal: the order of a sum may change."""
NUMBER = re.compile(r'(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])')
SKIPPED = {'provenance', 'version', 'date', 'sha256', 'files'}
"""Keys of a document that hold texts, hashes and versions."""


class Writer:
    """Runs verbs and keeps their exit codes."""

    def __init__(self, folder):
        self.folder, self.codes = folder, {}

    def run(self, name, verb, *arguments):
        """
        Run a verb with its result in `folder/name`, keep its printed document.

        It returns whether the verb wrote a result.
        """
        place = self.folder / name
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO()):
            code = main([verb, *map(str, arguments), '--json', '--quiet'])
        place.parent.mkdir(parents=True, exist_ok=True)
        place.with_name(place.name + f'.{verb}.json').write_text(printed.getvalue())
        self.codes[f'{name} {verb}'] = code
        return code != 1


def write(folder, *, data, recordings, sessions, plan):
    """Write the documents of all sources into `folder`."""
    folder.mkdir(parents=True)
    writer = Writer(folder)
    sources: list[tuple[str, Path, Path | None, Path | None]] = [
        ('sample', SAMPLE, SAMPLE / 'table.yaml', None)
    ]
    for name in recordings:
        bag = data / name
        table = bag / 'table.yaml'
        sources.append(
            (name, bag, table if table.is_file() else None, reference(data, name).get('nominal'))
        )
    for k in range(sessions):
        bag, hidden = folder / f'session_{k}' / 'bag', EFFECTS[k % len(EFFECTS)]
        effect = ('--effect', hidden) if hidden else ()
        writer.run(
            f'session_{k}/simulated',
            'simulate',
            '--profile',
            'quick',
            '--seed',
            100 + k,
            *effect,
            '--output',
            bag,
        )
        sources.append((f'session_{k}', bag, bag / 'table.yaml', None))
    for name, bag, table, nominal in sources:
        documents_of(writer, name, bag, table=table, nominal=nominal)
        if plan and table is not None:
            writer.run(
                f'{name}/plan',
                'plan',
                '--table',
                table,
                '--output',
                folder / name / 'plan',
                '--no-report',
                '--no-bound',
            )
        print(
            f'{name}: {sum(key.startswith(name + "/") for key in writer.codes)} verbs', flush=True
        )
    if plan:
        writer.run(
            'by_hand/plan',
            'plan',
            '--by-hand',
            '--output',
            folder / 'by_hand/plan',
            '--no-report',
            '--no-bound',
        )
    (folder / 'exit_codes.yaml').write_text(yaml.safe_dump(writer.codes))


def documents_of(writer, name, bag, *, table, nominal):
    """Write the documents of one recording."""
    place = writer.folder / name
    place.mkdir(parents=True, exist_ok=True)
    options = ('--table', table) if table else ()
    scaled = ()
    if nominal is not None:
        (place / 'nominal.yaml').write_text(yaml.safe_dump(nominal))
        scaled = ('--nominal', place / 'nominal.yaml')
    calibration = place / 'calibrate/calibration.yaml'
    writer.run(f'{name}/noise', 'noise', bag, *scaled, '--output', place / 'noise', '--no-report')
    writer.run(
        f'{name}/diagnose', 'diagnose', bag, *options, *scaled, '--output', place / 'diagnose'
    )
    if writer.run(
        f'{name}/calibrate',
        'calibrate',
        bag,
        *options,
        *scaled,
        '--output',
        place / 'calibrate',
        '--no-report',
    ):
        writer.run(f'{name}/check', 'check', bag, *options, '--calibration', calibration)
        for target in targets():
            writer.run(
                f'{name}/export_{target}',
                'export',
                calibration,
                '--to',
                target,
                '--anyway',
                '--output',
                place / f'export/{target}.txt',
            )


def targets():
    """Return the names of the programs that `export` writes, except the binary file of MATLAB."""
    from imu_calibration.document.exports.export import all_targets

    return [name for name in all_targets() if name != 'mat']


def numbers_of(path):
    """Return {place in the document: number} of a file."""
    text = path.read_text()
    if path.suffix in ('.yaml', '.json'):
        with contextlib.suppress(ValueError, yaml.YAMLError):
            return dict(
                _leaves(json.loads(text) if path.suffix == '.json' else yaml.safe_load(text), '')
            )
    return {f'number {k}': float(found) for k, found in enumerate(NUMBER.findall(text))}


def _leaves(value, place):
    if isinstance(value, dict):
        for key, each in value.items():
            if key not in SKIPPED:
                yield from _leaves(each, f'{place}/{key}')
    elif isinstance(value, list):
        for k, each in enumerate(value):
            yield from _leaves(each, f'{place}/{k}')
    elif isinstance(value, (int, float)):
        yield place, float(value)


def compare(before, after):
    """Return the lines that describe each difference of two folders."""

    def names(folder):
        return {
            p.relative_to(folder)
            for p in folder.rglob('*')
            if p.suffix in ('.yaml', '.json', '.txt') and 'bag' not in p.parts
        }

    lines = [f'{name}: only in one folder' for name in sorted(names(before) ^ names(after))]
    for name in sorted(names(before) & names(after)):
        if (before / name).read_bytes() != (after / name).read_bytes():
            lines += [
                f'{name}: {line}'
                for line in differences(numbers_of(before / name), numbers_of(after / name))
            ]
    return lines


def differences(first, second):
    """
    Return a line for the places in one document only, and one for each pair of numbers that differ.
    """
    lonely = sorted(first.keys() ^ second.keys())
    found = [f'{len(lonely)} places in one document only, first {lonely[0]}'] if lonely else []
    for place in first.keys() & second.keys():
        a, b = first[place], second[place]
        if a != b and not abs(a - b) <= RELATIVE * max(abs(a), abs(b)) and not (a != a and b != b):
            found.append(f'{place}: {a!r} became {b!r}')
    return found


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    verbs = parser.add_subparsers(dest='verb', required=True)
    writing = verbs.add_parser('write')
    writing.add_argument('folder', type=Path)
    writing.add_argument(
        '--data',
        type=Path,
        default=data_folder(),
        help=f'folder of the recordings, default {VARIABLE}',
    )
    writing.add_argument('--recordings', nargs='*', default=[])
    writing.add_argument('--sessions', type=int, default=0)
    writing.add_argument('--without-plan', action='store_true')
    add_smallest(writing, without_plan=True)
    comparing = verbs.add_parser('compare')
    comparing.add_argument('before', type=Path)
    comparing.add_argument('after', type=Path)
    given = parser.parse_args()
    if given.verb == 'write':
        write(
            given.folder.resolve(),
            data=given.data,
            recordings=given.recordings,
            sessions=given.sessions,
            plan=not given.without_plan,
        )
        sys.exit(0)
    found = compare(given.before, given.after)
    print('\n'.join(found) or 'no difference')
    sys.exit(bool(found))
