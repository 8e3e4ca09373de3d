"""
Processor time and memory of ``imu_calibration calibrate`` on a long bag.

Both are relative to the iteration of rosbags over the raw messages of the bag.

Every repetition times both on the same bag one after the other, so that a slow machine changes
both; the ratio is the median over the repetitions. The time of the command includes its imports.
Run it separately with ``python benchmarks/bench_calibrate.py [--minutes M] [--repetitions N]``.
"""

import argparse
import sys
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
if __name__ == '__main__':
    sys.path.insert(0, str(ROOT))

from benchmarks.bags import iterate, long_session, run_verb, write_bench_bag  # noqa: E402
from imu_calibration.api.resources import config_file  # noqa: E402
from tools.smallest import add_smallest  # noqa: E402

REPETITIONS = 5
RATE = 1000.0
JOINT_RATE = 200.0
"""Of the joint messages, Hz; not more of them than of the IMU."""
MINUTES = 60.0
LIMITS = {'mcap': 2.0, 'sqlite3': 4.0}
"""Storage -> largest ratio to bare iteration."""
GROWTH, GROWTH_LIMIT = 4.0, 4.4
"""Factor of the length, and the largest permitted factor of the time."""
MEMORY_LIMIT_MB = 500.0


class Row(NamedTuple):
    """One line of the benchmark."""

    name: str
    """Measured quantity."""
    value: float
    """The figure, median over the repetitions."""
    unit: str
    """Its unit."""
    limit: float
    """Largest permitted value."""
    note: str
    """Individual times."""


def bench_calibrate(minutes=MINUTES, repetitions=REPETITIONS, *, rate=RATE, storages=tuple(LIMITS)):
    """
    Return the rows.

    Time against bare iteration, growth with the length, and peak memory, per storage.
    """
    with TemporaryDirectory() as folder:
        session, rows = long_session(minutes, rate, min(rate, JOINT_RATE)), []
        short = tuple(
            samples.select(samples.stamp_ns - samples.stamp_ns[0] < 60e9 * minutes / GROWTH)
            for samples in session
        )
        for storage in storages:
            long_bag = write_bench_bag(
                Path(folder, f'long_{storage}'), minutes, storage, session=session
            )
            short_bag = write_bench_bag(
                Path(folder, f'short_{storage}'), minutes / GROWTH, storage, session=short
            )
            rows += _measure(long_bag, short_bag, storage, repetitions)
    return rows


def _measure(long_bag, short_bag, storage, repetitions):
    iterate(long_bag)  # reads the file into the page cache, so that both find it there
    runs = [
        (iterate(long_bag), *calibrate(long_bag), *calibrate(short_bag)) for _ in range(repetitions)
    ]
    bare, long, long_mb, short, short_mb = (median(column) for column in zip(*runs, strict=True))
    return [
        Row(
            f'calibrate against bare iteration, {storage}',
            median(run[1] / run[0] for run in runs),
            'x',
            LIMITS[storage],
            f'{long:.1f} s against {bare:.1f} s',
        ),
        Row(
            f'time at {GROWTH:g} x the length, {storage}',
            median(run[1] / run[3] for run in runs),
            'x',
            GROWTH_LIMIT,
            f'{long:.1f} s against {short:.1f} s',
        ),
        Row(
            f'peak memory, {storage}',
            max(run[2] for run in runs),
            'MB',
            MEMORY_LIMIT_MB,
            f'{short_mb:.0f} MB at a quarter of the length',
        ),
    ]


def calibrate(bag):
    """
    Return (processor seconds, peak memory in MB) of calibrating a bag into a folder beside it.

    Without a report.
    """
    return run_verb(
        [
            sys.executable,
            '-m',
            'imu_calibration',
            'calibrate',
            str(bag),
            '--table',
            str(config_file('table_simulated.yaml')),
            '--output',
            f'{bag}_result',
            '--no-report',
        ]
    )


def main():
    """Print the rows; exit code 1 when a limit is exceeded at full size."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument(
        '--minutes', type=float, default=MINUTES, help='length of the bags, default 60'
    )
    parser.add_argument(
        '--rate', type=float, default=RATE, help='rate of the IMU messages, Hz, default 1000'
    )
    parser.add_argument('--storages', nargs='+', choices=LIMITS, default=tuple(LIMITS))
    parser.add_argument('--repetitions', type=int, default=REPETITIONS)
    add_smallest(parser, minutes=0.5, rate=25.0, storages=['mcap'], repetitions=1)
    options = parser.parse_args()
    rows = bench_calibrate(
        options.minutes, options.repetitions, rate=options.rate, storages=options.storages
    )
    for row in rows:
        print(
            f'{row.name:50s} {row.value:7.2f} {row.unit:2s} (at most {row.limit:g} {row.unit}) '
            f' {row.note}'
        )
    missed = any(row.value > row.limit for row in rows)
    return int(missed and not options.smallest)


if __name__ == '__main__':
    sys.exit(main())
