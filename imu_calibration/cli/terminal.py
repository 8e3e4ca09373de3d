"""
Text on standard output.

Lines break between words at the width of a terminal, with colours on a terminal; a file has
neither.
"""

import os
import shutil
import sys
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import TextIO

UNLIMITED = 10_000
"""Width of a line in a file."""
STYLE_CODES = {
    'bold': '1',
    'dim': '2',
    'green': '32',
    'yellow': '33',
    'cyan': '36',
    'bold red': '1;31',
}
"""Style -> code of its escape sequence (ECMA-48, select graphic rendition)."""
STYLES = {'refuse': 'bold red', 'warning': 'yellow', 'note': 'cyan', 'good': 'green'}
"""Severity of a finding or level of a status -> style."""
Cell = str | tuple[str, str]
"""Text, or (text, style of `STYLE_CODES` or '')."""


@dataclass(frozen=True)
class Terminal:
    """A stream of text with a width."""

    stream: TextIO
    """Output of the lines."""
    width: int
    """Characters of a line."""
    moves: bool = False
    """Whether the cursor can move: a terminal."""
    coloured: bool = False
    """Whether escape sequences of colours are written."""

    @classmethod
    def of(cls, stream: TextIO | None = None) -> 'Terminal':
        """
        Return the terminal of a stream (standard output).

        With colours unless NO_COLOR is set (no-color.org).
        """
        stream = stream or sys.stdout
        moves = stream.isatty()
        width = shutil.get_terminal_size().columns if moves else UNLIMITED
        coloured = moves and not os.environ.get('NO_COLOR') and os.environ.get('TERM') != 'dumb'
        return cls(stream, width, moves, coloured)

    def styled(self, text: str, style: str) -> str:
        """Return the text in a style of `STYLE_CODES`; '' is plain."""
        if not (self.coloured and style and text):
            return text
        return f'\x1b[{STYLE_CODES[style]}m{text}\x1b[0m'

    def print(self, text: str = '', style: str = '', indent: str | None = None) -> None:
        """Print the lines of a text; `indent` as for `wrapped`."""
        for line in text.splitlines() or ['']:
            self.write(self.styled(part, style) for part in wrapped(line, self.width, indent))

    def write(self, lines: Iterable[str]) -> None:
        """Print lines as they are."""
        for line in lines:
            print(line, file=self.stream)

    def redraw(self, lines: Sequence[str], drawn: int) -> int:
        """Replace the last `drawn` lines; return the number of lines that can be replaced next."""
        if not self.moves:
            return 0
        if drawn:
            self.stream.write(f'\x1b[{drawn}A\x1b[J')
        self.write(lines)
        self.stream.flush()
        return len(lines)

    def table(
        self, rows: Sequence[Sequence[Cell]], *, right: Sequence[int] = (), gap: int = 2
    ) -> list[str]:
        """
        Return the lines of a table without rules.

        A column that is too wide is at least as wide as its longest word.

        Parameters
        ----------
        rows : sequence of sequences of Cell
        right : sequence of int
            Columns that are flush right; they get their width first.
        gap : int
            Spaces between columns.

        """
        if not rows:
            return []
        texts = []
        styles = []
        for row in rows:
            cells = [cell if isinstance(cell, tuple) else (cell, '') for cell in row]
            texts.append([text for text, _ in cells])
            styles.append([style for _, style in cells])

        # Each column is at least as wide as its longest word, and wider while there is room.
        columns = list(zip(*texts, strict=True))
        widths = [max(map(len, ['', *' '.join(column).split()])) for column in columns]
        room = self.width - sum(widths) - gap * (len(widths) - 1)
        for k in sorted(range(len(widths)), key=lambda k: k not in right):
            growth = max(0, min(room, max(map(len, columns[k])) - widths[k]))
            widths[k] += growth
            room -= growth

        lines = []
        for row_texts, row_styles in zip(texts, styles):
            wrapped_cells = map(wrapped, row_texts, widths)
            for parts in zip_longest(*wrapped_cells, fillvalue=''):
                padded = []
                for k, (part, width) in enumerate(zip(parts, widths)):
                    padded.append(part.rjust(width) if k in right else part.ljust(width))
                padded[-1] = padded[-1].rstrip()
                line = (' ' * gap).join(map(self.styled, padded, row_styles))
                lines.append(line.rstrip())
        return lines


def wrapped(text: str, width: int, indent: str | None = None) -> list[str]:
    """
    Return the lines of one line of text, broken between words.

    Further lines begin with `indent`, by default its indentation.
    """
    if len(text) <= width:
        return [text]
    indent = ' ' * (len(text) - len(text.lstrip())) if indent is None else indent
    return textwrap.wrap(
        text, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
