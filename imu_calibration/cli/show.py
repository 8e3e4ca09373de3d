"""Short tables that the verbs print on standard output."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from imu_calibration.calibration.result import summary
from imu_calibration.cli.parser import complain
from imu_calibration.cli.terminal import STYLES, Terminal
from imu_calibration.core.errors import printable, with_hint
from imu_calibration.document.calibration import NUMBER_COLUMNS, PARAMETER_HEADINGS, parameter_rows
from imu_calibration.preprocessing.recording_evidence import NOTE, WARNING, CheckFinding, Severity

if TYPE_CHECKING:
    from imu_calibration.use_cases.calibrate import Calibrated


def show_table(
    out: Terminal,
    headings: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    numbers: Collection[str] = (),
    dimmed: bool = False,
) -> None:
    """
    Print a table, `numbers` flush right.

    `dimmed`: rows with an empty last cell are dim.
    """
    rows = [tuple(row) for row in rows]
    narrow = (
        sum(2 + max(map(len, column)) for column in zip(headings, *rows, strict=True)) - 2
        > out.width
    )
    if narrow:  # dotted names may break at a dot
        rows = [(row[0].replace('.', ' '), *row[1:]) for row in rows]
    styles = ['bold', *('dim' if dimmed and not row[-1] else '' for row in rows)]
    cells = [
        [(cell, style) for cell in row]
        for row, style in zip([headings, *rows], styles, strict=True)
    ]
    right = [k for k, heading in enumerate(headings) if heading in numbers]
    out.write(out.table(cells, right=right, gap=1 if narrow else 2))


def warn(found: Sequence[dict[str, Any]] | Iterator) -> None:
    """
    Print warnings and notes about a recording on standard error, a line each.

    They are `preflight` in the statistics of a calibration.
    """
    for item in found:
        word = NOTE if item['severity'] == NOTE else WARNING
        complain(f'{word}: {printable(item["text"])}')


def show_findings(out: Terminal, findings: tuple[CheckFinding, ...], hints: dict[str, str]) -> None:
    """Print findings, the worst first; `hints` as for `errors.with_hint`."""
    ordered = sorted(findings, key=lambda found: list(Severity).index(found.severity))
    out.write(
        out.table(
            [
                (
                    (found.severity, STYLES[found.severity]),
                    (found.check.replace('_', ' '), 'bold'),
                    with_hint(found.text, found.key, hints, value=found.value),
                )
                for found in ordered
            ]
        )
    )


def show_calibration(
    found: 'Calibrated', folder: Path, hints: dict[str, str], *, report: bool = True
) -> None:
    """Print the parameters of a `Calibrated`, the decisions and where the files are."""
    out = Terminal.of()
    show_table(out, PARAMETER_HEADINGS, parameter_rows(found.calibration), numbers=NUMBER_COLUMNS)
    for line in summary(found.result, hints):
        out.print(line)
    files = 'calibration.yaml' + (' and report.html' if report else '')
    out.print(f'written: {files} in {folder}')
