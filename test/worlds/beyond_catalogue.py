"""
Worlds whose cause no catalogue holds: is the rest flagged, on the right axis, at the right place, with a formula of the right family?

Run as ``python test/worlds/beyond_catalogue.py --seeds 3 [--first 100] [--kinds cogging,knock] [--noise white]``; one JSON row each on standard output
with ``--rows``, and the table of figures.
"""

import argparse
import json
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'):
    os.environ.setdefault(_name, '1')
sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parents[2])]

import numpy as np  # noqa: E402

from imu_calibration.diagnosis.diagnose import diagnose  # noqa: E402

from worlds.hiding import record  # noqa: E402
from worlds.physics_beyond import KINDS, Beyond  # noqa: E402

FIRST_SEED = 100
"""Development; those from 9000 on are kept for a last run."""
NOTHING = 'nothing'


def row_of(seed, name, noise='white', size=1.0):
    """Hide a cause, diagnose, and return what was found beside the truth."""
    cause = None if name == NOTHING else Beyond(name, seed, size)
    recording = record(seed, None, noise, through_bag=False, **({} if cause is None else {'cause': cause}))
    start = time.process_time()
    found = diagnose(recording.windows, recording.table, recording.model)
    row = {'kind': name, 'seed': seed, 'noise': noise, 'seconds': time.process_time() - start, 'named': [f.effect for f in found.findings],
           'formulas': [column for rest in found.unexplained.values() if rest.proposal for column in rest.proposal.columns]}
    return row if cause is None else row | _judged(found, cause)


def _judged(found, cause):
    kind, rest = cause.kind, found.unexplained[cause.kind.sensor]
    proposal, told = rest.proposal, set(rest.axes)
    row = {'flagged': rest.significant, 'axis': told == cause.axes if len(cause.axes) == 1 else bool(told) and told <= cause.axes,
           'told_axes': sorted(told), 'axes': sorted(cause.axes)}
    if kind.family is not None:
        row |= {'family': proposal is not None and proposal.family == kind.family, 'reduction': 0.0 if proposal is None else proposal.reduction}
    if kind.place:
        regimes = [regime for regime in rest.regimes if regime.variable.startswith(kind.place)] or list(rest.regimes)
        row |= {'f1': max((_f1(regime, cause) for regime in regimes[:1]), default=0.0), 'where': [regime.text for regime in rest.regimes]}
    return row


def _f1(regime, cause):
    strength = np.abs(cause.signal).max(axis=1)
    true = np.interp(regime.time, cause.time, strength) > 0.2 * strength.max()
    # An offset here is an offset of the other sign everywhere else: the bias is free.
    return max(float(2 * (true & told).sum() / max(true.sum() + told.sum(), 1)) for told in [regime.inside, ~regime.inside][:1 + regime.offset])


def figures(rows):
    """Return {what: (count or value, of how many)}."""
    hidden = [row for row in rows if row['kind'] != NOTHING]
    formula, place = [row for row in hidden if 'family' in row], [row for row in hidden if 'f1' in row]
    empty = [row for row in rows if row['kind'] == NOTHING]

    def share(entries, of):
        return f'{sum(map(bool, entries))} of {len(of)}'
    seconds = [row['seconds'] for row in rows]
    return {'flagged': share((r['flagged'] for r in hidden), hidden), 'right axis': share((r['axis'] for r in hidden), hidden),
            'right family': share((r['family'] for r in formula), formula),
            'formula that lowers the held-out rest by 60 %': share((r['reduction'] >= 0.6 for r in formula), formula),
            'F1 of the place, mean': f'{np.mean([r["f1"] for r in place]) if place else np.nan:.2f} of {len(place)}',
            'a false name': share((r['named'] for r in hidden), hidden), 'nothing hidden: a formula': share((r['formulas'] for r in empty), empty),
            'nothing hidden: a name': share((r['named'] for r in empty), empty),
            'processor seconds, median and largest': f'{np.median(seconds):.1f}, {max(seconds):.1f}'}


def main():
    """Run and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--seeds', type=int, default=1)
    parser.add_argument('--first', type=int, default=FIRST_SEED)
    parser.add_argument('--kinds', default=','.join([*KINDS, NOTHING]))
    parser.add_argument('--noise', default='white')
    parser.add_argument('--jobs', type=int, default=1)
    parser.add_argument('--rows', action='store_true')
    options = parser.parse_args()
    tasks = [(seed, kind, options.noise) for seed in range(options.first, options.first + options.seeds) for kind in options.kinds.split(',')]
    with ProcessPoolExecutor(options.jobs) as pool:
        rows = []
        for row in pool.map(row_of, *zip(*tasks)):
            rows.append(row)
            if options.rows:
                print(json.dumps(row), flush=True)
    for what, value in figures(rows).items():
        print(f'{what}: {value}')


if __name__ == '__main__':
    main()
