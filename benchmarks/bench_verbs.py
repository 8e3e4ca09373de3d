"""
Processor time and peak memory of the verbs.

Both are relative to a bare iteration of rosbags over the same bag.

The limits were stated in seconds on one machine, where `calibrate` of an hour at 1 kHz needed 19.4
s of processor time, 2.7 times a bare iteration over the raw messages of its sqlite3 bag. One
iteration therefore needed 7.2 s, 1.67 us per message: a limit of S seconds for a bag of N messages
is S / (1.67e-6 N) iterations. The iteration and the verb run one after the other, and the ratio is
the median over the repetitions, so that a slow or busy machine changes both. The processor time of
a verb includes its imports and its report. Run it separately with ``python
benchmarks/bench_verbs.py [--repetitions N] [--only TEXT]``.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
if __name__ == '__main__':
    sys.path[:0] = [str(ROOT), str(ROOT / 'test')]  # simulated worlds of the tests

from benchmarks.bags import (
    hand_session,
    iterate,
    long_session,
    run_verb,
    write_bench_bag,
)  # noqa: E402
from imu_calibration.api.resources import config_file  # noqa: E402
from tools.smallest import add_smallest  # noqa: E402

REPETITIONS = 3
SECONDS_PER_MESSAGE = 19.4 / 2.7 / (3600 * 1200)
"""
Bare iteration on the machine on which the limits were stated: an hour with Imu at 1 kHz and
JointState at 200 Hz.
"""


class Session(NamedTuple):
    """A bag that several verbs read."""

    make: Callable
    """Returns (ImuSamples, JointSamples or None) of this share of the length."""
    messages: int
    """Number of messages."""


class Case(NamedTuple):
    """One verb on one session, with the limits that were stated."""

    verb: str
    session: str
    """Key of SESSIONS."""
    arguments: tuple[str, ...]
    """Further arguments; TABLE and OUTPUT are replaced by paths."""
    seconds: float
    """Largest processor time, s, on the machine of the limits."""
    memory_mb: float
    """Largest peak memory, MB."""


SESSIONS = {
    '5 min at 100 Hz': Session(
        lambda share: long_session(5.0 * share, imu_rate=100.0, joint_rate=100.0), 300 * 200
    ),
    '10 min by hand at 200 Hz': Session(lambda share: hand_session(22.0 * share), 600 * 200),
    'an hour at 1 kHz': Session(lambda share: long_session(60.0 * share), 3600 * 1200),
}
CASES = (
    Case('calibrate', '5 min at 100 Hz', ('--table', 'TABLE', '--output', 'OUTPUT'), 1.5, 200),
    Case('diagnose', '5 min at 100 Hz', ('--table', 'TABLE', '--output', 'OUTPUT'), 5, 500),
    Case('calibrate', '10 min by hand at 200 Hz', ('--output', 'OUTPUT'), 4, 200),
    Case('calibrate', 'an hour at 1 kHz', ('--table', 'TABLE', '--output', 'OUTPUT'), 8, 300),
    Case('inspect', 'an hour at 1 kHz', (), 10, 250),
    Case(
        'compensate',
        'an hour at 1 kHz',
        ('--calibration', 'CALIBRATION', '--output', 'OUTPUT'),
        10,
        200,
    ),
    Case('diagnose', 'an hour at 1 kHz', ('--table', 'TABLE', '--output', 'OUTPUT'), 15, 500),
)


def bench_verbs(repetitions=REPETITIONS, only='', *, share=1.0, further=()):
    """
    Yield (case, multiples of a bare iteration, seconds, MB, limit as multiple).

    Multiples, seconds and MB of each repetition. `further` are more arguments of each verb.
    """
    with TemporaryDirectory() as folder:
        for number, (name, session) in enumerate(SESSIONS.items()):
            cases = [
                case for case in CASES if case.session == name and only in f'{case.verb} {name}'
            ]
            if not cases:
                continue
            bag = write_bench_bag(Path(folder, f'bag{number}'), session=session.make(share))
            limit = 1 / (SECONDS_PER_MESSAGE * session.messages)
            for case in cases:
                runs = [
                    _measure(case, bag, Path(folder, f'{case.verb}{number}_{k}'), further)
                    for k in range(repetitions)
                ]
                yield (
                    case,
                    [run[1] / run[0] for run in runs],
                    [run[1] for run in runs],
                    [run[2] for run in runs],
                    limit * case.seconds,
                )


def _measure(case, bag, output, further):
    """
    Return (processor seconds of a bare iteration, processor seconds of the verb, its peak MB).
    """
    iteration, table = iterate(bag), config_file('table_simulated.yaml')
    calibration = bag.parent / f'calibration_{bag.name}'
    if case.verb == 'compensate' and not calibration.exists():
        run_verb(
            _command(
                'calibrate', bag, '--table', str(table), '--output', str(calibration), '--no-report'
            )
        )
    paths = {'TABLE': table, 'OUTPUT': output, 'CALIBRATION': calibration / 'calibration.yaml'}
    seconds, memory = run_verb(
        _command(case.verb, bag, *(str(paths.get(each, each)) for each in case.arguments), *further)
    )
    return iteration, seconds, memory


def _command(verb, bag, *arguments):
    return [sys.executable, '-m', 'imu_calibration', verb, str(bag), *arguments]


def main():
    """Print a line per case; exit code 1 when a limit is exceeded at full size."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--repetitions', type=int, default=REPETITIONS)
    parser.add_argument('--only', default='', help='run the cases with this text in the name')
    parser.add_argument('--share', type=float, default=1.0, help='share of the sessions, default 1')
    parser.add_argument('--further', nargs='+', default=(), help='further arguments of each verb')
    add_smallest(parser, repetitions=1, only='by hand', share=0.1, further=['--no-report'])
    options = parser.parse_args()
    missed = False
    for case, multiples, seconds, memory, limit in bench_verbs(
        options.repetitions, options.only, share=options.share, further=options.further
    ):
        multiple = median(multiples)
        missed |= multiple > limit or max(memory) > case.memory_mb
        print(
            f'{case.verb + ", " + case.session:40s} {multiple:6.1f} iterations (at most'
            f' {limit:.1f}: {case.seconds:g} s)  {median(seconds):5.1f} s  {max(memory):4.0f} MB'
            f' (at most {case.memory_mb:g})',
            flush=True,
        )
    return int(missed and not options.smallest)


if __name__ == '__main__':
    sys.exit(main())
