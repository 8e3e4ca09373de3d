"""A figure as SVG that keeps its matplotlib figure."""

import io
from typing import Any


class Drawn(str):
    """SVG of a matplotlib figure; templates do not escape it."""

    figure: Any
    """The matplotlib figure."""

    def __new__(cls, svg: str, figure: Any) -> 'Drawn':
        """Return the SVG with its figure."""
        made = super().__new__(cls, svg)
        made.figure = figure
        return made

    def __html__(self) -> str:
        return str(self)

    @property
    def pdf(self) -> bytes:
        """The figure as PDF; the same input gives the same bytes."""
        from matplotlib.backends.backend_pdf import FigureCanvasPdf
        whole = io.BytesIO()
        FigureCanvasPdf(self.figure).print_pdf(whole, metadata={'CreationDate': None})
        return whole.getvalue()

    @property
    def data(self) -> list[dict[str, Any]]:
        """For each axes its title and labels, and 'lines': list of (label, x (n,), y (n,)) as arrays in the units of the labels."""
        return [{'title': axes.get_title(loc='left'), 'x': axes.get_xlabel(), 'y': axes.get_ylabel(),
                 'lines': [(line.get_label(), *line.get_data()) for line in axes.get_lines()]} for axes in self.figure.axes]
