"""
The record of a run of hide and seek.

Kept in the repository, compressed, so that another run can be compared with it row by row.
"""

import gzip
import json
from pathlib import Path

KEPT = Path(__file__).with_name('hide_and_seek_record.jsonl.gz')
"""The record that was kept last."""
WHICH = ('part', 'kind', 'trap', 'hidden', 'seed', 'noise', 'grade', 'factor')
"""What tells one session from another."""
TOLD = ('found', 'classes', 'unexplained', 'flagged', 'told_axes', 'family', 'formulas', 'where')
"""What a search says of it; times and rounding may differ."""


def read(path=KEPT):
    """Return the rows of a record, packed or not; none where there is none."""
    path = Path(path)
    if not path.exists():
        return []
    with (gzip.open if path.suffix == '.gz' else open)(path, 'rt') as lines:
        return [json.loads(line) for line in lines]


def keep(rows, path=KEPT):
    """
    Write a record, in an order and with digits that do not depend on the machine's speed.

    Rows of the same sessions replace those kept.
    """
    every = {_key(row): row for row in [*read(path), *rows] if row['part'] != 'failed'}
    text = ''.join(json.dumps(_rounded(every[key])) + '\n' for key in sorted(every))
    beside = path.with_suffix('.new')
    beside.write_bytes(gzip.compress(text.encode(), mtime=0))
    beside.replace(path)


def differences(rows, kept):
    """Return a line for each session of both records of which another thing is told."""
    known = {_key(row): row for row in kept}
    lines = []
    for row in rows:
        was = known.get(_key(row))
        changed = [] if was is None else [name for name in TOLD if row.get(name) != was.get(name)]
        if changed:
            which = ' '.join(str(row[name]) for name in WHICH if name in row)
            lines.append(
                f'{which}: '
                + '; '.join(f'{name} {was.get(name)} -> {row.get(name)}' for name in changed)
            )
    return lines


def _key(row):
    return json.dumps([row.get(name) for name in WHICH])


def _rounded(value):
    if isinstance(value, dict):
        return {name: _rounded(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [_rounded(entry) for entry in value]
    return float(f'{value:.3g}') if isinstance(value, float) else value
