"""Worlds with causes that no catalogue holds: what is handed over helps in another session, or says in a sentence that it does not."""

import sys
from pathlib import Path

from imu_calibration.core.errors import ImuCalibrationError
from imu_calibration.document.decision import HELPS
from imu_calibration.kinematics.table import Table
from imu_calibration.use_cases.calibrate import calibrate
from imu_calibration.use_cases.check import check
from validation.section import Section, text

SEED = 31
ON_A_SHAFT = ('driver_lag', 'rate_dependent_lag', 'motor_ripple', 'flexible_mount')
WORSE = 1.05
"""No kind of motion may get worse by more."""


def worlds():
    """Return (cause, name of the table, options of `make_pair`) of every world."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))
    from worlds.misfit_worlds import CAUSES
    return [*((cause, 'three axis', {}) for cause in (None, *CAUSES)),
            *((cause, 'shaft', {'table': 'shaft', 'profile': 'sweeps'}) for cause in ON_A_SHAFT)]


def outcome(cause, options):
    """Return (what came of it, error after / before, the same in the worst motion, whether it is as it must be)."""
    from worlds.misfit_worlds import make_pair
    pair = make_pair(cause, SEED, **options)
    table = Table.from_mapping(pair.table)
    try:
        found = calibrate(pair.first.block, table)
    except ImuCalibrationError as error:
        return f'refused: {error}', '', '', True
    proof = check(pair.second.block, found.calibration, table).proof
    ratios = [entry['after'] / entry['before'] for entry in proof.values()]
    worst = [max(part['after'] / part['before'] for part in entry['regimes'].values()) for entry in proof.values()]
    figures = [' / '.join(f'{value:.2f}' for value in values) for values in (ratios, worst)]
    helped = [found.verdict.decisions[sensor] is HELPS for sensor in proof]
    return found.verdict.text, *figures, all(not helps or a < 1.0 and b <= WORSE for helps, a, b in zip(helped, ratios, worst, strict=True))


def run(folder, plots):
    """Return the section."""
    section, rows, held = Section('Worlds with causes that no catalogue holds'), [], []
    for cause, table, options in worlds():
        *cells, as_it_must = outcome(cause, options)
        held.append(as_it_must)
        rows.append(((cause or 'none').replace('_', ' '), table, *cells))
    over = sum(row[2] == 'handed over' for row in rows)
    section.claim('worlds of misfit: what is handed over helps in another session, in no motion worse by more than 5 %', 'all of them',
                  f'{sum(held) - len(rows) + over} of {over}; {len(rows) - over} say in a sentence why not', all(held), True)
    section.say(text('misfit'))
    section.table(('cause', 'table', 'what came of it', 'error after / before, accelerometer / gyroscope', 'the worst motion'), rows)
    return section
