"""Short tables that the verbs print on standard output."""

from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from imu_calibration.calibration.result import summary
from imu_calibration.cli.parser import complain
from imu_calibration.cli.terminal import STYLES, Cell, Terminal
from imu_calibration.core.errors import printable, with_hint
from imu_calibration.document.calibration import NUMBER_COLUMNS, PARAMETER_HEADINGS, parameter_rows
from imu_calibration.preprocessing.recording_evidence import NOTE, WARNING, CheckFinding, Severity

if TYPE_CHECKING:
    from imu_calibration.api.calibrate import Calibrated
    from imu_calibration.report.answer_page import AnswerTable


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
    widths = [max(map(len, column)) for column in zip(headings, *rows, strict=True)]
    gap = 2
    is_narrow = sum(widths) + gap * (len(widths) - 1) > out.width
    if is_narrow:  # dotted names may break at a dot
        rows = [(row[0].replace('.', ' '), *row[1:]) for row in rows]
        gap = 1
    cells = [[(heading, 'bold') for heading in headings]]
    for row in rows:
        style = 'dim' if dimmed and not row[-1] else ''
        cells.append([(cell, style) for cell in row])
    right = [k for k, heading in enumerate(headings) if heading in numbers]
    out.write(out.table(cells, right=right, gap=gap))


def show_answer(text: str, *, page: Path | None, table: 'AnswerTable', **content: Any) -> None:
    """
    Print a table and the text of an answer, and write `page` with both unless it is None.

    `content`: further arguments of `answer_page`.
    """
    from imu_calibration.document import files
    from imu_calibration.report.answer_page import answer_page

    out = Terminal.of()
    show_table(out, table.columns, table.rows, numbers=table.numbers)
    out.print(text)
    if page is not None:
        files.write_texts(page.parent, {page.name: answer_page(table=table, **content)})
        out.print(f'written: {page}')


def warn(findings: Iterable[dict[str, Any]]) -> None:
    """
    Print warnings and notes about a recording on standard error, a line each.

    They are `preflight` in the statistics of a calibration.
    """
    for finding in findings:
        word = NOTE if finding['severity'] == NOTE else WARNING
        complain(f'{word}: {printable(finding["text"])}')


def show_findings(out: Terminal, findings: tuple[CheckFinding, ...], hints: dict[str, str]) -> None:
    """Print findings, the worst first; `hints` as for `errors.with_hint`."""
    rows: list[list[Cell]] = []
    for finding in sorted(findings, key=lambda finding: list(Severity).index(finding.severity)):
        severity = (finding.severity, STYLES[finding.severity])
        check = (finding.check.replace('_', ' '), 'bold')
        text = with_hint(finding.text, finding.key, hints, value=finding.value)
        rows.append([severity, check, text])
    out.write(out.table(rows))


def show_calibration(
    calibrated: 'Calibrated', folder: Path, hints: dict[str, str], *, report: bool = True
) -> None:
    """Print the parameters of a `Calibrated`, the decisions and where the files are."""
    out = Terminal.of()
    show_table(
        out, PARAMETER_HEADINGS, parameter_rows(calibrated.calibration), numbers=NUMBER_COLUMNS
    )
    for line in summary(calibrated.result, hints):
        out.print(line)
    files = 'calibration.yaml' + (' and report.html' if report else '')
    out.print(f'written: {files} in {folder}')
