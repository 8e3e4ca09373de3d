"""A section of the document: claims with their figures, tables, remarks and plots."""

from dataclasses import dataclass, field
from pathlib import Path

TEXTS = Path(__file__).parent / 'texts'


@dataclass(frozen=True)
class Row:
    """One claim with what came out."""

    claim: str
    """What should hold."""
    target: str
    """The known value or the limit."""
    found: str
    """What this run measured."""
    holds: bool | None = None
    """Whether it holds; None where there is nothing to hold."""
    headline: bool = False
    """Whether the README quotes it."""


@dataclass
class Section:
    """Everything that one recording or one comparison shows."""

    title: str
    """Heading."""
    rows: list = field(default_factory=list)
    """Claims."""
    parts: list = field(default_factory=list)
    """Paragraphs and tables below the claims, Markdown."""
    plots: list = field(default_factory=list)
    """(file name beside the document, caption)."""

    def claim(self, claim, target, found, holds=None, headline=False):
        """Add a claim; a headline is quoted by the README."""
        self.rows.append(
            Row(claim, target, found, None if holds is None else bool(holds), headline)
        )

    def say(self, text):
        """Add a paragraph."""
        self.parts.append(text)

    def table(self, head, rows):
        """Add a table; cells are texts."""
        self.parts.append(markdown_table(head, rows))

    def quote(self, lines):
        """Add lines as a program printed them."""
        self.parts.append('\n'.join(['```', *lines, '```']))

    def plot(self, folder, name, figure, caption):
        """Save a figure beside the document."""
        figure.savefig(folder / name, dpi=110, bbox_inches='tight', metadata={'Software': None})
        self.plots.append((name, caption))

    def markdown(self):
        """Return the section as Markdown."""
        pieces = [f'## {self.title}']
        if self.rows:
            pieces.append(claims_table(self.rows))
        pieces += self.parts
        pieces += [f'![{caption}](validation/{name})\n\n{caption}' for name, caption in self.plots]
        return '\n\n'.join(pieces)


def text(name, **values):
    """Return a text of the folder texts with its figures filled in."""
    return (TEXTS / f'{name}.md').read_text().strip().format(**values)


def claims_table(rows):
    """Return the table of claims."""
    words = {True: 'yes', False: '**no**', None: ''}
    cells = [(row.claim, row.target, row.found, words[row.holds]) for row in rows]
    return markdown_table(('claim', 'known or wanted', 'found', 'holds'), cells)


def markdown_table(head, rows):
    """Return a Markdown table; bars within cells are escaped."""
    lines = [head, ['---'] * len(head), *rows]
    return '\n'.join(
        '| ' + ' | '.join(str(cell).replace('|', '\\|') for cell in line) + ' |' for line in lines
    )


def listed(values, digits):
    """Return numbers as text with a fixed number of decimals, with signs."""
    return ', '.join(f'{value:+.{digits}f}' for value in values)
