"""
A call in a process of its own with limited memory and processor time.

So that hostile input cannot take down the tests.
"""

import contextlib
import io
import multiprocessing
import resource
import sys
import traceback
from typing import Any, NamedTuple

LIMIT_BYTES = 3 << 30
"""Address space; libraries and the stacks of threads reserve more of it than they use."""
LIMIT_SECONDS = 20
"""Processor time."""
PRELOAD = [
    'backports.zstd',
    'imu_calibration.cli.inspect',
    'imu_calibration.cli.main',
    'imu_calibration.cli.parser',
    'imu_calibration.cli.show',
    'imu_calibration.cli.terminal',
    'imu_calibration.api.calibrate',
    'imu_calibration.api.inspect',
    'lz4.frame',
    'msg_adapters.bag',
    'rosbags.typesys.stores.ros2_jazzy',
    'scipy.optimize',
    'scipy.signal',
    'scipy.spatial.transform',
    'worlds.hostile_messages',
    'worlds.limited',
]


class Ended(NamedTuple):
    """What became of a call."""

    code: Any
    """What it returned; None where the process was ended by a limit."""
    out: str
    """Standard output."""
    err: str
    """Standard error."""
    seconds: float
    """Processor time."""
    megabytes: float
    """Largest memory in use beyond that of the imported modules."""


def limited(function, *arguments) -> Ended:
    """
    Return what became of ``function(*arguments)`` under the limits; `function` must be importable.
    """
    context = multiprocessing.get_context('forkserver')
    context.set_forkserver_preload(PRELOAD)
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(theirs, function, arguments))
    process.start()
    theirs.close()
    try:
        ended = ours.recv()
    except EOFError:
        ended = Ended(None, '', '', LIMIT_SECONDS, 0.0)
    process.join()
    return ended


def refused(*arguments) -> Ended:
    """
    Run the command line under the limits and assert that it refused in one line, within 500 MB.
    """
    return _refused_or_warned(arguments, (1,))


def survived(*arguments) -> Ended:
    """The same for input of which a part may be usable: exit code 0, 1 or 3, and no traceback."""
    return _refused_or_warned(arguments, (0, 1, 3))


def _refused_or_warned(arguments, codes):
    from imu_calibration.cli.main import main

    ended = limited(main, [str(argument) for argument in arguments])
    said = f'{arguments}: {ended}'
    assert ended.code in codes and 'Traceback' not in ended.err and ended.megabytes < 500, said
    assert ended.code != 1 or (ended.err.count('\n') == 1 and len(ended.err) < 3000), said
    assert all(character.isprintable() or character in '\n\r' for character in ended.err), said
    print(
        f'{arguments[0]}: {ended.seconds:.2f} s, {ended.megabytes:.0f} MB, exit code {ended.code}:'
        f' {ended.err.strip()}'
    )
    return ended


def _child(pipe, function, arguments):
    before = _megabytes()
    resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_SECONDS, LIMIT_SECONDS + 1))
    out, err, code = io.StringIO(), io.StringIO(), None
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = function(*arguments)
        except SystemExit as ended:
            code = ended.code
        except BaseException:
            traceback.print_exc(file=sys.stderr)
    used = resource.getrusage(resource.RUSAGE_SELF)
    pipe.send(
        Ended(
            code,
            out.getvalue(),
            err.getvalue(),
            used.ru_utime + used.ru_stime,
            _megabytes() - before,
        )
    )


def _megabytes():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
