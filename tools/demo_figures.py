"""
Compare the errors that the demonstration prints with those in the README: ``make demo-check``.

Usage: `demo_figures.py LOG`, where LOG is the output of ``make demo``. They agree within 5 %; the
sums of the estimation depend in their last digits on the processor and the numerical library.
"""

import re
import sys
from pathlib import Path

README = Path(__file__).resolve().parents[1] / 'README.md'
TOLERANCE = 0.05
"""Largest relative difference of a figure."""
SENTENCE = re.compile(
    r'accelerometer error ([\d.]+) mg to ([\d.]+) mg, gyroscope ([\d.]+) deg/s to ([\d.]+) deg/s'
)
"""Errors before and after compensation in the README."""
ROW = r'^{} +([\d.]+) mg +([\d.]+) deg/s'
"""Row of the printed table: accelerometer, gyroscope."""
NAMES = ('accelerometer before', 'accelerometer after', 'gyroscope before', 'gyroscope after')


def stated_figures(readme: str) -> list[float]:
    """Return the errors in the README, in the order of `NAMES`, mg and deg/s."""
    found = SENTENCE.search(' '.join(readme.split()))
    if found is None:
        raise ValueError('the README must state the errors of the demonstration, it does not')
    return [float(text) for text in found.groups()]


def printed_figures(log: str) -> list[float]:
    """Return the errors in the output of the demonstration, in the order of `NAMES`."""
    before = re.search(ROW.format('before'), log, re.MULTILINE)
    after = re.search(ROW.format('after'), log, re.MULTILINE)
    if before is None or after is None:
        raise ValueError('the demonstration must print its errors before and after, it does not')
    return [float(row[column]) for column in (1, 2) for row in (before, after)]


def differences(readme: str, log: str) -> list[str]:
    """Return a line for each figure that differs by more than `TOLERANCE`."""
    lines = []
    for name, stated, printed in zip(
        NAMES, stated_figures(readme), printed_figures(log), strict=True
    ):
        if abs(printed - stated) > TOLERANCE * stated:
            lines.append(
                f'{name} must be {stated:g} within {TOLERANCE:.0%} (README), the demonstration'
                f' printed {printed:g}; correct the code or the README'
            )
    return lines


def main() -> None:
    """Read the log and compare; exit code 1 with a line for each difference."""
    try:
        lines = differences(README.read_text(), Path(sys.argv[1]).read_text())
    except ValueError as problem:
        lines = [str(problem)]
    if lines:
        sys.exit('\n'.join(lines))
    print('the errors of the demonstration agree with the README')


if __name__ == '__main__':
    main()
