"""A copy of a text log with corrected readings in place of the measured ones."""

import csv
import io
from os import PathLike

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import SI_UNITS
from imu_calibration.core.samples import ImuSamples
from imu_calibration.document.files import write_whole
from msg_adapters.csv_log import CORRECTED, SENSOR_OF, CsvLog, LogText, name_with_unit, split_cells


def write_corrected_log(path: str | PathLike[str], log: CsvLog, corrected: ImuSamples) -> None:
    """
    Write a text log with the columns of another one and its readings corrected.

    The first line is the header, which states the units and that the readings are corrected; force
    and rate are in SI, and empty where a reading could not be corrected. Time and all other columns
    are copied as text.

    Parameters
    ----------
    path : path-like
        File to make; it appears when it is complete.
    log : CsvLog
        The log that was corrected; of one log per sensor the rows are those of the slower one.
    corrected : ImuSamples
        One for each sample of the log, in SI.

    Raises
    ------
    InputError
        When rows and samples do not correspond, or the file cannot be written.

    """
    text = log.text
    if text is None or len(corrected) != len(text.row_of_sample):
        raise InputError(
            f'each row of a text log must give one sample, {path} cannot be written; name a folder'
            ' for a bag',
            code='csv_rows',
        )
    readings = {}
    for quantity, values in (('force', corrected.force_s), ('rate', corrected.rate_s)):
        if quantity in text.places:
            readings[quantity] = values

    out = io.StringIO()
    # White space is no delimiter of names that contain it.
    delimiter = '\t' if text.delimiter is None else text.delimiter
    writer = csv.writer(out, delimiter=delimiter, lineterminator='\n')
    names = _corrected_header(text)
    writer.writerow(names)

    # Rows as they were read, with new cells of force and rate.
    for k, row in enumerate(text.row_of_sample.tolist()):
        cells = split_cells(text.lines[row], text.delimiter, text.path)
        cells += [''] * (len(names) - len(cells))
        for quantity, values in readings.items():
            for place, value in zip(text.places[quantity], values[k].tolist(), strict=True):
                cells[place] = _number(value, text.decimal_comma)
        writer.writerow(cells)
    write_whole(path, out.getvalue().encode())


def _corrected_header(text: LogText) -> list[str]:
    """Return the names of all columns, with the unit of each column that was read."""
    names = list(text.names)
    for columns in text.columns:
        if columns.quantity == 'time' and len(columns.names) == 2:
            continue  # seconds and nanoseconds
        for place in text.places.get(columns.quantity, ()):
            unit = columns.unit
            if columns.quantity in SENSOR_OF:
                unit = f'{SI_UNITS[SENSOR_OF[columns.quantity]]} {CORRECTED}'
            # A date or a time of day has no unit.
            if unit is not None and (columns.quantity != 'time' or _is_number(text, place)):
                names[place] = name_with_unit(names[place], columns.quantity, unit)
    return names


def _is_number(text: LogText, place: int) -> bool:
    """Return whether the first cell of a column is a number, not a date or a time of day."""
    cell = split_cells(text.lines[0], text.delimiter, text.path)[place]
    return ':' not in cell


def _number(value: float, comma: bool) -> str:
    """Return a number as text; '' for NaN."""
    if not np.isfinite(value):
        return ''
    number = f'{value:.10g}'
    return number.replace('.', ',') if comma else number
