"""Figures that are drawn when they are shown: curves, spectra, the geometry of the sensors."""

import io
import math
import re
from collections.abc import Callable
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from imu_calibration.compensation.compensate import arms_of
from imu_calibration.core.errors import InputError
from imu_calibration.document import files
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.base import Role
from imu_calibration.references.turntable.residuals.spectrum import MIN_LINE_POWER
from imu_calibration.report.page import raised
from imu_calibration.selection.unexplained import Unexplained


class Drawn(str):
    """
    SVG of a matplotlib figure.

    Templates do not escape it, a notebook shows it, a file can contain it.
    """

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

    def save(self, path: str | PathLike, *, force: bool = False) -> None:
        """
        Write the figure as PDF, SVG or PNG, by the end of the name.

        Parameters
        ----------
        path : path-like
            An existing file is replaced with `force` only, unless it contains the same figure.
        force : bool

        Raises
        ------
        InputError
            For another end of the name, and where a file exists or cannot be written.

        """
        kind = Path(path).suffix.lower()
        if kind not in ('.pdf', '.svg', '.png'):
            raise InputError(
                f'the name of a figure must end with .pdf, .svg or .png, got {path}; change it',
                code='figure_suffix',
            )
        content = str(self).encode() if kind == '.svg' else self.bytes_as(kind[1:])
        # The same input gives the same bytes: a cell of a notebook may run again.
        if Path(path).is_file() and Path(path).read_bytes() == content:
            return
        files.require_new(path, force=force)
        files.write_whole(path, content, to_disk=kind != '.svg')

    def bytes_as(self, kind: str) -> bytes:
        """
        Return the figure as 'pdf', or as 'png' with 200 pixels per inch.

        The same input gives the same bytes.
        """
        whole = io.BytesIO()
        self.figure.savefig(
            whole,
            format=kind,
            dpi=200,
            facecolor='white',
            metadata={'CreationDate': None} if kind == 'pdf' else None,
        )
        return whole.getvalue()

    @property
    def data(self) -> list[dict[str, Any]]:
        """
        For each axes its title and labels, and 'lines': list of (label, x (n,), y (n,)).

        The arrays are in the units of the labels.
        """
        panels = []
        for axes in self.axes:
            lines = [(line.get_label(), *line.get_data()) for line in axes.get_lines()]
            panels.append(
                {
                    'title': axes.get_title(loc='left'),
                    'x': axes.get_xlabel(),
                    'y': axes.get_ylabel(),
                    'lines': lines,
                }
            )
        return panels


INK, GREY, FAINT = '#1b2430', '#5c6877', '#98a2b0'
BEFORE, AFTER = '#d55e00', '#0072b2'
AXIS_COLOURS = {'x': '#d55e00', 'y': '#009e73', 'z': '#0072b2'}
"""
Colours of the three axes: vermilion, bluish green and blue of Okabe and Ito, distinct for
colour-blind readers.
"""
STATUS = {'determined': '#2b8a57', 'weak': '#d08a12', 'held': '#b4322c'}
MARKER = {'x': 'o', 'y': 's', 'z': '^'}
NAMESPACES = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'


def draw(
    name: str, size: tuple[float, float], paint: Callable[..., None], *data: Any, label: str
) -> Drawn:
    """
    Return a figure as SVG for the page, with the matplotlib figure.

    Parameters
    ----------
    name : str
        Different for every figure of a page: the salt of its identifiers.
    size : (float, float)
        Inches; 96 pixels each on the page.
    paint : callable
        ``paint(figure, *data)`` draws on an empty matplotlib figure.
    data
        Its further arguments.
    label : str
        Text alternative of the figure.

    """
    import matplotlib
    from markupsafe import escape
    from matplotlib.figure import Figure

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_style() | {'svg.hashsalt': name})
        figure = Figure(figsize=size, layout='constrained')
        paint(figure, *data)
        canvas = _laid_out(figure)
        text = io.StringIO()
        # The layout leaves the figure at 72 dots per inch, too coarse for pictures inside the SVG.
        figure.dpi = matplotlib.rcParams['figure.dpi']
        canvas.print_svg(
            text, metadata={'Date': None, 'Creator': None, 'Format': None, 'Type': None}
        )
        return Drawn(_inside(text.getvalue(), str(escape(label))), figure)


@cache
def _style():
    """Return the settings of matplotlib for figures of a page."""
    from matplotlib import rc_params_from_file

    return dict(
        rc_params_from_file(
            Path(__file__).with_name('templates') / 'figure.mplstyle', use_default_template=False
        )
    )


