"""
Causes outside the package.

Twenty recordings with a place, twenty without one, forty without a cause
(validation/foreign_worlds.py).

Usage: `python -m validation.foreign_physics --seed N [--kinds NAME ...] [--empty N]` prints one
line for each recording and the table. Reserved seeds: draw them once, after the search is frozen.
"""

import argparse
import json
import time

import numpy as np

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.api.compensate import compensate_recording
from imu_calibration.api.diagnose import diagnose
from imu_calibration.core.errors import ImuCalibrationError
from imu_calibration.core.samples import ImuSamples, JointSamples, SampleBlock, TemperatureSamples
from imu_calibration.kinematics.table import Table
from tools.smallest import add_smallest
from validation import foreign_worlds
from validation.foreign_worlds import PLACED, TABLE, UNPLACED, least_squares, make_world
from validation.section import markdown_table

SAME_PLACE = 0.7
"""F1 score of the reported and the true samples from which a place counts as correct."""
WORSE = 1.05
"""
Largest allowed ratio of the rms errors on a second session, chosen model over bias and matrix by
least squares.
"""
SENSORS = ('accelerometer', 'gyroscope')
KINDS = [
    'clock_stepped' if kind == 'accel_offset_in_outer_arc' else kind for kind in PLACED
] + list(UNPLACED)


def block_of(world):
    """Return a world as samples."""
    joints = JointSamples(
        world.joint_ns, world.angle, np.full_like(world.angle, np.nan), foreign_worlds.JOINTS
    )
    return SampleBlock(
        ImuSamples(world.stamp_ns, world.force, world.rate, 'imu_link'),
        joints,
        TemperatureSamples(world.temperature_ns, world.temperature_c),
    )


def outcome(kind, unit, motion, *, second=True):
    """Return the row of one recording; `second`: with the comparison on a second session."""
    world, table = make_world(kind, unit, motion), Table.from_mapping(TABLE)
    row = {
        'kind': kind,
        'unit': unit,
        'refused': None,
        'findings': [],
        'false_names': [],
        'axis': None,
        'flagged': True,
        'place': 'missed',
        'ratio': {},
    }
    start = time.process_time()
    try:
        found = diagnose(block_of(world), table).result.diagnosis
    except (
        ImuCalibrationError
    ) as error:  # the check before a calibration names exchanged axes with their time
        return row | {'refused': str(error)[:300], 'seconds': time.process_time() - start}
    row |= {
        'seconds': time.process_time() - start,
        'findings': [finding.effect for finding in found.findings],
    }
    concerned = SENSORS if world.sensor in ('both', '') else (world.sensor,)
    rests = [found.unexplained[sensor] for sensor in concerned]
    named = bool(world.names & set(row['findings']))
    row['flagged'] = (
        bool(row['findings'] if kind == 'nothing' else named)
        or any(rest.significant for rest in rests)
        or bool(found.onset)
    )
    row['false_names'] = sorted(set(row['findings']) - world.names)
    row['formulas'] = [
        str(column)
        for rest in found.unexplained.values()
        if rest.proposal
        for column in rest.proposal.columns
    ]
    reported = {axis for rest in rests for axis in rest.axes} | set(
        found.onset.axes if found.onset else ()
    )
    row['axes'] = sorted(reported)
    row['axis'] = (
        None
        if kind == 'nothing' or not world.axes
        else named or bool(reported) and reported <= world.axes
    )
    regimes = [regime for rest in found.unexplained.values() for regime in rest.regimes[:3]]
    row['places'] = [regime.text for regime in regimes]
    row['onset'] = found.onset and found.onset.time
    row['place'] = 'named' if named and world.place else _place(world, regimes, found.onset)
    if kind != 'nothing' and second:
        row['ratio'] = _second_session(world, table, make_world(kind, unit, motion + 500_000))
    return row


def _place(world, regimes, onset=None):
    """
    Return 'correct', 'false', 'missed' or 'none' for the reported places.

    An onset is the place after a time.
    """
    if not regimes and onset is None:
        return 'missed' if world.place else 'none'
    if not world.place:
        return 'false'
    scores = [
        _f1(regime.time, [regime.inside, ~regime.inside][: 1 + bool(regime.offset)], world)
        for regime in regimes
        if regime.variable.startswith(world.place)
    ]
    if onset is not None and 'time' in world.place:
        scores.append(_f1(world.time, [world.time >= onset.time], world))
    return 'correct' if max(scores, default=0.0) >= SAME_PLACE else 'false'


