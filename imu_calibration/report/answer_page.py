"""The pages of `check` and `compare`: an answer, its reasons and one table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from imu_calibration.document import files
from imu_calibration.report.page import render


@dataclass(frozen=True)
class AnswerTable:
    """A table of text, as it is printed on the terminal and on the page."""

    columns: tuple[str, ...]
    """Heads of the columns."""
    numbers: tuple[str, ...]
    """Those that are aligned to the right."""
    rows: tuple[tuple[str, ...], ...]
    """A text for each column."""


def answer_page(
    title: str,
    headline: str,
    lines: Sequence[str],
    *,
    table: AnswerTable,
    good: bool,
    lead: str,
    facts: Mapping[str, str],
) -> str:
    """Return one self-contained HTML page; the same input gives the same bytes."""
    return render(
        'answer.html',
        title=title,
        headline=headline,
        lines=[line.strip().rstrip('.') for line in lines],
        word='good' if good else 'weak',
        lead=lead,
        facts=list(facts.items()),
        columns=table.columns,
        numbers=table.numbers,
        rows=table.rows,
    )


def page_in(folder: str, name: str, *, force: bool) -> Path:
    """
    Return the path of a page in a folder, before any work is done.

    Raises
    ------
    InputError
        When there is such a page already, and no consent to replace it.

    """
    path = files.user_path(folder) / name
    files.require_new(path, force=force)
    return path
