"""Style of all figures and their output as SVG inside the page: no screen, no dates, the same input gives the same bytes."""

import io
import math
import re
from collections.abc import Callable
from typing import Any

from imu_calibration.report.drawn import Drawn

INK, GREY, FAINT, GRID = '#1b2430', '#5c6877', '#98a2b0', '#e3e8ee'
BEFORE, AFTER = '#d55e00', '#0072b2'
AXIS = {'x': '#d55e00', 'y': '#009e73', 'z': '#0072b2'}
"""Colours of the three axes: vermilion, bluish green and blue of Okabe and Ito, distinct for colour-blind readers."""
STATUS = {'determined': '#2b8a57', 'weak': '#d08a12', 'held': '#b4322c'}
MARKER = {'x': 'o', 'y': 's', 'z': '^'}
STYLE: Any = {
    'font.family': 'sans-serif', 'font.sans-serif': ['DejaVu Sans'], 'font.size': 9.5, 'axes.titlesize': 10, 'axes.titleweight': 'bold',
    'axes.titlelocation': 'left', 'axes.labelsize': 9.5, 'axes.labelcolor': GREY, 'axes.edgecolor': FAINT, 'axes.linewidth': 0.8,
    'axes.spines.top': False, 'axes.spines.right': False, 'axes.grid': True, 'axes.axisbelow': True, 'grid.color': GRID,
    'grid.linewidth': 0.8, 'xtick.color': FAINT, 'ytick.color': FAINT, 'xtick.labelcolor': GREY, 'ytick.labelcolor': GREY,
    'xtick.labelsize': 8.5, 'ytick.labelsize': 8.5, 'text.color': INK, 'legend.frameon': False, 'legend.fontsize': 8.5,
    'legend.handlelength': 1.4, 'figure.facecolor': 'none', 'axes.facecolor': 'none', 'savefig.facecolor': 'none', 'lines.linewidth': 1.5,
    'axes.unicode_minus': True, 'axes.formatter.useoffset': False, 'svg.fonttype': 'none', 'path.simplify': True,
    'text.parse_math': False,
}

NAMESPACES = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'


def draw(name: str, size: tuple[float, float], paint: Callable[[Any], None], *, label: str) -> Drawn:
    """
    Return a figure as SVG for the page, with the matplotlib figure.

    Parameters
    ----------
    name : str
        Different for every figure of a page: the salt of its identifiers.
    size : (float, float)
        Inches; 96 pixels each on the page.
    paint : callable
        ``paint(figure)`` draws on an empty matplotlib figure.
    label : str
        Text alternative of the figure.

    """
    import matplotlib
    from markupsafe import escape
    from matplotlib.figure import Figure
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update({**STYLE, 'svg.hashsalt': name})
        figure = Figure(figsize=size, layout='constrained')
        paint(figure)
        canvas, text = _laid_out(figure), io.StringIO()
        figure.dpi = matplotlib.rcParams['figure.dpi']   # of pictures inside, which the canvas lays out at 72
        canvas.print_svg(text, metadata={'Date': None, 'Creator': None, 'Format': None, 'Type': None})
        return Drawn(_inside(text.getvalue(), str(escape(label))), figure)


def _laid_out(figure):
    """Place the axes once and return the canvas; `savefig` would do it twice more, and draw once without need."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    canvas = FigureCanvasSVG(figure)
    figure.get_layout_engine().execute(figure)
    figure.set_layout_engine('none')
    return canvas


def _inside(svg, label):
    """Return only the svg element: without prologue, metadata and the identifiers that repeat from figure to figure."""
    svg = svg[svg.index('<svg'):]
    svg = re.sub(r'<metadata>.*?</metadata>', '', svg, flags=re.S)
    svg = re.sub(r' id="[A-Za-z0-9.]+_[0-9]+"', '', svg)
    head = rf'<svg {NAMESPACES} viewBox="\1" role="img" aria-label="{label}">'
    svg = re.sub(r'<svg [^>]*viewBox="([^"]+)"[^>]*>', head, svg, count=1)
    svg = re.sub(r'\n\s*', '\n', svg)
    return re.sub(r"font: ([0-9.]+)px[^;\"]*", r'font-size: \1px', svg)


def log_axis(axis: Any) -> None:
    """Make an axis logarithmic with decades only, written as plain text (mathtext uses most of the time of a page)."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
    axis.axes.set(**{f'{axis.axis_name}scale': 'log'})
    axis.set_major_locator(LogLocator(numticks=8))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: decade(value)))


def decade(value: float) -> str:
    """Return a power of ten as text: plain from 0.001 to 1000, with a raised exponent beyond."""
    exponent = round(math.log10(value))
    if -3 <= exponent <= 3:
        return f'{10.0**exponent:g}'
    return '10' + str(exponent).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))


def axis_legend(axes: Any, where: str = 'upper right', **more: Any) -> None:
    """Draw the legend of the three sensor axes."""
    from matplotlib.lines import Line2D
    handles = [Line2D([], [], color=colour, marker=MARKER[name], markersize=4, lw=0, label=name) for name, colour in AXIS.items()]
    axes.legend(handles=handles, loc=where, ncols=3, columnspacing=1.0, handletextpad=0.2, **more)
