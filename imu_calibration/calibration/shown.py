"""A calibration as text: every parameter with its standard deviation, in common units, and the decision per sensor."""

from collections.abc import Iterator
from html import escape
from typing import TYPE_CHECKING

from imu_calibration.calibration.decision import decisions_text
from imu_calibration.calibration.status import COMMON_SCALE, Status
from imu_calibration.units import for_people, with_sd

if TYPE_CHECKING:
    from imu_calibration.calibration.document import Calibration

HEADINGS = ('parameter', 'value', 'sd', 'unit', 'status')
NUMBERS = ('value', 'sd')
"""Columns that are set flush right."""


def parameter_rows(calibration: 'Calibration') -> Iterator[tuple[str, ...]]:
    """Yield the cells of each parameter in the order of `HEADINGS`."""
    for effect in calibration.model.effects:
        part = calibration.model.slices[effect.key]
        for k, index in enumerate(range(part.start, part.stop)):
            factor, unit = for_people(effect.unit_of(k), effect.sensor)
            value, sd = with_sd(calibration.values[index] * factor, calibration.own_sd[index] * factor)
            yield calibration.param_names[index], value, sd, unit, str(calibration.status[index])
    if common := calibration.common_scale:
        yield COMMON_SCALE, *with_sd(1.0, common['sd']), '1', str(common['status'])


def summary(calibration: 'Calibration') -> str:
    """Return one line: the frame, the decisions, and how many parameters have which status."""
    known = list(calibration.status_by_name.values())
    counts = {status: known.count(status) for status in Status}
    parts = ', '.join(f'{count} {status}' for status, count in counts.items() if count)
    return f'<Calibration of {calibration.frame_id or "an IMU"}: {decisions_text(calibration.decisions)}, {parts}>'


def as_text(calibration: 'Calibration') -> str:
    """Return the parameters as a table of plain text."""
    rows = [HEADINGS, *parameter_rows(calibration)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    aligned = ('  '.join(cell.rjust(width) if heading in NUMBERS else cell.ljust(width)
                         for cell, width, heading in zip(row, widths, HEADINGS))
               for row in rows)
    return '\n'.join([summary(calibration), *map(str.rstrip, aligned)])


def as_html(calibration: 'Calibration') -> str:
    """Return the parameters as an HTML table, for notebooks."""
    def row(cells: tuple[str, ...], tag: str) -> str:
        style = [' style="text-align:right"' if heading in NUMBERS else ' style="text-align:left"' for heading in HEADINGS]
        return '<tr>' + ''.join(f'<{tag}{s}>{escape(cell)}</{tag}>' for cell, s in zip(cells, style, strict=True)) + '</tr>'
    body = ''.join(row(cells, 'td') for cells in parameter_rows(calibration))
    return f'<table><caption>{escape(summary(calibration))}</caption>{row(HEADINGS, "th")}{body}</table>'
