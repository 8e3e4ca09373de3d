"""Figures that are drawn when they are shown: curves, spectra, the geometry of the sensors."""

import io
import math
import re
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from imu_calibration.calibration.installation_angles import AXIS_PAIRS, derive, in_paper_units
from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.compensation.compensate import arms_of
from imu_calibration.core.errors import InputError
from imu_calibration.core.units import DEG, decimals
from imu_calibration.document import files
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.report.page import fixed, pair
from imu_calibration.selection.spectrum import MIN_LINE_POWER
from imu_calibration.selection.unexplained import Unexplained


class Drawn(str):
    """SVG of a matplotlib figure: templates do not escape it, a notebook shows it, a file can contain it."""

    figure: Any
    """The matplotlib figure."""

    def __new__(cls, svg: str, figure: Any) -> 'Drawn':
        """Return the SVG with its figure."""
        made = super().__new__(cls, svg)
        made.figure = figure
        return made

    def __html__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        return f'<div style="max-width:860px">{self}</div>'

    @property
    def axes(self) -> list[Any]:
        """The matplotlib axes; ``axes[0].figure`` is the figure."""
        return self.figure.axes

    def save(self, path: str | PathLike) -> None:
        """Write the figure as PDF, SVG or PNG, by the end of the name; raises InputError for others."""
        kind = Path(path).suffix.lower()
        if kind not in ('.pdf', '.svg', '.png'):
            raise InputError(f'the name of a figure must end with .pdf, .svg or .png, got {path}; change it', code='figure_suffix')
        if kind == '.svg':
            files.write_text(path, str(self))
        else:
            files.write_whole(path, self.pdf if kind == '.pdf' else self.png)

    @property
    def pdf(self) -> bytes:
        """The figure as PDF; the same input gives the same bytes."""
        from matplotlib.backends.backend_pdf import FigureCanvasPdf
        whole = io.BytesIO()
        FigureCanvasPdf(self.figure).print_pdf(whole, metadata={'CreationDate': None})
        return whole.getvalue()

    @property
    def png(self) -> bytes:
        """The figure as PNG on white, 200 pixels per inch."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        whole = io.BytesIO()
        FigureCanvasAgg(self.figure)
        self.figure.savefig(whole, format='png', dpi=200, facecolor='white')
        return whole.getvalue()

    @property
    def data(self) -> list[dict[str, Any]]:
        """For each axes its title and labels, and 'lines': list of (label, x (n,), y (n,)) as arrays in the units of the labels."""
        return [{'title': axes.get_title(loc='left'), 'x': axes.get_xlabel(), 'y': axes.get_ylabel(),
                 'lines': [(line.get_label(), *line.get_data()) for line in axes.get_lines()]} for axes in self.axes]


INK, GREY, FAINT, GRID_GREY = '#1b2430', '#5c6877', '#98a2b0', '#e3e8ee'
BEFORE, AFTER = '#d55e00', '#0072b2'
AXIS_COLOURS = {'x': '#d55e00', 'y': '#009e73', 'z': '#0072b2'}
"""Colours of the three axes: vermilion, bluish green and blue of Okabe and Ito, distinct for colour-blind readers."""
STATUS = {'determined': '#2b8a57', 'weak': '#d08a12', 'held': '#b4322c'}
MARKER = {'x': 'o', 'y': 's', 'z': '^'}
STYLE: Any = {
    'font.family': 'sans-serif', 'font.sans-serif': ['DejaVu Sans'], 'font.size': 9.5, 'axes.titlesize': 10, 'axes.titleweight': 'bold',
    'axes.titlelocation': 'left', 'axes.labelsize': 9.5, 'axes.labelcolor': GREY, 'axes.edgecolor': FAINT, 'axes.linewidth': 0.8,
    'axes.spines.top': False, 'axes.spines.right': False, 'axes.grid': True, 'axes.axisbelow': True, 'grid.color': GRID_GREY,
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
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update({**STYLE, 'svg.hashsalt': name})
        figure, text = Figure(figsize=size), io.StringIO()
        paint(figure)
        _place(figure)
        FigureCanvasSVG(figure).print_svg(text, metadata={'Date': None, 'Creator': None, 'Format': None, 'Type': None})
        return Drawn(_inside(text.getvalue(), str(escape(label))), figure)


CHARACTER, LINE_HEIGHT = 0.58, 1.2
"""Mean width and height of text in units of its font size."""
PAD, TICK_PAD = 0.06, 0.1
"""Distance of texts, and of tick labels from their axis, inches."""


def _place(figure):
    """
    Place the axes side by side and one above the other, with margins from the numbers of characters of their labels.

    The layout engines of matplotlib measure each text twice, a third of the processor time of a page.
    """
    grid = figure.axes[0].get_subplotspec().get_topmost_subplotspec().get_gridspec()
    beside, above = np.zeros((2, grid.ncols)), np.zeros((2, grid.nrows))   # left and right of columns, top and bottom of rows, inches
    for axes in figure.axes:
        spec = axes.get_subplotspec().get_topmost_subplotspec()
        across, (top, bottom) = _labels(axes)
        beside[:, spec.colspan.start] = np.maximum(beside[:, spec.colspan.start], across)
        above[:, spec.rowspan.start] = np.maximum(above[:, spec.rowspan.start], (top, bottom))
    width, height = figure.get_size_inches()
    (left, right), (top, bottom) = (beside[0, 0], beside[1, -1]), (above[0, 0], above[1, -1])
    gaps = [(one[1:] + other[:-1]).max(initial=0.0) for one, other in (beside, above)]
    sizes = [(full - sum(ends) - gap * (count - 1)) / count for full, ends, gap, count in (
        (width, (left, right), gaps[0], grid.ncols), (height, (top, bottom), gaps[1], grid.nrows))]
    figure.subplots_adjust(left=left / width, right=1 - right / width, top=1 - top / height, bottom=bottom / height,
                           wspace=gaps[0] / sizes[0], hspace=gaps[1] / sizes[1])


def _labels(axes):
    """Return the inches that labels take at the (left, right) and (top, bottom) of axes."""
    beside, below = (max((_extent(text)[k] + TICK_PAD for text in _tick_labels(axis)), default=0.0) if axes.axison else 0.0
                     for k, axis in enumerate((axes.yaxis, axes.xaxis)))
    label, under, title = (sum(_extent(text)[k] + PAD for text in some if text.get_text())
                           for k, some in ((0, [axes.yaxis.label]), (1, [axes.xaxis.label]), (1, [axes.title, axes._left_title])))
    above = [title, *(_extent(text)[1] for text in axes.texts if getattr(text, 'get_annotation_clip', bool)() is False)]
    if (legend := axes.get_legend()) is not None:
        anchor, line = legend.get_bbox_to_anchor(), 3 * TICK_PAD
        above.append(line * (anchor.y0 >= axes.bbox.y1))
        under += line * (anchor.y1 < axes.bbox.y0)
    sides = (beside + label, 0.0) if axes.yaxis.get_label_position() == 'left' else (0.0, beside + label)
    return np.add(sides, PAD), np.add((max(above), below + under), PAD)


def _tick_labels(axis):
    low, high = sorted(axis.get_view_interval())
    return [text for place, text in zip(axis.get_majorticklocs(), axis.get_majorticklabels()) if low <= place <= high
            and text.get_visible() and text.get_text()]


def _extent(text):
    """Return width and height of a rotated line of text, inches, from its number of characters."""
    size, angle = text.get_fontsize() / 72, math.radians(text.get_rotation())
    width, height = CHARACTER * size * len(text.get_text()), LINE_HEIGHT * size
    return (width * abs(math.cos(angle)) + height * abs(math.sin(angle)), width * abs(math.sin(angle)) + height * abs(math.cos(angle)))


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
    handles = [Line2D([], [], color=colour, marker=MARKER[name], markersize=4, lw=0, label=name) for name, colour in AXIS_COLOURS.items()]
    axes.legend(handles=handles, loc=where, ncols=3, columnspacing=1.0, handletextpad=0.2, **more)


def draw_tones(sensor: str, rest: Unexplained) -> str:
    """Return the spectra with significant tones, as SVG; empty if there are none."""
    if not rest.tones:
        return ''
    label = f'Spectrum of the unexplained residual of the {sensor}'
    return draw(f'tones-{sensor}', (8.6, 0.6 + 2.1 * len(rest.tones)), _Spectra(rest.tones), label=label)


class _Spectra:
    """One panel for each tone: the power of its axis over that around it."""

    def __init__(self, tones):
        self.tones = tones

    def __call__(self, figure):
        for axes, tone in zip(np.atleast_1d(figure.subplots(len(self.tones), 1)), self.tones):
            axes.plot(tone.frequencies, tone.power, color=AFTER, lw=0.9)
            axes.axhline(MIN_LINE_POWER, color=GREY, lw=0.6)
            axes.axvline(tone.frequency, color=INK, lw=0.8, ls=':')
            log_axis(axes.yaxis)
            axes.set_ylabel(f'{tone.sensor} {tone.axis}: power / around')
            axes.set_xlabel('frequency, Hz' if tone.joint is None else f'cycles per turn of {tone.joint}')


PLANES = ((0, 1), (0, 2), (1, 2))


def derived_section(result: CalibrationResult) -> list[dict[str, Any]]:
    """Return scale factors, angles and biases of both sensors, as rows of text."""
    return [_derived(derive(result.calibration, sensor), result.options.nominal) for sensor in SENSORS]


def _derived(found, nominal):
    angles = [[' ± '.join(pair(v / DEG, s / DEG)) for v, s in zip(*rows)] for rows in zip(found.angles, found.angles_sd)]
    between = [('xyz'[i] + '–' + 'xyz'[j], ' ± '.join(pair(v / DEG, s / DEG)))
               for (i, j), v, s in zip(AXIS_PAIRS, found.between, found.between_sd)]
    lines = [{'what': what, 'unit': unit, 'values': [' ± '.join(pair(v, s)) for v, s in zip(values, sds)]}
             for what, unit, values, sds in in_paper_units(found, nominal)]
    ppm = [fixed((v - 1) * 1e6, decimals(max(s, 1e-12) * 1e6)) for v, s in zip(found.scale, found.scale_sd)]
    return {'sensor': found.sensor, 'lines': lines, 'ppm': ppm, 'angles': angles, 'between': between}


def lever_section(result: CalibrationResult) -> dict[str, Any] | None:
    """Return the drawing of the lever arms, or None when the model has none."""
    if result.calibration.of('accelerometer', Role.ARMS) is None:
        return None
    gauge = result.calibration.gauge.get('origin')
    origin = 'the mean of the three sensitive points' if gauge == 'mean_of_sensitive_points' else 'the reference point of the mount'
    return {'figure': draw('lever-arms', (8.6, 3.15), _Arms(result.calibration),
                           label='Sensitive points of the three accelerometers in three views'), 'origin': origin}


class _Arms:
    """Three views: sensitive points with ellipses of two sd."""

    def __init__(self, calibration):
        self.arms = arms_of(calibration) * 1e3
        part = calibration.model.part('accelerometer', Role.ARMS)
        self.cov = calibration.covariance[part, part] * 1e6

    def __call__(self, figure):
        limit = 1.25 * max(float(np.max(np.abs(self.arms))), 3 * float(np.sqrt(np.diag(self.cov).min())), 1e-3)
        for axes, (across, up) in zip(figure.subplots(1, 3), PLANES):
            axes.axhline(0, color=GREY, lw=0.6)
            axes.axvline(0, color=GREY, lw=0.6)
            for element, colour in enumerate(AXIS_COLOURS.values()):
                self._point(axes, element, across, up, colour)
            axes.plot(0, 0, '+', color=INK, markersize=9, mew=1.3)
            axes.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect='equal', xlabel=f'{"xyz"[across]}, mm', ylabel=f'{"xyz"[up]}, mm')
            axes.locator_params(nbins=5)

    def _point(self, axes, element, across, up, colour):
        x, y = self.arms[element, across], self.arms[element, up]
        axes.annotate('', (x, y), (0, 0), arrowprops={'arrowstyle': '-', 'color': colour, 'lw': 1.1, 'alpha': 0.55})
        axes.plot(x, y, 'o', color=colour, markersize=5)
        index = [3 * element + across, 3 * element + up]
        values, vectors = np.linalg.eigh(self.cov[np.ix_(index, index)])
        angle = np.linspace(0, 2 * np.pi, 61)
        ring = 2 * np.sqrt(np.maximum(values, 0))[:, None] * np.stack([np.cos(angle), np.sin(angle)])
        axes.plot(*(np.array([[x], [y]]) + vectors @ ring), color=colour, lw=0.9)
        away = 11 * np.array([x, y]) / max(np.hypot(x, y), 1e-9)
        axes.annotate('xyz'[element], (x, y), away, textcoords='offset points', color=colour, fontsize=10, fontweight='bold', ha='center',
                      va='center')
