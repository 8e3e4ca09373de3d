"""
Speed of the conversion of Imu messages to arrays relative to rosbags.

rosbags converts one message at a time.

Every repetition times rosbags and this package on the same bag one after the other, so that a busy
machine slows both; the ratio is the median over the repetitions. Run it separately with ``python
benchmarks/bench_decode.py [--minutes M]``.
"""

import argparse
import sys
import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import NamedTuple

if __name__ == '__main__':
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rosbags.highlevel import AnyReader  # noqa: E402

from benchmarks.bags import long_session, write_bench_bag  # noqa: E402
from msg_adapters.bag import open_recording  # noqa: E402
from tools.smallest import add_smallest  # noqa: E402

REPETITIONS = 5
RATE = 1000.0


class Row(NamedTuple):
    """One line of the benchmark."""

    name: str
    """Compared task."""
    ours: float
    """Messages per second, median."""
    theirs: float
    """Messages per second by rosbags, median."""
    ratio: float
    """Median of the ratios of one repetition."""
    target: float
    """Least permitted ratio; 0 for none."""


def bench_decode(minutes=3.0, repetitions=REPETITIONS, rate=RATE):
    """
    Return the rows.

    Decoding of Imu per storage, and of all messages against the bare iteration of rosbags.
    """
    with TemporaryDirectory() as folder:
        session = long_session(minutes, rate)
        bags = {
            'sqlite3': ('sqlite3', True),
            'mcap': ('mcap', True),
            'mcap, Imu only': ('mcap', False),
        }
        paths = {
            name: write_bench_bag(Path(folder, f'bag{k}'), minutes, storage, joints, session)
            for k, (name, (storage, joints)) in enumerate(bags.items())
        }
        rows = [
            _compare(
                f'Imu to arrays, {name}',
                lambda path=path: _deserialize(path),
                lambda path=path: _decode(path, False),
                target,
                repetitions,
            )
            for (name, path), target in zip(paths.items(), (15, 15, 25), strict=True)
        ]
        rows += [
            _compare(
                f'Imu and JointState to arrays against bare iteration, {name}',
                lambda path=path: _iterate(path),
                lambda path=path: _decode(path, True),
                0,
                repetitions,
            )
            for name, path in list(paths.items())[:2]
        ]
    return rows


def _compare(name, theirs, ours, target, repetitions):
    ours()  # reads the file into the page cache, so that both find it there
    speeds = [(_speed(ours), _speed(theirs)) for _ in range(repetitions)]
    return Row(
        name,
        median(s[0] for s in speeds),
        median(s[1] for s in speeds),
        median(s[0] / s[1] for s in speeds),
        target,
    )


def _speed(function):
    start = time.perf_counter()
    count = function()
    return count / (time.perf_counter() - start)


def _decode(path, with_joints):
    with open_recording(path, want_joints=with_joints, want_temperature=False) as recording:
        return sum(
            len(samples)
            for block in recording.blocks()
            for samples in (block.imu, block.joints)
            if samples is not None
        )


def _deserialize(path):
    count = 0
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages(reader.topics['/imu/data_raw'].connections):
            reader.deserialize(data, connection.msgtype)
            count += 1
    return count


def _iterate(path):
    with AnyReader([path]) as reader:
        return sum(1 for _ in reader.messages())


def main():
    """Print the rows; exit code 1 when a target is missed at full size."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--minutes', type=float, default=3.0, help='length of the bags, default 3')
    parser.add_argument(
        '--rate', type=float, default=RATE, help='rate of the IMU messages, Hz, default 1000'
    )
    parser.add_argument('--repetitions', type=int, default=REPETITIONS)
    add_smallest(parser, minutes=1.0, rate=100.0, repetitions=1)
    options = parser.parse_args()
    rows = bench_decode(options.minutes, options.repetitions, options.rate)
    for row in rows:
        target = f'  (at least {row.target:g})' if row.target else ''
        print(
            f'{row.name:60s} {row.ours / 1e6:7.3f} M/s against {row.theirs / 1e6:7.3f} M/s:'
            f' {row.ratio:6.1f} x{target}'
        )
    missed = any(row.ratio < row.target for row in rows)
    return int(missed and not options.smallest)


if __name__ == '__main__':
    sys.exit(main())
