"""
Run lanes of the suite: `run_lanes.py LANE [LANE ...] [-- PYTEST OPTIONS]`.

Lanes are core, live and long.

Live tests that fail run once more after all others, in one process. The run passes if all of them
pass then; each is listed as `unstable: NAME` with its first failure. A core test is never repeated.
"""

import argparse
import subprocess
import sys

import pytest

LANES = {'core': 'not live and not long', 'live': 'live and not long', 'long': 'long'}
"""Lane -> marker expression."""


class Failures:
    """Pytest plugin that keeps the first failed report of each test, and names the test at once."""

    def __init__(self):
        self.reports, self.others = {}, False
        self.terminal = None

    @pytest.hookimpl(trylast=True)
    def pytest_configure(self, config):
        self.terminal = config.pluginmanager.get_plugin('terminalreporter')

    def pytest_runtest_logreport(self, report):
        if report.failed:
            self.reports.setdefault(report.nodeid, report)
            self.terminal.write_line(f'\nfailed: {report.nodeid}')

    def pytest_collectreport(self, report):
        self.others |= report.failed

    def may_repeat(self):
        """Return whether every failure is that of a live test."""
        return (
            not self.others
            and bool(self.reports)
            and all('live' in report.keywords for report in self.reports.values())
        )


def run(lanes, options):
    """Return the exit code of the lanes."""
    failures = Failures()
    markers = ' or '.join(f'({LANES[lane]})' for lane in lanes)
    code = int(pytest.main(['-m', markers, *options], plugins=[failures]))
    if code != pytest.ExitCode.TESTS_FAILED or not failures.may_repeat():
        return code
    plugins = ['-p', 'xdist', '-n', '0'] if 'xdist' in options else ['-n', '0']
    again = subprocess.run(
        [sys.executable, '-m', 'pytest', *plugins, *failures.reports],
        capture_output=True,
        text=True,
    )
    if again.returncode == 0:
        for name, report in failures.reports.items():
            print(
                f'unstable: {name} failed once and passed when repeated; first'
                f' failure:\n{report.longreprtext}\n'
            )
    print(again.stdout, again.stderr, sep='', end='', flush=True)  # ends with pytest's closing line
    return again.returncode


def main():
    """Read the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('lanes', nargs='+', choices=LANES)
    arguments = sys.argv[1:]
    end = arguments.index('--') if '--' in arguments else len(arguments)
    sys.exit(run(parser.parse_args(arguments[:end]).lanes, arguments[end + 1 :]))


if __name__ == '__main__':
    main()
