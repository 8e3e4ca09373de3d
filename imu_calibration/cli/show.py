"""Short tables that the verbs print on standard output."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from imu_calibration.calibration.result import summary
from imu_calibration.core.errors import printable, with_hint
from imu_calibration.document.calibration import HEADINGS, NUMBERS, parameter_rows
from imu_calibration.preprocessing.recording_evidence import CheckFinding, Severity

if TYPE_CHECKING:
    from imu_calibration.use_cases.calibrate import Calibrated


UNLIMITED = 10_000
"""Width of a line in a file."""


def console() -> Any:
    """Return a console on standard output: lines break between words at the width of a terminal, and nowhere in a file."""
    import sys

    from rich.console import Console
    return Console(width=None if sys.stdout.isatty() else UNLIMITED, highlight=False, markup=False)


def show_table(out: Any, headings: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: Collection[str] = (),
               dimmed: bool = False) -> None:
    """
    Print a table without lines, `numbers` flush right; where it is wider than the terminal, lines break between words only.

    Rich would shrink the widest columns first, even below their longest entry. `dimmed`: rows with an empty last cell are dim.
    """
    from rich.table import Table
    rows = [tuple(row) for row in rows]
    most = [max(map(len, column)) for column in zip(headings, *rows, strict=True)]
    narrow = sum(most) + 2 * (len(most) - 1) > out.width
    if narrow:   # dotted names may break at a dot
        rows = [(row[0].replace('.', ' '), *row[1:]) for row in rows]
    least = [max(len(word) for cell in column for word in [*cell.split(), '']) for column in zip(headings, *rows, strict=True)]
    widths, room = list(least), out.width - sum(least) - (len(least) - 1)
    for k in sorted(range(len(widths)), key=lambda k: headings[k] not in numbers):   # numbers first
        widths[k] += max(0, min(room, most[k] - least[k]))
        room -= widths[k] - least[k]
    table = Table(box=None, pad_edge=False, collapse_padding=narrow)
    for heading, width in zip(headings, widths, strict=True):
        table.add_column(heading, justify='right' if heading in numbers else 'left', width=width if narrow else None)
    for row in rows:
        table.add_row(*row, style='dim' if dimmed and not row[-1] else None)
    out.print(table)


def warn(found: Sequence[dict[str, Any]] | Iterator) -> None:
    """Print the warnings about a recording (`preflight` in the statistics of a calibration) on standard error, a line each."""
    import sys
    for item in found:
        print(f'warning: {printable(item["text"])}', file=sys.stderr)


STYLES = {'refuse': 'bold red', 'warning': 'yellow', 'note': 'cyan', 'good': 'green'}


def show_findings(out: Any, findings: tuple[CheckFinding, ...], hints: dict[str, str]) -> None:
    """Print findings on a console, the worst first; `hints` as for `errors.with_hint`."""
    from rich.table import Table
    from rich.text import Text
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True, style='bold')
    table.add_column(overflow='fold')
    for finding in sorted(findings, key=lambda found: list(Severity).index(found.severity)):
        text = with_hint(finding.text, finding.key, hints)
        table.add_row(Text(finding.severity, STYLES[finding.severity]), finding.check.replace('_', ' '), Text(text))
    out.print(table)


def show_calibration(found: 'Calibrated', folder: Path, hints: dict[str, str], *, report: bool = True) -> None:
    """Print the parameters of a `Calibrated`, the decisions and where the files are."""
    out = console()
    show_table(out, HEADINGS, parameter_rows(found.calibration), numbers=NUMBERS)
    for line in summary(found.result, hints)[1]:
        out.print(line)
    files = 'calibration.yaml' + (' and report.html' if report else '')
    out.print(f'written: {files} in {folder}')
