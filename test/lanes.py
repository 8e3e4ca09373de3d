"""
Pytest plugin.

Keeps processes and DDS out of the core lane and reports the processor time of the slowest tests.
"""

import contextlib
import functools
import gc
import importlib
import multiprocessing.forkserver
import multiprocessing.util
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
STANDARD_LIBRARY = os.path.dirname(os.__file__)
SLOWEST = 20
"""Tests listed at the end of a run."""
_core_test = None
"""Node id of the core test that runs; None while a live test runs or none."""
_seconds = {}
"""Node id -> processor seconds, fixtures that the test set up included."""
_start = pytest.StashKey()


def _kept_out(function, action):
    """
    Return a function that fails a core test before it acts.

    A failure is no Exception, so that code under test cannot catch it.
    """

    @functools.wraps(function)
    def guarded(*arguments, **options):
        if _core_test and not _library_calls():
            pytest.fail(
                f'A core test must not {action}; {_core_test} did: mark it with pytest.mark.live,'
                ' or test without it.'
            )
        return function(*arguments, **options)

    return guarded


def _library_calls():
    """
    Return whether an installed library acts by itself.

    As matplotlib, which runs fc-list when it has no list of fonts yet.
    """
    frame = sys._getframe(2)
    while (
        frame
        and frame.f_code.co_filename.startswith((STANDARD_LIBRARY, '<frozen'))
        and '-packages' not in frame.f_code.co_filename
    ):
        frame = frame.f_back
    return frame is not None and '-packages' in frame.f_code.co_filename


def pytest_addoption(parser):
    """Add the option of checks in which nothing may be left out, and that of all times."""
    parser.addoption('--fail-skipped', action='store_true', help='a skipped test fails')
    parser.addoption('--processor-times', help='file for the times of all files and tests')


def pytest_configure():
    """Guard the functions that start processes and DDS participants."""
    starts = 'start a process'
    subprocess.Popen.__init__ = _kept_out(subprocess.Popen.__init__, starts)
    multiprocessing.util.spawnv_passfds = _kept_out(multiprocessing.util.spawnv_passfds, starts)
    for name in ('fork', 'forkpty', 'posix_spawn', 'posix_spawnp', 'system'):
        setattr(os, name, _kept_out(getattr(os, name), starts))
    try:
        from rclpy.context import Context
    except ImportError:
        return
    Context.init = _kept_out(Context.init, 'use DDS')


def pytest_sessionstart():
    """
    Collect no garbage while the test files are imported, a fifth of the time that it takes.
    """
    gc.disable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session):
    """
    Import all test files, in each process of xdist from another one on.

    In a fresh clone each process then rewrites the assertions of its share of the files and reads
    what the others have written, in place of rewriting all.
    """
    worker = getattr(session.config, 'workerinput', None)
    if worker is None or session.config.args != session.config.getini('testpaths'):
        return
    files = sorted(TESTS.rglob('test_*.py'))
    start = len(files) * int(worker['workerid'].removeprefix('gw')) // worker['workercount']
    for file in files[start:] + files[:start]:
        sys.path.insert(0, str(file.parent))
        # What cannot be imported is reported by the collection.
        with contextlib.suppress(Exception, pytest.skip.Exception):
            importlib.import_module(file.stem)
        sys.path.remove(str(file.parent))


def pytest_collection_finish():
    """
    Begin with the collection of garbage, from which everything that was imported is exempt.

    It begins after 20,000 new objects in place of 700, a fiftieth of the time of all tests.
    """
    gc.freeze()
    gc.set_threshold(20_000)
    gc.enable()


def _processor_time():
    """
    Return seconds of this process, of its ended children and of what it has forked by a server.

    Those do not depend on other work of the machine. The server of `multiprocessing` is no child
    that has ended: without it a test with forked processes would cost nothing.
    """
    seconds = sum(os.times()[:4])
    server = multiprocessing.forkserver._forkserver._forkserver_pid
    if server:
        # utime, stime and those of ended children; the name before may contain spaces.
        fields = Path(f'/proc/{server}/stat').read_text().rpartition(')')[2].split()
        seconds += sum(map(int, fields[11:15])) / os.sysconf('SC_CLK_TCK')
    return seconds


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Name the core test that runs, and take the time."""
    global _core_test
    _core_test = None if item.get_closest_marker('live') else item.nodeid
    item.stash[_start] = _processor_time()
    try:
        return (yield)
    finally:
        _core_test = None


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """
    Attach the processor time to the last report of a test, which also arrives from other processes.

    With ``--fail-skipped`` a skipped test fails, with the reason of the skip.
    """
    report = yield
    if report.skipped and item.config.getoption('fail_skipped'):
        report.outcome = 'failed'
        report.longrepr = f'E   {item.nodeid} was skipped: {report.longrepr[-1]}'
    if call.when == 'teardown':
        report.user_properties.append(('processor_seconds', _processor_time() - item.stash[_start]))
    return report


def pytest_runtest_logreport(report):
    """Collect the processor times."""
    _seconds.update(
        {
            report.nodeid: seconds
            for name, seconds in report.user_properties
            if name == 'processor_seconds'
        }
    )


def pytest_terminal_summary(terminalreporter):
    """List the tests that took most processor time, and write those of all where requested."""
    file = terminalreporter.config.getoption('processor_times')
    if file:
        Path(file).write_text(_all_times())
    slowest = [
        item
        for item in sorted(_seconds.items(), key=lambda item: -item[1])[:SLOWEST]
        if item[1] > 1
    ]
    if not slowest:
        return
    terminalreporter.section(
        f'slowest {len(slowest)} of {len(_seconds)} tests, {sum(_seconds.values()):.0f} s of'
        ' processor time in total'
    )
    for name, seconds in slowest:
        terminalreporter.write_line(f'{seconds:6.1f} s {name}')


def _all_times():
    """Return a line for each test, and before these one for each file with the sum of its tests."""
    sums = Counter()
    for name, seconds in _seconds.items():
        sums[name.partition('::')[0]] += seconds
    lines = [*sums.most_common(), *Counter(_seconds).most_common()]
    return ''.join(f'{seconds:8.2f} {name}\n' for name, seconds in lines)
