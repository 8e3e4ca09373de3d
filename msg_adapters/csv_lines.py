"""Lines of text logs that programs have decorated, as lines with columns."""

import re
from collections import Counter
from collections.abc import Sequence

SERIAL_STAMP = re.compile(r'\s*(\d{1,2}:\d\d:\d\d[.,]\d+) -> (.*)')
"""Line of a serial monitor that prints the time of its arrival."""
LABELLED_CELL = re.compile(
    r'([A-Za-z_][\w /^\[\]()%]{0,60}?)\s*[:=]\s*'
    r'([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?|nan)\s*(?:[,;\t]|\s|$)'
)
"""
Name and number, as for a plotter: ``ax:0.12``.

The name has a limit, and digits can be divided in one way only: the time of a search is otherwise
quadratic in the length of a line.
"""
SENSOR_LABELS = (
    ('acc', re.compile(r'acc(?:e|el|elerometer|eleration)?')),
    ('gyro', re.compile(r'gyr(?:o|os|oscope)?')),
)
"""Sensor -> word in its name, where a column names the sensor of each row."""
MOST_LINES = 50
"""Lines from which a decoration is recognised."""
LEAST_CELLS = 4
"""Labelled cells in a line, at least; three readings and a time."""
LEAST_DECORATED_SHARE = 0.8
"""Share of these lines with the decoration, at least."""
CELLS_OF_ECHO = 40
"""Numbers of a sensor_msgs/Imu, of which `ros2 topic echo` prints no header."""
ECHO_NAMES = (
    *('header.stamp.sec', 'header.stamp.nanosec', 'header.frame_id'),
    *(f'orientation.{axis}' for axis in 'xyzw'),
    *(f'orientation_covariance.{k}' for k in range(9)),
    *(f'angular_velocity.{axis}' for axis in 'xyz'),
    *(f'angular_velocity_covariance.{k}' for k in range(9)),
    *(f'linear_acceleration.{axis}' for axis in 'xyz'),
    *(f'linear_acceleration_covariance.{k}' for k in range(9)),
)


def plain_lines(lines: Sequence[str]) -> list[str]:
    """
    Return lines without the decorations of serial monitors, plotters and `ros2 topic echo`.

    The time that a serial monitor prints becomes a first column, labels and the fields of an Imu
    message become a header. Other lines are unchanged.
    """
    lines = _with_serial_column(lines)
    lines = _with_header_of_labels(lines)
    return _with_header_of_echo(lines)


def sensor_of_label(label: str) -> str:
    """Return the sensor of a row by its name: 'acc', 'gyro', or '' for another one."""
    words = re.split(r'[^a-z]+', re.sub(r'(?<=[a-z])(?=[A-Z])', ' ', label).lower())
    for sensor, word in SENSOR_LABELS:
        if any(map(word.fullmatch, words)):
            return sensor
    return ''


def _with_serial_column(lines: Sequence[str]) -> list[str]:
    """
    Return lines whose first column is the time of arrival that a serial monitor printed.

    Lines of another origin are unchanged.
    """
    matches = [SERIAL_STAMP.fullmatch(line) for line in lines[:MOST_LINES]]
    if not _are_most(matches):
        return list(lines)

    # The device printed its columns with the most frequent of these delimiters.
    texts = [match[2] for match in matches if match]
    delimiter = max('\t;, ', key=lambda mark: sum(text.count(mark) for text in texts))

    lines_with_time = []
    for line in lines:
        match = SERIAL_STAMP.fullmatch(line)
        text = match[2] if match else line
        # The header, a line without digits, gets the name of the column in place of its time, as
        # does a line without a time.
        has_digits = any(character.isdigit() for character in text)
        time = match[1] if match and has_digits else 'time'
        lines_with_time.append(f'{time}{delimiter}{text}')
    return lines_with_time


def _with_header_of_labels(lines: list[str]) -> list[str]:
    """Return numbers below a header with the most frequent labels, where each cell has a label."""
    labels = [_labels(line) for line in lines[:MOST_LINES]]
    if not _are_most(labels):
        return lines
    header = Counter(filter(None, labels)).most_common(1)[0][0]
    plain = [','.join(header)]
    for line in lines:
        if _labels(line) == header:
            plain.append(','.join(match[1] for match in LABELLED_CELL.findall(line)))
    return plain


def _labels(line: str) -> tuple[str, ...]:
    """Return the labels of a line of labelled numbers; () for another line."""
    cells = LABELLED_CELL.findall(line)
    if len(cells) < LEAST_CELLS or LABELLED_CELL.sub('', line).strip():
        return ()
    return tuple(label for label, _ in cells)


def _with_header_of_echo(lines: list[str]) -> list[str]:
    """Return messages below the names of their fields, where `ros2 topic echo` printed them."""
    are_messages = []
    for line in lines[:MOST_LINES]:
        cells = line.split(',')
        has_stamp = len(cells) == CELLS_OF_ECHO and cells[0].isdecimal() and cells[1].isdecimal()
        are_messages.append(has_stamp)
    if not _are_most(are_messages):
        return lines
    return [','.join(ECHO_NAMES), *lines]


def _are_most(decorations: Sequence) -> bool:
    """Return whether most lines have a decoration: a true element."""
    n_decorated = sum(map(bool, decorations))
    return bool(decorations) and n_decorated >= LEAST_DECORATED_SHARE * len(decorations)