def _laid_out(figure):
    """
    Place the axes once and return the canvas.

    `savefig` would do it twice more, and draw once without need.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    canvas = FigureCanvasSVG(figure)
    figure.get_layout_engine().execute(figure)
    figure.set_layout_engine('none')
    return canvas


def _inside(svg, label):
    """
    Return only the svg element, with a label for screen readers.

    Without prologue, metadata and the identifiers that repeat from figure to figure.
    """
    svg = svg[svg.index('<svg') :]
    svg = re.sub(r'<metadata>.*?</metadata>', '', svg, flags=re.S)
    svg = re.sub(r' id="[A-Za-z0-9.]+_[0-9]+"', '', svg)
    head = rf'<svg {NAMESPACES} viewBox="\1" role="img" aria-label="{label}">'
    svg = re.sub(r'<svg [^>]*viewBox="([^"]+)"[^>]*>', head, svg, count=1)
    svg = re.sub(r'\n\s*', '\n', svg)
    return re.sub(r'font: ([0-9.]+)px[^;\"]*', r'font-size: \1px', svg)


def log_axis(axis: Any) -> None:
    """
    Make an axis logarithmic with decades only, written as plain text.

    Plain text is used because mathtext uses most of the time of a page.
    """
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
    return '10' + raised(exponent)


def axis_legend(axes: Any, where: str = 'upper right', **more: Any) -> None:
    """Draw the legend of the three sensor axes."""
    handles = axis_handles(lw=0)
    axes.legend(handles=handles, loc=where, ncols=3, columnspacing=1.0, handletextpad=0.2, **more)


def axis_handles(lw: float) -> list[Any]:
    """Return the entries of the three sensor axes in a legend, with lines of a width."""
    from matplotlib.lines import Line2D

    return [
        Line2D([], [], color=colour, marker=MARKER[name], markersize=4, lw=lw, label=name)
        for name, colour in AXIS_COLOURS.items()
    ]


def draw_tones(sensor: str, rest: Unexplained) -> str:
    """Return the spectra with significant tones, as SVG; empty if there are none."""
    if not rest.tones:
        return ''
    label = f'Spectrum of the unexplained residual of the {sensor}'
    return draw(
        f'tones-{sensor}', (8.6, 0.6 + 2.1 * len(rest.tones)), _spectra, rest.tones, label=label
    )


def _spectra(figure, tones):
    """One panel for each tone: the power of its axis over that around it."""
    for axes, tone in zip(np.atleast_1d(figure.subplots(len(tones), 1)), tones):
        axes.plot(tone.frequencies, tone.power, color=AFTER, lw=0.9)
        axes.axhline(MIN_LINE_POWER, color=GREY, lw=0.6)
        axes.axvline(tone.frequency, color=INK, lw=0.8, ls=':')
        log_axis(axes.yaxis)
        axes.set(
            title=f'{tone.sensor} {tone.axis}',
            ylabel='relative power',
            xlabel='frequency, Hz' if tone.joint is None else f'cycles per turn of {tone.joint}',
        )


PLANES = ((0, 1), (0, 2), (1, 2))


def lever_figure(calibration: Calibration) -> Drawn | None:
    """Return the drawing of the lever arms, or None when the model has none."""
    if calibration.of('accelerometer', Role.ARMS) is None:
        return None
    part = calibration.model.part('accelerometer', Role.ARMS)
    return draw(
        'lever-arms',
        (8.6, 3.15),
        _views,
        arms_of(calibration) * 1e3,
        calibration.covariance[part, part] * 1e6,
        label='Sensitive points of the three accelerometers in three views',
    )


def _views(figure, arms, cov):
    """Draw the sensitive points, mm, (3, 3), with ellipses of two sd in three views."""
    # All views have one scale, that shows the points and, where they are close, their sds.
    limit = 1.25 * max(float(np.max(np.abs(arms))), 3 * float(np.sqrt(np.diag(cov).min())), 1e-3)
    for axes, (across, up) in zip(figure.subplots(1, 3), PLANES):
        axes.axhline(0, color=GREY, lw=0.6)
        axes.axvline(0, color=GREY, lw=0.6)
        for element, colour in enumerate(AXIS_COLOURS.values()):
            # The two components of this point in the view, of the nine ones row by row.
            index = [3 * element + across, 3 * element + up]
            _point(axes, arms.ravel()[index], cov[np.ix_(index, index)], 'xyz'[element], colour)
        axes.plot(0, 0, '+', color=INK, markersize=9, mew=1.3)
        axes.set(
            xlim=(-limit, limit),
            ylim=(-limit, limit),
            aspect='equal',
            xlabel=f'{"xyz"[across]}, mm',
            ylabel=f'{"xyz"[up]}, mm',
        )
        axes.locator_params(nbins=5)


def _point(axes, place, cov, name, colour):
    """Draw a sensitive point in one view, with its arm, ellipse of two sd and name."""
    x, y = place
    axes.annotate(
        '',
        (x, y),
        (0, 0),
        arrowprops={'arrowstyle': '-', 'color': colour, 'lw': 1.1, 'alpha': 0.55},
    )
    axes.plot(x, y, 'o', color=colour, markersize=5)
    # Ellipse in its principal axes, then turned and moved to the point.
    values, vectors = np.linalg.eigh(cov)
    angle = np.linspace(0, 2 * np.pi, 61)
    ring = 2 * np.sqrt(np.maximum(values, 0))[:, None] * np.stack([np.cos(angle), np.sin(angle)])
    axes.plot(*(np.array([[x], [y]]) + vectors @ ring), color=colour, lw=0.9)
    name_offset = 11 * np.array([x, y]) / max(np.hypot(x, y), 1e-9)
    axes.annotate(
        name,
        (x, y),
        name_offset,
        textcoords='offset points',
        color=colour,
        fontsize=10,
        fontweight='bold',
        ha='center',
        va='center',
    )