def _f1(time, options, world):
    true = np.interp(time, world.time, world.inside.astype(float)) > 0.5
    return max(
        float(2 * (true & reported).sum() / max(true.sum() + reported.sum(), 1))
        for reported in options
    )


def _second_session(first, table, second):
    """
    Return sensor -> ratio of the rms errors of a second session.

    It is the rms error when corrected by the chosen model over that by bias and matrix by least
    squares, with the same weight for each sample.
    """
    try:
        calibration = calibrate_recordings(block_of(first), table).calibration
        corrected = compensate_recording(block_of(second), calibration, anyway=True).imu
    except ImuCalibrationError as error:
        return {'refused': str(error)[:200]}
    assert corrected is not None, 'a block with IMU samples has them after compensation'
    plain = least_squares(first)
    ratios = {}
    for sensor, values, readings, true in (
        ('accelerometer', corrected.force_s, second.force, second.true_force),
        ('gyroscope', corrected.rate_s, second.rate, second.true_rate),
    ):
        bias, matrix = plain[sensor]
        of_plain = (readings - bias) @ np.linalg.inv(matrix).T - true
        ratios[sensor] = float(np.sqrt(np.nanmean((values - true) ** 2) / np.mean(of_plain**2)))
    return ratios


def table_of(rows):
    """Return the table of the protocol, Markdown."""
    hidden, empty = (
        [row for row in rows if row['kind'] != 'nothing'],
        [row for row in rows if row['kind'] == 'nothing'],
    )
    placed = [row for row in hidden if row['kind'] not in UNPLACED]
    unplaced = [row for row in hidden if row['kind'] in UNPLACED]
    axes = [row['axis'] for row in hidden if row['axis'] is not None]
    reported = [row for row in hidden if row['place'] in ('correct', 'false')]
    worst = [
        max(row['ratio'].values())
        for row in hidden
        if row['ratio'] and 'refused' not in row['ratio']
    ]

    def count(some, test):
        return f'{sum(map(bool, map(test, some)))} of {len(some)}'

    return markdown_table(
        ('measure', 'target', 'measured'),
        [
            ('flagged', '95 %', count(hidden, lambda row: row['flagged'])),
            ('correct axis', '95 %', count(axes, bool)),
            (
                'place correct or cause named',
                '12 of 20',
                count(placed, lambda row: row['place'] in ('correct', 'named')),
            ),
            (
                'reported places that are correct',
                '85 %',
                count(reported, lambda row: row['place'] == 'correct'),
            ),
            (
                'false place in a recording without one',
                'at most 2 of 20',
                count(unplaced, lambda row: row['place'] == 'false'),
            ),
            ('false name', 'at most 1 of 40', count(hidden, lambda row: row['false_names'])),
            ('finding without a cause', '0 of 40', count(empty, lambda row: row['findings'])),
            ('flagged without a cause', '', count(empty, lambda row: row['flagged'])),
            (
                'second session worse than least squares by more than 5 %',
                '0',
                count(worst, lambda ratio: ratio > WORSE),
            ),
            (
                'refused with a reason',
                '',
                (
                    f'{count(hidden, lambda row: row["refused"])}, the second session'
                    f' {len(hidden) - len(worst)}'
                ),
            ),
            (
                'processor time, median, 95 %, largest, s',
                '5 (95 %), 10',
                ', '.join(
                    f'{q:.1f}'
                    for q in np.quantile([row['seconds'] for row in rows], (0.5, 0.95, 1.0))
                ),
            ),
        ],
    )


def main():
    """Print the rows and the table."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--seed', type=int, required=True)
    parser.add_argument('--kinds', nargs='*', choices=KINDS, default=KINDS)
    parser.add_argument('--empty', type=int, default=40)
    parser.add_argument(
        '--no-second',
        dest='second',
        action='store_false',
        help='without the second sessions, which take half of the time',
    )
    add_smallest(parser, kinds=[], empty=1, second=False)
    options, rows = parser.parse_args(), []
    tasks = [
        (kind, options.seed + number) for number, kind in enumerate(KINDS) if kind in options.kinds
    ]
    for kind, unit in [
        *tasks,
        *(('nothing', options.seed + 1000 + number) for number in range(options.empty)),
    ]:
        rows.append(outcome(kind, unit, 7 * unit, second=options.second))
        print(json.dumps(rows[-1]), flush=True)
    print(table_of(rows))


if __name__ == '__main__':
    main()
