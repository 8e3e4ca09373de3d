"""
The main tasks in one run: simulate, calibrate, compensate another session, compare with the truth.

Run: ``python examples/demo.py --output demo`` (or ``make demo``).
"""

import argparse
import shutil
from pathlib import Path

from error_figures import before_and_after

from imu_calibration.api.recordings import source_of
from imu_calibration.cli.main import main
from imu_calibration.cli.show import show_table
from imu_calibration.cli.terminal import Terminal
from imu_calibration.core.units import error_text, significant
from imu_calibration.document import files
from imu_calibration.estimation.solution import LACKING
from imu_calibration.preprocessing.window_finder import session_truth


def verb(*arguments):
    """Run one verb through the command line and print the command."""
    print('\n$ imu_calibration ' + ' '.join(str(a) for a in arguments))
    code = main([str(a) for a in arguments])
    if code == 1:
        raise SystemExit(1)
    return code


def run(folder):
    """Carry out the demonstration in `folder`."""
    first, second = folder / 'session', folder / 'other_session'
    verb('simulate', '--profile', 'calibration', '--seed', 1, '--imu-seed', 5, '--output', first)
    verb('calibrate', first, '--table', first / 'table.yaml', '--output', folder)
    verb('simulate', '--profile', 'navigation', '--seed', 2, '--imu-seed', 5, '--output', second)
    verb(
        'compensate',
        second,
        '--calibration',
        folder / 'calibration.yaml',
        '--output',
        folder / 'other_session_corrected',
    )
    table, calibration = (
        files.read_table(second / 'table.yaml'),
        files.read_calibration(folder / 'calibration.yaml'),
    )
    truth = session_truth(source_of(second, joint_names=table.joint_names), table)
    show(before_and_after(*truth, calibration))
    lacking = [name for name, status in calibration.status_by_name.items() if status in LACKING]
    print(
        'not determined by this recording: '
        + (', '.join(lacking) if lacking else 'none; every parameter is within its tolerance')
    )
    print(f'report: {(folder / "report.html").resolve()}')


def show(figures):
    """Print the table of errors on the other session."""
    numbers = ('accelerometer', 'gyroscope', 'velocity after 50 s', 'position after 50 s')
    rows = [
        (
            name,
            error_text(f.force, 'm/s^2'),
            error_text(f.rate, 'rad/s'),
            f'{significant(f.velocity)} m/s',
            f'{significant(f.position)} m',
        )
        for name, f in zip(('before', 'after'), figures)
    ]
    print('\nErrors on a different session of the same IMU')
    show_table(Terminal.of(), ('', *numbers), rows, numbers=numbers)


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument(
        '--output', default='demo', help='output folder; an earlier demonstration in it is replaced'
    )
    target = Path(parser.parse_args().output)
    if target.exists():
        known = {
            'session',
            'other_session',
            'other_session_corrected',
            'calibration.yaml',
            'report.html',
        }
        strangers = sorted(p.name for p in target.iterdir() if p.name not in known)
        if strangers:
            raise SystemExit(
                f'{target} must be empty or contain an earlier demonstration, it contains'
                f' {strangers[0]}; choose another --output'
            )
        shutil.rmtree(target)
    target.mkdir(parents=True)
    run(target)
